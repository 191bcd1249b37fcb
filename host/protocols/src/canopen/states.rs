//! SYNC, guarding, heartbeats: what comes again and again, and is said when it changes.

use cantap_trace::TraceRecord;

use super::events::{event, malformed};
use super::names;
use super::node::Bus;
use crate::{Event, EventKind, Field, Party, Trouble};

pub fn sync(bus: &mut Bus, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>) {
    let counter = data.first().copied();
    let before = std::mem::replace(&mut bus.sync_counter, counter);
    if bus.sync_ns.replace(record.time_ns).is_none() {
        let mut event = event(record, EventKind::Sync, "SYNC");
        event.fields.extend(counter.map(|counter| Field::number("counter", counter)));
        events.push(event);
    } else if let (Some(before), Some(counter)) = (before, counter)
        // After its highest value, which is configured in each node, it restarts at 1.
        && counter != 1
        && counter != before.wrapping_add(1)
    {
        let mut event = event(record, EventKind::Sync, "SYNC");
        event.fields.push(Field::number("counter", counter));
        event.trouble = Some(Trouble::Sequence { expected: u32::from(before) + 1, got: counter.into() });
        events.push(event);
    }
}

pub fn guard(bus: &mut Bus, record: &TraceRecord, node: u8, events: &mut Vec<Event>) {
    let entry = bus.nodes.entry(node).or_default();
    entry.guarded_ns = Some(record.time_ns);
    if let Some(guard_ns) = entry.guard_ns.replace(record.time_ns) {
        let mut event = event(record, EventKind::GuardMissing, "no answer to guarding");
        event.start_ns = guard_ns;
        event.from = Party::Node(node);
        event.trouble = Some(Trouble::Overlapped);
        events.push(event);
    }
}

/// A heartbeat, a boot-up message, or the answer to a guarding request.
pub fn heartbeat(bus: &mut Bus, record: &TraceRecord, node: u8, data: &[u8], events: &mut Vec<Event>) {
    let known = if let &[byte] = data { names::state(byte & 0x7F).map(|title| (byte, title)) } else { None };
    let Some((byte, title)) = known else {
        let fault = if data.len() == 1 { "an unknown state" } else { "a state has 1 byte" };
        let mut said = malformed(record, EventKind::State, "state", fault);
        said.from = Party::Node(node);
        events.push(said);
        return;
    };
    let (state, toggle) = (byte & 0x7F, byte & 0x80 != 0);
    let entry = bus.nodes.entry(node).or_default();
    let before = entry.state.replace(state);
    let mut said = event(record, EventKind::State, title);
    said.from = Party::Node(node);
    if let Some(guard_ns) = entry.guard_ns.take() {
        let due = entry.toggle.replace(toggle).map(|before| !before);
        if due.is_some_and(|due| due != toggle) {
            said.kind = EventKind::Guard;
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
        said.kind = EventKind::BootUp;
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
        said.kind = EventKind::HeartbeatBack;
        said.title = format!("heartbeat is back: {title}").into();
        events.push(said);
    } else if before != Some(state) {
        if let Some(before) = before.and_then(names::state) {
            said.fields.push(Field::text("before", before));
        }
        events.push(said);
    }
}
