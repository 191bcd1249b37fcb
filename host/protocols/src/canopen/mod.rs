//! CANopen (CiA 301): network management, boot-up, heartbeat and guarding, SYNC, TIME, EMCY, SDO, PDO, LSS (CiA 305), SRDO and
//! GFC (EN 50325-5).
//!
//! Whatever repeats is reported only when it changes: a node's state, a heartbeat that stops or resumes, the first SYNC, a counter
//! that jumps. PDOs have names and values if an EDS or observed SDO transfers define their content.
//!
//! Memory: for each node of each channel one SDO transfer of at most 64 KiB for each of its SDO servers, and the mappings of 512 PDOs.

pub mod codec;
pub mod drive;
pub mod eds;
mod encode;
mod events;
mod lss;
mod names;
mod node;
mod pdo;
mod safety;
mod sdo;
mod sdo_channels;
mod signs;
mod states;
#[cfg(test)]
mod tests;
mod transfers;
mod types;
mod xdd;

pub use encode::{BadValue, encode, type_named};
pub use names::{abort as abort_text, state as state_name};
pub use types::known as known_type;

use std::sync::Arc;

use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;

use self::eds::Eds;
use self::events::{event, malformed, nothing};
use self::node::Bus;
use self::safety::{KnownSheets, SafetySheets};
use self::sdo_channels::{SdoChannel, SdoChannels};
pub(crate) use self::signs::CanOpenSigns;
use self::states::{guard, heartbeat, sync};
use self::transfers::{SdoFrame, transfer_event};
use crate::{Assembler, Event, EventKind, Field, Party, Protocol, Trouble, UnderWay, is_gap};

const LSS_MASTER: u16 = codec::lss::REQUEST.raw() as u16;
const LSS_SLAVE: u16 = codec::lss::RESPONSE.raw() as u16;
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

/// Decodes a CANopen bus.
#[derive(Default)]
pub struct CanOpen {
    buses: FxHashMap<u8, Bus>,
    sheets: Vec<Sheet>,
    /// Identifiers of PDOs according to the sheets, if they are not the predefined ones.
    sheet_ids: FxHashMap<u16, (u8, u16)>,
    /// And SDO channels beyond the first.
    sheet_channels: SdoChannels,
    sheet_safety: SafetySheets,
    sweep_ns: i64,
}

impl CanOpen {
    /// With the nodes' sheets, if any.
    pub fn new(sheets: Vec<Sheet>) -> Self {
        let (mut sheet_ids, mut sheet_channels) = (FxHashMap::default(), SdoChannels::default());
        let mut sheet_safety = SafetySheets::default();
        for sheet in &sheets {
            let nodes = sheet.node.map_or(1..=127, |node| node..=node);
            for node in nodes {
                let own = sheets.iter().any(|other| other.node == Some(node));
                if sheet.node.is_some() || !own {
                    let ids = pdo::sheet_ids(&sheet.eds, node, sheet.node.is_some());
                    sheet_ids.extend(ids.map(|(id, parameter)| (id, (node, parameter))));
                    sheet_channels.add_sheet(&sheet.eds, node, sheet.node.is_some());
                    sheet_safety.add_sheet(&sheet.eds, node, sheet.node.is_some());
                }
            }
        }
        Self { sheets, sheet_ids, sheet_channels, sheet_safety, ..Self::default() }
    }

    fn sheet(sheets: &[Sheet], node: u8) -> Option<&Eds> {
        let own = sheets.iter().find(|sheet| sheet.node == Some(node));
        own.or_else(|| sheets.iter().find(|sheet| sheet.node.is_none())).map(|sheet| &*sheet.eds)
    }

    fn frame(&mut self, record: &TraceRecord, id: u16, remote: bool, data: &[u8], events: &mut Vec<Event>) {
        let sheets = &self.sheets;
        let sheet_ids = &self.sheet_ids;
        let channels = &self.sheet_channels;
        let fresh = || Bus { pdo_ids: sheet_ids.clone(), channels: channels.clone(), ..Bus::default() };
        let bus = self.buses.entry(record.channel).or_insert_with(fresh);
        let node = (id & 0x7F) as u8;
        if !remote && let Some(SdoChannel { node, request, from_client }) = bus.channels.find(id) {
            let frame = SdoFrame { node, request: Some(request), from_client, data };
            transfers::frame(bus, record, &frame, Self::sheet(sheets, node), events);
            return;
        }
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
                    let mut event = event(record, EventKind::Nmt, title);
                    event.to = if node == 0 { Party::Everyone } else { Party::Node(node) };
                    event.fields.push(Field::number("command", command));
                    events.push(event);
                } else {
                    let fault = if data.len() == 2 { "an unknown command" } else { "a command has 2 bytes" };
                    events.push(malformed(record, EventKind::Nmt, "network management", fault));
                }
            }
            safety::GFC => events.push(safety::global_failsafe(record, data)),
            0x80 => sync(bus, record, data, events),
            0x81..=0xFF => {
                if let &[low, high, register, ref rest @ ..] = data {
                    let code = u16::from_le_bytes([low, high]);
                    let mut event = event(record, EventKind::Emergency, "emergency");
                    event.from = Party::Node(node);
                    let known = bus.nodes.get(&node).map(|node| node.drive).unwrap_or_default();
                    let is_drive = known.or_sheet(Self::sheet(sheets, node), node).is_drive();
                    let meaning = if is_drive { drive::error(code) } else { names::emergency(code) };
                    event.fields.push(Field::hex("code", code, 4).meaning(Some(meaning)));
                    event
                        .fields
                        .push(Field::hex("register", register, 2).meaning(names::error_register(register)));
                    event.fields.push(Field::bytes("manufacturer", rest));
                    // Of the required length, or else what is there.
                    event.trouble =
                        (rest.len() != 5).then_some(Trouble::Malformed("an emergency has 8 bytes"));
                    events.push(event);
                } else {
                    let mut event =
                        malformed(record, EventKind::Emergency, "emergency", "an emergency has 8 bytes");
                    event.from = Party::Node(node);
                    events.push(event);
                }
            }
            0x100 => {
                if let &[a, b, c, d, low, high] = data {
                    let ms = u32::from_le_bytes([a, b, c, d]) & 0x0FFF_FFFF;
                    let days = u16::from_le_bytes([low, high]);
                    let mut event = event(record, EventKind::Time, "time");
                    event.fields.push(Field::number("days_since_1984", days));
                    event.fields.push(Field::real("time_of_day_s", f64::from(ms) / 1000.0, "s"));
                    events.push(event);
                } else {
                    events.push(malformed(record, EventKind::Time, "time", "a time has 6 bytes"));
                }
            }
            LSS_SLAVE => events.extend(bus.lss.response(record, data)),
            LSS_MASTER => events.extend(bus.lss.request(record, data)),
            0x101..=0x180 if !bus.pdo_ids.contains_key(&id) => {
                let sheet_of = |node| Self::sheet(sheets, node);
                let known = KnownSheets { sheets: &self.sheet_safety, sheet_of: &sheet_of };
                bus.safety.take(record, id, data, &known, events);
            }
            _ if node == 0 => {}
            0x581..=0x5FF | 0x601..=0x67F => {
                let channel = SdoFrame { node, request: None, from_client: id > 0x600, data };
                transfers::frame(bus, record, &channel, Self::sheet(sheets, node), events);
            }
            0x701..=0x77F => heartbeat(bus, record, node, data, events),
            0x181..=0x57F => {
                // Four PDOs in each direction have their own identifiers.
                let (node, number) = bus.pdo_ids.get(&id).copied().unwrap_or((node, id & 0x780));
                let entry = bus.nodes.entry(node).or_default();
                let sheet = Self::sheet(sheets, node);
                events.push(entry.pdos.event(record, (node, number), data, sheet, &mut entry.drive));
            }
            _ => {
                if let Some(&(node, number)) = bus.pdo_ids.get(&id) {
                    let entry = bus.nodes.entry(node).or_default();
                    let sheet = Self::sheet(sheets, node);
                    events.push(entry.pdos.event(record, (node, number), data, sheet, &mut entry.drive));
                }
            }
        }
    }

    /// Reports what has not come.
    fn sweep(&mut self, now_ns: i64, events: &mut Vec<Event>) {
        self.sweep_ns = now_ns.saturating_add(SWEEP_NS);
        let from = events.len();
        let sheet_of = |node| Self::sheet(&self.sheets, node);
        let known = KnownSheets { sheets: &self.sheet_safety, sheet_of: &sheet_of };
        for (&channel, bus) in &mut self.buses {
            bus.safety.sweep(channel, now_ns, &known, events);
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
                            EventKind::HeartbeatMissing,
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
                        EventKind::GuardMissing,
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
                        event(guarded_ns + life_ns, guarded_ns, number, EventKind::GuardingStopped, title);
                    event.trouble = Some(Trouble::Timeout { after_ms: (life_ns / 1_000_000) as u32 });
                    event.frames = 0;
                    events.push(event);
                }
                let drive = node.drive;
                for (request, sdo) in node.sdos() {
                    let since = sdo.open.as_ref().map(|open| open.time_ns);
                    if since.is_none_or(|since| now_ns.saturating_sub(since) <= sdo::TIMEOUT_NS) {
                        continue;
                    }
                    let trouble = Trouble::Timeout { after_ms: (sdo::TIMEOUT_NS / 1_000_000) as u32 };
                    if let Some(mut transfer) = sdo.end(trouble) {
                        transfer.time_ns = transfer.time_ns.saturating_add(sdo::TIMEOUT_NS);
                        let sheet = Self::sheet(&self.sheets, number);
                        let drive = drive.or_sheet(sheet, number);
                        events.push(transfer_event(
                            &nothing(channel),
                            number,
                            request,
                            transfer,
                            sheet,
                            drive,
                        ));
                    }
                }
            }
        }
        events[from..].sort_by_key(|event| (event.time_ns, event.channel, event.from.node()));
    }
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
                bus.safety.interrupt();
                bus.sync_counter = None;
                for node in bus.nodes.values_mut() {
                    node.frames_lost = true;
                    node.toggle = None;
                    // The lost frames may have included heartbeats.
                    node.beat_ns = None;
                    for (_, sdo) in node.sdos() {
                        if let Some(open) = &mut sdo.open {
                            open.frames_lost = true;
                        }
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
                let sheet = Self::sheet(&self.sheets, number);
                let drive = node.drive.or_sheet(sheet, number);
                for (request, sdo) in node.sdos() {
                    if let Some(transfer) = sdo.end(Trouble::Unfinished) {
                        events.push(transfer_event(
                            &nothing(channel),
                            number,
                            request,
                            transfer,
                            sheet,
                            drive,
                        ));
                    }
                }
            }
        }
        events[from..].sort_by_key(|event| (event.time_ns, event.channel, event.to.node()));
    }

    fn under_way(&self, out: &mut Vec<UnderWay>) {
        for (&channel, bus) in &self.buses {
            let open = bus
                .nodes
                .iter()
                .flat_map(|(node, entry)| entry.open_transfers().map(|transfer| (*node, transfer)));
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
