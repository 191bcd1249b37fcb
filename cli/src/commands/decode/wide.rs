//! For spreadsheets and numerical programs: a column per signal, a line per frame or per interval of time.
//!
//! The columns are known only at the end, so lines wait in a temporary file.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Seek, Write};

use anyhow::Context;
use cantap_analysis::Cadence;
use cantap_protocols::Event;
use cantap_signals::{MessageRef, Reading};

use super::csv::Cells;
use super::decoded::Decoded;
use super::events;
use cantap_trace::Seconds;

/// Separates cells of a waiting line: it occurs in no number and no time.
const SEPARATOR: char = '\x1f';

/// Waiting lines, and the columns that they need.
pub struct Wide {
    waiting: BufWriter<File>,
    columns: Vec<Column>,
    places: HashMap<Place, usize>,
    /// Number of texts and bytes in events, which no column takes.
    left_out: u64,
    /// Interval between lines; `None` for one line per frame.
    step_ns: Option<i64>,
    /// When the next line is due.
    due_ns: Option<i64>,
}

/// The content of a column.
#[derive(PartialEq, Eq, Hash)]
enum Place {
    Signal(u8, MessageRef, u32),
    /// A field of events from several frames, by name.
    Field(u8, String),
}

struct Column {
    channel: u8,
    /// `Message.Signal`.
    name: String,
    unit: String,
    /// The last value, and when it came.
    last: Option<(i64, String)>,
    cadence: Cadence,
}

impl Wide {
    pub fn new(step_ns: Option<i64>) -> anyhow::Result<Self> {
        let file = tempfile::tempfile()
            .context("the lines need room for a temporary file; make some, or name a folder in TMPDIR")?;
        let (columns, places) = (Vec::new(), HashMap::new());
        Ok(Self { waiting: BufWriter::new(file), columns, places, left_out: 0, step_ns, due_ns: None })
    }

    /// The number of texts and bytes in events, which no column takes.
    pub const fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Takes an event from several frames: its numbers.
    pub fn push_protocol_event(&mut self, event: &Event) -> io::Result<()> {
        // An event that ends because nothing came is reported with the frame that shows it: lines at regular intervals do not
        // go back for it.
        let time_ns = match (self.step_ns, self.due_ns) {
            (Some(step_ns), Some(due_ns)) => event.time_ns.max(due_ns.saturating_sub(step_ns)),
            _ => event.time_ns,
        };
        self.advance(time_ns)?;
        let mut cells: Vec<(usize, String)> = Vec::new();
        for (name, unit, number) in events::numbers(event) {
            let Some(number) = number else {
                self.left_out += 1;
                continue;
            };
            let columns = &mut self.columns;
            let place = *self.places.entry(Place::Field(event.channel, name)).or_insert_with_key(|place| {
                let name = if let Place::Field(_, name) = place { name.clone() } else { String::new() };
                let cadence = Cadence::new(None);
                columns.push(Column { channel: event.channel, name, unit, last: None, cadence });
                columns.len() - 1
            });
            let column = &mut self.columns[place];
            column.cadence.arrive(time_ns);
            if self.step_ns.is_none() {
                cells.push((place, number));
            } else {
                column.last = Some((time_ns, number));
            }
        }
        self.line(time_ns, &cells)
    }

    /// Adds a line of these cells, unless lines are at regular intervals.
    fn line(&mut self, time_ns: i64, cells: &[(usize, String)]) -> io::Result<()> {
        if self.step_ns.is_some() || cells.is_empty() {
            return Ok(());
        }
        let mut line = vec![""; self.columns.len()];
        for (place, text) in cells {
            line[*place] = text;
        }
        write_line(&mut self.waiting, time_ns, &line)
    }

    /// Takes a frame.
    pub fn push(&mut self, decoded: &Decoded) -> io::Result<()> {
        let time_ns = decoded.record.time_ns;
        self.advance(time_ns)?;
        let mut cells: Vec<(usize, String)> = Vec::with_capacity(decoded.values.len());
        for value in decoded.values {
            let reading = Reading::of(decoded.message, value);
            let place = self.place(decoded, value.signal, &reading);
            let number = reading.number_for_programs().filter(|number| number.is_finite());
            let column = &mut self.columns[place];
            column.cadence.arrive(time_ns);
            let text = number.map(|number| number.to_string()).unwrap_or_default();
            if self.step_ns.is_none() {
                cells.push((place, text));
            } else {
                column.last = Some((time_ns, text));
            }
        }
        self.line(time_ns, &cells)
    }

    /// Frames on the channel are missing: its last values are no longer current.
    pub fn interrupt(&mut self, channel: u8) {
        for column in self.columns.iter_mut().filter(|column| column.channel == channel) {
            column.last = None;
        }
    }

    fn place(&mut self, decoded: &Decoded, signal: u32, reading: &Reading) -> usize {
        let channel = decoded.record.channel;
        let columns = &mut self.columns;
        *self.places.entry(Place::Signal(channel, decoded.reference, signal)).or_insert_with(|| {
            columns.push(Column {
                channel,
                name: format!("{}.{}", decoded.message.name, reading.label),
                unit: reading.signal.unit.clone(),
                last: None,
                cadence: Cadence::new(decoded.message.cycle_ms),
            });
            columns.len() - 1
        })
    }

    /// Writes the lines due before `now_ns`.
    fn advance(&mut self, now_ns: i64) -> io::Result<()> {
        let Some(step_ns) = self.step_ns else { return Ok(()) };
        let mut due_ns = match self.due_ns {
            // After the clock was set back, start over.
            Some(due_ns) if now_ns >= due_ns.saturating_sub(step_ns) => due_ns,
            // Lines are at whole multiples.
            _ => now_ns.div_euclid(step_ns).saturating_add(1).saturating_mul(step_ns),
        };
        while due_ns <= now_ns {
            let mut any = false;
            let cells: Vec<_> = self
                .columns
                .iter()
                .map(|column| {
                    let current =
                        column.last.as_ref().filter(|(since, _)| !column.cadence.is_silence(due_ns - since));
                    any |= current.is_some();
                    current.map_or("", |(_, text)| text)
                })
                .collect();
            if any {
                write_line(&mut self.waiting, due_ns, &cells)?;
                due_ns = due_ns.saturating_add(step_ns);
            } else {
                // Nothing more comes until now.
                due_ns = now_ns.div_euclid(step_ns).saturating_add(1).saturating_mul(step_ns);
            }
        }
        self.due_ns = Some(due_ns);
        Ok(())
    }

    /// Passes the table on.
    pub fn finish(mut self, out: &mut impl Rows) -> anyhow::Result<()> {
        if let Some(due_ns) = self.due_ns {
            // The last values get a line too.
            self.advance(due_ns)?;
        }
        let of_several = self.columns.iter().any(|column| column.channel != self.columns[0].channel);
        let names = self.columns.iter().map(|Column { channel, name, unit, .. }| {
            let name = if of_several { format!("{channel}:{name}") } else { name.clone() };
            (name, unit.clone())
        });
        out.begin(&names.collect::<Vec<_>>())?;
        let mut file = self.waiting.into_inner().map_err(io::IntoInnerError::into_error)?;
        file.rewind()?;
        for line in BufReader::new(file).lines() {
            let line = line?;
            let mut cells = line.split(SEPARATOR);
            let time_ns = cells.next().and_then(|time| time.parse().ok()).unwrap_or_default();
            // Pad with the columns that were added later.
            let cells = cells.chain(std::iter::repeat("")).take(self.columns.len());
            out.row(time_ns, cells)?;
        }
        Ok(())
    }
}

/// A destination for a table.
pub trait Rows {
    /// The columns' names and units.
    fn begin(&mut self, names_and_units: &[(String, String)]) -> anyhow::Result<()>;
    /// A row: a number or nothing for each column.
    fn row<'a>(&mut self, time_ns: i64, cells: impl Iterator<Item = &'a str>) -> anyhow::Result<()>;
}

/// A table as CSV.
pub struct Csv<W>(pub W, pub Cells);

impl<W: Write> Rows for Csv<W> {
    fn begin(&mut self, names_and_units: &[(String, String)]) -> anyhow::Result<()> {
        write!(self.0, "time")?;
        for (name, unit) in names_and_units {
            let unit = if unit.is_empty() { String::new() } else { format!(" [{unit}]") };
            write!(self.0, ",{}", self.1.field(&format!("{name}{unit}")))?;
        }
        Ok(write!(self.0, "\r\n")?)
    }

    fn row<'a>(&mut self, time_ns: i64, cells: impl Iterator<Item = &'a str>) -> anyhow::Result<()> {
        write!(self.0, "{}", Seconds(time_ns))?;
        for cell in cells {
            write!(self.0, ",{cell}")?;
        }
        Ok(write!(self.0, "\r\n")?)
    }
}

fn write_line(out: &mut impl Write, time_ns: i64, cells: &[&str]) -> io::Result<()> {
    write!(out, "{time_ns}")?;
    for cell in cells {
        write!(out, "{SEPARATOR}{cell}")?;
    }
    writeln!(out)
}
