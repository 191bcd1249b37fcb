//! An inventory of a bus, from what was said on it: its nodes with their states and trouble codes, the objects that were read,
//! written or sent, and response times.
//!
//! Memory is limited by the numbers of nodes, services and objects in the constants here; anything beyond is
//! counted.

mod object;

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::hash::Hash;

use hdrhistogram::Histogram as Counts;
use rustc_hash::FxHashMap;

use self::object::{ObjectKey, number, short};
use crate::canopen::drive::DriveState;
use crate::{Event, EventKind, Party, Protocol, Trouble, Value};

const MOST_NODES: usize = 1024;
const MOST_SERVICES: usize = 256;
const MOST_OBJECTS: usize = 8192;
/// Number of trouble code lists per node: confirmed, pending, previously active.
const MOST_LISTS: usize = 8;
/// Collects figures from events.
#[derive(Clone, Debug, Default)]
pub struct Overview {
    services: FxHashMap<(u8, Protocol, Cow<'static, str>), ServiceFigures>,
    nodes: FxHashMap<(u8, Protocol, Party), KnownNode>,
    /// With the object in words.
    objects: FxHashMap<(u8, Protocol, Party, ObjectKey), (String, KnownObject)>,
    left_out: u64,
}

/// How often a service was used, and its response times.
#[derive(Clone, Debug, Default)]
pub struct ServiceFigures {
    /// Number of requests with their responses, or messages of a kind.
    pub count: u64,
    /// Number of those in which something went wrong.
    pub faults: u64,
    /// Number of unanswered requests.
    pub unanswered: u64,
    /// Times from the end of a request to the first frame of its response.
    pub responses: Histogram,
}

/// Times in nanoseconds: exact minimum and maximum, the rest within 0.1 %.
#[derive(Clone, Debug, Default)]
pub struct Histogram {
    counts: Option<Box<Counts<u32>>>,
    least_ns: i64,
    most_ns: i64,
}

/// A node, server or device.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KnownNode {
    /// When it was first and last heard, in nanoseconds.
    pub first_ns: i64,
    /// See [`Self::first_ns`].
    pub last_ns: i64,
    /// Number of events that involved it.
    pub events: u64,
    /// Number of those in which something went wrong.
    pub faults: u64,
    /// Its state: CANopen's, or that it is missing.
    pub state: Option<String>,
    /// Since when, in nanoseconds.
    pub state_ns: Option<i64>,
    /// Its state as a drive (CiA 402).
    pub drive: Option<&'static str>,
    /// Since when, in nanoseconds.
    pub drive_ns: Option<i64>,
    /// The heartbeat period in milliseconds, once a heartbeat was missed.
    pub period_ms: Option<f64>,
    /// How often a heartbeat or the answer to a guarding request was missed.
    pub missed: u64,
    /// Its identity: a VIN, or the function and manufacturer in a NAME.
    pub identity: Option<String>,
    /// Its trouble codes, by list.
    pub codes: BTreeMap<String, String>,
}

/// Something of a node that was read, written or sent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KnownObject {
    /// Its name, if known.
    pub name: Option<String>,
    /// How often.
    pub count: u64,
    /// Its last value as text, if it is of a kind that need not change.
    pub value: Option<String>,
    /// It has had different values.
    pub varies: bool,
}

impl Histogram {
    fn add(&mut self, ns: i64) {
        if self.counts.is_none() {
            // A tenth of a microsecond is finer than any stamp; three digits are a reasonable use of memory.
            self.counts = Counts::new(3).ok().map(Box::new);
            (self.least_ns, self.most_ns) = (ns, ns);
        }
        (self.least_ns, self.most_ns) = (self.least_ns.min(ns), self.most_ns.max(ns));
        if let Some(counts) = &mut self.counts {
            // It grows as needed; only a value too large for memory would not be counted.
            let _ = counts.record((ns.max(0) / UNIT_NS).unsigned_abs());
        }
    }

    /// The number of times.
    pub fn count(&self) -> u64 {
        self.counts.as_ref().map_or(0, |counts| counts.len())
    }

    /// The time in milliseconds that this percentage does not exceed: 0 for the minimum, 100 for the maximum.
    pub fn percentile_ms(&self, percent: f64) -> Option<f64> {
        let counts = self.counts.as_ref()?;
        let ns = if percent <= 0.0 {
            self.least_ns
        } else if percent >= 100.0 {
            self.most_ns
        } else {
            let middle = counts.value_at_quantile(percent / 100.0);
            (i64::try_from(middle).unwrap_or(i64::MAX).saturating_mul(UNIT_NS))
                .clamp(self.least_ns, self.most_ns)
        };
        Some(ns as f64 / 1e6)
    }
}

const UNIT_NS: i64 = 100;

impl Overview {
    /// Takes an event.
    pub fn take(&mut self, event: &Event) {
        self.service(event);
        let Some(of) = subject(event) else { return };
        self.node(event, of);
        self.object(event, of);
    }

    /// By channel, protocol and name of the service.
    pub fn services(&self) -> impl Iterator<Item = ((u8, Protocol, &str), &ServiceFigures)> {
        let services = self.services.iter();
        sorted(
            services.map(|((channel, protocol, title), figures)| ((*channel, *protocol, &**title), figures)),
        )
    }

    /// By channel, protocol and number or identifier.
    pub fn nodes(&self) -> impl Iterator<Item = ((u8, Protocol, String), &KnownNode)> {
        let nodes = self.nodes.iter();
        sorted(
            nodes.map(|((channel, protocol, node), known)| ((*channel, *protocol, node.to_string()), known)),
        )
    }

    /// By channel, protocol, node and number of the object.
    pub fn objects(&self) -> impl Iterator<Item = ((u8, Protocol, String, &str), &KnownObject)> {
        sorted(self.objects.iter().map(|((channel, protocol, node, _), (object, known))| {
            ((*channel, *protocol, node.to_string(), &**object), known)
        }))
    }

    /// The number of items not counted because there were too many.
    pub const fn left_out(&self) -> u64 {
        self.left_out
    }

    fn service(&mut self, event: &Event) {
        // Only if somebody answers: what is sent without being asked has its period in the statistics of its
        // identifier.
        if event.response_ns.is_none() && event.kind != EventKind::NoResponse {
            return;
        }
        let key = (event.channel, event.protocol, service_name(event));
        let Some(figures) = entry(&mut self.services, key, MOST_SERVICES) else {
            self.left_out += 1;
            return;
        };
        figures.count += 1;
        figures.faults += u64::from(event.is_fault());
        figures.unanswered += u64::from(event.kind == EventKind::NoResponse);
        if let Some(ns) = event.response_ns {
            figures.responses.add(ns);
        }
    }

    fn node(&mut self, event: &Event, of: Party) {
        let key = (event.channel, event.protocol, of);
        let is_new = !self.nodes.contains_key(&key);
        let Some(node) = entry(&mut self.nodes, key, MOST_NODES) else {
            self.left_out += 1;
            return;
        };
        if is_new {
            node.first_ns = event.start_ns;
        }
        node.last_ns = node.last_ns.max(event.time_ns);
        node.events += 1;
        node.faults += u64::from(event.is_fault());
        let state_before = node.state.clone();
        if let Some(state) = crate::uavcan::state(event) {
            node.state = Some(state);
        }
        if let Some(drive) = DriveState::in_event(event).map(DriveState::name)
            && node.drive.replace(drive) != Some(drive)
        {
            node.drive_ns = Some(event.time_ns);
        }
        if let Some(name) = crate::uavcan::node_name(event) {
            node.identity = Some(name);
        }
        match event.kind {
            EventKind::State | EventKind::BootUp => node.state = Some(event.title.to_string()),
            EventKind::HeartbeatBack => {
                let state = event.title.rsplit(": ").next().unwrap_or_default();
                node.state = Some(state.to_owned());
            }
            EventKind::HeartbeatMissing | EventKind::GuardMissing | EventKind::GuardingStopped => {
                node.missed += 1;
                node.state = Some(event.title.to_string());
                node.period_ms = number(event, "period_ms").or(node.period_ms);
            }
            EventKind::Emergency => {
                let code = event.field("code").map(ToString::to_string).unwrap_or_default();
                keep(&mut node.codes, "emergency", code);
            }
            EventKind::AddressClaim => node.identity = Some(identity(event)),
            _ => {}
        }
        if node.state != state_before {
            node.state_ns = Some(event.time_ns);
        }
        if let Some(codes) = event.field("codes").and_then(text) {
            keep(&mut node.codes, &event.title, codes);
        } else if number(event, "trouble_codes") == Some(0.0) {
            keep(&mut node.codes, &event.title, "none".to_owned());
        }
        let vin = event.field("vin").or_else(|| {
            let is_vin = number(event, "did") == Some(f64::from(0xF190));
            event.field("value").filter(|_| is_vin && event.protocol == Protocol::Uds)
        });
        if let Some(vin) = vin.and_then(text) {
            node.identity = Some(vin);
        }
    }

    fn object(&mut self, event: &Event, of: Party) {
        let Some(key) = object::key_of(event) else { return };
        let key = (event.channel, event.protocol, of, key);
        let Some((words, known)) = entry(&mut self.objects, key, MOST_OBJECTS) else {
            self.left_out += 1;
            return;
        };
        if known.count == 0 {
            *words = object::object_text(event);
        }
        known.count += 1;
        if known.name.is_none() {
            known.name = object::name_of(event);
        }
        if let Some(value) = object::value_of(event) {
            known.varies |= known.value.as_ref().is_some_and(|before| *before != value);
            known.value = Some(value);
        }
    }
}

fn sorted<K: Ord, V>(entries: impl Iterator<Item = (K, V)>) -> impl Iterator<Item = (K, V)> {
    let mut entries: Vec<_> = entries.collect();
    entries.sort_by(|(a, _), (b, _)| a.cmp(b));
    entries.into_iter()
}

/// The entry, created if there is room.
fn entry<K: Eq + Hash, V: Default>(map: &mut FxHashMap<K, V>, key: K, most: usize) -> Option<&mut V> {
    if map.len() >= most && !map.contains_key(&key) {
        return None;
    }
    Some(map.entry(key).or_default())
}

fn keep(lists: &mut BTreeMap<String, String>, list: &str, codes: String) {
    if lists.len() < MOST_LISTS || lists.contains_key(list) {
        lists.insert(list.to_owned(), short(codes));
    }
}

fn text(field: &crate::Field) -> Option<String> {
    match &field.value {
        Value::Text(text) => Some(text.to_string()),
        _ => None,
    }
}

/// Services as people would count them: those of SDO by what they do, not by object.
fn service_name(event: &Event) -> Cow<'static, str> {
    match event.kind {
        EventKind::SdoRead => "SDO read".into(),
        EventKind::SdoWrite => "SDO write".into(),
        EventKind::State | EventKind::Guard => "guarding".into(),
        _ => event.title.clone(),
    }
}

/// The party that the event is about: the server that was asked, or the sender.
fn subject(event: &Event) -> Option<Party> {
    let known = |party: Party| (!matches!(party, Party::Unknown | Party::Everyone)).then_some(party);
    match event.protocol {
        // An unanswered request says nothing about a node, and one to all says nothing about any.
        Protocol::J1939 | Protocol::Nmea2000 if event.kind == EventKind::NoResponse => known(event.to),
        Protocol::J1939 | Protocol::Nmea2000 | Protocol::IsoTp => known(event.from),
        Protocol::Xcp | Protocol::Ccp
            if matches!(event.kind, EventKind::Notification | EventKind::Periodic) =>
        {
            known(event.from)
        }
        Protocol::Uds | Protocol::Kwp2000 | Protocol::Obd | Protocol::Xcp | Protocol::Ccp => match event.kind
        {
            EventKind::Response => known(event.from),
            EventKind::Exchange | EventKind::Refusal => known(event.to),
            EventKind::NoResponse if matches!(event.trouble, Some(Trouble::Timeout { .. })) => {
                known(event.to)
            }
            _ => None,
        },
        Protocol::DroneCan | Protocol::Cyphal if event.kind == EventKind::Message => known(event.from),
        Protocol::DeviceNet | Protocol::DroneCan | Protocol::Cyphal
            if matches!(event.kind, EventKind::Exchange | EventKind::Refusal | EventKind::NoResponse) =>
        {
            known(event.to)
        }
        _ => event.node().map(Party::Node),
    }
}

/// The identity of a node according to its NAME.
fn identity(event: &Event) -> String {
    let part = |name: &str| {
        let field = event.field(name)?;
        Some(field.text.as_ref().map_or_else(|| format!("{name} {}", field.value), ToString::to_string))
    };
    let parts = ["function", "manufacturer", "identity"].into_iter().filter_map(part);
    parts.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::at;
    use crate::{Options, Reader};

    fn overview(protocol: Protocol, frames: &[(f64, &str)]) -> Overview {
        let options = Options { protocols: vec![protocol], ..Options::default() };
        let (mut reader, mut events) = (Reader::new(options), Vec::new());
        for (ms, frame) in frames {
            reader.push(&at(*ms, frame), &mut events);
        }
        reader.finish(&mut events);
        let mut overview = Overview::default();
        for event in &events {
            overview.take(event);
        }
        overview
    }

    #[test]
    fn responses_are_measured_by_service() {
        let mut frames = Vec::new();
        for round in 0..100 {
            frames.push((f64::from(round) * 100.0, "7E0#0322F18C"));
            frames.push((f64::from(round) * 100.0 + f64::from(round) + 1.0, "7E8#0662F18C313233"));
        }
        frames.push((20_000.0, "7E0#0322F190"));
        frames.push((20_001.0, "7E8#037F2231"));
        frames.push((21_000.0, "7E0#023E00"));
        frames.push((30_000.0, "123#"));
        let overview = overview(Protocol::Uds, &frames);
        let services: Vec<_> = overview.services().map(|((_, _, title), figures)| (title, figures)).collect();
        let [(read, figures), (tester, silent)] = services[..] else { panic!("{services:?}") };
        assert_eq!((read, figures.count, figures.faults), ("ReadDataByIdentifier", 101, 1));
        let at = |percent| figures.responses.percentile_ms(percent).unwrap();
        assert_eq!((at(0.0), at(100.0)), (1.0, 100.0));
        assert!(
            (at(50.0) - 50.0).abs() <= 1.0 && (at(99.0) - 99.0).abs() <= 1.0,
            "{} {}",
            at(50.0),
            at(99.0)
        );
        assert_eq!((tester, silent.unanswered, silent.responses.count()), ("TesterPresent", 1, 0));
        let objects: Vec<_> = overview.objects().collect();
        assert_eq!(objects.len(), 2);
        assert_eq!(objects[0].1.value.as_deref(), Some("\"123\""));
    }

    #[test]
    fn nodes_have_their_states_codes_and_names() {
        let plant = overview(
            Protocol::CanOpen,
            &[
                (0.0, "705#00"),
                (100.0, "705#7F"),
                (200.0, "705#05"),
                (300.0, "705#05"),
                (310.0, "085#1023010000000000"),
                (2000.0, "080#"),
            ],
        );
        let (_, node) = plant.nodes().next().unwrap();
        assert_eq!((node.state.as_deref(), node.missed), (Some("heartbeat missing"), 1));
        assert!(node.codes["emergency"].contains("0x2310"), "{:?}", node.codes);
        assert_eq!((node.state_ns, node.drive), (Some(550_000_000), None));
        let drive = overview(
            Protocol::CanOpen,
            &[
                (0.0, "605#4041600000000000"),
                (1.0, "585#4B41600037060000"),
                (9.0, "605#4041600000000000"),
                (10.0, "585#4B41600008060000"),
            ],
        );
        let (_, node) = drive.nodes().next().unwrap();
        assert_eq!((node.drive, node.drive_ns), (Some("fault"), Some(10_000_000)));
        let truck = overview(
            Protocol::J1939,
            &[
                (0.0, "18EEFF00#0100200000000010"),
                (5.0, "18FECA00#0000A6010305FFFF"),
                (9.0, "18FECA00#0000A6010305FFFF"),
            ],
        );
        let (key, node) = truck.nodes().next().unwrap();
        assert_eq!(key, (1, Protocol::J1939, "0".to_owned()));
        assert_eq!(node.identity.as_deref(), Some("engine, manufacturer 1, identity 1"));
        assert!(node.codes["DM1 active trouble codes"].starts_with("SPN 422 FMI 3"), "{:?}", node.codes);
        assert_eq!(truck.objects().count(), 2);
    }

    #[test]
    fn memory_is_bounded_and_what_is_left_out_is_counted() {
        let mut overview = Overview::default();
        let mut event = Event::new(Protocol::CanOpen, &at(0.0, "605#"), EventKind::SdoRead, "SDO read");
        event.to = Party::Node(5);
        for index in 0..20_000_u32 {
            event.fields = vec![crate::Field::hex("index", index, 4), crate::Field::hex("sub", 0_u8, 2)];
            overview.take(&event);
        }
        assert_eq!(overview.objects().count(), MOST_OBJECTS);
        assert_eq!(overview.left_out(), 20_000 - MOST_OBJECTS as u64);
    }
}
