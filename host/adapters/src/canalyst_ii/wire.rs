//! What crosses USB: packets of 64 bytes, with numbers that have the low byte first.

use cantap_wire::{Frame, Id};

/// Bytes of every packet.
pub(super) const PACKET: usize = 64;
/// Bytes of a message, and how many are in a packet behind their count.
const MESSAGE: usize = 21;
const MOST: usize = 3;

/// What the adapter is told and asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Command {
    /// Be set to this bit rate, by the registers of an SJA1000.
    Set { btr0: u8, btr1: u8 },
    /// Take part in the bus.
    Start,
    /// Leave the bus.
    Stop,
    /// Forget what was received.
    Clear,
    /// Say how much waits: see [`waiting`].
    Waiting,
}

impl Command {
    pub fn packet(self) -> [u8; PACKET] {
        let words: &[u32] = match self {
            // No filter; what the other ones mean is not known, and they are as python-can has them.
            Self::Set { btr0, btr1 } => &[1, 0, u32::MAX, 0, 1, 0, btr0.into(), btr1.into(), 0, 1],
            Self::Start => &[2],
            Self::Stop => &[3],
            Self::Clear => &[5],
            Self::Waiting => &[0x0A],
        };
        let mut packet = [0; PACKET];
        for (bytes, word) in packet.chunks_mut(4).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        packet
    }
}

/// Bit rates in bit/s with their registers, of which the adapter knows these.
const RATES: [(u32, u8, u8); 13] = [
    (10_000, 0x31, 0x1C),
    (20_000, 0x18, 0x1C),
    (40_000, 0x87, 0xFF),
    (50_000, 0x09, 0x1C),
    (80_000, 0x83, 0xFF),
    (100_000, 0x04, 0x1C),
    (125_000, 0x03, 0x1C),
    (200_000, 0x81, 0xFA),
    (250_000, 0x01, 0x1C),
    (400_000, 0x80, 0xFA),
    (500_000, 0x00, 0x1C),
    (800_000, 0x00, 0x16),
    (1_000_000, 0x00, 0x14),
];

/// What sets a bit rate, if the adapter has it.
pub(super) fn set(bitrate_bps: u32) -> Option<Command> {
    let (_, btr0, btr1) = RATES.into_iter().find(|(rate, ..)| *rate == bitrate_bps)?;
    Some(Command::Set { btr0, btr1 })
}

/// Messages that wait to be read, and to be sent; `None` if this is no such answer.
pub(super) fn waiting(answer: &[u8]) -> Option<(u32, u32)> {
    let (packet, []) = answer.split_first_chunk::<PACKET>()? else { return None };
    Some((word(packet, 4)?, word(packet, 8)?))
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

/// One message, or what should be one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Message {
    /// A frame, and when it was received in units of 100 µs, if that is said.
    Frame(Frame, Option<u32>),
    /// A length or an identifier that no frame has, a packet that is cut, or one that counts more than it holds.
    Damaged,
}

/// The messages of what was read, which is packets.
pub(super) fn messages(bytes: &[u8]) -> impl Iterator<Item = Message> {
    bytes.chunks(PACKET).flat_map(|packet| {
        let count = usize::from(packet[0]);
        let is_whole = packet.len() == PACKET && count <= MOST;
        let held = packet[1..].chunks_exact(MESSAGE).take(if is_whole { count } else { 0 }).map(message);
        held.chain((!is_whole).then_some(Message::Damaged))
    })
}

fn message(bytes: &[u8]) -> Message {
    read(bytes).unwrap_or(Message::Damaged)
}

fn read(bytes: &[u8]) -> Option<Message> {
    let (raw, stamp) = (word(bytes, 0)?, word(bytes, 4)?);
    let &[has_stamp, _, is_remote, is_extended, len] = bytes.get(8..13)? else { return None };
    let id = if is_extended != 0 { Id::extended(raw) } else { Id::standard(raw) }?;
    let data = bytes.get(13..MESSAGE)?.try_into().ok().filter(|_| len <= 8)?;
    Some(Message::Frame(Frame::from_bus(id, is_remote != 0, len, data), (has_stamp != 0).then_some(stamp)))
}

/// The packet that has it send a frame.
pub(super) fn frame(frame: &Frame) -> [u8; PACKET] {
    let mut packet = [0; PACKET];
    packet[0] = 1;
    packet[1..5].copy_from_slice(&frame.id().raw().to_le_bytes());
    packet[11] = u8::from(frame.is_remote());
    packet[12] = u8::from(frame.id().is_extended());
    packet[13] = frame.dlc().min(8);
    packet[14..14 + frame.data().len()].copy_from_slice(frame.data());
    packet
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_frame_is_read_as_it_is_written() {
        for text in ["123#DEAD", "1ABCDEF0#0102030405060708", "7FF#R5", "00000001#"] {
            let packet = frame(&text.parse().unwrap());
            let read: Vec<Message> = messages(&packet).collect();
            assert_eq!(read, [Message::Frame(text.parse().unwrap(), None)], "{text}");
        }
    }

    #[test]
    fn commands_are_those_of_the_python_driver() {
        let packet = set(500_000).unwrap().packet();
        let words: Vec<u32> =
            packet.chunks(4).map(|word| u32::from_le_bytes(word.try_into().unwrap())).collect();
        assert_eq!(words[..11], [1, 0, 0xFFFF_FFFF, 0, 1, 0, 0, 0x1C, 0, 1, 0]);
        assert_eq!(Command::Waiting.packet()[..5], [0x0A, 0, 0, 0, 0]);
        assert_eq!(set(83_333), None);
    }

    #[test]
    fn what_lies_about_its_count_its_length_or_its_identifier_is_damaged() {
        let good = frame(&"123#11".parse().unwrap());
        for (at, lie) in [(0, 4), (0, 255), (13, 9), (3, 1)] {
            let mut bad = good;
            bad[at] = lie;
            assert_eq!(messages(&bad).collect::<Vec<_>>(), [Message::Damaged], "{at}");
        }
        assert_eq!(messages(&good[..63]).collect::<Vec<_>>(), [Message::Damaged]);
        assert_eq!(messages(&[0; 128]).count(), 0);
        assert_eq!([&[0; 63][..], &[0; 65], &[]].map(waiting), [None; 3]);
    }

    proptest! {
        #[test]
        fn any_bytes_are_read(bytes: Vec<u8>) {
            prop_assert!(messages(&bytes).count() <= bytes.len().div_ceil(PACKET) * MOST);
        }
    }
}
