//! The trace that a command reads: which file, and what to do about what is wrong in it.

use std::path::Path;

use anyhow::bail;
use cantap::TraceRecord;
use cantap::filter::Filter;
use cantap::formats::{Format, ReadOptions, TraceReader, open_reader};

use crate::live::{LiveArgs, LiveRecords};

/// How to read a trace; for commands to flatten into theirs.
#[derive(clap::Args)]
pub struct ReadArgs {
    /// The trace's format, where the file's name does not tell.
    #[arg(long, value_name = "FORMAT")]
    pub format: Option<Format>,
    /// Wait for more at the end of the file, until Ctrl-C.
    #[arg(long)]
    pub follow: bool,
    /// Stop at the first thing that is wrong instead of leaving it out.
    #[arg(long)]
    pub strict: bool,
    /// Only these frames, in candump's syntax: can0,123:7FF,400~7F0,#FF,j. Repeat for any of several.
    #[arg(short, long, value_name = "FILTER")]
    pub filter: Vec<Filter>,
}

/// Broken lines are told one by one until it is clear that the whole file is.
const ISSUES_SHOWN: u64 = 20;

/// The records of a trace or a device. Issues go to standard error.
pub struct Records {
    source: Source,
    filters: Vec<Filter>,
    strict: bool,
}

enum Source {
    /// A file, and whether it may grow.
    File(TraceReader, bool),
    Device(LiveRecords),
}

impl ReadArgs {
    /// Opens the file, or standard input for `-`.
    pub fn open(&self, path: &Path) -> anyhow::Result<Records> {
        let options = ReadOptions { format: self.format, follow: self.follow, strict: self.strict };
        let reader = open_reader(path, &options)?;
        let grows = self.follow || path.as_os_str() == "-";
        Ok(self.records(Source::File(reader, grows)))
    }

    /// Opens the device if one was given, else the file.
    pub fn open_either(&self, path: Option<&Path>, live: &LiveArgs) -> anyhow::Result<Records> {
        match (live.open()?, path) {
            (Some(live), _) => Ok(self.records(Source::Device(live))),
            (None, Some(path)) => self.open(path),
            (None, None) => bail!("give a trace to read, or a device with -d"),
        }
    }

    fn records(&self, source: Source) -> Records {
        Records { source, filters: self.filter.clone(), strict: self.strict }
    }
}

impl Records {
    /// Whether the next record may take a while, so that results should not wait in a buffer.
    pub fn may_wait(&self) -> bool {
        match &self.source {
            Source::File(reader, grows) => *grows && reader.would_wait(),
            Source::Device(live) => !live.has_next(),
        }
    }

    /// Ends a file that grows as soon as this is true; says whether it is one.
    pub fn end_when(&mut self, stop: fn() -> bool) -> bool {
        match &mut self.source {
            Source::File(reader, true) => {
                reader.end_when(stop);
                true
            }
            _ => false,
        }
    }

    /// How many places of a file could not be read so far.
    pub fn issues(&self) -> u64 {
        match &self.source {
            Source::File(reader, _) => reader.issues(),
            Source::Device(_) => 0,
        }
    }

    /// The next record that passes the filters; `None` at the end. With `--strict`, an issue is an error.
    pub fn next(&mut self) -> anyhow::Result<Option<TraceRecord>> {
        loop {
            let record = match &mut self.source {
                Source::File(reader, _) => next_of_file(reader, self.strict)?,
                Source::Device(live) => live.next()?,
            };
            let Some(record) = record else { return Ok(None) };
            if self.filters.is_empty() || self.filters.iter().any(|filter| filter.accepts(&record)) {
                return Ok(Some(record));
            }
        }
    }
}

/// The next record; says what is wrong on the way, and at the end how often that was.
fn next_of_file(reader: &mut TraceReader, strict: bool) -> anyhow::Result<Option<TraceRecord>> {
    loop {
        match reader.next() {
            None => break,
            Some(Ok(record)) => return Ok(Some(record)),
            Some(Err(issue)) if strict => bail!(issue),
            Some(Err(issue)) if reader.issues() <= ISSUES_SHOWN => eprintln!("cantap: {issue}"),
            Some(Err(_)) => {}
        }
    }
    match reader.issues() {
        0 => {}
        1 => eprintln!("cantap: 1 place in the file could not be read and was left out"),
        issues => eprintln!("cantap: {issues} places in the file could not be read and were left out"),
    }
    Ok(None)
}
