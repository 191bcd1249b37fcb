//! GVRET: the binary protocol of ESP32RET, M2RET and Macchina's boards, on a serial port or TCP port 23.
//!
//! As ESP32RET reads and writes it (`src/gvret_comm.h`, `src/commbuffer.h`), and SavvyCAN at the other end (`connections/gvretserial.cpp`).
//! It knows neither remote frames nor errors nor losses. The byte for a checksum is 0 (ESP32RET, M2RET, GVRET), and clients
//! do not look at it; here a frame with another byte there is none, since bytes before it were lost.

use cantap_can::{FdFrame, Frame, Id};

/// The TCP port that the adapters listen on, and the only one that SavvyCAN connects to.
pub const PORT: u16 = 23;
/// Begins every command and every message.
pub const START: u8 = 0xF1;
/// Sent, usually twice, by a client before its first command: the adapter leaves its text console.
pub const BINARY: u8 = 0xE7;

const FRAME: u8 = 0;
const TIME: u8 = 1;
const DIGITAL_INPUTS: u8 = 2;
const ANALOG_INPUTS: u8 = 3;
const SET_OUTPUTS: u8 = 4;
const SET_BUSES: u8 = 5;
const GET_BUSES: u8 = 6;
const GET_INFO: u8 = 7;
const SET_SINGLE_WIRE: u8 = 8;
const KEEP_ALIVE: u8 = 9;
const SET_SYSTEM: u8 = 10;
const ECHO_FRAME: u8 = 11;
const GET_NUMBER: u8 = 12;
const GET_FURTHER_BUSES: u8 = 13;
const SET_FURTHER_BUSES: u8 = 14;
const FD_FRAME: u8 = 20;

/// What an adapter answers to [`Command::KeepAlive`].
const ALIVE: [u8; 2] = [0xDE, 0xAD];
/// Bytes that describe a third and further buses.
const FURTHER_BYTES: usize = 15;
/// Longest data of a CAN FD frame.
const MAX_FD_LEN: usize = 64;

/// Bits of a bus's setting: the others are valid, it is on, it only listens; below them, the bit rate.
const SET_STATE: u32 = 1 << 31;
const ENABLED: u32 = 1 << 30;
const LISTENS: u32 = 1 << 29;
const BITRATE: u32 = 0xF_FFFF;

const EXTENDED: u32 = 1 << 31;

/// One of an adapter's first two buses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bus {
    /// It takes part in its bus.
    pub is_on: bool,
    /// It does not acknowledge.
    pub only_listens: bool,
    /// In bit/s, up to 1 Mbit/s.
    pub bitrate_bps: u32,
}

/// What an adapter sends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Message {
    /// A frame was received.
    Frame {
        /// When, in microseconds, modulo 2³².
        stamp_us: u32,
        /// The bus, from 0 to 15.
        bus: u8,
        /// The frame, which is no remote frame.
        frame: Frame,
    },
    /// A frame was received on a bus with CAN FD. ESP32RET says so of all frames there, classical ones too, and nothing tells them apart.
    Fd {
        /// When, in microseconds, modulo 2³².
        stamp_us: u32,
        /// The bus, from 0.
        bus: u8,
        /// The frame, without its flags, which the message has no place for: they are as if the bit rate was not switched. `None` if its identifier or its
        /// length cannot be.
        frame: Option<FdFrame>,
    },
    /// The time of the stamps, in microseconds.
    Time(u32),
    /// The first two buses.
    Buses([Bus; 2]),
    /// What the adapter is.
    Info {
        /// Its firmware's build number.
        build: u16,
    },
    /// It is there.
    Alive,
    /// The number of its buses.
    Number(u8),
    /// Something about inputs, or a third bus.
    Other,
    /// Bytes that are no message.
    Garbage,
}

/// What a client sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// The binary protocol begins.
    Binary,
    /// Send a frame.
    Frame {
        /// The bus, from 0.
        bus: u8,
        /// The frame.
        frame: Frame,
    },
    /// Send a CAN FD frame. There are no flags: they are as if the bit rate was switched. ESP32RET has no such command, so it is never written.
    Fd {
        /// The bus, from 0.
        bus: u8,
        /// The frame.
        frame: FdFrame,
    },
    /// Send a frame that is none: its identifier is too large, or no frame has so many bytes.
    NoFrame {
        /// The bus, from 0.
        bus: u8,
    },
    /// Ask for [`Message::Time`].
    Time,
    /// Set the first two buses. `None` leaves open whether it acknowledges.
    SetBuses([(Bus, Option<bool>); 2]),
    /// Ask for [`Message::Buses`].
    GetBuses,
    /// Ask for [`Message::Info`].
    GetInfo,
    /// Ask for [`Message::Alive`].
    KeepAlive,
    /// Ask for [`Message::Number`].
    GetNumber,
    /// Ask for the third and further buses, to which [`Message::Other`] is the answer.
    GetFurtherBuses,
    /// One about something that is not a CAN bus, by its number.
    Other(u8),
    /// A zero, which is skipped: SavvyCAN sends one behind the settings of buses.
    Padding,
    /// Bytes that are no command.
    Garbage,
}

/// The first message in the bytes, and its length, which is at least 1; `None` if it is not complete.
pub fn message(bytes: &[u8]) -> Option<(Message, usize)> {
    let (&start, rest) = bytes.split_first()?;
    if start != START {
        let len = bytes.iter().position(|byte| *byte == START).unwrap_or(bytes.len());
        return Some((Message::Garbage, len));
    }
    let (&kind, content) = rest.split_first()?;
    Some(match kind {
        FRAME => {
            let (stamp_us, raw) = (u32_at(content, 0)?, u32_at(content, 4)?);
            let lengths = *content.get(8)?;
            let (len, bus) = (usize::from(lengths & 0xF), lengths >> 4);
            // A length that no frame has, or an impossible identifier: the start was data.
            let Some(id) = id_of(raw).filter(|_| len <= 8) else { return Some((Message::Garbage, 1)) };
            let data = content.get(9..9 + len)?;
            if !is_end(bytes, 2 + 9 + len)? {
                return Some((Message::Garbage, 1));
            }
            let frame = Frame::data_frame(id, data)?;
            (Message::Frame { stamp_us, bus, frame }, 2 + 9 + len + 1)
        }
        FD_FRAME => {
            let (stamp_us, raw) = (u32_at(content, 0)?, u32_at(content, 4)?);
            let (len, bus) = (usize::from(*content.get(8)?), *content.get(9)?);
            if len > MAX_FD_LEN {
                return Some((Message::Garbage, 1));
            }
            let data = content.get(10..10 + len)?;
            if !is_end(bytes, 2 + 10 + len)? {
                return Some((Message::Garbage, 1));
            }
            let frame = id_of(raw).and_then(|id| FdFrame::new(id, false, false, data));
            (Message::Fd { stamp_us, bus, frame }, 2 + 10 + len + 1)
        }
        TIME => (Message::Time(u32_at(content, 0)?), 2 + 4),
        GET_BUSES => {
            let bus = |at: usize| {
                let state = *content.get(at)?;
                let bitrate_bps = u32_at(content, at + 1)?;
                Some(Bus { is_on: state & 0xF != 0, only_listens: state >> 4 != 0, bitrate_bps })
            };
            (Message::Buses([bus(0)?, bus(5)?]), 2 + 10)
        }
        GET_INFO => {
            content.get(5)?;
            let build = u16::from_le_bytes(*content.first_chunk()?);
            (Message::Info { build }, 2 + 6)
        }
        KEEP_ALIVE => match *content.first_chunk::<2>()? {
            ALIVE => (Message::Alive, 2 + ALIVE.len()),
            _ => (Message::Garbage, 1),
        },
        GET_NUMBER => (Message::Number(*content.first()?), 2 + 1),
        DIGITAL_INPUTS | ANALOG_INPUTS | GET_FURTHER_BUSES => {
            let len = if kind == DIGITAL_INPUTS { 2 } else { FURTHER_BYTES };
            content.get(len - 1)?;
            (Message::Other, 2 + len)
        }
        _ => (Message::Garbage, 1),
    })
}

/// Whether the byte at `at` ends a frame: 0, or what the firmware's own `checksumCalc`, which it does not use, would make of the bytes before it. If
/// another message may have begun in between, one begins after it, too, or nothing is there yet: otherwise this is the beginning of one and the
/// end of another.
fn is_end(bytes: &[u8], at: usize) -> Option<bool> {
    let (before, after) = bytes.split_at_checked(at)?;
    let last = *after.first()?;
    let has_start = before.iter().skip(1).any(|byte| *byte == START);
    let goes_on_otherwise = after.get(1).is_some_and(|byte| *byte != START);
    Some(
        (last == 0 || last == before.iter().fold(0, |sum, byte| sum ^ byte))
            && !(has_start && goes_on_otherwise),
    )
}

impl Message {
    /// Adds it to the bytes for a client. [`Message::Other`] is the answer to [`Command::GetFurtherBuses`]: there are none. What cannot be said,
    /// a CAN FD frame or [`Message::Garbage`], adds nothing.
    pub fn put(&self, out: &mut Vec<u8>) {
        match self {
            Self::Frame { stamp_us, bus, frame } => {
                out.extend_from_slice(&[START, FRAME]);
                out.extend_from_slice(&stamp_us.to_le_bytes());
                out.extend_from_slice(&raw(frame.id()).to_le_bytes());
                out.push(frame.data().len() as u8 | bus << 4);
                out.extend_from_slice(frame.data());
                out.push(0);
            }
            Self::Time(stamp_us) => {
                out.extend_from_slice(&[START, TIME]);
                out.extend_from_slice(&stamp_us.to_le_bytes());
            }
            Self::Buses(buses) => {
                out.extend_from_slice(&[START, GET_BUSES]);
                for bus in buses {
                    out.push(u8::from(bus.is_on) | u8::from(bus.only_listens) << 4);
                    out.extend_from_slice(&bus.bitrate_bps.to_le_bytes());
                }
            }
            Self::Info { build } => {
                let [low, high] = build.to_le_bytes();
                // Versions of a memory and of log files, automatic logging, single wire mode: there are none.
                out.extend_from_slice(&[START, GET_INFO, low, high, 0x20, 0, 0, 0]);
            }
            Self::Alive => out.extend_from_slice(&[START, KEEP_ALIVE, ALIVE[0], ALIVE[1]]),
            Self::Number(number) => out.extend_from_slice(&[START, GET_NUMBER, *number]),
            Self::Other => {
                out.extend_from_slice(&[START, GET_FURTHER_BUSES]);
                out.extend_from_slice(&[0; FURTHER_BYTES]);
            }
            Self::Fd { .. } | Self::Garbage => {}
        }
    }
}

/// The first command in the bytes, and its length, which is at least 1; `None` if it is not complete.
pub fn command(bytes: &[u8]) -> Option<(Command, usize)> {
    let (&start, rest) = bytes.split_first()?;
    match start {
        START => {}
        BINARY => return Some((Command::Binary, 1)),
        0 => return Some((Command::Padding, 1)),
        _ => return Some((Command::Garbage, 1)),
    }
    let (&kind, content) = rest.split_first()?;
    let of_len = |len: usize| content.get(..len).map(|_| (Command::Other(kind), 2 + len));
    Some(match kind {
        // SavvyCAN has the same command for longer frames; GEVCU7 reads one of its own, with the same content.
        FRAME | ECHO_FRAME | FD_FRAME => {
            let (raw, bus, len) = (u32_at(content, 0)?, *content.get(4)?, usize::from(*content.get(5)?));
            if len > MAX_FD_LEN {
                return Some((Command::Garbage, 1));
            }
            let data = content.get(6..6 + len)?;
            content.get(6 + len)?;
            let id = id_of(raw).filter(|_| kind != FD_FRAME);
            let frame = id.and_then(|id| Frame::data_frame(id, data));
            let fd = || id_of(raw).and_then(|id| FdFrame::new(id, true, false, data));
            let command = match frame {
                _ if kind == ECHO_FRAME => Command::Other(kind),
                Some(frame) => Command::Frame { bus, frame },
                None => fd().map_or(Command::NoFrame { bus }, |frame| Command::Fd { bus, frame }),
            };
            (command, 2 + 6 + len + 1)
        }
        TIME => (Command::Time, 2),
        SET_BUSES => {
            let bus = |at: usize| u32_at(content, at).map(setting);
            (Command::SetBuses([bus(0)?, bus(4)?]), 2 + 8)
        }
        GET_BUSES => (Command::GetBuses, 2),
        GET_INFO => (Command::GetInfo, 2),
        KEEP_ALIVE => (Command::KeepAlive, 2),
        GET_NUMBER => (Command::GetNumber, 2),
        GET_FURTHER_BUSES => (Command::GetFurtherBuses, 2),
        DIGITAL_INPUTS | ANALOG_INPUTS => of_len(0)?,
        SET_OUTPUTS | SET_SINGLE_WIRE | SET_SYSTEM => of_len(1)?,
        SET_FURTHER_BUSES => of_len(12)?,
        _ => (Command::Garbage, 1),
    })
}

impl Command {
    /// Adds it to the bytes for an adapter. What cannot be said adds nothing.
    pub fn put(&self, out: &mut Vec<u8>) {
        let kind = match self {
            Self::Binary => return out.push(BINARY),
            Self::Padding => return out.push(0),
            Self::Fd { .. } | Self::NoFrame { .. } | Self::Other(_) | Self::Garbage => return,
            Self::Frame { .. } => FRAME,
            Self::Time => TIME,
            Self::SetBuses(_) => SET_BUSES,
            Self::GetBuses => GET_BUSES,
            Self::GetInfo => GET_INFO,
            Self::KeepAlive => KEEP_ALIVE,
            Self::GetNumber => GET_NUMBER,
            Self::GetFurtherBuses => GET_FURTHER_BUSES,
        };
        out.extend_from_slice(&[START, kind]);
        match self {
            Self::Frame { bus, frame } => {
                out.extend_from_slice(&raw(frame.id()).to_le_bytes());
                out.extend_from_slice(&[*bus, frame.data().len() as u8]);
                out.extend_from_slice(frame.data());
                out.push(0);
            }
            Self::SetBuses(buses) => {
                for (bus, only_listens) in buses {
                    let state = only_listens.map_or(0, |listens| {
                        SET_STATE | if bus.is_on { ENABLED } else { 0 } | if listens { LISTENS } else { 0 }
                    });
                    out.extend_from_slice(&(state | bus.bitrate_bps & BITRATE).to_le_bytes());
                }
            }
            _ => {}
        }
    }
}

/// How a bus is to be set, and whether it is to acknowledge, if that is said.
const fn setting(raw: u32) -> (Bus, Option<bool>) {
    let says_state = raw & SET_STATE != 0;
    let only_listens = raw & LISTENS != 0;
    let bus = Bus {
        // Without the state, a bit rate switches it on.
        is_on: if says_state { raw & ENABLED != 0 } else { raw != 0 },
        only_listens: says_state && only_listens,
        bitrate_bps: raw & BITRATE,
    };
    (bus, if says_state { Some(only_listens) } else { None })
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().map(|bytes| u32::from_le_bytes(*bytes))
}

fn id_of(raw: u32) -> Option<Id> {
    if raw & EXTENDED != 0 { Id::extended(raw & !EXTENDED) } else { Id::standard(raw) }
}

const fn raw(id: Id) -> u32 {
    id.raw() | if id.is_extended() { EXTENDED } else { 0 }
}

#[cfg(test)]
mod tests {
    use super::Command::{Binary, GetBuses, GetInfo, GetNumber, KeepAlive, Time};
    use super::*;

    proptest::proptest! {
        #[test]
        fn whatever_arrives_is_used_up_or_waited_for(bytes: Vec<u8>) {
            if let Some((_, len)) = message(&bytes) {
                proptest::prop_assert!((1..=bytes.len()).contains(&len));
            } else {
                // No message is longer than a CAN FD frame.
                proptest::prop_assert!(bytes.len() < 80);
            }
            if let Some((_, len)) = command(&bytes) {
                proptest::prop_assert!((1..=bytes.len()).contains(&len));
            } else {
                proptest::prop_assert!(bytes.len() < 80);
            }
        }
    }

    #[test]
    fn a_frame_in_data_that_lies_about_its_length_is_not_one() {
        // A length nibble of 15.
        let lie = [START, FRAME, 1, 0, 0, 0, 0x23, 1, 0, 0, 0x0F, 0, 0, 0, 0, 0, 0, 0, 0];
        assert_eq!(message(&lie), Some((Message::Garbage, 1)));
        let whole = [START, FRAME, 4, 3, 2, 1, 0x23, 1, 0, 0, 0x12, 0xAA, 0xBB, 0];
        let frame = "123#AABB".parse().unwrap();
        let read = Message::Frame { stamp_us: 0x0102_0304, bus: 1, frame };
        assert_eq!(message(&whole), Some((read.clone(), 14)));
        for cut in 0..whole.len() {
            assert_eq!(message(&whole[..cut]), None, "{cut}");
        }
        let mut written = Vec::new();
        read.put(&mut written);
        assert_eq!(written, whole);
    }

    /// As ESP32RET writes it (`CommBuffer::sendFrameToBuffer` for `CAN_FRAME_FD`): the length before the bus, each in a byte of its own.
    #[test]
    fn a_frame_of_a_bus_with_can_fd_is_read_and_one_that_cannot_be_is_none() {
        let with = |raw: u32, len: u8| {
            let head = [&[START, FD_FRAME, 4, 3, 2, 1][..], &raw.to_le_bytes(), &[len, 3]].concat();
            [head, (1..=len).collect(), vec![0]].concat()
        };
        for (raw, len, text) in [
            (0x98DA_F110, 12, Some("18DAF110##00102030405060708090A0B0C")),
            (0x123, 0, Some("123##0")),
            (0x123, 9, None),
            (0x800, 1, None),
        ] {
            let bytes = with(raw, len);
            let Some((Message::Fd { stamp_us: 0x0102_0304, bus: 3, frame }, used)) = message(&bytes) else {
                panic!("{:?}", message(&bytes));
            };
            assert_eq!((frame.map(|frame| frame.to_string()).as_deref(), used), (text, bytes.len()));
            for cut in 0..bytes.len() {
                assert_eq!(message(&bytes[..cut]), None, "{cut}");
            }
        }
        assert_eq!(message(&with(0x123, 65)), Some((Message::Garbage, 1)));
    }

    /// What SavvyCAN sends when it connects (`GVRetSerial::deviceConnected`), and what ESP32RET answers, byte for byte.
    #[test]
    fn savvycan_s_greeting_is_read_and_answered_as_an_esp32ret_does() {
        let greeting = [0xE7, 0xE7, 0xF1, 0x0C, 0xF1, 0x06, 0xF1, 0x07, 0xF1, 0x01, 0xF1, 0x09];
        let mut rest = &greeting[..];
        let mut read = Vec::new();
        while let Some((command, len)) = command(rest) {
            read.push(command);
            rest = &rest[len..];
        }
        assert!(rest.is_empty());
        assert_eq!(read, [Binary, Binary, GetNumber, GetBuses, GetInfo, Time, KeepAlive]);
        let bus = Bus { is_on: true, only_listens: true, bitrate_bps: 500_000 };
        for (message, bytes) in [
            (Message::Number(2), &[0xF1, 12, 2][..]),
            (Message::Buses([bus, Bus::default()]), &[0xF1, 6, 0x11, 0x20, 0xA1, 7, 0, 0, 0, 0, 0, 0]),
            (Message::Info { build: 618 }, &[0xF1, 7, 0x6A, 2, 0x20, 0, 0, 0]),
            (Message::Time(0x0102_0304), &[0xF1, 1, 4, 3, 2, 1]),
            (Message::Alive, &[0xF1, 9, 0xDE, 0xAD]),
            (Message::Other, &[0xF1, 13, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]),
        ] {
            let mut out = Vec::new();
            message.put(&mut out);
            assert_eq!(out, bytes);
            assert_eq!(super::message(bytes), Some((message, bytes.len())));
        }
    }

    /// As `GVRetSerial::piSetBusSettings` and `piSendFrame` write them.
    #[test]
    fn settings_and_frames_of_savvycan_are_read() {
        // Bus 0 on at 500 kbit/s, listening; bus 1 off at 250 kbit/s; a zero behind them.
        let settings = [0xF1, 5, 0x20, 0xA1, 7, 0xE0, 0x90, 0xD0, 3, 0x80, 0];
        let on = Bus { is_on: true, only_listens: true, bitrate_bps: 500_000 };
        let off = Bus { is_on: false, only_listens: false, bitrate_bps: 250_000 };
        let read = Command::SetBuses([(on, Some(true)), (off, Some(false))]);
        assert_eq!(command(&settings), Some((read, 10)));
        assert_eq!(command(&settings[10..]), Some((Command::Padding, 1)));
        let mut written = Vec::new();
        read.put(&mut written);
        assert_eq!(written, settings[..10]);
        // Older clients say nothing but the bit rate.
        let old = [0xF1, 5, 0x20, 0xA1, 7, 0, 0, 0, 0, 0];
        let on = Bus { only_listens: false, ..on };
        assert_eq!(command(&old), Some((Command::SetBuses([(on, None), (Bus::default(), None)]), 10)));
        let sent = [0xF1, 0, 0xF1, 0, 0xDA, 0x98, 1, 2, 0xAA, 0xBB, 0];
        let frame = "18DA00F1#AABB".parse().unwrap();
        assert_eq!(command(&sent), Some((Command::Frame { bus: 1, frame }, 11)));
        for cut in 0..sent.len() {
            assert_eq!(command(&sent[..cut]), None, "{cut}");
        }
        // A length that CAN FD has, by both commands; one that none has; an identifier of more than 11 bits without the flag.
        let fd = |kind: u8, len: u8| {
            [&[0xF1, kind, 0x23, 1, 0, 0, 0, len][..], &[0xA5; 64][..usize::from(len)], &[0]].concat()
        };
        for (kind, len) in [(0, 12), (0, 64), (20, 64), (20, 8), (20, 0)] {
            let bytes = fd(kind, len);
            let Some((Command::Fd { bus: 0, frame }, used)) = command(&bytes) else {
                panic!("{:?}", command(&bytes))
            };
            assert_eq!(
                (frame.to_string(), used),
                (format!("123##1{}", "A5".repeat(len.into())), bytes.len())
            );
        }
        for (kind, len) in [(0, 9), (20, 63)] {
            assert_eq!(command(&fd(kind, len)), Some((Command::NoFrame { bus: 0 }, 9 + usize::from(len))));
        }
        assert_eq!(command(&[0xF1, 0, 0, 8, 0, 0, 0, 0, 0]), Some((Command::NoFrame { bus: 0 }, 9)));
        for other in ["GET / HTTP/1.1", "\u{16}\u{3}\u{1}", "< open can0 >"] {
            assert_eq!(command(other.as_bytes()), Some((Command::Garbage, 1)), "{other}");
        }
    }
}
