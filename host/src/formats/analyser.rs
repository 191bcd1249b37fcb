//! The table of the earlier CANanalyser, which its CSV and DIF files share: an index, the time from the start,
//! the frame, its errors, and its length on the bus.
//!
//! `Index;TimeStamps;D/R;S/E;CANId;DLC;D1;…;D8;ACK;FRM;CRC;STF;DE;SE;OVRBUF;FSiZ;SFF`: D or R for data or
//! remote, S or E for standard or extended, hexadecimal ID and data, Y under the error that a row tells
//! of, Y for data and stamps being recorded, Y where frames were lost behind this one, and the bits of the
//! frame without and of stuffing. Channel, direction, states and numbers of losses have no column.

use cantap_wire::record::BusErrorKind;
use cantap_wire::{Frame, Id};

use super::calendar::{Date, start_of_trace};
use super::csv::Row as ReadRow;
use super::issue::Fault;
use super::text::{self, NS_PER_S};
use super::writer::{Encode, LeftOut};
use crate::bits::FrameBits;
use crate::{Direction, TraceEvent, TraceRecord};

/// The names of the columns.
pub(crate) const COLUMNS: [&str; 23] = [
    "Index",
    "TimeStamps",
    "D/R",
    "S/E",
    "CANId",
    "DLC",
    "D1",
    "D2",
    "D3",
    "D4",
    "D5",
    "D6",
    "D7",
    "D8",
    "ACK",
    "FRM",
    "CRC",
    "STF",
    "DE",
    "SE",
    "OVRBUF",
    "FSiZ",
    "SFF",
];

/// The error that each of the four columns from `ACK` on tells of.
const ERRORS: [BusErrorKind; 4] =
    [BusErrorKind::Acknowledgment, BusErrorKind::Form, BusErrorKind::Crc, BusErrorKind::Stuff];

/// How lines end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LineEnd {
    /// As on Windows, where the analyser's program ran.
    #[default]
    CrLf,
    /// As on Unix.
    Lf,
}

/// What `VECTORS` counts in a DIF file, and what follows a number in it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DifConvention {
    /// As DIF was defined: `VECTORS` are columns, `TUPLES` rows; `V` follows a number.
    #[default]
    Columns,
    /// As some spreadsheets have it: `VECTORS` are rows, `TUPLES` columns; an empty line follows a number.
    Rows,
}

/// How the analyser's tables are written. Reading finds out by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TableStyle {
    /// What separates columns of CSV.
    pub separator: u8,
    /// What separates a fraction.
    pub decimal_mark: u8,
    /// How lines end.
    pub line_end: LineEnd,
    /// Which kind of DIF.
    pub dif: DifConvention,
}

impl Default for TableStyle {
    fn default() -> Self {
        Self { separator: b';', decimal_mark: b',', line_end: LineEnd::CrLf, dif: DifConvention::Columns }
    }
}

impl TableStyle {
    pub(crate) fn line_end(self) -> &'static [u8] {
        match self.line_end {
            LineEnd::CrLf => b"\r\n",
            LineEnd::Lf => b"\n",
        }
    }
}

/// One row to be written.
pub(crate) struct TableRow {
    index: u64,
    offset_ns: i64,
    content: Content,
    overrun: bool,
}

enum Content {
    Frame(Frame),
    Error(Option<BusErrorKind>),
}

/// A cell's type: DIF tells numbers from text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Cell {
    Number,
    Text,
}

/// Makes rows of records. The last row is held back until it is known whether frames were lost behind it.
#[derive(Default)]
pub(crate) struct RowEncoder {
    start_ns: Option<i64>,
    rows: u64,
    held: Option<TableRow>,
}

impl RowEncoder {
    /// The time that offsets count from.
    pub(crate) fn start(&mut self, first_ns: i64) -> i64 {
        *self.start_ns.get_or_insert_with(|| start_of_trace(first_ns))
    }

    /// Takes a record; gives the row before it.
    pub(crate) fn add(&mut self, record: &TraceRecord, left_out: &mut LeftOut) -> Option<TableRow> {
        let offset_ns = record.time_ns.saturating_sub(self.start(record.time_ns));
        if record.channel != 1 {
            left_out.note("channels other than 1, which the analyser's table has no column for");
        }
        let content = match record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                if direction == Direction::Tx {
                    left_out
                        .note("the direction of sent frames, which the analyser's table has no column for");
                }
                Content::Frame(frame)
            }
            TraceEvent::BusError { kind, counters } => {
                if counters.is_some() {
                    left_out.note("error counters, which the analyser's table has no column for");
                }
                if kind.is_some_and(|kind| !ERRORS.contains(&kind)) {
                    left_out.note("the kind of bit errors, which the analyser's table has no column for");
                }
                Content::Error(kind)
            }
            TraceEvent::Lost { .. } => {
                match &mut self.held {
                    Some(row) if !row.overrun => {
                        row.overrun = true;
                        left_out.note(
                            "how many frames were lost: the analyser's table marks only that some were",
                        );
                    }
                    _ => left_out.note("losses without a frame of their own before them"),
                }
                return None;
            }
            TraceEvent::State { .. }
            | TraceEvent::ErrorsSuppressed { .. }
            | TraceEvent::TransmitFailed { .. } => {
                left_out.note("changes of state and other events, which the analyser's table has no row for");
                return None;
            }
        };
        self.rows += 1;
        self.held.replace(TableRow { index: self.rows, offset_ns, content, overrun: false })
    }

    /// The last row.
    pub(crate) fn last(&self) -> Option<&TableRow> {
        self.held.as_ref()
    }

    /// Rows so far.
    pub(crate) fn rows(&self) -> u64 {
        self.rows
    }
}

impl TableRow {
    /// Gives each cell in turn.
    pub(crate) fn cells(&self, decimal_mark: u8, mut emit: impl FnMut(Cell, &[u8])) {
        let mut cell = Vec::with_capacity(24);
        let mut number = |push: &dyn Fn(&mut Vec<u8>), kind: Cell| {
            cell.clear();
            push(&mut cell);
            emit(kind, &cell);
        };
        let yes = |on: bool| move |out: &mut Vec<u8>| out.push(if on { b'Y' } else { b'N' });
        number(&|out| text::push_decimal(out, self.index), Cell::Number);
        number(&|out| text::push_time(out, self.offset_ns, NS_PER_S, 9, decimal_mark), Cell::Number);
        match &self.content {
            Content::Frame(frame) => {
                let id = frame.id();
                number(&|out| out.push(if frame.is_remote() { b'R' } else { b'D' }), Cell::Text);
                number(&|out| out.push(if id.is_extended() { b'E' } else { b'S' }), Cell::Text);
                number(&|out| text::push_hex(out, id.raw(), text::hex_len(id.raw())), Cell::Text);
                number(&|out| text::push_decimal(out, u64::from(frame.dlc())), Cell::Number);
                for at in 0..8 {
                    match frame.data().get(at) {
                        Some(byte) => number(&|out| text::push_hex_byte(out, *byte), Cell::Text),
                        None => number(&|_| {}, Cell::Text),
                    }
                }
            }
            Content::Error(_) => (0..12).for_each(|_| number(&|_| {}, Cell::Text)),
        }
        for kind in ERRORS {
            let told = matches!(self.content, Content::Error(Some(error)) if error == kind);
            number(&|out| out.extend_from_slice(if told { b"Y" } else { b"" }), Cell::Text);
        }
        number(&yes(true), Cell::Text);
        number(&yes(true), Cell::Text);
        number(&yes(self.overrun), Cell::Text);
        match &self.content {
            Content::Frame(frame) => {
                let bits = FrameBits::of(frame);
                number(&|out| text::push_decimal(out, u64::from(bits.unstuffed)), Cell::Number);
                number(&|out| text::push_decimal(out, u64::from(bits.stuff)), Cell::Number);
            }
            Content::Error(_) => (0..2).for_each(|_| number(&|_| {}, Cell::Text)),
        }
    }
}

/// The comment that names the start: `Date: 2014-09-14 17:14:42.622`.
pub(crate) fn date_comment(start_ns: i64) -> String {
    let date = Date::of(start_ns);
    let (hour, minute, second, ns) = date.clock();
    let (year, month, day) = (date.year, date.month, date.day);
    format!("Date: {year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}.{:03}", ns / 1_000_000)
}

/// Writes the table as CSV.
pub(crate) struct CsvEncoder {
    style: TableStyle,
    rows: RowEncoder,
    started: bool,
}

impl CsvEncoder {
    pub(crate) fn new(style: TableStyle) -> Self {
        Self { style, rows: RowEncoder::default(), started: false }
    }

    fn start(&mut self, first_ns: i64, out: &mut Vec<u8>) {
        if std::mem::replace(&mut self.started, true) {
            return;
        }
        let end = self.style.line_end();
        for comment in [date_comment(self.rows.start(first_ns)), "Filter: as captured".to_owned()] {
            out.extend_from_slice(b"# ");
            out.extend_from_slice(comment.as_bytes());
            out.extend_from_slice(end);
        }
        for (at, name) in COLUMNS.iter().enumerate() {
            if at > 0 {
                out.push(self.style.separator);
            }
            out.extend_from_slice(name.as_bytes());
        }
        out.extend_from_slice(end);
    }

    fn row(&self, row: &TableRow, out: &mut Vec<u8>) {
        let mut first = true;
        row.cells(self.style.decimal_mark, |_, cell| {
            if !std::mem::replace(&mut first, false) {
                out.push(self.style.separator);
            }
            out.extend_from_slice(cell);
        });
        out.extend_from_slice(self.style.line_end());
    }
}

impl Encode for CsvEncoder {
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut) {
        self.start(record.time_ns, out);
        if let Some(row) = self.rows.add(record, left_out) {
            self.row(&row, out);
        }
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.start(0, out);
        self.provisional_end(out);
    }

    fn provisional_end(&self, out: &mut Vec<u8>) {
        if let Some(row) = self.rows.last() {
            self.row(row, out);
        }
    }
}

/// Reads rows of the table.
#[derive(Default)]
pub(crate) struct RowDecoder {
    separator: u8,
    start_ns: i64,
    /// The place of each of [`COLUMNS`] in this file.
    places: Vec<Option<usize>>,
}

impl RowDecoder {
    /// Looks at a line of CSV before the rows. True if it names the columns; a comment may name the date.
    pub(crate) fn head(&mut self, line: &[u8]) -> bool {
        if let Some([separator, ..]) = line.strip_prefix(b"Index") {
            self.separator = *separator;
            let cells: Vec<&[u8]> = line.split(|byte| byte == separator).collect();
            return self.name(&cells);
        }
        self.comment(line);
        false
    }

    /// Looks for a date in a comment.
    pub(crate) fn comment(&mut self, comment: &[u8]) {
        let comment = String::from_utf8_lossy(comment);
        let digits = |c: char| !(c.is_ascii_digit() || ":.-/ ".contains(c));
        for part in comment.split(digits) {
            if let Some(start_ns) = date(part.trim_matches(|c: char| !c.is_ascii_digit())) {
                self.start_ns = start_ns;
            }
        }
    }

    /// Takes the names of the columns; false if they are not this table's.
    pub(crate) fn name(&mut self, cells: &[&[u8]]) -> bool {
        let find = |name: &&str| cells.iter().position(|cell| cell.trim_ascii() == name.as_bytes());
        self.places = COLUMNS.iter().map(find).collect();
        // Time, kind, format, ID and length there must be.
        self.places[1..6].iter().all(Option::is_some)
    }

    /// A line of CSV. Without its line end it must have all its cells.
    pub(crate) fn line(&self, line: &[u8], terminated: bool) -> Result<ReadRow, Fault> {
        if matches!(line.first(), Some(b'#' | b'/')) {
            return Ok(None);
        }
        let cells: Vec<&[u8]> = line.split(|byte| *byte == self.separator).collect();
        let last = self.places.iter().flatten().max().copied().unwrap_or(0);
        if !terminated && cells.len() <= last {
            return Err(Fault::malformed(format!("{} cells", last + 1), line));
        }
        self.cells(&cells, line)
    }

    /// A row. `shown` is what an issue shows of it.
    pub(crate) fn cells(&self, cells: &[&[u8]], shown: &[u8]) -> Result<ReadRow, Fault> {
        let cell = |column: usize| {
            let place = self.places.get(column).copied().flatten();
            place.and_then(|place| cells.get(place)).map_or(&b""[..], |cell| cell.trim_ascii())
        };
        let time = cell(1);
        let offset_ns = text::time(time, NS_PER_S, b',')
            .or_else(|| text::time(time, NS_PER_S, b'.'))
            .ok_or_else(|| {
                Fault::malformed(
                    "a time in seconds under TimeStamps",
                    if time.is_empty() { shown } else { time },
                )
            })?;
        let lost = TraceEvent::Lost { stage: None, count: 1, at_least: true };
        let second = (cell(20) == b"Y").then_some(lost);
        let record =
            |event| TraceRecord { time_ns: self.start_ns.saturating_add(offset_ns), channel: 1, event };
        let kinds = ERRORS.iter().enumerate();
        let told: Vec<_> =
            kinds.filter(|(at, _)| !matches!(cell(14 + at), b"" | b"N")).map(|(_, kind)| *kind).collect();
        if cell(2).is_empty() {
            let event = TraceEvent::BusError { kind: told.first().copied(), counters: None };
            return Ok(Some((record(event), second)));
        }
        let remote = match cell(2) {
            b"D" => false,
            b"R" => true,
            other => return Err(Fault::malformed("D or R", other)),
        };
        let raw = text::hex(cell(4));
        let id = match cell(3) {
            b"S" => raw.and_then(Id::standard),
            b"E" => raw.and_then(Id::extended),
            other => return Err(Fault::malformed("S or E", other)),
        };
        let id = id.ok_or_else(|| Fault::malformed("an identifier that fits its format", cell(4)))?;
        let dlc = text::decimal(cell(5))
            .filter(|dlc| *dlc <= 15)
            .ok_or_else(|| Fault::malformed("a length of 0 to 15", cell(5)))? as u8;
        let mut data = [0; 8];
        if !remote {
            for (at, slot) in data[..usize::from(dlc.min(8))].iter_mut().enumerate() {
                let byte = cell(6 + at);
                // Data can be left out of a capture to save bandwidth.
                if byte.is_empty() && cell(18) == b"N" {
                    continue;
                }
                *slot = text::hex(byte)
                    .and_then(|byte| u8::try_from(byte).ok())
                    .ok_or_else(|| Fault::malformed(format!("a byte under D{}", at + 1), byte))?;
            }
        }
        let frame = Frame::from_bus(id, remote, dlc, data);
        Ok(Some((record(TraceEvent::Frame { frame, direction: Direction::Rx, late: false }), second)))
    }
}

/// `2014-09-14 17:14:42.622`, or `14/09/2014 17:14:42`.
pub(crate) fn date(text: &str) -> Option<i64> {
    let (day, clock) = text.split_once([' ', 'T'])?;
    let numbers: Vec<i64> = day.split(['-', '/', '.']).map(str::parse).collect::<Result<_, _>>().ok()?;
    let (year, month, day) = match numbers[..] {
        [year, month, day] | [day, month, year] if year >= 1000 => (year, month, day),
        _ => return None,
    };
    let mut clock = clock.trim().splitn(3, ':');
    let hour = text::decimal(clock.next()?.as_bytes())?;
    let minute = text::decimal(clock.next()?.as_bytes())?;
    let second_ns = text::time(clock.next()?.as_bytes(), NS_PER_S, b'.').filter(|ns| *ns >= 0)?;
    let of_day_ns = Date::of_day(hour, minute, (second_ns / NS_PER_S) as u64, second_ns % NS_PER_S)?;
    Date { year, month: u8::try_from(month).ok()?, day: u8::try_from(day).ok()?, of_day_ns }.time_ns()
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use super::*;
    use crate::formats::{CsvDialect, Format, WriteOptions};
    use crate::testing::{frame, record};
    use proptest::prelude::*;

    const CSV: Format = Format::Csv(CsvDialect::Analyser);

    fn options(format: Format, table: TableStyle) -> WriteOptions {
        WriteOptions { format: Some(format), table, ..WriteOptions::default() }
    }

    /// What the table carries of records.
    fn kept(records: &[TraceRecord]) -> Vec<TraceRecord> {
        let mut kept: Vec<TraceRecord> = Vec::new();
        for record in records {
            let time_ns = record.time_ns;
            let event = match record.event {
                TraceEvent::Frame { frame, .. } => {
                    TraceEvent::Frame { frame, direction: Direction::Rx, late: false }
                }
                TraceEvent::BusError { kind, .. } => {
                    TraceEvent::BusError { kind: kind.filter(|kind| ERRORS.contains(kind)), counters: None }
                }
                TraceEvent::Lost { .. } => match kept.last() {
                    Some(TraceRecord { event: TraceEvent::Lost { .. }, .. }) | None => continue,
                    Some(before) => {
                        let lost = TraceEvent::Lost { stage: None, count: 1, at_least: true };
                        let record = TraceRecord { event: lost, ..*before };
                        kept.push(record);
                        continue;
                    }
                },
                _ => continue,
            };
            kept.push(TraceRecord { time_ns, channel: 1, event });
        }
        kept
    }

    proptest! {
        #[test]
        fn any_trace_round_trips_as_far_as_the_table_carries(
            records in prop::collection::vec(record(1), 0..12),
            (comma, lf, rows) in any::<(bool, bool, bool)>(),
        ) {
            let style = TableStyle {
                separator: if comma { b',' } else { b';' },
                decimal_mark: if comma { b'.' } else { b',' },
                line_end: if lf { LineEnd::Lf } else { LineEnd::CrLf },
                dif: if rows { DifConvention::Rows } else { DifConvention::Columns },
            };
            for format in [CSV, Format::Dif] {
                let (bytes, left_out) = tests::write_with(&options(format, style), &records);
                let (read, issues) = tests::read(format, bytes);
                prop_assert_eq!(issues, Vec::<String>::new());
                let expected = kept(&records);
                prop_assert!(expected == records || !left_out.is_empty());
                prop_assert_eq!(read, expected);
            }
        }

        #[test]
        fn frames_of_channel_1_lose_nothing(frames in prop::collection::vec(frame(), 0..12)) {
            let event = |frame| TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
            let record = |(at, frame)| TraceRecord { time_ns: at as i64, channel: 1, event: event(frame) };
            let records: Vec<_> = frames.into_iter().enumerate().map(record).collect();
            prop_assert_eq!(tests::round_trip(CSV, &records), records.clone());
            prop_assert_eq!(tests::round_trip(Format::Dif, &records), records);
        }
    }

    /// The row of the analyser's own documentation.
    #[test]
    fn rows_are_the_analysers() {
        let frame = "000#55".parse().unwrap();
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        let record = TraceRecord { time_ns: 97_125, channel: 1, event };
        let row = "1;0,000097125;D;S;0;1;55;;;;;;;;;;;;Y;Y;N;55;3";
        let csv = tests::write(CSV, &[record]);
        let lines: Vec<_> = csv.split("\r\n").collect();
        assert_eq!(
            lines[2],
            "Index;TimeStamps;D/R;S/E;CANId;DLC;D1;D2;D3;D4;D5;D6;D7;D8;ACK;FRM;CRC;STF;DE;SE;OVRBUF;FSiZ;SFF"
        );
        assert_eq!(lines[3..], [row, ""]);
        // Read from a file with comments of which nothing is known.
        let file =
            format!("CANanalyser\r\nDate : 14/09/2014 17:14:42\r\nFilter : all\r\n{}\r\n{row}\r\n", lines[2]);
        let (records, issues) = tests::read(CSV, file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Candump, &records), "(1410714882.000097) can0 000#55\n");
    }

    #[test]
    fn broken_rows_are_named() {
        let head = COLUMNS.join(";");
        let file =
            format!("{head}\n1;x;D;S;0;0\n2;0,1;Q;S;0;0\n3;0,1;D;S;800;0\n4;0,1;D;S;0;2;55\n5;0,1;D;S;0;0\n");
        let (records, issues) = tests::read(CSV, file);
        assert_eq!(records.len(), 1);
        assert_eq!(
            issues,
            [
                "test, line 2: expected a time in seconds under TimeStamps, found 'x'",
                "test, line 3: expected D or R, found 'Q'",
                "test, line 4: expected an identifier that fits its format, found '800'",
                "test, line 5: expected a byte under D2, found nothing",
            ]
        );
    }
}
