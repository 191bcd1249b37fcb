//! The active half: clients for ISO-TP and diagnostics, CANopen, J1939, XCP and CCP.
//!
//! Each is a [`Machine`] without its own input and output: frames and the time go in, frames and the next deadline come out. Whoever
//! has a bus drives it; the `cantap` command does so with a device. Every machine ends in bounded time, whatever the other side does.

mod answer;
pub mod calibration;
#[cfg(test)]
mod calibration_tests;
pub mod drive;
pub mod exchange;
pub mod heartbeat;
pub mod lss;
pub mod node_scan;
mod rivals;
pub mod sdo;
mod sdo_job;
pub mod server_scan;
pub mod station;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
pub mod transfer;

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

/// A client that communicates on one bus. Times are nanoseconds of a clock that never goes back, the same one in
/// all calls.
pub trait Machine {
    /// The next frame to send now, if any. Call it repeatedly until there is none: after every other call, and when
    /// [`Self::due_ns`] is reached.
    fn next(&mut self, now_ns: u64) -> Option<Frame>;

    /// The earliest unconfirmed frame from [`Self::next`] was on the bus.
    fn sent(&mut self, now_ns: u64);

    /// A data frame from another node was on the bus.
    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]);

    /// Frames may be missing here. Anything that cannot be proved complete by sequence numbers is abandoned.
    fn gap(&mut self, now_ns: u64);

    /// When to call [`Self::next`] even if nothing happens. There is no such time while its own frames are in flight: whoever sends
    /// them knows whether they leave.
    fn due_ns(&self) -> Option<u64>;

    /// Whether it has ended, successfully or not.
    fn is_done(&self) -> bool;

    /// It is ended from outside: what to send last, if the other side would otherwise wait or go on. Send that and nothing more.
    fn cancel(&mut self) -> Option<Frame> {
        None
    }
}

/// Frames that need no answer: done when they have been on the bus.
#[derive(Clone, Debug)]
pub struct Broadcast {
    frames: VecDeque<Frame>,
    under_way: usize,
}

impl Broadcast {
    /// Sends these frames in order.
    pub fn new(frames: impl IntoIterator<Item = Frame>) -> Self {
        Self { frames: frames.into_iter().collect(), under_way: 0 }
    }
}

impl Machine for Broadcast {
    fn next(&mut self, _now_ns: u64) -> Option<Frame> {
        let frame = self.frames.pop_front();
        self.under_way += usize::from(frame.is_some());
        frame
    }

    fn sent(&mut self, _now_ns: u64) {
        self.under_way = self.under_way.saturating_sub(1);
    }

    fn hear(&mut self, _now_ns: u64, _id: Id, _data: &[u8]) {}

    fn gap(&mut self, _now_ns: u64) {}

    fn due_ns(&self) -> Option<u64> {
        None
    }

    fn is_done(&self) -> bool {
        self.frames.is_empty() && self.under_way == 0
    }
}

/// The earlier of two deadlines.
pub fn earlier(one: Option<u64>, other: Option<u64>) -> Option<u64> {
    one.into_iter().chain(other).min()
}
