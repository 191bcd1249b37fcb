//! The earlier CANanalyser's table as DIF, the data interchange format of old spreadsheets.
//!
//! Pairs of lines: a header of named items, then for each cell its type and number, and its text. See
//! [`DifConvention`] for the two ways in which programs count rows and columns; the reader uses neither
//! number.

use std::io;

use super::analyser::{COLUMNS, Cell, DifConvention, Layout, RowDecoder, TableRow, TableStyle};
use super::codec::Decode;
use super::found::Found;
use super::input::Input;
use super::issue::{Fault, Place};
use super::output::Patch;
use super::zone::Zone;
use cantap_trace::{TraceEvent, TraceRecord};

/// The number of rows has a fixed width, so that it can be filled in at the end.
const COUNT_DIGITS: usize = 10;

/// Writes DIF.
pub(crate) struct DifLayout {
    style: TableStyle,
    /// The position of the number of rows in the file, once it is written.
    count_at: Option<u64>,
}

impl DifLayout {
    pub(crate) fn new(style: TableStyle) -> Self {
        Self { style, count_at: None }
    }

    fn begin_row(&self, out: &mut Vec<u8>) {
        for line in [&b"-1,0"[..], b"BOT"] {
            out.extend_from_slice(line);
            out.extend_from_slice(self.style.line_end());
        }
    }

    fn cell(&self, out: &mut Vec<u8>, kind: Cell, cell: &[u8]) {
        let end = self.style.line_end();
        match kind {
            Cell::Number => {
                out.extend_from_slice(b"0,");
                out.extend_from_slice(cell);
                out.extend_from_slice(end);
                if self.style.dif == DifConvention::Columns {
                    out.push(b'V');
                }
            }
            Cell::Text => {
                out.extend_from_slice(b"1,0");
                out.extend_from_slice(end);
                out.push(b'"');
                out.extend_from_slice(cell);
                out.push(b'"');
            }
        }
        out.extend_from_slice(end);
    }
}

/// What a stream or a compressed file lacks.
pub(super) const ROWS_UNTOLD: &str =
    "the number of rows in its head, which only a plain file can be given afterwards";

impl Layout for DifLayout {
    fn head(&mut self, date: &str, out: &mut Vec<u8>) {
        // The start is in the title, as it is in a comment of the analyser's CSV.
        let count = "0".repeat(COUNT_DIGITS);
        let columns = COLUMNS.len().to_string();
        let (vectors, tuples) = match self.style.dif {
            DifConvention::Columns => (&columns, &count),
            DifConvention::Rows => (&count, &columns),
        };
        let end = self.style.line_end();
        for (name, number, text) in [
            ("TABLE", "1", date),
            ("VECTORS", vectors.as_str(), ""),
            ("TUPLES", tuples.as_str(), ""),
            ("DATA", "0", ""),
        ] {
            out.extend_from_slice(name.as_bytes());
            out.extend_from_slice(end);
            out.extend_from_slice(b"0,");
            if number == count {
                self.count_at = Some(out.len() as u64);
            }
            out.extend_from_slice(number.as_bytes());
            out.extend_from_slice(end);
            out.extend_from_slice(format!("\"{text}\"").as_bytes());
            out.extend_from_slice(end);
        }
        self.begin_row(out);
        for name in COLUMNS {
            self.cell(out, Cell::Text, name.as_bytes());
        }
    }

    fn row(&self, row: &TableRow, out: &mut Vec<u8>) {
        self.begin_row(out);
        row.cells(self.style.decimal_mark, |kind, cell| self.cell(out, kind, cell));
    }

    fn end(&self, out: &mut Vec<u8>) {
        for line in [&b"-1,0"[..], b"EOD"] {
            out.extend_from_slice(line);
            out.extend_from_slice(self.style.line_end());
        }
    }

    fn patch(&self, rows: u64) -> Option<Patch> {
        // One more, for the names of the columns.
        let count = format!("{:0COUNT_DIGITS$}", rows + 1);
        self.count_at.map(|offset| Patch { offset, bytes: count.into_bytes(), missed: Some(ROWS_UNTOLD) })
    }
}

/// The two lines at which a row begins.
const MARK: &[u8] = b"-1,0";
const BEGIN: &[u8] = b"BOT";

/// More cells than this in a row mean damage.
const MAX_CELLS: usize = 256;

/// Reads DIF.
#[derive(Default)]
pub(crate) struct Decoder {
    rows: RowDecoder,
    /// The cells of the row being read.
    cells: Vec<Vec<u8>>,
    /// `DATA` has been seen, then the names of the columns.
    in_data: bool,
    named: bool,
    /// The line at which the row begins.
    row_line: u64,
    /// Whether the rest of a damaged row is being passed over, up to where the next begins.
    skipping: bool,
    /// A line that was read as the second of a damaged pair and is the first of the next.
    held: Option<Vec<u8>>,
    pending: Option<TraceRecord>,
    ended: bool,
}

impl Decoder {
    /// `zone` is the zone of the file's date.
    pub(crate) fn new(zone: &Zone) -> Self {
        Self { rows: RowDecoder::new(zone), ..Self::default() }
    }
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(record) = self.pending.take() {
            return Ok(Found::Record(record));
        }
        while !self.ended {
            if self.named
                && self.cells.is_empty()
                && self.held.is_none()
                && !self.skipping
                && let Some(found) = self.whole_row(input)
            {
                return Ok(found);
            }
            let held = self.held.take();
            let place = Place::Line(input.line_number() + u64::from(held.is_none()));
            let first =
                if held.is_some() { held } else { input.line()?.map(|line| line.text.trim_ascii().to_vec()) };
            let Some(first) = first else {
                self.ended = true;
                // Without its end, the last row may lack cells.
                let cut = Fault::Truncated("a table; its last row is left out");
                return Ok(Found::Issue(place, cut));
            };
            if !self.in_data {
                match self.header(&first, input)? {
                    None => continue,
                    Some(fault) => return Ok(Found::Issue(place, fault)),
                }
            }
            // Pairs that are out of step never get into it again by themselves.
            if self.skipping && first != MARK && first != BEGIN {
                continue;
            }
            let Some(second) = input.line()? else { continue };
            let second = second.text.trim_ascii();
            let row_place = Place::Line(self.row_line);
            let (fault_place, result) = match (first.split(|byte| *byte == b',').next(), second) {
                (Some(b"-1"), BEGIN) => {
                    (self.row_line, self.skipping) = (input.line_number() + 1, false);
                    (row_place, self.row())
                }
                (Some(b"-1"), b"EOD") => {
                    self.ended = true;
                    (row_place, self.row())
                }
                (Some(b"0"), _) if second != MARK && second != BEGIN => {
                    (row_place, self.cell(first.get(2..).unwrap_or_default()))
                }
                (Some(b"1"), [b'"', text @ .., b'"'] | text) if second != MARK && second != BEGIN => {
                    (row_place, self.cell(text))
                }
                (_, second) => {
                    let was_skipping = std::mem::replace(&mut self.skipping, true);
                    self.cells.clear();
                    if first == BEGIN {
                        self.held = Some(second.to_vec());
                        (self.row_line, self.skipping) = (input.line_number(), false);
                    } else if second == BEGIN {
                        (self.row_line, self.skipping) = (input.line_number() + 1, false);
                    } else if second == MARK {
                        self.held = Some(second.to_vec());
                    }
                    if was_skipping {
                        continue;
                    }
                    (place, Err(Fault::malformed("a cell: '0,' and a number, '1,0', or '-1,0'", &first)))
                }
            };
            match result {
                Ok(Some((record, second))) => {
                    self.pending = second.map(|event| TraceRecord { event, ..record });
                    return Ok(Found::Record(record));
                }
                Ok(None) => {}
                Err(fault) => return Ok(Found::Issue(fault_place, fault)),
            }
        }
        // Only the end shows whether a compressed file is complete.
        while !input.follows() && !input.peek(1)?.is_empty() {
            input.consume(input.buffered().len());
        }
        Ok(Found::End)
    }
}

/// A line of the buffer without its line end and surrounding space.
#[inline]
fn trimmed(line: &[u8]) -> &[u8] {
    match line {
        // Most lines are like this.
        [b'!'..=b'~', .., b'!'..=b'~', b'\r'] => &line[..line.len() - 1],
        [b'!'..=b'~', .., b'!'..=b'~'] => line,
        _ => line.trim_ascii(),
    }
}

impl Decoder {
    /// Reads a row that is in the buffer from its first cell to the beginning of the next, as nearly all are, without
    /// copying a cell. `None` if it is not; then its lines are read one by one.
    fn whole_row(&mut self, input: &mut Input) -> Option<Found> {
        let buffered = input.buffered();
        let mut ends = memchr::memchr_iter(b'\n', buffered);
        let mut cells = [&b""[..]; COLUMNS.len() + 1];
        let (mut count, mut begin, mut lines) = (0, 0, 0);
        loop {
            let (first_end, second_end) = (ends.next()?, ends.next()?);
            let (first, second) = (&buffered[begin..first_end], &buffered[first_end + 1..second_end]);
            begin = second_end + 1;
            lines += 2;
            let cell = match trimmed(first) {
                [b'0', b',', number @ ..] => number,
                [b'1', b',', ..] => match trimmed(second) {
                    [b'"', text @ .., b'"'] | text => text,
                },
                MARK if trimmed(second) == BEGIN => break,
                _ => return None,
            };
            *cells.get_mut(count)? = cell;
            count += 1;
        }
        if count == 0 {
            return None;
        }
        let row = self.rows.cells(&cells[..count], b"an incomplete row");
        let place = Place::Line(self.row_line);
        input.consume_lines(begin, lines);
        self.row_line = input.line_number() + 1;
        match row {
            Ok(Some((record, second))) => {
                self.pending = second.map(|event| TraceRecord { event, ..record });
                Some(Found::Record(record))
            }
            Ok(None) => None,
            Err(fault) => Some(Found::Issue(place, fault)),
        }
    }

    /// An item of the header: a name, its number, its text.
    fn header(&mut self, name: &[u8], input: &mut Input) -> io::Result<Option<Fault>> {
        let known = !name.is_empty() && name.iter().all(u8::is_ascii_uppercase);
        if !known {
            return Ok(Some(Fault::malformed("a DIF header item such as TABLE", name)));
        }
        self.in_data = name == b"DATA";
        input.line()?;
        if let Some(text) = input.line()? {
            self.rows.comment(text.text);
        }
        Ok(None)
    }

    fn cell(&mut self, text: &[u8]) -> Result<super::found::Row, Fault> {
        if self.cells.len() >= MAX_CELLS {
            self.cells.clear();
            self.skipping = true;
            return Err(Fault::malformed("the end of a row", text));
        }
        self.cells.push(text.to_vec());
        Ok(None)
    }

    /// The row that has just ended.
    fn row(&mut self) -> Result<Option<(TraceRecord, Option<TraceEvent>)>, Fault> {
        let cells = std::mem::take(&mut self.cells);
        if cells.is_empty() {
            return Ok(None);
        }
        let cells: Vec<&[u8]> = cells.iter().map(Vec::as_slice).collect();
        if self.named {
            return self.rows.cells(&cells, b"an incomplete row");
        }
        self.named = self.rows.name(&cells);
        if self.named {
            Ok(None)
        } else {
            Err(Fault::malformed("the columns Index, TimeStamps, D/R and so on", &cells.join(&b' ')))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::{DifConvention, Format, LineEnd, TableStyle, WriteOptions};
    use cantap_trace::testing::data_record;

    #[test]
    fn both_conventions_are_written_as_their_programs_expect() {
        let text = |dif| {
            let table =
                TableStyle { line_end: LineEnd::Lf, decimal_mark: b'.', dif, ..TableStyle::default() };
            let options = WriteOptions { format: Some(Format::Dif), table, ..WriteOptions::default() };
            String::from_utf8(tests::write_with(&options, &[data_record(1_000_000)]).0).unwrap()
        };
        let columns = text(DifConvention::Columns);
        let head = "TABLE\n0,1\n\"Date: 1970-01-01 00:00:00.000\"\nVECTORS\n0,23\n\"\"\nTUPLES\n0,0000000000\n\"\"\n\
                    DATA\n0,0\n\"\"\n-1,0\nBOT\n1,0\n\"Index\"\n1,0\n\"TimeStamps\"\n";
        assert!(columns.starts_with(head), "{columns}");
        assert!(
            columns.contains("BOT\n0,1\nV\n0,0.001000000\nV\n1,0\n\"D\"\n1,0\n\"S\"\n1,0\n\"123\"\n0,4\nV\n")
        );
        assert!(columns.ends_with("-1,0\nEOD\n"));
        let rows = text(DifConvention::Rows);
        assert!(rows.contains("VECTORS\n0,0000000000\n\"\"\nTUPLES\n0,23\n"), "{rows}");
        assert!(rows.contains("BOT\n0,1\n\n0,0.001000000\n\n1,0\n\"D\"\n"));
    }

    #[test]
    fn the_number_of_rows_is_put_in_where_the_file_allows_it() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.dif");
        let mut writer = crate::create_writer(&path, &WriteOptions::default()).unwrap();
        for at in 0..3 {
            writer.write(&data_record(at)).unwrap();
        }
        writer.finish().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains("TUPLES\r\n0,0000000004\r\n"), "{text}");
    }

    #[test]
    fn a_cut_table_gives_the_rows_before_the_cut() {
        let whole = tests::write(Format::Dif, &[data_record(1), data_record(2), data_record(3)]);
        for keep in [whole.len() - 6, whole.len() - 12, whole.len() - 40] {
            let (records, issues) = tests::read(Format::Dif, &whole[..keep]);
            assert_eq!((records.len(), issues.len()), (2, 1), "{issues:?}");
        }
    }

    /// A line more or less put all pairs behind it out of step, to the end of the file.
    #[test]
    fn a_damaged_row_is_one_issue_and_the_rows_behind_it_are_read() {
        let records: Vec<_> = (1..=6).map(data_record).collect();
        let whole = tests::write(Format::Dif, &records);
        let lines: Vec<_> = whole.split_inclusive('\n').collect();
        let begins: Vec<_> = (0..lines.len()).filter(|at| lines[*at] == "BOT\r\n").collect();
        // The names of the columns, then the rows: from the third's first cell to the mark of the fourth.
        for at in begins[3] + 1..begins[4] {
            let without = [&lines[..at], &lines[at + 1..]].concat().concat();
            let with = [&lines[..at], &["rubbish\r\n"], &lines[at..]].concat().concat();
            for text in [without, with] {
                let (read, issues) = tests::read(Format::Dif, text);
                assert_eq!(issues.len(), 1, "line {at}: {issues:?}");
                assert!(read.len() >= 4, "line {at}: {}", read.len());
                assert_eq!(read[..2], records[..2]);
                assert_eq!(read[read.len() - 2..], records[4..]);
            }
        }
    }
}
