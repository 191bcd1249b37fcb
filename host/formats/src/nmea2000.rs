//! What gateways between NMEA 2000 and computers print, a message on each line:
//!
//! * Yacht Devices' RAW, `00:29:58.617 R 0DFF180D A2 8C 50 C0 FF FF FF FF`: every frame as it was.
//! * canboat's plain form, `2011-11-24-22:42:04.388,2,127250,36,255,8,ff,10,…`: time, priority, PGN, source, destination, length and bytes.
//! * Actisense's N2K ASCII, `A000159.990 CCFF7 0FF63 3B9F0000000002FF`: time of day, source, destination and priority, PGN, bytes.
//!
//! Signal K's log of what came in has such lines, each behind a time and the name of its source: `1555009219000;ydgw;00:29:58.617 R …`.
//!
//! Some gateways put fast packets together before they print them. The frames that those were are not in the file, so they are counted and left out.

use super::calendar::NS_PER_DAY;
use super::frame_fields::{FrameFields, Payload, hex_byte, identifier};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::table::date;
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord};

const EXPECTED: &str = "a line of an NMEA 2000 gateway such as '00:29:58.617 R 0DFF180D A2 8C', \
                        '2011-11-24-22:42:04.388,2,127250,36,255,2,ff,10' or 'A000159.990 CCFF7 0FF63 3B9F'";
const PUT_TOGETHER: &str = "NMEA 2000 messages that their gateway put together from several frames";
const OF_ANOTHER_SOURCE: &str = "lines of Signal K's log that are of no NMEA 2000 gateway";
const OF_THE_GATEWAY: &str = "messages of the gateway itself";

/// The parameter groups from 1F000 to 1FEFF that are one frame each, less 1F000: those of canboat's table (2026, Apache-2.0).
const SINGLE_FRAMES: [u16; 61] = [
    0x010, 0x011, 0x10D, 0x112, 0x113, 0x114, 0x119, 0x11A, 0x200, 0x205, 0x20C, 0x20D, 0x20E, 0x211, 0x214,
    0x300, 0x301, 0x302, 0x303, 0x304, 0x305, 0x306, 0x307, 0x400, 0x401, 0x402, 0x403, 0x406, 0x407, 0x408,
    0x503, 0x50B, 0x700, 0x701, 0x708, 0x709, 0x70A, 0x70C, 0x801, 0x802, 0x803, 0x804, 0x809, 0x903, 0x90B,
    0xA03, 0xA0A, 0xA0E, 0xD02, 0xD06, 0xD07, 0xD08, 0xD09, 0xD0A, 0xD0B, 0xD0C, 0xE00, 0xE10, 0xE13, 0xE16,
    0xE19,
];

/// Reads the lines.
#[derive(Default)]
pub(crate) struct Decoder {
    /// Whether the file has messages that were put together from several frames.
    puts_together: bool,
    /// The last time of day, and the days before it: clocks without a date go over midnight.
    last_ns: i64,
    days_ns: i64,
}

/// When a message was on the bus.
#[derive(Clone, Copy)]
enum Time<'a> {
    OfDay(i64),
    /// With a date, to be read only if the line is a frame's.
    Date(&'a [u8]),
}

/// The fields of a line.
struct Message<'a> {
    time: Time<'a>,
    direction: Direction,
    /// The identifier of 29 bits; `None` if the group is not one of NMEA 2000, but a gateway's own.
    id: Option<u32>,
    data: Payload,
    /// How many bytes there are, which may be more than a frame has.
    len: usize,
    /// Whether the line is in a form that has messages rather than frames.
    of_messages: bool,
}

/// Whether a line is in one of the forms.
pub(crate) fn is_line(line: &[u8]) -> bool {
    message(line.trim_ascii()).is_some()
}

/// Whether a text is a log of Signal K with such a line.
pub(crate) fn is_log_of_signal_k(text: &[u8]) -> bool {
    let mut lines = text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii);
    lines.any(|line| of_signal_k(line).is_some_and(|(_, line)| is_line(line)))
}

/// The time before a line of Signal K's log, in nanoseconds, and what a source sent: `1555009219000;ydgw;…`.
fn of_signal_k(line: &[u8]) -> Option<(i64, &[u8])> {
    /// A time since 1970 in milliseconds has as many digits from 2001 to 2286.
    const DIGITS: usize = 13;
    const NS_PER_MS: i64 = 1_000_000;
    let (time, rest) = line.split_at_checked(DIGITS)?;
    let rest = rest.strip_prefix(b";")?;
    let source = memchr::memchr(b';', rest)?;
    let ms = i64::try_from(text::decimal(time)?).ok()?;
    Some((ms * NS_PER_MS, rest[source + 1..].trim_ascii()))
}

fn message(line: &[u8]) -> Option<Message<'_>> {
    frame_line(line).or_else(|| plain_line(line)).or_else(|| actisense_line(line))
}

/// `00:29:58.617 R 0DFF180D A2 8C 50 C0`.
fn frame_line(line: &[u8]) -> Option<Message<'_>> {
    let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    let time = words.next()?;
    let parts: Vec<_> = time.split(|byte| *byte == b':').collect();
    let [hours, minutes, seconds] = parts[..] else { return None };
    let direction = match words.next()? {
        b"R" => Direction::Rx,
        b"T" => Direction::Tx,
        _ => return None,
    };
    let id = words.next().filter(|id| id.len() == 8).and_then(text::hex)?;
    let bytes: Option<Vec<u8>> = words.map(hex_byte).collect();
    let bytes = bytes.filter(|bytes| bytes.len() <= 8)?;
    let time = Time::OfDay(of_day_ns(hours, minutes, seconds)?);
    let data = Payload::of(&bytes)?;
    Some(Message { time, direction, id: Some(id), data, len: bytes.len(), of_messages: false })
}

/// `2011-11-24-22:42:04.388,2,127250,36,255,8,ff,10,3b,ff,7f,ce,f5,fc`.
fn plain_line(line: &[u8]) -> Option<Message<'_>> {
    let mut cells = line.split(|byte| *byte == b',').map(<[u8]>::trim_ascii);
    let time = cells.next().filter(|time| memchr::memchr_iter(b':', time).count() >= 2)?;
    let mut number = |most: u64| cells.next().and_then(text::decimal).filter(|number| *number <= most);
    let [priority, group] = [number(7)?, number(0xFF_FFFF)?];
    let [source, destination] = [number(255)?, number(255)?];
    let len = number(1785)? as usize;
    // The last comma may be at the end of the line.
    let mut cells = cells.filter(|cell| !cell.is_empty());
    let data = Payload::words(&mut cells, len.min(8), hex_byte).ok()?;
    let rest = cells.filter(|cell| hex_byte(cell).is_some()).count();
    let id = id(priority as u32, group as u32, source as u32, destination as u32);
    let is_whole = rest == len.saturating_sub(8);
    is_whole.then_some(Message {
        time: Time::Date(time),
        direction: Direction::Rx,
        id,
        data,
        len,
        of_messages: false,
    })
}

/// `A000159.990 CCFF7 0FF63 3B9F0000000002FF`.
fn actisense_line(line: &[u8]) -> Option<Message<'_>> {
    let mut words = line.strip_prefix(b"A")?.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    let (clock, seconds) = words.next().filter(|time| time.is_ascii())?.split_at_checked(4)?;
    let hex = |word: &[u8]| text::hex(word).filter(|_| word.len() == 5);
    let addresses = words.next().and_then(hex)?;
    let group = words.next().and_then(hex)?;
    let digits = words.next()?;
    let len = digits.len() / 2;
    let is_whole = digits.len().is_multiple_of(2) && digits.iter().all(u8::is_ascii_hexdigit);
    if !is_whole || words.next().is_some() {
        return None;
    }
    let data = Payload::words(digits.chunks_exact(2), len.min(8), hex_byte).ok()?;
    let time = Time::OfDay(of_day_ns(&clock[..2], &clock[2..], seconds)?);
    let id = id(addresses & 0xF, group, addresses >> 12, addresses >> 4 & 0xFF);
    Some(Message { time, direction: Direction::Rx, id, data, len, of_messages: true })
}

fn of_day_ns(hours: &[u8], minutes: &[u8], seconds: &[u8]) -> Option<i64> {
    let hours = text::decimal(hours).filter(|hours| *hours < 24)?;
    let minutes = text::decimal(minutes).filter(|minutes| *minutes < 60)?;
    let seconds_ns = text::time(seconds, NS_PER_S, b'.').filter(|ns| (0..61 * NS_PER_S).contains(ns))?;
    Some((hours * 3600 + minutes * 60) as i64 * NS_PER_S + seconds_ns)
}

/// The identifier of a message's frames (SAE J1939-21): groups below F0 in their second byte have a destination.
fn id(priority: u32, group: u32, source: u32, destination: u32) -> Option<u32> {
    let is_addressed = group >> 8 & 0xFF < 0xF0;
    let is_of_bus = priority <= 7 && group <= 0x3_FFFF && !(is_addressed && group & 0xFF != 0);
    let low = if is_addressed { destination << 8 } else { 0 };
    is_of_bus.then_some(priority << 26 | group << 8 | low | source)
}

/// Whether the messages of a group are one frame each, so that nothing was put together.
fn is_single(id: u32) -> bool {
    let group = id >> 8 & 0x3_FFFF;
    // Up to there are the groups of J1939, which need a transport protocol for more than 8 bytes.
    !(0x1_ED00..0x2_0000).contains(&group)
        || (0x1_F000..0x1_FF00).contains(&group) && SINGLE_FRAMES.contains(&((group - 0x1_F000) as u16))
}

impl Decoder {
    fn time_ns(&mut self, time: Time<'_>, zone: &Zone) -> Result<i64, Fault> {
        match time {
            Time::Date(shown) => {
                let mut text = shown.to_vec();
                // canboat has the same mark between a date and a time as within the date.
                if let Some(mark @ b'-') = text.get_mut(10) {
                    *mark = b'T';
                }
                date(&text, zone).ok_or_else(|| Fault::malformed("a date or a time of day", shown))
            }
            Time::OfDay(of_day_ns) => {
                if of_day_ns < self.last_ns - NS_PER_DAY / 2 {
                    self.days_ns = self.days_ns.saturating_add(NS_PER_DAY);
                }
                self.last_ns = of_day_ns;
                Ok(self.days_ns.saturating_add(of_day_ns))
            }
        }
    }
}

impl RowFormat for Decoder {
    fn begin(&mut self, buffered: &[u8]) {
        let lines = buffered.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii);
        let lines = lines.map(|line| of_signal_k(line).map_or(line, |(_, line)| line));
        self.puts_together = lines.filter_map(message).any(|message| message.len > 8);
    }

    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() || line.starts_with(b"#") {
            return Ok(Line::Nothing);
        }
        let (logged_ns, line) = match of_signal_k(line) {
            Some((logged_ns, line)) => (Some(logged_ns), line),
            None => (None, line),
        };
        let message = match message(line) {
            Some(message) => message,
            None if logged_ns.is_some() => return Ok(Line::LeftOut(OF_ANOTHER_SOURCE)),
            None => return Err(Fault::malformed(EXPECTED, line)),
        };
        // A gateway's clock is the better one if it has a date.
        let time_ns = match (message.time, logged_ns) {
            (Time::OfDay(_), Some(logged_ns)) => logged_ns,
            (time, _) => self.time_ns(time, zone)?,
        };
        self.puts_together |= message.len > 8;
        let Some(raw) = message.id else { return Ok(Line::LeftOut(OF_THE_GATEWAY)) };
        if message.len > 8 || (message.of_messages || self.puts_together) && !is_single(raw) {
            return Ok(Line::LeftOut(PUT_TOGETHER));
        }
        let id = identifier(raw, true, line)?;
        let fields =
            FrameFields { id, remote: false, direction: message.direction, len: message.len as u8, fd: None };
        Ok(Line::Record(TraceRecord {
            time_ns,
            device_ns: None,
            channel: 1,
            event: fields.event(&message.data)?,
        }))
    }

    fn may_be_cut(&self, line: &[u8], record: &TraceRecord) -> bool {
        // The form with commas says how many bytes there are, and no frame has more than 8.
        !line.contains(&b',') && record.frame().is_none_or(|frame| frame.data().len() < 8)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::{Format, ReadOptions, TraceReader};

    fn as_log(file: &str) -> (String, Vec<String>) {
        tests::as_log(Format::Nmea2000, file)
    }

    #[test]
    fn frames_of_yacht_devices_are_read_over_midnight() {
        let (log, issues) = as_log(
            "23:59:59.617 R 0DFF180D A2 8C 50 C0 FF FF FF FF\r\n00:00:00.100 T 18EAFF44 14 F0 01\r\n\
             00:00:00.050 R 09FD020D\r\n",
        );
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(86399.617000) can0 0DFF180D#A28C50C0FFFFFFFF\n(86400.100000) can0 18EAFF44#14F001 T\n\
             (86400.050000) can0 09FD020D#\n"
        );
    }

    #[test]
    fn the_plain_form_has_dates_of_several_kinds() {
        let (log, issues) = as_log(
            "# a drive\n2011-11-24-22:42:04.388,2,127250,36,255,8,ff,10,3b,ff,7f,ce,f5,fc\n\
             2022-09-28T11:36:59.668Z,6,59904,36,23,3,14,f0,01\n2022-09-28T04:36:59.668-07:00,6,59904,36,255,3,14,f0,01,\n",
        );
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(1322174524.388000) can0 09F11224#FF103BFF7FCEF5FC\n(1664365019.668000) can0 18EA1724#14F001\n\
             (1664365019.668000) can0 18EAFF24#14F001\n"
        );
    }

    #[test]
    fn a_log_of_signal_k_has_dates_and_lines_of_other_sources() {
        let file = "1555009219000;gps;$GPGLL,4916.45,N,12311.12,W,225444,A\n\
                    1555009219100;ydgw;17:33:39.050 R 0DFF180D A2 8C 50 C0 FF FF FF FF\n\
                    1555009219200;A;2019-04-11-17:33:39.150,6,59904,36,255,3,14,f0,01\n1555009219300;ydgw;17:3\n";
        assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Nmea2000));
        let (log, issues) = as_log(file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(1555009219.100000) can0 0DFF180D#A28C50C0FFFFFFFF\n(1555004019.150000) can0 18EAFF24#14F001\n"
        );
    }

    /// Of the frames that a message was made of, such a file has nothing.
    #[test]
    fn what_was_put_together_is_counted_and_what_is_one_frame_is_read() {
        let file = "A000159.990 CCFF7 0FF63 3B9F0000000002FF\nA000200.004 24FF2 1F112 FFFFCA300100FFFF\n\
             A000200.005 24FF3 1F805 20945F1F44ED03030102\nA000200.006 24FF3 1F805 2094\n\
             2011-11-24-22:42:04.388,2,393216,36,255,1,ff\n";
        let (log, issues) = as_log(file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(119.990000) can0 1CFF63CC#3B9F0000000002FF\n(120.004000) can0 09F11224#FFFFCA300100FFFF\n"
        );
        let source = std::io::Cursor::new(file);
        let mut reader =
            TraceReader::from_source("test", source, Format::Nmea2000, &ReadOptions::default()).unwrap();
        assert_eq!(reader.by_ref().count(), 2);
        let left_out: Vec<_> = reader.left_out().iter().collect();
        assert_eq!(left_out, [(super::PUT_TOGETHER, 2), (super::OF_THE_GATEWAY, 1)]);
        // Without a message of more than a frame, every line is a frame.
        let (log, _) = as_log("2011-11-24-22:42:04.388,2,129029,36,255,3,a0,2b,01\n");
        assert_eq!(log, "(1322174524.388000) can0 09F80524#A02B01\n");
    }

    #[test]
    fn broken_lines_are_named() {
        let (log, issues) = as_log(
            "00:29:58.617 R 2DFF180D A2\n00:29:58.617 X 0DFF180D A2\n25:29:58.617 R 0DFF180D A2\n00:29:58.617 R 0DFF180D A\n\
             2011-11-24-22:42:04.388,2,127250,36,255,8,ff\n2011-11-24-22:42:04.388,8,127250,36,255,1,ff\n\
             2011-13-24-22:42:04.388,2,127250,36,255,1,ff\n2011-11-24-22:42:04.388,2,127250,36,255,1,ff,ff\n\
             A000159.990 CCFF7 0FF63 3B9\nA00\u{e9}159.990 CCFF7 0FF63 3B9F\n00:29:58.617 R 0DFF180D A2",
        );
        assert_eq!((log.as_str(), issues.len()), ("", 11), "{issues:#?}");
        assert!(issues[10].contains("the file ends inside a line"), "{issues:#?}");
        let (log, issues) = as_log("00:29:58.617 R 0DFF180D A2 8C 50 C0 FF FF FF FF");
        assert_eq!((log.lines().count(), issues.len()), (1, 0), "{issues:?}");
    }
}
