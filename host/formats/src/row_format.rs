//! Formats with one event per line: reading the lines is done here, interpreting a line is left to the
//! format.

use std::io;

use super::codec::Decode;
use super::error_frames::ErrorFrames;
use super::found::Found;
use super::input::Input;
use super::issue::{Fault, Place};
use super::zone::Zone;
use cantap_trace::{TraceEvent, TraceRecord};

/// The content of a line.
pub(crate) enum Line {
    /// An event.
    Record(TraceRecord),
    /// Two at the same time.
    Two(TraceRecord, TraceEvent),
    /// Something that a CAN trace does not hold, by kind.
    LeftOut(&'static str),
    /// Nothing from the bus: part of the header, a comment, an empty line.
    Nothing,
}

/// A line-based format.
pub(crate) trait RowFormat: Send {
    /// Looks ahead, before the first line.
    fn begin(&mut self, _buffered: &[u8]) {}

    /// The content of a line, without line end and surrounding space, except where [`Self::trims`] says
    /// otherwise.
    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault>;

    /// What else stood on the last line, where one has more than one of what others have one of.
    fn more(&mut self, _zone: &Zone) -> Option<Result<Line, Fault>> {
        None
    }

    /// Whether a last line that reads well but has no line end may have lost its end.
    fn may_be_cut(&self, _line: &[u8], _record: &TraceRecord) -> bool {
        true
    }

    /// What else to report about the last line, to be counted.
    fn note(&mut self) -> Option<&'static str> {
        None
    }

    /// What a file of this format always lacks at its end.
    fn missing(&self) -> Option<&'static str> {
        None
    }

    /// Whether leading space is insignificant.
    fn trims(&self) -> bool {
        true
    }
}

/// Reads the lines of a format.
#[derive(Default)]
pub(crate) struct Rows<F> {
    format: F,
    begun: bool,
    ended: bool,
    more: ErrorFrames,
}

impl<F> Rows<F> {
    /// With a format that is not the default of its kind.
    pub(crate) fn of(format: F) -> Self {
        Self { format, begun: false, ended: false, more: ErrorFrames::default() }
    }
}

impl<F> Rows<F> {
    /// The first of two events; the other one is next.
    fn two(&mut self, record: TraceRecord, second: TraceEvent) -> Found {
        self.more.keep([TraceRecord { event: second, ..record }]);
        Found::Record(record)
    }
}

impl<F: RowFormat> Decode for Rows<F> {
    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if let Some(found) = self.more.next() {
            return Ok(found);
        }
        if let Some(note) = self.format.note() {
            return Ok(Found::Note(note));
        }
        if !std::mem::replace(&mut self.begun, true) {
            self.format.begin(input.buffered());
        }
        let zone = input.zone().clone();
        loop {
            if let Some(more) = self.format.more(&zone) {
                match more {
                    Ok(Line::Nothing) => continue,
                    Ok(Line::Record(record)) => return Ok(Found::Record(record)),
                    Ok(Line::Two(record, second)) => return Ok(self.two(record, second)),
                    Ok(Line::LeftOut(what)) => return Ok(Found::LeftOut(what)),
                    Err(fault) => return Ok(Found::Issue(Place::Line(input.line_number()), fault)),
                }
            }
            let Some(line) = input.line()? else { break };
            let end = line.text.trim_ascii_end();
            let text = if self.format.trims() { end.trim_ascii_start() } else { end };
            match self.format.line(text, &zone) {
                Ok(Line::Nothing) => {}
                Ok(Line::Record(record)) if !line.terminated && self.format.may_be_cut(text, &record) => {
                    return Ok(line.cut());
                }
                Ok(Line::Record(record)) => return Ok(Found::Record(record)),
                Ok(Line::Two(..) | Line::LeftOut(_)) if !line.terminated => return Ok(line.cut()),
                Ok(Line::Two(record, second)) => return Ok(self.two(record, second)),
                Ok(Line::LeftOut(what)) => return Ok(Found::LeftOut(what)),
                Err(fault) => return Ok(line.issue(fault)),
            }
        }
        let missing = self.format.missing().filter(|_| !std::mem::replace(&mut self.ended, true));
        Ok(missing.map_or(Found::End, |expected| {
            Found::Issue(Place::Line(input.line_number()), Fault::malformed(expected, b""))
        }))
    }
}
