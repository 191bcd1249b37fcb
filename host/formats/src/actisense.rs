//! Actisense's binary logs (`.ebl`), and what its gateways send to a computer (NGT-1, NGX, W2K-1), saved as it came.
//!
//! A log has tags, `ESC SOH … ESC LF`, with times, directions and messages, and between them messages as a gateway sends
//! them, `DLE STX … DLE ETX`, with a checksum. What a gateway sent, saved without a log, is such messages alone. Actisense's
//! SDK describes both (EBL 1.002, BST 93, 94, 95 and D0).
//!
//! Message 95 is a frame. The others are whole messages of NMEA 2000: one is a frame if its group never has more than one, or
//! if the message says so.

use std::collections::VecDeque;
use std::io;

use super::codec::Decode;
use super::found::Found;
use super::frame_fields::{FrameFields, Payload, identifier};
use super::input::Input;
use super::issue::{Fault, Place};
use super::nmea2000;
use super::text::NS_PER_S;
use cantap_trace::{Direction, TraceRecord};

const ESC: u8 = 0x1B;
const SOH: u8 = 0x01;
const LF: u8 = 0x0A;
const DLE: u8 = 0x10;
const STX: u8 = 0x02;
const ETX: u8 = 0x03;

/// Longer than any message or tag, all of its bytes doubled twice.
const MOST_BYTES: usize = 16 << 10;
const NS_PER_MS: i64 = NS_PER_S / 1000;

const TO_GATEWAY: &str = "messages to a gateway, which sends them with an address of its own";
const OTHER_TAGS: &str = "tags of another kind than times, directions and messages";
const REST: &str = "the rest of a message that began before the file";
const TEXTS: &str = "texts of a gateway between its messages";
const NO_DATE: &str = "there is no date: times are the gateway's stamps";
const SHORT_CLOCK: &str =
    "stamps begin again in less than a second: pauses that are longer look shorter by as much";
const EXPECTED: &str = "a message of a gateway with a right length and checksum";

/// Whether a file begins like a log, or with two whole messages.
pub(crate) fn is_head(head: &[u8]) -> bool {
    /// A program that begins to listen may come into the middle of a message.
    const MOST_BEFORE: usize = 300;
    if let Part::Tag { content, .. } = part(head, true) {
        let lens = [(1, 5), (3, 9)];
        return lens.iter().any(|(tag, len)| content.first() == Some(tag) && content.len() == *len);
    }
    let Some(start) = head.windows(2).take(MOST_BEFORE).position(|pair| pair == [DLE, STX]) else {
        return false;
    };
    let mut at = start;
    for _ in 0..2 {
        match part(&head[at..], false) {
            Part::Message { len, bytes } if Bst::of(&bytes).is_some_and(|bst| bst.is_known()) => at += len,
            _ => return false,
        }
    }
    true
}

/// What stands next in a file.
#[derive(Debug, PartialEq, Eq)]
enum Part {
    /// Its first byte says of what kind.
    Tag { len: usize, content: Vec<u8> },
    /// With its checksum.
    Message { len: usize, bytes: Vec<u8> },
    /// Bytes that are neither.
    Other { len: usize },
    /// One that was begun and is not whole, although something follows.
    Broken { len: usize },
    /// One of which the end is not there.
    More,
}

fn part(bytes: &[u8], has_tags: bool) -> Part {
    match bytes {
        [ESC, SOH, ..] if has_tags => tag(bytes),
        [DLE, STX, ..] => message(bytes, has_tags),
        [DLE] => Part::More,
        [ESC] if has_tags => Part::More,
        _ => {
            let mut len = 0;
            while let Some(first) = bytes.get(len) {
                let next = bytes.get(len + 1);
                match (*first, next) {
                    (ESC, Some(&SOH) | None) if has_tags => break,
                    (DLE, Some(&STX) | None) => break,
                    (ESC, Some(&ESC)) if has_tags => len += 2,
                    (DLE, Some(&DLE)) => len += 2,
                    _ => len += 1,
                }
            }
            Part::Other { len }
        }
    }
}

fn tag(bytes: &[u8]) -> Part {
    let (mut at, mut content) = (2, Vec::new());
    loop {
        match bytes.get(at..).unwrap_or_default() {
            [ESC, ESC, ..] => {
                content.push(ESC);
                at += 2;
            }
            [ESC, LF, ..] => return Part::Tag { len: at + 2, content },
            [ESC, SOH, ..] => return Part::Broken { len: at },
            [] | [ESC] => return if at < MOST_BYTES { Part::More } else { Part::Broken { len: at } },
            [ESC, ..] => return Part::Broken { len: at + 2 },
            [byte, ..] => {
                content.push(*byte);
                at += 1;
            }
        }
        if at > MOST_BYTES {
            return Part::Broken { len: at };
        }
    }
}

/// A message. A log's writer may have put a tag with the time into the middle of it.
fn message(bytes: &[u8], has_tags: bool) -> Part {
    let (mut at, mut content) = (2, Vec::new());
    loop {
        match bytes.get(at..).unwrap_or_default() {
            [DLE, DLE, ..] => {
                content.push(DLE);
                at += 2;
            }
            [DLE, ETX, ..] => return Part::Message { len: at + 2, bytes: content },
            [DLE, STX, ..] => return Part::Broken { len: at },
            rest @ [ESC, SOH, ..] if has_tags => match tag(rest) {
                Part::Tag { len, .. } => at += len,
                Part::Broken { len } => return Part::Broken { len: at + len },
                _ => return Part::More,
            },
            [ESC, ESC, ..] if has_tags => {
                content.push(ESC);
                at += 2;
            }
            [] | [DLE] => return if at < MOST_BYTES { Part::More } else { Part::Broken { len: at } },
            [ESC] if has_tags => return Part::More,
            [DLE, ..] => return Part::Broken { len: at + 2 },
            [ESC, ..] if has_tags => return Part::Broken { len: at + 2 },
            [byte, ..] => {
                content.push(*byte);
                at += 1;
            }
        }
        if at > MOST_BYTES {
            return Part::Broken { len: at };
        }
    }
}

/// A whole message, without its checksum.
struct Bst<'a>(&'a [u8]);

impl<'a> Bst<'a> {
    /// Of bytes with a checksum.
    fn of(bytes: &'a [u8]) -> Option<Self> {
        let (sum, message) = bytes.split_last()?;
        let total = message.iter().fold(*sum, |total, byte| total.wrapping_add(*byte));
        (total == 0 && Self::len(message) == Some(message.len())).then_some(Self(message))
    }

    /// Of a tag's bytes, which W2K-1 writes without a checksum.
    fn of_tag(bytes: &'a [u8]) -> Option<Self> {
        if Self::len(bytes) == Some(bytes.len()) { Some(Self(bytes)) } else { Self::of(bytes) }
    }

    /// How long a message is that begins so, without its checksum.
    fn len(bytes: &[u8]) -> Option<usize> {
        match bytes {
            [0xD0..=0xDF, low, high, ..] => Some(usize::from(u16::from_le_bytes([*low, *high]))),
            [_, len, ..] => Some(2 + usize::from(*len)),
            _ => None,
        }
    }

    /// Whether gateways send messages of its kind.
    fn is_known(&self) -> bool {
        matches!(self.0.first(), Some(0x93..=0x95 | 0x9D | 0xA0..=0xA7 | 0xD0))
    }

    fn byte(&self, at: usize) -> u32 {
        u32::from(self.0.get(at).copied().unwrap_or(0))
    }

    fn u32(&self, at: usize) -> u32 {
        let bytes = self.0.get(at..).and_then(|rest| rest.first_chunk());
        u32::from_le_bytes(bytes.copied().unwrap_or_default())
    }

    /// What it says.
    fn content(&self) -> Content<'a> {
        let data = |at: usize| self.0.get(at..);
        match self.0.first() {
            Some(0x93) => match data(13) {
                Some(data) if data.len() == self.byte(12) as usize => {
                    let group = self.byte(3) | self.byte(4) << 8 | self.byte(5) << 16;
                    let id = nmea2000::id(self.byte(2), group, self.byte(7), self.byte(6));
                    let Some(id) = id else { return Content::LeftOut(nmea2000::OF_THE_GATEWAY) };
                    let is_frame = data.len() <= 8 && nmea2000::is_single(id);
                    let stamp = Stamp::milliseconds(self.u32(8), 32);
                    Content::of(is_frame, Frame { id, direction: Direction::Rx, stamp, data })
                }
                _ => Content::Broken,
            },
            Some(0x94) => Content::LeftOut(TO_GATEWAY),
            Some(0x95) => match data(8) {
                Some(data) if data.len() <= 8 => {
                    let word = self.u32(4);
                    let direction = if word >> 31 == 0 { Direction::Rx } else { Direction::Tx };
                    let stamp = Stamp {
                        ticks: self.byte(2) | self.byte(3) << 8,
                        bits: 16,
                        tick_ns: [NS_PER_MS, NS_PER_MS / 10, NS_PER_MS / 100, NS_PER_MS / 1000]
                            [(word >> 29 & 3) as usize],
                    };
                    Content::Frame(Frame { id: word & 0x1FFF_FFFF, direction, stamp, data })
                }
                _ => Content::Broken,
            },
            Some(0xD0) => match data(13) {
                Some(data) => {
                    let (format, page) = (self.byte(6), self.byte(7));
                    let low = if format < 0xF0 { 0 } else { self.byte(5) };
                    let group = low | format << 8 | (page & 3) << 16;
                    let id = nmea2000::id(page >> 2 & 7, group, self.byte(4), self.byte(3));
                    let Some(id) = id else { return Content::LeftOut(nmea2000::OF_THE_GATEWAY) };
                    let control = self.byte(8);
                    let direction = if control & 8 == 0 { Direction::Rx } else { Direction::Tx };
                    let packets = control & 3;
                    let is_frame = data.len() <= 8 && packets == 0;
                    let stamp = Stamp::milliseconds(self.u32(9), 32);
                    Content::of(is_frame, Frame { id, direction, stamp, data })
                }
                None => Content::Broken,
            },
            Some(0x9D) => Content::LeftOut(nmea2000::OTHER_SENTENCES),
            _ => Content::LeftOut(nmea2000::OF_THE_GATEWAY),
        }
    }
}

enum Content<'a> {
    Frame(Frame<'a>),
    LeftOut(&'static str),
    /// Its fields do not fit its length.
    Broken,
}

impl<'a> Content<'a> {
    fn of(is_frame: bool, frame: Frame<'a>) -> Self {
        if is_frame { Self::Frame(frame) } else { Self::LeftOut(nmea2000::PUT_TOGETHER) }
    }
}

struct Frame<'a> {
    id: u32,
    direction: Direction,
    stamp: Stamp,
    data: &'a [u8],
}

/// When a gateway had a message, by its own clock, which begins again after so many bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stamp {
    ticks: u32,
    bits: u32,
    tick_ns: i64,
}

impl Stamp {
    fn milliseconds(ticks: u32, bits: u32) -> Self {
        Self { ticks, bits, tick_ns: NS_PER_MS }
    }

    /// How long after another one, in nanoseconds. Messages that were sent may stand a little behind those that were
    /// received later.
    fn since(self, other: Self) -> Option<i64> {
        if (self.bits, self.tick_ns) != (other.bits, other.tick_ns) {
            return None;
        }
        let period = 1_i64 << self.bits;
        let passed = (i64::from(self.ticks) - i64::from(other.ticks)).rem_euclid(period);
        let passed = if passed > period / 8 * 7 { passed - period } else { passed };
        Some(passed * self.tick_ns)
    }
}

/// The time, from the tags and the stamps: a message behind a tag is of the tag's time, and the stamps say how much later
/// those are that follow.
#[derive(Default)]
struct Clock {
    /// The last tag's time, until a message had it.
    tag_ns: Option<i64>,
    has_date: bool,
    last: Option<(i64, Stamp)>,
}

impl Clock {
    fn time_ns(&mut self, stamp: Stamp) -> i64 {
        let by_stamp = self.last.and_then(|(last_ns, last)| Some(last_ns.saturating_add(stamp.since(last)?)));
        let last_ns = self.last.map(|(last_ns, _)| last_ns);
        let first_ns = || i64::from(stamp.ticks) * stamp.tick_ns;
        let time_ns = self.tag_ns.take().or(by_stamp).or(last_ns).unwrap_or_else(first_ns);
        self.last = Some((time_ns, stamp));
        time_ns
    }
}

/// Reads the tags and messages.
#[derive(Default)]
pub(crate) struct Decoder {
    has_tags: Option<bool>,
    /// There was a tag or a message.
    has_begun: bool,
    clock: Clock,
    is_sent: bool,
    noted: Vec<&'static str>,
    waiting: VecDeque<Found>,
}

impl Decoder {
    /// What a tag says.
    fn tag(&mut self, content: &[u8], place: Place) -> Option<Found> {
        let (kind, rest) = content.split_first()?;
        match kind {
            3 => {
                let time_ns = rest.first_chunk().map(|ticks| u64::from_le_bytes(*ticks)).and_then(of_windows);
                let Some(time_ns) = time_ns.filter(|_| rest.len() == 8) else {
                    return Some(Found::Issue(place, Fault::malformed("a time", rest)));
                };
                self.clock.tag_ns = Some(time_ns);
                self.clock.has_date = true;
                None
            }
            5 => {
                self.is_sent = rest == [1];
                None
            }
            7 => Some(self.message(Bst::of_tag(rest), place, rest)),
            // The format's version, what somebody wrote about the file, and the kind of what follows.
            1 | 2 | 4 => None,
            _ => Some(Found::LeftOut(OTHER_TAGS)),
        }
    }

    fn message(&mut self, message: Option<Bst<'_>>, place: Place, shown: &[u8]) -> Found {
        let frame = match message.map(|message| message.content()) {
            Some(Content::Frame(frame)) => frame,
            Some(Content::LeftOut(what)) => return Found::LeftOut(what),
            Some(Content::Broken) | None => return Found::Issue(place, Fault::malformed(EXPECTED, shown)),
        };
        let time_ns = self.clock.time_ns(frame.stamp);
        if !self.clock.has_date {
            self.note(NO_DATE);
        }
        if frame.stamp.bits == 16 && frame.stamp.tick_ns < NS_PER_MS / 10 {
            self.note(SHORT_CLOCK);
        }
        match self.record(&frame, time_ns) {
            Ok(record) => Found::Record(record),
            Err(fault) => Found::Issue(place, fault),
        }
    }

    fn record(&self, frame: &Frame<'_>, time_ns: i64) -> Result<TraceRecord, Fault> {
        let id = identifier(frame.id, true, format!("{:X}", frame.id).as_bytes())?;
        let direction = if self.is_sent { Direction::Tx } else { frame.direction };
        let fields = FrameFields { id, remote: false, direction, len: frame.data.len() as u8, fd: None };
        let data = Payload::of(frame.data).unwrap_or(Payload::EMPTY);
        Ok(TraceRecord { time_ns, device_ns: None, channel: 1, event: fields.event(&data)? })
    }

    fn note(&mut self, note: &'static str) {
        if !self.noted.contains(&note) {
            self.noted.push(note);
            self.waiting.push_back(Found::Note(note));
        }
    }
}

/// Nanoseconds since 1970 of a time of Windows: tenths of microseconds since 1601.
fn of_windows(ticks: u64) -> Option<i64> {
    const BEFORE_1970: u64 = 116_444_736_000_000_000;
    i64::try_from(ticks.checked_sub(BEFORE_1970)?).ok()?.checked_mul(100)
}

/// The tags in the middle of a message.
fn tags_in(bytes: &[u8]) -> impl Iterator<Item = Vec<u8>> {
    let mut at = 0;
    std::iter::from_fn(move || {
        while let Some(rest) = bytes.get(at..).filter(|rest| rest.len() > 1) {
            match rest {
                [ESC, SOH, ..] => {
                    let Part::Tag { len, content } = tag(rest) else { return None };
                    at += len;
                    return Some(content);
                }
                [ESC, ESC, ..] => at += 2,
                _ => at += 1,
            }
        }
        None
    })
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        loop {
            if let Some(found) = self.waiting.pop_front() {
                return Ok(found);
            }
            let has_tags = match self.has_tags {
                Some(has_tags) => has_tags,
                None => *self.has_tags.insert(input.peek(2)?.starts_with(&[ESC, SOH])),
            };
            let place = Place::Offset(input.offset());
            if input.peek(1)?.is_empty() {
                return Ok(Found::End);
            }
            let bytes = input.buffered();
            let (len, found) = match part(bytes, has_tags) {
                Part::Tag { len, content } => {
                    self.has_begun = true;
                    (len, self.tag(&content, place))
                }
                Part::Message { len, bytes: message } => {
                    self.has_begun = true;
                    let found = self.message(Bst::of(&message), place, &message);
                    // They are about what follows.
                    if has_tags {
                        for content in tags_in(&bytes[..len]) {
                            let inner = self.tag(&content, place);
                            self.waiting.extend(inner);
                        }
                    }
                    (len, Some(found))
                }
                Part::Other { len } => {
                    let other = &bytes[..len];
                    let is_text = |byte: &u8| matches!(byte, b' '..=b'~' | b'\t' | b'\r' | b'\n');
                    let found = match self.has_begun {
                        true if other.iter().all(is_text) => Found::LeftOut(TEXTS),
                        false if other.ends_with(&[DLE, ETX]) => Found::LeftOut(REST),
                        _ => Found::Issue(place, Fault::malformed(EXPECTED, other)),
                    };
                    (len, Some(found))
                }
                Part::Broken { len } => {
                    (len, Some(Found::Issue(place, Fault::malformed(EXPECTED, &bytes[..len]))))
                }
                Part::More => {
                    let len = bytes.len();
                    if input.peek(len + 1)?.len() > len {
                        continue;
                    }
                    (len, Some(Found::Issue(place, Fault::Truncated("a message"))))
                }
            };
            input.consume(len);
            self.waiting.extend(found);
        }
    }
}

#[cfg(test)]
mod tests;
