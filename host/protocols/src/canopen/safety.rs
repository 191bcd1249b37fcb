//! CANopen safety (EN 50325-5, once CiA 304): safety-related data objects (SRDO), and the global fail-safe command (GFC).
//!
//! An SRDO is two frames: the data on an odd identifier from 101 to 17F, and their bitwise inverse on the next one. A pair of identifiers is
//! known from a sheet (1301 to 1340), or from pairs that fit ([`PAIRS_ENOUGH`]): until then nothing is said of it, and what came meanwhile
//! is said when it is known. Identifiers, times and mapping are as in CANopenNode (`304/CO_SRDO.c`, `304/CO_GFC.c`; Apache License 2.0).

use std::collections::BTreeMap;

use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;

use super::drive::DriveView;
use super::eds::Eds;
use super::events::{event, nothing};
use super::pdo;
use crate::{Bytes, Event, EventKind, Field, Party, Trouble};

/// The identifier of the global fail-safe command.
pub const GFC: u16 = 1;

/// How many pairs make a pair of identifiers known without a sheet: one byte and its inverse are soon met by chance, and those that are
/// all zeros and all ones sooner.
const PAIRS_ENOUGH: usize = 3;
const TRIVIAL_PAIRS_ENOUGH: usize = 10;

/// For how long the second frame may take, where no sheet says it: the standard's default.
const VALIDATION_MS: u8 = 20;

/// A second frame that takes longer than this many of its times is not late, but missing.
const MISSED_TIMES: i64 = 5;

/// What a sheet says of an SRDO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Parameters {
    node: u8,
    /// Its place, from 0.
    place: u16,
    /// Otherwise the node receives it.
    is_sent: bool,
    /// The time within which it comes again, if the node receives it and watches that.
    cycle_ms: u16,
    validation_ms: u8,
}

/// The SRDOs that are known from sheets, by the identifier of the data.
#[derive(Clone, Debug, Default)]
pub struct SafetySheets(BTreeMap<u16, Parameters>);

impl SafetySheets {
    /// Takes what a node's sheet says. Where the sheet is not `of_the_node` alone, only identifiers that depend on its number.
    pub fn add_sheet(&mut self, eds: &Eds, node: u8, of_the_node: bool) {
        for (&index, object) in eds.objects.range(0x1301..=0x1340) {
            let value = |sub| eds.value_of(index, sub, node);
            let place = index - 0x1301;
            let is_own = object
                .entries
                .get(&5)
                .is_some_and(|entry| entry.value.to_ascii_uppercase().contains("$NODEID"));
            let (Some(direction @ 1..=2), Some(id)) =
                (value(1), value(5).and_then(|id| u16::try_from(id).ok()))
            else {
                continue;
            };
            // The default of the first one leaves the node's number out.
            let id = if id == DEFAULT_ID && !is_own && node <= 64 { id + 2 * u16::from(node) } else { id };
            let depends = is_own || value(5) == Some(DEFAULT_ID.into());
            if !(of_the_node || depends) || !is_of_data(id) {
                continue;
            }
            let parameters = Parameters {
                node,
                place,
                is_sent: direction == 1,
                cycle_ms: value(2).and_then(|ms| u16::try_from(ms).ok()).unwrap_or(0),
                validation_ms: value(3)
                    .and_then(|ms| u8::try_from(ms).ok())
                    .filter(|ms| *ms > 0)
                    .unwrap_or(VALIDATION_MS),
            };
            // Both the sender and those that receive it may have it: what is said comes from the sender.
            let known = self.0.entry(id).or_insert(parameters);
            if parameters.is_sent {
                *known = Parameters { cycle_ms: known.cycle_ms.max(parameters.cycle_ms), ..parameters };
            }
        }
    }
}

/// The identifier in object 1301, to which twice the node's number is added.
const DEFAULT_ID: u16 = 0xFF;

/// Whether an identifier may be that of an SRDO's data.
const fn is_of_data(id: u16) -> bool {
    matches!(id, 0x101..=0x17F) && id % 2 == 1
}

/// The SRDOs of one bus, by the identifier of their data.
#[derive(Default)]
pub struct Safety(FxHashMap<u16, Srdo>);

#[derive(Default)]
struct Srdo {
    /// The data that wait for their inverse.
    open: Option<(TraceRecord, Bytes)>,
    is_known: bool,
    /// Pairs before it was known.
    held: Vec<Event>,
    /// Whether one of them was not all zeros or all ones.
    has_content: bool,
    latest_ns: Option<i64>,
    is_missing: bool,
    frames_lost: bool,
}

/// The sheets, by their safety parameters and by node.
pub struct KnownSheets<'a> {
    pub sheets: &'a SafetySheets,
    pub sheet_of: &'a dyn Fn(u8) -> Option<&'a Eds>,
}

impl KnownSheets<'_> {
    fn of(&self, id: u16) -> Option<Parameters> {
        self.sheets.0.get(&id).copied()
    }

    fn validation_ns(&self, id: u16) -> i64 {
        i64::from(self.of(id).map_or(VALIDATION_MS, |of| of.validation_ms)) * 1_000_000
    }

    /// An SRDO's event, without its content.
    fn event(&self, record: &TraceRecord, id: u16) -> Event {
        let Some(Parameters { node, place, is_sent, .. }) = self.of(id) else {
            let mut event = event(record, EventKind::Srdo, "SRDO");
            // The predefined identifiers of the first SRDO of nodes 1 to 64.
            event.from = Party::Node(((id - DEFAULT_ID) / 2) as u8);
            event.fields.push(Field::hex("id", id, 3));
            return event;
        };
        let mut event = event(record, EventKind::Srdo, format!("SRDO{}", place + 1));
        *(if is_sent { &mut event.from } else { &mut event.to }) = Party::Node(node);
        event.fields.push(Field::hex("id", id, 3));
        event
    }

    /// Adds the values of the data, or the data.
    fn content(&self, id: u16, data: &[u8], event: &mut Event) {
        let of = self.of(id);
        let sheet = of.and_then(|of| (self.sheet_of)(of.node));
        let (node, mapping) = of.map_or((0, 0), |of| (of.node, 0x1381 + of.place));
        let value = |sub| sheet.and_then(|eds| eds.value_of(mapping, sub, node));
        // The data's and the inverse's take turns.
        let subs = (1..=value(0).unwrap_or(0).min(16) as u8).step_by(2);
        pdo::values(subs.map_while(value), node, data, sheet, &mut DriveView::default(), event);
    }
}

/// The command that sends everything to its safe state.
pub fn global_failsafe(record: &TraceRecord, data: &[u8]) -> Event {
    let mut event = event(record, EventKind::Failsafe, "global fail-safe command");
    event.to = Party::Everyone;
    if !data.is_empty() {
        event.fields.push(Field::bytes("data", data));
        event.trouble = Some(Trouble::Malformed("a global fail-safe command has no data"));
    }
    event
}

impl Safety {
    /// Takes a frame with an identifier from 101 to 180.
    pub fn take(
        &mut self,
        record: &TraceRecord,
        id: u16,
        data: &[u8],
        known: &KnownSheets<'_>,
        events: &mut Vec<Event>,
    ) {
        if is_of_data(id) {
            self.data(record, id, data, known, events);
        } else {
            self.inverse(record, id - 1, data, known, events);
        }
    }

    fn data(
        &mut self,
        record: &TraceRecord,
        id: u16,
        data: &[u8],
        known: &KnownSheets<'_>,
        events: &mut Vec<Event>,
    ) {
        let srdo = self.0.entry(id).or_default();
        srdo.is_known |= known.of(id).is_some();
        if let Some((first, data)) = srdo.open.replace((*record, Bytes::from_slice(data))) {
            srdo.half(|| known.event(&first, id), Field::bytes("data", &data), Trouble::Overlapped, events);
        }
    }

    fn inverse(
        &mut self,
        record: &TraceRecord,
        id: u16,
        data: &[u8],
        known: &KnownSheets<'_>,
        events: &mut Vec<Event>,
    ) {
        let Some(srdo) = self.0.get_mut(&id) else { return };
        let Some((first, plain)) = srdo.open.take() else {
            srdo.half(|| known.event(record, id), Field::bytes("inverse", data), Trouble::Headless, events);
            return;
        };
        let after_ns = record.time_ns.saturating_sub(first.time_ns);
        let is_inverse = plain.len() == data.len() && plain.iter().zip(data).all(|(a, b)| *a == !*b);
        let is_late = after_ns > known.validation_ns(id);
        if !srdo.is_known && (!is_inverse || is_late || plain.is_empty()) {
            srdo.forget();
            return;
        }
        let mut event = known.event(record, id);
        event.start_ns = first.time_ns;
        event.frames = 2;
        event.data.clone_from(&plain);
        event.frames_lost = std::mem::take(&mut srdo.frames_lost);
        if is_inverse {
            known.content(id, &plain, &mut event);
        } else {
            event.fields.push(Field::bytes("data", &plain));
            event.fields.push(Field::bytes("inverse", data));
            event.trouble = Some(Trouble::Malformed("the second frame is not the inverse of the first"));
        }
        event.fields.push(Field::real("inverse_after_ms", after_ns as f64 / 1e6, "ms"));
        if is_late && event.trouble.is_none() {
            event.trouble = Some(Trouble::Timeout { after_ms: (known.validation_ns(id) / 1_000_000) as u32 });
        }
        if std::mem::take(&mut srdo.is_missing) {
            event.title = format!("{} is back", event.title).into();
        }
        srdo.latest_ns = Some(record.time_ns);
        if srdo.is_known {
            events.push(event);
            return;
        }
        srdo.has_content |= !(plain.iter().all(|byte| *byte == 0) || plain.iter().all(|byte| *byte == 0xFF));
        srdo.held.push(event);
        let enough = if srdo.has_content { PAIRS_ENOUGH } else { TRIVIAL_PAIRS_ENOUGH };
        if srdo.held.len() >= enough {
            srdo.is_known = true;
            events.append(&mut srdo.held);
        }
    }

    /// Says what has not come.
    pub fn sweep(&mut self, channel: u8, now_ns: i64, known: &KnownSheets<'_>, events: &mut Vec<Event>) {
        for (&id, srdo) in &mut self.0 {
            let validation_ns = known.validation_ns(id);
            let is_missed = |(first, _): &mut (TraceRecord, Bytes)| {
                now_ns.saturating_sub(first.time_ns) > MISSED_TIMES * validation_ns
            };
            if let Some((first, data)) = srdo.open.take_if(is_missed) {
                let late = || {
                    let mut event = known.event(&first, id);
                    event.time_ns = first.time_ns + validation_ns;
                    event
                };
                let trouble = Trouble::Timeout { after_ms: (validation_ns / 1_000_000) as u32 };
                srdo.half(late, Field::bytes("data", &data), trouble, events);
            }
            let cycle_ns = known.of(id).map_or(0, |of| i64::from(of.cycle_ms) * 1_000_000);
            if let Some(latest_ns) = srdo.latest_ns
                && cycle_ns > 0
                && !srdo.is_missing
                && now_ns.saturating_sub(latest_ns) > cycle_ns + validation_ns
            {
                srdo.is_missing = true;
                let record = TraceRecord { time_ns: latest_ns + cycle_ns, ..nothing(channel) };
                let mut event = known.event(&record, id);
                event.title = format!("{} missing", event.title).into();
                event.frames = 0;
                event.start_ns = latest_ns;
                event.trouble = Some(Trouble::Timeout { after_ms: (cycle_ns / 1_000_000) as u32 });
                event.frames_lost = std::mem::take(&mut srdo.frames_lost);
                events.push(event);
            }
        }
    }

    /// Frames were lost.
    pub fn interrupt(&mut self) {
        for srdo in self.0.values_mut() {
            srdo.open = None;
            srdo.latest_ns = None;
            srdo.frames_lost = srdo.is_known;
        }
    }
}

impl Srdo {
    /// One frame of a pair came without the other: that is said if the pair is known, and otherwise it is none.
    fn half(
        &mut self,
        event: impl FnOnce() -> Event,
        frame: Field,
        trouble: Trouble,
        events: &mut Vec<Event>,
    ) {
        if !self.is_known {
            self.forget();
            return;
        }
        let mut event = event();
        event.fields.push(frame);
        event.trouble = Some(trouble);
        event.frames_lost = std::mem::take(&mut self.frames_lost);
        events.push(event);
    }

    /// What came is no pair, and nothing was said of it.
    fn forget(&mut self) {
        self.held.clear();
        self.has_content = false;
    }
}

#[cfg(test)]
mod tests {
    use super::super::{CanOpen, Sheet};
    use super::*;
    use crate::testing::{self, at, hex, lost};

    /// Four pairs of one node, 25 ms apart.
    fn pairs(data: &[u8]) -> Vec<(f64, String)> {
        let inverse: Vec<u8> = data.iter().map(|byte| !byte).collect();
        let pair =
            |at: f64| [(at, format!("105#{}", hex(data))), (at + 1.5, format!("106#{}", hex(&inverse)))];
        (0..4).flat_map(|number| pair(f64::from(number) * 25.0)).collect()
    }

    fn lines(frames: &[(f64, String)]) -> Vec<String> {
        let frames: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
        testing::event_lines(CanOpen::default(), &frames)
    }

    #[test]
    fn pairs_of_data_and_their_inverse_are_safety_related_data() {
        let found = lines(&pairs(&[0x12, 0x34]));
        assert_eq!(found.len(), 4, "those before it was known, too");
        assert_eq!(found[0], "canopen 3 SRDO: id 0x105, data 12 34, inverse_after_ms 1.5 ms");
        // A constant of zeros and ones has to be seen more often.
        assert_eq!(lines(&pairs(&[0, 0])).len(), 0);
        let frames: Vec<_> = (0..3)
            .flat_map(|round| {
                pairs(&[0, 0]).into_iter().map(move |(at, frame)| (at + 100.0 * f64::from(round), frame))
            })
            .collect();
        assert_eq!(lines(&frames).len(), 12);
    }

    #[test]
    fn a_pair_that_does_not_fit_or_comes_late_is_said() {
        let mut frames = pairs(&[0x12]);
        let frame = |at: f64, frame: &str| (at, frame.to_owned());
        frames.extend([
            frame(100.0, "105#12"),
            frame(101.0, "106#EC"),
            frame(125.0, "105#12"),
            frame(146.0, "106#ED"),
            frame(150.0, "106#ED"),
            frame(175.0, "105#12"),
            frame(200.0, "105#12"),
            frame(400.0, "705#05"),
        ]);
        assert_eq!(
            lines(&frames)[4..],
            [
                "canopen 3 SRDO: id 0x105, data 12, inverse EC, inverse_after_ms 1 ms; \
                 malformed: the second frame is not the inverse of the first",
                "canopen 3 SRDO: id 0x105, data 12, inverse_after_ms 21 ms; nothing came for 20 ms",
                "canopen 3 SRDO: id 0x105, inverse ED; its beginning is missing",
                "canopen 3 SRDO: id 0x105, data 12; the next one began before it was complete",
                "canopen 3 SRDO: id 0x105, data 12; nothing came for 20 ms",
                "canopen 5 operational",
            ]
        );
        // Where frames are missing, nothing is wrong with what is left of a pair.
        let mut records: Vec<_> = frames[..9].iter().map(|(ms, frame)| at(*ms, frame)).collect();
        records.extend([lost(110.0), at(125.0, "105#12"), at(126.0, "106#ED")]);
        let events = testing::events(CanOpen::default(), &records);
        assert!(events.iter().all(|event| event.trouble.is_none()), "{events:?}");
        assert!(events[4].frames_lost && !events[3].frames_lost);
    }

    /// On a bus where other things have these identifiers, nothing is claimed.
    #[test]
    fn other_frames_there_are_none() {
        let mut random = fastrand::Rng::with_seed(25);
        let mut frames = Vec::new();
        for at in 0..20_000 {
            let id = random.u16(0x101..0x181);
            let data: Vec<u8> = (0..random.usize(0..4)).map(|_| random.u8(..)).collect();
            frames.push((f64::from(at), format!("{id:03X}#{}", hex(&data))));
        }
        // One signal after another with its inverse beside it now and then.
        for at in 0..100_u8 {
            let first = f64::from(at) * 100.0 + 20_000.0;
            let second = if at % 3 == 0 { at } else { !at };
            frames.extend([(first, format!("111#{at:02X}")), (first + 2.0, format!("112#{second:02X}"))]);
        }
        assert_eq!(lines(&frames), Vec::<String>::new());
    }

    #[test]
    fn the_global_failsafe_command_is_for_everyone() {
        assert_eq!(
            testing::event_lines(CanOpen::default(), &[(0.0, "001#"), (1.0, "001#01")]),
            [
                "canopen ? > all global fail-safe command",
                "canopen ? > all global fail-safe command: data 01; malformed: a global fail-safe command has no data",
            ]
        );
    }

    const SHEET: &str = "[DeviceInfo]\nProductName=Scanner\n[1301]\nParameterName=SRDO\nObjectType=9\n[1301sub1]\nDataType=5\nDefaultValue=1\n\
        [1301sub2]\nDataType=6\nDefaultValue=50\n[1301sub3]\nDataType=5\nDefaultValue=10\n[1301sub5]\nDataType=7\nDefaultValue=0xFF\n\
        [1301sub6]\nDataType=7\nDefaultValue=0x100\n[1381]\nParameterName=Mapping\nObjectType=9\n[1381sub0]\nDataType=5\nDefaultValue=4\n\
        [1381sub1]\nDataType=7\nDefaultValue=0x20000108\n[1381sub2]\nDataType=7\nDefaultValue=0x20000208\n\
        [1381sub3]\nDataType=7\nDefaultValue=0x20000310\n[1381sub4]\nDataType=7\nDefaultValue=0x20000410\n[2000]\nParameterName=Safe\nObjectType=9\n\
        [2000sub1]\nParameterName=Zones\nDataType=5\n[2000sub3]\nParameterName=Distance\nDataType=6\n";

    #[test]
    fn a_sheet_names_the_values_and_says_the_times() {
        let eds = std::sync::Arc::new(Eds::parse(SHEET.as_bytes()));
        let assembler = CanOpen::new(vec![Sheet { node: Some(7), eds }]);
        let frames = [
            (0.0, "10D#05E803"),
            (1.0, "10E#FA17FC"),
            (25.0, "10D#05E803"),
            (36.0, "10E#FA17FC"),
            (200.0, "707#05"),
            (225.0, "10D#05E803"),
            (226.0, "10E#FA17FC"),
        ];
        assert_eq!(
            testing::event_lines(assembler, &frames),
            [
                "canopen 7 SRDO1: id 0x10D, Zones 5, Distance 1000, inverse_after_ms 1 ms",
                "canopen 7 SRDO1: id 0x10D, Zones 5, Distance 1000, inverse_after_ms 11 ms; nothing came for 10 ms",
                "canopen 7 SRDO1 missing: id 0x10D; nothing came for 50 ms",
                "canopen 7 operational",
                "canopen 7 SRDO1 is back: id 0x10D, Zones 5, Distance 1000, inverse_after_ms 1 ms",
            ]
        );
    }
}
