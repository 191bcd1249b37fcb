//! Records everything that arrives into a file that is new, whatever pages show.

use std::fs::OpenOptions;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail};
use cantap_formats::{Format, TraceWriter, WriteOptions, create_writer};
use cantap_trace::TraceRecord;
use cantap_work::advice;

use crate::state::RecordingState;

/// Longest name that a page may give, in bytes.
const MOST_NAME: usize = 120;

/// A growing file.
pub struct Recorder {
    path: PathBuf,
    writer: Box<dyn TraceWriter>,
    records: u64,
    since: Instant,
}

impl Recorder {
    /// Creates a file in `folder` by a name that a page gave. An existing one stays: then this is an error.
    pub fn of_page(folder: &Path, name: &str) -> anyhow::Result<Self> {
        Self::create(&folder.join(checked(name)?))
    }

    /// Creates a file. An existing one stays: then this is an error.
    pub fn create(path: &Path) -> anyhow::Result<Self> {
        // Before anything is created, whether its suffix names a format.
        Format::of_path(path)
            .map_err(|error| anyhow::anyhow!("nothing is recorded: {}", advice::explained(&error)))?;
        if let Err(error) = OpenOptions::new().write(true).create_new(true).open(path) {
            if error.kind() == std::io::ErrorKind::AlreadyExists {
                bail!("{} exists, and is not overwritten; choose another name", path.display());
            }
            return Err(error).with_context(|| format!("cannot record to {}", path.display()));
        }
        let writer = create_writer(path, &WriteOptions::default()).inspect_err(|_| {
            // It is empty, and this program's.
            let _ = std::fs::remove_file(path);
        });
        let writer = writer.with_context(|| format!("cannot record to {}", path.display()))?;
        Ok(Self { path: path.to_owned(), writer, records: 0, since: Instant::now() })
    }

    /// Writes records.
    pub fn write(&mut self, records: &[TraceRecord]) -> anyhow::Result<()> {
        for record in records {
            self.writer.write(record)?;
            self.records += 1;
        }
        Ok(())
    }

    /// Passes what was written to the system, and returns the recording's state.
    pub fn state(&mut self) -> anyhow::Result<RecordingState> {
        self.writer.flush()?;
        Ok(RecordingState {
            name: self.path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            records: self.records,
            bytes: std::fs::metadata(&self.path).map_or(0, |file| file.len()),
            seconds: self.since.elapsed().as_secs(),
        })
    }

    /// Ends the file and returns a sentence about it.
    pub fn finish(self) -> String {
        let (path, records) = (self.path.display().to_string(), self.records);
        match self.writer.finish() {
            Ok(left_out) if left_out.is_empty() => format!("{records} records are in {path}"),
            Ok(left_out) => {
                let listed: Vec<_> = left_out.iter().map(|(what, count)| format!("{count} {what}")).collect();
                format!("{records} records are in {path}, without {}", listed.join(", "))
            }
            Err(error) => {
                format!("the end of {path} could not be written: {error}; check the disk's free space")
            }
        }
    }
}

/// A file's name that stays in its folder, on every system.
fn checked(name: &str) -> anyhow::Result<&str> {
    const RESERVED: [&str; 6] = ["con", "prn", "aux", "nul", "com", "lpt"];
    let stem = name.split('.').next().unwrap_or_default().to_ascii_lowercase();
    let stem = stem.trim_end_matches(char::is_numeric);
    let is_plain = |letter: char| letter.is_alphanumeric() || " ._-+()".contains(letter);
    let is_good = !name.is_empty()
        && name.len() <= MOST_NAME
        && name.chars().all(is_plain)
        && !name.starts_with(['.', '-', ' '])
        && !name.ends_with(['.', ' '])
        && !RESERVED.contains(&stem.trim_end());
    if !is_good {
        bail!(
            "a recording's name has letters, digits, blanks and . _ - + ( ), and no folder, such as drive.blf"
        );
    }
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::testing::data_record;

    #[test]
    fn a_recording_is_a_new_file_in_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = Recorder::of_page(folder.path(), "drive 1.log").unwrap();
        recorder.write(&[data_record(1), data_record(2)]).unwrap();
        let state = recorder.state().unwrap();
        assert_eq!((state.name.as_str(), state.records), ("drive 1.log", 2));
        assert!(recorder.finish().starts_with("2 records are in "));
        let text = std::fs::read_to_string(folder.path().join("drive 1.log")).unwrap();
        assert_eq!(text.lines().count(), 2);
        let again = Recorder::of_page(folder.path(), "drive 1.log").err().unwrap();
        assert!(again.to_string().contains("is not overwritten"), "{again}");
        assert_eq!(std::fs::read_to_string(folder.path().join("drive 1.log")).unwrap(), text);
    }

    #[test]
    fn no_name_leads_out_of_the_folder_or_leaves_something_behind() {
        let folder = tempfile::tempdir().unwrap();
        let inner = folder.path().join("inner");
        std::fs::create_dir(&inner).unwrap();
        for name in [
            "",
            "../a.log",
            "/tmp/a.log",
            "a/b.log",
            r"..\a.log",
            "C:a.log",
            ".a.log",
            "-o.log",
            "a.log:stream",
            "con.log",
            "COM1.log",
            "com¹.log",
            "nul",
            "a\n.log",
            "a\0.log",
            "a\u{1b}[2J.log",
            "a.log ",
            "a.log.",
            "a.unknown",
            "a",
            "a.html",
            "*.log",
            "\u{202e}gol.a",
        ] {
            assert!(Recorder::of_page(&inner, name).is_err(), "{name:?}");
        }
        assert!(Recorder::of_page(&inner, &format!("{}.log", "a".repeat(300))).is_err());
        assert_eq!(std::fs::read_dir(&inner).unwrap().count(), 0);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn a_link_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("target");
        std::os::unix::fs::symlink(&target, folder.path().join("a.log")).unwrap();
        assert!(Recorder::of_page(folder.path(), "a.log").is_err());
        assert!(!target.exists());
    }
}
