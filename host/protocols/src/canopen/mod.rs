//! CANopen (CiA 301): network management, boot-up, heartbeat and guarding, SYNC, TIME, EMCY, SDO, PDO, LSS (CiA 305).
//!
//! Whatever repeats is reported only when it changes: a node's state, a heartbeat that stops or resumes, the first SYNC, a counter
//! that jumps. PDOs have names and values if an EDS or observed SDO transfers define their content.
//!
//! Memory: for each node on each channel, one SDO transfer of at most 64 KiB and the mappings of 512 PDOs.

pub mod eds;
mod encode;
mod lss;
mod names;
mod pdo;
mod sdo;
mod signs;
#[cfg(test)]
mod tests;
mod types;

pub use encode::{BadValue, encode, type_named};
pub use names::{abort as abort_text, state as state_name};
pub use sdo::crc_of;
pub use types::known as known_type;

use std::borrow::Cow;
use std::sync::Arc;

use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;

use self::eds::Eds;
use self::lss::Lss;
use self::pdo::Pdos;
use self::sdo::{Sdo, SdoTransfer};
pub(crate) use self::signs::CanOpenSigns;
use crate::{Assembler, Event, Field, Party, Protocol, Trouble, UnderWay, is_gap};

const SWEEP_NS: i64 = 50_000_000;
/// A heartbeat counts as missing after this many of its periods.
const MISSED_PERIODS: f64 = 2.5;
/// How long a node may take to answer a guarding request.
const GUARD_NS: i64 = 500_000_000;

/// A node's data sheet.
#[derive(Clone, Debug)]
pub struct Sheet {
    /// The node's number; `None` if it is for all nodes without a sheet of their own.
    pub node: Option<u8>,
    /// Its content.
    pub eds: Arc<Eds>,
}

#[derive(Default)]
struct Node {
    state: Option<u8>,
    /// The last heartbeat, and its period: measured, or as configured.
    beat_ns: Option<i64>,
    period_ns: Option<i64>,
    is_period_set: bool,
    is_missing: bool,
    /// The shortest time for which others wait for its heartbeat, as configured in their object 1016.
    consumer_ns: Option<i64>,
    /// Objects 100C and 100D as configured: guard time in milliseconds, and life time factor.
    life: (i64, i64),
    /// When it was last guarded; `None` once that has stopped for longer than its life time.
    guarded_ns: Option<i64>,
    /// A guarding request that waits for its answer.
    guard_ns: Option<i64>,
    toggle: Option<bool>,
    sdo: Sdo,
    pdos: Pdos,
    frames_lost: bool,
}

impl Node {
    /// Takes timeouts from an SDO transfer that wrote them; returns those of another node, with its number and in nanoseconds.
    fn learn_timeouts(&mut self, transfer: &SdoTransfer) -> Option<(u8, i64)> {
        if transfer.trouble.is_some() || !transfer.is_write {
            return None;
        }
        let value = i64::from(number_of(&transfer.data));
        match (transfer.index, transfer.sub) {
            (0x100C, 0) => self.life.0 = value & 0xFFFF,
            (0x100D, 0) => self.life.1 = value & 0xFF,
            (0x1016, 1..) => {
                let (node, ms) = ((value >> 16 & 0xFF) as u8, value & 0xFFFF);
                return ((1..128).contains(&node) && ms > 0).then_some((node, ms * 1_000_000));
            }
            _ => {}
        }
        None
    }
}

#[derive(Default)]
struct Bus {
    nodes: FxHashMap<u8, Node>,
    /// Which node's PDO an identifier is, if it is not the predefined one.
    pdo_ids: FxHashMap<u16, (u8, u16)>,
    lss: Lss,
    sync_ns: Option<i64>,
    sync_counter: Option<u8>,
}

/// Decodes a CANopen bus.
#[derive(Default)]
pub struct CanOpen {
    buses: FxHashMap<u8, Bus>,
    sheets: Vec<Sheet>,
    /// Identifiers of PDOs according to the sheets, if they are not the predefined ones.
    sheet_ids: FxHashMap<u16, (u8, u16)>,
    sweep_ns: i64,
}

impl CanOpen {
    /// With the nodes' sheets, if any.
    pub fn new(sheets: Vec<Sheet>) -> Self {
        let mut sheet_ids = FxHashMap::default();
        for sheet in &sheets {
            let nodes = sheet.node.map_or(1..=127, |node| node..=node);
            for node in nodes {
                let own = sheets.iter().any(|other| other.node == Some(node));
                if sheet.node.is_some() || !own {
                    let ids = pdo::sheet_ids(&sheet.eds, node, sheet.node.is_some());
                    sheet_ids.extend(ids.map(|(id, parameter)| (id, (node, parameter))));
                }
            }
        }
        Self { sheets, sheet_ids, ..Self::default() }
    }

    fn sheet(sheets: &[Sheet], node: u8) -> Option<&Eds> {
        let own = sheets.iter().find(|sheet| sheet.node == Some(node));
        own.or_else(|| sheets.iter().find(|sheet| sheet.node.is_none())).map(|sheet| &*sheet.eds)
    }

    fn frame(&mut self, record: &TraceRecord, id: u16, remote: bool, data: &[u8], events: &mut Vec<Event>) {
        let sheets = &self.sheets;
        let sheet_ids = &self.sheet_ids;
        let fresh = || Bus { pdo_ids: sheet_ids.clone(), ..Bus::default() };
        let bus = self.buses.entry(record.channel).or_insert_with(fresh);
        let node = (id & 0x7F) as u8;
        match id {
            _ if remote => {
                if id >> 7 == 0xE && node > 0 {
                    guard(bus, record, node, events);
                }
            }
            0 => {
                if let &[command, node] = data
                    && let Some(title) = names::command(command)
                {
                    let mut event = event(record, "nmt", title);
                    event.to = if node == 0 { Party::Everyone } else { Party::Node(node) };
                    event.fields.push(Field::number("command", command));
                    events.push(event);
                } else {
                    let fault = if data.len() == 2 { "an unknown command" } else { "a command has 2 bytes" };
                    events.push(malformed(record, "nmt", "network management", fault));
                }
            }
            0x80 => sync(bus, record, data, events),
            0x81..=0xFF => {
                if let &[low, high, register, ref rest @ ..] = data {
                    let code = u16::from_le_bytes([low, high]);
                    let mut event = event(record, "emergency", "emergency");
                    event.from = Party::Node(node);
                    event.fields.push(Field::hex("code", code, 4).meaning(Some(names::emergency(code))));
                    event.fields.push(Field::hex("register", register, 2).meaning(register_text(register)));
                    event.fields.push(Field::bytes("manufacturer", rest));
                    // Of the required length, or else what is there.
                    event.trouble =
                        (rest.len() != 5).then_some(Trouble::Malformed("an emergency has 8 bytes"));
                    events.push(event);
                } else {
                    let mut event = malformed(record, "emergency", "emergency", "an emergency has 8 bytes");
                    event.from = Party::Node(node);
                    events.push(event);
                }
            }
            0x100 => {
                if let &[a, b, c, d, low, high] = data {
                    let ms = u32::from_le_bytes([a, b, c, d]) & 0x0FFF_FFFF;
                    let days = u16::from_le_bytes([low, high]);
                    let mut event = event(record, "time", "time");
                    event.fields.push(Field::number("days_since_1984", days));
                    event.fields.push(Field::real("time_of_day_s", f64::from(ms) / 1000.0, "s"));
                    events.push(event);
                } else {
                    events.push(malformed(record, "time", "time", "a time has 6 bytes"));
                }
            }
            0x7E4 | 0x7E5 => events.extend(bus.lss.take(record, id == 0x7E5, data)),
            _ if node == 0 => {}
            0x581..=0x5FF | 0x601..=0x67F => {
                let from_client = id > 0x600;
                let sheet = Self::sheet(sheets, node);
                let ended = bus.nodes.entry(node).or_default().sdo.take(record.time_ns, from_client, data);
                for transfer in ended.into_iter().flatten() {
                    let entry = bus.nodes.entry(node).or_default();
                    let changed = transfer.trouble.is_none() && entry.pdos.learn(node, &transfer);
                    if transfer.trouble.is_none()
                        && transfer.is_write
                        && (transfer.index, transfer.sub) == (0x1017, 0)
                    {
                        let ms = i64::from(number_of(&transfer.data) & 0xFFFF);
                        entry.period_ns = Some(ms * 1_000_000).filter(|ns| *ns > 0);
                        entry.is_period_set = true;
                        entry.beat_ns = None;
                    }
                    let watched = entry.learn_timeouts(&transfer);
                    let lost = transfer.trouble.is_some() && std::mem::take(&mut entry.frames_lost);
                    let mut event = transfer_event(record, node, transfer, sheet);
                    event.frames_lost |= lost;
                    events.push(event);
                    if let Some((watched, ns)) = watched {
                        let entry = bus.nodes.entry(watched).or_default();
                        entry.consumer_ns = Some(entry.consumer_ns.map_or(ns, |known| known.min(ns)));
                    }
                    if changed && let Some(entry) = bus.nodes.get(&node) {
                        bus.pdo_ids.retain(|_, (of, _)| *of != node);
                        bus.pdo_ids.extend(entry.pdos.ids().map(|(id, number)| (id, (node, number))));
                    }
                }
            }
            0x701..=0x77F => heartbeat(bus, record, node, data, events),
            0x180..=0x57F => {
                // Four PDOs in each direction have their own identifiers.
                let (node, number) = bus.pdo_ids.get(&id).copied().unwrap_or((node, id & 0x780));
                let entry = bus.nodes.entry(node).or_default();
                let sheet = Self::sheet(sheets, node);
                events.push(entry.pdos.event(record, node, number, data, sheet));
            }
            _ => {
                if let Some(&(node, number)) = bus.pdo_ids.get(&id) {
                    let entry = bus.nodes.entry(node).or_default();
                    events.push(entry.pdos.event(record, node, number, data, Self::sheet(sheets, node)));
                }
            }
        }
    }

    /// Reports what has not come.
    fn sweep(&mut self, now_ns: i64, events: &mut Vec<Event>) {
        self.sweep_ns = now_ns.saturating_add(SWEEP_NS);
        let from = events.len();
        for (&channel, bus) in &mut self.buses {
            let event = |time_ns: i64, start_ns: i64, node: u8, kind, title: &'static str| Event {
                time_ns,
                start_ns,
                channel,
                from: Party::Node(node),
                ..Event::new(Protocol::CanOpen, &nothing(channel), kind, title)
            };
            for (&number, node) in &mut bus.nodes {
                if let (Some(beat_ns), Some(period_ns)) = (node.beat_ns, node.period_ns)
                    && !node.is_missing
                {
                    let patience = node.consumer_ns.unwrap_or((period_ns as f64 * MISSED_PERIODS) as i64);
                    if now_ns.saturating_sub(beat_ns) > patience {
                        node.is_missing = true;
                        let mut event = event(
                            beat_ns + patience,
                            beat_ns,
                            number,
                            "heartbeat_missing",
                            "heartbeat missing",
                        );
                        event.fields.push(Field::real("period_ms", period_ns as f64 / 1e6, "ms"));
                        event.trouble = Some(Trouble::Timeout { after_ms: (patience / 1_000_000) as u32 });
                        event.frames_lost = std::mem::take(&mut node.frames_lost);
                        event.frames = 0;
                        events.push(event);
                    }
                }
                if let Some(guard_ns) =
                    node.guard_ns.filter(|guard_ns| now_ns.saturating_sub(*guard_ns) > GUARD_NS)
                {
                    node.guard_ns = None;
                    let mut event = event(
                        guard_ns + GUARD_NS,
                        guard_ns,
                        number,
                        "guard_missing",
                        "no answer to guarding",
                    );
                    event.trouble = Some(Trouble::Timeout { after_ms: (GUARD_NS / 1_000_000) as u32 });
                    events.push(event);
                }
                let life_ns = node.life.0.saturating_mul(node.life.1).saturating_mul(1_000_000);
                if let Some(guarded_ns) = node.guarded_ns
                    && life_ns > 0
                    && now_ns.saturating_sub(guarded_ns) > life_ns
                {
                    node.guarded_ns = None;
                    let title = "guarding has stopped for longer than the life time";
                    let mut event =
                        event(guarded_ns + life_ns, guarded_ns, number, "guarding_stopped", title);
                    event.trouble = Some(Trouble::Timeout { after_ms: (life_ns / 1_000_000) as u32 });
                    event.frames = 0;
                    events.push(event);
                }
                let waits = node.sdo.open.as_ref().map(|open| open.time_ns);
                if waits.is_some_and(|since| now_ns.saturating_sub(since) > sdo::TIMEOUT_NS) {
                    let trouble = Trouble::Timeout { after_ms: (sdo::TIMEOUT_NS / 1_000_000) as u32 };
                    if let Some(mut transfer) = node.sdo.end(trouble) {
                        transfer.time_ns = transfer.time_ns.saturating_add(sdo::TIMEOUT_NS);
                        let sheet = Self::sheet(&self.sheets, number);
                        events.push(transfer_event(&nothing(channel), number, transfer, sheet));
                    }
                }
            }
        }
        events[from..].sort_by_key(|event| (event.time_ns, event.channel, event.from.node()));
    }
}

/// The number in at most four bytes, least significant first.
fn number_of(bytes: &[u8]) -> u32 {
    bytes.iter().take(4).rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
}

/// A record without a frame, for events that no frame causes.
const fn nothing(channel: u8) -> TraceRecord {
    TraceRecord { time_ns: 0, channel, event: cantap_trace::TraceEvent::GAP }
}

fn event(record: &TraceRecord, kind: &'static str, title: impl Into<Cow<'static, str>>) -> Event {
    Event::new(Protocol::CanOpen, record, kind, title)
}

/// An event for something that violates the protocol.
fn malformed(record: &TraceRecord, kind: &'static str, title: &'static str, fault: &'static str) -> Event {
    let mut event = event(record, kind, title);
    event.fields.push(Field::bytes("data", &event.data));
    event.trouble = Some(Trouble::Malformed(fault));
    event
}

fn register_text(register: u8) -> Option<String> {
    const BITS: [&str; 8] = [
        "generic",
        "current",
        "voltage",
        "temperature",
        "communication",
        "device profile",
        "reserved",
        "manufacturer",
    ];
    let set = BITS.iter().enumerate().filter(|(bit, _)| register >> bit & 1 == 1).map(|(_, name)| *name);
    Some(set.collect::<Vec<_>>().join(", ")).filter(|text| !text.is_empty())
}

fn sync(bus: &mut Bus, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>) {
    let counter = data.first().copied();
    let before = std::mem::replace(&mut bus.sync_counter, counter);
    if bus.sync_ns.replace(record.time_ns).is_none() {
        let mut event = event(record, "sync", "SYNC");
        event.fields.extend(counter.map(|counter| Field::number("counter", counter)));
        events.push(event);
    } else if let (Some(before), Some(counter)) = (before, counter)
        // After its highest value, which is configured in each node, it restarts at 1.
        && counter != 1
        && counter != before.wrapping_add(1)
    {
        let mut event = event(record, "sync", "SYNC");
        event.fields.push(Field::number("counter", counter));
        event.trouble = Some(Trouble::Sequence { expected: u32::from(before) + 1, got: counter.into() });
        events.push(event);
    }
}

fn guard(bus: &mut Bus, record: &TraceRecord, node: u8, events: &mut Vec<Event>) {
    let entry = bus.nodes.entry(node).or_default();
    entry.guarded_ns = Some(record.time_ns);
    if let Some(guard_ns) = entry.guard_ns.replace(record.time_ns) {
        let mut event = event(record, "guard_missing", "no answer to guarding");
        event.start_ns = guard_ns;
        event.from = Party::Node(node);
        event.trouble = Some(Trouble::Overlapped);
        events.push(event);
    }
}

/// A heartbeat, a boot-up message, or the answer to a guarding request.
fn heartbeat(bus: &mut Bus, record: &TraceRecord, node: u8, data: &[u8], events: &mut Vec<Event>) {
    let known = if let &[byte] = data { names::state(byte & 0x7F).map(|title| (byte, title)) } else { None };
    let Some((byte, title)) = known else {
        let fault = if data.len() == 1 { "an unknown state" } else { "a state has 1 byte" };
        let mut said = malformed(record, "state", "state", fault);
        said.from = Party::Node(node);
        events.push(said);
        return;
    };
    let (state, toggle) = (byte & 0x7F, byte & 0x80 != 0);
    let entry = bus.nodes.entry(node).or_default();
    let before = entry.state.replace(state);
    let mut said = event(record, "state", title);
    said.from = Party::Node(node);
    if let Some(guard_ns) = entry.guard_ns.take() {
        let due = entry.toggle.replace(toggle).map(|before| !before);
        if due.is_some_and(|due| due != toggle) {
            said.kind = "guard";
            said.trouble = Some(Trouble::Sequence { expected: (!toggle).into(), got: toggle.into() });
            events.push(said);
        } else if before != Some(state) {
            said.response_ns = Some(record.time_ns.saturating_sub(guard_ns));
            events.push(said);
        }
        return;
    }
    if state == 0 {
        // A node that has just started: its heartbeat and its toggle bit start over.
        (entry.beat_ns, entry.toggle, entry.is_missing) = (None, None, false);
        if !entry.is_period_set {
            entry.period_ns = None;
        }
        said.kind = "boot_up";
        events.push(said);
        return;
    }
    let was_missing = std::mem::take(&mut entry.is_missing);
    if let Some(beat_ns) = entry.beat_ns.replace(record.time_ns)
        && !entry.is_period_set
        && !was_missing
    {
        let period_ns = record.time_ns.saturating_sub(beat_ns);
        // The longest one seen: with a shorter one, jitter would be reported as missing.
        entry.period_ns = Some(entry.period_ns.map_or(period_ns, |known| known.max(period_ns)));
    }
    if was_missing {
        said.kind = "heartbeat_back";
        said.title = format!("heartbeat is back: {title}").into();
        events.push(said);
    } else if before != Some(state) {
        if let Some(before) = before.and_then(names::state) {
            said.fields.push(Field::text("before", before));
        }
        events.push(said);
    }
}

fn transfer_event(record: &TraceRecord, node: u8, transfer: SdoTransfer, sheet: Option<&Eds>) -> Event {
    let (verb, kind) = if transfer.is_write { ("write", "sdo_write") } else { ("read", "sdo_read") };
    let mut event = event(record, kind, format!("SDO {verb} {:04X}:{:02X}", transfer.index, transfer.sub));
    (event.time_ns, event.start_ns) = (transfer.time_ns, transfer.start_ns);
    event.to = Party::Node(node);
    event.frames = transfer.frames;
    event.response_ns = transfer.response_ns;
    event.trouble = transfer.trouble;
    event.frames_lost = transfer.frames_lost;
    let entry = sheet.and_then(|eds| eds.entry_of(transfer.index, transfer.sub));
    let object = sheet.and_then(|eds| eds.objects.get(&transfer.index));
    let name: Option<Cow<'static, str>> = match (object, entry) {
        (Some(object), Some(entry)) if object.entries.len() > 1 && !object.name.is_empty() => {
            Some(format!("{}: {}", object.name, entry.name).into())
        }
        (_, Some(entry)) => Some(entry.name.clone().into()),
        (Some(object), None) => Some(object.name.clone().into()),
        _ => names::object(transfer.index).map(Cow::Borrowed),
    };
    event.fields.push(Field::hex("index", transfer.index, 4).meaning(name));
    event.fields.push(Field::hex("sub", transfer.sub, 2));
    if let Some(code) = transfer.abort {
        event.fields.push(Field::hex("abort", code, 8).meaning(Some(names::abort(code))));
    } else {
        event.fields.push(Field::text("transport", transfer.mode.name()));
        if !transfer.data.is_empty() || transfer.trouble.is_none() {
            let known = entry
                .and_then(|entry| entry.data_type)
                .or_else(|| types::known(transfer.index, transfer.sub));
            let mut field = Field::bytes("value", &[]);
            field.value = types::value(known, &transfer.data);
            event.fields.push(field);
        }
    }
    event.data = transfer.data;
    event
}

impl Assembler for CanOpen {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        if record.time_ns >= self.sweep_ns {
            self.sweep(record.time_ns, events);
        }
        let Some(frame) = record.frame() else {
            if is_gap(&record.event)
                && let Some(bus) = self.buses.get_mut(&record.channel)
            {
                bus.lss.interrupt();
                bus.sync_counter = None;
                for node in bus.nodes.values_mut() {
                    node.frames_lost = true;
                    node.toggle = None;
                    // The lost frames may have included heartbeats.
                    node.beat_ns = None;
                    if let Some(open) = &mut node.sdo.open {
                        open.frames_lost = true;
                    }
                }
            }
            return;
        };
        if !frame.id().is_extended() {
            self.frame(record, frame.id().raw() as u16, frame.is_remote(), frame.data(), events);
        }
    }

    fn finish(&mut self, events: &mut Vec<Event>) {
        let from = events.len();
        for (&channel, bus) in &mut self.buses {
            for (&number, node) in &mut bus.nodes {
                if let Some(transfer) = node.sdo.end(Trouble::Unfinished) {
                    events.push(transfer_event(
                        &nothing(channel),
                        number,
                        transfer,
                        Self::sheet(&self.sheets, number),
                    ));
                }
            }
        }
        events[from..].sort_by_key(|event| (event.time_ns, event.channel, event.to.node()));
    }

    fn under_way(&self, out: &mut Vec<UnderWay>) {
        for (&channel, bus) in &self.buses {
            let open = bus.nodes.iter().filter_map(|(node, entry)| Some((*node, entry.sdo.open.as_ref()?)));
            out.extend(open.map(|(node, transfer)| {
                let (server, client) = (Party::Node(node), Party::Unknown);
                let (from, to) = if transfer.is_write { (client, server) } else { (server, client) };
                UnderWay {
                    channel,
                    protocol: Protocol::CanOpen,
                    from,
                    to,
                    start_ns: transfer.start_ns,
                    received: transfer.data.len() as u32,
                    length: transfer.size,
                }
            }));
        }
    }
}
