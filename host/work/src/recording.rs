//! A recording: whatever arrives goes into a file, or only what happened around the events of a condition.

use std::fs::OpenOptions;
use std::path::{Path, PathBuf};

use anyhow::{anyhow, bail};
use cantap_formats::{ChannelInfo, Format, LeftOut, TraceWriter, WriteOptions, create_writer};
use cantap_signals::Decoder;
use cantap_signals::trigger::{Trigger, TriggerCounts, Window};
use cantap_trace::TraceRecord;
use cantap_trace::counted;

use crate::advice;

/// The time kept around an event if nothing else is requested.
pub const WINDOW: Window = Window { pre_ns: 2_000_000_000, post_ns: 5_000_000_000, events: None };

/// Separates a file's name from the condition for recording.
const IF: &str = " if ";

/// The file's name, and the condition if there is one, in a text such as `fast.blf if Speed > 80`.
pub fn parts(text: &Path) -> (&Path, Option<&str>) {
    match text.to_str().and_then(|text| text.split_once(IF)) {
        None => (text, None),
        Some((path, condition)) => (Path::new(path.trim()), Some(condition.trim())),
    }
}

/// What to do with a file that is there already.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Older {
    /// Nothing is recorded.
    Refuse,
    /// It is overwritten.
    Replace,
}

/// The events around which records are kept.
#[derive(Debug)]
pub struct Around {
    condition: String,
    trigger: Trigger,
}

impl Around {
    /// The events of a condition, such as `Speed > 80`.
    ///
    /// # Errors
    /// If it is no condition, or names what the databases do not have.
    pub fn new(condition: &str, window: Window, decoder: &Decoder) -> anyhow::Result<Self> {
        let parsed = cantap_protocols::condition(condition, decoder, &cantap_protocols::Options::default())
            .map_err(|error| anyhow!("nothing is recorded: {}", advice::explained(&error)))?;
        Ok(Self { condition: condition.to_owned(), trigger: Trigger::new(parsed, window) })
    }
}

/// A growing file, or a condition for one.
pub struct Recording {
    path: PathBuf,
    /// None until the condition has come true: a recording that never begins leaves no file behind.
    writer: Option<Box<dyn TraceWriter>>,
    /// Whether there was a file that may be overwritten: one that comes into being while the condition is awaited stays.
    older: Older,
    records: u64,
    since_ns: i64,
    around: Option<Around>,
    /// What is known of the channels, for formats that have a place for it.
    channels: Vec<ChannelInfo>,
}

/// How far a recording is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecordingState {
    /// The file. It does not exist while a condition has not come true.
    pub path: PathBuf,
    /// The condition around whose events records are written, if that is not all of them.
    pub condition: Option<String>,
    /// How often the condition came true.
    pub events: u64,
    /// Records before an event that there was no room to remember.
    pub forgotten: u64,
    /// Records written.
    pub records: u64,
    /// Size of the file according to the system, in bytes.
    pub bytes: u64,
    /// The time of its first record, in nanoseconds as in [`TraceRecord::time_ns`]; 0 if there is none.
    pub since_ns: i64,
}

impl Recording {
    /// Creates the file, in the format of its suffix. With a condition, only the records around its events are written, and the file begins
    /// with the first of them. `channels` is what is known of the channels, as for [`WriteOptions::channels`].
    ///
    /// # Errors
    /// What prevents it; with a condition, also what would prevent it later.
    pub fn create(
        path: &Path,
        around: Option<Around>,
        older: Older,
        channels: Vec<ChannelInfo>,
    ) -> anyhow::Result<Self> {
        // Before anything is created, whether its suffix names a format.
        Format::of_path(path).map_err(|error| cannot(path, &advice::explained(&error)))?;
        let older = if path.exists() { older } else { Older::Refuse };
        let writer = if around.is_none() {
            Some(create_file(path, older, &channels)?)
        } else {
            // Whether it could be created, without leaving one.
            if older == Older::Refuse {
                reserve(path)?;
                std::fs::remove_file(path).map_err(|error| cannot(path, &error.to_string()))?;
            }
            None
        };
        Ok(Self { path: path.to_owned(), writer, older, records: 0, since_ns: 0, around, channels })
    }

    /// The same by a text: the file's name may be followed by a condition, as in `fast.blf if Speed > 80`.
    ///
    /// # Errors
    /// As above.
    pub fn create_by_text(
        text: &Path,
        decoder: &Decoder,
        older: Older,
        channels: Vec<ChannelInfo>,
    ) -> anyhow::Result<Self> {
        let (path, condition) = parts(text);
        let around = condition.map(|condition| Around::new(condition, WINDOW, decoder)).transpose()?;
        Self::create(path, around, older, channels)
    }

    /// Checks such a text without creating anything.
    ///
    /// # Errors
    /// What is wrong with the condition, the file's suffix or its folder, or that the file is there already.
    pub fn check_text(text: &Path, decoder: &Decoder) -> anyhow::Result<()> {
        let (path, condition) = parts(text);
        if path.exists() {
            bail!("{} already exists; choose another name, or remove it first", path.display());
        }
        Format::of_path(path).map_err(|error| cannot(path, &advice::explained(&error)))?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
            return Err(cannot(path, &format!("there is no folder {}", folder.display())));
        }
        condition.map(|condition| Around::new(condition, WINDOW, decoder)).transpose()?;
        Ok(())
    }

    /// Writes records.
    ///
    /// # Errors
    /// If the disk takes no more, or if somebody else has created the file while the condition was awaited.
    pub fn write(&mut self, records: &[TraceRecord]) -> anyhow::Result<()> {
        let Self { path, writer, older, around, records: count, since_ns, channels } = self;
        let mut keep = |record: &TraceRecord| -> anyhow::Result<()> {
            let writer = match writer {
                Some(writer) => writer,
                None => writer.insert(create_file(path, *older, channels)?),
            };
            if *count == 0 {
                *since_ns = record.time_ns;
            }
            *count += 1;
            Ok(writer.write(record)?)
        };
        for record in records {
            match around {
                Some(around) => around.trigger.push(record, &mut keep)?,
                None => keep(record)?,
            }
        }
        Ok(())
    }

    fn counts(&self) -> TriggerCounts {
        self.around.as_ref().map_or_else(TriggerCounts::default, |around| around.trigger.counts())
    }

    /// Passes what was written to the system, and returns how far it is.
    ///
    /// # Errors
    /// If the disk takes no more.
    pub fn state(&mut self) -> std::io::Result<RecordingState> {
        let bytes = match &mut self.writer {
            None => 0,
            Some(writer) => {
                writer.flush()?;
                std::fs::metadata(&self.path).map_or(0, |file| file.len())
            }
        };
        let TriggerCounts { events, forgotten, .. } = self.counts();
        Ok(RecordingState {
            path: self.path.clone(),
            condition: self.around.as_ref().map(|around| around.condition.clone()),
            events,
            forgotten,
            records: self.records,
            bytes,
            since_ns: self.since_ns,
        })
    }

    /// Ends the file and returns a sentence about it.
    pub fn finish(self) -> String {
        let (path, records, forgotten) = (self.path.display(), self.records, self.counts().forgotten);
        let Some(writer) = self.writer else {
            let condition = self.around.map(|around| around.condition).unwrap_or_default();
            return format!("nothing was recorded: {condition} never came true, and there is no {path}");
        };
        let without = match writer.finish() {
            Ok(left_out) => listed(&left_out, forgotten),
            Err(error) => {
                return format!(
                    "the end of {path} could not be written: {error}; check the disk's free space"
                );
            }
        };
        let are_in =
            format!("{} {} in {path}", counted(records, "record"), if records == 1 { "is" } else { "are" });
        if without.is_empty() { are_in } else { format!("{are_in}, without {}", without.join(", ")) }
    }

    /// A sentence about the error that ended a recording.
    pub fn failure(error: &anyhow::Error) -> String {
        match error.downcast_ref::<std::io::Error>() {
            Some(error) => format!("recording ended: {error}; check the disk's free space"),
            None => format!("recording ended: {}", advice::sentence(error)),
        }
    }
}

fn cannot(path: &Path, reason: &str) -> anyhow::Error {
    anyhow!("cannot record to {}: {reason}", path.display())
}

/// Creates an empty file; a link is not followed.
fn reserve(path: &Path) -> anyhow::Result<()> {
    match OpenOptions::new().write(true).create_new(true).open(path) {
        Ok(_) => Ok(()),
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {
            bail!("{} exists, and is not overwritten; choose another name", path.display());
        }
        Err(error) => Err(cannot(path, &error.to_string())),
    }
}

fn create_file(path: &Path, older: Older, channels: &[ChannelInfo]) -> anyhow::Result<Box<dyn TraceWriter>> {
    if older == Older::Refuse {
        reserve(path)?;
    }
    create_writer(path, &WriteOptions { channels: channels.to_vec(), ..WriteOptions::default() }).map_err(
        |error| {
            if older == Older::Refuse {
                // It is empty, and this program's.
                let _ = std::fs::remove_file(path);
            }
            cannot(path, &advice::explained(&error))
        },
    )
}

fn listed(left_out: &LeftOut, forgotten: u64) -> Vec<String> {
    let mut parts: Vec<_> = left_out.iter().map(|(what, count)| format!("{count} {what}")).collect();
    if forgotten > 0 {
        parts.push(format!("{forgotten} before events, which there was no memory for"));
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::{Direction, TraceEvent};

    fn frame(second: i64, frame: &str) -> TraceRecord {
        let event =
            TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
        TraceRecord { time_ns: second * 1_000_000_000, device_ns: None, channel: 1, event }
    }

    fn fast() -> Around {
        Around::new("byte[0] > 0x80", WINDOW, &Decoder::new(Vec::new())).unwrap()
    }

    #[test]
    fn everything_is_in_a_new_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("drive.log");
        let mut recording = Recording::create(&path, None, Older::Refuse, Vec::new()).unwrap();
        recording.write(&[frame(3, "123#00"), frame(4, "123#01")]).unwrap();
        let state = recording.state().unwrap();
        assert_eq!((state.path, state.records, state.since_ns), (path.clone(), 2, 3_000_000_000));
        assert_eq!(recording.finish(), format!("2 records are in {}", path.display()));
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().count(), 2);
        for around in [None, Some(fast())] {
            let error =
                Recording::create(&path, around, Older::Refuse, Vec::new()).err().unwrap().to_string();
            assert!(error.contains("is not overwritten"), "{error}");
            assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
        }
        let mut recording = Recording::create(&path, Some(fast()), Older::Replace, Vec::new()).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
        recording.write(&[frame(5, "123#FF")]).unwrap();
        recording.finish();
        assert_eq!(std::fs::read_to_string(&path).unwrap().lines().count(), 1);
        Recording::create(&path, None, Older::Replace, Vec::new()).unwrap().finish();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "");
    }

    #[test]
    fn only_what_is_around_an_event_is_recorded_where_a_condition_is_given() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fast.log");
        let mut recording = Recording::create(&path, Some(fast()), Older::Refuse, Vec::new()).unwrap();
        for second in 0..30 {
            recording.write(&[frame(second, if second == 15 { "123#FF" } else { "123#01" })]).unwrap();
        }
        let state = recording.state().unwrap();
        assert_eq!((state.records, state.events, state.since_ns), (8, 1, 13_000_000_000));
        assert_eq!(recording.finish(), format!("8 records are in {}", path.display()));
        assert_eq!(std::fs::read_to_string(&path).unwrap().lines().count(), 8);
    }

    #[test]
    fn a_condition_that_never_comes_true_leaves_no_file_and_is_awaited() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("never.log");
        let mut recording = Recording::create(&path, Some(fast()), Older::Refuse, Vec::new()).unwrap();
        recording.write(&[frame(0, "123#01"); 5]).unwrap();
        let state = recording.state().unwrap();
        assert_eq!((state.condition.as_deref(), state.records, state.events), (Some("byte[0] > 0x80"), 0, 0));
        assert_eq!(
            recording.finish(),
            format!(
                "nothing was recorded: byte[0] > 0x80 never came true, and there is no {}",
                path.display()
            )
        );
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        // What would prevent it later is an error at once, and a file of somebody else is not overwritten later.
        for place in ["no-folder/a.log", "a.unknown"] {
            let error =
                Recording::create(&folder.path().join(place), Some(fast()), Older::Refuse, Vec::new());
            let error = error.err().unwrap().to_string();
            assert!(error.starts_with("cannot record to "), "{error}");
        }
        let mut recording = Recording::create(&path, Some(fast()), Older::Refuse, Vec::new()).unwrap();
        std::fs::write(&path, "somebody's").unwrap();
        let error = recording.write(&[frame(0, "123#FF")]).unwrap_err();
        assert!(Recording::failure(&error).contains("is not overwritten"), "{error}");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "somebody's");
    }

    #[test]
    fn a_name_may_be_followed_by_a_condition() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fast.log");
        let begin = |text: &str| {
            Recording::create_by_text(Path::new(text), &Decoder::new(Vec::new()), Older::Refuse, Vec::new())
        };
        let state = begin(&format!("{} if byte[0] > 0x80", path.display())).unwrap().state().unwrap();
        assert_eq!((state.path, state.condition.as_deref()), (path.clone(), Some("byte[0] > 0x80")));
        assert_eq!(begin(path.to_str().unwrap()).unwrap().state().unwrap().condition, None);
        let wrong = begin("wrong.log if byte[0] >").err().unwrap().to_string();
        assert!(wrong.starts_with("nothing is recorded: "), "{wrong}");
    }

    #[cfg(unix)]
    #[test]
    fn a_link_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("target");
        std::os::unix::fs::symlink(&target, folder.path().join("a.log")).unwrap();
        assert!(Recording::create(&folder.path().join("a.log"), None, Older::Refuse, Vec::new()).is_err());
        assert!(!target.exists());
    }

    #[test]
    fn what_would_be_refused_is_known_before_and_a_recording_keeps_the_bit_rates() {
        let folder = tempfile::tempdir().unwrap();
        let at = |text: &str| folder.path().join(text);
        let decoder = Decoder::new(Vec::new());
        let refused = |text: &str| Recording::check_text(&at(text), &decoder).unwrap_err().to_string();
        assert!(
            refused("a.blf if Speed >").contains("nothing is recorded"),
            "{}",
            refused("a.blf if Speed >")
        );
        assert!(refused("nowhere/a.blf").contains("there is no folder"));
        assert!(refused("a.nothing").contains("a.nothing"));
        std::fs::write(at("older.log"), "").unwrap();
        assert!(refused("older.log if id == 0x123").contains("already exists"));
        Recording::check_text(&at("a.blf if id == 0x123"), &decoder).unwrap();
        let channel = ChannelInfo { channel: 2, bitrate_bps: Some(125_000), description: String::new() };
        let recording = Recording::create(&at("b.asc"), None, Older::Refuse, vec![channel]);
        recording.unwrap().finish();
        let text = std::fs::read_to_string(at("b.asc")).unwrap();
        assert!(text.contains("// cantap: bit-rates 2=125000\n"), "{text}");
    }
}
