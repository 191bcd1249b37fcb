//! The 29-bit identifier according to SAE J1939-21.

use cantap_trace::Id;

use crate::Party;

/// To all.
pub const GLOBAL: u8 = 255;
/// The sender has no address.
pub const NULL: u8 = 254;

/// The content of an identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Header {
    /// 0, the highest, to 7.
    pub priority: u8,
    /// The parameter group's number, 18 bits.
    pub pgn: u32,
    /// The sender's address.
    pub source: u8,
    /// The receiver's address; 255 for all.
    pub destination: u8,
}

impl Header {
    /// Parses an identifier; `None` for one of 11 bits.
    pub fn of(id: Id) -> Option<Self> {
        if !id.is_extended() {
            return None;
        }
        let raw = id.raw();
        let (priority, source) = ((raw >> 26) as u8, raw as u8);
        let group = raw >> 8 & 0x3_FFFF;
        // If the format byte is below 240, it is followed by an address (J1939-21, 5.2.3).
        let (pgn, destination) =
            if group >> 8 & 0xFF < 240 { (group & 0x3_FF00, group as u8) } else { (group, GLOBAL) };
        Some(Self { priority, pgn, source, destination })
    }

    /// The identifier for a message with this header.
    pub fn id(self) -> Id {
        let to = if self.pgn >> 8 & 0xFF < 240 { u32::from(self.destination) << 8 } else { 0 };
        Id::extended_truncated(u32::from(self.priority) << 26 | self.pgn << 8 | to | u32::from(self.source))
    }
}

/// An address as a party.
pub fn party(address: u8) -> Party {
    match address {
        GLOBAL => Party::Everyone,
        NULL => Party::Unknown,
        address => Party::Node(address),
    }
}

/// A number of 18 bits in three bytes, as in transport frames and requests.
pub fn pgn(bytes: [u8; 3]) -> u32 {
    u32::from_le_bytes([bytes[0], bytes[1], bytes[2], 0]) & 0x3_FFFF
}
