//! Reading TRC.

use std::io;

use cantap_can::ErrorState;
use cantap_can::{Frame, Id};

use super::super::bit_rates::{self, BitRates};
use super::super::calendar::{Date, NS_PER_DAY};
use super::super::codec::Decode;
use super::super::event_text;
use super::super::found::Found;
use super::super::input::Input;
use super::super::issue::Fault;
use super::super::seek;
use super::super::text;
use super::super::zone::Zone;
use super::layout::{Layout, MAX_COLUMNS};
use super::{BIT_RATE, EPOCH_DAY, TrcVersion, WARNING_ID, bus_row, error_of, event_of};
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

const NS_PER_MS: i64 = 1_000_000;

/// Reads TRC.
pub(crate) struct Decoder {
    version: TrcVersion,
    start_ns: i64,
    has_start: bool,
    /// The header names the version or the columns.
    has_layout: bool,
    has_rows: bool,
    layout: Layout,
    /// The file is a table that PEAK-Converter made, and what is between its cells; 0 before their names.
    table: Option<u8>,
    /// The row before gave an event exactly; the format's own row for it follows.
    told: Option<TraceRecord>,
    /// The zone of the dates.
    zone: Zone,
    bit_rates: BitRates,
    /// The lines of the header are rows of the table of buses.
    in_buses: bool,
}

/// The kind of row.
enum Row {
    Record(TraceRecord),
    /// Something known that is not part of a CAN trace, by kind.
    LeftOut(&'static str),
    /// Part of the header, or covered by the row before.
    Nothing,
}

impl Default for Decoder {
    fn default() -> Self {
        let version = TrcVersion::V1_0;
        Self {
            version,
            start_ns: 0,
            has_start: false,
            has_layout: false,
            has_rows: false,
            layout: Layout::of(version),
            table: None,
            told: None,
            zone: Zone::default(),
            bit_rates: BitRates::new(),
            in_buses: false,
        }
    }
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
        let Self { version, start_ns, has_start, has_layout, has_rows, layout, table, told, .. } = self;
        let bit_rates = &self.bit_rates;
        let version = TrcVersion::ALL.iter().position(|known| known == version);
        told.is_none()
            && seek::save(
                &(version, start_ns, has_start, has_layout, has_rows, layout, table, bit_rates),
                state,
            )
    }

    fn restore(&mut self, state: &[u8]) -> Option<()> {
        let (version, layout): (Option<usize>, Layout);
        let Self { start_ns, has_start, has_layout, has_rows, table, bit_rates, .. } = self;
        (version, *start_ns, *has_start, *has_layout, *has_rows, layout, *table, *bit_rates) =
            seek::load(state)?;
        self.version = *TrcVersion::ALL.get(version?)?;
        self.layout = Some(layout).filter(Layout::is_of_a_row)?;
        Some(())
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        while let Some(line) = input.line()? {
            let text = line.text.trim_ascii();
            let result = match text {
                [] => Ok(Row::Nothing),
                // After the header, nothing more of it is expected: damage may have turned a row into a
                // comment.
                [b';', ..] if self.has_rows => Ok(Row::LeftOut("comments and texts")),
                [b';', comment @ ..] => self.head(comment).map(|()| Row::Nothing),
                [b'$', ..] if !self.has_rows => {
                    self.table = Some(0);
                    self.head(text).map(|()| Row::Nothing)
                }
                _ => match self.table {
                    None | Some(b' ') => self.row(text),
                    Some(0) => {
                        self.table_head(text);
                        Ok(Row::Nothing)
                    }
                    Some(separator) => {
                        let blank = |byte: &u8| if *byte == separator { b' ' } else { *byte };
                        self.row(&text.iter().map(blank).collect::<Vec<_>>())
                    }
                },
            };
            let result = match result {
                Ok(Row::LeftOut(_)) if !line.terminated => return Ok(line.cut()),
                Ok(Row::LeftOut(what)) => return Ok(Found::LeftOut(what)),
                Ok(Row::Record(record)) => Ok(Some(record)),
                Ok(Row::Nothing) => Ok(None),
                Err(fault) => Err(fault),
            };
            match result {
                Ok(row)
                    if !line.terminated
                        && !matches!(text, [] | [b';', ..])
                        && !row.is_some_and(|record| self.is_sure(&record)) =>
                {
                    return Ok(line.cut());
                }
                Ok(Some(record)) => return Ok(Found::Record(record)),
                Ok(None) => {}
                Err(fault) => return Ok(line.issue(fault)),
            }
        }
        Ok(Found::End)
    }
}

impl Decoder {
    /// Whether a row without its line end is certainly complete. An event's row is not, and in version 1 RTR might have
    /// followed a length of 0; any other truncated frame is an error.
    fn is_sure(&self, record: &TraceRecord) -> bool {
        let v1 = self.version < TrcVersion::V2_0;
        record.frame().is_some_and(|frame| frame.dlc() > 0 || frame.is_remote() || !v1)
    }

    /// A line of the header, without the semicolon.
    fn head(&mut self, line: &[u8]) -> Result<(), Fault> {
        let value = |name: &[u8]| line.strip_prefix(name).map(<[u8]>::trim_ascii);
        let words = line.trim_ascii();
        if words.starts_with(b"Bus") && words.ends_with(BIT_RATE.as_bytes()) {
            self.in_buses = true;
        } else if words.starts_with(b"--") {
            self.in_buses = false;
        } else if let Some((channel, bps)) = self.in_buses.then(|| bus_row(words)).flatten() {
            bit_rates::learn(&mut self.bit_rates, channel, bps);
        }
        if let Some(version) = value(b"$FILEVERSION=") {
            self.version = match version {
                b"1.0" => TrcVersion::V1_0,
                b"1.1" => TrcVersion::V1_1,
                b"1.2" => TrcVersion::V1_2,
                b"1.3" => TrcVersion::V1_3,
                b"2.0" => TrcVersion::V2_0,
                b"2.1" => TrcVersion::V2_1,
                other => return Err(Fault::malformed("a version from 1.0 to 2.1", other)),
            };
            self.layout = Layout::of(self.version);
            self.has_layout = true;
        } else if let Some(days) = value(b"$STARTTIME=") {
            let start_ns = time_of_days(days)
                .ok_or_else(|| Fault::malformed("days since 1899-12-30, such as 44548.6028595139", days))?;
            // Programs without a clock write 0.
            if start_ns != -EPOCH_DAY * NS_PER_DAY {
                self.start_ns = self.zone.utc_ns(start_ns);
                self.has_start = true;
            }
        } else if let Some(names) = value(b"$COLUMNS=") {
            self.layout = Layout::named(names)
                .ok_or_else(|| Fault::malformed("column names such as N,O,T,B,I,d,R,L,D", names))?;
            self.has_layout = true;
        } else if let Some(start) = line.trim_ascii().strip_prefix(b"Start time:")
            && !self.has_start
            && let Some(start_ns) = date(start.trim_ascii())
        {
            self.start_ns = self.zone.utc_ns(start_ns);
        }
        Ok(())
    }

    /// A line of the head of PEAK-Converter's table. Its last has the names above the columns: Number, Time (ms), Bus, Direction, Type, ID (hex),
    /// Reserved, Length, D0 …
    fn table_head(&mut self, line: &[u8]) {
        if let Some(names) = line.strip_prefix(b"Number") {
            self.version = TrcVersion::V2_1;
            self.layout = Layout::named(b"N,O,B,d,T,I,R,l,D").unwrap_or(self.layout);
            self.has_layout = true;
            self.table = Some(names.first().copied().unwrap_or(b' '));
        }
    }

    fn row(&mut self, row: &[u8]) -> Result<Row, Fault> {
        if !self.has_rows && !self.has_layout {
            self.version = version_of_row(row);
            self.layout = Layout::of(self.version);
        }
        self.has_rows = true;
        let mut columns: [&[u8]; MAX_COLUMNS] = [b""; MAX_COLUMNS];
        let mut rest = row;
        for column in &mut columns[..self.layout.data.min(MAX_COLUMNS)] {
            (*column, rest) = text::word(rest);
        }
        let told = self.told.take();
        let layout = self.layout;
        let time = columns[layout.offset];
        let offset_ns = text::time_of_any_mark(time, NS_PER_MS)
            .ok_or_else(|| Fault::malformed("a time in milliseconds", time))?;
        let time_ns = self.start_ns.saturating_add(offset_ns);
        let kind = layout.kind.map_or(&b""[..], |at| columns[at]);
        let frame_kind = match kind {
            b"" if layout.kind.is_none() => {
                columns[layout.id] != WARNING_ID && !rest.trim_ascii().starts_with(b"ERROR")
            }
            b"Rx" | b"Tx" if self.version < TrcVersion::V2_0 => true,
            b"Warng" | b"Error" if self.version < TrcVersion::V2_0 => false,
            b"DT" | b"RR" | b"FD" | b"FB" | b"FE" | b"BI" if self.version >= TrcVersion::V2_0 => true,
            b"ST" | b"ER" | b"EC" | b"EV" if self.version >= TrcVersion::V2_0 => false,
            other if self.version < TrcVersion::V2_0 => {
                return Err(Fault::malformed("a row's type: Rx, Tx, Warng or Error", other));
            }
            other => {
                let expected = "a row's type: DT, RR, FD, FB, FE, BI, ST, ER, EC or EV";
                return Err(Fault::malformed(expected, other));
            }
        };
        if !frame_kind {
            return self.event(row, kind, columns, time_ns, told);
        }
        let bus = layout.bus.map(|at| columns[at]);
        let channel = match bus {
            Some(bus) => text::decimal(bus)
                .and_then(|bus| u8::try_from(bus).ok())
                .ok_or_else(|| Fault::malformed("a bus number", bus))?,
            None => 1,
        };
        let id = identifier(columns[layout.id])?;
        let direction = match layout.direction.map(|at| columns[at]) {
            Some(b"Tx") => Direction::Tx,
            Some(b"Rx") | None => Direction::Rx,
            Some(other) => return Err(Fault::malformed("'Rx' or 'Tx'", other)),
        };
        let len = columns[layout.len];
        if let b"FD" | b"FB" | b"FE" | b"BI" = kind {
            let (brs, esi) = (matches!(kind, b"FB" | b"BI"), matches!(kind, b"FE" | b"BI"));
            let frame = flexible(id, brs, esi, len, layout.len_is_bytes, rest)?;
            let event = TraceEvent::Frame { frame, direction, late: false };
            return Ok(Row::Record(TraceRecord { time_ns, device_ns: None, channel, event }));
        }
        let dlc = text::decimal(len)
            .filter(|dlc| *dlc <= 15)
            .ok_or_else(|| Fault::malformed("a length of 0 to 15", len))? as u8;
        let remote = kind == b"RR" || text::word(rest).0 == b"RTR";
        let mut data = [0; 8];
        if !remote {
            let mut bytes = rest;
            for slot in &mut data[..usize::from(dlc.min(8))] {
                let (word, after) = text::word(bytes);
                *slot = match word {
                    [high, low] => text::hex_pair(*high, *low),
                    _ => None,
                }
                .ok_or_else(|| Fault::malformed(format!("{} data bytes", dlc.min(8)), rest.trim_ascii()))?;
                bytes = after;
            }
            if !bytes.trim_ascii().is_empty() {
                return Err(Fault::malformed(format!("{} data bytes", dlc.min(8)), rest.trim_ascii()));
            }
        }
        let frame = Frame::from_bus(id, remote, dlc, data);
        let event = TraceEvent::Frame { frame: frame.into(), direction, late: false };
        Ok(Row::Record(TraceRecord { time_ns, device_ns: None, channel, event }))
    }

    /// A row that is not a frame. Those without interest yield nothing.
    fn event(
        &mut self,
        row: &[u8],
        kind: &[u8],
        columns: [&[u8]; MAX_COLUMNS],
        time_ns: i64,
        told: Option<TraceRecord>,
    ) -> Result<Row, Fault> {
        if let Some(event) = event_text::marked(row) {
            let record = TraceRecord { time_ns, device_ns: None, channel: named_channel(row), event };
            if self.version >= TrcVersion::V2_0 {
                self.told = Some(record);
            }
            return Ok(Row::Record(record));
        }
        let channel = self.layout.bus.and_then(|at| text::decimal(columns[at]));
        let channel = channel.and_then(|bus| u8::try_from(bus).ok()).unwrap_or(1);
        let bytes = data_bytes(row, self.version >= TrcVersion::V2_0);
        let wrong = || Fault::malformed("the bytes of a warning, an error or a status", row);
        let event = match (kind, &bytes[..]) {
            // Version 1 has the type in the identifier's place.
            (b"Error" | b"", [_, position, rec, tec, ..]) if columns[self.layout.id] != WARNING_ID => {
                let class = text::hex(columns[self.layout.id]).ok_or_else(wrong)?;
                error_of(class, *position, (*tec, *rec))
            }
            (b"ER", [class, _, position, rec, tec, ..]) => {
                error_of(u32::from(*class), *position, (*tec, *rec))
            }
            (b"Warng" | b"ST" | b"", [a, b, c, d, ..]) => {
                match event_of(u32::from_be_bytes([*a, *b, *c, *d])) {
                    Some(event) => event,
                    None => return Ok(Row::LeftOut("states of PEAK's hardware and driver")),
                }
            }
            (b"EC", [rec, tec, ..]) => {
                TraceEvent::State { state: ErrorState::of_counters(*tec, *rec), counters: Some((*tec, *rec)) }
            }
            (b"EV", _) => return Ok(Row::LeftOut("comments and texts")),
            _ => return Err(wrong()),
        };
        let record = TraceRecord { time_ns, device_ns: None, channel, event };
        let same = |told: TraceRecord| {
            told.time_ns == time_ns
                && std::mem::discriminant(&told.event) == std::mem::discriminant(&record.event)
        };
        Ok(if told.is_some_and(same) { Row::Nothing } else { Row::Record(record) })
    }
}

/// A CAN FD frame: `len` is the length column, `rest` is what follows it.
fn flexible(
    id: Id,
    brs: bool,
    esi: bool,
    len: &[u8],
    len_is_bytes: bool,
    rest: &[u8],
) -> Result<TraceFrame, Fault> {
    let number = text::decimal(len).and_then(|number| usize::try_from(number).ok());
    let bytes = match number {
        Some(number) if len_is_bytes => Some(number).filter(|number| *number <= FD_MAX_BYTES),
        Some(dlc) => FD_LENGTHS.get(dlc).map(|len| usize::from(*len)),
        None => None,
    };
    let expected = "a length that CAN FD has: a code of 0 to 15, in the column 'l' 0 to 64 bytes";
    let bytes = bytes.ok_or_else(|| Fault::malformed(expected, len))?;
    let mut data = [0; FD_MAX_BYTES];
    let mut at = rest;
    for slot in &mut data[..bytes] {
        let (word, after) = text::word(at);
        let byte = match word {
            [high, low] => text::hex_pair(*high, *low),
            _ => None,
        };
        *slot = byte.ok_or_else(|| Fault::malformed(format!("{bytes} data bytes"), rest.trim_ascii()))?;
        at = after;
    }
    let frame = FdFrame::new(id, brs, esi, &data[..bytes]);
    frame.map(TraceFrame::Fd).ok_or_else(|| Fault::malformed(expected, len))
}

/// The channel in an event's text.
fn named_channel(row: &[u8]) -> u8 {
    let Some(at) = memchr::memmem::find(row, b"CAN ") else { return 1 };
    let number = text::decimal(text::word(&row[at + 4..]).0);
    number.and_then(|number| u8::try_from(number).ok()).unwrap_or(1)
}

/// The data bytes of a row with empty columns, which therefore cannot be counted: in version 2 the pairs of
/// digits after the direction, in version 1 those after a length of 4.
fn data_bytes(row: &[u8], version_2: bool) -> Vec<u8> {
    let mut words = row.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    let found = if version_2 {
        words.any(|word| word == b"Rx" || word == b"Tx")
    } else {
        words.by_ref().nth(1).is_some() && words.any(|word| word == b"4")
    };
    if !found {
        return Vec::new();
    }
    let pair = |word: &[u8]| match word {
        [high, low] => text::hex_pair(*high, *low),
        _ => None,
    };
    words.filter_map(pair).take(8).collect()
}

fn identifier(digits: &[u8]) -> Result<Id, Fault> {
    let raw = text::hex(digits);
    // python-can writes 29-bit identifiers with seven digits.
    let id = match digits.len() {
        0..=4 => raw.and_then(Id::standard),
        _ => raw.and_then(Id::extended),
    };
    id.ok_or_else(|| Fault::malformed("an identifier of 4 digits up to 07FF or 8 up to 1FFFFFFF", digits))
}

/// The version that a row without a header has: version 1.0 has none, and what others wrote may have been cut out of a file.
fn version_of_row(row: &[u8]) -> TrcVersion {
    let mut rest = row;
    let columns: [&[u8]; 6] = std::array::from_fn(|_| {
        let (word, behind) = text::word(rest);
        rest = behind;
        word
    });
    let is_v1 = |kind: &[u8]| matches!(kind, b"Rx" | b"Tx" | b"Warng" | b"Error");
    match columns {
        [_, _, kind, ..] if is_v1(kind) => TrcVersion::V1_1,
        [_, _, _, kind, _, b"-"] if is_v1(kind) => TrcVersion::V1_3,
        [_, _, _, kind, ..] if is_v1(kind) => TrcVersion::V1_2,
        [_, _, b"DT" | b"RR" | b"FD" | b"FB" | b"FE" | b"BI" | b"ST" | b"ER" | b"EC" | b"EV", bus, ..] => {
            // Identifiers have at least four digits.
            if bus.len() < 4 && text::decimal(bus).is_some() { TrcVersion::V2_1 } else { TrcVersion::V2_0 }
        }
        _ => TrcVersion::V1_0,
    }
}

/// Whether a text, and its first line, are those of such a file's head, or rows cut out of such a file.
pub(crate) fn is_head(text: &[u8], line: &[u8]) -> bool {
    is_row(line)
        || text.starts_with(b";$FILEVERSION")
        || text.starts_with(b"$STARTTIME=")
        || text.starts_with(b";####")
        || line.starts_with(b";") && memchr::memmem::find(text, b"Start time:").is_some()
}

/// Whether a line is a row, whatever is above it: of version 1, with its number and a bracket, or of version 2, whose number is followed by a time and
/// one of its types.
fn is_row(line: &[u8]) -> bool {
    let (number, rest) = text::word(line);
    let is_v1 = number.strip_suffix(b")").is_some_and(|number| text::decimal(number).is_some());
    let is_v2 = || text::decimal(number).is_some() && version_of_row(line) >= TrcVersion::V2_0;
    let has_time = text::time_of_any_mark(text::word(rest).0, NS_PER_MS).is_some();
    has_time && (is_v1 || is_v2()) && matches!(Decoder::default().row(line), Ok(Row::Record(_)))
}

/// Days since 1899-12-30 as nanoseconds since the Unix epoch, to a microsecond, which is as exact as the
/// digits are.
fn time_of_days(days: &[u8]) -> Option<i64> {
    const NS_PER_US: i128 = 1000;
    // Decimal digits of a day, exactly: a float would be wrong by half a microsecond.
    const DIGITS: u32 = 18;
    let (whole, fraction) = match days.iter().position(|byte| matches!(byte, b'.' | b',')) {
        Some(at) => (&days[..at], &days[at + 1..]),
        None => (days, &b""[..]),
    };
    let (negative, whole) = whole.strip_prefix(b"-").map_or((false, whole), |whole| (true, whole));
    let fraction = &fraction[..fraction.len().min(DIGITS as usize)];
    let scale = 10_i128.pow(DIGITS - fraction.len() as u32);
    let fraction = if fraction.is_empty() { 0 } else { i128::from(text::decimal(fraction)?) * scale };
    let days = i128::from(text::decimal(whole)?) * 10_i128.pow(DIGITS) + fraction;
    let days = if negative { -days } else { days } - i128::from(EPOCH_DAY) * 10_i128.pow(DIGITS);
    let unit = 10_i128.pow(DIGITS) * NS_PER_US;
    let us = (days.checked_mul(i128::from(NS_PER_DAY))? + unit / 2).div_euclid(unit);
    i64::try_from(us * NS_PER_US).ok()
}

/// `18.12.2021 14:28:07.062`, followed by further digits or fields.
fn date(text: &[u8]) -> Option<i64> {
    let text = std::str::from_utf8(text).ok()?;
    let (day, clock) = text.split_once(' ')?;
    let mut day = day.splitn(3, '.').map(str::parse::<u16>);
    let mut next = || day.next().and_then(Result::ok);
    let (day, month, year) = (next()?, next()?, next()?);
    let mut clock = clock.trim().splitn(3, ':');
    let hour = text::decimal(clock.next()?.as_bytes())?;
    let minute = text::decimal(clock.next()?.as_bytes())?;
    // Tenths of a millisecond follow after a second point.
    let second: String = clock.next()?.splitn(3, '.').take(2).collect::<Vec<_>>().join(".");
    let second_ns = text::time_of_any_mark(second.as_bytes(), text::NS_PER_S).filter(|ns| *ns >= 0)?;
    let second = (second_ns / text::NS_PER_S) as u64;
    let of_day_ns = Date::of_day(hour, minute, second, second_ns % text::NS_PER_S)?;
    Date { year: i64::from(year), month: u8::try_from(month).ok()?, day: u8::try_from(day).ok()?, of_day_ns }
        .time_ns()
}
