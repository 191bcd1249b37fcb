//! Finds out which protocols are used on a bus, by signs that are specific to them.

use std::collections::BTreeMap;

use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;

use crate::canopen;
use crate::devicenet;
use crate::diagnostics::Diagnostics;
use crate::j1939::{self, Header};
use crate::nmea2000;
use crate::relatives::{Relative, Relatives};
use crate::{Assembler, Event, Protocol, UnderWay};

/// Bytes of a message under way that show ISO 15765-2 even if it is not complete: three frames.
const CONVINCING_BYTES: u32 = 20;

/// Examines the first records of a trace or a bus.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    diagnostics: Diagnostics,
    events: Vec<Event>,
    diagnostics_signs: FxHashMap<u8, DiagnosticsSigns>,
    /// Numbers of extended frames: those of NMEA 2000's groups, those of J1939's, and all.
    extended: FxHashMap<u8, [u32; 3]>,
    canopen: FxHashMap<u8, canopen::CanOpenSigns>,
    devicenet: FxHashMap<u8, devicenet::DeviceNetSigns>,
    relatives: FxHashMap<u8, Relatives>,
}

/// What on a channel looks like ISO 15765-2 and the protocols on top of it.
#[derive(Clone, Debug, Default)]
pub(crate) struct DiagnosticsSigns {
    /// Messages that convince.
    seen: BTreeMap<Protocol, u32>,
    /// Requests and responses of UDS that did not find each other.
    alone: u32,
    all: u32,
}

impl DiagnosticsSigns {
    /// Takes what was found on the channel.
    pub fn take(&mut self, event: &Event) {
        let convinces = match event.protocol {
            Protocol::IsoTp => event.kind == "transfer" && event.frames > 2,
            _ => matches!(event.kind, "exchange" | "refusal"),
        };
        let is_alone =
            event.protocol == Protocol::Uds && matches!(event.kind, "response" | "no_response" | "request");
        self.all += 1;
        self.alone += u32::from(is_alone);
        if convinces {
            *self.seen.entry(event.protocol).or_default() += 1;
        }
    }

    /// The protocols, with the number of messages that indicate them.
    pub fn found(&self) -> impl Iterator<Item = (Protocol, u32)> {
        // A server that does not answer, or answers something else: other traffic with these identifiers rarely looks like that.
        let is_silent =
            self.seen.is_empty() && self.alone > 1 && u64::from(self.alone) * 5 >= u64::from(self.all) * 4;
        let silent = is_silent.then_some((Protocol::Uds, self.alone));
        self.seen.iter().map(|(protocol, count)| (*protocol, *count)).chain(silent)
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
    /// Nothing has been seen yet.
    pub fn new() -> Self {
        Self { diagnostics: Diagnostics::new(&[], true), ..Self::default() }
    }

    /// Takes the next record.
    pub fn take(&mut self, record: &TraceRecord) {
        self.diagnostics.take(record, &mut self.events);
        if let Some(frame) = record.frame() {
            self.canopen.entry(record.channel).or_default().take(frame);
            self.devicenet.entry(record.channel).or_default().take(frame);
            self.relatives.entry(record.channel).or_default().take(frame);
        }
        let header =
            record.frame().filter(|frame| !frame.is_remote()).and_then(|frame| Header::of(frame.id()));
        if let Some(header) = header {
            let [marine, vehicle, all] = self.extended.entry(record.channel).or_default();
            *all += 1;
            *marine += u32::from(nmea2000::is_known(header.pgn));
            *vehicle += u32::from(j1939::is_known(header.pgn));
        }
        for event in self.events.drain(..) {
            self.diagnostics_signs.entry(event.channel).or_default().take(&event);
        }
    }

    /// Protocols that are recognised but not decoded, by channel.
    pub fn relatives(&self) -> Vec<(u8, Relative)> {
        let found = self.relatives.iter().flat_map(|(channel, relatives)| {
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
        for (&channel, &[marine, vehicle, all]) in &self.extended {
            // Other 29-bit traffic occasionally matches a known number.
            let enough = |known: u32| known > 1 && known > all / 10;
            let protocol = match (enough(marine), enough(vehicle)) {
                (true, _) => Protocol::Nmea2000,
                (_, true) => Protocol::J1939,
                _ => continue,
            };
            found.push(Evidence { channel, protocol, messages: marine.max(vehicle) });
        }
        for (&channel, signs) in &self.canopen {
            let messages = signs.count();
            if messages > 0 {
                found.push(Evidence { channel, protocol: Protocol::CanOpen, messages });
            }
        }
        for (&channel, signs) in &self.devicenet {
            let messages = signs.count();
            // CANopen's SDO servers use identifiers that also occur in DeviceNet.
            let is_canopen = self.canopen.get(&channel).is_some_and(|signs| signs.count() > 0);
            if messages > 0 && !is_canopen {
                found.push(Evidence { channel, protocol: Protocol::DeviceNet, messages });
            }
        }
        found.sort_unstable();
        found
    }
}
