//! What crosses the line to such an adapter.
//!
//! A message of variable length is `AA`, a type `11ermmmm` (extended, remote, data length code), the identifier in two or four bytes and the data,
//! both with the low byte first, and `55`. A packet is `AA 55`, 17 bytes that begin with its kind, and their sum modulo 256.

use cantap_wire::{Frame, Id};

const START: u8 = 0xAA;
const END: u8 = 0x55;
/// Bytes of a packet.
const PACKET: usize = 20;
/// Bits of the type of a message.
const TYPE: u8 = 0xC0;
const EXTENDED: u8 = 1 << 5;
const REMOTE: u8 = 1 << 4;
/// Kinds of packets: a frame of fixed length, the state of the controller, settings for messages of variable length.
const FIXED_FRAME: u8 = 0x01;
const STATE: u8 = 0x04;
const SETTINGS: u8 = 0x12;

/// Bit rates in bit/s; the first is number 1.
const RATES: [u32; 12] =
    [1_000_000, 800_000, 500_000, 400_000, 250_000, 200_000, 125_000, 100_000, 50_000, 20_000, 10_000, 5_000];

/// What an adapter sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Message {
    /// A frame was received.
    Frame(Frame),
    /// The controller's error counters.
    State { transmit: u8, receive: u8 },
    /// A frame as an adapter sends it that is set to packets of fixed length: it has not taken its settings.
    FixedFrame,
    /// Settings. An adapter sends none: something returns what it is sent.
    Settings,
    /// A packet of another kind.
    Other,
    /// A byte that belongs to none of these.
    Garbage,
}

/// How an adapter takes part in its bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Settings {
    /// The number of the bit rate, from 1.
    pub rate: u8,
    /// Frames with extended identifiers are received, instead of those with standard ones.
    pub extended: bool,
    /// It acknowledges nothing.
    pub silent: bool,
}

/// The number of a bit rate, if it has one.
pub(super) fn rate(bitrate_bps: u32) -> Option<u8> {
    RATES.iter().zip(1..).find_map(|(rate, number)| (*rate == bitrate_bps).then_some(number))
}

/// The packet that sets an adapter: no filter, and frames that were not acknowledged are repeated, as CAN has it.
pub(super) fn settings(settings: Settings) -> [u8; PACKET] {
    let Settings { rate, extended, silent } = settings;
    let ids = if extended { 2 } else { 1 };
    let mode = if silent { 2 } else { 0 };
    packet([SETTINGS, rate, ids, 0, 0, 0, 0, 0, 0, 0, 0, mode, 0, 0, 0, 0, 0])
}

/// The packet that asks for [`Message::State`].
pub(super) fn ask_state() -> [u8; PACKET] {
    let mut content = [0; PACKET - 3];
    content[0] = STATE;
    packet(content)
}

fn packet(content: [u8; PACKET - 3]) -> [u8; PACKET] {
    let mut bytes = [0; PACKET];
    (bytes[0], bytes[1]) = (START, END);
    bytes[2..PACKET - 1].copy_from_slice(&content);
    bytes[PACKET - 1] = sum(&content);
    bytes
}

fn sum(content: &[u8]) -> u8 {
    content.iter().fold(0, |sum, byte| sum.wrapping_add(*byte))
}

/// The message that has it send a frame.
pub(super) fn frame(frame: &Frame) -> Vec<u8> {
    let (id, dlc) = (frame.id(), frame.dlc().min(8));
    let mut kind = TYPE | dlc;
    kind |= if id.is_extended() { EXTENDED } else { 0 } | if frame.is_remote() { REMOTE } else { 0 };
    let id_bytes = id.raw().to_le_bytes();
    let id_len = if id.is_extended() { 4 } else { 2 };
    [&[START, kind][..], &id_bytes[..id_len], frame.data(), &[END]].concat()
}

/// The first message of these bytes and its length; `None` if its end has not arrived.
pub(super) fn message(bytes: &[u8]) -> Option<(Message, usize)> {
    const NOTHING: Option<(Message, usize)> = Some((Message::Garbage, 1));
    let [START, rest @ ..] = bytes else { return bytes.first().and(NOTHING) };
    let kind = *rest.first()?;
    if kind == END {
        let packet = bytes.get(..PACKET)?;
        let content = &packet[2..PACKET - 1];
        return if sum(content) == packet[PACKET - 1] { Some((meaning(content), PACKET)) } else { NOTHING };
    }
    let (is_remote, is_extended, dlc) = (kind & REMOTE != 0, kind & EXTENDED != 0, kind & 15);
    if kind & TYPE != TYPE || dlc > 8 {
        return NOTHING;
    }
    let id_end = if is_extended { 6 } else { 4 };
    let raw = bytes.get(2..id_end)?.iter().rev().fold(0, |id, byte| id << 8 | u32::from(*byte));
    let Some(id) = (if is_extended { Id::extended(raw) } else { Id::standard(raw) }) else { return NOTHING };
    // Whether a remote frame has room for the data that it does not have, its maker does not say.
    let is_short = is_remote && *bytes.get(id_end)? == END;
    let data_end = if is_short { id_end } else { id_end + usize::from(dlc) };
    if *bytes.get(data_end)? != END || bytes.get(data_end + 1).is_some_and(|next| *next != START) {
        return NOTHING;
    }
    let mut data = [0; 8];
    if !is_remote {
        data[..usize::from(dlc)].copy_from_slice(&bytes[id_end..data_end]);
    }
    Some((Message::Frame(Frame::from_bus(id, is_remote, dlc, data)), data_end + 1))
}

fn meaning(content: &[u8]) -> Message {
    match *content {
        [STATE, receive, transmit, ..] => Message::State { transmit, receive },
        [FIXED_FRAME, ..] => Message::FixedFrame,
        [SETTINGS, ..] => Message::Settings,
        _ => Message::Other,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn read(bytes: &[u8]) -> Option<(Message, usize)> {
        message(bytes)
    }

    fn frame_of(text: &str) -> Message {
        Message::Frame(text.parse().unwrap())
    }

    /// The examples of the maker's page ("Secondary Development Serial Conversion Definition of CAN Protocol").
    #[test]
    fn frames_are_written_and_read_as_the_maker_s_examples() {
        for (text, bytes) in [
            ("123#1122334455667788", &b"\xAA\xC8\x23\x01\x11\x22\x33\x44\x55\x66\x77\x88\x55"[..]),
            ("103#1122", b"\xAA\xC2\x03\x01\x11\x22\x55"),
            ("01234567#1122334455667788", b"\xAA\xE8\x67\x45\x23\x01\x11\x22\x33\x44\x55\x66\x77\x88\x55"),
            ("123#R4", b"\xAA\xD4\x23\x01\x55"),
        ] {
            assert_eq!(frame(&text.parse().unwrap()), bytes, "{text}");
            assert_eq!(read(bytes), Some((frame_of(text), bytes.len())), "{text}");
            for len in 0..bytes.len() {
                assert_eq!(read(&bytes[..len]), None, "{text}");
            }
        }
        // With room for its data.
        assert_eq!(read(b"\xAA\xD2\x23\x01\0\0\x55"), Some((frame_of("123#R2"), 7)));
    }

    #[test]
    fn what_lies_about_its_length_its_identifier_or_its_sum_is_no_message() {
        for bytes in [
            &b"\x55"[..],
            b"\xAA\x00",
            b"\xAA\x88",
            // Nine bytes.
            b"\xAA\xC9\x23\x01",
            // An identifier of twelve bits, and one of thirty.
            b"\xAA\xC0\x00\x08\x55",
            b"\xAA\xE0\x00\x00\x00\x20\x55",
            // No end, and one behind which nothing begins.
            b"\xAA\xC1\x23\x01\x11\x54",
            b"\xAA\xC1\x23\x01\x11\x55\x22",
            b"\xAA\x55\x04\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x05",
        ] {
            assert_eq!(read(bytes), Some((Message::Garbage, 1)), "{bytes:X?}");
        }
    }

    #[test]
    fn packets_are_known_by_their_kind() {
        let set = Settings { rate: rate(500_000).unwrap(), extended: false, silent: true };
        let bytes = settings(set);
        // python-can's `silent` at 500 kbit/s, but for the byte of frames that are sent once.
        assert_eq!(bytes, *b"\xAA\x55\x12\x03\x01\0\0\0\0\0\0\0\0\x02\0\0\0\0\0\x18");
        assert_eq!(read(&bytes), Some((Message::Settings, 20)));
        let mut state = ask_state();
        (state[3], state[4], state[19]) = (7, 200, 211);
        assert_eq!(read(&state), Some((Message::State { receive: 7, transmit: 200 }, 20)));
        assert_eq!([1_000_000, 5_000, 83_333].map(rate), [Some(1), Some(12), None]);
    }

    proptest! {
        /// Whatever arrives is read without a panic, goes on, and holds up no more than one packet.
        #[test]
        fn any_bytes_are_read(mut bytes in proptest::collection::vec(prop_oneof![Just(START), Just(END), Just(0xC8), any::<u8>()], 0..200)) {
            while let Some((_, len)) = message(&bytes) {
                prop_assert!(len > 0 && len <= bytes.len());
                bytes.drain(..len);
            }
            prop_assert!(bytes.len() < PACKET);
        }
    }
}
