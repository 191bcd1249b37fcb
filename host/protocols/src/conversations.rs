//! Several protocols at once.

use cantap_trace::TraceRecord;

use crate::diagnostics::Diagnostics;
use crate::iso_tp::{IsoTp, Pair};
use crate::{Assembler, Event, Evidence, Protocol};

/// What to listen for.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Only these protocols; all if empty. `isotp` alone shows every transfer as it is.
    pub protocols: Vec<Protocol>,
    /// What each channel speaks, as a survey found it; all channels speak all protocols without one.
    pub spoken: Option<Vec<Evidence>>,
    /// Pairs of identifiers that talk by ISO 15765-2, beside those of the standards.
    pub pairs: Vec<Pair>,
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
    pub fn new(options: Options) -> Self {
        let bits = |protocols: &[Protocol]| protocols.iter().fold(0, |bits, protocol| bits | protocol.bit());
        let wanted = if options.protocols.is_empty() { u16::MAX } else { bits(&options.protocols) };
        let mut spoken = Box::new([if options.spoken.is_some() { 0 } else { u16::MAX }; 256]);
        for evidence in options.spoken.unwrap_or_default() {
            spoken[usize::from(evidence.channel)] |= evidence.protocol.bit();
        }
        let mut assemblers: Vec<(u16, Box<dyn Assembler + Send>)> = Vec::new();
        if wanted == Protocol::IsoTp.bit() {
            assemblers.push((wanted, Box::new(IsoTp::new(&options.pairs, true))));
        } else if wanted & DIAGNOSTICS != 0 {
            assemblers.push((DIAGNOSTICS, Box::new(Diagnostics::new(&options.pairs, true))));
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
