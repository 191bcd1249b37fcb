//! Sends frames in a stream: many in flight at once, never more than fit in the device's queue, each accounted
//! for.
//!
//! A request carries up to 20 frames and its answer takes a USB round trip, so several requests are in flight at a time.
//! Unconfirmed frames are counted, and no more are sent than fit in the device's queue: it never refuses any, so the order is
//! kept.

use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use cantap_trace::TraceFrame;
use cantap_wire::message::{MAX_SEND, MAX_SEND_FD, TxFdFrame, TxFrame};
use cantap_wire::{CHANNELS, Channel, Command};

use crate::device::{Pending, Transmission};
use crate::{Device, DeviceError};

/// Requests in flight: with 20 frames each, more than both buses can send in a USB round trip.
const REQUESTS: usize = 6;
/// How often to check whether to continue while waiting for a confirmation.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Tags wrap here, far below the device's own tags and far above the number in flight.
const TAGS: u32 = 1 << 24;

/// Frames for one request: of one kind.
enum Batch {
    Classic(heapless::Vec<TxFrame, MAX_SEND>),
    Fd(heapless::Vec<TxFdFrame, MAX_SEND_FD>),
}

impl Default for Batch {
    fn default() -> Self {
        Self::Classic(heapless::Vec::new())
    }
}

impl Batch {
    fn len(&self) -> usize {
        match self {
            Self::Classic(frames) => frames.len(),
            Self::Fd(frames) => frames.len(),
        }
    }

    fn is_full(&self) -> bool {
        match self {
            Self::Classic(frames) => frames.is_full(),
            Self::Fd(frames) => frames.is_full(),
        }
    }

    /// Adds a frame; false if the batch has none of its kind, but others.
    fn push(&mut self, tag: u32, frame: TraceFrame, at_ticks: Option<u64>) -> bool {
        if self.len() == 0 {
            *self = match frame {
                TraceFrame::Classic(_) => Self::Classic(heapless::Vec::new()),
                TraceFrame::Fd(_) => Self::Fd(heapless::Vec::new()),
            };
        }
        // There is room: a full batch is sent at once.
        match (self, frame) {
            (Self::Classic(frames), TraceFrame::Classic(frame)) => {
                frames.push(TxFrame { tag, frame, at_ticks }).is_ok()
            }
            (Self::Fd(frames), TraceFrame::Fd(frame)) => {
                frames.push(TxFdFrame { tag, frame, at_ticks }).is_ok()
            }
            _ => false,
        }
    }

    fn command(self, channel: Channel) -> Command {
        match self {
            Self::Classic(frames) => Command::Send { channel, frames },
            Self::Fd(frames) => Command::SendFd { channel, frames },
        }
    }
}

#[derive(Default)]
struct Lane {
    batch: Batch,
    /// Tag and due time (0: immediately) of frames that have not ended, in order, including those in the
    /// batch.
    waiting: VecDeque<(u32, u64)>,
    next_tag: u32,
}

impl Lane {
    fn end(&mut self, tag: u32) {
        // Nearly always the first one, but frames that were given up may end out of order.
        if let Some(at) = self.waiting.iter().position(|(waiting, _)| *waiting == tag) {
            self.waiting.remove(at);
        }
    }
}

/// A stream of frames to one device's channels.
pub struct Stream<'d> {
    device: &'d Device,
    confirmations: Receiver<Transmission>,
    lanes: [Lane; CHANNELS],
    requests: VecDeque<Pending<'d>>,
    /// Ended transmissions, in the device's order, for [`Self::take_ended`].
    ended: Vec<Transmission>,
}

impl<'d> Stream<'d> {
    /// A stream to a device whose channels are open; it takes over the device's confirmations.
    pub fn new(device: &'d Device) -> Self {
        Self {
            device,
            confirmations: device.transmissions(),
            lanes: Default::default(),
            requests: VecDeque::new(),
            ended: Vec::new(),
        }
    }

    /// Adds a frame, to be sent no earlier than a device time. Waits while the device's queue is full, and
    /// returns `None` if `go_on` returned false meanwhile. Otherwise returns the tag of its confirmation.
    ///
    /// A CAN FD frame is refused ([`DeviceError::NoFd`]) if the device sends none.
    pub fn push(
        &mut self,
        channel: Channel,
        frame: impl Into<TraceFrame>,
        at_ticks: Option<u64>,
        mut go_on: impl FnMut(&mut Self) -> bool,
    ) -> Result<Option<u32>, DeviceError> {
        while self.is_full(channel) {
            self.wait_for_room()?;
            if !go_on(self) {
                return Ok(None);
            }
        }
        self.add(channel, frame.into(), at_ticks).map(Some)
    }

    /// Whether the device's queue is full.
    pub(crate) fn is_full(&self, channel: Channel) -> bool {
        let room = usize::from(self.device.hello().tx_queue).max(1);
        self.lanes[channel.index()].waiting.len() >= room
    }

    /// Waits a while for a transmission to end.
    pub(crate) fn wait_for_room(&mut self) -> Result<(), DeviceError> {
        // Everything has to be on its way before waiting for anything.
        self.flush()?;
        self.collect(LOOK_EVERY)
    }

    /// Adds a frame; there must be room.
    pub(crate) fn add(
        &mut self,
        channel: Channel,
        frame: TraceFrame,
        at_ticks: Option<u64>,
    ) -> Result<u32, DeviceError> {
        if frame.is_fd() && !self.device.hello().sends_fd() {
            return Err(DeviceError::NoFd);
        }
        let lane = self.lane(channel);
        let tag = lane.next_tag;
        lane.next_tag = (tag + 1) % TAGS;
        if !lane.batch.push(tag, frame, at_ticks) {
            self.send(channel)?;
            // Cannot fail: it is empty.
            self.lane(channel).batch.push(tag, frame, at_ticks);
        }
        let lane = self.lane(channel);
        lane.waiting.push_back((tag, at_ticks.unwrap_or(0)));
        if lane.batch.is_full() {
            self.send(channel)?;
        }
        self.collect(Duration::ZERO)?;
        Ok(tag)
    }

    /// Hands everything to the device.
    pub fn flush(&mut self) -> Result<(), DeviceError> {
        for channel in Channel::ALL {
            if self.lane(channel).batch.len() > 0 {
                self.send(channel)?;
            }
        }
        while let Some(request) = self.requests.pop_front() {
            request.wait()?;
        }
        Ok(())
    }

    /// Waits until everything has ended, as long as `go_on` returns true; it is given the time since the last
    /// end. Returns whether everything has ended.
    pub fn finish(&mut self, mut go_on: impl FnMut(Duration) -> bool) -> Result<bool, DeviceError> {
        self.flush()?;
        let mut last = Instant::now();
        while self.under_way() > 0 {
            let before = self.ended.len();
            self.collect(LOOK_EVERY)?;
            if self.ended.len() > before {
                last = Instant::now();
            } else if !go_on(last.elapsed()) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Waits for the next transmission to end, at most this long.
    pub fn wait(&mut self, at_most: Duration) -> Result<(), DeviceError> {
        self.collect(at_most)
    }

    /// Number of frames handed over that have not ended.
    pub fn under_way(&self) -> usize {
        self.lanes.iter().map(|lane| lane.waiting.len() - lane.batch.len()).sum()
    }

    /// For each channel, when its oldest frame became due, in ticks (0: immediately), if one has not ended.
    pub fn oldest_due(&self) -> [Option<u64>; CHANNELS] {
        self.lanes.each_ref().map(|lane| lane.waiting.front().map(|(_, due)| *due))
    }

    /// How transmissions ended since the last call, in the device's order.
    pub fn take_ended(&mut self) -> Vec<Transmission> {
        std::mem::take(&mut self.ended)
    }

    fn lane(&mut self, channel: Channel) -> &mut Lane {
        &mut self.lanes[channel.index()]
    }

    fn send(&mut self, channel: Channel) -> Result<(), DeviceError> {
        let lane = self.lane(channel);
        let batch = std::mem::take(&mut lane.batch);
        if self.requests.len() >= REQUESTS
            && let Some(oldest) = self.requests.pop_front()
        {
            oldest.wait()?;
        }
        self.requests.push_back(self.device.request_later(batch.command(channel))?);
        Ok(())
    }

    /// Takes confirmations, waiting at most `wait` for the first.
    fn collect(&mut self, wait: Duration) -> Result<(), DeviceError> {
        let mut wait = wait;
        loop {
            match self.confirmations.recv_timeout(wait) {
                Ok(end) => {
                    if end.tag < TAGS {
                        self.lane(end.channel).end(end.tag);
                    }
                    self.ended.push(end);
                    wait = Duration::ZERO;
                }
                Err(RecvTimeoutError::Timeout) => return Ok(()),
                // The reader has ended: a request returns the reason.
                Err(RecvTimeoutError::Disconnected) => return self.device.time().map(|_| ()),
            }
        }
    }
}
