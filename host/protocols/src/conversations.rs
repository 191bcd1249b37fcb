//! Decodes several protocols at once.

use std::collections::VecDeque;
use std::sync::Arc;

use cantap_signals::Decoder;
use cantap_trace::{Id, TraceRecord};
use rustc_hash::{FxHashMap, FxHashSet};

use crate::calibration::Known;
use crate::canopen::{CanOpen, Sheet};
use crate::ccp::Ccp;
use crate::devicenet::DeviceNet;
use crate::diagnostics::Diagnostics;
use crate::dsdl::{DataTypes, Generation};
use crate::iso_tp::{IsoTp, KnownPairs};
use crate::j1939::{Groups, J1939};
use crate::odx::Descriptions;
use crate::signs::FAMILY;
use crate::survey::DiagnosticsSigns;
use crate::uavcan::Uavcan;
use crate::watch::Begun;
use crate::xcp::Xcp;
use crate::{Assembler, Event, Evidence, Party, Protocol, UnderWay};

/// What to decode.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Only these protocols; all if empty. `isotp` alone shows every transfer as it is.
    pub protocols: Vec<Protocol>,
    /// Pairs of identifiers that communicate by ISO 15765-2, in addition to those of the standards.
    pub pairs: Vec<KnownPairs>,
    /// Signals for the messages of J1939 and NMEA 2000.
    pub decoder: Option<Arc<Decoder>>,
    /// The sheets of CANopen nodes.
    pub sheets: Vec<Sheet>,
    /// Descriptions of ECUs for diagnostics.
    pub descriptions: Option<Arc<Descriptions>>,
    /// Connections of XCP and CCP, and what is at which address.
    pub calibration: Known,
    /// Data types of DroneCAN and Cyphal; without them, those that are built in.
    pub types: Option<Arc<DataTypes>>,
}

/// Takes records and returns the events of all protocols, in the order of completion.
pub struct Conversations {
    /// Those that a channel needs, or has needed.
    readers: [Option<Box<dyn Assembler + Send + Sync>>; 8],
    /// J1939 and NMEA 2000: a channel may have one of them, and the other later.
    family: Option<Box<J1939>>,
    /// The protocols of each channel.
    spoken: Box<[u16; 256]>,
    /// Which of the readers decode each channel, one bit each.
    of_channel: Box<[u8; 256]>,
    wanted: u16,
    /// Channels that do not, or not yet, have diagnostics.
    doubts: FxHashMap<u8, Doubt>,
    /// Channels and identifiers of connections of XCP and CCP.
    calibrated: FxHashSet<(u8, Id)>,
}

/// What looks like diagnostics on a channel, but may be other traffic.
#[derive(Default)]
struct Doubt {
    signs: DiagnosticsSigns,
    held: VecDeque<Event>,
}

/// How many events of a channel are held back.
const MOST_HELD: usize = 64;

/// The readers' bits.
const OF_DIAGNOSTICS: u8 = 1;
const OF_CANOPEN: u8 = 2;
const OF_DEVICENET: u8 = 4;
const OF_FAMILY: u8 = 8;
const OF_XCP: u8 = 16;
const OF_CCP: u8 = 32;
const OF_DRONECAN: u8 = 64;
const OF_CYPHAL: u8 = 128;

/// The readers that a channel with these protocols needs.
fn readers_of(spoken: u16) -> u8 {
    let has = |protocols: u16, reader: u8| if spoken & protocols == 0 { 0 } else { reader };
    has(Protocol::DIAGNOSTICS, OF_DIAGNOSTICS)
        | has(FAMILY, OF_FAMILY)
        | has(Protocol::CanOpen.bit(), OF_CANOPEN)
        | has(Protocol::DeviceNet.bit(), OF_DEVICENET)
        | has(Protocol::Xcp.bit(), OF_XCP)
        | has(Protocol::Ccp.bit(), OF_CCP)
        | has(Protocol::DroneCan.bit(), OF_DRONECAN)
        | has(Protocol::Cyphal.bit(), OF_CYPHAL)
}

/// Whose groups a channel with these protocols has.
const fn groups_of(spoken: u16) -> Groups {
    match spoken & FAMILY {
        FAMILY => Groups::Both,
        family if family == Protocol::Nmea2000.bit() => Groups::Boat,
        _ => Groups::Vehicle,
    }
}

impl Conversations {
    /// Sets up decoding according to the options, and to what each channel speaks by a survey. Without one, channels are decoded by the
    /// protocols of the options; if those are empty too, by ISO 15765-2 and the protocols on top of it. These are looked for on every
    /// channel, since a tester may come at any time: where a survey has not found them, what looks like them is held back until an
    /// exchange shows that it is them.
    pub fn new(options: &Options, spoken: Option<&[Evidence]>) -> Self {
        let bits = |protocols: &[Protocol]| protocols.iter().fold(0, |bits, protocol| bits | protocol.bit());
        let wanted = if options.protocols.is_empty() { u16::MAX } else { bits(&options.protocols) };
        // Without a survey or a choice, frames that fit two protocols would be decoded twice.
        let everywhere = match (spoken, options.protocols.is_empty()) {
            (Some(_), _) | (None, true) => (Protocol::DIAGNOSTICS | options.calibration.protocols()) & wanted,
            (None, false) => wanted,
        };
        let (mut of_channels, mut doubts) = ([everywhere; 256], FxHashMap::default());
        if spoken.is_some() {
            doubts.extend((0..=u8::MAX).map(|channel| (channel, Doubt::default())));
        }
        for evidence in spoken.into_iter().flatten() {
            of_channels[usize::from(evidence.channel)] |= evidence.protocol.bit() & wanted;
            if evidence.protocol.is_diagnostics() {
                doubts.remove(&evidence.channel);
            }
        }
        let mut this = Self {
            readers: Default::default(),
            family: None,
            spoken: Box::new(of_channels),
            of_channel: Box::new([0; 256]),
            wanted,
            doubts,
            calibrated: FxHashSet::default(),
        };
        this.assign(options);
        this
    }

    /// The channel has RV-C's groups beside J1939's.
    pub fn read_rv_c(&mut self, channel: u8) {
        if let Some(family) = &mut self.family {
            family.assign_rv_c(channel);
        }
    }

    /// Goes on with diagnostics that have been read until here.
    pub fn go_on_with(&mut self, diagnostics: Diagnostics) {
        self.readers[OF_DIAGNOSTICS.trailing_zeros() as usize] = Some(Box::new(diagnostics));
    }

    /// Takes a record whose diagnostics have been read already, with what they said.
    pub fn take_read(
        &mut self,
        record: &TraceRecord,
        said: impl Iterator<Item = Event>,
        events: &mut Vec<Event>,
    ) {
        let before = events.len();
        self.read(record, self.of_channel[usize::from(record.channel)] & !OF_DIAGNOSTICS, events);
        events.extend(said);
        self.leave_out_calibration(before, events);
        self.hold_back(before, events);
    }

    /// From now on, decodes this as well, beginning with the records that showed it.
    pub fn also(&mut self, options: &Options, begun: &Begun, events: &mut Vec<Event>) {
        let Evidence { channel, protocol, .. } = begun.evidence;
        let channel = usize::from(channel);
        let before = self.of_channel[channel];
        self.spoken[channel] |= protocol.bit() & self.wanted;
        self.assign(options);
        let readers = self.of_channel[channel] & !before;
        begun.held.iter().for_each(|record| self.read(record, readers, events));
    }

    /// Gives each channel the decoders that it needs.
    fn assign(&mut self, options: &Options) {
        *self.of_channel = self.spoken.map(readers_of);
        let needed = self.of_channel.iter().fold(0, |all, readers| all | readers);
        if needed & OF_FAMILY != 0 {
            let family = self.family.get_or_insert_with(|| Box::new(J1939::new(options.decoder.clone())));
            for (channel, spoken) in (0..=u8::MAX).zip(self.spoken.iter()) {
                family.assign(channel, groups_of(*spoken));
            }
        }
        for (number, reader) in self.readers.iter_mut().enumerate() {
            if needed & 1 << number & !OF_FAMILY == 0 || reader.is_some() {
                continue;
            }
            *reader = Some(match 1 << number {
                OF_DIAGNOSTICS if self.wanted == Protocol::IsoTp.bit() => {
                    Box::new(IsoTp::new(&options.pairs, true))
                }
                OF_DIAGNOSTICS => {
                    let diagnostics = Diagnostics::new(&options.pairs, true);
                    Box::new(diagnostics.with_descriptions(options.descriptions.clone()))
                }
                OF_CANOPEN => Box::new(CanOpen::new(options.sheets.clone())),
                OF_XCP => Box::new(Xcp::new(options.calibration.clone())),
                OF_CCP => Box::new(Ccp::new(options.calibration.clone())),
                of @ (OF_DRONECAN | OF_CYPHAL) => {
                    let types = options.types.clone().unwrap_or_else(DataTypes::built_in);
                    let is_cyphal = of == OF_CYPHAL;
                    let generation = if is_cyphal { Generation::Cyphal } else { Generation::DroneCan };
                    Box::new(Uavcan::new(generation, types))
                }
                _ => Box::new(DeviceNet::new()),
            });
        }
    }

    /// Takes the next record and appends what it completes.
    pub fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        let readers = self.of_channel[usize::from(record.channel)];
        let before = events.len();
        self.read(record, readers, events);
        if events.len() > before {
            self.leave_out_calibration(before, events);
            self.keep_wanted(before, events);
            self.hold_back(before, events);
        }
    }

    fn read(&mut self, record: &TraceRecord, readers: u8, events: &mut Vec<Event>) {
        if readers & OF_FAMILY != 0
            && let Some(family) = &mut self.family
        {
            family.take(record, events);
        }
        let mut readers = readers & !OF_FAMILY;
        while readers != 0 {
            if let Some(reader) = &mut self.readers[readers.trailing_zeros() as usize] {
                reader.take(record, events);
            }
            readers &= readers - 1;
        }
    }

    /// The trace has ended: appends whatever was in progress.
    pub fn finish(&mut self, events: &mut Vec<Event>) {
        let before = events.len();
        for reader in self.readers.iter_mut().flatten() {
            reader.finish(events);
        }
        if let Some(family) = &mut self.family {
            family.finish(events);
        }
        self.leave_out_calibration(before, events);
        self.keep_wanted(before, events);
        self.hold_back(before, events);
    }

    /// The transfers in progress, in the order in which they began.
    pub fn under_way(&self) -> Vec<UnderWay> {
        let mut under_way = Vec::new();
        self.readers.iter().flatten().for_each(|reader| reader.under_way(&mut under_way));
        self.family.iter().for_each(|family| family.under_way(&mut under_way));
        under_way.retain(|transfer| {
            !transfer.protocol.is_diagnostics() || !self.doubts.contains_key(&transfer.channel)
        });
        under_way.sort_by_key(|transfer| transfer.start_ns);
        under_way
    }

    /// Removes new events of diagnostics about frames of XCP and CCP: their data packets begin with any number, as those of ISO 15765-2 do.
    fn leave_out_calibration(&mut self, before: usize, events: &mut Vec<Event>) {
        for event in &events[before..] {
            if event.protocol.bit() & Protocol::CALIBRATION != 0 {
                let ids = [event.from, event.to].into_iter().filter_map(|party| match party {
                    Party::Id(id) => Some((event.channel, id)),
                    _ => None,
                });
                self.calibrated.extend(ids);
            }
        }
        if self.calibrated.is_empty() {
            return;
        }
        for event in events.split_off(before) {
            let has = |party: Party| match party {
                Party::Id(id) | Party::Addressed(id, _) => self.calibrated.contains(&(event.channel, id)),
                _ => false,
            };
            if !event.protocol.is_diagnostics() || !(has(event.from) || has(event.to)) {
                events.push(event);
            }
        }
    }

    /// Holds back new events of diagnostics on channels where nothing has shown yet that it is them.
    fn hold_back(&mut self, before: usize, events: &mut Vec<Event>) {
        let is_doubtful = |event: &Event| event.protocol.is_diagnostics();
        if self.doubts.is_empty() || !events[before..].iter().any(is_doubtful) {
            return;
        }
        for event in events.split_off(before) {
            let channel = event.channel;
            let Some(doubt) = self.doubts.get_mut(&channel).filter(|_| is_doubtful(&event)) else {
                events.push(event);
                continue;
            };
            doubt.signs.take(&event);
            if doubt.held.len() == MOST_HELD {
                doubt.held.pop_front();
            }
            doubt.held.push_back(event);
            if doubt.signs.found().next().is_some()
                && let Some(doubt) = self.doubts.remove(&channel)
            {
                events.extend(doubt.held);
            }
        }
    }

    /// Removes the events of protocols that were not requested.
    fn keep_wanted(&self, before: usize, events: &mut Vec<Event>) {
        if self.wanted == u16::MAX {
            return;
        }
        // Only new events: the caller may keep all events of a long trace in the same vector.
        let mut end = before;
        let diagnostics = self.wanted & Protocol::DIAGNOSTICS != 0;
        for at in before..events.len() {
            let Event { protocol, trouble, .. } = &events[at];
            // A broken transfer may have been a request, or its response: nobody can tell which.
            let broke = diagnostics && *protocol == Protocol::IsoTp && trouble.is_some();
            if broke || self.wanted & protocol.bit() != 0 {
                events.swap(end, at);
                end += 1;
            }
        }
        events.truncate(end);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::EventKind;
    use crate::testing::at;

    fn event_lines(protocol: Protocol, frames: &[(f64, &str)]) -> Vec<String> {
        let options = Options { protocols: vec![protocol], ..Options::default() };
        let (mut conversations, mut events) = (Conversations::new(&options, None), Vec::new());
        for (ms, frame) in frames {
            conversations.take(&at(*ms, frame), &mut events);
        }
        conversations.finish(&mut events);
        events.iter().map(ToString::to_string).collect()
    }

    /// Anyone who decodes a single protocol must not think that a bus on which its transfers break is in
    /// order.
    #[test]
    fn transfers_that_break_are_said_whatever_they_would_have_been() {
        let frames =
            [(0.0, "7E0#1FFF360102030405"), (1.0, "7E8#320000"), (2.0, "7E0#023E00"), (3.0, "7E8#027E00")];
        let uds_lines = event_lines(Protocol::Uds, &frames);
        assert_eq!(uds_lines.len(), 2, "{uds_lines:?}");
        assert!(uds_lines[0].ends_with("refused by the receiver: too long for it"), "{uds_lines:?}");
        assert_eq!(event_lines(Protocol::J1939, &frames), [""; 0]);
    }

    /// A tester is plugged in long after a survey of the first frames: its requests are shown, those without a response among them, but
    /// not what only looks like them.
    #[test]
    fn a_tester_may_come_at_any_time() {
        let (mut conversations, mut events) =
            (Conversations::new(&Options::default(), Some(&[])), Vec::new());
        for (ms, frame) in
            [(0.0, "7E8#0150000000000000"), (1.0, "7E3#1122334455667788"), (3000.0, "7E0#023E00")]
        {
            conversations.take(&at(ms, frame), &mut events);
        }
        conversations.take(&at(9000.0, "7E0#0322F190"), &mut events);
        assert_eq!(events, []);
        conversations.take(&at(9001.0, "7E8#0462F19041"), &mut events);
        let said: Vec<_> = events.iter().map(|event| (event.kind, event.time_ns / 1_000_000)).collect();
        assert_eq!(said.last(), Some(&(EventKind::Exchange, 9001)));
        assert!(said.iter().any(|(kind, _)| *kind == EventKind::NoResponse), "{said:?}");
        let before = events.len();
        conversations.take(&at(9002.0, "7E0#0210"), &mut events);
        conversations.take(&at(9003.0, "7E8#037F1012"), &mut events);
        conversations.finish(&mut events);
        assert!(events.len() > before && conversations.under_way().is_empty());
    }

    #[test]
    fn a_broken_fast_packet_has_its_groups_name() {
        let broken = event_lines(
            Protocol::Nmea2000,
            &[(0.0, "0DF80501#002B000102030405"), (1.0, "0DF80501#020D0E0F10111213")],
        );
        assert!(broken[0].starts_with("nmea2000 1 > all GNSS Position Data: "), "{broken:?}");
        let asked = event_lines(Protocol::Nmea2000, &[(0.0, "18EAFF01#14F001")]);
        assert!(asked[0].contains("requested 126996 (Product Information)"), "{asked:?}");
    }
}
