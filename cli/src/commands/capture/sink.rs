//! Where a capture's records go: a file or standard output, past the trigger if there is one.

use std::io;
use std::path::Path;

use anyhow::Context;
use cantap::TraceRecord;
use cantap_formats::{TraceWriter, WriteOptions, create_writer};
use cantap_signals::trigger::Trigger;

use crate::trace_output::{report as report_left_out, shown};

/// Where records go.
pub struct Sink {
    writer: Option<Box<dyn TraceWriter>>,
    name: String,
    to_stdout: bool,
    pub trigger: Option<Trigger>,
    /// Channels, by number, that were opened without data.
    pub omits_data: Vec<u8>,
    /// Frames written without their data being known.
    without_data: u64,
    /// Whoever read standard output has closed it.
    is_closed: bool,
}

impl Sink {
    /// For the records that this trigger passes, if there is one. Nothing is written yet.
    pub fn new(trigger: Option<Trigger>) -> Self {
        Self {
            writer: None,
            name: String::new(),
            to_stdout: false,
            trigger,
            omits_data: Vec::new(),
            without_data: 0,
            is_closed: false,
        }
    }

    /// Writes to this file, or to standard output for `-`.
    pub fn create(&mut self, path: &Path, options: &WriteOptions) -> anyhow::Result<()> {
        self.name = path.display().to_string();
        self.to_stdout = self.name == "-";
        let writer = create_writer(path, options).with_context(|| {
            format!("cannot write to '{}'; choose a folder and name that you may write", self.name)
        })?;
        self.writer = Some(writer);
        Ok(())
    }

    /// Writes a record, unless the trigger holds it back. Returns whether anybody still reads.
    pub fn write(&mut self, record: &TraceRecord) -> anyhow::Result<bool> {
        let Self { writer, omits_data, without_data, .. } = self;
        let mut write = |record: &TraceRecord| {
            let has_data = record.frame().is_some_and(|frame| frame.data_len() > 0);
            *without_data += u64::from(has_data && omits_data.contains(&record.channel));
            writer.as_mut().map_or(Ok(()), |writer| writer.write(record))
        };
        let result = match &mut self.trigger {
            Some(trigger) => trigger.push(record, write),
            None => write(record),
        };
        self.judge(result)
    }

    /// Writes what is waiting in memory. Returns whether anybody still reads.
    pub fn flush(&mut self) -> anyhow::Result<bool> {
        let result = self.writer.as_mut().map_or(Ok(()), |writer| writer.flush());
        self.judge(result)
    }

    fn judge(&mut self, result: io::Result<()>) -> anyhow::Result<bool> {
        match result {
            Ok(()) => Ok(true),
            Err(error) if self.to_stdout && error.kind() == io::ErrorKind::BrokenPipe => {
                self.writer = None;
                self.is_closed = true;
                Ok(false)
            }
            Err(error) => {
                // Nothing more can be written; the file is valid up to the last whole record.
                self.writer = None;
                Err(error).with_context(|| self.failure())
            }
        }
    }

    fn failure(&self) -> String {
        let place = if self.to_stdout { "standard output".to_owned() } else { format!("'{}'", self.name) };
        format!(
            "writing to {place} failed, and what was captured before is in it; make room or choose another place"
        )
    }

    /// Ends the file, and reports what it could not carry. Returns whether all that was written was taken, as far as can be known.
    pub fn finish(mut self) -> anyhow::Result<bool> {
        let Some(writer) = self.writer.take() else { return Ok(!self.is_closed) };
        match writer.finish() {
            Ok(left_out) => {
                let path = Path::new(&self.name);
                report_left_out(&left_out, path);
                if self.without_data > 0 {
                    eprintln!(
                        "cantap: {} does not carry the data that the device left out, and has zeros in its place ({})",
                        shown(path),
                        self.without_data
                    );
                }
                Ok(true)
            }
            Err(error) if self.to_stdout && error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
            Err(error) => Err(error).with_context(|| self.failure()),
        }
    }
}
