//! A reading that passes over what an index knows.

use std::io;

use super::TraceReader;
use crate::seek::{Indexing, Reading};
use crate::time_range::TimeRange;

impl TraceReader {
    /// Leaves out parts of the file that have nothing in this range, if [`ReadOptions::index`](crate::ReadOptions::index) knows them: records of other times may still come, and what
    /// is reported at the end is about the whole file. The range learns the time of the first record, which may be among what is left out.
    /// Without effect once anything was read.
    ///
    /// # Errors
    /// The system's, on the way to the range.
    pub fn within(&mut self, range: &mut TimeRange) -> io::Result<()> {
        if range.is_all() || self.records > 0 || self.after.is_some() || self.ended {
            return Ok(());
        }
        self.indexed(|indexing, reading| indexing.begin(Some(range), reading))
    }

    /// The channels of the records that [`Self::within`] has left out so far.
    pub fn passed_channels(&self) -> impl Iterator<Item = u8> {
        self.passed.channels.iter().copied()
    }

    /// How many records [`Self::within`] has left out so far; they are among [`Self::records`].
    pub fn passed_records(&self) -> u64 {
        self.passed.records
    }

    /// The latest time of the records that [`Self::within`] has left out so far, in nanoseconds as in
    /// [`TraceRecord::time_ns`](cantap_trace::TraceRecord::time_ns).
    pub fn passed_latest_ns(&self) -> Option<i64> {
        self.passed.latest_ns
    }

    /// How far it has come: bytes, or for what is read at many places something that grows like them.
    pub(crate) fn position(&self) -> u64 {
        self.decoder.position().unwrap_or_else(|| self.input.offset())
    }

    /// Whether the file's bytes are read as they are, in a format that can be read on from places in it.
    pub(crate) fn can_go_on_from_anywhere(&self) -> bool {
        self.input.file().is_some() && !self.input.may_wait() && self.decoder.save(&mut Vec::new())
    }

    /// Does something with the index, if there is one, and gives it up if it returns false.
    fn indexed(
        &mut self,
        with: impl FnOnce(&mut Indexing, &mut Reading<'_>) -> io::Result<bool>,
    ) -> io::Result<()> {
        let Some(mut indexing) = self.indexing.take() else { return Ok(()) };
        let mut reading = Reading {
            input: &mut self.input,
            decoder: &mut self.decoder,
            records: &mut self.records,
            notes: &mut self.notes,
            left_out: &mut self.left_out,
            passed: &mut self.passed,
            issues: self.issues,
        };
        if with(&mut indexing, &mut reading)? {
            self.indexing = Some(indexing);
        }
        Ok(())
    }

    /// Goes on to what is wanted, if there is an index. Called when everything decoded has been handed out.
    pub(super) fn step(&mut self) -> io::Result<()> {
        self.indexed(|indexing, reading| {
            if !indexing.begin(None, reading)? {
                return Ok(false);
            }
            indexing.step(reading)?;
            Ok(true)
        })
    }

    /// At the end of the file.
    pub(super) fn end_index(&mut self) -> io::Result<()> {
        self.indexed(|indexing, reading| indexing.check(reading).map(|()| true))?;
        self.keep_index();
        Ok(())
    }

    /// At the end of the reading.
    pub(super) fn keep_index(&mut self) {
        if let Some(mut indexing) = self.indexing.take() {
            indexing.finish(&mut self.input);
        }
    }
}

impl Drop for TraceReader {
    /// What was learned of a file that was not read to its end is worth as much.
    fn drop(&mut self) {
        self.keep_index();
    }
}
