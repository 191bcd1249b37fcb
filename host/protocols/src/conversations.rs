//! Several protocols at once.

use std::sync::Arc;

use cantap_signals::Decoder;
use cantap_trace::TraceRecord;

use crate::canopen::{CanOpen, Sheet};
use crate::devicenet::DeviceNet;
use crate::diagnostics::Diagnostics;
use crate::iso_tp::{IsoTp, Pair};
use crate::j1939::J1939;
use crate::{Assembler, Event, Evidence, Protocol};

/// What to listen for.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Only these protocols; all if empty. `isotp` alone shows every transfer as it is.
    pub protocols: Vec<Protocol>,
    /// What each channel speaks, as a survey found it. Without one, channels speak the protocols above; and if there are none, ISO
    /// 15765-2 and what stands on it, which need no survey.
    pub spoken: Option<Vec<Evidence>>,
    /// Pairs of identifiers that talk by ISO 15765-2, beside those of the standards.
    pub pairs: Vec<Pair>,
    /// Signals for the messages of J1939 and NMEA 2000.
    pub decoder: Option<Arc<Decoder>>,
    /// The sheets of CANopen nodes.
    pub sheets: Vec<Sheet>,
}

/// Takes records and gives the events of all protocols, in the order in which they are complete.
pub struct Conversations {
    assemblers: Vec<(u16, Box<dyn Assembler + Send>)>,
    /// The protocols of each channel.
    spoken: Box<[u16; 256]>,
    wanted: u16,
}

const DIAGNOSTICS: u16 =
    Protocol::IsoTp.bit() | Protocol::Uds.bit() | Protocol::Kwp2000.bit() | Protocol::Obd.bit();

impl Conversations {
    /// Listens for what the options say.
    pub fn new(options: &Options) -> Self {
        let bits = |protocols: &[Protocol]| protocols.iter().fold(0, |bits, protocol| bits | protocol.bit());
        let wanted = if options.protocols.is_empty() { u16::MAX } else { bits(&options.protocols) };
        let mut spoken = Box::new([if options.spoken.is_some() { 0 } else { u16::MAX }; 256]);
        for evidence in options.spoken.iter().flatten() {
            spoken[usize::from(evidence.channel)] |= evidence.protocol.bit();
        }
        let anywhere = spoken.iter().fold(0, |all, protocols| all | protocols);
        // Without a survey and a choice, frames that two protocols could claim would be read twice.
        let chosen = options.spoken.is_some() || !options.protocols.is_empty();
        let speaks = |protocol: Protocol| chosen && wanted & anywhere & protocol.bit() != 0;
        let mut assemblers: Vec<(u16, Box<dyn Assembler + Send>)> = Vec::new();
        if wanted == Protocol::IsoTp.bit() {
            assemblers.push((wanted, Box::new(IsoTp::new(&options.pairs, true))));
        } else if wanted & DIAGNOSTICS != 0 {
            assemblers.push((DIAGNOSTICS, Box::new(Diagnostics::new(&options.pairs, true))));
        }
        let mut add = |protocol: Protocol, make: fn(Option<Arc<Decoder>>) -> J1939| {
            if speaks(protocol) {
                assemblers.push((protocol.bit(), Box::new(make(options.decoder.clone()))));
            }
        };
        add(Protocol::J1939, J1939::new);
        add(Protocol::Nmea2000, J1939::nmea2000);
        if speaks(Protocol::CanOpen) {
            assemblers.push((Protocol::CanOpen.bit(), Box::new(CanOpen::new(options.sheets.clone()))));
        }
        if speaks(Protocol::DeviceNet) {
            assemblers.push((Protocol::DeviceNet.bit(), Box::new(DeviceNet::new())));
        }
        Self { assemblers, spoken, wanted }
    }

    /// Takes the next record and appends what it completes.
    pub fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        let spoken = self.spoken[usize::from(record.channel)];
        let before = events.len();
        for (protocols, assembler) in &mut self.assemblers {
            if spoken & *protocols != 0 {
                assembler.take(record, events);
            }
        }
        if events.len() > before {
            self.keep_wanted(before, events);
        }
    }

    /// The trace has ended: appends what was under way.
    pub fn finish(&mut self, events: &mut Vec<Event>) {
        let before = events.len();
        for (_, assembler) in &mut self.assemblers {
            assembler.finish(events);
        }
        self.keep_wanted(before, events);
    }

    fn keep_wanted(&self, before: usize, events: &mut Vec<Event>) {
        if self.wanted != u16::MAX {
            let mut at = 0;
            events.retain(|event| {
                at += 1;
                at <= before || self.wanted & event.protocol.bit() != 0
            });
        }
    }
}
