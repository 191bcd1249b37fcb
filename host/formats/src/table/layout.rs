//! Where in a row of a table everything is.

use cantap_trace::counted;

use super::super::issue::Fault;
use super::super::text::{self, NS_PER_S};
use super::super::zone::Zone;
use super::columns::{Column, Columns, Form, ROLES, Role, kind_of, role_of};
use super::columns::{TypedColumn, TypedForm};

/// What separates the cells of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Separator {
    Byte(u8),
    /// One or more blanks.
    Blanks,
}

impl Separator {
    /// The one that makes the most cells of a line.
    pub(super) fn of(line: &[u8]) -> Self {
        let count = |separator: u8| memchr::memchr_iter(separator, line).count();
        let most = [b';', b'\t', b','].into_iter().max_by_key(|separator| count(*separator));
        most.filter(|separator| count(*separator) > 0).map_or(Self::Blanks, Self::Byte)
    }

    /// The cells of a line, without quotation marks and the space around them.
    pub(super) fn cells(self, line: &[u8]) -> Vec<&[u8]> {
        let Self::Byte(separator) = self else {
            return line.split(u8::is_ascii_whitespace).filter(|cell| !cell.is_empty()).collect();
        };
        let mut quoted = false;
        line.split(|byte| {
            quoted ^= *byte == b'"';
            *byte == separator && !quoted
        })
        .map(|cell| {
            let cell = cell.trim_ascii();
            cell.strip_prefix(b"\"").and_then(|cell| cell.strip_suffix(b"\"")).unwrap_or(cell).trim_ascii()
        })
        .collect()
    }
}

/// A column of a role: where it is, from 0, and its form.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Place {
    pub at: usize,
    pub form: Option<Form>,
}

/// Where everything is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    pub separator: Separator,
    places: [Option<Place>; ROLES.len()],
    /// How many columns of one byte there are.
    pub byte_columns: usize,
    /// The columns that describe the frame in words, and whether each is one of types.
    pub kinds: Vec<(usize, bool)>,
    /// Whether there are columns that have no place in a trace.
    pub has_others: bool,
    /// Whether it is Cabana's: then buses are numbered as the panda numbers them.
    pub is_cabana: bool,
    /// Whether it is python-can's, saved anew with other separators: its bytes are in base64.
    pub is_base64: bool,
}

impl Layout {
    pub(super) fn place(&self, role: Role) -> Option<Place> {
        self.places[role as usize]
    }

    /// How many cells a row has at least: those of bytes may be missing where a frame has none.
    pub(super) fn least_cells(&self) -> usize {
        let may_be_missing = |role: Role| match role {
            Role::Bytes => true,
            // Of a row that ends with nothing behind a tab, that tab is space at the end of a line.
            Role::Data => matches!(self.separator, Separator::Blanks | Separator::Byte(b'\t')),
            _ => false,
        };
        let needed = ROLES.iter().filter(|(_, role)| !may_be_missing(*role));
        needed.filter_map(|(_, role)| self.place(*role)).map(|place| place.at + 1).max().unwrap_or(0)
    }

    /// From the names above the columns, if they are usual ones.
    pub(super) fn of_names(line: &[u8]) -> Option<Self> {
        let separator = Separator::of(line);
        Self::of_usual_names(separator, &separator.cells(line))
    }

    /// No columns yet.
    const fn empty(separator: Separator) -> Self {
        let kinds = Vec::new();
        Self {
            separator,
            places: [None; ROLES.len()],
            byte_columns: 0,
            kinds,
            has_others: false,
            is_cabana: false,
            is_base64: false,
        }
    }

    fn of_usual_names(separator: Separator, names: &[&[u8]]) -> Option<Self> {
        let mut layout = Self::empty(separator);
        for (at, name) in names.iter().enumerate() {
            match role_of(name) {
                Some((Role::Bytes, form)) => {
                    let first = layout.places[Role::Bytes as usize].get_or_insert(Place { at, form });
                    // Only those side by side are the bytes of a frame.
                    if at == first.at + layout.byte_columns {
                        layout.byte_columns += 1;
                    } else {
                        layout.has_others = true;
                    }
                }
                Some((role, form)) if layout.place(role).is_none() => {
                    layout.places[role as usize] = Some(Place { at, form });
                }
                _ => match kind_of(name) {
                    Some(is_type) => layout.kinds.push((at, is_type)),
                    None => layout.has_others = true,
                },
            }
        }
        // As the panda's own logger and libpanda call the bytes; elsewhere it is the name of a message.
        let at_name = |wanted: &[u8]| names.iter().position(|name| name.eq_ignore_ascii_case(wanted));
        if let (None, None, Some(_), Some(at)) =
            (layout.place(Role::Data), layout.place(Role::Bytes), at_name(b"MessageID"), at_name(b"Message"))
        {
            layout.places[Role::Data as usize] = Some(Place { at, form: Some(Form::Hex) });
            layout.has_others = names.len() > layout.places.iter().flatten().count() + layout.kinds.len();
        }
        layout.is_base64 = names
            == [&b"timestamp"[..], b"arbitration_id", b"extended", b"remote", b"error", b"dlc", b"data"];
        layout.is_cabana = names == [&b"time"[..], b"addr", b"bus", b"data"];
        let has = |role| layout.place(role).is_some();
        let blanks_too = separator != Separator::Blanks || has(Role::Time);
        (has(Role::Id) && (has(Role::Data) || has(Role::Bytes)) && blanks_too).then_some(layout)
    }

    /// From what the user says, and the first line. The second value is whether that line is a row, because every column is a number.
    pub(super) fn of_columns(columns: &Columns, line: &[u8]) -> Result<(Self, bool), Fault> {
        let separator = Separator::of(line);
        Self::of_given_columns(columns, separator, &separator.cells(line))
    }

    fn of_given_columns(
        columns: &Columns,
        separator: Separator,
        names: &[&[u8]],
    ) -> Result<(Self, bool), Fault> {
        let mut layout = Self::empty(separator);
        let mut is_row = true;
        for Column { role, name, form } in &columns.0 {
            let same = |cell: &&[u8]| cell.eq_ignore_ascii_case(name.as_bytes());
            let number = || text::decimal(name.as_bytes()).filter(|number| *number > 0);
            let at = match (names.iter().position(same), number()) {
                // A number that also stands in the first row is still a number.
                (_, Some(number)) => usize::try_from(number - 1).ok(),
                (Some(at), None) => {
                    is_row = false;
                    Some(at)
                }
                (None, None) => None,
            };
            let at = at.ok_or_else(|| {
                Fault::malformed(format!("a column with the name '{name}'"), &names.join(&b", "[..]))
            })?;
            layout.places[*role as usize] = Some(Place { at, form: *form });
        }
        if let Some(first) = layout.place(Role::Bytes) {
            let others = layout.places.iter().flatten().map(|place| place.at).filter(|at| *at > first.at);
            let end = others.min().unwrap_or(usize::MAX);
            let is_byte = |name: &&&[u8]| is_row || matches!(role_of(name), Some((Role::Bytes, _)));
            let columns = names.iter().skip(first.at).take_while(is_byte).count();
            // Rows may be longer than the first, whose frame may have no bytes.
            layout.byte_columns = (end - first.at).min(if is_row { usize::MAX } else { columns.max(1) });
        }
        Ok((layout, is_row))
    }

    /// Of columns that have types, by what the user says or by their names. A type says how cells are written, unless the user does.
    pub(super) fn of_typed(columns: Option<&Columns>, typed: &[TypedColumn]) -> Result<Self, Fault> {
        // What has no cells has no name either.
        let named = |column: &TypedColumn| column.form != TypedForm::None;
        let names: Vec<&[u8]> =
            typed.iter().map(|column| if named(column) { column.name.as_bytes() } else { b"" }).collect();
        let separator = Separator::Byte(b'\t');
        let mut layout = match columns {
            Some(columns) => Self::of_given_columns(columns, separator, &names)?.0,
            None => Self::of_usual_names(separator, &names).ok_or_else(|| {
                let expected = "columns of a trace, or of frames: say what they are with --columns";
                Fault::malformed(expected, &names.join(&b", "[..]))
            })?,
        };
        for (role, place) in ROLES.iter().zip(&mut layout.places) {
            let Some(place) = place else { continue };
            let Some(column) = typed.get(place.at) else {
                let found = counted(typed.len(), "column");
                return Err(Fault::malformed(format!("a column {}", place.at + 1), found.as_bytes()));
            };
            let of_type = match (role.1, column.form) {
                (Role::Time, TypedForm::Seconds) => Some(Form::Unit(NS_PER_S)),
                (Role::Data | Role::Bytes, TypedForm::Bytes) => Some(Form::Hex),
                (Role::Id | Role::Data | Role::Bytes, TypedForm::Number) if columns.is_none() => {
                    Some(Form::Decimal)
                }
                (Role::Id | Role::Data | Role::Bytes, TypedForm::Number) => {
                    place.form.or(Some(Form::Decimal))
                }
                _ => place.form,
            };
            place.form = of_type;
        }
        Ok(layout)
    }

    /// The columns that have a place in a trace, out of so many.
    pub(super) fn taken(&self, columns: usize) -> Vec<usize> {
        let is_byte = |at: usize| {
            let first = self.place(Role::Bytes).map(|place| place.at);
            first.is_some_and(|first| at >= first && at - first < self.byte_columns)
        };
        let is_other = |at: usize| self.places.iter().flatten().any(|place| place.at == at);
        (0..columns)
            .filter(|at| is_byte(*at) || is_other(*at) || self.kinds.iter().any(|(own, _)| own == at))
            .collect()
    }

    /// From a row of a table without names, if it is like those that people made of logs: see [`Self::with_length`] and [`Self::without_length`].
    pub(super) fn of_row(line: &[u8]) -> Option<Self> {
        let separator = Separator::of(line);
        let cells = separator.cells(line);
        Self::with_length(separator, &cells).or_else(|| Self::without_length(separator, &cells))
    }

    /// A time, an identifier, a length and as many bytes, in one cell or one each. What follows, such as a mark of an attack, has no place in
    /// a trace, nor has the `000` between identifier and length of data sets of HCRL and CrySyS. A channel may stand before an identifier that has `0x`
    /// before it, and a direction before any.
    fn with_length(separator: Separator, cells: &[&[u8]]) -> Option<Self> {
        let is_channel = |cell: &[u8]| cell.len() <= 2 && text::decimal(cell).is_some();
        let is_direction = |cell: &[u8]| cell.eq_ignore_ascii_case(b"rx") || cell.eq_ignore_ascii_case(b"tx");
        let (cells, before, between) = match cells {
            [time, id, b"000", rest @ ..] => (&[&[*time, *id], rest].concat()[..], None, 1),
            [time, channel, id, rest @ ..] if is_channel(channel) && text::after_0x(id).is_some() => {
                (&[&[*time, *id], rest].concat()[..], Some(Role::Channel), 0)
            }
            [time, direction, rest @ ..] if is_direction(direction) => {
                (&[&[*time], rest].concat()[..], Some(Role::Direction), 0)
            }
            _ => (cells, None, 0),
        };
        let [time, id, len, data @ ..] = cells else { return None };
        let is_clock = is_clock(time);
        let is_time = is_clock || text::time(time, NS_PER_S, b'.').is_some() && time.contains(&b'.');
        let is_id = match text::after_0x(id) {
            Some(digits) => matches!(digits.len(), 1..=8) && text::hex(digits).is_some(),
            None => matches!(id.len(), 3 | 4 | 8) && text::hex(id).is_some(),
        };
        let len = text::decimal(len).filter(|len| *len <= 8 && is_id && is_time)? as usize;
        let is_byte = |cell: &&[u8]| cell.len() == 2 && text::hex(cell).is_some();
        let one_each = data.iter().take(len).take_while(|cell| is_byte(cell)).count() == len;
        let in_one = len > 1 && data.first().is_some_and(|cell| byte_count(cell) == Some(len));
        // Where a frame has no bytes, more numbers behind its length are not what this takes them for.
        let is_empty = len == 0 && data.len() > 1 && !data[0].is_empty() && !is_byte(&data[0]);
        if !one_each && !in_one || is_empty || separator == Separator::Blanks && len == 0 {
            return None;
        }
        let mut places = [None; ROLES.len()];
        let hex = Some(Form::Hex);
        let form = (!is_clock).then_some(Form::Unit(NS_PER_S));
        places[Role::Time as usize] = Some(Place { at: 0, form });
        if let Some(role) = before {
            places[role as usize] = Some(Place { at: 1, form: None });
        }
        let before = usize::from(before.is_some());
        // Without `0x` the rows show whether they are decimal, as those of `tshark -T fields` are.
        let form = text::after_0x(id).and(hex);
        places[Role::Id as usize] = Some(Place { at: 1 + before, form });
        places[Role::Dlc as usize] = Some(Place { at: 2 + before + between, form: None });
        let role = if one_each { Role::Bytes } else { Role::Data };
        places[role as usize] = Some(Place { at: 3 + before + between, form: hex });
        let has_others = data.len() > if one_each { len } else { 1 };
        Some(Self { places, byte_columns: usize::MAX, has_others, ..Self::empty(separator) })
    }

    /// A time, an identifier with `0x` before it and all bytes in a cell; or a stamp of CSS Electronics' older loggers, a mark of 29 bits, the
    /// identifier and all bytes in a cell, as in their files without the head.
    fn without_length(separator: Separator, cells: &[&[u8]]) -> Option<Self> {
        let is_hex = |cell: &[u8]| matches!(cell.len(), 1..=8) && text::hex(cell).is_some();
        let is_data = |cell: &[u8]| byte_count(cell).is_some_and(|count| count <= 8);
        let mut places = [None; ROLES.len()];
        let hex = Some(Form::Hex);
        match cells {
            [time, id, data] => {
                let is_time = time.contains(&b'.') && text::time(time, NS_PER_S, b'.').is_some();
                let is_id = text::after_0x(id).is_some_and(is_hex);
                if !is_time || !is_id || !is_data(data) || data.len() < 4 {
                    return None;
                }
                places[Role::Time as usize] = Some(Place { at: 0, form: Some(Form::Unit(NS_PER_S)) });
                places[Role::Id as usize] = Some(Place { at: 1, form: hex });
                places[Role::Data as usize] = Some(Place { at: 2, form: hex });
            }
            [time, b"0" | b"1", id, data] => {
                let is_stamp = is_stamp(time) && separator != Separator::Blanks;
                if !is_stamp || !is_hex(id) || !is_data(data) {
                    return None;
                }
                places[Role::Time as usize] = Some(Place { at: 0, form: None });
                places[Role::Extended as usize] = Some(Place { at: 1, form: None });
                places[Role::Id as usize] = Some(Place { at: 2, form: hex });
                places[Role::Data as usize] = Some(Place { at: 3, form: hex });
            }
            _ => return None,
        }
        Some(Self { places, ..Self::empty(separator) })
    }
}

/// Whether a cell is a time of day, `12:34:56.789`.
fn is_clock(cell: &[u8]) -> bool {
    memchr::memchr_iter(b':', cell).count() == 2
        && cell.first().is_some_and(u8::is_ascii_digit)
        && super::time::date(cell, &Zone::default()).is_some()
}

/// Whether a cell is a day, `T`, and a time of day in digits: `31T135012345`.
fn is_stamp(cell: &[u8]) -> bool {
    let Some(at) = memchr::memchr(b'T', cell) else { return false };
    let digits = [&cell[..at], &cell[at + 1..]].concat();
    matches!((at, cell.len() - at - 1), (2 | 8, 6 | 9)) && digits.iter().all(u8::is_ascii_digit)
}

/// How many bytes a cell of hexadecimal digits is: without gaps, or with a blank between two, or a colon, as `tshark -T fields` has it.
fn byte_count(cell: &[u8]) -> Option<usize> {
    if let Some(gap) = cell.iter().find(|byte| matches!(byte, b' ' | b':')) {
        let is_byte = |word: &[u8]| word.len() == 2 && text::hex(word).is_some();
        return cell.split(|byte| byte == gap).all(is_byte).then_some(cell.len() / 3 + 1);
    }
    let all = cell.len().is_multiple_of(2) && cell.iter().all(u8::is_ascii_hexdigit);
    all.then_some(cell.len() / 2)
}

/// Columns as a user may give them, for a table of unusual names: what is not found is a question mark.
pub(super) fn proposal(line: &[u8]) -> Option<String> {
    let separator = Separator::of(line);
    let names = separator.cells(line);
    if separator == Separator::Blanks || names.len() < 2 {
        return None;
    }
    let named = |wanted: Role| {
        let found = names.iter().find(|name| role_of(name).is_some_and(|(role, _)| role == wanted));
        found.map(|name| String::from_utf8_lossy(name).into_owned())
    };
    let unknown = || "?".to_owned();
    let data = match (named(Role::Data), named(Role::Bytes)) {
        (None, Some(bytes)) => format!("bytes={bytes}"),
        (data, _) => format!("data={}", data.unwrap_or_else(unknown)),
    };
    let [time, id] = [Role::Time, Role::Id].map(|role| named(role).unwrap_or_else(unknown));
    Some(format!("time={time},id={id},{data}"))
}

/// The same for rows without names, such as `7E8 03 41 0C 1A`: columns by their numbers. The bytes are what stands last.
pub(super) fn proposal_of_row(line: &[u8]) -> Option<String> {
    let cells = Separator::of(line).cells(line);
    let bare = |cell: &'_ [u8]| text::after_0x(cell).unwrap_or(cell).to_vec();
    // Sketches print no leading zeros.
    let is_byte = |cell: &&&[u8]| matches!(bare(cell).len(), 1 | 2) && text::hex(&bare(cell)).is_some();
    let mut bytes = cells.iter().rev().take_while(is_byte).count();
    let is_len = |cell: &[u8], bytes: usize| text::decimal(cell) == Some(bytes as u64);
    // One digit before as many bytes is their number; two may be the first byte of a request or a response.
    let first = cells[cells.len() - bytes..].first();
    if first.is_some_and(|first| first.len() == 1 && is_len(first, bytes - 1)) {
        bytes -= 1;
    }
    let before = &cells[..cells.len() - bytes];
    let is_id = |cell: &&[u8]| {
        let digits = bare(cell.strip_suffix(b":").unwrap_or(cell));
        matches!(digits.len(), 3 | 4 | 8) && text::hex(&digits).is_some()
    };
    let is_time = |cell: &[u8]| {
        is_clock(cell)
            || cell.iter().any(|byte| matches!(byte, b'.' | b','))
                && text::time_of_any_mark(cell, NS_PER_S).is_some()
    };
    let time_in = |cells: &[&[u8]]| {
        let at = cells.iter().position(|cell| is_time(cell));
        at.map_or(String::new(), |at| format!("time={},", at + 1))
    };
    // All bytes in a cell, with something between them.
    let in_one = bytes == 0
        && cells
            .last()
            .is_some_and(|cell| cell.len() > 4 && cell.contains(&b' ') && byte_count(cell).is_some());
    if in_one {
        let before = &before[..before.len() - 1];
        // One of 29 bits in decimal digits has more of them.
        let is_decimal =
            |cell: &&[u8]| cell.len() == 9 && text::decimal(cell).is_some_and(|id| id <= 0x1FFF_FFFF);
        let (id, radix) = match before.iter().rposition(is_id) {
            Some(id) => (id, "hex"),
            None => (before.iter().rposition(is_decimal)?, "dec"),
        };
        return Some(format!("{}id={}:{radix},data={}:hex", time_in(before), id + 1, cells.len()));
    }
    let id = before.iter().rposition(is_id).filter(|_| bytes > 0)?;
    let time = time_in(&before[..id]);
    let has_len = before.len() > id + 1 && before.last().is_some_and(|len| is_len(len, bytes));
    let len = if has_len { format!("dlc={},", before.len()) } else { String::new() };
    Some(format!("{time}id={}:hex,{len}bytes={}:hex", id + 1, before.len() + 1))
}
