//! Whether nodes are there: each reports its state once a second.

use rustc_hash::FxHashMap;

use super::transfers::Transfer;
use crate::dsdl::Generation;
use crate::{Bytes, Event, EventKind, Field, Party, Protocol, Trouble, Value};

/// After so long without a report, a node is gone: `OFFLINE_TIMEOUT` of both reports.
const OFFLINE_NS: i64 = 3_000_000_000;

/// The nodes of all channels.
#[derive(Debug)]
pub struct Nodes {
    generation: Generation,
    last: FxHashMap<(u8, u8), Seen>,
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    time_ns: i64,
    uptime_s: i64,
    is_missing: bool,
}

/// The number of the message in which nodes report their state.
pub const fn status_port(generation: Generation) -> u16 {
    match generation {
        Generation::DroneCan => 341,
        Generation::Cyphal => 7509,
    }
}

/// The state of a node in words, by the report of either language.
pub(crate) fn state(event: &Event) -> Option<String> {
    let is_report = matches!(&*event.title, "uavcan.protocol.NodeStatus" | "uavcan.node.Heartbeat.1.0");
    if !is_report || event.trouble.is_some() {
        return None;
    }
    state_in(event)
}

/// The name that a node gives itself when it is asked for its identity.
pub(crate) fn node_name(event: &Event) -> Option<String> {
    let is_info = matches!(&*event.title, "uavcan.protocol.GetNodeInfo" | "uavcan.node.GetInfo.1.0");
    let is_answer = matches!(event.kind, EventKind::Exchange | EventKind::Response);
    text(event.field("name").filter(|_| is_info && is_answer)?)
}

/// A parameter or register of a server, with its value, if that is what the exchange is about.
pub(crate) fn parameter(event: &Event) -> Option<(String, String)> {
    if event.kind != EventKind::Exchange || event.trouble.is_some() {
        return None;
    }
    let name = match (event.protocol, &*event.title) {
        (Protocol::DroneCan, "uavcan.protocol.param.GetSet") => text(event.field("name")?)?,
        (Protocol::Cyphal, "uavcan.register.Access.1.0") => text(event.field("request.name.name")?)?,
        _ => return None,
    };
    let values = event.fields.iter().filter(|field| field.name.starts_with("value."));
    let values: Vec<_> = values.map(|field| field.value.to_string()).collect();
    (!name.is_empty()).then(|| (name, values.join(", ")))
}

fn text(field: &Field) -> Option<String> {
    match &field.value {
        Value::Text(text) => Some(text.to_string()),
        _ => None,
    }
}

fn state_in(event: &Event) -> Option<String> {
    let text = |names: [&str; 2]| {
        let field = names.into_iter().find_map(|name| event.field(name))?;
        Some(field.text.as_ref().map_or_else(|| field.value.to_string(), ToString::to_string))
    };
    let (mode, health) = (text(["mode", "mode.value"])?, text(["health", "health.value"])?);
    Some(format!("{mode}, health {health}"))
}

impl Nodes {
    pub fn new(generation: Generation) -> Self {
        Self { generation, last: FxHashMap::default() }
    }

    /// Takes a message, to which it adds that the node has started anew. Returns that it is back.
    pub fn take(&mut self, transfer: &Transfer, event: &mut Event) -> Option<Event> {
        let node = transfer.header.source?;
        if transfer.header.port != status_port(self.generation) {
            return None;
        }
        let uptime = event.field("uptime_sec").or_else(|| event.field("uptime"))?;
        let uptime_s = uptime.value.as_number()? as i64;
        let seen = Seen { time_ns: transfer.time_ns, uptime_s, is_missing: false };
        let before = self.last.insert((transfer.channel, node), seen)?;
        if uptime_s < before.uptime_s {
            event.fields.push(Field::text("restarted", "its time since start went back"));
        }
        if !before.is_missing {
            return None;
        }
        let state = state_in(event).unwrap_or_default();
        let mut back =
            about(event.protocol, transfer.channel, node, transfer.time_ns, EventKind::HeartbeatBack);
        back.title = format!("node status is back: {state}").into();
        Some(back)
    }

    /// Reports what has not come.
    pub fn sweep(&mut self, now_ns: i64, protocol: Protocol, events: &mut Vec<Event>) {
        for ((channel, node), seen) in &mut self.last {
            if seen.is_missing || now_ns.saturating_sub(seen.time_ns) <= OFFLINE_NS {
                continue;
            }
            seen.is_missing = true;
            let since_ns = seen.time_ns.saturating_add(OFFLINE_NS);
            let mut missing = about(protocol, *channel, *node, since_ns, EventKind::HeartbeatMissing);
            missing.start_ns = seen.time_ns;
            missing.title = "node status missing".into();
            missing.trouble = Some(Trouble::Timeout { after_ms: (OFFLINE_NS / 1_000_000) as u32 });
            events.push(missing);
        }
    }

    /// Frames of the channel may be missing: the wait begins again.
    pub fn gap(&mut self, channel: u8, now_ns: i64) {
        for ((of, _), seen) in &mut self.last {
            if *of == channel && !seen.is_missing {
                seen.time_ns = seen.time_ns.max(now_ns);
            }
        }
    }
}

fn about(protocol: Protocol, channel: u8, node: u8, time_ns: i64, kind: EventKind) -> Event {
    Event {
        time_ns,
        start_ns: time_ns,
        channel,
        protocol,
        from: Party::Node(node),
        to: Party::Unknown,
        kind,
        title: "".into(),
        fields: Vec::new(),
        data: Bytes::new(),
        response_ns: None,
        frames: 0,
        trouble: None,
        frames_lost: false,
    }
}
