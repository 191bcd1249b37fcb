//! Finds out which protocols are used on a bus, by signs that are specific to them.

use std::collections::BTreeMap;
use std::sync::Arc;

use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;

use crate::diagnostics::Diagnostics;
use crate::iso_tp::KnownPairs;
use crate::odx::Descriptions;
use crate::relatives::{Relative, Relatives};
use crate::signs::{FAMILY, Signs};
use crate::{Assembler, Event, EventKind, Protocol, UnderWay};

/// Bytes of a message under way that show ISO 15765-2 even if it is not complete: three frames.
const CONVINCING_BYTES: u32 = 20;

/// Examines the first records of a trace or a bus.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    diagnostics: Diagnostics,
    /// What they have said so far, with the number of the record that completed it.
    said: Vec<(usize, Event)>,
    events: Vec<Event>,
    records: usize,
    diagnostics_signs: FxHashMap<u8, DiagnosticsSigns>,
    channels: FxHashMap<u8, (Signs, Relatives)>,
}

/// What on a channel looks like ISO 15765-2 and the protocols on top of it.
#[derive(Clone, Debug, Default)]
pub(crate) struct DiagnosticsSigns {
    /// Messages that convince.
    seen: BTreeMap<Protocol, u32>,
    /// Requests and responses of UDS that did not find each other.
    alone: u32,
    /// Responses of OBD-II without their requests: loggers often leave out what they send.
    answers: u32,
    all: u32,
}

impl DiagnosticsSigns {
    /// Takes what was found on the channel.
    pub fn take(&mut self, event: &Event) {
        let convinces = match event.protocol {
            Protocol::IsoTp => event.kind == EventKind::Transfer && event.frames > 2,
            _ => matches!(event.kind, EventKind::Exchange | EventKind::Refusal),
        };
        let is_alone = event.protocol == Protocol::Uds
            && matches!(event.kind, EventKind::Response | EventKind::NoResponse | EventKind::Request);
        let is_answer =
            event.protocol == Protocol::Obd && event.kind == EventKind::Response && event.trouble.is_none();
        self.all += 1;
        self.alone += u32::from(is_alone);
        self.answers += u32::from(is_answer);
        if convinces {
            *self.seen.entry(event.protocol).or_default() += 1;
        }
    }

    /// The protocols, with the number of messages that indicate them.
    pub fn found(&self) -> impl Iterator<Item = (Protocol, u32)> {
        // A server that does not answer, or answers something else: other traffic with these identifiers rarely looks like that.
        let is_most = |count: u32| self.seen.is_empty() && u64::from(count) * 5 >= u64::from(self.all) * 4;
        let silent = (self.alone > 1 && is_most(self.alone)).then_some((Protocol::Uds, self.alone));
        let answers = (self.answers > 2 && is_most(self.answers)).then_some((Protocol::Obd, self.answers));
        self.seen.iter().map(|(protocol, count)| (*protocol, *count)).chain(silent).chain(answers)
    }
}

/// Evidence that a channel uses a protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Evidence {
    /// The channel, from 1.
    pub channel: u8,
    /// The protocol.
    pub protocol: Protocol,
    /// The number of messages that indicate it.
    pub messages: u32,
}

impl Survey {
    /// For all protocols; these pairs are known to talk by ISO 15765-2, and these ECUs are described.
    pub fn new(pairs: &[KnownPairs], descriptions: Option<Arc<Descriptions>>) -> Self {
        let diagnostics = Diagnostics::new(pairs, true).with_descriptions(descriptions);
        Self { diagnostics, ..Self::default() }
    }

    /// Takes the next record.
    pub fn take(&mut self, record: &TraceRecord) {
        self.diagnostics.take(record, &mut self.events);
        if let Some(frame) = record.frame() {
            let (signs, relatives) = self.channels.entry(record.channel).or_default();
            signs.take(record, u16::MAX);
            relatives.take(frame);
        }
        for event in self.events.drain(..) {
            if self.channels.get(&event.channel).is_some_and(|(signs, _)| signs.is_calibration(&event)) {
                continue;
            }
            self.diagnostics_signs.entry(event.channel).or_default().take(&event);
            self.said.push((self.records, event));
        }
        self.records += 1;
    }

    /// The diagnostics that have been read, which go on from here, and what they have said, with the numbers of the records, from 0.
    pub(crate) fn into_diagnostics(self) -> (Diagnostics, Vec<(usize, Event)>) {
        (self.diagnostics, self.said)
    }

    /// Whether the channel has had a frame.
    pub(crate) fn has_channel(&self, channel: u8) -> bool {
        self.channels.contains_key(&channel)
    }

    /// Protocols that are recognised but not decoded, by channel.
    pub fn relatives(&self) -> Vec<(u8, Relative)> {
        let found = self.channels.iter().flat_map(|(channel, (_, relatives))| {
            relatives.found().into_iter().map(|relative| (*channel, relative))
        });
        let mut found: Vec<_> = found.collect();
        found.sort_unstable();
        found
    }

    /// The protocols found, by channel.
    pub fn found(&self) -> Vec<Evidence> {
        let mut found: Vec<_> = self
            .diagnostics_signs
            .iter()
            .flat_map(|(&channel, signs)| {
                signs.found().map(move |(protocol, messages)| Evidence { channel, protocol, messages })
            })
            .collect();
        // A trace may end before any message is complete.
        let mut open = Vec::new();
        self.diagnostics.under_way(&mut open);
        for UnderWay { channel, protocol, .. } in
            open.into_iter().filter(|open| open.received >= CONVINCING_BYTES)
        {
            if !found.iter().any(|found: &Evidence| found.channel == channel) {
                found.push(Evidence { channel, protocol, messages: 1 });
            }
        }
        for (&channel, (signs, relatives)) in &self.channels {
            found.extend(signs.found(0).map(|(protocol, messages)| Evidence { channel, protocol, messages }));
            // Read with J1939, of which it may have nothing else.
            if let Some((_, groups)) = relatives.rv_c()
                && !found.iter().any(|found| found.channel == channel && FAMILY & found.protocol.bit() != 0)
            {
                found.push(Evidence { channel, protocol: Protocol::J1939, messages: groups });
            }
        }
        found.sort_unstable();
        found
    }
}
