//! What an identifier of 29 bits and the last byte of a frame say.

use cantap_trace::Id;

use crate::Party;
use crate::dsdl::Generation;

/// What a transfer is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Purpose {
    /// To all, of DroneCAN's data type or Cyphal's subject with the number.
    Message,
    /// To the server of a service.
    Request,
    /// Back to its client.
    Response,
}

/// An identifier's parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    /// 0 is the highest: up to 31 in DroneCAN, 7 in Cyphal.
    pub priority: u8,
    pub purpose: Purpose,
    /// The number of the data type, subject or service. Of an anonymous message of DroneCAN, its lowest two bits.
    pub port: u16,
    /// None if it is anonymous, because it has no number yet.
    pub source: Option<u8>,
    /// The server or the client.
    pub destination: Option<u8>,
}

impl Header {
    /// None if the identifier is not of that form.
    pub fn of(id: Id, generation: Generation) -> Option<Self> {
        if !id.is_extended() {
            return None;
        }
        let bits = |at: u32, count: u32| (id.raw() >> at & ((1 << count) - 1)) as u16;
        let bit = |at: u32| bits(at, 1) == 1;
        let source = bits(0, 7) as u8;
        match generation {
            Generation::DroneCan => {
                let priority = bits(24, 5) as u8;
                if bit(7) {
                    let purpose = if bit(15) { Purpose::Request } else { Purpose::Response };
                    let destination = bits(8, 7) as u8;
                    // Services have two nodes with numbers.
                    return (source != 0 && destination != 0).then_some(Self {
                        priority,
                        purpose,
                        port: bits(16, 8),
                        source: Some(source),
                        destination: Some(destination),
                    });
                }
                let port = if source == 0 { bits(8, 2) } else { bits(8, 16) };
                let source = Some(source).filter(|source| *source != 0);
                Some(Self { priority, purpose: Purpose::Message, port, source, destination: None })
            }
            Generation::Cyphal => {
                let priority = bits(26, 3) as u8;
                // Frames with this bit are to be left alone, and so are messages with the other.
                if bit(23) || !bit(25) && bit(7) {
                    return None;
                }
                if bit(25) {
                    let purpose = if bit(24) { Purpose::Request } else { Purpose::Response };
                    let destination = Some(bits(7, 7) as u8);
                    return Some(Self {
                        priority,
                        purpose,
                        port: bits(14, 9),
                        source: Some(source),
                        destination,
                    });
                }
                let source = Some(source).filter(|_| !bit(24));
                Some(Self {
                    priority,
                    purpose: Purpose::Message,
                    port: bits(8, 13),
                    source,
                    destination: None,
                })
            }
        }
    }

    /// The sender.
    pub fn from(self) -> Party {
        self.source.map_or(Party::Unknown, Party::Node)
    }

    /// The receiver.
    pub fn to(self) -> Party {
        self.destination.map_or(Party::Everyone, Party::Node)
    }
}

/// The last byte of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tail {
    pub starts: bool,
    pub ends: bool,
    pub toggle: bool,
    /// Counts the sender's transfers of a kind, from 0 to 31.
    pub transfer: u8,
}

impl Tail {
    /// Of a frame's data, with the rest of them.
    pub fn of(data: &[u8]) -> Option<(Self, &[u8])> {
        let (tail, payload) = data.split_last()?;
        let tail = Self {
            starts: tail & 0x80 != 0,
            ends: tail & 0x40 != 0,
            toggle: tail & 0x20 != 0,
            transfer: tail & 0x1F,
        };
        Some((tail, payload))
    }

    /// The language of a first frame, which its toggle bit tells.
    pub const fn generation(self) -> Generation {
        if self.toggle { Generation::Cyphal } else { Generation::DroneCan }
    }
}

/// The toggle bit of a first frame.
pub const fn first_toggle(generation: Generation) -> bool {
    matches!(generation, Generation::Cyphal)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(id: u32, generation: Generation) -> Option<Header> {
        Header::of(Id::extended_truncated(id), generation)
    }

    /// The examples of both specifications' tables.
    #[test]
    fn identifiers_have_their_parts() {
        let status = header(0x1001_550A, Generation::DroneCan).unwrap();
        assert_eq!((status.priority, status.port, status.source), (16, 341, Some(10)));
        let asked = header(0x1E0B_8AFF, Generation::DroneCan).unwrap();
        assert_eq!((asked.purpose, asked.port), (Purpose::Request, 11));
        assert_eq!((asked.source, asked.destination), (Some(127), Some(10)));
        let anonymous = header(0x1EAB_CD00 & !0xFF | 0x100, Generation::DroneCan).unwrap();
        assert_eq!((anonymous.port, anonymous.source), (1, None));
        assert_eq!(header(0x1E0B_8A80, Generation::DroneCan), None);
        let beat = header(0x107D_552A, Generation::Cyphal).unwrap();
        assert_eq!((beat.priority, beat.port, beat.source), (4, 7509, Some(42)));
        // The specification's example of a request: service 430 (GetInfo), from 123 to 42.
        let info = header(0x136B_957B, Generation::Cyphal).unwrap();
        assert_eq!((info.purpose, info.port), (Purpose::Request, 430));
        assert_eq!((info.source, info.destination), (Some(123), Some(42)));
        assert_eq!(header(0x10FD_552A, Generation::Cyphal), None);
    }
}
