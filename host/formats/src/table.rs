//! Tables of any columns: what they mean is said by the user, shown by the names above them, or by the first row.

mod cells;
mod columns;
mod identifiers;
mod kind;
mod layout;
mod time;

pub use columns::{BadColumns, Columns};
pub(crate) use columns::{TypedColumn, TypedForm};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::frame_fields::{FdFields, FrameFields, Payload, identifier};
use super::interfaces::Interfaces;
use super::issue::Fault;
use super::panda::{self, REJECTED};
use super::row_format::{Line, RowFormat};
use super::text;
use super::zone::Zone;
use cantap_trace::fd::FD_LENGTHS;
use cantap_trace::{TraceRecord, counted};
pub(crate) use cells::lists_are_decimal;
use cells::{byte, direction, id, is_bracketed, is_empty, is_list, length, mark, push_bytes};
use columns::{Form, Role};
use identifiers::count_rows;
pub(crate) use identifiers::ids_are_decimal;
use kind::Kind;
use layout::{Layout, Separator};
use time::FileDate;
pub(crate) use time::{date, going_on};

const NO_TIMES: &str = "the table has no times: all its frames stand at 0";
const OTHERS: &str = "columns of the table that have no place in a trace, such as labels, were left out";
const ABOVE_NAMES: &str = "lines above the names of the table's columns";
const NAMES_AGAIN: &str = "further lines of names of columns";
const ERROR_FRAMES: &str = "rows marked as error frames, of which a table does not say enough";
const MAY_BE_DECIMAL: &str =
    "identifiers were read as hexadecimal, but may be decimal: the columns say so with id=NAME:dec";

/// Reads the rows.
#[derive(Default)]
pub(crate) struct Decoder {
    columns: Option<Columns>,
    layout: Option<Layout>,
    /// The first rows, to see how numbers are written in them.
    sample: Vec<u8>,
    /// The name of the first column.
    first_name: Vec<u8>,
    /// How many lines there are still above the names of the columns.
    above: usize,
    unit_ns: Option<i64>,
    day: Option<FileDate>,
    /// The last time of a clock without a date.
    clock_ns: Option<i64>,
    interfaces: Interfaces,
    radix: Radix,
    /// Whether cells come apart, from columns with types, of which one may have nothing in a row.
    is_typed: bool,
    notes: Vec<&'static str>,
}

/// Whether numbers are decimal.
#[derive(Clone, Copy, Default)]
pub(crate) struct Radix {
    pub(crate) id: bool,
    pub(crate) data: bool,
    /// Of bytes in brackets, as Python prints lists and numpy arrays.
    pub(crate) lists: bool,
}

/// Whether a line is the names above the columns of a table, or a row of one without names.
pub(crate) fn is_first(line: &[u8]) -> bool {
    Layout::of_names(line).is_some() || Layout::of_row(line).is_some()
}

/// Whether names above columns, with one of times among them, stand below lines about the vehicle or the logger.
pub(crate) fn has_names_below(head: &[u8]) -> bool {
    let is_names =
        |line: &[u8]| Layout::of_names(line).is_some_and(|layout| layout.place(Role::Time).is_some());
    first_lines(head).take(LINES).any(is_names)
        || memchr::memmem::find(head, b"\nLine,Abs Time(Sec),").is_some()
}

/// The cells of a line, without quotation marks and the space around them.
pub(crate) fn split_cells(separator: u8, line: &[u8]) -> Vec<&[u8]> {
    Separator::Byte(separator).cells(line)
}

/// How many lines may stand above the names in a table that is not known otherwise.
const LINES: usize = 40;

/// Of a line, what may be cells: a tab at its beginning is behind a cell with nothing in it, such as the name above pandas' numbers of rows.
fn without_space(line: &[u8]) -> &[u8] {
    let line = line.trim_ascii_end();
    let blanks = line.iter().take_while(|byte| **byte == b' ').count();
    &line[blanks..]
}

/// The lines that are no comments, among which the names above the columns are looked for.
fn first_lines(head: &[u8]) -> impl Iterator<Item = &[u8]> {
    let lines = head.split(|byte| *byte == b'\n').map(without_space);
    lines.filter(|line| !line.is_empty() && !line.starts_with(b"#"))
}

/// What a name says of a frame, if it is something that many frames may have in common: `0`, `1` and `2` for the time, the channel and the direction.
pub(crate) fn role_of_many(name: &str) -> Option<u8> {
    match columns::role_of(name.as_bytes())?.0 {
        Role::Time => Some(0),
        Role::Channel => Some(1),
        Role::Direction => Some(2),
        _ => None,
    }
}

/// Columns as a user may give them for a table that is not known by itself.
pub(crate) fn proposal(head: &[u8]) -> Option<String> {
    layout::proposal(first_lines(head).next()?)
}

/// The same for one without names, if one of the first rows shows it.
pub(crate) fn proposal_of_rows(head: &[u8]) -> Option<String> {
    first_lines(head).take(8).find_map(layout::proposal_of_row)
}

impl Decoder {
    /// With the columns that the user gave, if any.
    pub(crate) fn new(columns: Option<Columns>) -> Self {
        Self { columns, ..Self::default() }
    }

    /// Where everything is, and whether this line is a row and not the names above the columns.
    fn layout_of(&self, line: &[u8]) -> Result<(Layout, bool), Fault> {
        match &self.columns {
            Some(columns) => Layout::of_columns(columns, line),
            None => match (Layout::of_names(line), Layout::of_row(line)) {
                (Some(layout), _) => Ok((layout, false)),
                (None, Some(layout)) => Ok((layout, true)),
                (None, None) => {
                    let expected = "names above the columns, among them an identifier and data bytes";
                    Err(Fault::malformed(expected, line))
                }
            },
        }
    }

    /// How many lines stand above the names of the columns, if there are names.
    fn lines_above_names(&self) -> usize {
        /// Vehicle Spy says more of its networks than others of anything.
        const LINES: usize = 400;
        let is_row =
            first_lines(&self.sample).take(LINES).map(|line| self.layout_of(line).map(|(_, is_row)| is_row));
        let first = is_row.enumerate().find_map(|(above, is_row)| Some((above, is_row.ok()?)));
        first.filter(|(_, is_row)| !is_row).map_or(0, |(above, _)| above)
    }

    /// Takes the first line that is no comment or above the names; true if it is a row.
    fn first(&mut self, line: &[u8]) -> Result<bool, Fault> {
        let (layout, is_row) = self.layout_of(line)?;
        self.radix = self.radix_of(&layout, is_row)?;
        self.note_layout(&layout);
        if !is_row {
            self.first_name = layout.separator.cells(line).first().copied().unwrap_or_default().to_vec();
        }
        self.layout = Some(layout);
        self.sample = Vec::new();
        Ok(is_row)
    }

    /// Whether these columns have a frame in each row.
    pub(crate) fn has_frame(&self, columns: &[TypedColumn]) -> bool {
        Layout::of_typed(self.columns.as_ref(), columns).is_ok()
    }

    /// Prepares for rows whose cells come apart, from columns that have types. Returns the columns of which cells are wanted.
    pub(crate) fn begin_typed(&mut self, columns: &[TypedColumn]) -> Result<Vec<usize>, Fault> {
        let layout = Layout::of_typed(self.columns.as_ref(), columns)?;
        self.note_layout(&layout);
        let taken = layout.taken(columns.len());
        self.is_typed = true;
        self.radix.data = layout
            .place(Role::Data)
            .or(layout.place(Role::Bytes))
            .is_some_and(|place| place.form == Some(Form::Decimal));
        self.layout = Some(layout);
        Ok(taken)
    }

    /// Looks at the first rows' cells, before [`Self::typed_row`] takes them.
    pub(crate) fn first_typed_rows<'a>(&mut self, rows: impl Iterator<Item = &'a [&'a [u8]]>) {
        let Some(layout) = &self.layout else { return };
        let place = layout.place(Role::Id);
        let rows: Vec<_> = rows.collect();
        let at = |cells: &&'a [&'a [u8]], role| cells.get(layout.place(role)?.at).copied();
        let ids: Vec<_> = rows.iter().filter_map(|cells| at(cells, Role::Id)).collect();
        let times: Vec<_> =
            rows.iter().filter_map(|cells| at(cells, Role::Time).zip(at(cells, Role::Id))).collect();
        let unit = unit_of(layout, &times);
        let form = place.and_then(|place| place.form);
        let (is_decimal, is_sure) =
            form.map_or_else(|| ids_are_decimal(&ids), |form| (form == Form::Decimal, true));
        self.radix.id = is_decimal;
        if !is_sure {
            self.notes.push(MAY_BE_DECIMAL);
        }
        self.take_unit(unit);
    }

    /// Reads times without a unit in this one, if the rows show one and none was found before.
    fn take_unit(&mut self, unit: Option<(i64, &'static str)>) {
        if let (Some((unit_ns, what)), None) = (unit, self.unit_ns) {
            self.unit_ns = Some(unit_ns);
            self.notes.push(what);
        }
    }

    /// The record of a row with a cell for each column; empty where there is nothing, or where none is wanted.
    pub(crate) fn typed_row(&mut self, cells: &[&[u8]], zone: &Zone) -> Result<Line, Fault> {
        let Some(layout) = self.layout.take() else { return Ok(Line::Nothing) };
        let line = self.line_of_cells(&layout, cells, zone);
        self.layout = Some(layout);
        line
    }

    /// What is worth knowing about the columns.
    fn note_layout(&mut self, layout: &Layout) {
        if layout.place(Role::Time).is_none() {
            self.notes.push(NO_TIMES);
        }
        if layout.has_others {
            self.notes.push(OTHERS);
        }
    }

    /// How identifiers and bytes are written, by what is said, and otherwise by what the first rows have.
    fn radix_of(&mut self, layout: &Layout, is_row: bool) -> Result<Radix, Fault> {
        let rows = first_lines(&self.sample);
        let (mut ids, mut bytes, mut times, mut lists) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let data = layout.place(Role::Data).or(layout.place(Role::Bytes));
        for row in rows.skip(if is_row { 0 } else { self.lines_above_names() + 1 }) {
            let cells = layout.separator.cells(row);
            let at = |role| layout.place(role).and_then(|place| cells.get(place.at)).copied();
            ids.extend(at(Role::Id));
            lists.extend(at(Role::Data).filter(|cell| is_bracketed(cell)));
            times.extend(at(Role::Time).zip(at(Role::Id)));
            if let Some(first) = layout.place(Role::Bytes) {
                bytes.extend(cells.iter().skip(first.at).take(layout.byte_columns.min(8)).copied());
            }
        }
        if self.columns.is_none() && count_rows(&ids) {
            let expected = "identifiers in a column that counts the rows: --columns id=NAME,data=NAME says which has them";
            return Err(Fault::malformed(expected, ids[0]));
        }
        let unit = unit_of(layout, &times);
        let form = layout.place(Role::Id).and_then(|place| place.form);
        let (id, is_sure) = form.map_or_else(|| ids_are_decimal(&ids), |form| (form == Form::Decimal, true));
        if !is_sure {
            self.notes.push(MAY_BE_DECIMAL);
        }
        let data = match data.and_then(|place| place.form) {
            Some(form) => form == Form::Decimal,
            // Hexadecimal bytes have two digits at most.
            None => bytes.iter().any(|byte| {
                let number = cells::whole(byte);
                text::decimal(number).is_some() && (number.len() == 3 || number.len() < byte.len())
            }),
        };
        let lists = lists_are_decimal(&lists);
        self.take_unit(unit);
        Ok(Radix { id, data, lists })
    }

    fn time_ns(&mut self, cell: &[u8], form: Option<Form>, zone: &Zone) -> Result<i64, Fault> {
        let is_number =
            |byte: &u8| byte.is_ascii_digit() || matches!(byte, b'.' | b',' | b'-' | b'+' | b'e' | b'E');
        let time_ns = if cell.iter().all(is_number) {
            let unit_ns = match (form, self.unit_ns) {
                (Some(Form::Unit(unit_ns)), _) | (_, Some(unit_ns)) => unit_ns,
                _ => *self.unit_ns.insert(time::unit_of(cell)),
            };
            time::number(cell, unit_ns)
        } else {
            time::stamp(cell, self.day, zone).or_else(|| time::with_unit(cell)).or_else(|| {
                let time_ns = time::date(cell, zone)?;
                if cell.contains(&b'-') || cell.contains(&b'/') {
                    return Some(time_ns);
                }
                // A clock without a date begins again at midnight.
                self.clock_ns = Some(time::going_on(time_ns, self.clock_ns));
                self.clock_ns
            })
        };
        time_ns.ok_or_else(|| Fault::malformed("a time: a number or a date", cell))
    }

    fn row(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        let Some(layout) = self.layout.take() else { return Ok(Line::Nothing) };
        let record = if is_rejected(&layout, line) {
            Ok(Line::LeftOut(REJECTED))
        } else if self.names_again(&layout, line) {
            Ok(Line::LeftOut(NAMES_AGAIN))
        } else {
            self.line_of_row(&layout, line, zone)
        };
        self.layout = Some(layout);
        record
    }

    /// Whether a line has names as the first one had: those of another bus, or of the next file of several that were joined.
    fn names_again(&self, layout: &Layout, line: &[u8]) -> bool {
        let is_name = self.first_name.iter().any(u8::is_ascii_alphabetic);
        let cells = layout.separator.cells(line);
        let has_numbers = cells.iter().any(|cell| text::decimal(cell).is_some());
        is_name
            && !has_numbers
            && cells.first().is_some_and(|cell| cell.eq_ignore_ascii_case(&self.first_name))
    }

    fn line_of_row(&mut self, layout: &Layout, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        let cells = layout.separator.cells(line);
        if cells.len() < layout.least_cells() {
            return Err(Fault::malformed(format!("{} cells or more", layout.least_cells()), line));
        }
        self.line_of_cells(layout, &cells, zone)
    }

    fn line_of_cells(&mut self, layout: &Layout, cells: &[&[u8]], zone: &Zone) -> Result<Line, Fault> {
        let error = layout.place(Role::Error).and_then(|place| cells.get(place.at));
        let kinds = layout.kinds.iter().filter_map(|(at, is_type)| Some(Kind::of(cells.get(*at)?, *is_type)));
        let kind = kinds.fold(Kind::default(), Kind::and);
        if error.and_then(|cell| mark(cell)) == Some(true) || kind.is_error {
            return Ok(Line::LeftOut(ERROR_FRAMES));
        }
        self.record_of_cells(layout, cells, kind, zone).map(Line::Record)
    }

    fn record_of_cells(
        &mut self,
        layout: &Layout,
        cells: &[&[u8]],
        kind: Kind,
        zone: &Zone,
    ) -> Result<TraceRecord, Fault> {
        let is_typed = self.is_typed;
        let cell = |role| {
            let place = layout.place(role)?;
            let shown = cells.get(place.at).copied().unwrap_or_default();
            // What has no value in a row says nothing there.
            let is_absent =
                is_typed && shown.is_empty() && matches!(role, Role::Dlc | Role::Extended | Role::Channel);
            (!is_absent).then_some((shown, place.form))
        };
        let time_ns = match cell(Role::Time) {
            Some((time, form)) => self.time_ns(time, form, zone)?,
            None => 0,
        };
        let (shown, _) = cell(Role::Id).unwrap_or_default();
        let raw = id(shown, self.radix.id)?;
        let extended = cell(Role::Extended).and_then(|(cell, _)| mark(cell)).or(kind.extended);
        let id = identifier(raw, extended.unwrap_or(raw > 0x7FF), shown)?;
        let remote = match cell(Role::Remote).map(|(cell, _)| (cell, mark(cell))) {
            // Vehicle Spy's flags of CAN FD, whose bytes go on in other columns.
            Some((flags, None)) if flags.contains(&b'-') => {
                return Err(Fault::malformed(
                    "T or F for a remote frame: CAN FD is not read from such a table",
                    flags,
                ));
            }
            Some((_, remote)) => remote.or(kind.remote).unwrap_or(false),
            None => kind.remote.unwrap_or(false),
        };
        let direction = match cell(Role::Direction) {
            Some((way, _)) => direction(way)?,
            None => kind.direction.unwrap_or_default(),
        };
        let (channel, direction) = match cell(Role::Channel) {
            Some((bus, _)) if layout.is_cabana => {
                let known = text::decimal(bus).and_then(|bus| panda::bus(u8::try_from(bus).ok()?));
                known.ok_or_else(|| Fault::malformed("a bus of 0 to 255", bus))?
            }
            Some((name, form)) => (self.channel(name, form)?, direction),
            None => (1, direction),
        };
        let len = match cell(Role::Dlc) {
            Some((cell, _)) => Some(length(cell)?),
            None => None,
        };
        let data = if remote { Payload::EMPTY } else { self.data(layout, cells, len)? };
        let count = data.as_slice().len();
        let code = len.filter(|_| remote || count == 8).filter(|len| *len <= 15);
        let is_fd = count > 8 || kind.fd && !remote;
        let fd = is_fd.then_some(FdFields { brs: kind.brs, esi: kind.esi });
        let code = code.filter(|code| !is_fd && (*code >= 8 || remote));
        let len = code.unwrap_or(count);
        let fields = FrameFields { id, remote, direction, len: len as u8, fd };
        Ok(TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? })
    }

    fn channel(&mut self, name: &[u8], form: Option<Form>) -> Result<u8, Fault> {
        let Some(number) = text::decimal(name) else { return Ok(self.interfaces.channel(name)) };
        let channel = number.checked_add(u64::from(form == Some(Form::FromZero)));
        let channel = channel.and_then(|channel| u8::try_from(channel).ok());
        channel.ok_or_else(|| Fault::malformed("a channel of 0 to 255", name))
    }

    /// The bytes, as many as the length says if there is one.
    fn data(&self, layout: &Layout, cells: &[&[u8]], len: Option<usize>) -> Result<Payload, Fault> {
        let mut decimal = self.radix.data;
        let mut bytes = Vec::with_capacity(8);
        if let Some(place) = layout.place(Role::Data) {
            let is_decimal_list = |cell: &&[u8]| is_list(cell) || self.radix.lists && is_bracketed(cell);
            decimal |= place.form.is_none() && cells.get(place.at).is_some_and(is_decimal_list);
            let is_last = layout.separator == Separator::Blanks;
            let end = if is_last { cells.len() } else { (place.at + 1).min(cells.len()) };
            for cell in cells.get(place.at..end).unwrap_or_default() {
                if layout.is_base64 {
                    bytes = STANDARD.decode(cell).map_err(|_| Fault::malformed("bytes in base64", cell))?;
                } else {
                    push_bytes(cell, decimal, &mut bytes)?;
                }
            }
            let fits = |len: usize| {
                len == bytes.len()
                    || bytes.len() == 8 && (9..16).contains(&len)
                    || FD_LENGTHS.get(len).is_some_and(|fd| usize::from(*fd) == bytes.len())
            };
            if let Some(len) = len.filter(|len| !fits(*len)) {
                let found = counted(bytes.len(), "byte");
                return Err(Fault::malformed(counted(len, "data byte"), found.as_bytes()));
            }
        } else if let Some(first) = layout.place(Role::Bytes) {
            let columns = cells.iter().skip(first.at).take(layout.byte_columns);
            match len {
                Some(len) => {
                    // A classical frame's code may be above 8; it has 8 bytes all the same.
                    let here = columns.clone().filter(|cell| !cell.is_empty()).count();
                    let len = if (9..16).contains(&len) && here < len { 8 } else { len };
                    let parse = |cell: &[u8]| byte(cell, decimal);
                    return Payload::words(columns.copied(), len, parse);
                }
                None => {
                    for cell in columns.take_while(|cell| !is_empty(cell)) {
                        push_bytes(cell, decimal, &mut bytes)?;
                    }
                }
            }
        }
        let found = counted(bytes.len(), "byte");
        Payload::of(&bytes)
            .filter(|_| bytes.len() <= 8 || FD_LENGTHS.iter().any(|fd| usize::from(*fd) == bytes.len()))
            .ok_or_else(|| Fault::malformed("a number of bytes that CAN or CAN FD has", found.as_bytes()))
    }
}

/// The unit of the times in these rows, each with its identifier, and what to say of it, where nothing else shows it.
fn unit_of(layout: &Layout, rows: &[(&[u8], &[u8])]) -> Option<(i64, &'static str)> {
    let has_unit = layout.place(Role::Time)?.form.is_some();
    // A date of our days shows its unit.
    let is_date = rows.iter().any(|(time, _)| time::unit_of(time) != text::NS_PER_S);
    (!has_unit && !is_date).then(|| time::unit_of_rows(rows))?
}

/// Whether a row is of a frame that was never on the bus.
fn is_rejected(layout: &Layout, line: &[u8]) -> bool {
    let Some(place) = layout.place(Role::Channel).filter(|_| layout.is_cabana) else { return false };
    let cells = layout.separator.cells(line);
    let bus = cells.get(place.at).and_then(|bus| text::decimal(bus)).and_then(|bus| u8::try_from(bus).ok());
    bus.is_some_and(|bus| panda::bus(bus).is_none())
}

impl RowFormat for Decoder {
    fn begin(&mut self, buffered: &[u8]) {
        const SAMPLE_BYTES: usize = 64 << 10;
        // The last line may not be whole.
        let sample = &buffered[..buffered.len().min(SAMPLE_BYTES)];
        self.sample = memchr::memrchr(b'\n', sample).map_or(sample, |end| &sample[..end]).to_vec();
        self.above = self.lines_above_names();
    }

    fn trims(&self) -> bool {
        false
    }

    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        let line = without_space(line);
        if line.is_empty() || line.starts_with(b"#") {
            self.day = self.day.or_else(|| FileDate::of_comment(line));
            return Ok(Line::Nothing);
        }
        if self.above > 0 {
            self.above -= 1;
            return Ok(Line::LeftOut(ABOVE_NAMES));
        }
        if self.layout.is_none() && !self.first(line)? {
            return Ok(Line::Nothing);
        }
        self.row(line, zone)
    }

    fn may_be_cut(&self, line: &[u8], record: &TraceRecord) -> bool {
        let Some(layout) = &self.layout else { return true };
        let cells = layout.separator.cells(line);
        let data_len = record.frame().map_or(0, |frame| frame.data().len());
        // Where the cells of the bytes end, of which there are as many as the length says.
        let end = match (layout.place(Role::Bytes), layout.place(Role::Data)) {
            (Some(first), _) => first.at + data_len,
            (None, place) => place.map_or(0, |place| place.at + 1),
        };
        let later = [Role::Time, Role::Id, Role::Dlc, Role::Channel].into_iter();
        let is_behind = |role| layout.place(role).is_some_and(|place| place.at >= end);
        let is_whole = cells.len() > end || cells.last().is_some_and(|last| last.len() >= 2);
        layout.place(Role::Dlc).is_none() || data_len == 0 || !is_whole || later.into_iter().any(is_behind)
    }

    fn note(&mut self) -> Option<&'static str> {
        self.notes.pop()
    }
}

#[cfg(test)]
mod tests;
