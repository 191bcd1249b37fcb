//! Reads a bus by its protocols: records in, events and announcements out.

use std::collections::BTreeSet;

use cantap_trace::TraceRecord;

use crate::conversations::Conversations;
use crate::relatives::Relative;
use crate::survey::Survey;
use crate::watch::{Begun, Watch};
use crate::{Event, Evidence, Options, Protocol, UnderWay};

/// The first records, by which each channel's protocols are found, are no more than this.
const MOST_FIRST: usize = 200_000;
/// Nor more than this time of the bus, in nanoseconds.
const FIRST_NS: i64 = 3_000_000_000;

/// Reads records by the given protocols, or by those that the first records of each channel show, and by others as soon as they show.
pub struct Reader {
    options: Options,
    /// Until the protocols of each channel are known.
    first: Option<First>,
    conversations: Option<Conversations>,
    watch: Option<Watch>,
    events: Vec<Event>,
    /// Channels of which it was announced that they have diagnostics.
    announced: BTreeSet<u8>,
}

/// The first records, which wait.
struct First {
    survey: Survey,
    records: Vec<TraceRecord>,
}

/// What a reader returns, in order.
#[derive(Clone, Debug, PartialEq)]
pub enum ReadItem<'a> {
    /// A record, before the events that it completes.
    Record(&'a TraceRecord),
    /// An event.
    Event(Event),
    /// What is known about a channel from here on.
    Announcement(Announcement),
}

/// What a reader has found out about the bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Announcement {
    /// What the first records show; once, unless protocols were given.
    Found {
        /// By channel.
        protocols: Vec<Evidence>,
        /// Protocols that are recognised and not read, by channel.
        relatives: Vec<(u8, Relative)>,
    },
    /// A protocol that the first records did not show.
    Begun {
        /// The channel, from 1.
        channel: u8,
        /// The protocol.
        protocol: Protocol,
        /// The stamp from which on it is read, in nanoseconds.
        from_ns: i64,
        /// Nothing of it can have come before.
        is_whole: bool,
    },
}

impl Reader {
    /// Sets up reading. With protocols given, nothing waits and nothing is announced.
    pub fn new(options: Options) -> Self {
        let is_given = !options.protocols.is_empty();
        let survey = || Survey::new(&options.pairs, options.descriptions.clone());
        let first = (!is_given).then(|| First { survey: survey(), records: Vec::new() });
        let conversations = is_given.then(|| Conversations::new(&options, None));
        Self { options, first, conversations, watch: None, events: Vec::new(), announced: BTreeSet::new() }
    }

    /// Takes records and passes on what they say. Until the protocols are known, records wait. If `more` is false, this was the end.
    ///
    /// # Errors
    ///
    /// The first error of `read`.
    pub fn take<E>(
        &mut self,
        records: &[TraceRecord],
        more: bool,
        mut read: impl FnMut(ReadItem<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut rest = records;
        if let Some(mut first) = self.first.take() {
            while let Some((record, after)) = rest.split_first()
                && !first.is_over()
            {
                first.survey.take(record);
                first.records.push(*record);
                rest = after;
            }
            if more && !first.is_over() {
                self.first = Some(first);
                return Ok(());
            }
            let (protocols, relatives) = (first.survey.found(), first.survey.relatives());
            let diagnostics = protocols.iter().filter(|found| found.protocol.is_diagnostics());
            self.announced.extend(diagnostics.map(|found| found.channel));
            self.watch = Some(Watch::new(&first.survey));
            let mut conversations = Conversations::new(&self.options, Some(&protocols));
            let (diagnostics, said) = first.survey.into_diagnostics();
            conversations.go_on_with(diagnostics);
            for (channel, relative) in &relatives {
                if matches!(relative, Relative::RvC { .. }) {
                    conversations.read_rv_c(*channel);
                }
            }
            self.conversations = Some(conversations);
            read(ReadItem::Announcement(Announcement::Found { protocols, relatives }))?;
            let mut said = said.into_iter().peekable();
            for (number, record) in first.records.iter().enumerate() {
                self.one(record, &mut read, |conversations, events| {
                    let of_record = std::iter::from_fn(|| said.next_if(|(of, _)| *of == number));
                    conversations.take_read(record, of_record.map(|(_, event)| event), events);
                })?;
            }
        }
        for record in rest {
            self.one(record, &mut read, |conversations, events| conversations.take(record, events))?;
        }
        if more { Ok(()) } else { self.end(&mut read) }
    }

    /// Takes a record and appends the events that it completes.
    pub fn push(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        self.collect(std::slice::from_ref(record), true, events);
    }

    /// The records have ended: appends whatever was in progress.
    pub fn finish(&mut self, events: &mut Vec<Event>) {
        self.collect(&[], false, events);
    }

    fn collect(&mut self, records: &[TraceRecord], more: bool, events: &mut Vec<Event>) {
        let Ok(()) = self.take(records, more, |read| {
            if let ReadItem::Event(event) = read {
                events.push(event);
            }
            Ok::<_, std::convert::Infallible>(())
        });
    }

    /// The transfers in progress.
    pub fn under_way(&self) -> Vec<UnderWay> {
        self.conversations.as_ref().map_or_else(Vec::new, Conversations::under_way)
    }

    fn one<E>(
        &mut self,
        record: &TraceRecord,
        read: &mut impl FnMut(ReadItem<'_>) -> Result<(), E>,
        take: impl FnOnce(&mut Conversations, &mut Vec<Event>),
    ) -> Result<(), E> {
        read(ReadItem::Record(record))?;
        let begun = self.watch.as_mut().map_or_else(Vec::new, |watch| watch.take(record));
        self.begin(begun, read)?;
        if let Some(conversations) = &mut self.conversations {
            take(conversations, &mut self.events);
        }
        if self.events.is_empty() { Ok(()) } else { self.pass_on(read) }
    }

    fn end<E>(&mut self, read: &mut impl FnMut(ReadItem<'_>) -> Result<(), E>) -> Result<(), E> {
        let begun = self.watch.as_mut().map_or_else(Vec::new, Watch::finish);
        self.begin(begun, read)?;
        if let Some(conversations) = &mut self.conversations {
            conversations.finish(&mut self.events);
        }
        self.pass_on(read)
    }

    /// From now on, reads these as well.
    fn begin<E>(
        &mut self,
        all: Vec<Begun>,
        read: &mut impl FnMut(ReadItem<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        for begun in all {
            let Begun { evidence: Evidence { channel, protocol, .. }, from_ns, is_whole, .. } = begun;
            read(ReadItem::Announcement(Announcement::Begun { channel, protocol, from_ns, is_whole }))?;
            if let Some(conversations) = &mut self.conversations {
                conversations.also(&self.options, &begun, &mut self.events);
            }
        }
        Ok(())
    }

    /// Events one by one: what is freed immediately is available for the next.
    fn pass_on<E>(&mut self, read: &mut impl FnMut(ReadItem<'_>) -> Result<(), E>) -> Result<(), E> {
        let announces = self.watch.is_some();
        for event in self.events.drain(..) {
            let Event { channel, protocol, start_ns: from_ns, .. } = event;
            if announces && protocol.is_diagnostics() && self.announced.insert(channel) {
                let begun = Announcement::Begun { channel, protocol, from_ns, is_whole: true };
                read(ReadItem::Announcement(begun))?;
            }
            read(ReadItem::Event(event))?;
        }
        Ok(())
    }
}

impl First {
    fn is_over(&self) -> bool {
        let span_ns = match (self.records.first(), self.records.last()) {
            (Some(first), Some(last)) => last.time_ns.saturating_sub(first.time_ns),
            _ => 0,
        };
        self.records.len() >= MOST_FIRST || span_ns >= FIRST_NS
    }
}
