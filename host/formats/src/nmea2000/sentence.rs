//! NMEA 0183 sentences that carry NMEA 2000, among those that do not:
//!
//! * `$PCDIN,01F119,00000000,0F,2AAF00D1067414FF*59` (SeaSmart): PGN, stamp, source and bytes; messages, without priority and destination.
//! * `$MXPGN,01F801,2801,C1308AC40C5DE343*19` (MiniPlex): PGN, a word with direction, priority, length and address, and bytes; frames, without times.
//!   MiniPlex writes the last byte first, others the first: what the bytes show decides.
//! * `!PDGY,127257,3,17,255,0.563,AP9/UgAh/v8=` (Digital Yacht): PGN, priority, source, destination, seconds, and bytes in Base64; messages.
//!
//! Before a sentence there may be a TAG block (`\s:x,c:1577836800*hh\`), a date, or seconds or milliseconds since 1970.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::super::calendar::Date;
use super::super::frame_fields::{Payload, hex_byte};
use super::super::table;
use super::super::text::{self, NS_PER_S};
use super::super::zone::Zone;
use super::message::{Form, Message, Time, id, is_addressed};
use cantap_trace::Direction;

/// What a sentence says.
pub(super) enum Sentence<'a> {
    Message(Message<'a>),
    /// The date and time of day of a position, in nanoseconds.
    Fix(i64),
    /// Nothing of NMEA 2000.
    Other,
    /// Its checksum or its fields are wrong.
    Broken,
    /// One that a program sends to a gateway, which adds its own address.
    ToGateway,
}

/// What a file's first sentences show about all of them.
#[derive(Clone, Copy, Default)]
pub(super) struct Habits {
    pub last_byte_first: bool,
    /// Whether nothing showed which byte is first.
    pub order_unknown: bool,
    pub ticks: Ticks,
}

/// What the stamps of `$PCDIN` are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Ticks {
    /// Milliseconds since the gateway started, in hexadecimal digits, as most write them.
    #[default]
    Milliseconds,
    /// Seconds since 1970, in hexadecimal digits.
    Seconds,
    /// 1/1024 s since 2010, in digits from 0 to V, as SeaSmart's own devices write them.
    Base32,
}

impl Ticks {
    /// A stamp in nanoseconds.
    pub fn ns(self, stamp: &[u8]) -> Option<i64> {
        const FIRST_OF_2010_S: i64 = 1_262_304_000;
        let number = |radix| i64::from_str_radix(std::str::from_utf8(stamp).ok()?, radix).ok();
        match self {
            Self::Milliseconds => number(16)?.checked_mul(NS_PER_S / 1000),
            Self::Seconds => number(16)?.checked_mul(NS_PER_S),
            Self::Base32 => {
                let ticks = number(32)?;
                let ns = (ticks >> 10).checked_mul(NS_PER_S)? + (ticks & 0x3FF) * NS_PER_S / 1024;
                ns.checked_add(FIRST_OF_2010_S * NS_PER_S)
            }
        }
    }
}

/// The sentences of a line, each behind what stands before the first: some gateways end no line between them.
pub(super) fn each(line: &[u8]) -> Vec<Vec<u8>> {
    let starts: Vec<_> =
        memchr::memchr2_iter(b'$', b'!', line).filter(|at| Line::begins(&line[*at..])).collect();
    let before = &line[..starts.first().copied().unwrap_or(0)];
    let ends = starts.iter().copied().skip(1).chain([line.len()]);
    let parts =
        starts.iter().zip(ends).map(|(start, end)| [before, line[*start..end].trim_ascii_end()].concat());
    parts.collect()
}

/// Whether a line has more than one sentence.
pub(super) fn has_more(line: &[u8]) -> bool {
    memchr::memchr2_iter(b'$', b'!', line).filter(|at| Line::begins(&line[*at..])).nth(1).is_some()
}

/// A line's sentence, without its checksum, and what stands before it.
pub(super) struct Line<'a> {
    before: &'a [u8],
    body: &'a [u8],
    is_whole: bool,
    has_sum: bool,
}

impl<'a> Line<'a> {
    /// Whether a sentence begins there.
    fn begins(text: &[u8]) -> bool {
        let name = text[1..].split(|byte| *byte == b',').next().unwrap_or_default();
        (4..=6).contains(&name.len())
            && name.iter().all(|byte| byte.is_ascii_uppercase() || byte.is_ascii_digit())
            && text.len() > 1 + name.len()
    }

    /// Whether its checksum is missing, which only Digital Yacht leaves out.
    pub fn is_cut(&self) -> bool {
        !self.has_sum && self.name() != b"PDGY"
    }

    /// `None` if there is no sentence in it.
    pub fn of(line: &'a [u8]) -> Option<Self> {
        let start = memchr::memchr2_iter(b'$', b'!', line).find(|at| Self::begins(&line[*at..]))?;
        let (before, sentence) = line.split_at(start);
        let sentence = &sentence[1..];
        let (body, sum) = match memchr::memrchr(b'*', sentence) {
            Some(star) => (&sentence[..star], Some(sentence[star + 1..].trim_ascii())),
            None => (sentence, None),
        };
        let is = body.iter().fold(0, |sum, byte| sum ^ byte);
        let is_whole = sum.is_none_or(|sum| hex_byte(sum) == Some(is));
        Some(Self { before, body, is_whole, has_sum: sum.is_some() })
    }

    /// Whether it carries NMEA 2000.
    pub fn is_of_nmea2000(&self) -> bool {
        let carries = |name: &[u8]| matches!(name, b"PCDIN" | b"MXPGN" | b"PDGY");
        self.is_whole
            && carries(self.name())
            && matches!(self.content(Habits::default()), Sentence::Message(_))
    }

    fn name(&self) -> &'a [u8] {
        self.body.split(|byte| *byte == b',').next().unwrap_or_default()
    }

    /// The time before it, in nanoseconds.
    pub fn time_ns(&self, zone: &Zone) -> Option<i64> {
        let before = self.before.trim_ascii();
        if let Some(block) = before.strip_prefix(b"\\") {
            let mut fields = block.split(|byte| matches!(byte, b',' | b'\\' | b'*'));
            return since_1970(fields.find_map(|field| field.strip_prefix(b"c:"))?);
        }
        let is_separator = |byte: &u8| matches!(byte, b',' | b';' | b'|' | b'>' | b'\t' | b' ' | b'"');
        let end = before.iter().rposition(|byte| !is_separator(byte))? + 1;
        let shown = &before[..end];
        let shown = shown.strip_prefix(b"[").and_then(|shown| shown.strip_suffix(b"]")).unwrap_or(shown);
        since_1970(shown).or_else(|| table::date(shown, zone))
    }

    /// What it says.
    pub fn content(&self, habits: Habits) -> Sentence<'a> {
        if !self.is_whole {
            return Sentence::Broken;
        }
        let mut cells = self.body.split(|byte| *byte == b',');
        match cells.next().unwrap_or_default() {
            b"PCDIN" => pcdin(cells).map_or(Sentence::Broken, Sentence::Message),
            b"MXPGN" => mxpgn(cells, habits).unwrap_or(Sentence::Broken),
            // `$PDGY` is the gateway's own, such as its list of groups.
            b"PDGY" if self.body.len() > 5 => pdgy(cells).map_or(Sentence::Other, Sentence::Message),
            name if name.ends_with(b"ZDA") => zda(cells).map_or(Sentence::Other, Sentence::Fix),
            name if name.ends_with(b"RMC") => rmc(cells).map_or(Sentence::Other, Sentence::Fix),
            _ => Sentence::Other,
        }
    }
}

impl Habits {
    /// Looks at a file's first lines.
    pub fn of<'a>(lines: impl Iterator<Item = &'a [u8]>) -> Self {
        /// A count that goes on tells as much as so many fill bytes.
        const CERTAIN: u32 = 8;
        let (mut first, mut last) = (0, 0);
        let (mut stamps, mut before) = (Vec::new(), None);
        for line in lines.filter_map(Line::of) {
            match line.content(Self::default()) {
                Sentence::Message(Message { time: Time::Ticks(stamp), .. }) => stamps.push(stamp),
                Sentence::Message(message) if message.form == Form::Frame => {
                    let data = message.data;
                    if let [start, .., end] = *data.as_slice() {
                        // What is left over of a frame is filled with FF, at its end.
                        first += u32::from(end == 0xFF && start != 0xFF);
                        last += u32::from(start == 0xFF && end != 0xFF);
                        // A fast packet counts its frames in their first bytes.
                        let group = message.id.map(|id| id & 0x3FF_FFFF);
                        if let Some((same, was_start, was_end)) = before
                            && same == group
                        {
                            let follows = |was: u8, is: u8| is & 0x1F != 0 && is == was.wrapping_add(1);
                            let (at_start, at_end) = (follows(was_start, start), follows(was_end, end));
                            first += CERTAIN * u32::from(at_start && !at_end);
                            last += CERTAIN * u32::from(at_end && !at_start);
                        }
                        before = Some((group, start, end));
                    }
                }
                _ => {}
            }
        }
        let has_frames = before.is_some();
        Self {
            // MiniPlex, which the sentence is named after, writes the last byte first.
            last_byte_first: last > first || has_frames && last == first,
            order_unknown: has_frames && last == first,
            ticks: Self::ticks_of(&stamps),
        }
    }

    fn ticks_of(stamps: &[&[u8]]) -> Ticks {
        /// In 2001, and more days than a gateway runs.
        const BILLION: u32 = 1_000_000_000;
        let numbers: Option<Vec<u32>> = stamps.iter().map(|stamp| text::hex(stamp)).collect();
        let Some(numbers) = numbers else { return Ticks::Base32 };
        let (Some(least), Some(most)) = (numbers.iter().min(), numbers.iter().max()) else {
            return Ticks::default();
        };
        // Several messages come in a second, and not in a millisecond.
        let is_slow = ((most - least) as usize) < numbers.len();
        if *least > BILLION && is_slow { Ticks::Seconds } else { Ticks::Milliseconds }
    }
}

/// Seconds, possibly with a fraction, or milliseconds.
fn since_1970(shown: &[u8]) -> Option<i64> {
    match shown.len() {
        13 if !shown.contains(&b'.') => text::time(shown, NS_PER_S / 1000, b'.'),
        10.. if shown[..10].iter().all(u8::is_ascii_digit) => text::time(shown, NS_PER_S, b'.'),
        _ => None,
    }
}

fn bytes_of(digits: &[u8]) -> Option<Vec<u8>> {
    let pairs = digits.chunks_exact(2);
    if !pairs.remainder().is_empty() {
        return None;
    }
    pairs.map(hex_byte).collect()
}

/// The bytes that a frame could have, of so many.
fn payload(bytes: &[u8]) -> Option<Payload> {
    Payload::of(&bytes[..bytes.len().min(8)])
}

fn pcdin<'a>(mut cells: impl Iterator<Item = &'a [u8]>) -> Option<Message<'a>> {
    /// `$PCDIN` has no priority: most groups have this one.
    const PRIORITY: u32 = 6;
    let group = cells.next().filter(|group| group.len() <= 6).and_then(text::hex)?;
    let stamp = cells.next().filter(|stamp| stamp.len() == 8)?;
    Ticks::Base32.ns(stamp)?;
    let source = cells.next().and_then(hex_byte)?;
    let bytes = bytes_of(cells.next()?)?;
    let is_end = cells.next().is_none() && !bytes.is_empty();
    is_end.then_some(Message {
        time: Time::Ticks(stamp),
        direction: Direction::Rx,
        id: id(PRIORITY, group, source.into(), 255),
        data: payload(&bytes)?,
        len: bytes.len(),
        form: Form::Message,
    })
}

fn mxpgn<'a>(mut cells: impl Iterator<Item = &'a [u8]>, habits: Habits) -> Option<Sentence<'a>> {
    let group = cells.next().filter(|group| group.len() == 6).and_then(text::hex)?;
    let word = cells.next().filter(|word| word.len() == 4).and_then(text::hex)?;
    let mut bytes = bytes_of(cells.next()?)?;
    let (is_sent, priority, len, address) = (word >> 15 == 1, word >> 12 & 7, word >> 8 & 0xF, word & 0xFF);
    if bytes.len() != len as usize || len > 8 || cells.next().is_some() {
        return None;
    }
    if is_sent {
        return Some(Sentence::ToGateway);
    }
    if habits.last_byte_first {
        bytes.reverse();
    }
    // The destination is in the first byte, if the gateway leaves it there.
    let (group, destination) =
        if is_addressed(group) && group & 0xFF != 0 { (group & !0xFF, group & 0xFF) } else { (group, 255) };
    Some(Sentence::Message(Message {
        time: Time::Unknown,
        direction: Direction::Rx,
        id: id(priority, group, address, destination),
        data: payload(&bytes)?,
        len: bytes.len(),
        form: Form::Frame,
    }))
}

fn pdgy<'a>(mut cells: impl Iterator<Item = &'a [u8]>) -> Option<Message<'a>> {
    let mut number = |most: u64| cells.next().and_then(text::decimal).filter(|number| *number <= most);
    let group = number(0xFF_FFFF)?;
    let [priority, source, destination] = [number(7)?, number(255)?, number(255)?];
    let time_ns = text::time(cells.next()?, NS_PER_S, b'.')?;
    let bytes = STANDARD.decode(cells.next()?).ok()?;
    cells.next().is_none().then_some(())?;
    Some(Message {
        time: Time::Ns(time_ns),
        direction: Direction::Rx,
        id: id(priority as u32, group as u32, source as u32, destination as u32),
        data: payload(&bytes)?,
        len: bytes.len(),
        form: Form::Message,
    })
}

/// A time of day such as `123519.25`.
fn clock_ns(cell: &[u8]) -> Option<i64> {
    let (digits, fraction) = cell.split_at_checked(6)?;
    let [hour, minute, second] = [0, 2, 4].map(|at| text::decimal(&digits[at..at + 2]));
    let ns = if fraction.len() > 1 { text::time(&[b"0", fraction].concat(), NS_PER_S, b'.')? } else { 0 };
    Date::of_day(hour?, minute?, second?, ns)
}

fn on_day(day: u64, month: u64, year: u64, of_day_ns: i64) -> Option<i64> {
    let [day, month] = [u8::try_from(day).ok()?, u8::try_from(month).ok()?];
    Date { year: i64::try_from(year).ok()?, month, day, of_day_ns }.time_ns()
}

/// `160012.71,11,03,2004,-1,00`.
fn zda<'a>(mut cells: impl Iterator<Item = &'a [u8]>) -> Option<i64> {
    let of_day_ns = clock_ns(cells.next()?)?;
    let mut number = || cells.next().and_then(text::decimal);
    on_day(number()?, number()?, number()?, of_day_ns)
}

/// `225446,A,4916.45,N,12311.12,W,000.5,054.7,191194,…`, valid only with an A.
fn rmc<'a>(mut cells: impl Iterator<Item = &'a [u8]>) -> Option<i64> {
    let of_day_ns = clock_ns(cells.next()?)?;
    cells.next().filter(|status| *status == b"A")?;
    let date = cells.nth(6).filter(|date| date.len() == 6)?;
    let [day, month, year] = [0, 2, 4].map(|at| text::decimal(&date[at..at + 2]));
    let year = year?;
    on_day(day?, month?, year + if year < 80 { 2000 } else { 1900 }, of_day_ns)
}
