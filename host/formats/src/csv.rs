//! CSV in three dialects; reading takes the dialect from the head.
//!
//! python-can's (`timestamp,arbitration_id,extended,remote,error,dlc,data`) has no place for channel and direction;
//! everything that is not a frame is an error row with SocketCAN's classes and bytes. Our own is for
//! people and spreadsheets and carries everything. The earlier CANanalyser's is in
//! [`analyser`](super::analyser).

use std::collections::VecDeque;
use std::io;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use cantap_wire::{Frame, Id};

use super::analyser;
use super::codec::{Decode, Encode};
use super::error_frames::ErrorFrames;
use super::event_text::EventText;
use super::found::{Found, Row};
use super::gvret;
use super::input::Input;
use super::issue::{Fault, Place};
use super::left_out::LeftOut;
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};
use cantap_trace::socketcan::ErrorFrame;
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

/// Which columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum CsvDialect {
    /// As python-can writes and reads it.
    PythonCan,
    /// Ours: everything, for people and spreadsheets.
    Full,
    /// The earlier CANanalyser's.
    Analyser,
    /// SavvyCAN's.
    Gvret,
}

const PYTHON_CAN_HEAD: &str = "timestamp,arbitration_id,extended,remote,error,dlc,data";
/// Types of CAN FD frames in our own dialect, by their flags.
const FD_KINDS: [&str; 4] = ["fd", "fd-brs", "fd-esi", "fd-brs-esi"];
const FULL_HEAD: &str = "time,channel,direction,type,id,dlc,data,event";

/// Reads any dialect.
#[derive(Default)]
pub(crate) struct Decoder {
    dialect: Option<CsvDialect>,
    analyser: analyser::RowDecoder,
    gvret: gvret::RowDecoder,
    /// Lines before the head that may be the analyser's comments: what is wrong if they are not.
    no_head: VecDeque<(Place, Fault)>,
    error_frames: ErrorFrames,
}

impl Decoder {
    /// With the zone of the file's date, if it has one.
    pub(crate) fn new(zone: &Zone) -> Self {
        Self { analyser: analyser::RowDecoder::new(zone), ..Self::default() }
    }
}

impl Decode for Decoder {
    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(found) = self.error_frames.next() {
            return Ok(found);
        }
        // Too many for comments, or in front of a head that has none.
        if (self.dialect.is_some() || self.no_head.len() > MAX_COMMENTS)
            && let Some((place, fault)) = self.no_head.pop_front()
        {
            return Ok(Found::Issue(place, fault));
        }
        while let Some(line) = input.line()? {
            let text = line.text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(line.text).trim_ascii();
            if text.is_empty() {
                continue;
            }
            let result = match self.dialect {
                None => self.head(text),
                Some(CsvDialect::PythonCan) => python_can(text, &mut self.error_frames),
                Some(CsvDialect::Full) => full(text).map(|record| Some((record, None))),
                Some(CsvDialect::Analyser) => self.analyser.line(text, line.terminated),
                Some(CsvDialect::Gvret) => self.gvret.line(text),
            };
            if !line.terminated && self.may_be_cut(text, &result) {
                return Ok(line.cut());
            }
            match result {
                Ok(Some((record, second))) => {
                    self.error_frames.keep(second.map(|event| TraceRecord { event, ..record }));
                    return Ok(Found::Record(record));
                }
                Ok(None) => {}
                Err(fault) if self.dialect.is_none() => {
                    // The analyser's file begins with comments; they are told from damage by the head behind them.
                    self.no_head.push_back((Place::Line(line.number), fault));
                    if self.no_head.len() > MAX_COMMENTS
                        && let Some((place, fault)) = self.no_head.pop_front()
                    {
                        return Ok(Found::Issue(place, fault));
                    }
                }
                Err(fault) => return Ok(line.issue(fault)),
            }
        }
        Ok(self.no_head.pop_front().map_or(Found::End, |(place, fault)| Found::Issue(place, fault)))
    }
}

/// More lines than this before the head are no comments.
const MAX_COMMENTS: usize = 100;

impl Decoder {
    /// Whether a last row that looks whole, and has no line end, may have lost the end of what it says.
    fn may_be_cut(&self, row: &[u8], read: &Result<Row, Fault>) -> bool {
        let Ok(Some((TraceRecord { event, .. }, _))) = read else { return false };
        let is_frame = matches!(event, TraceEvent::Frame { .. });
        match self.dialect {
            Some(CsvDialect::Full) => !is_frame || !(row.ends_with(b",") || row.ends_with(b",late")),
            Some(CsvDialect::PythonCan) => !is_frame && !row.ends_with(b"="),
            // Its rows end with a comma.
            Some(CsvDialect::Gvret) => !row.ends_with(b","),
            Some(CsvDialect::Analyser) | None => false,
        }
    }

    fn head(&mut self, line: &[u8]) -> Result<Row, Fault> {
        if line == PYTHON_CAN_HEAD.as_bytes() {
            self.dialect = Some(CsvDialect::PythonCan);
        } else if line == FULL_HEAD.as_bytes() {
            self.dialect = Some(CsvDialect::Full);
        } else if self.gvret.head(line) {
            self.dialect = Some(CsvDialect::Gvret);
        } else if self.analyser.head(line) {
            self.dialect = Some(CsvDialect::Analyser);
            self.no_head.clear();
        } else {
            // Without its head a table is most likely one of python-can's columns, cut out of a file.
            let row = python_can(line, &mut self.error_frames);
            if row.is_ok() {
                self.dialect = Some(CsvDialect::PythonCan);
                return row;
            }
            let expected = format!("a head such as {PYTHON_CAN_HEAD}, {FULL_HEAD} or Index;TimeStamps;…");
            return Err(Fault::malformed(expected, line));
        }
        Ok(None)
    }
}

/// Splits a row into `N` columns.
fn columns<const N: usize>(line: &[u8]) -> Result<[&[u8]; N], Fault> {
    let mut columns: [&[u8]; N] = [b""; N];
    let mut count = 0;
    for column in line.split(|byte| *byte == b',') {
        if let Some(slot) = columns.get_mut(count) {
            *slot = column.trim_ascii();
        }
        count += 1;
    }
    if count == N { Ok(columns) } else { Err(Fault::malformed(format!("{N} columns"), line)) }
}

/// A column that says yes or no.
fn flag(word: &[u8]) -> Result<bool, Fault> {
    match word {
        b"0" | b"False" | b"false" => Ok(false),
        b"1" | b"True" | b"true" => Ok(true),
        other => Err(Fault::malformed("0 or 1 as a flag", other)),
    }
}

fn python_can(line: &[u8], error_frames: &mut ErrorFrames) -> Result<Row, Fault> {
    let [time, id, extended, remote, error, dlc, data] = columns(line)?;
    let time_ns = python_time(time).ok_or_else(|| Fault::malformed("a time in seconds", time))?;
    let digits = id.strip_prefix(b"0x").unwrap_or(id);
    let raw = text::hex(digits).ok_or_else(|| Fault::malformed("an identifier such as 0x123", id))?;
    let bytes = decode_base64(data).ok_or_else(|| Fault::malformed("up to 64 bytes in base64", data))?;
    let mut padded = [0; 8];
    let present = bytes.len().min(8);
    padded[..present].copy_from_slice(&bytes[..present]);
    let record = |event| TraceRecord { time_ns, channel: 1, event };
    let [extended, remote, error] = [flag(extended)?, flag(remote)?, flag(error)?];
    if error {
        let (event, second) = error_frames.read(raw, padded);
        return Ok(Some((record(event), second)));
    }
    let parsed = if extended { Id::extended(raw) } else { Id::standard(raw) };
    let parsed = parsed.ok_or_else(|| Fault::malformed("an identifier that fits its format", id))?;
    let number = text::decimal(dlc).ok_or_else(|| Fault::malformed("a length", dlc))?;
    let data_event =
        |frame| Ok(Some((record(TraceEvent::Frame { frame, direction: Direction::Rx, late: false }), None)));
    // There is no column for FD: a longer frame is one, and only that much is known of it.
    if bytes.len() > 8
        && !remote
        && number == bytes.len() as u64
        && let Some(frame) = FdFrame::new(parsed, false, false, &bytes)
    {
        return data_event(TraceFrame::Fd(frame));
    }
    if bytes.len() > 8 || number > 15 {
        return Err(Fault::malformed("a length that CAN or CAN FD has, and as many bytes", line));
    }
    let expected = number.min(8) as usize;
    if !remote && present != expected {
        return Err(Fault::malformed(format!("{expected} data bytes"), data));
    }
    let frame = Frame::from_bus(parsed, remote, number as u8, padded);
    data_event(frame.into())
}

/// A time as Python writes a float: `1.5`, and for small ones `9.7e-05`.
fn python_time(time: &[u8]) -> Option<i64> {
    if let Some(ns) = text::time(time, NS_PER_S, b'.') {
        return Some(ns);
    }
    let seconds: f64 = std::str::from_utf8(time).ok()?.parse().ok()?;
    let ns = (seconds * 1e9).round();
    (ns.abs() < 9e18).then_some(ns as i64)
}

fn full(line: &[u8]) -> Result<TraceRecord, Fault> {
    let [time, channel, direction, kind, id, dlc, data, event] = columns(line)?;
    let time_ns =
        text::time(time, NS_PER_S, b'.').ok_or_else(|| Fault::malformed("a time in seconds", time))?;
    let channel = text::decimal(channel)
        .and_then(|channel| u8::try_from(channel).ok())
        .ok_or_else(|| Fault::malformed("a channel of 1 to 255", channel))?;
    let event_text = std::str::from_utf8(event).unwrap_or_default();
    if kind == b"event" {
        let parsed = event_text.parse::<EventText>();
        let EventText(event) =
            parsed.map_err(|_| Fault::malformed("an event such as 'lost 5 queue'", event))?;
        return Ok(TraceRecord { time_ns, channel, event });
    }
    let fd = FD_KINDS.iter().position(|known| known.as_bytes() == kind);
    let remote = match kind {
        b"data" => false,
        b"remote" => true,
        _ if fd.is_some() => false,
        other => {
            return Err(Fault::malformed(
                "a type: data, remote, fd, fd-brs, fd-esi, fd-brs-esi or event",
                other,
            ));
        }
    };
    let direction = match direction {
        b"Rx" => Direction::Rx,
        b"Tx" => Direction::Tx,
        other => return Err(Fault::malformed("'Rx' or 'Tx'", other)),
    };
    let fault = || Fault::malformed("an identifier of 3 digits up to 7FF or 8 up to 1FFFFFFF", id);
    let parsed = std::str::from_utf8(id).ok().and_then(|id| id.parse::<Id>().ok()).ok_or_else(fault)?;
    let number = text::decimal(dlc)
        .filter(|dlc| *dlc <= 15)
        .ok_or_else(|| Fault::malformed("a data length code of 0 to 15", dlc))? as u8;
    let expected = match fd {
        _ if remote => 0,
        Some(_) => usize::from(FD_LENGTHS[usize::from(number)]),
        None => usize::from(number.min(8)),
    };
    let mut bytes = [0; FD_MAX_BYTES];
    let pairs = data.chunks(2).map(|pair| match pair {
        [high, low] => text::hex_pair(*high, *low),
        _ => None,
    });
    let wrong = || Fault::malformed(format!("{expected} data bytes"), data);
    if data.len() != 2 * expected {
        return Err(wrong());
    }
    for (slot, byte) in bytes.iter_mut().zip(pairs) {
        *slot = byte.ok_or_else(wrong)?;
    }
    let frame = match fd {
        Some(flags) => {
            FdFrame::new(parsed, flags & 1 != 0, flags & 2 != 0, &bytes[..expected]).map(TraceFrame::Fd)
        }
        None => bytes.first_chunk().map(|data| Frame::from_bus(parsed, remote, number, *data).into()),
    };
    let frame = frame.ok_or_else(wrong)?;
    let event = TraceEvent::Frame { frame, direction, late: event == b"late" };
    Ok(TraceRecord { time_ns, channel, event })
}

fn push_base64(out: &mut Vec<u8>, bytes: &[u8]) {
    // Four digits for three bytes, padded.
    let mut digits = [0; FD_MAX_BYTES.div_ceil(3) * 4];
    let len = STANDARD.encode_slice(bytes, &mut digits).unwrap_or(0);
    out.extend_from_slice(&digits[..len]);
}

/// Up to 64 bytes.
fn decode_base64(text: &[u8]) -> Option<Vec<u8>> {
    STANDARD.decode(text).ok().filter(|bytes| bytes.len() <= FD_MAX_BYTES)
}

/// Microseconds, and nanoseconds only where there are any.
fn push_time(out: &mut Vec<u8>, time_ns: i64) {
    text::push_time(out, time_ns, NS_PER_S, if time_ns % 1000 == 0 { 6 } else { 9 }, b'.');
}

/// Writes python-can's dialect.
#[derive(Default)]
pub(crate) struct PythonCanEncoder {
    started: bool,
}

impl PythonCanEncoder {
    fn start(&mut self, out: &mut Vec<u8>) {
        if !std::mem::replace(&mut self.started, true) {
            out.extend_from_slice(PYTHON_CAN_HEAD.as_bytes());
            out.push(b'\n');
        }
    }
}

impl Encode for PythonCanEncoder {
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut) {
        self.start(out);
        if record.channel != 1 {
            left_out.note("channels other than 1, which python-can's CSV has no column for");
        }
        push_time(out, record.time_ns);
        let mut row = |id: u32, flags: [bool; 3], dlc: u8, data: &[u8]| {
            out.extend_from_slice(b",0x");
            text::push_hex(out, id, text::hex_len(id));
            for flag in flags {
                out.extend_from_slice(if flag { b",1" } else { b",0" });
            }
            out.push(b',');
            text::push_decimal(out, u64::from(dlc));
            out.push(b',');
            push_base64(out, data);
            out.push(b'\n');
        };
        match &record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                let id = frame.id();
                let len = if frame.is_fd() { frame.data_len() as u8 } else { frame.dlc() };
                row(id.raw(), [id.is_extended(), frame.is_remote(), false], len, frame.data());
                if let TraceFrame::Fd(frame) = frame {
                    if frame.data_len() <= 8 {
                        left_out.note(
                            "that short CAN FD frames are such, which python-can's CSV has no column for",
                        );
                    }
                    if frame.flags() != 0 {
                        left_out.note("the flags of CAN FD frames, which python-can's CSV has no column for");
                    }
                }
                if *direction == Direction::Tx {
                    left_out.note("the direction of sent frames, which python-can's CSV has no column for");
                }
            }
            event => {
                if let Some(ErrorFrame { classes, data }) = ErrorFrame::of(event) {
                    row(classes, [true, false, true], 8, &data);
                }
            }
        }
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.start(out);
    }
}

/// Writes our own dialect.
#[derive(Default)]
pub(crate) struct FullEncoder {
    started: bool,
}

impl FullEncoder {
    fn start(&mut self, out: &mut Vec<u8>) {
        if !std::mem::replace(&mut self.started, true) {
            out.extend_from_slice(FULL_HEAD.as_bytes());
            out.push(b'\n');
        }
    }
}

impl Encode for FullEncoder {
    fn carries_late(&self) -> bool {
        true
    }

    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.start(out);
        push_time(out, record.time_ns);
        out.push(b',');
        text::push_decimal(out, u64::from(record.channel));
        match &record.event {
            TraceEvent::Frame { frame, direction, late } => {
                out.extend_from_slice(if *direction == Direction::Tx { b",Tx," } else { b",Rx," });
                out.extend_from_slice(match frame {
                    TraceFrame::Fd(frame) => FD_KINDS[usize::from(frame.flags() & 3)].as_bytes(),
                    TraceFrame::Classic(frame) if frame.is_remote() => b"remote",
                    TraceFrame::Classic(_) => b"data",
                });
                out.push(b',');
                let id = frame.id();
                text::push_hex(out, id.raw(), if id.is_extended() { 8 } else { 3 });
                out.push(b',');
                text::push_decimal(out, u64::from(frame.dlc()));
                out.push(b',');
                for byte in frame.data() {
                    text::push_hex_byte(out, *byte);
                }
                out.extend_from_slice(if *late { b",late\n" } else { b",\n" });
            }
            event => out.extend_from_slice(format!(",,event,,,,{}\n", EventText(*event)).as_bytes()),
        }
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.start(out);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use super::*;
    use crate::{Format, WriteOptions};
    use cantap_trace::testing::{record, record_or_fd};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_trace_round_trips(records in prop::collection::vec(record(1), 0..20), late: bool) {
            let mut records = records;
            if let Some(TraceRecord { event: TraceEvent::Frame { late: flag, .. }, .. }) = records.first_mut() {
                *flag = late;
            }
            prop_assert_eq!(tests::round_trip(Format::Csv(CsvDialect::Full), &records), records.clone());
            let options =
                WriteOptions { format: Some(Format::Csv(CsvDialect::PythonCan)), ..WriteOptions::default() };
            let (bytes, left_out) = tests::write_with(&options, &records);
            let plain = |record: &TraceRecord| {
                let mut event = record.event;
                if let TraceEvent::Frame { direction, late, .. } = &mut event {
                    (*direction, *late) = (Direction::Rx, false);
                }
                TraceRecord { channel: 1, event, ..*record }
            };
            let expected: Vec<_> = records.iter().map(plain).collect();
            let (read, issues) = tests::read(Format::Csv(CsvDialect::Full), bytes);
            prop_assert_eq!(issues, Vec::<String>::new());
            prop_assert_eq!(read, expected.clone());
            let told = records.iter().zip(&expected).filter(|(record, plain)| record.channel != plain.channel);
            let noted = left_out.iter().filter(|(what, _)| what.contains("channels")).map(|(_, count)| count);
            prop_assert_eq!(noted.sum::<u64>(), told.count() as u64);
        }

        #[test]
        fn our_own_dialect_keeps_fd_frames(records in prop::collection::vec(record_or_fd(1), 0..20)) {
            prop_assert_eq!(tests::round_trip(Format::Csv(CsvDialect::Full), &records), records);
        }

        #[test]
        fn base64_round_trips(bytes in prop::collection::vec(any::<u8>(), 0..=64)) {
            let mut text = Vec::new();
            push_base64(&mut text, &bytes);
            prop_assert_eq!(decode_base64(&text), Some(bytes));
        }
    }

    #[test]
    fn rows_are_python_cans() {
        let file = "timestamp,arbitration_id,extended,remote,error,dlc,data\n\
                    1483389946.197000,0xdadada,1,0,0,6,WzQyLCA5XQ==\n";
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), file);
        // python-can's own example has a length of 6 and 7 bytes.
        assert_eq!((records.len(), issues.len()), (0, 1));
        let file = file.replace(",6,", ",7,").replace("0xdadada", "0xDADADA");
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), &file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Csv(CsvDialect::PythonCan), &records), file);
        assert_eq!(
            tests::write(Format::Csv(CsvDialect::Full), &records),
            "time,channel,direction,type,id,dlc,data,event\n\
             1483389946.197000,1,Rx,data,00DADADA,7,5B34322C20395D,\n"
        );
    }

    /// python-can writes a longer frame with its length and its bytes, and nothing else that tells FD.
    #[test]
    fn python_cans_dialect_keeps_the_data_of_fd_frames_and_counts_what_it_has_no_column_for() {
        let log = "(1.000000) can0 123##1000102030405060708090A0B\n(2.000000) can0 124##0AA\n";
        let (records, _) = tests::read(Format::Candump, log);
        let options =
            WriteOptions { format: Some(Format::Csv(CsvDialect::PythonCan)), ..WriteOptions::default() };
        let (bytes, left_out) = tests::write_with(&options, &records);
        let (read, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), bytes);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &read),
            "(1.000000) can0 123##0000102030405060708090A0B\n(2.000000) can0 124#AA\n"
        );
        let counts: Vec<_> = left_out.iter().collect();
        assert_eq!(
            counts,
            [
                ("that short CAN FD frames are such, which python-can's CSV has no column for", 1),
                ("the flags of CAN FD frames, which python-can's CSV has no column for", 1),
            ]
        );
        let bad = "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.0,0x1,0,0,0,9,AAAAAAAAAAAA\n";
        assert!(
            tests::read(Format::Csv(CsvDialect::PythonCan), bad).1[0]
                .contains("a length that CAN or CAN FD has")
        );
    }

    #[test]
    fn flags_are_read_or_refused_and_every_unknown_line_counts() {
        let file = "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.0,0x800,True,0,0,0,\n\
                    1.0,0x1,2,0,0,0,\n1.0,0x1,0,x,0,0,\n1.0,0x1,0,0,,0,\n2.0,0x1,False,0,0,0,\n";
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), file);
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1.000000) can0 00000800#\n(2.000000) can0 001#\n"
        );
        assert_eq!(issues.len(), 3, "{issues:?}");
        // Every line of a file that is none of ours counts, and those before a head too.
        let file = "not a table\n".repeat(150);
        assert_eq!(tests::read(Format::Csv(CsvDialect::PythonCan), &file).1.len(), 150);
        let file = format!("rubbish\nmore\n{PYTHON_CAN_HEAD}\n2.0,0x1,0,0,0,0,\n");
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), &file);
        assert_eq!((records.len(), issues.len()), (1, 2), "{issues:?}");
    }

    #[test]
    fn broken_rows_are_named() {
        let file = "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.0,0x1,0,0,0,1\n\
                    x,0x1,0,0,0,0,\n1.0,zz,0,0,0,0,\n1.0,0x800,0,0,0,0,\n1.0,0x1,0,0,0,1,?\n9.7e-05,0x1,0,1,0,3,\n";
        let (records, issues) = tests::read(Format::Csv(CsvDialect::PythonCan), file);
        assert_eq!(tests::write(Format::Candump, &records), "(0.000097) can0 001#R3\n");
        assert_eq!(issues.len(), 5, "{issues:?}");
        assert_eq!(issues[0], "test, line 2: expected 7 columns, found '1.0,0x1,0,0,0,1'");
    }
}
