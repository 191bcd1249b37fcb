//! Frames as a sketch prints them to its serial port, each part behind its label: `Standard ID: 0x123  DLC: 2  Data: 0x01 0x02`. What the labels of
//! Arduino's, Teensy's and ESP-IDF's examples are is data here. Times are those that the serial monitor, the terminal or ESP-IDF's log put before a line.

mod parts;
#[cfg(test)]
mod tests;

use std::borrow::Cow;

use super::frame_fields::{FdFields, FrameFields, Payload, identifier};
use super::issue::Fault;
use super::line_clock::{LineClock, without_time};
use super::row_format::{Line, RowFormat};
use super::table;
use super::text;
use super::zone::Zone;
use cantap_trace::TraceRecord;
use cantap_trace::counted;
use parts::{Packet, Parts, bytes_of, next_line, tokens};

const NO_FRAME: &str = "lines of text without a frame";
const NO_TIMES: &str =
    "nothing shows when the frames were printed: they stand at the last time that was, or at 0";
const NO_BYTES: &str = "identifiers without data bytes behind them";
const NO_PLACE: &str = "errors that a driver printed as frames";
const CHARACTERS: &str = "data bytes were read as characters, as arduino-CAN's example prints them";
const MAY_BE_DECIMAL: &str =
    "identifiers without 0x were read as hexadecimal: nothing shows whether they are decimal";

/// Reads what was printed.
#[derive(Default)]
pub(crate) struct Decoder {
    radix: table::Radix,
    /// What a line said of the frame in the next ones.
    extended: Option<bool>,
    pending: Option<Pending>,
    /// The line `ID  DLC   DATA` was there: the three stand without labels.
    has_names: bool,
    clock: LineClock,
    /// The last line had all bytes that its length says, in two digits each.
    is_whole: bool,
    /// Bytes are printed as numbers below a line of arduino-CAN's.
    has_numbers: bool,
    noted_characters: bool,
    has_frames: bool,
    has_text: bool,
    notes: Vec<&'static str>,
    noted_times: bool,
}

/// A frame whose bytes are in the next lines.
struct Pending {
    parts: Parts<'static>,
    time_ns: i64,
    bytes: Vec<u8>,
}

/// Whether a file begins with such frames, and with nothing that contradicts them.
pub(crate) fn is_head(head: &[u8]) -> bool {
    /// What a board prints when it starts may be long.
    const HEAD_BYTES: usize = 8 << 10;
    let head = &head[..head.len().min(HEAD_BYTES)];
    let mut decoder = Decoder::default();
    let end = memchr::memrchr(b'\n', head).unwrap_or(head.len());
    decoder.begin(&head[..end]);
    let (mut frames, mut faults) = (0, 0);
    for line in head[..end].split(|byte| *byte == b'\n') {
        match decoder.line(line.trim_ascii(), &Zone::default()) {
            Ok(Line::Record(_)) => frames += 1,
            Err(_) => faults += 1,
            Ok(_) => {}
        }
    }
    frames > faults
}

impl Decoder {
    /// The frame of these parts, with all its bytes.
    fn record(&mut self, parts: &Parts<'_>, time_ns: i64, bytes: &[u8]) -> Result<Line, Fault> {
        const ERROR: u32 = 1 << 29;
        let shown = parts.id.as_deref().unwrap_or_default();
        let number = text::number(shown, self.radix.id || parts.is_decimal);
        let raw = number.ok_or_else(|| Fault::malformed("an identifier", shown))?;
        // As Linux has it, and the libraries that follow it: above the identifier are the marks of 29 bits and of a remote frame.
        let has_marks = raw > 0x1FFF_FFFF;
        if has_marks && raw & ERROR != 0 {
            return Ok(Line::LeftOut(NO_PLACE));
        }
        let marked = has_marks.then_some(raw & 1 << 31 != 0);
        let remote = parts.remote || has_marks && raw & 1 << 30 != 0;
        let raw = raw & 0x1FFF_FFFF;
        let extended = marked.or(parts.extended).unwrap_or(raw > 0x7FF);
        let id = identifier(raw, extended, shown)?;
        let bytes = if remote { &[] } else { bytes };
        // What stands behind the label is there, and is no bytes.
        let unread = parts.data.filter(|data| bytes.is_empty() && !remote && tokens(data).next().is_some());
        if let (Some(data), None) = (unread, parts.len) {
            return Err(Fault::malformed("data bytes", data));
        }
        let len = parts.len.unwrap_or(bytes.len());
        if !remote && len != bytes.len() {
            let found = counted(bytes.len(), "byte");
            return Err(Fault::malformed(format!("{len} data bytes"), found.as_bytes()));
        }
        if remote && len > 15 {
            return Err(Fault::malformed("a data length code of 0 to 15", len.to_string().as_bytes()));
        }
        let data = Payload::of(bytes).ok_or_else(|| Fault::malformed("up to 64 data bytes", shown))?;
        let fd = (!remote && len > 8).then(FdFields::default);
        let fields = FrameFields { id, remote, direction: parts.direction, len: len.min(64) as u8, fd };
        let event = fields.event(&data)?;
        if !self.clock.has_time && !std::mem::replace(&mut self.noted_times, true) {
            self.notes.push(NO_TIMES);
        }
        self.extended = None;
        self.has_frames = true;
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel: 1, event }))
    }

    /// A line of a table without labels: identifier, length and bytes.
    fn row(&mut self, line: &[u8]) -> Option<Result<Line, Fault>> {
        let mut words = tokens(line);
        let (id, len) = (words.next()?, words.next()?);
        text::number(id, false).filter(|_| id.len() <= 8)?;
        let len = text::hex(len).filter(|number| *number <= 15 && len.len() == 1)? as usize;
        let bytes = bytes_of(words, self.radix.data);
        let parts = Parts { id: Some(Cow::Borrowed(id)), len: Some(len), ..Parts::default() };
        Some(self.record(&parts, self.clock.time_ns, &bytes))
    }

    /// A line behind one that has only an identifier; `None` if it does not go on with the frame.
    fn next_of(&mut self, pending: &mut Pending, line: &[u8]) -> Option<Result<Line, Fault>> {
        if let (true, Some(len)) = (pending.parts.is_packet, pending.parts.len) {
            return Some(self.packet(pending, len, line));
        }
        let (bytes, is_last) = next_line(line, pending.bytes.len(), self.radix.data)?;
        pending.bytes.extend(bytes);
        let is_last = match pending.parts.len {
            Some(len) => pending.bytes.len() >= len,
            None => is_last,
        };
        if !is_last {
            return Some(Ok(Line::Nothing));
        }
        Some(self.record(&pending.parts, pending.time_ns, &pending.bytes))
    }

    /// The line below one of arduino-CAN's.
    fn packet(&mut self, pending: &Pending, len: usize, line: &[u8]) -> Result<Line, Fault> {
        let bytes = match Packet::of(line, len, self.radix.data) {
            Some(Packet::Numbers(bytes)) => bytes,
            Some(Packet::Either(byte)) if self.has_numbers => vec![byte],
            Some(Packet::Either(_) | Packet::Characters) => {
                if !std::mem::replace(&mut self.noted_characters, true) {
                    self.notes.push(CHARACTERS);
                }
                line.to_vec()
            }
            None => return Err(Fault::malformed(format!("{len} data bytes"), line)),
        };
        self.record(&pending.parts, pending.time_ns, &bytes)
    }

    /// What is said of a frame of which no more came: with a single byte on each line, the first line of something else ends it.
    fn end(&mut self, pending: &Pending) -> Result<Option<TraceRecord>, Fault> {
        if !pending.bytes.is_empty() && pending.parts.len.is_none() {
            return self.record(&pending.parts, pending.time_ns, &pending.bytes).map(|line| match line {
                Line::Record(record) => Some(record),
                _ => None,
            });
        }
        if let Some(len) = pending.parts.len {
            return Err(Fault::malformed(format!("{len} data bytes behind the identifier"), b""));
        }
        self.notes.push(NO_BYTES);
        Ok(None)
    }

    fn labelled(&mut self, line: &[u8]) -> Result<Line, Fault> {
        if let Some(extended) = parts::says_format(line) {
            self.extended = Some(extended);
            return Ok(Line::Nothing);
        }
        if parts::are_names(line) {
            self.has_names = true;
            return Ok(Line::Nothing);
        }
        let mut parts = Parts::of(line);
        if parts.id.is_none() {
            let row = if self.has_names { self.row(line) } else { None };
            return row.unwrap_or(Ok(Line::LeftOut(NO_FRAME)));
        }
        parts.extended = parts.extended.or(self.extended);
        let is_number = parts.id.as_deref().is_some_and(|id| text::number(id, false).is_some());
        match parts.data {
            Some(data) => {
                let words: Vec<_> = tokens(data).collect();
                let bytes = bytes_of(words.iter().copied(), self.radix.data);
                self.is_whole = parts.len == Some(bytes.len())
                    && words.last().is_some_and(|word| text::after_0x(word).unwrap_or(word).len() == 2);
                self.record(&parts, self.clock.time_ns, &bytes)
            }
            None if parts.remote || parts.len == Some(0) => self.record(&parts, self.clock.time_ns, &[]),
            None if is_number => {
                let parts = parts.into_owned();
                self.pending = Some(Pending { parts, time_ns: self.clock.time_ns, bytes: Vec::new() });
                Ok(Line::Nothing)
            }
            None => Ok(Line::LeftOut(NO_FRAME)),
        }
    }
}

impl RowFormat for Decoder {
    fn begin(&mut self, buffered: &[u8]) {
        let (mut ids, mut bytes) = (Vec::new(), Vec::new());
        let (mut has_names, mut waits) = (false, false);
        let mut lists = Vec::new();
        let mut packet = None;
        for line in buffered.split(|byte| *byte == b'\n') {
            let rest = without_time(line.trim_ascii());
            if let Some(len) = packet.take() {
                self.has_numbers |= matches!(Packet::of(rest, len, false), Some(Packet::Numbers(_)));
                continue;
            }
            let parts = Parts::of(rest);
            packet = parts.len.filter(|len| parts.is_packet && !parts.remote && *len > 0);
            if let (Some(Cow::Borrowed(id)), false) = (&parts.id, parts.is_decimal) {
                ids.push(*id);
            }
            has_names |= parts::are_names(rest);
            let skipped = if has_names && !waits { 2 } else { 0 };
            let here = if parts.id.is_some() || !has_names && !waits {
                parts.data
            } else {
                parts::plain_bytes(rest)
            };
            lists.extend(here.and_then(parts::list));
            bytes.extend(here.into_iter().flat_map(tokens).skip(skipped));
            waits = parts.id.is_some() && parts.data.is_none();
        }
        let (is_decimal, is_sure) = table::ids_are_decimal(&ids);
        if !is_sure {
            self.notes.push(MAY_BE_DECIMAL);
        }
        let data = bytes.iter().any(|byte| byte.len() == 3 && text::decimal(byte).is_some())
            || table::lists_are_decimal(&lists);
        self.radix = table::Radix { id: is_decimal, data, ..table::Radix::default() };
    }

    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        self.is_whole = false;
        let line = parts::without_colours(line);
        let rest = self.clock.take(&line, zone);
        if let Some(mut pending) = self.pending.take() {
            if let Some(next) = self.next_of(&mut pending, rest) {
                if matches!(next, Ok(Line::Nothing)) {
                    self.pending = Some(pending);
                }
                return next;
            }
            let ended = self.end(&pending);
            return match (ended, self.labelled(rest)) {
                (Ok(Some(first)), Ok(Line::Record(second))) => Ok(Line::Two(first, second.event)),
                (Ok(Some(first)), Ok(_)) => Ok(Line::Record(first)),
                (Ok(None), other) => other,
                (Err(_), Ok(Line::Record(record))) => {
                    self.notes.push(NO_BYTES);
                    Ok(Line::Record(record))
                }
                (Err(fault), _) | (_, Err(fault)) => Err(fault),
            };
        }
        if rest.is_empty() || rest.starts_with(b"#") {
            return Ok(Line::Nothing);
        }
        self.has_text = true;
        self.labelled(rest)
    }

    fn may_be_cut(&self, _line: &[u8], _record: &TraceRecord) -> bool {
        !self.is_whole
    }

    fn note(&mut self) -> Option<&'static str> {
        self.notes.pop()
    }

    fn missing(&self) -> Option<&'static str> {
        match &self.pending {
            Some(_) => Some("the last frame's data bytes"),
            // Text alone is not a trace that was read.
            None => (self.has_text && !self.has_frames).then_some("a frame with labels such as ID and Data"),
        }
    }
}
