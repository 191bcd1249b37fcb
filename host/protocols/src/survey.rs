//! Finds out which protocols are used on a bus, by signs that are specific to them.

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
    seen: FxHashMap<(u8, Protocol), u32>,
    /// Requests and responses of UDS that did not find each other, and all that ISO 15765-2 was found in.
    alone: FxHashMap<u8, [u32; 2]>,
    /// Numbers of extended frames: those of NMEA 2000's groups, those of J1939's, and all.
    extended: FxHashMap<u8, [u32; 3]>,
    canopen: FxHashMap<u8, canopen::CanOpenSigns>,
    devicenet: FxHashMap<u8, devicenet::DeviceNetSigns>,
    relatives: FxHashMap<u8, Relatives>,
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
            let convinces = match event.protocol {
                Protocol::IsoTp => event.kind == "transfer" && event.frames > 2,
                _ => matches!(event.kind, "exchange" | "refusal"),
            };
            let [alone, all] = self.alone.entry(event.channel).or_default();
            *all += 1;
            *alone += u32::from(
                event.protocol == Protocol::Uds
                    && matches!(event.kind, "response" | "no_response" | "request"),
            );
            if convinces {
                *self.seen.entry((event.channel, event.protocol)).or_default() += 1;
            }
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
            .seen
            .iter()
            .map(|(&(channel, protocol), &messages)| Evidence { channel, protocol, messages })
            .collect();
        // A server that does not answer, or answers something else: other traffic with these identifiers rarely looks like that.
        for (&channel, &[alone, all]) in &self.alone {
            let is_speaking = found.iter().any(|found| found.channel == channel);
            if !is_speaking && alone > 1 && alone * 5 >= all * 4 {
                found.push(Evidence { channel, protocol: Protocol::Uds, messages: alone });
            }
        }
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
