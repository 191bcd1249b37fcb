//! Reads records by their bus's protocols, and reports which those are.

use std::sync::Arc;

use cantap::TraceRecord;
use cantap_protocols::{Event, Options, ReadItem, Reader, UnderWay};
use cantap_signals::Decoder;

use crate::announcement;
use crate::report::Reporter;

/// Reads records by the requested protocols, or by those found in the first records of each channel.
pub struct Reading {
    reader: Reader,
    reporter: Option<Reporter>,
}

impl Reading {
    /// The protocols found are reported to `reporter`, if any.
    pub fn new(options: Options, decoder: Option<Arc<Decoder>>, reporter: Option<Reporter>) -> Self {
        Self { reader: Reader::new(Options { decoder, ..options }), reporter }
    }

    /// The transfers in progress.
    pub fn under_way(&self) -> Vec<UnderWay> {
        self.reader.under_way()
    }

    /// Takes records, and passes on events. Until the protocols are known, records wait. If `more` is false, this was the end.
    pub fn take<E>(
        &mut self,
        records: &[TraceRecord],
        more: bool,
        mut take: impl FnMut(Event) -> Result<(), E>,
    ) -> Result<(), E> {
        self.take_both(records, more, |read| match read {
            ReadItem::Event(event) => take(event),
            ReadItem::Record(_) | ReadItem::Announcement(_) => Ok(()),
        })
    }

    /// The same, with the records in between: each before the events that it completes.
    pub fn take_both<E>(
        &mut self,
        records: &[TraceRecord],
        more: bool,
        mut read: impl FnMut(ReadItem<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let reporter = self.reporter.clone();
        self.reader.take(records, more, |one| {
            if let (ReadItem::Announcement(announcement), Some(reporter)) = (&one, &reporter) {
                for line in announcement::lines(announcement) {
                    reporter.note(line);
                }
            }
            read(one)
        })
    }
}
