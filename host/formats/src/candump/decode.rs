//! Reading candump's log.

use std::io;

use cantap_can::{Frame, Id};

use super::super::bit_rates::{self, BitRates};
use super::super::codec::{BATCH, Decode};
use super::super::error_frames::ErrorFrames;
use super::super::found::Found;
use super::super::input::Input;
use super::super::interfaces::Interfaces;
use super::super::issue::Fault;
use super::super::seek;
use super::super::text::{self, NS_PER_S};
use super::lengths::Lengths;
use cantap_trace::fd::{FD_MAX_BYTES, FLAG_BRS, FLAG_ESI, FLAG_FDF};
use cantap_trace::socketcan::ERROR_FLAG;
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

const NO_TIMES: &str = "frames have no time: they are a list for cansend";
const LABELS: &str = "labels behind the frames, such as marks of attacks, have no place in a trace";
/// The flag of 29 bits in SocketCAN's number of an identifier.
const EXTENDED_FLAG: u32 = 0x8000_0000;
const EXPECTED: &str = "a log line such as '(1410714882.622188) can0 123#DEADBEEF'";

/// Reads the format.
#[derive(Default)]
pub(crate) struct Decoder {
    interfaces: Interfaces,
    error_frames: ErrorFrames,
    lengths: Lengths,
    /// Whether the file is a list of frames without times; `None` before its first line.
    untimed: Option<bool>,
    /// To be reported once.
    note: Option<&'static str>,
    has_labels: bool,
    /// The last line looked whole and had no line end.
    end_missing: bool,
    /// The digits and time of the last second: most lines are in the same second as the one before.
    second: [u8; 10],
    second_ns: i64,
    bit_rates: BitRates,
}

impl Decode for Decoder {
    fn bit_rates(&self) -> &[(u8, u32)] {
        &self.bit_rates
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(found) = self.error_frames.next() {
            return Ok(found);
        }
        if let Some(note) = self.note.take() {
            return Ok(Found::Note(note));
        }
        if self.untimed.is_none() {
            self.untimed = Some(is_list(input.peek(1)?));
            self.note = self.untimed.filter(|untimed| *untimed).map(|_| NO_TIMES);
        }
        while let Some(line) = input.line()? {
            let text = line.text.trim_ascii();
            if matches!(text.first(), None | Some(b'#')) && !line.too_long {
                bit_rates::learn_note(&mut self.bit_rates, text);
                continue;
            }
            let parsed = if self.untimed == Some(true) { self.untimed(text) } else { self.parse(text) };
            return Ok(match parsed {
                Ok((record, _)) if !line.terminated && self.was_cut(line.text, &record) => line.cut(),
                Ok((record, second)) => {
                    self.end_missing = !line.terminated;
                    if let Some(frame) = record.frame().filter(|frame| !frame.is_remote()) {
                        self.lengths.note(frame.id(), frame.dlc());
                    }
                    self.error_frames.keep(second.map(|event| TraceRecord { event, ..record }));
                    Found::Record(record)
                }
                Err(_) if line.terminated && is_xl(text) => Found::LeftOut("CAN XL frames"),
                Err(fault) => line.issue(fault),
            });
        }
        if std::mem::take(&mut self.end_missing) {
            return Ok(Found::Note("the last line has no end: it may have been longer"));
        }
        Ok(Found::End)
    }

    fn save(&self, state: &mut Vec<u8>) -> bool {
        let is_between = self.error_frames.is_over() && self.note.is_none() && !self.end_missing;
        is_between && seek::save(&(&self.interfaces, &self.lengths, self.untimed, &self.bit_rates), state)
    }

    fn restore(&mut self, state: &[u8]) -> Option<()> {
        (self.interfaces, self.lengths, self.untimed, self.bit_rates) = seek::load(state)?;
        Some(())
    }

    /// Lines exactly as candump writes them are read in place in the buffer; the others one by one.
    fn batch(&mut self, input: &mut Input, records: &mut Vec<TraceRecord>) -> io::Result<Option<Found>> {
        loop {
            if self.error_frames.is_empty() {
                let (mut used, mut lines) = (0, 0);
                let buffered = input.buffered();
                while records.len() < BATCH
                    && let Some((record, len)) = self.plain(&buffered[used..])
                {
                    records.push(record);
                    used += len;
                    lines += 1;
                }
                input.consume_lines(used, lines);
                if lines > 0 {
                    self.untimed = Some(false);
                }
            }
            if records.len() >= BATCH || !records.is_empty() && input.may_wait() && !input.has_line() {
                return Ok(None);
            }
            match self.next(input)? {
                Found::Record(record) => records.push(record),
                other => return Ok(Some(other)),
            }
        }
    }
}

impl Decoder {
    /// The line that `text` begins with, if it is a data frame exactly as candump writes it, with ten digits of seconds,
    /// as most lines are; and its length including the line end. All positions are fixed, so nothing is searched for.
    /// `None` is not a verdict: [`Self::parse`] then looks at the line.
    #[inline]
    pub(super) fn plain(&mut self, text: &[u8]) -> Option<(TraceRecord, usize)> {
        let (time, rest) = text.split_first_chunk::<20>()?;
        let [b'(', seconds @ .., b'.', u0, u1, u2, u3, u4, u5, b')', b' '] = time else { return None };
        let seconds: &[u8; 10] = seconds.first_chunk()?;
        if *seconds != self.second {
            // Ten digits reach beyond the year 2262, where nanoseconds no longer fit.
            self.second_ns = text::digits(seconds)?.checked_mul(NS_PER_S)?;
            self.second = *seconds;
        }
        let us = text::digits(&[*u0, *u1, *u2, *u3, *u4, *u5])?;
        let time_ns = self.second_ns.checked_add(us * 1000)?;
        let (interface, rest) = split_at_byte(rest, b' ')?;
        if interface.is_empty() {
            return None;
        }
        let (id, rest) = match rest {
            [a, b, c, d, e, f, g, h, b'#', rest @ ..] => {
                (Id::extended(text::hex(&[*a, *b, *c, *d, *e, *f, *g, *h])?)?, rest)
            }
            [a, b, c, b'#', rest @ ..] => (Id::standard(text::hex(&[*a, *b, *c])?)?, rest),
            _ => return None,
        };
        let (data, len, rest) = match rest.split_first_chunk::<16>() {
            Some((digits, rest)) if let Some(data) = text::eight_bytes(digits) => (data, 8, rest),
            _ => {
                let digits = rest.iter().take_while(|digit| text::hex_digit(**digit).is_some()).count();
                let (data, len) = bytes(&rest[..digits])?;
                (data, len, &rest[digits..])
            }
        };
        let (direction, rest) = match rest {
            [b' ', b'T', rest @ ..] => (Direction::Tx, rest),
            [b' ', b'R', rest @ ..] | rest => (Direction::Rx, rest),
        };
        let [b'\n', rest @ ..] = rest else { return None };
        // Only now: a refused line must not introduce an interface.
        let channel = self.interfaces.channel(interface);
        let frame = Frame::from_bus(id, false, len, data);
        self.lengths.note(id, len);
        let event = TraceEvent::Frame { frame: frame.into(), direction, late: false };
        Some((TraceRecord { time_ns, device_ns: None, channel, event }, text.len() - rest.len()))
    }

    /// Whether a line without its end, which reads as `record`, lost a part of it. A complete log may lack the last line
    /// end, and a cut line may look whole: what matters is whether the identifier had longer frames before.
    fn was_cut(&self, line: &[u8], record: &TraceRecord) -> bool {
        match record.frame() {
            Some(frame) if line.ends_with(b" ") || frame.is_remote() => {
                !frame.is_remote() || line.ends_with(b" ")
            }
            Some(frame) if frame.dlc() == 8 && !frame.is_fd() => false,
            // A file of a single line was hardly cut; in others an identifier rarely appears for the first time on the
            // last line.
            Some(frame) => match self.lengths.of(frame.id()) {
                Some(longest) => longest > frame.dlc(),
                None => self.lengths.any,
            },
            None => line.len() - line.iter().position(|byte| *byte == b'#').unwrap_or(0) <= 16,
        }
    }

    /// One line's record, and a second event if it contains two.
    #[inline]
    pub(super) fn parse(&mut self, line: &[u8]) -> Result<(TraceRecord, Option<TraceEvent>), Fault> {
        let malformed = || Fault::malformed(EXPECTED, line);
        let rest = line.strip_prefix(b"(").ok_or_else(malformed)?;
        let (time, rest) = split_at_byte(rest, b')').ok_or_else(malformed)?;
        // Programs that count from a trace's start put blanks before it.
        let time_ns = text::time(time.trim_ascii_start(), NS_PER_S, b'.')
            .ok_or_else(|| Fault::malformed("a time in seconds between the parentheses", time))?;
        let (interface, rest) = text::word(rest);
        let (frame, rest) = text::word(rest);
        let direction = match rest.trim_ascii() {
            b"" | b"R" | b"r" => Direction::Rx,
            b"T" | b"t" => Direction::Tx,
            label if is_label(label) => {
                if !std::mem::replace(&mut self.has_labels, true) {
                    self.note = Some(LABELS);
                }
                Direction::Rx
            }
            other => return Err(Fault::malformed("'R', 'T' or nothing after the frame", other)),
        };
        let (event, second) = self.event(frame).ok_or_else(malformed)??;
        let event = match event {
            TraceEvent::Frame { frame, late, .. } => TraceEvent::Frame { frame, direction, late },
            other => other,
        };
        let channel = self.interfaces.channel(interface);
        Ok((TraceRecord { time_ns, device_ns: None, channel, event }, second))
    }

    /// The same for a line of a list: `123#DEADBEEF`, with or without an interface or cansend before it.
    fn untimed(&mut self, line: &[u8]) -> Result<(TraceRecord, Option<TraceEvent>), Fault> {
        let malformed =
            || Fault::malformed("a frame such as '123#DEADBEEF' or 'cansend can0 123#DEADBEEF'", line);
        let (interface, frame) = untimed_parts(line).ok_or_else(malformed)?;
        let (event, second) = self.event(frame).ok_or_else(malformed)??;
        let channel = self.interfaces.channel(interface);
        Ok((TraceRecord { time_ns: 0, device_ns: None, channel, event }, second))
    }

    /// What `123#DEADBEEF` is, as received; `None` without a `#`.
    #[inline]
    fn event(&mut self, frame: &[u8]) -> Option<Result<(TraceEvent, Option<TraceEvent>), Fault>> {
        let (id, data) = split_at_byte(frame, b'#')?;
        Some(self.event_of(frame, id, data))
    }

    #[inline]
    fn event_of(
        &mut self,
        frame: &[u8],
        id: &[u8],
        data: &[u8],
    ) -> Result<(TraceEvent, Option<TraceEvent>), Fault> {
        let raw = text::hex(id).ok_or_else(|| Fault::malformed("a hexadecimal identifier", id))?;
        if id.len() == 8 && raw & ERROR_FLAG != 0 {
            let (bytes, _) = bytes(data).ok_or_else(|| Fault::malformed("up to eight data bytes", data))?;
            return Ok(self.error_frames.read(raw, bytes));
        }
        let id = match id.len() {
            3 => Id::standard(raw),
            8 => Id::extended(raw & !EXTENDED_FLAG),
            _ => None,
        };
        let id = id.ok_or_else(|| {
            Fault::malformed("an identifier of 3 digits up to 7FF or 8 up to 1FFFFFFF", frame)
        })?;
        let frame = match data {
            [b'#', fd @ ..] => flexible(id, fd).ok_or_else(|| {
                Fault::malformed("a CAN FD frame such as 123##1DEADBEEF, with a length that FD has", frame)
            })?,
            _ => payload(id, data)?.into(),
        };
        Ok((TraceEvent::Frame { frame, direction: Direction::Rx, late: false }, None))
    }
}

/// The interface and the frame of a line of a list.
fn untimed_parts(line: &[u8]) -> Option<(&[u8], &[u8])> {
    let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).peekable();
    words.next_if(|word| *word == b"cansend");
    match (words.next()?, words.next(), words.next()) {
        (frame, None, None) => Some((b"can0", frame)),
        (interface, Some(frame), None) => Some((interface, frame)),
        _ => None,
    }
}

/// Whether a word behind a frame says if it belongs to an attack, as in CAN-MIRGU and other sets of data.
fn is_label(word: &[u8]) -> bool {
    let labels = ["0", "1", "normal", "benign", "attack", "malicious", "anomaly", "injected"];
    labels.iter().any(|label| word.eq_ignore_ascii_case(label.as_bytes()))
}

/// Whether a line is one of a list of frames without times.
pub(crate) fn is_untimed(line: &[u8]) -> bool {
    let frame = untimed_parts(line).and_then(|(_, frame)| split_at_byte(frame, b'#'));
    frame.is_some_and(|(id, data)| {
        let is_data = |byte: &u8| byte.is_ascii_hexdigit() || matches!(byte, b'#' | b'.' | b'R' | b'_');
        matches!(id.len(), 3 | 8) && text::hex(id).is_some() && data.iter().all(is_data)
    })
}

/// Whether a file that begins so is such a list: a fragment of a line may look like a frame, but not the line after it.
fn is_list(head: &[u8]) -> bool {
    const ENOUGH: usize = 4;
    let lines = head.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii);
    let mut lines = lines.filter(|line| !line.is_empty() && !line.starts_with(b"#")).take(ENOUGH);
    lines.next().is_some_and(is_untimed) && lines.all(|line| !line.starts_with(b"("))
}

/// Whether a line has a CAN XL frame: three hexadecimal numbers with colons after the first `#`, then the data.
fn is_xl(line: &[u8]) -> bool {
    let (_, rest) = text::word(line);
    let (frame, _) = text::word(text::word(rest).1);
    let mut parts = frame.split(|byte| *byte == b'#');
    let (Some(priority), Some(fields), Some(_)) = (parts.next(), parts.next(), parts.next()) else {
        return false;
    };
    let fields: Vec<_> =
        fields.split(|byte| *byte == b':').map(|digits| (digits.len(), text::hex(digits))).collect();
    text::hex(priority).is_some() && matches!(fields[..], [(2, Some(_)), (2, Some(_)), (8, Some(_))])
}

/// The text before and after the first `byte`.
#[inline]
fn split_at_byte(text: &[u8], byte: u8) -> Option<(&[u8], &[u8])> {
    let at = text.iter().position(|&other| other == byte)?;
    Some((&text[..at], &text[at + 1..]))
}

/// Up to eight bytes, with or without dots between them.
#[inline]
fn bytes(mut digits: &[u8]) -> Option<([u8; 8], u8)> {
    let mut data = [0; 8];
    let mut len = 0;
    while let [high, low, rest @ ..] = digits {
        *data.get_mut(len)? = text::hex_pair(*high, *low)?;
        len += 1;
        digits = match rest {
            [b'.', more @ ..] if !more.is_empty() => more,
            _ => rest,
        };
    }
    digits.is_empty().then_some((data, len as u8))
}

/// Parses what follows `##`: a digit of flags, then the data. `None` if it is something else.
fn flexible(id: Id, text: &[u8]) -> Option<TraceFrame> {
    let (flags, mut digits) = text.split_first()?;
    let flags = text::hex_digit(*flags).filter(|flags| flags & !(FLAG_BRS | FLAG_ESI | FLAG_FDF) == 0)?;
    let mut data = [0; FD_MAX_BYTES];
    let mut len = 0;
    while let [high, low, rest @ ..] = digits {
        *data.get_mut(len)? = text::hex_pair(*high, *low)?;
        len += 1;
        digits = match rest {
            [b'.', more @ ..] if !more.is_empty() => more,
            _ => rest,
        };
    }
    if !digits.is_empty() {
        return None;
    }
    FdFrame::new(id, flags & FLAG_BRS != 0, flags & FLAG_ESI != 0, &data[..len]).map(TraceFrame::Fd)
}

/// Parses what follows `#`.
#[inline]
fn payload(id: Id, digits: &[u8]) -> Result<Frame, Fault> {
    if let Some((data, len)) = bytes(digits) {
        return Ok(Frame::from_bus(id, false, len, data));
    }
    // Remote frames and DLCs above 8 are rare: the frame's own parser handles them.
    let text = format!("{id}#{}", String::from_utf8_lossy(digits));
    text.parse().map_err(|error: cantap_can::frame::ParseFrameError| {
        Fault::malformed(format!("a frame such as 123#DEADBEEF ({error})"), text.as_bytes())
    })
}
