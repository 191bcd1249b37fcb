//! Sends or receives one message by ISO 15765-2 on classical CAN, in normal, extended or mixed addressing.

use cantap_can::Frame;

use crate::iso_tp::{Endpoint, FlowStatus, Pci, separation_us};

/// How many frames of a block may wait in the sender's queue at a time, if no separation time is requested.
const MOST_UNDER_WAY: u32 = 16;
/// If the frame after the first one has not come by then, the device has not sent flow control. Servers begin within some
/// milliseconds, and wait for it for a second (N_Bs); a second flow control frame is ignored.
const FLOW_MISSING_NS: u64 = 100_000_000;
/// The longest message that is accepted, in bytes.
const MOST_BYTES: u32 = 1 << 16;

/// Parameters of transfers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransferSettings {
    /// Fills frames to eight bytes; without it, they are as short as possible.
    pub padding: Option<u8>,
    /// How many frames the other side may send before it waits for flow control; 0 for all.
    pub block_size: u8,
    /// The minimum separation of the other side's frames, encoded as in flow control: 0 to 7F in milliseconds, F1 to F9 in
    /// 100 µs.
    pub separation: u8,
    /// How long to wait for flow control (N_Bs).
    pub flow_timeout_ns: u64,
    /// How long to wait for the next frame (N_Cr).
    pub next_timeout_ns: u64,
    /// How often in a row the other side may ask to wait (N_WFTmax).
    pub most_waits: u32,
}

impl Default for TransferSettings {
    /// As in ISO 15765-2: a second each; everything at once; ten requests to wait.
    fn default() -> Self {
        Self {
            padding: Some(0xCC),
            block_size: 0,
            separation: 0,
            flow_timeout_ns: 1_000_000_000,
            next_timeout_ns: 1_000_000_000,
            most_waits: 10,
        }
    }
}

/// Why a transfer ended before it was complete.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TransferError {
    /// No flow control came.
    #[error("no flow control came within {after_ms} ms, after {sent} of {length} bytes")]
    NoFlowControl {
        /// How long we waited.
        after_ms: u64,
        /// Bytes sent so far.
        sent: usize,
        /// Bytes of the message.
        length: usize,
    },
    /// The other side kept asking to wait.
    #[error("the receiver asked to wait {times} times in a row, after {sent} of {length} bytes")]
    EndlessWait {
        /// How often.
        times: u32,
        /// Bytes sent so far.
        sent: usize,
        /// Bytes of the message.
        length: usize,
    },
    /// The receiver has no room for such a long message.
    #[error("the receiver has no room for a message of {length} bytes (flow control: overflow)")]
    Overflow {
        /// Bytes of the message.
        length: usize,
    },
    /// The other side's frames are not consecutive.
    #[error("frame {got} came instead of {expected}, after {received} of {length} bytes")]
    Sequence {
        /// The expected sequence number.
        expected: u8,
        /// The one received.
        got: u8,
        /// Bytes received so far.
        received: usize,
        /// Bytes of the message.
        length: usize,
    },
    /// The other side fell silent.
    #[error("the next frame did not come within {after_ms} ms, after {received} of {length} bytes")]
    NextMissing {
        /// How long we waited.
        after_ms: u64,
        /// Bytes received so far.
        received: usize,
        /// Bytes of the message.
        length: usize,
    },
    /// The other side announced more than is accepted.
    #[error("a message of {length} bytes is announced, and no more than {MOST_BYTES} are taken")]
    TooLong {
        /// Bytes announced.
        length: u32,
    },
    /// The other side's frame violates the standard.
    #[error("the other side sent {0}")]
    Malformed(&'static str),
    /// Frames from the bus were lost on the way to this computer: sequence numbers alone cannot prove that the message is complete.
    #[error("frames were lost on the way to this computer, so the message may not be whole")]
    FramesLost,
}

/// A frame to an endpoint.
fn frame(to: Endpoint, pci: Pci<'_>, padding: Option<u8>) -> Frame {
    let (bytes, length) = pci.encode(to.address, padding);
    Frame::from_bus(to.id, false, length, bytes)
}

/// Flow control. One that ends the transfer asks for nothing else.
fn flow(to: Endpoint, settings: &TransferSettings, status: FlowStatus) -> Frame {
    let (block_size, separation_us) = match status {
        FlowStatus::Overflow => (0, 0),
        _ => (settings.block_size, separation_us(settings.separation)),
    };
    frame(to, Pci::Flow { status, block_size, separation_us }, settings.padding)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sending {
    /// Nothing has been sent.
    New,
    /// The first frame, or a block, was handed over; the deadline starts with its confirmation.
    AwaitsFlow { until_ns: Option<u64> },
    /// A block is being sent: how many frames may still follow, and when.
    Block { left: Option<u8>, gap_ns: u64, next_ns: u64 },
    /// Everything was handed over.
    Last,
    /// Everything was on the bus.
    Done,
}

/// Sends one message.
#[derive(Clone, Debug)]
pub struct TransferSender {
    to: Endpoint,
    data: Vec<u8>,
    settings: TransferSettings,
    at: usize,
    number: u8,
    state: Sending,
    under_way: u32,
    waits: u32,
}

impl TransferSender {
    /// One message, of at least one byte, to an endpoint.
    pub const fn new(to: Endpoint, data: Vec<u8>, settings: TransferSettings) -> Self {
        Self { to, data, settings, at: 0, number: 1, state: Sending::New, under_way: 0, waits: 0 }
    }

    /// Whether it fits one frame.
    pub fn is_single(&self) -> bool {
        self.data.len() <= Pci::Single(&[]).room(self.to.address)
    }

    /// Whether everything was on the bus.
    pub fn is_done(&self) -> bool {
        self.state == Sending::Done
    }

    /// When to call [`Self::next`] again.
    pub const fn due_ns(&self) -> Option<u64> {
        match self.state {
            Sending::AwaitsFlow { until_ns } => until_ns,
            Sending::Block { next_ns, .. } if self.under_way == 0 => Some(next_ns),
            _ => None,
        }
    }

    /// The next frame to send now; an error ends the transfer.
    pub fn next(&mut self, now_ns: u64) -> Result<Option<Frame>, TransferError> {
        let (length, padding) = (self.data.len(), self.settings.padding);
        match self.state {
            Sending::New if self.is_single() => {
                self.state = Sending::Last;
                self.at = length;
                self.under_way = 1;
                Ok(Some(frame(self.to, Pci::Single(&self.data), padding)))
            }
            Sending::New => {
                let first = Pci::First { length: length as u32, data: &self.data };
                self.at = first.room(self.to.address);
                self.state = Sending::AwaitsFlow { until_ns: None };
                self.under_way = 1;
                Ok(Some(frame(self.to, first, padding)))
            }
            Sending::AwaitsFlow { until_ns: Some(until_ns) } if now_ns >= until_ns => {
                let after_ms = self.settings.flow_timeout_ns / 1_000_000;
                Err(TransferError::NoFlowControl { after_ms, sent: self.at, length })
            }
            Sending::Block { left, gap_ns, next_ns } => {
                let may = if gap_ns == 0 {
                    self.under_way < MOST_UNDER_WAY
                } else {
                    self.under_way == 0 && now_ns >= next_ns
                };
                if !may {
                    return Ok(None);
                }
                let next = Pci::Consecutive { number: self.number, data: &self.data[self.at..] };
                let end = length.min(self.at + next.room(self.to.address));
                let sent = frame(self.to, next, padding);
                (self.at, self.number) = (end, (self.number + 1) & 15);
                self.under_way += 1;
                let left = left.map(|left| left - 1);
                self.state = match left {
                    _ if end == length => Sending::Last,
                    Some(0) => Sending::AwaitsFlow { until_ns: None },
                    left => Sending::Block { left, gap_ns, next_ns },
                };
                Ok(Some(sent))
            }
            _ => Ok(None),
        }
    }

    /// A frame was on the bus.
    pub const fn sent(&mut self, now_ns: u64) {
        self.under_way = self.under_way.saturating_sub(1);
        match &mut self.state {
            Sending::AwaitsFlow { until_ns } if self.under_way == 0 => {
                *until_ns = Some(now_ns + self.settings.flow_timeout_ns);
            }
            Sending::Block { gap_ns, next_ns, .. } => *next_ns = now_ns + *gap_ns,
            Sending::Last if self.under_way == 0 => self.state = Sending::Done,
            _ => {}
        }
    }

    /// Takes flow control; an error ends the transfer. Unexpected flow control is ignored, as ISO 15765-2
    /// requires.
    pub fn flow(
        &mut self,
        now_ns: u64,
        status: FlowStatus,
        block_size: u8,
        separation_us: u32,
    ) -> Result<(), TransferError> {
        let Sending::AwaitsFlow { until_ns } = &mut self.state else { return Ok(()) };
        let (sent, length) = (self.at, self.data.len());
        match status {
            FlowStatus::Go => {
                self.waits = 0;
                let gap_ns = u64::from(separation_us) * 1000;
                self.state =
                    Sending::Block { left: (block_size > 0).then_some(block_size), gap_ns, next_ns: now_ns };
                Ok(())
            }
            FlowStatus::Wait => {
                self.waits += 1;
                if self.waits > self.settings.most_waits {
                    return Err(TransferError::EndlessWait { times: self.waits, sent, length });
                }
                *until_ns = Some(now_ns + self.settings.flow_timeout_ns);
                Ok(())
            }
            FlowStatus::Overflow => Err(TransferError::Overflow { length }),
        }
    }
}

/// An incoming message.
#[derive(Clone, Debug)]
struct Receiving {
    data: Vec<u8>,
    length: usize,
    number: u8,
    /// Frames until the next flow control is due.
    left: Option<u8>,
    until_ns: u64,
}

/// Receives messages from one sender, one after the other.
#[derive(Clone, Debug)]
pub struct TransferReceiver {
    flow_to: Endpoint,
    settings: TransferSettings,
    receiving: Option<Receiving>,
    /// The flow control frame to send.
    flow: Option<Frame>,
    /// The device itself sends flow control after the next frame.
    flow_by_device: bool,
    /// If the next frame has not come by then, the device has not sent it.
    flow_missing_ns: Option<u64>,
}

impl TransferReceiver {
    /// Receives from a sender that takes flow control at an endpoint. With `flow_by_device`, the device sends the first flow control
    /// frame on its own, as its reply to the sender's next frame. It does not if that frame did not come over the bus but from another
    /// program that uses the device; so if nothing follows the first frame, flow control is sent here after all.
    pub const fn new(flow_to: Endpoint, settings: TransferSettings, flow_by_device: bool) -> Self {
        Self { flow_to, settings, receiving: None, flow: None, flow_by_device, flow_missing_ns: None }
    }

    /// The flow control frame that lets a sender continue.
    pub fn go_on(flow_to: Endpoint, settings: &TransferSettings) -> Frame {
        flow(flow_to, settings, FlowStatus::Go)
    }

    /// Whether a message has begun but not ended.
    pub const fn is_receiving(&self) -> bool {
        self.receiving.is_some()
    }

    /// When to call [`Self::next`] again.
    pub fn due_ns(&self) -> Option<u64> {
        let receiving = self.receiving.as_ref()?;
        Some(self.flow_missing_ns.map_or(receiving.until_ns, |missing_ns| missing_ns.min(receiving.until_ns)))
    }

    /// The flow control frame to send now; an error ends the message.
    pub fn next(&mut self, now_ns: u64) -> Result<Option<Frame>, TransferError> {
        if let Some(flow) = self.flow.take() {
            return Ok(Some(flow));
        }
        if self.is_receiving() && self.flow_missing_ns.take_if(|missing_ns| now_ns >= *missing_ns).is_some() {
            return Ok(Some(Self::go_on(self.flow_to, &self.settings)));
        }
        match self.receiving.take_if(|receiving| now_ns >= receiving.until_ns) {
            None => Ok(None),
            Some(receiving) => Err(TransferError::NextMissing {
                after_ms: self.settings.next_timeout_ns / 1_000_000,
                received: receiving.data.len(),
                length: receiving.length,
            }),
        }
    }

    /// Frames may be missing.
    pub fn gap(&mut self) -> Result<(), TransferError> {
        if self.receiving.take().is_some() { Err(TransferError::FramesLost) } else { Ok(()) }
    }

    /// Takes a frame from the sender; returns the message that it completes.
    pub fn take(&mut self, now_ns: u64, pci: Pci<'_>) -> Result<Option<Vec<u8>>, TransferError> {
        let by_device = std::mem::take(&mut self.flow_by_device);
        self.flow_missing_ns = None;
        let until_ns = now_ns + self.settings.next_timeout_ns;
        match pci {
            Pci::Single(data) => {
                self.receiving = None;
                Ok(Some(data.to_vec()))
            }
            Pci::First { length, .. } if length > MOST_BYTES => {
                self.receiving = None;
                self.flow = Some(flow(self.flow_to, &self.settings, FlowStatus::Overflow));
                Err(TransferError::TooLong { length })
            }
            Pci::First { length, data } => {
                if by_device {
                    self.flow_missing_ns = Some(now_ns + FLOW_MISSING_NS);
                } else {
                    self.flow = Some(Self::go_on(self.flow_to, &self.settings));
                }
                self.receiving = Some(Receiving {
                    data: data.to_vec(),
                    length: length as usize,
                    number: 1,
                    left: self.block(),
                    until_ns,
                });
                Ok(None)
            }
            Pci::Consecutive { number, data } => {
                let Some(mut receiving) = self.receiving.take() else { return Ok(None) };
                let (received, length) = (receiving.data.len(), receiving.length);
                if number != receiving.number {
                    let expected = receiving.number;
                    return Err(TransferError::Sequence { expected, got: number, received, length });
                }
                receiving.data.extend_from_slice(data);
                if receiving.data.len() >= length {
                    receiving.data.truncate(length);
                    return Ok(Some(receiving.data));
                }
                receiving.number = (number + 1) & 15;
                receiving.until_ns = until_ns;
                receiving.left = receiving.left.map(|left| left - 1);
                if receiving.left == Some(0) {
                    receiving.left = self.block();
                    self.flow = Some(Self::go_on(self.flow_to, &self.settings));
                }
                self.receiving = Some(receiving);
                Ok(None)
            }
            Pci::Flow { .. } => Ok(None),
        }
    }

    fn block(&self) -> Option<u8> {
        Some(self.settings.block_size).filter(|size| *size > 0)
    }
}
