//! Turns records into rows of the table, and does the writing that the two kinds of file have in common.

use cantap_can::BusErrorKind;
use cantap_can::Frame;

use super::super::calendar::{Date, start_of_trace};
use super::super::codec::Encode;
use super::super::left_out::LeftOut;
use super::super::output::Patch;
use super::super::text::{self, NS_PER_S};
use super::super::zone::Zone;
use super::{ERRORS, OVERRUN};
use cantap_trace::bits::FrameBits;
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};

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

/// Makes rows from records. The last row is held back until it is known whether frames were lost after it.
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

    /// Takes a record; returns the row before it.
    pub(crate) fn add(&mut self, record: &TraceRecord, left_out: &mut LeftOut) -> Option<TableRow> {
        let offset_ns = record.time_ns.saturating_sub(self.start(record.time_ns));
        let content = match record.event {
            TraceEvent::Frame { frame: TraceFrame::Fd(_), .. } => {
                left_out.note("CAN FD frames, which the analyser's table has no row for");
                return None;
            }
            TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction, .. } => {
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
                        let is_mark = record.event == OVERRUN && record.channel == 1;
                        if !is_mark || row.offset_ns != offset_ns {
                            left_out.note(
                                "how many frames were lost: the analyser's table marks only that some were",
                            );
                        }
                    }
                    _ => left_out.note("losses without a frame of their own before them"),
                }
                return None;
            }
            TraceEvent::State { .. }
            | TraceEvent::ErrorsSuppressed { .. }
            | TraceEvent::TransmitFailed { .. }
            | TraceEvent::Disturbed { .. }
            | TraceEvent::Lin { .. } => {
                left_out.note("changes of state and other events, which the analyser's table has no row for");
                return None;
            }
        };
        if record.channel != 1 {
            left_out.note("channels other than 1, which the analyser's table has no column for");
        }
        self.rows += 1;
        self.held.replace(TableRow { index: self.rows, offset_ns, content, overrun: false })
    }

    /// The last row.
    pub(crate) fn last(&self) -> Option<&TableRow> {
        self.held.as_ref()
    }

    /// Number of rows so far.
    pub(crate) fn rows(&self) -> u64 {
        self.rows
    }
}

impl TableRow {
    /// Passes each cell in turn.
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

/// The comment with the start: `Date: 2014-09-14 17:14:42.622`.
pub(crate) fn date_comment(start_ns: i64) -> String {
    let date = Date::of(start_ns);
    let (hour, minute, second, ns) = date.clock();
    let (year, month, day) = (date.year, date.month, date.day);
    format!("Date: {year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}.{:03}", ns / 1_000_000)
}

/// How a kind of file represents the table.
pub(crate) trait Layout: Send {
    /// Appends everything before the rows, with the comment that names the start.
    fn head(&mut self, date: &str, out: &mut Vec<u8>);

    /// Appends a row.
    fn row(&self, row: &TableRow, out: &mut Vec<u8>);

    /// Appends everything after the rows.
    fn end(&self, _out: &mut Vec<u8>) {}

    /// What to change in the file after `rows` rows.
    fn patch(&self, _rows: u64) -> Option<Patch> {
        None
    }
}

/// Writes the table in a layout.
pub(crate) struct TableEncoder<L> {
    layout: L,
    rows: RowEncoder,
    started: bool,
    /// The zone of the date.
    zone: Zone,
}

impl<L: Layout> TableEncoder<L> {
    /// `zone` is the zone of the file's date.
    pub(crate) fn new(layout: L, zone: &Zone) -> Self {
        Self { layout, rows: RowEncoder::default(), started: false, zone: zone.clone() }
    }

    fn start(&mut self, first_ns: i64, out: &mut Vec<u8>) {
        if !std::mem::replace(&mut self.started, true) {
            let clock_ns = self.zone.clock_ns(self.rows.start(first_ns));
            self.layout.head(&date_comment(clock_ns), out);
        }
    }
}

impl<L: Layout> Encode for TableEncoder<L> {
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut) {
        self.start(record.time_ns, out);
        if let Some(row) = self.rows.add(record, left_out) {
            self.layout.row(&row, out);
        }
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.start(0, out);
        self.provisional_end(out);
    }

    fn provisional_end(&self, out: &mut Vec<u8>) {
        if !self.started {
            return;
        }
        if let Some(row) = self.rows.last() {
            self.layout.row(row, out);
        }
        self.layout.end(out);
    }

    fn patch(&self, _written: u64) -> Option<Patch> {
        self.layout.patch(self.rows.rows())
    }
}
