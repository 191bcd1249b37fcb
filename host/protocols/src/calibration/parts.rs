//! The parts of commands and responses, as tables name them, read into fields.

use std::borrow::Cow;

use crate::Field;

/// In which order the bytes of a number are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ByteOrder {
    /// The lowest first (Intel).
    Little,
    /// The highest first (Motorola).
    Big,
}

impl ByteOrder {
    /// The number in these bytes, of which the first eight count.
    pub fn number(self, bytes: &[u8]) -> u64 {
        let bytes = &bytes[..bytes.len().min(8)];
        let add = |number: u64, byte: &u8| number << 8 | u64::from(*byte);
        match self {
            Self::Little => bytes.iter().rev().fold(0, add),
            Self::Big => bytes.iter().fold(0, add),
        }
    }

    /// The lowest `size` bytes of a number, at most eight.
    pub fn bytes(self, number: u64, size: usize) -> Vec<u8> {
        let size = size.min(8);
        match self {
            Self::Little => number.to_le_bytes()[..size].to_vec(),
            Self::Big => number.to_be_bytes()[8 - size..].to_vec(),
        }
    }
}

/// A part of a command or of a response.
#[derive(Clone, Copy, Debug)]
pub enum PacketPart {
    /// Bytes that mean nothing.
    Skip(usize),
    /// A number of so many bytes, written in decimal.
    Number(&'static str, usize),
    /// A number of so many bytes, written in hexadecimal.
    Hex(&'static str, usize),
    /// A byte whose values have names.
    Named(&'static str, &'static [(u8, &'static str)]),
    /// A byte whose bits have names.
    Bits(&'static str, &'static [(u8, &'static str)]),
    /// All that follows, as it is.
    Rest(&'static str),
}

/// A command of XCP or CCP.
#[derive(Debug)]
pub struct CommandDefinition {
    /// Its first byte.
    pub code: u8,
    /// Its name in the standard.
    pub name: &'static str,
    /// What follows in a command: the first byte, and CCP's counter, are not among it.
    pub request: &'static [PacketPart],
    /// What follows in an answer that agrees: the packet identifier, and CCP's return code and counter, are not among it.
    pub response: &'static [PacketPart],
}

/// One line of a table of commands.
pub(crate) const fn command(
    code: u8,
    name: &'static str,
    request: &'static [PacketPart],
    response: &'static [PacketPart],
) -> CommandDefinition {
    CommandDefinition { code, name, request, response }
}

/// The names of the bits of a byte that are set, each a mask.
pub fn bit_names(byte: u8, names: &[(u8, &'static str)]) -> Option<String> {
    let set = names.iter().filter(|(mask, _)| byte & mask != 0).map(|(_, name)| *name);
    let names = set.collect::<Vec<_>>().join(", ");
    (!names.is_empty()).then_some(names)
}

/// The name of a number in a table.
pub fn name_in(table: &[(u8, &'static str)], number: u8) -> Option<&'static str> {
    table.iter().find(|(known, _)| *known == number).map(|(_, name)| *name)
}

/// Appends the fields that these parts name. Where the order of bytes is not known, numbers of more than one byte are bytes. Parts that are
/// not there are left out.
pub fn push_parts(fields: &mut Vec<Field>, parts: &[PacketPart], mut data: &[u8], order: Option<ByteOrder>) {
    for part in parts {
        let size = match *part {
            PacketPart::Skip(size) | PacketPart::Number(_, size) | PacketPart::Hex(_, size) => size,
            PacketPart::Named(..) | PacketPart::Bits(..) => 1,
            PacketPart::Rest(_) => data.len(),
        };
        let Some((bytes, rest)) = data.split_at_checked(size) else { return };
        data = rest;
        let order = if size == 1 { Some(ByteOrder::Little) } else { order };
        match (*part, order) {
            (PacketPart::Skip(_), _) => {}
            (PacketPart::Rest(_), _) if bytes.is_empty() => {}
            (PacketPart::Number(name, _), Some(order)) => {
                fields.push(Field::number(name, order.number(bytes) as i64));
            }
            (PacketPart::Hex(name, size), Some(order)) => {
                fields.push(Field::hex(name, order.number(bytes), 2 * size as u8));
            }
            (PacketPart::Named(name, names), _) => {
                fields.push(Field::hex(name, bytes[0], 2).meaning(name_in(names, bytes[0])));
            }
            (PacketPart::Bits(name, names), _) => {
                fields.push(Field::hex(name, bytes[0], 2).meaning(bit_names(bytes[0], names).map(Cow::from)));
            }
            (PacketPart::Number(name, _) | PacketPart::Hex(name, _) | PacketPart::Rest(name), _) => {
                fields.push(Field::bytes(name, bytes));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_and_written_in_both_orders() {
        for order in [ByteOrder::Little, ByteOrder::Big] {
            assert_eq!(order.number(&order.bytes(0x1234_5678, 4)), 0x1234_5678);
        }
        assert_eq!(ByteOrder::Big.bytes(0x1234, 2), [0x12, 0x34]);
        assert_eq!(ByteOrder::Little.number(&[0x34, 0x12]), 0x1234);
    }

    #[test]
    fn what_cannot_be_read_stays_bytes_and_what_is_missing_is_left_out() {
        let parts = [PacketPart::Number("a", 1), PacketPart::Hex("b", 2), PacketPart::Number("c", 4)];
        let mut fields = Vec::new();
        push_parts(&mut fields, &parts, &[7, 0x12, 0x34], None);
        let text: Vec<_> = fields.iter().map(ToString::to_string).collect();
        assert_eq!(text, ["a 7", "b 12 34"]);
    }
}
