//! Records everything that arrives, whatever is displayed.

use std::path::{Path, PathBuf};

use anyhow::bail;
use cantap::TraceRecord;
use cantap_formats::{Format, LeftOut, TraceWriter, WriteOptions, create_writer};
use cantap_signals::Decoder;
use cantap_signals::trigger::{Trigger, Window};

use super::model::Recording;
use cantap_work::advice;

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

/// Where records go.
enum Output {
    /// Into this file.
    File(Box<dyn TraceWriter>),
    /// Nowhere yet: the condition has not come true, and a recording that never begins leaves no file behind.
    Awaited,
}

/// A recording: a growing file, or a condition for one.
pub struct Recorder {
    path: PathBuf,
    output: Output,
    records: u64,
    since_ns: i64,
    /// The condition, as typed, and what looks for it.
    trigger: Option<(String, Trigger)>,
}

impl Recorder {
    /// Creates the file, in the format of its suffix. The name may be followed by a condition, as
    /// in `fast.blf if Speed > 80`: then only the records around such events are written, and the file begins with the first
    /// of them. What would prevent that is an error now.
    pub fn create(text: &Path, decoder: &Decoder) -> anyhow::Result<Self> {
        let (path, condition) = parts(text);
        let (output, trigger) = match condition {
            None => (Output::File(create_file(path)?), None),
            Some(text) => {
                let condition =
                    cantap_protocols::condition(text, decoder, &cantap_protocols::Options::default())
                        .map_err(|error| {
                            anyhow::anyhow!("nothing is recorded: {}", advice::explained(&error))
                        })?;
                check_place(path)?;
                (Output::Awaited, Some((text.to_owned(), Trigger::new(condition, WINDOW))))
            }
        };
        Ok(Self { path: path.to_owned(), output, records: 0, since_ns: 0, trigger })
    }

    /// Writes records.
    pub fn write(&mut self, records: &[TraceRecord]) -> anyhow::Result<()> {
        let Self { path, output, trigger, records: count, since_ns } = self;
        let mut keep = |record: &TraceRecord| -> anyhow::Result<()> {
            if let Output::Awaited = output {
                // It has been looked for when it was armed, but that may have been hours ago.
                if path.exists() {
                    bail!("{} has come into being meanwhile, and is not overwritten", path.display());
                }
                *output = Output::File(create_file(path)?);
            }
            if *count == 0 {
                *since_ns = record.time_ns;
            }
            *count += 1;
            match output {
                Output::File(writer) => Ok(writer.write(record)?),
                Output::Awaited => Ok(()),
            }
        };
        for record in records {
            match trigger {
                Some((_, trigger)) => trigger.push(record, &mut keep)?,
                None => keep(record)?,
            }
        }
        Ok(())
    }

    /// Passes what was written to the system, and returns the recording's state.
    pub fn state(&mut self) -> std::io::Result<Recording> {
        let bytes = match &mut self.output {
            Output::Awaited => 0,
            Output::File(writer) => {
                writer.flush()?;
                std::fs::metadata(&self.path).map_or(0, |file| file.len())
            }
        };
        Ok(Recording {
            path: self.path.display().to_string(),
            condition: self.trigger.as_ref().map(|(text, _)| text.clone()),
            events: self.trigger.as_ref().map_or(0, |(_, trigger)| trigger.counts().events),
            records: self.records,
            bytes,
            since_ns: self.since_ns,
        })
    }

    /// Ends the file and returns a sentence about it.
    pub fn finish(self) -> String {
        let (path, records) = (self.path.display().to_string(), self.records);
        let Output::File(writer) = self.output else {
            let condition = self.trigger.map(|(text, _)| text).unwrap_or_default();
            return format!("nothing was recorded: {condition} never came true, and there is no {path}");
        };
        match writer.finish() {
            Ok(left_out) if left_out.is_empty() => format!("{records} records are in {path}"),
            Ok(left_out) => format!("{records} records are in {path}, without {}", listed(&left_out)),
            Err(error) => format!("the end of {path} could not be written: {error}"),
        }
    }
}

fn create_file(path: &Path) -> anyhow::Result<Box<dyn TraceWriter>> {
    create_writer(path, &WriteOptions::default()).map_err(|error| {
        anyhow::anyhow!("cannot record to {}: {}", path.display(), advice::explained(&error))
    })
}

/// Whether a file could be created here, without leaving one.
fn check_place(path: &Path) -> anyhow::Result<()> {
    let cannot = |reason: String| anyhow::anyhow!("cannot record to {}: {reason}", path.display());
    Format::of_path(path).map_err(|error| cannot(advice::explained(&error)))?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    tempfile::tempfile_in(folder).map_err(|error| cannot(error.to_string()))?;
    Ok(())
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
    }

    #[test]
    fn a_condition_that_never_comes_true_leaves_no_file_and_is_said_to_be_awaited() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("never.log");
        let text = format!("{} if byte[0] > 0x80", path.display());
        let decoder = Decoder::new(Vec::new());
        let mut recorder = Recorder::create(Path::new(&text), &decoder).unwrap();
        let event =
            TraceEvent::Frame { frame: "123#01".parse().unwrap(), direction: Direction::Rx, late: false };
        recorder.write(&[TraceRecord { time_ns: 0, channel: 1, event }; 5]).unwrap();
        let state = recorder.state().unwrap();
        assert_eq!((state.condition.as_deref(), state.records, state.events), (Some("byte[0] > 0x80"), 0, 0));
        assert_eq!(
            recorder.finish(),
            format!(
                "nothing was recorded: byte[0] > 0x80 never came true, and there is no {}",
                path.display()
            )
        );
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        // What would prevent it later is said at once, and a file of somebody else is not overwritten later.
        for place in ["no-folder/a.log", "a.unknown"] {
            let text = format!("{} if byte[0] > 0x80", folder.path().join(place).display());
            let error = Recorder::create(Path::new(&text), &decoder).err().unwrap().to_string();
            assert!(error.starts_with("cannot record to "), "{error}");
        }
        let mut recorder = Recorder::create(Path::new(&text), &decoder).unwrap();
        std::fs::write(&path, "somebody's").unwrap();
        let event =
            TraceEvent::Frame { frame: "123#FF".parse().unwrap(), direction: Direction::Rx, late: false };
        let error = recorder.write(&[TraceRecord { time_ns: 0, channel: 1, event }]).unwrap_err().to_string();
        assert!(error.contains("is not overwritten"), "{error}");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "somebody's");
    }

    #[test]
    fn a_wrong_condition_is_said_before_anything_is_recorded() {
        let wrong = "wrong.log if byte[0] >";
        let reason = Recorder::create(Path::new(wrong), &Decoder::new(Vec::new())).err().unwrap().to_string();
        assert!(reason.starts_with("nothing is recorded: "), "{reason}");
    }
}
