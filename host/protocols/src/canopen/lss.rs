//! Layer setting services (CiA 305): node numbers and bit rates of nodes that have none yet.

use std::borrow::Cow;

use cantap_trace::TraceRecord;

use super::codec::lss::{Bound, LssRequest, LssResponse, Part, Service};
use super::names;
use crate::{Event, EventKind, Field, Protocol};

/// A service of the master that a slave may answer.
#[derive(Default)]
pub struct Lss {
    asked: Option<(i64, LssRequest)>,
    frames_lost: bool,
}

impl Lss {
    /// Frames on the channel are missing.
    pub const fn interrupt(&mut self) {
        self.frames_lost = true;
    }

    /// Takes a frame from the master.
    pub fn request(&mut self, record: &TraceRecord, data: &[u8]) -> Option<Event> {
        let request = LssRequest::decode(data);
        self.asked = request.map(|request| (record.time_ns, request));
        self.frames_lost = false;
        let Some(request) = request else { return unknown(record, EventKind::Lss, data) };
        let mut event = Event::new(Protocol::CanOpen, record, EventKind::Lss, request_title(request));
        let fields = &mut event.fields;
        match request {
            LssRequest::SwitchGlobal(mode) => {
                let text = ["waiting", "configuration"].get(usize::from(mode)).copied();
                fields.push(Field::number("mode", mode).meaning(text));
            }
            LssRequest::ConfigureNode(node) => fields.push(Field::number("node", node)),
            LssRequest::ConfigureBitTiming { table, index } => {
                let text = names::bit_rate(index).filter(|_| table == 0);
                fields.push(Field::number("table", table));
                fields.push(Field::number("index", index).meaning(text));
            }
            LssRequest::ActivateBitTiming(delay_ms) => {
                fields.push(Field::number("switch_delay_ms", delay_ms));
            }
            LssRequest::SwitchSelective(_, value) | LssRequest::Identify(_, value) => {
                fields.push(Field::hex("value", value, 8));
            }
            LssRequest::FastScan { value, unchecked, part, next } => {
                fields.push(Field::hex("value", value, 8));
                fields.push(Field::number("bits_not_checked", unchecked));
                fields.push(Field::number("part", part));
                fields.push(Field::number("next_part", next));
            }
            LssRequest::Store
            | LssRequest::IdentifyWithoutNumber
            | LssRequest::Inquire(_)
            | LssRequest::InquireNode => {}
        }
        Some(event)
    }

    /// Takes a frame from a slave.
    pub fn response(&mut self, record: &TraceRecord, data: &[u8]) -> Option<Event> {
        let Some(response) = LssResponse::decode(data) else {
            return unknown(record, EventKind::LssAnswer, data);
        };
        let mut event = Event::new(Protocol::CanOpen, record, EventKind::LssAnswer, response_title(response));
        let fields = &mut event.fields;
        match response {
            LssResponse::Outcome { error, device_error, .. } => {
                let text = match error {
                    0 => "success",
                    1 => "out of range, or not supported",
                    2 => "no access to the storage",
                    0xFF => "a reason of the device",
                    _ => "reserved",
                };
                fields.push(Field::number("error", error).meaning(Some(text)));
                fields.push(Field::number("device_error", device_error));
            }
            LssResponse::Address(_, value) => fields.push(Field::hex("value", value, 8)),
            LssResponse::Node(node) => fields.push(Field::number("node", node)),
            LssResponse::Selected | LssResponse::Identified | LssResponse::WithoutNumber => {}
        }
        if let Some((asked_ns, request)) = &self.asked
            && response.answers(request)
        {
            event.response_ns = Some(record.time_ns.saturating_sub(*asked_ns));
            event.frames_lost = self.frames_lost;
        }
        Some(event)
    }
}

/// A frame that is none of this side's services, or lacks bytes.
fn unknown(record: &TraceRecord, kind: EventKind, data: &[u8]) -> Option<Event> {
    let (&service, rest) = data.split_first()?;
    let mut event = Event::new(Protocol::CanOpen, record, kind, Cow::Borrowed("LSS, unknown service"));
    event.fields.push(Field::hex("service", service, 2));
    event.fields.push(Field::bytes("data", rest));
    Some(event)
}

const fn request_title(request: LssRequest) -> &'static str {
    match request {
        LssRequest::SwitchGlobal(_) => "LSS switch state global",
        LssRequest::ConfigureNode(_) => "LSS configure node number",
        LssRequest::ConfigureBitTiming { .. } => "LSS configure bit timing",
        LssRequest::ActivateBitTiming(_) => "LSS activate bit timing",
        LssRequest::Store => "LSS store configuration",
        LssRequest::SwitchSelective(Part::Vendor, _) => "LSS switch state selective: vendor",
        LssRequest::SwitchSelective(Part::Product, _) => "LSS switch state selective: product",
        LssRequest::SwitchSelective(Part::Revision, _) => "LSS switch state selective: revision",
        LssRequest::SwitchSelective(Part::Serial, _) => "LSS switch state selective: serial number",
        LssRequest::Identify(Bound::Vendor, _) => "LSS identify: vendor",
        LssRequest::Identify(Bound::Product, _) => "LSS identify: product",
        LssRequest::Identify(Bound::LowestRevision, _) => "LSS identify: revision, lowest",
        LssRequest::Identify(Bound::HighestRevision, _) => "LSS identify: revision, highest",
        LssRequest::Identify(Bound::LowestSerial, _) => "LSS identify: serial number, lowest",
        LssRequest::Identify(Bound::HighestSerial, _) => "LSS identify: serial number, highest",
        LssRequest::IdentifyWithoutNumber => "LSS identify slaves without a number",
        LssRequest::FastScan { .. } => "LSS fast scan",
        LssRequest::Inquire(part) => inquiry_title(part),
        LssRequest::InquireNode => "LSS inquire node number",
    }
}

const fn response_title(response: LssResponse) -> &'static str {
    match response {
        LssResponse::Outcome { service: Service::ConfigureNode, .. } => "LSS configure node number",
        LssResponse::Outcome { service: Service::ConfigureBitTiming, .. } => "LSS configure bit timing",
        LssResponse::Outcome { service: Service::Store, .. } => "LSS store configuration",
        LssResponse::Selected => "LSS switched",
        LssResponse::Identified => "LSS identified",
        LssResponse::WithoutNumber => "LSS a slave without a number",
        LssResponse::Address(part, _) => inquiry_title(part),
        LssResponse::Node(_) => "LSS inquire node number",
    }
}

const fn inquiry_title(part: Part) -> &'static str {
    match part {
        Part::Vendor => "LSS inquire vendor",
        Part::Product => "LSS inquire product",
        Part::Revision => "LSS inquire revision",
        Part::Serial => "LSS inquire serial number",
    }
}
