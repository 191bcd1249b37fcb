//! What of a trace was not read: the one place where all of it ends up.

use std::fmt;

use super::issue::ReadIssue;
use super::left_out::LeftOut;
use super::reader::TraceReader;
use cantap_trace::TraceRecord;
use cantap_trace::counted;

/// So many issues are kept; the others are counted.
const KEPT: usize = 100;

/// What of a trace was not read so far.
#[derive(Debug, Default)]
pub struct Unread {
    first: Vec<ReadIssue>,
    issues: u64,
    left_out: LeftOut,
}

impl Unread {
    /// Keeps or counts an issue.
    fn add(&mut self, issue: ReadIssue) {
        self.issues += 1;
        if self.first.len() < KEPT {
            self.first.push(issue);
        }
    }

    /// The first places that could not be read, at most 100.
    pub fn first_issues(&self) -> &[ReadIssue] {
        &self.first
    }

    /// How many places could not be read.
    pub fn issues(&self) -> u64 {
        self.issues
    }

    /// What is well-formed but no part of a CAN trace, by kind.
    pub fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    /// Whether everything was read.
    pub fn is_empty(&self) -> bool {
        self.issues == 0 && self.left_out.is_empty()
    }
}

/// A line for each of the first issues, a line for the others, and one for each kind of what was left out; nothing if everything was read.
impl fmt::Display for Unread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for issue in &self.first {
            writeln!(f, "{issue}")?;
        }
        let others = self.issues - self.first.len() as u64;
        if others > 0 {
            writeln!(f, "{others} could not be read", others = counted(others, "more place"))?;
        }
        for (what, count) in self.left_out.iter() {
            writeln!(f, "no part of a CAN trace: {what} ({count})")?;
        }
        Ok(())
    }
}

/// The records of a trace, without what could not be read; see [`TraceReader::readable`].
pub struct Readable {
    reader: TraceReader,
    unread: Unread,
}

impl Readable {
    /// What was not read so far.
    pub fn unread(&mut self) -> &Unread {
        self.unread.left_out = self.reader.left_out().clone();
        &self.unread
    }

    /// The reader, such as to ask it for the format.
    pub fn reader(&self) -> &TraceReader {
        &self.reader
    }
}

impl Iterator for Readable {
    type Item = TraceRecord;

    fn next(&mut self) -> Option<TraceRecord> {
        loop {
            match self.reader.next()? {
                Ok(record) => return Some(record),
                Err(issue) => self.unread.add(issue),
            }
        }
    }
}

impl TraceReader {
    /// The records alone, for programs that read what can be read: an issue does not end the reading, and is found in [`Readable::unread`] with
    /// everything else that was not read. A system's error and, in strict mode, the first issue end it.
    pub fn readable(self) -> Readable {
        Readable { reader: self, unread: Unread::default() }
    }
}

#[cfg(test)]
mod tests {
    use crate::{Format, ReadOptions, TraceReader};

    #[test]
    fn a_broken_line_ends_nothing_and_is_found_with_all_that_was_not_read() {
        let lines = "(1.0) can0 123#11\nrubbish\n(2.0) can0 123#22\n".to_owned() + &"x\n".repeat(150);
        let source = std::io::Cursor::new(lines + "(3.0) can0 123#33\n");
        let reader = TraceReader::from_source("a.log", source, Format::Candump, &ReadOptions::default());
        let mut records = reader.unwrap().readable();
        assert_eq!(records.by_ref().count(), 3);
        let unread = records.unread();
        assert_eq!((unread.issues(), unread.first_issues().len(), unread.is_empty()), (151, 100, false));
        let text = unread.to_string();
        assert!(text.starts_with("a.log, line 2: "), "{text}");
        assert!(text.ends_with("51 more places could not be read\n"), "{text}");
    }
}
