//! Reading ASC.

use std::io;

use cantap_can::{Frame, Id};

use super::super::bit_rates::{self, BitRates};
use super::super::codec::{Decode, REQUESTS_TO_SEND};
use super::super::event_text;
use super::super::found::Found;
use super::super::input::Input;
use super::super::issue::Fault;
use super::super::seek;
use super::super::sja1000;
use super::super::text::{self, NS_PER_S};
use super::super::zone::Zone;
use super::content::{Content, OnChannel, direction};
use super::date::{date, has_wrong_weekday};
use super::{FD_FORMAT, REMOTE, STATES, lin, others};
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

const WRONG_WEEKDAY: &str = "a date is not of the day of the week that it names; python-can before version 4 wrote the month's number in place of the day's";

/// Reads ASC.
#[derive(Default)]
pub(crate) struct Decoder {
    decimal: bool,
    relative: bool,
    /// From the `date` line.
    date_ns: i64,
    /// From the first trigger block, until the first time shows which of the two dates applies.
    block_ns: Option<i64>,
    blocks: u32,
    /// What times are added to: a date or, with relative times, the last event.
    base_ns: Option<i64>,
    /// The zone of the dates.
    zone: Zone,
    bit_rates: BitRates,
}

/// Whether `line` begins with `word`, in any case.
fn begins(line: &[u8], word: &str) -> bool {
    line.get(..word.len()).is_some_and(|start| start.eq_ignore_ascii_case(word.as_bytes()))
}

/// Whether a line is empty or the end of a block, as at the end of files.
fn is_footer(line: &[u8]) -> bool {
    line.is_empty() || begins(line, "end triggerblock")
}

impl Decoder {
    /// `zone` is the zone of the file's dates.
    pub(crate) fn new(zone: &Zone) -> Self {
        Self { zone: zone.clone(), ..Self::default() }
    }
}

impl Decode for Decoder {
    fn bit_rates(&self) -> &[(u8, u32)] {
        &self.bit_rates
    }

    fn save(&self, state: &mut Vec<u8>) -> bool {
        let Self { decimal, relative, date_ns, block_ns, blocks, base_ns, zone: _, bit_rates } = self;
        seek::save(&(decimal, relative, date_ns, block_ns, blocks, base_ns, bit_rates), state)
    }

    fn restore(&mut self, state: &[u8]) -> Option<()> {
        let Self { decimal, relative, date_ns, block_ns, blocks, base_ns, zone: _, bit_rates } = self;
        (*decimal, *relative, *date_ns, *block_ns, *blocks, *base_ns, *bit_rates) = seek::load(state)?;
        Some(())
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        while let Some(line) = input.line()? {
            let text = line.text.trim_ascii();
            match self.line(text) {
                Ok(Content::Record(record)) if !line.terminated && self.may_be_cut(text, &record) => {
                    return Ok(line.cut());
                }
                Ok(Content::Record(record)) => return Ok(Found::Record(record)),
                Ok(Content::Request) => return Ok(Found::Note(REQUESTS_TO_SEND)),
                // The beginning of an event can look like something to leave out.
                Ok(Content::LeftOut(_)) if !line.terminated => return Ok(line.cut()),
                Ok(Content::LeftOut(what)) => return Ok(Found::LeftOut(what)),
                Ok(Content::Other | Content::Note(_)) if !line.terminated && !is_footer(text) => {
                    return Ok(line.cut());
                }
                Ok(Content::Note(what)) => return Ok(Found::Note(what)),
                Ok(Content::Other) => {}
                Err(fault) => return Ok(line.issue(fault)),
            }
        }
        Ok(Found::End)
    }
}

impl Decoder {
    fn line(&mut self, line: &[u8]) -> Result<Content, Fault> {
        let (time, rest) = text::word(line);
        match text::time_of_any_mark(time, NS_PER_S) {
            Some(offset_ns) => self.event(offset_ns, rest),
            None => self.head(line),
        }
    }

    /// Handles a line that does not begin with a time.
    fn head(&mut self, line: &[u8]) -> Result<Content, Fault> {
        let note =
            |stamp| if has_wrong_weekday(stamp) { Content::Note(WRONG_WEEKDAY) } else { Content::Other };
        if begins(line, "date ") {
            self.date_ns = date(&line[5..], &self.zone)?;
            return Ok(note(&line[5..]));
        } else if begins(line, "base ") {
            let words = line.to_ascii_lowercase();
            let has = |word| memchr::memmem::find(&words, word).is_some();
            self.decimal = has(b"base dec");
            self.relative = has(b"relative");
        } else if begins(line, "begin triggerblock") {
            // Later blocks belong to the same measurement: its times continue.
            self.blocks = self.blocks.saturating_add(1);
            let stamp = line["begin triggerblock".len()..].trim_ascii();
            if self.blocks == 1 && !stamp.is_empty() {
                self.block_ns = Some(date(stamp, &self.zone)?);
                return Ok(note(stamp));
            }
        } else if line.starts_with(b"//") {
            bit_rates::learn_note(&mut self.bit_rates, line);
        } else if !(line.is_empty()
            || begins(line, "internal events")
            || begins(line, "no internal events")
            || begins(line, "end triggerblock"))
        {
            return Err(Fault::malformed("a line that begins with a time in seconds", line));
        }
        Ok(Content::Other)
    }

    /// The absolute time of an event.
    #[inline]
    fn time(&mut self, offset_ns: i64) -> i64 {
        let base_ns = match self.base_ns {
            Some(base_ns) => base_ns,
            None => self.start(offset_ns),
        };
        let time_ns = base_ns.saturating_add(offset_ns);
        if self.relative {
            self.base_ns = Some(time_ns);
        }
        time_ns
    }

    /// Chooses between the dates of the header and of the trigger block. Vector's times start at the header's
    /// date, and the block's is roughly that of its first event. python-can's header has the date when the
    /// file was written, and times start at the block's.
    fn start(&mut self, offset_ns: i64) -> i64 {
        let base_ns = match self.block_ns {
            None => self.date_ns,
            Some(block_ns) => {
                let apart_ns =
                    self.date_ns.saturating_add(offset_ns).saturating_sub(block_ns).saturating_abs();
                let from_head = offset_ns > NS_PER_S && apart_ns < offset_ns / 2;
                if from_head { self.date_ns } else { block_ns }
            }
        };
        self.base_ns = Some(base_ns);
        base_ns
    }

    #[inline]
    fn event(&mut self, offset_ns: i64, rest: &[u8]) -> Result<Content, Fault> {
        let time_ns = self.time(offset_ns);
        let (first, behind) = text::word(rest);
        if let Some(channel) = channel(first) {
            return Ok(self.classical(behind)?.on(time_ns, channel));
        }
        if let Some(channel) = lin::channel(first) {
            let identifier = |word: &[u8]| self.identifier(word).map(|(raw, _)| raw);
            return Ok(lin::line(behind, identifier, |word| self.byte(word))?.on(time_ns, channel));
        }
        if !matches!(first, b"CAN" | b"CANFD") {
            return others::kind(rest.trim_ascii());
        }
        let (second, behind) = text::word(behind);
        let channel = channel(second).ok_or_else(|| Fault::malformed("a channel of 0 to 255", second))?;
        let found = if first == b"CAN" { status(behind)? } else { self.flexible(behind)? };
        Ok(found.on(time_ns, channel))
    }

    /// An event on a classical channel, after the channel's number.
    #[inline]
    fn classical(&self, rest: &[u8]) -> Result<OnChannel, Fault> {
        let (id, rest) = text::word(rest);
        if id.eq_ignore_ascii_case(b"ErrorFrame") {
            return Ok(OnChannel::Event(error_frame(rest)));
        }
        let Some((raw, extended)) = self.identifier(id) else { return others::on_channel(id) };
        let after_id = rest;
        let (word, rest) = text::word(rest);
        let (direction, rest) = match direction(word) {
            Some(direction) => (direction, rest),
            None if word == b"TxRq" => return Ok(OnChannel::Request),
            // As scripts write it that leave the direction out.
            None if matches!(word, b"d" | b"r") => (Direction::Rx, after_id),
            None => {
                let marker = others::like_a_frame(rest).map(OnChannel::LeftOut);
                return marker.ok_or_else(|| Fault::malformed("'Rx' or 'Tx' after the identifier", word));
            }
        };
        let id = if extended { Id::extended(raw) } else { Id::standard(raw) }.ok_or_else(|| {
            Fault::malformed("an identifier up to 7FF, or up to 1FFFFFFF followed by x", id)
        })?;
        let (kind, rest) = text::word(rest);
        let (dlc, rest) = text::word(rest);
        let frame = match kind {
            b"d" | b"D" => {
                if let Some(frame) = self.long(id, dlc, rest) {
                    return Ok(OnChannel::Event(TraceEvent::Frame { frame, direction, late: false }));
                }
                let dlc = self.dlc(dlc)?;
                let len = dlc.min(8);
                let data = self.data(rest, len)?;
                Frame::from_bus(id, false, dlc, data)
            }
            b"r" | b"R" => {
                // Older files leave the length out, and others have further columns.
                let dlc = if dlc.len() == 1 { self.dlc(dlc)? } else { 0 };
                Frame::from_bus(id, true, dlc, [0; 8])
            }
            other => return Err(Fault::malformed("'d' or 'r' after the direction", other)),
        };
        Ok(OnChannel::Event(TraceEvent::Frame { frame: frame.into(), direction, late: false }))
    }

    /// A CAN FD frame among the classical ones: with its number of bytes, two digits, in place of the length code, as earlier
    /// versions of python-can wrote it, or with a decimal code, as the converters for CANedge loggers do. The bytes themselves
    /// show which.
    #[inline]
    fn long(&self, id: Id, len: &[u8], columns: &[u8]) -> Option<TraceFrame> {
        let bytes = match len {
            [_, _] if !self.decimal => text::hex(len).map(u64::from),
            [_, _] => text::decimal(len),
            _ => None,
        };
        let code = match len {
            [digit] => text::hex_digit(*digit).map(u64::from),
            _ => text::decimal(len),
        };
        let by_code = code.and_then(|code| FD_LENGTHS.get(code as usize)).map(|len| usize::from(*len));
        let lengths = [bytes.map(|len| len as usize), by_code];
        lengths.into_iter().flatten().find_map(|len| self.long_of(id, len, columns))
    }

    /// A CAN FD frame of exactly `len` bytes, more than a classical frame has.
    fn long_of(&self, id: Id, len: usize, columns: &[u8]) -> Option<TraceFrame> {
        let mut words = columns.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let mut data = [0; FD_MAX_BYTES];
        for slot in data.get_mut(..len).filter(|data| data.len() > 8)? {
            *slot = self.byte(words.next()?)?;
        }
        if words.next().is_some_and(|word| self.byte(word).is_some()) {
            return None;
        }
        FdFrame::new(id, false, false, &data[..len]).map(TraceFrame::Fd)
    }

    /// Whether a last line that looks whole but has no line end may have lost its end: any but a frame with all its
    /// bytes.
    fn may_be_cut(&self, line: &[u8], record: &TraceRecord) -> bool {
        match record.frame() {
            Some(frame) if frame.is_remote() => matches!(line.last(), Some(b'r' | b'R')),
            // What is left of a longer frame's bytes may be as many as another reading of its length asks for.
            Some(frame) => self.decimal || frame.dlc() > 8 || memchr::memmem::find(line, b"CANFD").is_some(),
            None => true,
        }
    }

    /// An event on a CAN FD channel, which may be a classical frame.
    fn flexible(&self, rest: &[u8]) -> Result<OnChannel, Fault> {
        let mut words = rest.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let mut next = || words.next().unwrap_or_default();
        let word = next();
        let direction = match direction(word) {
            Some(direction) => direction,
            None if word == b"TxRq" => return Ok(OnChannel::Request),
            None => return Err(Fault::malformed("'Rx' or 'Tx' after the channel", word)),
        };
        let word = next();
        if word.eq_ignore_ascii_case(b"ErrorFrame") {
            return Ok(OnChannel::Event(TraceEvent::BusError { kind: None, counters: None }));
        }
        let parsed = self.identifier(word);
        let id =
            parsed.and_then(|(raw, extended)| if extended { Id::extended(raw) } else { Id::standard(raw) });
        let id = id.ok_or_else(|| {
            Fault::malformed("an identifier up to 7FF, or up to 1FFFFFFF followed by x", word)
        })?;
        // An optional symbolic name, then BRS, ESI, DLC, data length, data, duration, bits, flags.
        let flag = |word: &[u8]| match word {
            b"0" => Some(false),
            b"1" => Some(true),
            _ => None,
        };
        let mut word = next();
        if flag(word).is_none() {
            word = next();
        }
        let expected = "BRS and ESI as 0 or 1, a length code and a number of bytes after the identifier";
        let brs = flag(word).ok_or_else(|| Fault::malformed(expected, word))?;
        let word = next();
        let esi = flag(word).ok_or_else(|| Fault::malformed(expected, word))?;
        let word = next();
        // Two digits are decimal ones, whatever the base.
        let dlc = match word {
            [digit] => text::hex_digit(*digit),
            _ => text::decimal(word).filter(|dlc| (10..16).contains(dlc)).map(|dlc| dlc as u8),
        };
        let dlc = dlc.ok_or_else(|| Fault::malformed(expected, word))?;
        let word = next();
        let len = text::decimal(word).filter(|len| *len <= FD_MAX_BYTES as u64);
        let len = len.ok_or_else(|| Fault::malformed(expected, word))? as usize;
        let mut data = [0; FD_MAX_BYTES];
        for slot in &mut data[..len] {
            let word = next();
            *slot = self.byte(word).ok_or_else(|| Fault::malformed(format!("{len} data bytes"), word))?;
        }
        // Duration, bits, flags and more: some programs leave them out, and what the line says at its beginning counts.
        let (_duration, _bits, word) = (next(), next(), next());
        let flags = match word {
            b"" => FD_FORMAT,
            _ => text::hex(word).ok_or_else(|| Fault::malformed("flags in hexadecimal digits", word))?,
        };
        // Some have zeros there; anything that only an FD frame has shows it too. No FD frame is a remote one.
        let remote = flags & (REMOTE | FD_FORMAT) == REMOTE;
        let frame = if !remote && (flags & FD_FORMAT != 0 || len > 8 || brs || esi) {
            let frame = FdFrame::new(id, brs, esi, &data[..len]);
            frame.filter(|_| usize::from(FD_LENGTHS[usize::from(dlc)]) == len).map(TraceFrame::Fd)
        } else {
            let frame = data.first_chunk().map(|data| Frame::from_bus(id, remote, dlc, *data));
            // A remote frame has no data, and its length is the requested one or zero.
            frame.filter(|frame| remote || frame.data_len() == len).map(TraceFrame::Classic)
        };
        let frame = frame.ok_or_else(|| {
            Fault::malformed(
                "a length code that means the number of bytes",
                format!("{dlc:x} {len}").as_bytes(),
            )
        })?;
        Ok(OnChannel::Event(TraceEvent::Frame { frame, direction, late: false }))
    }

    /// An identifier, and whether it has 29 bits: it is followed by x, or so large that it can be no other, where a script left the x out.
    #[inline]
    fn identifier(&self, word: &[u8]) -> Option<(u32, bool)> {
        let (digits, extended) = match word {
            [digits @ .., b'x' | b'X'] => (digits, true),
            _ => (word, false),
        };
        let raw = match digits.strip_prefix(b"0x") {
            Some(digits) => text::hex(digits)?,
            None if self.decimal => u32::try_from(text::decimal(digits)?).ok()?,
            None => text::hex(digits)?,
        };
        Some((raw, extended || raw > 0x7FF && digits.len() > 3))
    }

    #[inline]
    fn dlc(&self, word: &[u8]) -> Result<u8, Fault> {
        let dlc = match word {
            [digit] => text::hex_digit(*digit),
            _ if self.decimal => text::decimal(word).filter(|dlc| *dlc < 16).map(|dlc| dlc as u8),
            _ => None,
        };
        dlc.ok_or_else(|| Fault::malformed("a data length code of 0 to F", word))
    }

    #[inline]
    fn byte(&self, word: &[u8]) -> Option<u8> {
        if self.decimal {
            return text::decimal(word).and_then(|byte| u8::try_from(byte).ok());
        }
        match word {
            [high, low] => text::hex_pair(*high, *low),
            _ => None,
        }
    }

    #[inline]
    fn data(&self, columns: &[u8], len: u8) -> Result<[u8; 8], Fault> {
        let mut data = [0; 8];
        let mut rest = columns;
        for slot in &mut data[..usize::from(len)] {
            let (word, after) = text::word(rest);
            let fault = || Fault::malformed(format!("{len} data bytes"), columns.trim_ascii());
            *slot = self.byte(word).ok_or_else(fault)?;
            rest = after;
        }
        // Further columns may follow, but no byte: then the length would be wrong.
        let (word, _) = text::word(rest);
        if self.byte(word).is_some() {
            return Err(Fault::malformed(format!("{len} data bytes"), columns.trim_ascii()));
        }
        Ok(data)
    }
}

#[inline]
fn channel(word: &[u8]) -> Option<u8> {
    text::decimal(word).and_then(|channel| u8::try_from(channel).ok())
}

/// The event for what follows `ErrorFrame`.
fn error_frame(rest: &[u8]) -> TraceEvent {
    if let Some(event) = event_text::marked(rest) {
        return event;
    }
    let value = |name: &[u8]| {
        let at = memchr::memmem::find(rest, name)?;
        Some(text::word(&rest[at + name.len()..]).0)
    };
    let code = match (value(b"ECC:"), value(b" Code = 0x")) {
        (Some(bits), _) => std::str::from_utf8(bits).ok().and_then(|bits| u8::from_str_radix(bits, 2).ok()),
        (None, Some(code)) => text::hex(code).and_then(|code| u8::try_from(code).ok()),
        (None, None) => None,
    };
    TraceEvent::BusError { kind: code.and_then(sja1000::kind), counters: None }
}

/// A line that begins with `CAN` and a channel: the controller's status.
fn status(rest: &[u8]) -> Result<OnChannel, Fault> {
    let rest = rest.trim_ascii();
    let Some(status) = rest.strip_prefix(b"Status:") else {
        return others::on_channel(text::word(rest).0);
    };
    if let Some(event) = event_text::marked(status) {
        return Ok(OnChannel::Event(event));
    }
    let status = String::from_utf8_lossy(status).to_ascii_lowercase();
    if status.contains("overrun") {
        return Ok(OnChannel::Event(TraceEvent::Lost { stage: None, count: 1, at_least: true }));
    }
    // Files spell these in several ways.
    let status = status.replace("busoff", "bus off").replace("warning level", "warning limit");
    let Some((state, _)) = STATES.iter().find(|(_, text)| status.starts_with(text)) else {
        return Ok(OnChannel::LeftOut("other states of the controller"));
    };
    let counter = |name: &str| {
        let (_, rest) = status.split_once(name)?;
        rest.split_ascii_whitespace().next()?.parse().ok()
    };
    let counters = counter("txerr:").zip(counter("rxerr:"));
    Ok(OnChannel::Event(TraceEvent::State { state: *state, counters }))
}
