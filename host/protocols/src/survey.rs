//! Which protocols a bus speaks, by what only they would do.

use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;

use crate::diagnostics::Diagnostics;
use crate::{Assembler, Event, Protocol};

/// Looks at the first records of a trace or a bus.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    diagnostics: Diagnostics,
    events: Vec<Event>,
    seen: FxHashMap<(u8, Protocol), u32>,
}

/// That a channel speaks a protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Evidence {
    /// The channel, from 1.
    pub channel: u8,
    /// The protocol.
    pub protocol: Protocol,
    /// How many messages showed it.
    pub messages: u32,
}

impl Survey {
    /// Nothing seen so far.
    pub fn new() -> Self {
        Self { diagnostics: Diagnostics::new(&[], true), ..Self::default() }
    }

    /// Takes the next record.
    pub fn take(&mut self, record: &TraceRecord) {
        self.diagnostics.take(record, &mut self.events);
        for event in self.events.drain(..) {
            let convinces = match event.protocol {
                Protocol::IsoTp => event.kind == "transfer" && event.frames > 2,
                _ => event.kind != "no_response",
            };
            if convinces {
                *self.seen.entry((event.channel, event.protocol)).or_default() += 1;
            }
        }
    }

    /// What was seen, by channel.
    pub fn found(&self) -> Vec<Evidence> {
        let mut found: Vec<_> = self
            .seen
            .iter()
            .map(|(&(channel, protocol), &messages)| Evidence { channel, protocol, messages })
            .collect();
        found.sort_unstable();
        found
    }
}
