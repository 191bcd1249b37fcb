//! Takes a message's fields from its bytes, one after the other.

use std::borrow::Cow;

use super::values::{number, unsigned};
use crate::Field;

/// The bytes that are left, and the fields so far. A field that the bytes do not suffice for takes none: [`Cursor::finish`] shows what is
/// left.
pub struct Cursor<'a, 'f> {
    left: &'a [u8],
    fields: &'f mut Vec<Field>,
}

impl<'a, 'f> Cursor<'a, 'f> {
    pub fn new(bytes: &'a [u8], fields: &'f mut Vec<Field>) -> Self {
        Self { left: bytes, fields }
    }

    /// Bytes that make no field.
    pub fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, left) = self.left.split_at_checked(count)?;
        self.left = left;
        Some(taken)
    }

    /// A byte shown in hexadecimal, with its meaning.
    pub fn byte<T: Into<Cow<'static, str>>>(
        &mut self,
        name: &'static str,
        meaning: impl FnOnce(u8) -> Option<T>,
    ) -> Option<u8> {
        let byte = self.take(1)?[0];
        self.fields.push(Field::hex(name, byte, 2).meaning(meaning(byte)));
        Some(byte)
    }

    /// A number of several bytes, shown in hexadecimal.
    pub fn hex(&mut self, name: &'static str, bytes: usize) -> Option<u64> {
        let value = number(self.take(bytes)?);
        self.fields.push(Field::hex(name, value, 2 * bytes as u8));
        Some(value)
    }

    /// A number of up to eight bytes, shown in decimal.
    pub fn number(&mut self, name: &'static str, bytes: usize, unit: &'static str) -> Option<()> {
        if !(1..=8).contains(&bytes) {
            return None;
        }
        let value = number(self.take(bytes)?);
        self.push(unsigned(name, value).unit(unit));
        Some(())
    }

    /// This many bytes as they are.
    pub fn bytes(&mut self, name: &'static str, count: usize) -> Option<()> {
        let bytes = self.take(count)?;
        self.push(Field::bytes(name, bytes));
        Some(())
    }

    /// Bytes after a length of two bytes. If there are none, there is no field.
    pub fn sized(&mut self, name: &'static str) -> Option<()> {
        let (length, left) = self.left.split_first_chunk::<2>()?;
        let (bytes, left) = left.split_at_checked(usize::from(u16::from_be_bytes(*length)))?;
        self.left = left;
        if !bytes.is_empty() {
            self.push(Field::bytes(name, bytes));
        }
        Some(())
    }

    pub fn push(&mut self, field: Field) {
        self.fields.push(field);
    }

    /// Leaves out the rest.
    pub fn skip(&mut self) {
        self.left = &[];
    }

    /// Bytes that are left.
    pub const fn left(&self) -> usize {
        self.left.len()
    }

    /// Shows what is left, if anything.
    pub fn finish(self, name: &'static str) {
        if !self.left.is_empty() {
            self.fields.push(Field::bytes(name, self.left));
        }
    }
}
