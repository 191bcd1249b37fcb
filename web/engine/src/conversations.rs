//! What frames say together: requests and answers, messages of several frames, announcements.

use std::collections::BTreeMap;
use std::convert::Infallible;

use cantap_protocols::{Event, EventKind, Options, Overview, Party, ReadItem, Reader};
use serde::Serialize;

use crate::interval::{self, IntervalAnswer};
use crate::trace::Content;

/// The records by which a channel's protocols are found: those of so many nanoseconds from the beginning.
const SURVEY_NS: i64 = 3_000_000_000;
/// No more than so many.
const MOST_SURVEYED: usize = 200_000;
/// What began so long before the window is known in it, in nanoseconds.
const LEAD_NS: i64 = 10_000_000_000;
/// The longest text of an event, in characters.
const TEXT: usize = 400;

/// `ProtocolEvent` in `api.ts`.
#[derive(Serialize)]
pub struct ProtocolEvent {
    time: f64,
    end: f64,
    took: IntervalAnswer,
    channel: u8,
    protocol: &'static str,
    kind: &'static str,
    from: String,
    to: String,
    text: String,
    failed: bool,
}

/// `ProtocolNode` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct ProtocolNode {
    channel: u8,
    protocol: &'static str,
    node: String,
    state: Option<String>,
    state_since: Option<f64>,
    drive: Option<&'static str>,
    drive_since: Option<f64>,
    events: u64,
    faults: u64,
    missed: u64,
    identity: Option<String>,
    codes: BTreeMap<String, String>,
    last: f64,
}

/// The answer to `conversations` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct Found {
    events: Vec<ProtocolEvent>,
    total: usize,
    nodes: Vec<ProtocolNode>,
    /// Events of nodes, services and objects beyond the limits.
    not_counted: u64,
}

/// Reads the records by their protocols, and passes on each event, those of `from_ns` and later for certain.
pub fn read(content: &Content, options: Options, from_ns: i64, to_ns: i64, mut each: impl FnMut(&Event)) {
    let store = &content.store;
    let mut reader = Reader::new(options);
    let surveyed = store.row_at(content.begin_kept_ns().saturating_add(SURVEY_NS)).min(MOST_SURVEYED);
    let begin = store.row_at(from_ns.saturating_sub(LEAD_NS)).max(surveyed);
    let end = store.row_at(to_ns.saturating_add(1));
    let mut batch = Vec::with_capacity(1024);
    let mut take = |records: &[_], more| {
        let result: Result<(), Infallible> = reader.take(records, more, |item| {
            if let ReadItem::Event(event) = item {
                each(&event);
            }
            Ok(())
        });
        let Ok(()) = result;
    };
    for row in (0..surveyed.min(end)).chain(begin..end) {
        batch.extend(store.record(row));
        if batch.len() == batch.capacity() {
            take(&batch, true);
            batch.clear();
        }
    }
    take(&batch, false);
}

/// The first events that ended in a stretch of time, how many there are, and the nodes as they are at its end.
pub fn found(content: &Content, options: Options, from_ns: i64, to_ns: i64, limit: usize) -> Found {
    let mut found = Found { events: Vec::new(), total: 0, nodes: Vec::new(), not_counted: 0 };
    let mut overview = Overview::default();
    read(content, options, from_ns, to_ns, |event| {
        if event.time_ns <= to_ns {
            overview.take(event);
        }
        if event.time_ns < from_ns || event.start_ns > to_ns {
            return;
        }
        found.total += 1;
        if found.events.len() < limit {
            found.events.push(ProtocolEvent {
                time: content.seconds(event.start_ns),
                end: content.seconds(event.time_ns),
                took: interval::between(event.start_ns, event.time_ns, &content.store).into(),
                channel: event.channel,
                protocol: event.protocol.name(),
                kind: event.kind.name(),
                from: party(event.from),
                to: party(event.to),
                text: text(event),
                failed: is_failed(event),
            });
        }
    });
    let time = |time_ns: i64| content.seconds(time_ns);
    let nodes = overview.nodes().map(|((channel, protocol, node), known)| ProtocolNode {
        channel,
        protocol: protocol.name(),
        node,
        state: known.state.as_deref().map(|state| cantap_trace::clean::line(state).into_owned()),
        state_since: known.state_ns.map(time),
        drive: known.drive,
        drive_since: known.drive_ns.map(time),
        events: known.events,
        faults: known.faults,
        missed: known.missed,
        identity: known.identity.as_deref().map(|identity| cantap_trace::clean::line(identity).into_owned()),
        codes: known.codes.clone(),
        last: time(known.last_ns),
    });
    found.nodes = nodes.collect();
    found.not_counted = overview.left_out();
    found
}

/// Whether something went wrong.
fn is_failed(event: &Event) -> bool {
    event.trouble.is_some()
        || matches!(
            event.kind,
            EventKind::Refusal
                | EventKind::NoResponse
                | EventKind::Broken
                | EventKind::HeartbeatMissing
                | EventKind::GuardMissing
                | EventKind::Emergency
        )
}

fn party(party: Party) -> String {
    let mut text = String::new();
    if party != Party::Unknown {
        party.push_to(&mut text);
    }
    text
}

/// The event as a sentence, without protocol and parties, which have fields of their own.
pub fn text(event: &Event) -> String {
    let mut whole = String::new();
    event.push_to(&mut whole);
    let title = whole.find(&*event.title).map_or(0, |at| at.min(whole.len()));
    let text = if event.title.is_empty() { &whole[..] } else { &whole[title..] };
    let text = cantap_trace::clean::line(text);
    match text.char_indices().nth(TEXT) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.into_owned(),
    }
}
