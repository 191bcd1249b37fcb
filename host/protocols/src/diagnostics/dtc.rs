//! Trouble codes by their names: P0123.

use std::fmt;

use super::names::FILE;
use crate::table::Table;

pub static STATUS: Table = Table::new(FILE, "dtc_status");

/// A trouble code of two bytes (SAE J2012): a letter and four digits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dtc(pub u16);

impl fmt::Display for Dtc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let letter = ['P', 'C', 'B', 'U'][usize::from(self.0 >> 14)];
        write!(f, "{letter}{:04X}", self.0 & 0x3FFF)
    }
}

/// Codes of two bytes, separated by commas; zeros are padding.
pub fn list(bytes: &[u8]) -> String {
    let codes = bytes.chunks_exact(2).map(|code| u16::from_be_bytes([code[0], code[1]]));
    codes.filter(|code| *code != 0).map(|code| Dtc(code).to_string()).collect::<Vec<_>>().join(", ")
}

/// Codes of three bytes, each with a status byte, as UDS reports them: `P0123-11 (confirmed)`.
pub fn list_with_status(bytes: &[u8]) -> String {
    let codes = bytes.chunks_exact(4).map(|code| {
        let name = Dtc(u16::from_be_bytes([code[0], code[1]]));
        format!("{name}-{:02X} ({})", code[2], status(code[3]))
    });
    codes.collect::<Vec<_>>().join(", ")
}

/// The bits of a status (ISO 14229-1:2020, D.2).
pub fn status(byte: u8) -> String {
    let set = STATUS.bits(byte).collect::<Vec<_>>().join(" + ");
    if set.is_empty() { "no status".to_owned() } else { set }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_have_their_letters() {
        assert_eq!(
            list(&[0x01, 0x33, 0x41, 0x55, 0x92, 0x34, 0xC1, 0x58, 0, 0]),
            "P0133, C0155, B1234, U0158"
        );
        assert_eq!(list_with_status(&[0x01, 0x23, 0x11, 0x08]), "P0123-11 (confirmed)");
        assert_eq!(status(0), "no status");
    }
}
