//! Frames of explicit messages, as types without state: for those who read a bus and for nodes. Volume III of the CIP networks library,
//! chapter 3 (connection identifiers) and 4 (fragmentation).

use cantap_trace::Id;

/// The MAC IDs of a network.
pub const MAC_IDS: u8 = 64;
/// The service that refuses.
pub const ERROR_RESPONSE: u8 = 0x14;
/// The bit of a service that marks it as a response.
pub const RESPONSE: u8 = 0x80;

/// The identifiers of a slave of the predefined master/slave connection set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SlaveMessage {
    /// Group 1, message 15: what it answers to a poll.
    PollResponse,
    /// Group 2, message 3: explicit responses, also those of unconnected requests.
    ExplicitResponse,
    /// Group 2, message 4: explicit requests of its master.
    ExplicitRequest,
    /// Group 2, message 5: a poll, with its outputs.
    Poll,
    /// Group 2, message 6: explicit requests without a connection.
    UnconnectedRequest,
    /// Group 2, message 7: the check for duplicate MAC IDs.
    DuplicateCheck,
}

impl SlaveMessage {
    /// The identifier for the slave with this MAC ID, 0 to 63.
    pub const fn id(self, mac: u8) -> Id {
        let mac = (mac % MAC_IDS) as u32;
        Id::standard_truncated(match self {
            Self::PollResponse => 0x3C0 | mac,
            Self::ExplicitResponse => 0x400 | mac << 3 | 3,
            Self::ExplicitRequest => 0x400 | mac << 3 | 4,
            Self::Poll => 0x400 | mac << 3 | 5,
            Self::UnconnectedRequest => 0x400 | mac << 3 | 6,
            Self::DuplicateCheck => 0x400 | mac << 3 | 7,
        })
    }
}

/// The first byte of an explicit message's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ExplicitHeader {
    /// The message has several frames, and this one a second byte that says which.
    pub fragmented: bool,
    /// A response repeats its request's.
    pub transaction: bool,
    /// The other side's MAC ID, 0 to 63.
    pub mac: u8,
}

impl ExplicitHeader {
    /// The byte.
    pub const fn encode(self) -> u8 {
        (self.fragmented as u8) << 7 | (self.transaction as u8) << 6 | self.mac & 0x3F
    }

    /// From the byte.
    pub const fn decode(byte: u8) -> Self {
        Self { fragmented: byte & 0x80 != 0, transaction: byte & 0x40 != 0, mac: byte & 0x3F }
    }
}

/// The second byte of a fragmented message's frames; numbers count from 0 and wrap at 64.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fragment {
    /// The first one. Its number is 0.
    First,
    /// One in the middle.
    Middle(u8),
    /// The last one.
    Last(u8),
    /// The receiver has it, or says by a status other than 0 that it does not want it.
    Acknowledge(u8),
}

impl Fragment {
    /// The byte.
    pub const fn encode(self) -> u8 {
        match self {
            Self::First => 0,
            Self::Middle(number) => 0x40 | number & 0x3F,
            Self::Last(number) => 0x80 | number & 0x3F,
            Self::Acknowledge(number) => 0xC0 | number & 0x3F,
        }
    }

    /// From the byte.
    pub const fn decode(byte: u8) -> Self {
        let number = byte & 0x3F;
        match byte >> 6 {
            0 => Self::First,
            1 => Self::Middle(number),
            2 => Self::Last(number),
            _ => Self::Acknowledge(number),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::identifiers::{Use, use_of};
    use super::*;

    #[test]
    fn identifiers_and_bytes_are_read_as_they_were_written() {
        for mac in [0, 5, 63] {
            let used = |message: SlaveMessage| use_of(message.id(mac).raw() as u16).unwrap();
            assert_eq!(used(SlaveMessage::PollResponse), Use::Io(mac, "poll response", true));
            assert_eq!(used(SlaveMessage::Poll), Use::Io(mac, "poll command", false));
            assert_eq!(used(SlaveMessage::ExplicitResponse), Use::Response(mac));
            assert_eq!(used(SlaveMessage::ExplicitRequest), Use::Request(mac));
            assert_eq!(used(SlaveMessage::UnconnectedRequest), Use::Request(mac));
            assert_eq!(used(SlaveMessage::DuplicateCheck), Use::DuplicateCheck(mac));
        }
        for byte in 0..=u8::MAX {
            assert_eq!(ExplicitHeader::decode(byte).encode(), byte);
            if byte == 0 || byte > 0x3F {
                assert_eq!(Fragment::decode(byte).encode(), byte);
            }
        }
    }
}
