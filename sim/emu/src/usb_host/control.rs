//! A control transfer, one transaction at a time.

use crate::otg::{InReply, OutReply};

/// bRequest of the standard requests (USB 2.0, table 9-4).
pub const GET_STATUS: u8 = 0;
/// See [`GET_STATUS`].
pub const CLEAR_FEATURE: u8 = 1;
/// See [`GET_STATUS`].
pub const SET_FEATURE: u8 = 3;
/// See [`GET_STATUS`].
pub const SET_CONFIGURATION: u8 = 9;
/// See [`GET_STATUS`].
pub const SET_INTERFACE: u8 = 11;
/// Feature selectors (USB 2.0, 9.4).
pub const ENDPOINT_HALT: u16 = 0;
/// See [`ENDPOINT_HALT`].
pub const DEVICE_REMOTE_WAKEUP: u16 = 1;

/// A request on endpoint 0 (USB 2.0, 9.3).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request {
    /// bmRequestType.
    pub kind: u8,
    /// bRequest.
    pub request: u8,
    /// wValue.
    pub value: u16,
    /// wIndex.
    pub index: u16,
    /// wLength: bytes asked for, or the length of `data`.
    pub length: u16,
    /// What an OUT request carries.
    pub data: Vec<u8>,
}

impl Request {
    /// A request without data or one that asks for `length` bytes.
    pub fn new(kind: u8, request: u8, value: u16, index: u16, length: u16) -> Self {
        Self { kind, request, value, index, length, data: Vec::new() }
    }

    /// A request that carries data to the device.
    pub fn with_data(kind: u8, request: u8, value: u16, index: u16, data: Vec<u8>) -> Self {
        Self { kind, request, value, index, length: data.len() as u16, data }
    }

    /// SET_CONFIGURATION.
    pub fn set_configuration(value: u16) -> Self {
        Self::new(0x00, SET_CONFIGURATION, value, 0, 0)
    }

    /// SET_INTERFACE to the only setting that CDC-ACM interfaces have.
    pub fn set_interface(interface: u16) -> Self {
        Self::new(0x01, SET_INTERFACE, 0, interface, 0)
    }

    /// SET_FEATURE(ENDPOINT_HALT) of the endpoint with this address, bit 7 for IN.
    pub fn halt(endpoint: u8) -> Self {
        Self::new(0x02, SET_FEATURE, ENDPOINT_HALT, endpoint.into(), 0)
    }

    /// CLEAR_FEATURE(ENDPOINT_HALT).
    pub fn clear_halt(endpoint: u8) -> Self {
        Self::new(0x02, CLEAR_FEATURE, ENDPOINT_HALT, endpoint.into(), 0)
    }

    /// GET_STATUS of an endpoint: two bytes, bit 0 of the first is set if it is halted.
    pub fn endpoint_status(endpoint: u8) -> Self {
        Self::new(0x82, GET_STATUS, 0, endpoint.into(), 2)
    }

    /// Whether pipes begin with DATA0 afterwards, on both sides.
    pub fn restarts_pipes(&self) -> bool {
        matches!(
            (self.kind, self.request),
            (0x00, SET_CONFIGURATION) | (0x01, SET_INTERFACE) | (0x02, CLEAR_FEATURE)
        )
    }

    /// The request that a SETUP packet carries, with the data that goes with it.
    pub fn from_setup(packet: [u8; 8], data: Vec<u8>) -> Self {
        let word = |at: usize| u16::from_le_bytes([packet[at], packet[at + 1]]);
        Self { kind: packet[0], request: packet[1], value: word(2), index: word(4), length: word(6), data }
    }

    fn reads(&self) -> bool {
        self.kind & 0x80 != 0
    }

    fn setup(&self) -> [u8; 8] {
        let (value, index, length) =
            (self.value.to_le_bytes(), self.index.to_le_bytes(), self.length.to_le_bytes());
        [self.kind, self.request, value[0], value[1], index[0], index[1], length[0], length[1]]
    }
}

/// How a control transfer ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// With these bytes; none for a request that carries data to the device.
    Done(Vec<u8>),
    /// The device refused the request.
    Stalled,
    /// The device did not answer, or broke the protocol: says how.
    Failed(&'static str),
}

/// What to put on the bus next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// A SETUP packet.
    Setup([u8; 8]),
    /// An IN token.
    In,
    /// An OUT packet.
    Out {
        /// DATA1 rather than DATA0.
        data1: bool,
        /// Its bytes.
        bytes: Vec<u8>,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Setup,
    Data,
    Status,
}

/// Attempts at a transaction that gets no answer (USB 2.0, 10.2.6).
const ATTEMPTS: u32 = 3;

/// A transfer on its way.
#[derive(Debug)]
pub struct Transfer {
    request: Request,
    stage: Stage,
    data1: bool,
    moved: Vec<u8>,
    sent: usize,
    silences: u32,
}

impl Transfer {
    /// A transfer that has not begun.
    pub fn new(request: Request) -> Self {
        Self { request, stage: Stage::Setup, data1: true, moved: Vec::new(), sent: 0, silences: 0 }
    }

    /// The request.
    pub fn request(&self) -> &Request {
        &self.request
    }

    /// What to put on the bus. `packet` is endpoint 0's packet size.
    pub fn step(&self, packet: usize) -> Step {
        match self.stage {
            Stage::Setup => Step::Setup(self.request.setup()),
            Stage::Data if self.request.reads() => Step::In,
            Stage::Data => {
                let rest = &self.request.data[self.sent..];
                Step::Out { data1: self.data1, bytes: rest[..rest.len().min(packet)].to_vec() }
            }
            Stage::Status if self.request.reads() && self.request.length > 0 => {
                Step::Out { data1: true, bytes: Vec::new() }
            }
            Stage::Status => Step::In,
        }
    }

    /// Takes the answer to a SETUP or OUT packet.
    pub fn on_out(&mut self, reply: OutReply, packet: usize) -> Option<Outcome> {
        match (self.stage, reply) {
            (_, OutReply::Silence) => return self.silence(),
            (_, OutReply::Nak) => {}
            (Stage::Setup, OutReply::Stall) => {
                return Some(Outcome::Failed("a SETUP packet was answered with STALL"));
            }
            (_, OutReply::Stall) => return Some(Outcome::Stalled),
            (Stage::Setup, OutReply::Ack) => {
                self.stage = if self.request.length > 0 { Stage::Data } else { Stage::Status };
            }
            (Stage::Data, OutReply::Ack) => {
                self.sent = (self.sent + packet).min(self.request.data.len());
                self.data1 = !self.data1;
                if self.sent == self.request.data.len() {
                    self.stage = Stage::Status;
                }
            }
            (Stage::Status, OutReply::Ack) => return Some(Outcome::Done(std::mem::take(&mut self.moved))),
        }
        self.silences = 0;
        None
    }

    /// Takes the answer to an IN token.
    pub fn on_in(&mut self, reply: InReply, packet: usize) -> Option<Outcome> {
        let (data1, bytes) = match reply {
            InReply::Silence => return self.silence(),
            InReply::Nak => {
                self.silences = 0;
                return None;
            }
            InReply::Stall => return Some(Outcome::Stalled),
            InReply::Data { data1, bytes } => (data1, bytes),
        };
        self.silences = 0;
        if self.stage == Stage::Status {
            return Some(match (data1, bytes.is_empty()) {
                (true, true) => Outcome::Done(std::mem::take(&mut self.moved)),
                (false, _) => Outcome::Failed("the status stage came as DATA0"),
                (true, false) => Outcome::Failed("the status stage carried data"),
            });
        }
        if data1 != self.data1 {
            // A repetition of a packet that has already been taken.
            return None;
        }
        self.data1 = !data1;
        self.moved.extend_from_slice(&bytes);
        if self.moved.len() > usize::from(self.request.length) {
            return Some(Outcome::Failed("more bytes than were asked for"));
        }
        if bytes.len() < packet || self.moved.len() == usize::from(self.request.length) {
            self.stage = Stage::Status;
        }
        None
    }

    fn silence(&mut self) -> Option<Outcome> {
        self.silences += 1;
        (self.silences >= ATTEMPTS).then_some(Outcome::Failed("no answer"))
    }
}
