//! Records everything that arrives, whatever is displayed.

use std::path::{Path, PathBuf};

use cantap::TraceRecord;
use cantap_formats::{LeftOut, TraceWriter, WriteOptions, create_writer};
use cantap_signals::Decoder;
use cantap_signals::trigger::{Trigger, Window};

use super::model::Recording;
use crate::advice;
use crate::protocols;

/// The time kept around an event if a condition is given.
const WINDOW: Window = Window { pre_ns: 2_000_000_000, post_ns: 5_000_000_000, events: None };

/// Separates a file's name from the condition for recording.
const IF: &str = " if ";

/// A file's name, and the condition for recording, if there is one.
pub fn parts(text: &Path) -> (&Path, Option<&str>) {
    match text.to_str().and_then(|text| text.split_once(IF)) {
        None => (text, None),
        Some((path, condition)) => (Path::new(path.trim()), Some(condition.trim())),
    }
}

/// A growing file.
pub struct Recorder {
    path: PathBuf,
    writer: Box<dyn TraceWriter>,
    records: u64,
    since_ns: i64,
    trigger: Option<Trigger>,
}

impl Recorder {
    /// Creates the file, in the format of its suffix. The name may be followed by a condition, as
    /// in `fast.blf if Speed > 80`: then only the records around such events are written.
    pub fn create(text: &Path, decoder: &Decoder) -> anyhow::Result<Self> {
        let (path, condition) = parts(text);
        let trigger = match condition {
            None => None,
            Some(condition) => {
                let condition = protocols::condition(condition, decoder)
                    .map_err(|error| anyhow::anyhow!("nothing is recorded: {}", advice::told(&error)))?;
                Some(Trigger::new(condition, WINDOW))
            }
        };
        let writer = create_writer(path, &WriteOptions::default()).map_err(|error| {
            anyhow::anyhow!("cannot record to {}: {}", path.display(), advice::told(&error))
        })?;
        Ok(Self { path: path.to_owned(), writer, records: 0, since_ns: 0, trigger })
    }

    /// Writes records.
    pub fn write(&mut self, records: &[TraceRecord]) -> std::io::Result<()> {
        let Self { writer, trigger, records: count, since_ns, .. } = self;
        let mut keep = |record: &TraceRecord| {
            if *count == 0 {
                *since_ns = record.time_ns;
            }
            *count += 1;
            writer.write(record)
        };
        for record in records {
            match trigger {
                Some(trigger) => trigger.push(record, &mut keep)?,
                None => keep(record)?,
            }
        }
        Ok(())
    }

    /// Passes what was written to the system, and returns the recording's state.
    pub fn state(&mut self) -> std::io::Result<Recording> {
        self.writer.flush()?;
        Ok(Recording {
            path: self.path.display().to_string(),
            records: self.records,
            bytes: std::fs::metadata(&self.path).map_or(0, |file| file.len()),
            since_ns: self.since_ns,
        })
    }

    /// Ends the file and returns a sentence about it.
    pub fn finish(self) -> String {
        let (path, records) = (self.path.display().to_string(), self.records);
        match self.writer.finish() {
            Ok(left_out) if left_out.is_empty() => format!("{records} records are in {path}"),
            Ok(left_out) => format!("{records} records are in {path}, without {}", listed(&left_out)),
            Err(error) => format!("the end of {path} could not be written: {error}"),
        }
    }
}

fn listed(left_out: &LeftOut) -> String {
    let parts: Vec<_> = left_out.iter().map(|(what, count)| format!("{count} {what}")).collect();
    parts.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::{Direction, TraceEvent};

    #[test]
    fn only_what_is_around_an_event_is_recorded_where_a_condition_is_given() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fast.log");
        let text = format!("{} if byte[0] > 0x80", path.display());
        let mut recorder = Recorder::create(Path::new(&text), &Decoder::new(Vec::new())).unwrap();
        for second in 0..30 {
            let frame = if second == 15 { "123#FF" } else { "123#01" }.parse().unwrap();
            let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
            recorder.write(&[TraceRecord { time_ns: second * 1_000_000_000, channel: 1, event }]).unwrap();
        }
        let state = recorder.state().unwrap();
        assert_eq!((state.records, state.since_ns), (8, 13_000_000_000));
        assert_eq!(recorder.finish(), format!("8 records are in {}", path.display()));
        assert_eq!(std::fs::read_to_string(&path).unwrap().lines().count(), 8);
        let wrong = format!("{} if byte[0] >", path.display());
        let reason =
            Recorder::create(Path::new(&wrong), &Decoder::new(Vec::new())).err().unwrap().to_string();
        assert!(reason.starts_with("nothing is recorded: "), "{reason}");
    }
}
