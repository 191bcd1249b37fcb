//! The half that speaks: clients of ISO-TP and diagnostics, CANopen and J1939.
//!
//! Each is a [`Machine`] without input and output of its own: frames and the time go in, frames and the time of the next deadline come
//! out. Whoever has a bus drives it; the `cantap` command does with a device. Every machine ends in bounded time, whatever the other
//! side does.

pub mod exchange;
pub mod lss;
pub mod node_scan;
pub mod sdo;
pub mod station;
#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
pub mod transfer;

use std::collections::VecDeque;

use cantap_trace::Id;
use cantap_wire::Frame;

/// A client that talks on one bus. Times are nanoseconds of a clock that never goes back, the same in all calls.
pub trait Machine {
    /// The frame that is to be sent now, if there is one. To be called again until there is none, after everything else here, and
    /// when [`Self::due_ns`] has come.
    fn next(&mut self, now_ns: u64) -> Option<Frame>;

    /// The frame that [`Self::next`] gave before any other that has not been confirmed was on the bus.
    fn sent(&mut self, now_ns: u64);

    /// A data frame of somebody else was on the bus.
    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]);

    /// Frames may be missing here. What numbers cannot prove to be whole is given up.
    fn gap(&mut self, now_ns: u64);

    /// When to call [`Self::next`] although nothing happens. There is none while its own frames are under way: whoever sends them knows
    /// whether they leave.
    fn due_ns(&self) -> Option<u64>;

    /// Whether it has ended, well or not.
    fn is_done(&self) -> bool;
}

/// Frames that nobody has to answer: done when they were on the bus.
#[derive(Clone, Debug)]
pub struct Announcement {
    frames: VecDeque<Frame>,
    under_way: usize,
}

impl Announcement {
    /// These frames, in this order.
    pub fn new(frames: impl IntoIterator<Item = Frame>) -> Self {
        Self { frames: frames.into_iter().collect(), under_way: 0 }
    }
}

impl Machine for Announcement {
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

/// The earliest of two deadlines.
pub(crate) fn earlier(one: Option<u64>, other: Option<u64>) -> Option<u64> {
    one.into_iter().chain(other).min()
}
