//! Linux's CAN frames as packets of a capture: directly (link type 227), or after the header of a capture of the "any"
//! interface (113 and 276, `tcpdump -i any`).

use cantap_can::{Frame, Id};
use cantap_trace::counted;
use serde::{Deserialize, Serialize};

use super::error_frames::ErrorFrames;
use super::issue::Fault;
use cantap_trace::fd::{FLAG_BRS, FLAG_ESI, FLAG_FDF};
use cantap_trace::socketcan::ERROR_FLAG;
use cantap_trace::{Direction, FdFrame, TraceEvent};

/// SocketCAN's link type.
pub(crate) const LINK_TYPE: u16 = 227;

// Flags in an identifier.
pub(crate) const EXTENDED: u32 = 1 << 31;
pub(crate) const REMOTE: u32 = 1 << 30;

/// Length of a classical packet: identifier, length, two bytes for CAN FD, the raw DLC, data.
pub(crate) const PACKET_BYTES: usize = 16;
/// Length of a CAN FD packet: the byte after the length has its flags.
pub(crate) const FD_PACKET_BYTES: usize = 8 + 64;

/// What precedes a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Link {
    /// Nothing: the identifier is in network byte order.
    SocketCan,
    /// The header of a capture of the "any" interface, whose frames are as the computer had them: in the file's byte
    /// order.
    Cooked { big_endian: bool },
    /// Its second version, which names the interface.
    Cooked2 { big_endian: bool },
}

/// The content of a packet.
pub(crate) enum Packet {
    /// One event, or two at the same time.
    Events(TraceEvent, Option<TraceEvent>),
    /// Something that is not a classical or FD CAN frame.
    LeftOut(&'static str),
}

/// Reads packets, and keeps what remains to be reported of them.
#[derive(Default)]
pub(crate) struct Packets {
    pub errors: ErrorFrames,
    /// Whether bytes that should be zero were found not to be: then none of them has a meaning.
    pub dirty: bool,
}

/// What the link says about its frame.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Says {
    Nothing,
    Classic,
    Fd,
}

impl Link {
    /// The link for a capture's link type.
    pub(crate) fn of(number: u32, big_endian: bool) -> Option<Self> {
        const COOKED: u32 = 113;
        const COOKED_2: u32 = 276;
        match number {
            COOKED => Some(Self::Cooked { big_endian }),
            COOKED_2 => Some(Self::Cooked2 { big_endian }),
            _ if number == u32::from(LINK_TYPE) => Some(Self::SocketCan),
            _ => None,
        }
    }

    /// The number of the interface, if the packet has it.
    pub(crate) fn interface(self, packet: &[u8]) -> Option<u32> {
        let Self::Cooked2 { .. } = self else { return None };
        packet.get(4..8)?.first_chunk().map(|bytes| u32::from_be_bytes(*bytes))
    }
}

fn short(packet: &[u8]) -> Fault {
    let found = counted(packet.len(), "byte");
    Fault::malformed("a SocketCAN packet of at least 8 bytes", found.as_bytes())
}

impl Packets {
    /// The content of a packet. `direction`: according to the capture.
    #[inline]
    pub(crate) fn read(
        &mut self,
        link: Link,
        packet: &[u8],
        direction: Option<Direction>,
    ) -> Result<Packet, Fault> {
        match link {
            Link::SocketCan => self.frame(packet, true, Says::Nothing, direction.unwrap_or_default()),
            Link::Cooked { big_endian } | Link::Cooked2 { big_endian } => {
                self.cooked(link, big_endian, packet, direction)
            }
        }
    }

    fn cooked(
        &mut self,
        link: Link,
        big_endian: bool,
        packet: &[u8],
        direction: Option<Direction>,
    ) -> Result<Packet, Fault> {
        const OUTGOING: u16 = 4;
        let word = |at: usize| {
            let bytes = packet.get(at..).and_then(|rest| rest.first_chunk());
            bytes.map(|bytes| u16::from_be_bytes(*bytes))
        };
        let (kind, protocol, header) = match link {
            Link::Cooked2 { .. } => (packet.get(10).map(|kind| u16::from(*kind)), word(0), 20),
            _ => (word(0), word(14), 16),
        };
        let (Some(kind), Some(protocol), Some(frame)) = (kind, protocol, packet.get(header..)) else {
            return Err(short(packet));
        };
        let says = match protocol {
            0x000C => Says::Classic,
            0x000D => Says::Fd,
            0x000E => return Ok(Packet::LeftOut("CAN XL frames")),
            _ => return Ok(Packet::LeftOut("packets of other protocols than CAN")),
        };
        let sent = if kind == OUTGOING { Direction::Tx } else { Direction::Rx };
        self.frame(frame, big_endian, says, direction.unwrap_or(sent))
    }

    /// A frame, without what preceded it.
    #[inline]
    fn frame(
        &mut self,
        packet: &[u8],
        big_endian: bool,
        says: Says,
        direction: Direction,
    ) -> Result<Packet, Fault> {
        const XL_FORMAT: u8 = 0x80;
        let [a, b, c, d, len, flags, padding, raw_dlc, data @ ..] = packet else { return Err(short(packet)) };
        let (len, flags, raw_dlc) = (*len, *flags, *raw_dlc);
        if len & XL_FORMAT != 0 && says == Says::Nothing {
            return Ok(Packet::LeftOut("CAN XL frames"));
        }
        let id = [*a, *b, *c, *d];
        let id = if big_endian { u32::from_be_bytes(id) } else { u32::from_le_bytes(id) };
        // Some captures have arbitrary bytes between the length and the data, so a flag there does not make an FD frame if the
        // length of the packet decides.
        let is_fd = match (says, packet.len()) {
            (Says::Fd, _) => true,
            (Says::Classic, _) => false,
            _ if len > 8 => true,
            (Says::Nothing, FD_PACKET_BYTES) => true,
            // A classical frame is padded to eight bytes, but nobody pads eight.
            (Says::Nothing, PACKET_BYTES) if len < 8 || self.dirty => false,
            (Says::Nothing, _) => {
                let known = FLAG_BRS | FLAG_ESI | FLAG_FDF;
                flags & FLAG_FDF != 0 && flags & !known == 0 && *padding == 0 && raw_dlc == 0
            }
        };
        if is_fd {
            let event = flexible(id, len, flags, data, direction)?;
            return Ok(Packet::Events(event, None));
        }
        self.dirty |= flags != 0 || *padding != 0 || raw_dlc > 15 || raw_dlc != 0 && len != 8;
        self.classic(id, len, raw_dlc, data, direction)
    }

    #[inline]
    fn classic(
        &mut self,
        id: u32,
        len: u8,
        raw_dlc: u8,
        bytes: &[u8],
        direction: Direction,
    ) -> Result<Packet, Fault> {
        let mut data = [0; 8];
        let present = bytes.len().min(usize::from(len)).min(8);
        data[..present].copy_from_slice(&bytes[..present]);
        if id & ERROR_FLAG != 0 {
            let (event, second) = self.errors.read(id, data);
            return Ok(Packet::Events(event, second));
        }
        let remote = id & REMOTE != 0;
        if present < usize::from(len) && !remote || len > 8 {
            return Err(Fault::malformed(format!("{len} data bytes"), format!("{present}").as_bytes()));
        }
        let is_raw = len == 8 && (9..=15).contains(&raw_dlc) && !self.dirty;
        let dlc = if is_raw { raw_dlc } else { len };
        let frame = Frame::from_bus(identifier(id)?, remote, dlc, data);
        Ok(Packet::Events(TraceEvent::Frame { frame: frame.into(), direction, late: false }, None))
    }
}

/// An identifier without its flags.
fn identifier(id: u32) -> Result<Id, Fault> {
    let raw = id & !(EXTENDED | REMOTE);
    let parsed = if id & EXTENDED != 0 { Id::extended(raw) } else { Id::standard(raw) };
    parsed.ok_or_else(|| Fault::malformed("an identifier up to 0x7ff", format!("{raw:#x}").as_bytes()))
}

/// A CAN FD frame.
fn flexible(id: u32, len: u8, flags: u8, bytes: &[u8], direction: Direction) -> Result<TraceEvent, Fault> {
    let present = bytes.len();
    let data = bytes
        .get(..usize::from(len))
        .ok_or_else(|| Fault::malformed(format!("{len} data bytes"), present.to_string().as_bytes()))?;
    let frame = FdFrame::new(identifier(id)?, flags & FLAG_BRS != 0, flags & FLAG_ESI != 0, data);
    let frame =
        frame.ok_or_else(|| Fault::malformed("a length that CAN FD has", counted(len, "byte").as_bytes()))?;
    Ok(TraceEvent::Frame { frame: frame.into(), direction, late: false })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(packets: &mut Packets, bytes: &[u8]) -> String {
        match packets.read(Link::SocketCan, bytes, None).unwrap() {
            Packet::Events(TraceEvent::Frame { frame, .. }, None) => frame.to_string(),
            _ => "no frame".to_owned(),
        }
    }

    /// From public captures: the bytes after the length are old memory contents.
    #[test]
    fn dirty_padding_makes_no_fd_frame_and_no_long_code() {
        let mut packets = Packets::default();
        let dirty = [0x8D, 0xFF, 0x18, 0x2B, 8, 0x2D, 0x92, 4, 1, 2, 3, 4, 5, 6, 7, 8];
        assert_eq!(read(&mut packets, &dirty), "0DFF182B#0102030405060708");
        let code = [0x8D, 0xFF, 0x18, 0x2B, 8, 0, 0, 12, 1, 2, 3, 4, 5, 6, 7, 8];
        assert_eq!(read(&mut packets, &code), "0DFF182B#0102030405060708");
        // In a clean capture it is a length code.
        assert_eq!(read(&mut Packets::default(), &code), "0DFF182B#0102030405060708_C");
    }

    #[test]
    fn fd_is_what_the_length_says_and_the_flag_only_where_that_says_nothing() {
        let mut packets = Packets::default();
        let mut long = vec![0, 0, 1, 0x23, 2, 0, 0, 0, 0xAB, 0xCD];
        assert_eq!(read(&mut packets, &long), "123#ABCD");
        long[5] = FLAG_FDF | FLAG_BRS;
        assert_eq!(read(&mut packets, &long), "123##1ABCD");
        long.resize(FD_PACKET_BYTES, 0);
        assert_eq!(read(&mut packets, &long), "123##1ABCD");
        long[5] = 0;
        assert_eq!(read(&mut packets, &long), "123##0ABCD");
        long.truncate(PACKET_BYTES);
        long[5] = FLAG_FDF;
        assert_eq!(read(&mut packets, &long), "123#ABCD");
        long[4] = 8;
        assert_eq!(read(&mut packets, &long), "123#ABCD000000000000", "the flag before was none");
        let mut packets = Packets::default();
        assert_eq!(read(&mut packets, &long), "123##0ABCD000000000000", "nothing of it is padding");
        long[7] = 9;
        assert_eq!(read(&mut packets, &long), "123#ABCD000000000000", "nor a flag, where something else is");
        long[7] = 0;
        long[4] = 12;
        long.resize(8 + 12, 0);
        assert_eq!(read(&mut packets, &long), "123##0ABCD00000000000000000000");
    }
}
