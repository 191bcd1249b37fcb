//! A node's object dictionary, made from its sheet (CiA 306).

use std::collections::BTreeMap;

use crate::canopen::codec::sdo::{SdoObject, abort};
use crate::canopen::eds::{self, Eds};

/// Longest value that is accepted, in bytes.
pub const MOST_OBJECT_BYTES: usize = 1 << 16;

#[derive(Clone, Debug)]
struct Entry {
    /// Length of a value in bytes; `None` if it may have any.
    length: Option<usize>,
    is_signed: bool,
    can_read: bool,
    can_write: bool,
    mappable: bool,
    value: Vec<u8>,
}

/// All of the node's objects.
#[derive(Clone, Debug, Default)]
pub struct ObjectDictionary {
    entries: BTreeMap<(u16, u8), Entry>,
}

/// Bytes of a data type (CiA 301, table 44); `None` for texts and domains.
const fn length(data_type: u16) -> Option<usize> {
    Some(match data_type {
        0x01 | 0x02 | 0x05 => 1,
        0x03 | 0x06 => 2,
        0x04 | 0x07 | 0x08 => 4,
        0x11 | 0x15 | 0x1B => 8,
        _ => return None,
    })
}

impl ObjectDictionary {
    /// The sheet's values, for a node with this number.
    pub fn new(sheet: &Eds, node: u8) -> Self {
        let mut entries = BTreeMap::new();
        for (&index, object) in &sheet.objects {
            for (&sub, entry) in &object.entries {
                let length = entry.data_type.and_then(length);
                let value = match length {
                    Some(length) => {
                        let number = eds::number(&entry.value, node).unwrap_or(0);
                        number.to_le_bytes()[..length].to_vec()
                    }
                    None => entry.value.clone().into_bytes(),
                };
                let access = entry.access.as_str();
                let (can_read, can_write) = (access != "wo", access.starts_with("rw") || access == "wo");
                let is_signed = matches!(entry.data_type, Some(0x02..=0x04 | 0x15));
                let made = Entry { length, is_signed, can_read, can_write, mappable: entry.mappable, value };
                entries.insert((index, sub), made);
            }
        }
        Self { entries }
    }

    fn entry(&self, index: u16, sub: u8) -> Result<&Entry, u32> {
        let missing = || {
            let known = self.entries.range((index, 0)..=(index, u8::MAX)).next().is_some();
            if known { abort::NO_ENTRY } else { abort::NO_OBJECT }
        };
        self.entries.get(&(index, sub)).ok_or_else(missing)
    }

    /// A client reads.
    ///
    /// # Errors
    /// The abort code: no such object, or it can only be written.
    pub fn read(&self, object: SdoObject) -> Result<&[u8], u32> {
        let entry = self.entry(object.index, object.sub)?;
        if entry.can_read { Ok(&entry.value) } else { Err(abort::WRITE_ONLY) }
    }

    /// Whether a client may write this many bytes, or any number if it does not say.
    ///
    /// # Errors
    /// The abort code: no such object, it can only be read, or it has another length.
    pub fn may_write(&self, object: SdoObject, bytes: Option<usize>) -> Result<(), u32> {
        let entry = self.entry(object.index, object.sub)?;
        if !entry.can_write {
            return Err(abort::READ_ONLY);
        }
        match (bytes, entry.length) {
            (Some(bytes), Some(length)) if bytes != length => Err(abort::LENGTH),
            (Some(bytes), _) if bytes > MOST_OBJECT_BYTES => Err(abort::MEMORY),
            _ => Ok(()),
        }
    }

    /// A client writes.
    ///
    /// # Errors
    /// The abort code, as [`Self::may_write`], or because a PDO's mapping is not allowed.
    pub fn write(&mut self, object: SdoObject, value: &[u8]) -> Result<(), u32> {
        self.may_write(object, Some(value.len()))?;
        let SdoObject { index, sub } = object;
        let number = value.iter().take(4).rev().fold(0_u32, |number, byte| number << 8 | u32::from(*byte));
        match (index, sub) {
            // The history can only be cleared.
            (0x1003, 0) if number != 0 => return Err(abort::VALUE),
            (0x1600..=0x17FF | 0x1A00..=0x1BFF, 0) => self.check_mapping(index, number)?,
            // CiA 301, 7.5.2.36: first set the number to zero, then map objects, then set their number.
            (0x1600..=0x17FF | 0x1A00..=0x1BFF, 1..) if self.number(index, 0) != 0 => {
                return Err(abort::STATE);
            }
            _ => {}
        }
        self.set(index, sub, value);
        Ok(())
    }

    /// Whether the first `count` entries of a mapping can be sent or received.
    fn check_mapping(&self, index: u16, count: u32) -> Result<(), u32> {
        let mut bits = 0;
        for sub in 1..=u8::try_from(count).map_err(|_| abort::VALUE)? {
            let mapped = self.entry(index, sub).map_err(|_| abort::VALUE).map(|_| self.number(index, sub))?;
            let (object, of) = ((mapped >> 16) as u16, (mapped >> 8) as u8);
            // Below 20h it is a type: a placeholder for unused bytes.
            if object >= 0x20 && !self.entry(object, of)?.mappable {
                return Err(abort::NOT_MAPPABLE);
            }
            bits += mapped & 0xFF;
        }
        if bits > 64 { Err(abort::PDO_LENGTH) } else { Ok(()) }
    }

    /// Sets the node's own value; without an entry, nothing happens.
    pub fn set(&mut self, index: u16, sub: u8, value: &[u8]) {
        if let Some(entry) = self.entries.get_mut(&(index, sub)) {
            entry.value = value.to_vec();
        }
    }

    /// A value as a number; 0 if there is none.
    pub fn number(&self, index: u16, sub: u8) -> u32 {
        let value = self.entries.get(&(index, sub)).map_or(&[][..], |entry| &entry.value);
        value.iter().take(4).rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
    }

    /// A value: a number with its sign, or [`None`] if its type is none of up to 64 bits.
    ///
    /// # Errors
    /// The abort code if there is no such object.
    pub fn integer(&self, index: u16, sub: u8) -> Result<Option<i64>, u32> {
        let entry = self.entry(index, sub)?;
        let Some(length) = entry.length else { return Ok(None) };
        let raw = entry.value.iter().take(8).rev().fold(0_u64, |number, byte| number << 8 | u64::from(*byte));
        let unused = 64 - 8 * length.clamp(1, 8);
        let signed = (raw << unused) as i64 >> unused;
        Ok(Some(if entry.is_signed { signed } else { raw as i64 }))
    }

    /// The bytes of a value, whether clients may read it or not.
    ///
    /// # Errors
    /// The abort code if there is no such object.
    pub fn bytes(&self, index: u16, sub: u8) -> Result<&[u8], u32> {
        self.entry(index, sub).map(|entry| &entry.value[..])
    }

    /// Sets the node's own value to a number, of which as many bytes count as the object has.
    ///
    /// # Errors
    /// The abort code if there is no such object, or it is no number.
    pub fn set_integer(&mut self, index: u16, sub: u8, value: i64) -> Result<(), u32> {
        let length = self.entry(index, sub)?.length.ok_or(abort::LENGTH)?;
        self.set(index, sub, &value.to_le_bytes()[..length]);
        Ok(())
    }

    /// The data of a TPDO whose mapping is this object (1A00h to 1BFFh).
    pub fn pdo(&self, mapping: u16) -> Vec<u8> {
        let (mut bits, mut filled) = (0_u64, 0);
        for (index, sub, length) in self.mapping(mapping) {
            let raw = self.bytes(index, sub).unwrap_or_default();
            let value = raw.iter().take(8).rev().fold(0_u64, |number, byte| number << 8 | u64::from(*byte));
            let kept = if length >= 64 { value } else { value & ((1 << length) - 1) };
            bits |= kept.checked_shl(filled as u32).unwrap_or(0);
            filled += length;
        }
        bits.to_le_bytes()[..filled.min(64).div_ceil(8)].to_vec()
    }

    /// Takes the data of an RPDO whose mapping is this object (1600h to 17FFh): returns the objects that it has set, or [`None`] if it is too
    /// short, and then it sets none.
    pub fn take_pdo(&mut self, mapping: u16, data: &[u8]) -> Option<Vec<SdoObject>> {
        let mapping: Vec<_> = self.mapping(mapping).collect();
        let needed: usize = mapping.iter().map(|(.., length)| length).sum();
        if data.len() * 8 < needed {
            return None;
        }
        let all = data.iter().take(8).rev().fold(0_u64, |bits, byte| bits << 8 | u64::from(*byte));
        let mut at = 0;
        for &(index, sub, length) in &mapping {
            let value = all.checked_shr(at as u32).unwrap_or(0);
            at += length;
            self.set(index, sub, &value.to_le_bytes()[..length.div_ceil(8).min(8)]);
        }
        Some(mapping.into_iter().map(|(index, sub, _)| SdoObject { index, sub }).collect())
    }

    /// The mapping of a PDO, in order: object, entry, bits.
    pub fn mapping(&self, index: u16) -> impl Iterator<Item = (u16, u8, usize)> + '_ {
        (1..=self.number(index, 0).min(64) as u8).map(move |sub| {
            let mapped = self.number(index, sub);
            ((mapped >> 16) as u16, (mapped >> 8) as u8, (mapped & 0xFF) as usize)
        })
    }
}
