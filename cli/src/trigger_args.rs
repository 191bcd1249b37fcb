//! Triggers on the command line: keep only what happened around events.

use std::time::Duration;

use anyhow::Context;
use cantap_address::Address;
use cantap_signals::Decoder;
use cantap_signals::trigger::{Trigger, Window};

use crate::args;
use crate::completion;
use crate::database_args::{DatabaseArgs, load};
use crate::protocols;

/// When to keep records; commands flatten this into their arguments.
#[derive(clap::Args)]
pub struct TriggerArgs {
    /// Keep only what happens around this condition, such as "Speed > 80 and Gear == Drive", "id == 0x123",
    /// "error" or "uds.nrc" (see cantap search --help).
    #[arg(long, value_name = "CONDITION", add = completion::conditions())]
    pub trigger: Option<String>,
    /// Also keep what happened during this time before the condition held.
    #[arg(long, value_name = "TIME", default_value = "1s", requires = "trigger", value_parser = args::duration)]
    pre: Duration,
    /// Also keep what happens during this time after it held.
    #[arg(long, value_name = "TIME", default_value = "1s", requires = "trigger", value_parser = args::duration)]
    post: Duration,
    /// End after this many events, and the time after the last one.
    #[arg(long, value_name = "N", requires = "trigger", value_parser = clap::value_parser!(u64).range(1..))]
    events: Option<u64>,
    #[command(flatten)]
    databases: DatabaseArgs,
}

impl TriggerArgs {
    /// The databases, otherwise those of these devices.
    pub fn decoder<'a>(&self, devices: impl IntoIterator<Item = &'a Address>) -> anyhow::Result<Decoder> {
        // Without a trigger, only filters can need them.
        load(&self.databases.or_of(devices), false, self.trigger.is_none())
    }

    /// The trigger, if requested.
    pub fn trigger(&self, decoder: &Decoder) -> anyhow::Result<Option<Trigger>> {
        let Some(text) = &self.trigger else { return Ok(None) };
        let condition = protocols::condition(text, decoder).context("--trigger")?;
        let nanoseconds = |time: Duration| i64::try_from(time.as_nanos()).unwrap_or(i64::MAX);
        let window =
            Window { pre_ns: nanoseconds(self.pre), post_ns: nanoseconds(self.post), events: self.events };
        Ok(Some(Trigger::new(condition, window)))
    }

    /// Whether nothing more is wanted.
    pub fn is_over(&self, trigger: &Trigger) -> bool {
        self.events.is_some_and(|most| trigger.counts().events >= most) && !trigger.is_open()
    }
}
