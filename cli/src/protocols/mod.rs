//! What the frames mean, for every command that asks: the options, and reading records as the bus speaks.

mod known;
mod sheet;
mod surveyed;

use std::sync::Arc;

use cantap::TraceRecord;
use cantap_protocols::iso_tp::Pair;
use cantap_protocols::{Conversations, Event, Options};
use cantap_signals::Decoder;
use cantap_signals::condition::{Condition, ConditionError};

use self::sheet::SheetPath;
use self::surveyed::Surveyed;

pub use known::Known;

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

    /// Takes records, and hands out what was said. Until it is clear what is spoken, records wait. Without `more`, this was the end.
    pub fn take<E>(
        &mut self,
        records: &[TraceRecord],
        more: bool,
        mut said: impl FnMut(Event) -> Result<(), E>,
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
                surveyed::tell(found.as_deref());
            }
            options.spoken = found;
            waited = surveyed.release();
            records = &waited;
        }
        let conversations = conversations.get_or_insert_with(|| Conversations::new(options));
        for record in records {
            conversations.take(record, events);
            // One by one: what is freed at once is there for the next.
            events.drain(..).try_for_each(&mut said)?;
        }
        if !more {
            conversations.finish(events);
            events.drain(..).try_for_each(&mut said)?;
        }
        Ok(())
    }
}
