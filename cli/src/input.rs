//! The trace that a command reads: which file, and what to do about what is wrong in it.

use std::path::Path;

use anyhow::bail;
use cantap::TraceRecord;
use cantap::filter::Filter;
use cantap::formats::{Format, ReadOptions, TraceReader, open_reader};

/// How to read a trace; for commands to flatten into theirs.
#[derive(clap::Args)]
pub struct ReadArgs {
    /// The trace's format, where the file's name does not tell.
    #[arg(long, value_name = "FORMAT")]
    format: Option<Format>,
    /// Wait for more at the end of the file, until Ctrl-C.
    #[arg(long)]
    follow: bool,
    /// Stop at the first thing that is wrong instead of leaving it out.
    #[arg(long)]
    pub strict: bool,
    /// Only these frames, in candump's syntax: can0,123:7FF,400~7F0,#FF,j. Repeat for any of several.
    #[arg(short, long, value_name = "FILTER")]
    filter: Vec<Filter>,
}

/// Broken lines are told one by one until it is clear that the whole file is.
const ISSUES_SHOWN: u64 = 20;

/// The records of a trace. Issues go to standard error.
pub struct Records {
    reader: TraceReader,
    filters: Vec<Filter>,
    strict: bool,
    live: bool,
}

impl ReadArgs {
    /// Opens the file, or standard input for `-`.
    pub fn open(&self, path: &Path) -> anyhow::Result<Records> {
        let options = ReadOptions { format: self.format, follow: self.follow, strict: self.strict };
        let reader = open_reader(path, &options)?;
        let live = self.follow || path.as_os_str() == "-";
        Ok(Records { reader, filters: self.filter.clone(), strict: self.strict, live })
    }
}

impl Records {
    /// Whether more may come at any time, so that results should not wait in a buffer.
    pub fn is_live(&self) -> bool {
        self.live
    }

    /// The next record that passes the filters; `None` at the end. With `--strict`, an issue is an error.
    pub fn next(&mut self) -> anyhow::Result<Option<TraceRecord>> {
        loop {
            match self.reader.next() {
                None => break,
                Some(Ok(record)) => {
                    if self.filters.is_empty() || self.filters.iter().any(|filter| filter.accepts(&record)) {
                        return Ok(Some(record));
                    }
                }
                Some(Err(issue)) if self.strict => bail!(issue),
                Some(Err(issue)) if self.reader.issues() <= ISSUES_SHOWN => eprintln!("cantap: {issue}"),
                Some(Err(_)) => {}
            }
        }
        match self.reader.issues() {
            0 => {}
            1 => eprintln!("cantap: 1 place in the file could not be read and was left out"),
            issues => eprintln!("cantap: {issues} places in the file could not be read and were left out"),
        }
        Ok(None)
    }
}
