//! Parquet: our own tables of records with everything in them, and other programs' tables of frames, whose columns are known by their
//! names or said by the user as those of a text.
//!
//! The file is read in many places, and its directory stands at its end: a file without its end has nothing that can be read.

use std::io;

use cantap_columns::parquet::ParquetReader;
use cantap_columns::{BadColumns, CellKind, RecordBatch, Row, cells, rows};

use super::codec::Decode;
use super::found::Found;
use super::input::Input;
use super::issue::{Fault, Place};
use super::row_format::{Line, RowFormat as _};
use super::table::{self, Columns, TypedColumn, TypedForm};
use super::zone::Zone;
use cantap_trace::clean;

const VALUES: &str = "decoded values, whose frames are not in the table";

/// Reads a file.
pub(crate) struct Decoder {
    columns: Option<Columns>,
    state: State,
    /// What the last batch contained, the last one first.
    found: Vec<Found>,
    /// Rows before the next batch.
    rows: i64,
}

enum State {
    Closed,
    Open(Box<Opened>),
    Ended,
}

struct Opened {
    reader: ParquetReader,
    table: Option<Table>,
    zone: Zone,
}

/// A table of another program.
struct Table {
    decoder: table::Decoder,
    /// Which columns are wanted.
    taken: Vec<usize>,
    columns: usize,
    begun: bool,
}

impl Decoder {
    pub(crate) fn new(columns: Option<Columns>) -> Self {
        Self { columns, state: State::Closed, found: Vec::new(), rows: 0 }
    }

    /// The state in which reading begins, and what to report about it.
    fn open(&mut self, input: &mut Input) -> io::Result<State> {
        let zone = input.zone().clone();
        let file = input.whole()?;
        if file.len() == 0 {
            return Ok(State::Ended);
        }
        let begun = ParquetReader::open(file.into_source())
            .map_err(|error| of_file(&error.to_string()))
            .and_then(|reader| Ok((Table::of(&reader, self.columns.take())?, reader)));
        match begun {
            Ok((table, reader)) => Ok(State::Open(Box::new(Opened { reader, table, zone }))),
            Err(fault) => {
                self.found.push(Found::Issue(Place::Offset(0), fault));
                Ok(State::Ended)
            }
        }
    }

    /// Reads the next batch into `found`; false at the end.
    fn batch(&mut self) -> bool {
        let State::Open(opened) = &mut self.state else { return false };
        let Opened { reader, table, zone } = opened.as_mut();
        let Some(batch) = reader.next() else { return false };
        match batch {
            Err(lost) => {
                let fault = of_file(&lost.to_string());
                self.found.push(Found::Issue(Place::Row(place(lost.from)), fault));
                self.rows = self.rows.max(place(lost.from.saturating_add(lost.rows)) - 1);
            }
            Ok(batch) => {
                let len = batch.num_rows();
                let result = match table {
                    Some(table) => table.push(&batch, self.rows, zone, &mut self.found),
                    None => push_records(&batch, self.rows, &mut self.found),
                };
                self.rows += len as i64;
                if let Err(error) = result {
                    self.found.push(Found::Issue(Place::Row(self.rows), of_columns(&error)));
                    self.state = State::Ended;
                }
            }
        }
        self.found.reverse();
        true
    }
}

/// A row's number, from 1, of its index.
fn place(index: u64) -> i64 {
    i64::try_from(index).unwrap_or(i64::MAX - 1) + 1
}

/// What is wrong, of which the names of columns are a stranger's.
fn malformed(expected: &'static str, found: &str) -> Fault {
    /// Enough for the longest sentence with some names.
    const SHOWN: usize = 400;
    let found: String = clean::line(found).chars().take(SHOWN).collect();
    Fault::Malformed { expected: expected.into(), found }
}

fn of_file(error: &str) -> Fault {
    malformed("a Parquet file that is whole, with its directory at the end", error)
}

fn of_columns(error: &BadColumns) -> Fault {
    malformed("columns of a trace", &error.to_string())
}

/// The rows of a table of records.
fn push_records(batch: &RecordBatch, before: i64, found: &mut Vec<Found>) -> Result<(), BadColumns> {
    for (row, number) in rows(batch)?.into_iter().zip(before + 1..) {
        found.push(match row {
            Row::Record(record) => Found::Record(record),
            Row::Value => Found::LeftOut(VALUES),
            Row::Bad(what) => Found::Issue(Place::Row(number), malformed("a row of a trace", &what)),
        });
    }
    Ok(())
}

impl Table {
    /// `None` if it is a table of records.
    fn of(reader: &ParquetReader, columns: Option<Columns>) -> Result<Option<Self>, Fault> {
        let schema = reader.schema();
        let as_records = rows(&RecordBatch::new_empty(schema.clone()));
        if columns.is_none() && as_records.is_ok() {
            return Ok(None);
        }
        let typed: Vec<_> = schema
            .fields()
            .iter()
            .map(|field| {
                let form = match CellKind::of(field.data_type()) {
                    Some(CellKind::Time) => TypedForm::Seconds,
                    Some(CellKind::Number) => TypedForm::Number,
                    Some(CellKind::Bytes) => TypedForm::Bytes,
                    Some(CellKind::Text) => TypedForm::Text,
                    None => TypedForm::None,
                };
                TypedColumn { name: field.name(), form }
            })
            .collect();
        let mut decoder = table::Decoder::new(columns);
        let taken = decoder.begin_typed(&typed)?;
        Ok(Some(Self { decoder, taken, columns: typed.len(), begun: false }))
    }

    /// The rows of a batch. If a cell is out of range, only its row is not read: halves are tried apart.
    fn push(
        &mut self,
        batch: &RecordBatch,
        before: i64,
        zone: &Zone,
        found: &mut Vec<Found>,
    ) -> Result<(), BadColumns> {
        let mut columns: Vec<Vec<Option<String>>> = vec![Vec::new(); self.columns];
        for at in &self.taken {
            match cells(batch, *at) {
                Ok(cells) => columns[*at] = cells,
                Err(BadColumns::Row { what, .. }) if batch.num_rows() == 1 => {
                    let fault = malformed("a row of a trace", &what);
                    found.push(Found::Issue(Place::Row(before + 1), fault));
                    return Ok(());
                }
                Err(BadColumns::Row { .. }) => {
                    let half = batch.num_rows() / 2;
                    self.push(&batch.slice(0, half), before, zone, found)?;
                    let rest = batch.slice(half, batch.num_rows() - half);
                    return self.push(&rest, before + half as i64, zone, found);
                }
                Err(error) => return Err(error),
            }
        }
        let cell = |at: usize, row: usize| {
            columns[at].get(row).and_then(Option::as_deref).unwrap_or_default().trim().as_bytes()
        };
        let rows: Vec<Vec<&[u8]>> =
            (0..batch.num_rows()).map(|row| (0..self.columns).map(|at| cell(at, row)).collect()).collect();
        if !std::mem::replace(&mut self.begun, true) {
            self.decoder.first_typed_rows(rows.iter().map(Vec::as_slice));
        }
        for (row, number) in rows.iter().zip(before + 1..) {
            found.extend(match self.decoder.typed_row(row, zone) {
                Ok(Line::Record(record)) => Some(Found::Record(record)),
                Ok(Line::LeftOut(what)) => Some(Found::LeftOut(what)),
                Ok(_) => None,
                Err(fault) => Some(Found::Issue(Place::Row(number), fault)),
            });
        }
        found.extend(std::iter::from_fn(|| self.decoder.note()).map(Found::Note));
        Ok(())
    }
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if matches!(self.state, State::Closed) {
            self.state = self.open(input)?;
        }
        while self.found.is_empty() {
            if !self.batch() {
                self.state = State::Ended;
                return Ok(Found::End);
            }
        }
        Ok(self.found.pop().unwrap_or(Found::End))
    }
}
