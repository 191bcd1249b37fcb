//! The commands of a socketcand client: `< send 123 2 11 22 >`.

use cantap_wire::{Frame, Id};

/// A command. Identifiers, times and data are as in the protocol.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Open a bus by its name.
    Open(String),
    /// The bit rate with which to open a bus.
    Bitrate(String, u32),
    /// How to open a bus.
    ControlMode { bus: String, listen_only: bool, loopback: bool, triple: bool },
    /// Raw mode: every frame of the bus.
    RawMode,
    /// BCM mode: subscribed frames.
    BcmMode,
    /// Only statistics.
    StatisticsMode,
    /// Send once, immediately.
    Send(Frame),
    /// Send repeatedly, with a period in microseconds.
    Add(u64, Frame),
    /// Change a frame that is sent repeatedly.
    Update(Frame),
    /// Stop sending it.
    Delete(Id),
    /// Receive an identifier; at most one frame in this many microseconds.
    Subscribe(u64, Id),
    /// Receive an identifier when the masked bits of its data change.
    Filter(u64, Id, Vec<u8>),
    /// The same by the multiplexer's value: its mask, then values and masks.
    MuxFilter(u64, Id, Vec<[u8; 8]>),
    /// Stop receiving an identifier.
    Unsubscribe(Id),
    /// Statistics at this interval in milliseconds; 0 for none.
    Statistics(u64),
    /// Request an echo.
    Echo,
}

/// Why a text is not a command.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BadCommand {
    /// There is no such command.
    Unknown,
    /// A part of it is wrong.
    Syntax(&'static str),
    /// It has more bytes than a classical frame, and the protocol has no message for others. python-can sends such ones.
    Fd,
}

/// The longest command: a multiplexer filter of 257 times eight bytes.
pub const LONGEST: usize = 8 * 1024;
/// Values in one multiplexer filter.
const MOST_MUX: usize = 257;

/// Parses the text between `<` and `>`.
pub fn parse(text: &str) -> Result<Command, BadCommand> {
    let words: Vec<&str> = text.split_ascii_whitespace().collect();
    let Some((&name, rest)) = words.split_first() else { return Err(BadCommand::Unknown) };
    let command = match (name, rest) {
        ("open", [bus]) => Command::Open((*bus).to_owned()),
        ("rawmode", []) => Command::RawMode,
        ("bcmmode", []) => Command::BcmMode,
        ("controlmode", []) => Command::StatisticsMode,
        ("echo", []) => Command::Echo,
        ("statistics", [interval]) => Command::Statistics(number(interval)?),
        ("send", frame) => Command::Send(data_frame(frame)?),
        ("sendrtr", [id, dlc]) => {
            let dlc = number(dlc)?.try_into().map_err(|_| BadCommand::Syntax("the length"))?;
            Command::Send(Frame::remote_frame(self::id(id)?, dlc).ok_or(BadCommand::Syntax("the length"))?)
        }
        ("add", [seconds, micros, frame @ ..]) => {
            Command::Add(interval(seconds, micros)?, data_frame(frame)?)
        }
        ("update", frame) => Command::Update(data_frame(frame)?),
        ("delete", [id]) => Command::Delete(self::id(id)?),
        ("unsubscribe", [id]) => Command::Unsubscribe(self::id(id)?),
        ("subscribe", [seconds, micros, id]) => Command::Subscribe(interval(seconds, micros)?, self::id(id)?),
        ("filter", [seconds, micros, id, len, mask @ ..]) => {
            Command::Filter(interval(seconds, micros)?, self::id(id)?, counted(len, mask)?)
        }
        ("muxfilter", [seconds, micros, id, count, bytes @ ..]) => {
            let count = number(count)? as usize;
            let bytes = bytes.iter().map(|text| byte(text)).collect::<Result<Vec<_>, _>>()?;
            let (tuples, rest) = bytes.as_chunks::<8>();
            if !(2..=MOST_MUX).contains(&count) || tuples.len() != count || !rest.is_empty() {
                return Err(BadCommand::Syntax("the number of bytes"));
            }
            Command::MuxFilter(interval(seconds, micros)?, self::id(id)?, tuples.to_vec())
        }
        (bus, ["B", rest @ ..]) if !rest.is_empty() => {
            let rate = number(rest[0])?.try_into().map_err(|_| BadCommand::Syntax("the bit rate"))?;
            Command::Bitrate(bus.to_owned(), rate)
        }
        (bus, ["C", listen_only, loopback, triple]) => {
            let flag = |text: &&str| match *text {
                "0" => Ok(false),
                "1" => Ok(true),
                _ => Err(BadCommand::Syntax("a flag")),
            };
            Command::ControlMode {
                bus: bus.to_owned(),
                listen_only: flag(listen_only)?,
                loopback: flag(loopback)?,
                triple: flag(triple)?,
            }
        }
        (
            "open" | "rawmode" | "bcmmode" | "controlmode" | "echo" | "statistics" | "sendrtr" | "add"
            | "delete" | "unsubscribe" | "subscribe" | "filter" | "muxfilter",
            _,
        ) => return Err(BadCommand::Syntax("the number of words")),
        _ => return Err(BadCommand::Unknown),
    };
    Ok(command)
}

fn number(text: &str) -> Result<u64, BadCommand> {
    text.parse().map_err(|_| BadCommand::Syntax("a number"))
}

/// In microseconds.
fn interval(seconds: &str, micros: &str) -> Result<u64, BadCommand> {
    let seconds = number(seconds)?.checked_mul(1_000_000);
    seconds.and_then(|us| us.checked_add(number(micros).ok()?)).ok_or(BadCommand::Syntax("the interval"))
}

/// Parses a number as `%x` of C's `sscanf` into 32 bits does, with which the original server reads: with a sign, with `0x`, and cut off at 32
/// bits. Programs print negative numbers and 64 bits where they mean less. Also returns the number of digits.
fn hexadecimal(text: &str) -> Option<(u32, usize)> {
    let (is_negative, digits) = match text.as_bytes().first()? {
        b'-' => (true, &text[1..]),
        b'+' => (false, &text[1..]),
        _ => (false, text),
    };
    let digits = digits.strip_prefix("0x").or_else(|| digits.strip_prefix("0X")).unwrap_or(digits);
    // `from_str_radix` would take another sign.
    if digits.is_empty() || !digits.bytes().all(|digit| digit.is_ascii_hexdigit()) {
        return None;
    }
    let value = u64::from_str_radix(digits, 16).ok()? as u32;
    Some((if is_negative { value.wrapping_neg() } else { value }, digits.len()))
}

/// The flag with which Linux marks an identifier of 29 bits.
const EXTENDED_FLAG: u32 = 1 << 31;

/// An identifier of eight digits has 29 bits, as in the original server, and so has one with Linux's flag, or one that needs them, which
/// SavvyCAN writes without leading zeros. Linux's other flags (remote and error frames) are refused.
fn id(text: &str) -> Result<Id, BadCommand> {
    let bad = || BadCommand::Syntax("the identifier");
    let (value, digits) = hexadecimal(text).ok_or_else(bad)?;
    let raw = value & !EXTENDED_FLAG;
    let is_extended = value != raw || digits >= 8 || raw > Id::MAX_STANDARD;
    let id = if is_extended { Id::extended(raw) } else { Id::standard(raw) };
    id.ok_or_else(bad)
}

/// A byte. SavvyCAN writes those from 80 up sign-extended, or as negative numbers.
fn byte(text: &str) -> Result<u8, BadCommand> {
    let value = hexadecimal(text).map(|(value, _)| value);
    let value = value.filter(|value| *value <= 0xFF || *value >= 0xFFFF_FF80);
    value.map(|value| value as u8).ok_or(BadCommand::Syntax("a byte"))
}

/// As many bytes as the number before them says.
fn counted(len: &str, bytes: &[&str]) -> Result<Vec<u8>, BadCommand> {
    if number(len)? != bytes.len() as u64 || bytes.len() > 8 {
        return Err(BadCommand::Syntax("the number of bytes"));
    }
    bytes.iter().map(|text| byte(text)).collect()
}

fn data_frame(words: &[&str]) -> Result<Frame, BadCommand> {
    let [id, len, bytes @ ..] = words else { return Err(BadCommand::Syntax("the number of words")) };
    if bytes.len() > 8 {
        return Err(BadCommand::Fd);
    }
    let bytes = counted(len, bytes)?;
    Frame::data_frame(self::id(id)?, &bytes).ok_or(BadCommand::Syntax("the number of bytes"))
}

/// Finds commands in what a client sends. It holds at most one.
#[derive(Default)]
pub struct Finder {
    /// The text after a `<`.
    text: Option<String>,
    has_begun: bool,
}

impl Finder {
    /// Takes any piece of the stream and reports each complete command's text. Returns false if the stream does not begin with a `<`:
    /// nothing is skipped in search of the first command.
    #[must_use]
    pub fn push(&mut self, bytes: &[u8], mut report: impl FnMut(&str)) -> bool {
        if !self.has_begun && bytes.first().is_some_and(|first| *first != b'<') {
            return false;
        }
        self.has_begun |= !bytes.is_empty();
        for &byte in bytes {
            match (byte, &mut self.text) {
                (b'<', text) => *text = Some(String::new()),
                (b'>', text) => {
                    if let Some(text) = text.take() {
                        report(&text);
                    }
                }
                (byte, Some(text)) if text.len() < LONGEST => text.push(char::from(byte)),
                // Longer than any command.
                (_, text) => *text = None,
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(text: &str) -> Frame {
        text.parse().unwrap()
    }

    /// The examples of the protocol's page.
    #[test]
    fn the_page_s_commands_are_understood() {
        let standard = |raw| Id::standard(raw).unwrap();
        for (text, command) in [
            ("open can0", Command::Open("can0".to_owned())),
            ("add 1 0 123 8 11 22 33 44 55 66 77 88", Command::Add(1_000_000, frame("123#1122334455667788"))),
            ("add 0 10 123 8 11 22 33 44 55 66 77 88", Command::Add(10, frame("123#1122334455667788"))),
            ("add 0 20000 123 4 42 42 42 42", Command::Add(20_000, frame("123#42424242"))),
            ("update 123 3 11 22 33", Command::Update(frame("123#112233"))),
            ("delete 123", Command::Delete(standard(0x123))),
            ("send 123 0", Command::Send(frame("123#"))),
            ("send 1AAAAAAA 2 1 F1", Command::Send(frame("1AAAAAAA#01F1"))),
            ("sendrtr 123 0", Command::Send(frame("123#R"))),
            ("sendrtr 1AAAAAAA 2", Command::Send(frame("1AAAAAAA#R2"))),
            ("filter 0 0 123 1 FF", Command::Filter(0, standard(0x123), vec![0xFF])),
            (
                "filter 1 500000 123 8 FF 00 F8 00 00 00 00 00",
                Command::Filter(1_500_000, standard(0x123), vec![0xFF, 0, 0xF8, 0, 0, 0, 0, 0]),
            ),
            (
                "muxfilter 0 0 123 2 FF 00 00 00 00 00 00 00 33 FF FF FF FF FF FF FF",
                Command::MuxFilter(
                    0,
                    standard(0x123),
                    vec![[0xFF, 0, 0, 0, 0, 0, 0, 0], [0x33, 255, 255, 255, 255, 255, 255, 255]],
                ),
            ),
            ("subscribe 0 0 123", Command::Subscribe(0, standard(0x123))),
            ("unsubscribe 123", Command::Unsubscribe(standard(0x123))),
            ("statistics 1000", Command::Statistics(1000)),
            ("can0 B 500000 0 0 0 0 0 0 0", Command::Bitrate("can0".to_owned(), 500_000)),
            (
                "can0 C 1 0 0",
                Command::ControlMode {
                    bus: "can0".to_owned(),
                    listen_only: true,
                    loopback: false,
                    triple: false,
                },
            ),
            ("rawmode", Command::RawMode),
            ("echo", Command::Echo),
        ] {
            assert_eq!(parse(text), Ok(command), "{text}");
        }
    }

    #[test]
    fn savvycan_s_extended_signs_and_short_identifiers_are_understood() {
        assert_eq!(parse("send 18FF1122 2 ffffffffffffff80 7f"), Ok(Command::Send(frame("18FF1122#807F"))));
        assert_eq!(parse("send ffffffff9ABBCCDD 1 ffffffff"), Ok(Command::Send(frame("1ABBCCDD#FF"))));
        assert_eq!(parse("send 800 0"), Ok(Command::Send(frame("00000800#"))));
        assert_eq!(parse("send 00000123 0"), Ok(Command::Send(frame("00000123#"))));
        // With Qt 6, and as the original server takes them.
        assert_eq!(parse("send 123 3 -80 0x11 -1"), Ok(Command::Send(frame("123#8011FF"))));
        assert_eq!(parse("send -7ffffedd 1 7f"), Ok(Command::Send(frame("00000123#7F"))));
        assert_eq!(parse("send 80000123 0"), Ok(Command::Send(frame("00000123#"))));
        assert_eq!(parse("send 0x7FF 1 +1"), Ok(Command::Send(frame("7FF#01"))));
    }

    #[test]
    fn what_is_no_command_is_refused_and_not_guessed_at() {
        for text in ["", "fly", "isotpmode", "can0 X"] {
            assert_eq!(parse(text), Err(BadCommand::Unknown), "{text}");
        }
        for text in [
            "send 123 2 11",
            "send 123 1 11 22",
            "send 123",
            "send xyz 0",
            "send 123 1 100",
            "send 20000000 0",
            "send -1 0",
            "send 40000123 0",
            "send 0x 0",
            "send --1 0",
            "send 123 1 0x-1",
            "send 123 1 -81",
            "send 11111111111111111 0",
            "add 1 123 0",
            "sendrtr 123 16",
            "filter 0 0 123 2 FF",
            "muxfilter 0 0 123 1 0 0 0 0 0 0 0 0",
            "statistics often",
            "open",
            "can0 C 2 0 0",
            "can0 B fast",
        ] {
            assert!(matches!(parse(text), Err(BadCommand::Syntax(_))), "{text}: {:?}", parse(text));
        }
        // As anybody would write it, and as python-can does: the length in hexadecimal, each byte with its blank.
        for text in ["send 123 9 1 2 3 4 5 6 7 8 9", "send 123 C 1 2 3 4 5 6 7 8 9 a b c"] {
            assert_eq!(parse(text), Err(BadCommand::Fd), "{text}");
        }
    }

    #[test]
    fn commands_are_found_in_any_pieces() {
        let bytes = [
            b"< open can0 >garbage< rawmode >\r\n<".to_vec(),
            vec![b'x'; 2 * LONGEST],
            b"> < echo >".to_vec(),
        ]
        .concat();
        for piece in [1, 7, bytes.len()] {
            let (mut finder, mut found) = (Finder::default(), Vec::new());
            for bytes in bytes.chunks(piece) {
                assert!(finder.push(bytes, |text| found.push(text.trim().to_owned())));
            }
            assert_eq!(found, ["open can0", "rawmode", "echo"]);
        }
    }

    /// A web page's request has its headers in front of any body.
    #[test]
    fn nothing_is_skipped_in_search_of_the_first_command() {
        for first in ["POST / HTTP/1.1\r\n\r\n< open can0 >", " < open can0 >", "\0< open can0 >", "-"] {
            let mut finder = Finder::default();
            assert!(!finder.push(first.as_bytes(), |text| panic!("{text}")), "{first}");
        }
    }
}
