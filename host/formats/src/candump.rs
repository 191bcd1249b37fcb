//! can-utils' log format, as `candump -l` writes it: `(1410714882.622188) can0 09F80102#36729A16`, with
//! an optional ` R` or ` T` for the direction. Times have microseconds; error frames follow
//! SocketCAN.

use std::io;

use cantap_wire::{Frame, Id};

use super::codec::{BATCH, Decode, Encode};
use super::error_frames::ErrorFrames;
use super::found::Found;
use super::input::Input;
use super::interfaces::Interfaces;
use super::issue::Fault;
use super::left_out::LeftOut;
use super::line::{Line, Seconds};
use super::text::{self, NS_PER_S};
use cantap_trace::fd::{FD_MAX_BYTES, FLAG_BRS, FLAG_ESI, FLAG_FDF};
use cantap_trace::socketcan::{BUS_ERROR, ERROR_FLAG, ErrorFrame};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

const EXPECTED: &str = "a log line such as '(1410714882.622188) can0 123#DEADBEEF'";

/// Reads the format.
#[derive(Default)]
pub(crate) struct Decoder {
    interfaces: Interfaces,
    error_frames: ErrorFrames,
    lengths: Lengths,
    /// The last line looked whole and had no line end.
    end_missing: bool,
    /// The last second's digits and time: most lines are in the same second as the one before.
    second: [u8; 10],
    second_ns: i64,
}

impl Decode for Decoder {
    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(found) = self.error_frames.next() {
            return Ok(found);
        }
        while let Some(line) = input.line()? {
            let text = line.text.trim_ascii();
            if matches!(text.first(), None | Some(b'#')) && !line.too_long {
                continue;
            }
            return Ok(match self.parse(text) {
                Ok((record, _)) if !line.terminated && self.was_cut(line.text, &record) => line.cut(),
                Ok((record, second)) => {
                    self.end_missing = !line.terminated;
                    if let Some(frame) = record.frame().filter(|frame| !frame.is_remote()) {
                        self.lengths.note(frame.id(), frame.dlc());
                    }
                    self.error_frames.keep(second.map(|event| TraceRecord { event, ..record }));
                    Found::Record(record)
                }
                Err(fault) => line.issue(fault),
            });
        }
        if std::mem::take(&mut self.end_missing) {
            return Ok(Found::Note("the last line has no end: it may have been longer"));
        }
        Ok(Found::End)
    }

    /// Lines exactly as candump writes them are read where they are in the buffer; the others one by one.
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
    /// as most lines are, and its length with its end. Everything is at its place, so nothing is searched for. `None` is
    /// no verdict: [`Self::parse`] looks at the line then.
    #[inline]
    fn plain(&mut self, text: &[u8]) -> Option<(TraceRecord, usize)> {
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
        // Only now: a line that is refused must not name an interface.
        let channel = self.interfaces.channel(interface);
        let frame = Frame::from_bus(id, false, len, data);
        self.lengths.note(id, len);
        let event = TraceEvent::Frame { frame: frame.into(), direction, late: false };
        Some((TraceRecord { time_ns, channel, event }, text.len() - rest.len()))
    }

    /// Whether a line without its end, which reads as `record`, lost a part of it. A complete log may lack the last line
    /// end, and a cut line may look whole: what counts is whether the identifier had longer frames before.
    fn was_cut(&self, line: &[u8], record: &TraceRecord) -> bool {
        match record.frame() {
            Some(frame) if line.ends_with(b" ") || frame.is_remote() => {
                !frame.is_remote() || line.ends_with(b" ")
            }
            Some(frame) if frame.dlc() == 8 && !frame.is_fd() => false,
            // A file of one line was hardly cut; in others an identifier seldom comes for the first time in the last one.
            Some(frame) => match self.lengths.of(frame.id()) {
                Some(longest) => longest > frame.dlc(),
                None => self.lengths.any,
            },
            None => line.len() - line.iter().position(|byte| *byte == b'#').unwrap_or(0) <= 16,
        }
    }

    /// One line's record, and a second event if it says two things.
    #[inline]
    fn parse(&mut self, line: &[u8]) -> Result<(TraceRecord, Option<TraceEvent>), Fault> {
        let malformed = || Fault::malformed(EXPECTED, line);
        let rest = line.strip_prefix(b"(").ok_or_else(malformed)?;
        let (time, rest) = split_at_byte(rest, b')').ok_or_else(malformed)?;
        let time_ns = text::time(time, NS_PER_S, b'.')
            .ok_or_else(|| Fault::malformed("a time in seconds between the parentheses", time))?;
        let (interface, rest) = text::word(rest);
        let (frame, rest) = text::word(rest);
        let (id, data) = split_at_byte(frame, b'#').ok_or_else(malformed)?;
        let direction = match rest.trim_ascii() {
            b"" | b"R" | b"r" => Direction::Rx,
            b"T" | b"t" => Direction::Tx,
            other => return Err(Fault::malformed("'R', 'T' or nothing behind the frame", other)),
        };
        let raw = text::hex(id).ok_or_else(|| Fault::malformed("a hexadecimal identifier", id))?;
        let channel = self.interfaces.channel(interface);
        if id.len() == 8 && raw & ERROR_FLAG != 0 {
            let (bytes, _) = bytes(data).ok_or_else(|| Fault::malformed("up to eight data bytes", data))?;
            let (event, second) = self.error_frames.read(raw, bytes);
            return Ok((TraceRecord { time_ns, channel, event }, second));
        }
        let id = match id.len() {
            3 => Id::standard(raw),
            8 => Id::extended(raw),
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
        let event = TraceEvent::Frame { frame, direction, late: false };
        Ok((TraceRecord { time_ns, channel, event }, None))
    }
}

/// How long the longest data frames of recent identifiers were.
struct Lengths {
    places: Box<[(u32, u8); Self::PLACES]>,
    /// There was a data frame.
    any: bool,
}

impl Lengths {
    /// More identifiers than most buses have, and little enough for the processor's cache.
    const PLACES: usize = 512;
    const EXTENDED: u32 = 1 << 31;

    #[inline]
    fn key(id: Id) -> (usize, u32) {
        let raw = id.raw();
        let place = (raw ^ raw >> 9 ^ raw >> 18) as usize % Self::PLACES;
        (place, raw | if id.is_extended() { Self::EXTENDED } else { 0 })
    }

    #[inline]
    fn note(&mut self, id: Id, dlc: u8) {
        let (place, key) = Self::key(id);
        let (known, longest) = &mut self.places[place];
        *longest = if *known == key { dlc.max(*longest) } else { dlc };
        *known = key;
        self.any = true;
    }

    fn of(&self, id: Id) -> Option<u8> {
        let (place, key) = Self::key(id);
        let (known, len) = self.places[place];
        (known == key).then_some(len)
    }
}

impl Default for Lengths {
    fn default() -> Self {
        // No identifier has these bits.
        Self { places: Box::new([(u32::MAX, 0); Self::PLACES]), any: false }
    }
}

/// What stands before and after the first `byte`.
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

/// What follows the `##`: a digit of flags, then the data. `None` if it is not that.
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

/// What follows the `#`.
#[inline]
fn payload(id: Id, digits: &[u8]) -> Result<Frame, Fault> {
    if let Some((data, len)) = bytes(digits) {
        return Ok(Frame::from_bus(id, false, len, data));
    }
    // Remote frames and DLCs above 8 are rare: the frame's own text form understands them.
    let text = format!("{id}#{}", String::from_utf8_lossy(digits));
    text.parse().map_err(|error: cantap_wire::frame::ParseFrameError| {
        Fault::malformed(format!("a frame such as 123#DEADBEEF ({error})"), text.as_bytes())
    })
}

/// Writes the format.
pub(crate) struct Encoder {
    seconds: Seconds<0>,
}

impl Default for Encoder {
    fn default() -> Self {
        Self { seconds: Seconds::new() }
    }
}

impl Encode for Encoder {
    #[inline]
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        let mut line = Line::new();
        if record.time_ns >= 0 {
            line.put(b"(");
            self.seconds.put(&mut line, record.time_ns as u64 / 1000);
        } else {
            out.push(b'(');
            text::push_time(out, record.time_ns, NS_PER_S, 6, b'.');
        }
        if record.channel == 0 {
            line.put(b") channel0");
        } else {
            line.put(b") can");
            line.put_small(record.channel - 1);
        }
        line.put(b" ");
        match &record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                match frame {
                    TraceFrame::Classic(frame) => put_frame(&mut line, frame),
                    TraceFrame::Fd(frame) => {
                        put_id(&mut line, frame.id());
                        line.put(b"##");
                        line.put_hex(u32::from(frame.flags()));
                        // Longer than a line that is built in place.
                        std::mem::replace(&mut line, Line::new()).end(out);
                        frame.data().iter().for_each(|byte| text::push_hex_byte(out, *byte));
                    }
                }
                if *direction == Direction::Tx {
                    line.put(b" T");
                }
            }
            event => {
                // Every event but a frame has an error frame. python-can takes one without this class for
                // a frame on the bus; bus-off stays as the kernel has it all the same.
                if let Some(ErrorFrame { classes, data }) = ErrorFrame::of(event) {
                    let is_bus_off = classes & cantap_trace::socketcan::BUS_OFF != 0;
                    let class = if is_bus_off { 0 } else { BUS_ERROR };
                    line.put(&text::hex_digits_of(ERROR_FLAG | class | classes));
                    line.put(b"#");
                    line.put(&text::hex_digits_of_eight(data));
                }
            }
        }
        line.put(b"\n");
        line.end(out);
    }

    fn finish(&mut self, _out: &mut Vec<u8>, _left_out: &mut LeftOut) {}
}

/// `123#DEADBEEF`.
#[inline]
fn put_frame(line: &mut Line, frame: &Frame) {
    put_id(line, frame.id());
    line.put(b"#");
    if frame.is_remote() {
        line.put(b"R");
        if frame.dlc() > 0 {
            line.put(&[b'0' + frame.dlc().min(8)]);
        }
    }
    line.put_start(&text::hex_digits_of_eight(frame.padded_data()), 2 * frame.data_len());
    if frame.dlc() > 8 {
        line.put(b"_");
        line.put_hex(u32::from(frame.dlc()));
    }
}

/// Three digits or eight.
#[inline]
fn put_id(line: &mut Line, id: Id) {
    let digits = text::hex_digits_of(id.raw());
    if id.is_extended() {
        line.put(&digits);
    } else {
        line.put(&[digits[5], digits[6], digits[7]]);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;
    use cantap_trace::testing::record_or_fd;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_trace_round_trips(records in prop::collection::vec(record_or_fd(1000), 0..20)) {
            prop_assert_eq!(tests::round_trip(Format::Candump, &records), records);
        }

        #[test]
        fn the_short_way_agrees_with_the_long_one(
            line in "\\([0-9]{9,11}[.,][0-9]{5,7}\\) (can0|x|) ?([0-7]?[0-9A-Fa-f]{2}|[012][0-9A-F]{7})#([0-9A-Fa-fR]{2}){0,9}( [RTQ])?",
        ) {
            let (mut short, mut long) = (super::Decoder::default(), super::Decoder::default());
            if let Some((record, len)) = short.plain(format!("{line}\n(").as_bytes()) {
                prop_assert_eq!(len, line.len() + 1);
                prop_assert_eq!(long.parse(line.as_bytes()).ok(), Some((record, None)));
            }
        }
    }

    #[test]
    fn a_time_beyond_nanoseconds_is_refused_and_not_wrapped() {
        let (records, issues) = tests::read(Format::Candump, "(9999999999.000000) can0 123#11\n");
        assert_eq!((records.len(), issues.len()), (0, 1));
    }

    #[test]
    fn ordinary_lines_go_the_short_way() {
        for frame in ["09F80102#36729A16021AB80D", "123#", "7FF#11 R", "000#0102030405060708 T"] {
            let line = format!("(1410714882.622188) can0 {frame}\n");
            let record = super::Decoder::default().plain(line.as_bytes()).map(|(record, _)| record);
            assert_eq!(record, tests::read(Format::Candump, line.as_str()).0.first().copied(), "{frame}");
            assert!(record.is_some(), "{frame}");
        }
    }

    /// A complete log may lack its last line end; a cut line can look whole.
    #[test]
    fn a_last_line_without_its_end_counts_unless_the_identifier_had_longer_frames() {
        // The last frame before was a short one; what counts is the longest.
        let before = "(1.000000) can0 123#DEADBEEF\n(2.000000) can0 456#\n(2.000000) can0 123#DE\n";
        for (last, records, issues) in [
            ("(3.000000) can0 123#DEADBEEF", 3, 0),
            ("(3.000000) can0 123#DEAD", 2, 1),
            ("(3.000000) can0 123#DEADB", 2, 1),
            ("(3.000000) can0 456#DE", 3, 0),
            ("(3.000000) can0 789#DE", 2, 1),
            ("(3.000000) can0 789#1122334455667788", 3, 0),
            ("(3.000000) can0 123##1DEADBEEF", 3, 0),
            ("(3.000000) can0 123##1DEADBE", 2, 1),
            ("(3.000000) can0 123#R", 3, 0),
            ("(3.000000) can0 123#DEADBEEF ", 2, 1),
            ("(3.000000) can0 20000004#0001", 2, 1),
            ("(3.000000) ca", 2, 1),
        ] {
            let (got, told) = tests::read(Format::Candump, format!("{before}{last}"));
            assert_eq!((got.len(), told.len()), (records + 1, issues), "{last}: {told:?}");
            assert!(
                told.iter().all(|issue| issue.contains("line 4: the file ends inside a line")),
                "{told:?}"
            );
        }
    }

    #[test]
    fn a_change_of_state_and_a_channel_0_stay_what_they_are() {
        let log =
            "(1.000000) can0 20000040#0000000000000000\n(2.000000) channel0 123#11\n(3.000000) can0 123#11\n";
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(records.iter().map(|record| record.channel).collect::<Vec<_>>(), [1, 0, 1]);
        assert_eq!(tests::write(Format::Candump, &records), log);
        assert_eq!(tests::round_trip(Format::Pcapng, &records), records);
        assert_eq!(tests::round_trip(Format::Asc, &records), records);
        assert_eq!(tests::round_trip(Format::Blf, &records), records);
    }

    #[test]
    fn an_over_long_line_is_one_issue_and_the_next_has_its_number() {
        let log = format!("(1.0) can0 123#11\n{}\nrubbish\n(2.0) can0 123#11\n", "x".repeat(9 << 20));
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!(records.len(), 2);
        assert_eq!(issues.len(), 2);
        assert!(
            issues[0].starts_with("test, line 2: ") && issues[1].starts_with("test, line 3: "),
            "{issues:?}"
        );
    }

    #[test]
    fn lines_are_what_candump_writes() {
        let log = "(1410714882.622188) can0 09F80102#36729A16021AB80D\n\
                   (0.000000) can1 123#R3\n\
                   (1.000001) can0 123# T\n\
                   (1.000001) can0 7FF#1122334455667788_F\n\
                   (1.000002) can0 7FF##3112233445566778899AABBCC T\n\
                   (1.000003) can0 18DAF110##0\n\
                   (-0.500000) can0 000#00\n";
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Candump, &records), log);
    }

    #[test]
    fn broken_lines_are_named_and_the_rest_is_read() {
        let log = "# a comment\n\n(1.0) can0 123#11\n(x) can0 123#11\nnonsense\n(2.0) can0 123##111111111111111111\n\
                   (2.0) can0 800#\n(2.0) can0 123#1\n(2.0) can0 123#11 Q\r\n(3.0) can0 123#5.6\n(4) can3 123#r";
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!(records.len(), 2);
        assert_eq!(
            issues,
            [
                "test, line 4: expected a time in seconds between the parentheses, found 'x'",
                "test, line 5: expected a log line such as '(1410714882.622188) can0 123#DEADBEEF', found 'nonsense'",
                "test, line 6: expected a CAN FD frame such as 123##1DEADBEEF, with a length that FD has, found '123##111111111111111111'",
                "test, line 7: expected an identifier of 3 digits up to 7FF or 8 up to 1FFFFFFF, found '800#'",
                "test, line 8: expected a frame such as 123#DEADBEEF (the data must be pairs of hexadecimal digits, with '.' between pairs if you like), found '123#1'",
                "test, line 9: expected 'R', 'T' or nothing behind the frame, found 'Q'",
                "test, line 10: expected a frame such as 123#DEADBEEF (the data must be pairs of hexadecimal digits, with '.' between pairs if you like), found '123#5.6'",
            ]
        );
    }
}
