//! Reads records by their bus's protocols.

use std::collections::BTreeSet;
use std::sync::Arc;

use cantap::TraceRecord;
use cantap_protocols::{Begun, Conversations, Event, Options, UnderWay, Watch};
use cantap_signals::Decoder;

use super::later;
use super::surveyed::{self, Surveyed};

/// Reads records by the requested protocols, or by those found in the first records of each channel.
pub struct Reading {
    options: Options,
    surveyed: Surveyed,
    conversations: Option<Conversations>,
    watch: Option<Watch>,
    events: Vec<Event>,
    quiet: bool,
    /// Channels of which it was said that they have diagnostics.
    told: BTreeSet<u8>,
}

impl Reading {
    /// The protocols found are reported on standard error, unless `quiet`.
    pub fn new(options: Options, decoder: Option<Arc<Decoder>>, quiet: bool) -> Self {
        let surveyed = Surveyed::new(options.protocols.is_empty());
        let options = Options { decoder, ..options };
        Self {
            options,
            surveyed,
            conversations: None,
            watch: None,
            events: Vec::new(),
            quiet,
            told: BTreeSet::new(),
        }
    }

    /// The transfers in progress.
    pub fn under_way(&self) -> Vec<UnderWay> {
        self.conversations.as_ref().map_or_else(Vec::new, Conversations::under_way)
    }

    /// Takes records, and passes on events. Until the protocols are known, records wait. If `more` is false, this was the end.
    pub fn take<E>(
        &mut self,
        records: &[TraceRecord],
        more: bool,
        mut said: impl FnMut(Event) -> Result<(), E>,
    ) -> Result<(), E> {
        self.take_both(records, more, |read| match read {
            Read::Record(_) => Ok(()),
            Read::Event(event) => said(event),
        })
    }

    /// The same, with the records in between: each before the events that it completes.
    pub fn take_both<E>(
        &mut self,
        records: &[TraceRecord],
        more: bool,
        mut read: impl FnMut(Read<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let Self { options, surveyed, conversations, watch, events, quiet, told } = self;
        let waited;
        let mut records = records;
        if conversations.is_none() {
            if !surveyed.take(records, more) {
                return Ok(());
            }
            let found = surveyed.found();
            if !*quiet {
                surveyed::tell(found.as_deref(), &surveyed.relatives());
            }
            let diagnostics = found.iter().flatten().filter(|found| found.protocol.is_diagnostics());
            told.extend(diagnostics.map(|found| found.channel));
            *watch = surveyed.survey().map(Watch::new);
            options.spoken = found;
            waited = surveyed.release();
            records = &waited;
        }
        let conversations = conversations.get_or_insert_with(|| Conversations::new(options));
        for record in records {
            read(Read::Record(record))?;
            let begun = watch.as_mut().map_or_else(Vec::new, |watch| watch.take(record));
            begin(conversations, options, &begun, *quiet, events);
            conversations.take(record, events);
            if !*quiet && options.spoken.is_some() {
                later::tell_diagnostics(events, told);
            }
            // One by one: what is freed immediately is available for the next.
            events.drain(..).try_for_each(|event| read(Read::Event(event)))?;
        }
        if !more {
            let begun = watch.as_mut().map_or_else(Vec::new, Watch::finish);
            begin(conversations, options, &begun, *quiet, events);
            conversations.finish(events);
            events.drain(..).try_for_each(|event| read(Read::Event(event)))?;
        }
        Ok(())
    }
}

/// Reads by these as well, and says so.
fn begin(
    conversations: &mut Conversations,
    options: &Options,
    begun: &[Begun],
    quiet: bool,
    events: &mut Vec<Event>,
) {
    for begun in begun {
        if !quiet {
            later::tell_begun(begun);
        }
        conversations.also(options, begun, events);
    }
}

/// A record or an event.
pub enum Read<'a> {
    /// The record.
    Record(&'a TraceRecord),
    /// The event.
    Event(Event),
}
