//! SDO transfers as events, and what they teach.

use std::borrow::Cow;

use cantap_trace::TraceRecord;

use super::drive::DriveView;
use super::eds::Eds;
use super::events::event;
use super::node::Bus;
use super::sdo::SdoTransfer;
use super::types::number_of;
use super::{drive, names, types};
use crate::{Event, EventKind, Field, Party};

/// A frame of an SDO channel.
pub struct SdoFrame<'a> {
    /// The node that serves.
    pub node: u8,
    /// The identifier of requests, where it is not the node's first channel.
    pub request: Option<u16>,
    pub from_client: bool,
    pub data: &'a [u8],
}

/// Takes a frame, and says what it ends.
pub fn frame(
    bus: &mut Bus,
    record: &TraceRecord,
    frame: &SdoFrame<'_>,
    sheet: Option<&Eds>,
    events: &mut Vec<Event>,
) {
    let &SdoFrame { node, request, from_client, data } = frame;
    let server = bus.nodes.entry(node).or_default().sdo_of(request);
    let ended = server.take(record.time_ns, from_client, data);
    for transfer in ended.into_iter().flatten() {
        let entry = bus.nodes.entry(node).or_default();
        let is_whole = transfer.trouble.is_none();
        let changed = is_whole && entry.pdos.learn(node, &transfer);
        if is_whole {
            bus.channels.learn(node, transfer.index, transfer.sub, &transfer.data);
        }
        if is_whole && transfer.is_write && (transfer.index, transfer.sub) == (0x1017, 0) {
            let ms = i64::from(number_of(&transfer.data) & 0xFFFF);
            entry.period_ns = Some(ms * 1_000_000).filter(|ns| *ns > 0);
            entry.is_period_set = true;
            entry.beat_ns = None;
        }
        if is_whole {
            let bits = 8 * transfer.data.len();
            entry.drive.learn(transfer.index, transfer.sub, bits, &transfer.data);
        }
        let watched = entry.learn_timeouts(&transfer);
        let lost = !is_whole && std::mem::take(&mut entry.frames_lost);
        let drive = entry.drive.or_sheet(sheet, node);
        let mut event = transfer_event(record, node, request, transfer, sheet, drive);
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

/// What was read or written, as far as it came.
pub fn transfer_event(
    record: &TraceRecord,
    node: u8,
    request: Option<u16>,
    transfer: SdoTransfer,
    sheet: Option<&Eds>,
    drive: DriveView,
) -> Event {
    let (verb, kind) =
        if transfer.is_write { ("write", EventKind::SdoWrite) } else { ("read", EventKind::SdoRead) };
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
        _ => names::object(transfer.index)
            .or_else(|| drive.is_drive().then(|| names::drive_object(transfer.index))?)
            .map(Cow::Borrowed),
    };
    event.fields.push(Field::hex("index", transfer.index, 4).meaning(name));
    event.fields.push(Field::hex("sub", transfer.sub, 2));
    // Which of the node's servers, where it is not the first.
    event.fields.extend(request.map(|request| Field::hex("cob_id", request, 3)));
    if let Some(code) = transfer.abort {
        event.fields.push(Field::hex("abort", code, 8).meaning(Some(names::abort(code))));
    } else {
        event.fields.push(Field::text("transport", transfer.mode.name()));
        if !transfer.data.is_empty() || transfer.trouble.is_none() {
            let known = entry
                .and_then(|entry| entry.data_type)
                .or_else(|| types::known(transfer.index, transfer.sub))
                .or_else(|| drive.is_drive().then(|| drive::data_type(transfer.index))?);
            let mut field = Field::bytes("value", &[]);
            field.value = types::value(known, &transfer.data);
            drive.explain(transfer.index, transfer.sub, &transfer.data, field, &mut event.fields);
        }
    }
    event.data = transfer.data;
    event
}
