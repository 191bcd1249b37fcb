//! What gateways between NMEA 2000 and computers print, a message on each line:
//!
//! * Yacht Devices' RAW, `00:29:58.617 R 0DFF180D A2 8C 50 C0 FF FF FF FF`: every frame as it was.
//! * canboat's plain form, `2011-11-24-22:42:04.388,2,127250,36,255,8,ff,10,…`: time, priority, PGN, source, destination, length and bytes.
//! * Actisense's N2K ASCII, `A000159.990 CCFF7 0FF63 3B9F0000000002FF`: time of day, source, destination and priority, PGN, bytes.
//! * The NMEA2000 library of T. Lappalainen, for boards: `228437 : Pri:2 PGN:130306 Source:105 Dest:255 Len:8 Data:0,F6,0,FB,96,FA,FF,FF`, milliseconds since
//!   the board started.
//! * NMEA 0183 sentences of several makers, in `sentence.rs`.
//!
//! Signal K's log of what came in has such lines, each behind a time and the name of its source: `1555009219000;ydgw;00:29:58.617 R …`.
//!
//! Some gateways put fast packets together before they print them. The frames that those were are not in the file, so they are counted and left out.

mod message;
mod sentence;

use std::collections::VecDeque;

use super::calendar::NS_PER_DAY;
use super::frame_fields::{FrameFields, Payload, hex_byte, identifier};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::table::date;
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord};
pub(crate) use message::id;
use message::{Form, Message, Time};
use sentence::{Habits, Sentence};

const EXPECTED: &str = "a line of an NMEA 2000 gateway such as '00:29:58.617 R 0DFF180D A2 8C', \
                        '2011-11-24-22:42:04.388,2,127250,36,255,2,ff,10', 'A000159.990 CCFF7 0FF63 3B9F' or \
                        '$PCDIN,01F119,00000000,0F,2AAF00D1067414FF*59'";
pub(crate) const PUT_TOGETHER: &str =
    "NMEA 2000 messages that their gateway put together from several frames";
const OF_ANOTHER_SOURCE: &str = "lines of Signal K's log that are of no NMEA 2000 gateway";
pub(crate) const OF_THE_GATEWAY: &str = "messages of the gateway itself";
pub(crate) const OTHER_SENTENCES: &str = "NMEA 0183 sentences that carry no NMEA 2000";
const TO_GATEWAY: &str = "sentences to a gateway, which sends them with an address of its own";
const SENTENCE: &str = "a whole NMEA 0183 sentence with a right checksum";
const NO_TIMES: &str =
    "nothing shows when the frames of $MXPGN were on the bus: they stand at the last time that was, or at 0";
const TIMES_OF_FIXES: &str =
    "$MXPGN has no times: its frames stand at that of the last position before them (RMC, ZDA)";
const ORDER_UNKNOWN: &str = "nothing shows which byte of $MXPGN is the first: the last one on the line was taken, as MiniPlex writes it";
const NO_PRIORITY: &str =
    "$PCDIN has neither priority nor destination: its frames have priority 6, and are to all";

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
    /// How sentences of NMEA 0183 are written in this file.
    habits: Habits,
    /// The last time of a sentence, and whether it was that of a position.
    sentence_ns: Option<i64>,
    of_fix: bool,
    /// The last stamp of `$PCDIN`, and what was lost to 32 bits before it.
    stamp_ns: i64,
    wrapped_ns: i64,
    /// The other sentences of the last line.
    rest: VecDeque<Vec<u8>>,
    notes: Notes,
}

/// What was said once.
#[derive(Default)]
struct Notes {
    next: Vec<&'static str>,
    said: Vec<&'static str>,
}

impl Notes {
    fn say(&mut self, note: &'static str) {
        if !self.said.contains(&note) {
            self.said.push(note);
            self.next.push(note);
        }
    }
}

/// Whether a line is in one of the forms.
pub(crate) fn is_line(line: &[u8]) -> bool {
    message(line.trim_ascii()).is_some()
}

/// Whether NMEA 0183 sentences of a text carry NMEA 2000.
pub(crate) fn has_sentence(text: &[u8]) -> bool {
    let begins = |line: &[u8]| matches!(line.first(), Some(b'$' | b'!' | b'\\' | b'0'..=b'9' | b'['));
    let lines = text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).filter(|line| !line.is_empty());
    lines.clone().find(|line| !line.starts_with(b"#")).is_some_and(begins)
        && lines
            .flat_map(sentence::each)
            .any(|line| sentence::Line::of(&line).is_some_and(|line| line.is_of_nmea2000()))
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
    frame_line(line)
        .or_else(|| plain_line(line))
        .or_else(|| actisense_line(line))
        .or_else(|| library_line(line))
}

/// `228437 : Pri:2 PGN:130306 Source:105 Dest:255 Len:8 Data:0,F6,0,FB,96,FA,FF,FF`.
fn library_line(line: &[u8]) -> Option<Message<'_>> {
    let mut words = line.split(|byte| *byte == b' ').filter(|word| !word.is_empty());
    let ms = words.next().and_then(text::decimal).and_then(|ms| i64::try_from(ms).ok())?;
    words.next().filter(|word| *word == b":")?;
    let mut number = |name: &[u8], most: u64| {
        words.next()?.strip_prefix(name).and_then(text::decimal).filter(|number| *number <= most)
    };
    let [priority, group] = [number(b"Pri:", 7)?, number(b"PGN:", 0xFF_FFFF)?];
    let [source, destination] = [number(b"Source:", 255)?, number(b"Dest:", 255)?];
    let len = number(b"Len:", 1785)? as usize;
    let cells: Vec<_> = words.next()?.strip_prefix(b"Data:")?.split(|byte| *byte == b',').collect();
    let byte = |cell: &[u8]| text::hex(cell).and_then(|byte| u8::try_from(byte).ok());
    let is_whole =
        cells.len() == len && words.next().is_none() && cells.iter().all(|cell| byte(cell).is_some());
    let data = Payload::words(cells.into_iter(), len.min(8), byte).ok()?;
    let id = id(priority as u32, group as u32, source as u32, destination as u32);
    is_whole.then_some(Message {
        time: Time::Ns(ms.checked_mul(NS_PER_S / 1000)?),
        direction: Direction::Rx,
        id,
        data,
        len,
        form: Form::Message,
    })
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
    Some(Message { time, direction, id: Some(id), data, len: bytes.len(), form: Form::FrameIfAll })
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
        form: Form::FrameIfAll,
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
    Some(Message { time, direction: Direction::Rx, id, data, len, form: Form::Message })
}

fn of_day_ns(hours: &[u8], minutes: &[u8], seconds: &[u8]) -> Option<i64> {
    let hours = text::decimal(hours).filter(|hours| *hours < 24)?;
    let minutes = text::decimal(minutes).filter(|minutes| *minutes < 60)?;
    let seconds_ns = text::time(seconds, NS_PER_S, b'.').filter(|ns| (0..61 * NS_PER_S).contains(ns))?;
    Some((hours * 3600 + minutes * 60) as i64 * NS_PER_S + seconds_ns)
}

/// Whether the messages of a group are one frame each, so that nothing was put together.
pub(crate) fn is_single(id: u32) -> bool {
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
            Time::Ns(ns) => Ok(ns),
            Time::Ticks(stamp) => {
                const WRAP_NS: i64 = (1 << 32) * (NS_PER_S / 1000);
                let ns = self.habits.ticks.ns(stamp);
                let ns = ns.ok_or_else(|| Fault::malformed("a stamp of eight digits", stamp))?;
                if self.habits.ticks == sentence::Ticks::Milliseconds && ns < self.stamp_ns - WRAP_NS / 2 {
                    self.wrapped_ns = self.wrapped_ns.saturating_add(WRAP_NS);
                }
                self.stamp_ns = ns;
                Ok(self.wrapped_ns.saturating_add(ns))
            }
            Time::Unknown => {
                self.notes.say(if self.of_fix { TIMES_OF_FIXES } else { NO_TIMES });
                Ok(self.sentence_ns.unwrap_or(0))
            }
        }
    }
}

impl Decoder {
    /// What a line says, of what is not left out, and when the line was written if that stands before it.
    fn content<'a>(&mut self, line: &'a [u8], zone: &Zone) -> Result<Content<'a>, Fault> {
        let (logged_ns, line) = match of_signal_k(line) {
            Some((logged_ns, line)) => (Some(logged_ns), line),
            None => (None, line),
        };
        if let Some(message) = message(line) {
            return Ok(Content::Message(logged_ns, message));
        }
        let others = logged_ns.map_or(OTHER_SENTENCES, |_| OF_ANOTHER_SOURCE);
        let Some(sentence) = sentence::Line::of(line) else {
            return match logged_ns {
                Some(_) => Ok(Content::LeftOut(others)),
                None => Err(Fault::malformed(EXPECTED, line)),
            };
        };
        let logged_ns = logged_ns.or_else(|| sentence.time_ns(zone));
        if logged_ns.is_some() {
            (self.sentence_ns, self.of_fix) = (logged_ns, false);
        }
        match sentence.content(self.habits) {
            Sentence::Message(message) => {
                if matches!(message.time, Time::Ticks(_)) {
                    self.notes.say(NO_PRIORITY);
                }
                Ok(Content::Message(logged_ns, message))
            }
            Sentence::Fix(time_ns) => {
                if logged_ns.is_none() && (self.of_fix || self.sentence_ns.is_none()) {
                    (self.sentence_ns, self.of_fix) = (Some(time_ns), true);
                }
                Ok(Content::LeftOut(others))
            }
            Sentence::Other => Ok(Content::LeftOut(others)),
            Sentence::ToGateway => Ok(Content::LeftOut(TO_GATEWAY)),
            Sentence::Broken => Err(Fault::malformed(SENTENCE, line)),
        }
    }
}

/// What a line says.
enum Content<'a> {
    Message(Option<i64>, Message<'a>),
    LeftOut(&'static str),
}

impl RowFormat for Decoder {
    fn begin(&mut self, buffered: &[u8]) {
        const SAMPLE_BYTES: usize = 64 << 10;
        let lines = || {
            let lines = buffered.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii);
            lines.map(|line| of_signal_k(line).map_or(line, |(_, line)| line))
        };
        self.puts_together = lines().filter_map(message).any(|message| message.len > 8);
        let sample = &buffered[..buffered.len().min(SAMPLE_BYTES)];
        let sentences: Vec<_> =
            sample.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).flat_map(sentence::each).collect();
        self.habits = Habits::of(sentences.iter().map(Vec::as_slice));
        if self.habits.order_unknown {
            self.notes.say(ORDER_UNKNOWN);
        }
    }

    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() || line.starts_with(b"#") {
            return Ok(Line::Nothing);
        }
        if sentence::has_more(line) {
            self.rest.extend(sentence::each(line));
            return Ok(Line::Nothing);
        }
        self.one(line, zone)
    }

    fn more(&mut self, zone: &Zone) -> Option<Result<Line, Fault>> {
        let line = self.rest.pop_front()?;
        if sentence::Line::of(&line).is_none_or(|line| line.is_cut()) {
            return Some(Err(Fault::malformed(SENTENCE, &line)));
        }
        Some(self.one(&line, zone))
    }

    fn may_be_cut(&self, line: &[u8], record: &TraceRecord) -> bool {
        // The form with commas says how many bytes there are, and no frame has more than 8; a sentence has a checksum.
        if sentence::Line::of(line).is_some() {
            return !line.contains(&b'*');
        }
        !line.contains(&b',') && record.frame().is_none_or(|frame| frame.data().len() < 8)
    }

    fn note(&mut self) -> Option<&'static str> {
        self.notes.next.pop()
    }
}

impl Decoder {
    /// What a line with one message says.
    fn one(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        let (logged_ns, message) = match self.content(line, zone)? {
            Content::Message(logged_ns, message) => (logged_ns, message),
            Content::LeftOut(what) => return Ok(Line::LeftOut(what)),
        };
        // A gateway's clock is the better one if it has a date.
        let time_ns = match (message.time, logged_ns) {
            (Time::Date(_), _) | (_, None) => self.time_ns(message.time, zone)?,
            (_, Some(logged_ns)) => logged_ns,
        };
        if matches!(message.time, Time::Ns(_) | Time::Ticks(_)) {
            (self.sentence_ns, self.of_fix) = (Some(time_ns), false);
        }
        self.puts_together |= message.len > 8;
        let Some(raw) = message.id else { return Ok(Line::LeftOut(OF_THE_GATEWAY)) };
        let is_whole = match message.form {
            Form::Frame => true,
            Form::FrameIfAll => !self.puts_together || is_single(raw),
            Form::Message => is_single(raw),
        };
        if message.len > 8 || !is_whole {
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
}

#[cfg(test)]
mod tests;
