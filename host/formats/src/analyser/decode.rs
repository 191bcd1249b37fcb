//! Reads rows of the table as records.

use cantap_can::{Frame, Id};

use super::super::calendar::Date;
use super::super::found::Row as ReadRow;
use super::super::issue::Fault;
use super::super::text::{self, NS_PER_S};
use super::super::zone::Zone;
use super::{COLUMNS, ERRORS, OVERRUN};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

/// Reads rows of the table.
#[derive(Default)]
pub(crate) struct RowDecoder {
    separator: u8,
    start_ns: i64,
    /// The zone of the date in a comment.
    zone: Zone,
    /// The position of each of [`COLUMNS`] in this file.
    places: Vec<Option<usize>>,
}

impl RowDecoder {
    /// What reading rows depends on.
    pub(crate) fn state(&self) -> (u8, i64, &[Option<usize>]) {
        (self.separator, self.start_ns, &self.places)
    }

    /// Takes that up; `None` if it is nonsense.
    pub(crate) fn restore(
        &mut self,
        (separator, start_ns, places): (u8, i64, Vec<Option<usize>>),
    ) -> Option<()> {
        let is_place = |place: &usize| u16::try_from(*place).is_ok();
        places.iter().flatten().all(is_place).then_some(())?;
        (self.separator, self.start_ns, self.places) = (separator, start_ns, places);
        Some(())
    }

    /// `zone` is the zone of the file's date.
    pub(crate) fn new(zone: &Zone) -> Self {
        Self { zone: zone.clone(), ..Self::default() }
    }

    /// Takes a line of CSV before the rows. True if it names the columns; a comment may contain the date.
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
                self.start_ns = self.zone.utc_ns(start_ns);
            }
        }
    }

    /// Takes the names of the columns; false if they are not those of this table.
    pub(crate) fn name(&mut self, cells: &[&[u8]]) -> bool {
        let find = |name: &&str| cells.iter().position(|cell| cell.trim_ascii() == name.as_bytes());
        self.places = COLUMNS.iter().map(find).collect();
        // Time, kind, format, ID and length are required.
        self.places[1..6].iter().all(Option::is_some)
    }

    /// A line of CSV. Without a line end it must still have all its cells.
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
        let second = (cell(20) == b"Y").then_some(OVERRUN);
        let record = |event| TraceRecord {
            time_ns: self.start_ns.saturating_add(offset_ns),
            device_ns: None,
            channel: 1,
            event,
        };
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
                // A capture may leave out data to save bandwidth.
                if byte.is_empty() && cell(18) == b"N" {
                    continue;
                }
                *slot = text::hex(byte)
                    .and_then(|byte| u8::try_from(byte).ok())
                    .ok_or_else(|| Fault::malformed(format!("a byte under D{}", at + 1), byte))?;
            }
        }
        let frame = Frame::from_bus(id, remote, dlc, data);
        let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
        Ok(Some((record(event), second)))
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
