//! What the frames mean, for every command that asks: the options, and reading records as the bus speaks.

mod known;
mod sheet;
mod surveyed;

use std::sync::Arc;

use cantap::TraceRecord;
use cantap_protocols::iso_tp::Pair;
use cantap_protocols::{Conversations, Event, Options, UnderWay};
use cantap_signals::Decoder;
use cantap_signals::condition::{Condition, ConditionError};

pub use self::sheet::SheetPath;
use self::surveyed::Surveyed;

pub use known::{Known, about, named};

/// What helps to understand a bus; for commands to flatten into theirs.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct ProtocolArgs {
    /// Two identifiers that talk to each other by ISO 15765-2, as 7E0:7E8; with an address in the first data byte as
    /// 6F1/12:612/F1. Can be repeated. Others are found by what they do.
    #[arg(long = "pair", value_name = "ID:ID")]
    pairs: Vec<Pair>,
    /// The sheet (EDS or DCF) of CANopen nodes; with a node's number before it (5:drive.eds), that node's. Can be repeated.
    #[arg(long = "eds", value_name = "[NODE:]FILE")]
    sheets: Vec<SheetPath>,
}

impl ProtocolArgs {
    /// What reads a trace for its nodes and services.
    pub fn known(&self, quiet: bool) -> anyhow::Result<Known> {
        Ok(Known::new(Reading::new(self.options(quiet)?, None, quiet)))
    }

    /// As the library takes it; what of a sheet is not understood goes to standard error, unless `quiet`.
    pub fn options(&self, quiet: bool) -> anyhow::Result<Options> {
        let sheets = self.sheets.iter().map(|path| path.load(quiet)).collect::<anyhow::Result<Vec<_>>>()?;
        Ok(Options { pairs: self.pairs.clone(), sheets, ..Options::default() })
    }
}

/// A condition on signals, frames, and what frames say together.
pub fn condition(text: &str, decoder: &Decoder) -> Result<Condition, ConditionError> {
    cantap_protocols::condition(text, decoder, &Options::default())
}

/// Says which of a condition's names nothing had: a name that is misspelt would find nothing, and look as if there were nothing.
pub fn tell_unheard(condition: &Condition) {
    let names: Vec<_> = condition.unheard().collect();
    if !names.is_empty() {
        eprintln!(
            "cantap: nothing had {}; `cantap conversations` shows what there is, with its names",
            names.join(", ")
        );
    }
}

/// Reads records by the protocols that were asked for, or by those that the first records of each channel show.
pub struct Reading {
    options: Options,
    surveyed: Surveyed,
    conversations: Option<Conversations>,
    events: Vec<Event>,
    quiet: bool,
}

impl Reading {
    /// What is spoken goes to standard error, unless `quiet`.
    pub fn new(options: Options, decoder: Option<Arc<Decoder>>, quiet: bool) -> Self {
        let surveyed = Surveyed::new(options.protocols.is_empty());
        let options = Options { decoder, ..options };
        Self { options, surveyed, conversations: None, events: Vec::new(), quiet }
    }

    /// The transfers that have begun and have not ended.
    pub fn under_way(&self) -> Vec<UnderWay> {
        self.conversations.as_ref().map_or_else(Vec::new, Conversations::under_way)
    }

    /// Takes records, and hands out what was said. Until it is clear what is spoken, records wait. Without `more`, this was the end.
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

    /// The same, with the records in between: each before what it completes.
    pub fn take_both<E>(
        &mut self,
        records: &[TraceRecord],
        more: bool,
        mut read: impl FnMut(Read<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let Self { options, surveyed, conversations, events, quiet } = self;
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
            options.spoken = found;
            waited = surveyed.release();
            records = &waited;
        }
        let conversations = conversations.get_or_insert_with(|| Conversations::new(options));
        for record in records {
            read(Read::Record(record))?;
            conversations.take(record, events);
            // One by one: what is freed at once is there for the next.
            events.drain(..).try_for_each(|event| read(Read::Event(event)))?;
        }
        if !more {
            conversations.finish(events);
            events.drain(..).try_for_each(|event| read(Read::Event(event)))?;
        }
        Ok(())
    }
}

/// A record, or what was said.
pub enum Read<'a> {
    /// The record.
    Record(&'a TraceRecord),
    /// What was said.
    Event(Event),
}
