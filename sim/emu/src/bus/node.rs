//! A simulated node on the bus: a sender with its own clock, a receiver that acknowledges, or both.

use std::collections::VecDeque;

use cantap_can::Frame;

use crate::Clock;
use crate::can::fault::ErrorCounters;

/// Where a node's frames come from when its own queue is empty.
pub trait Source: Send {
    /// The next frame and the earliest core cycle for its start, or `None` when there are no more.
    /// `bit` is the length of a bit as a fraction of core cycles.
    fn next_frame(&mut self, bit: BitTime) -> Option<(u64, Frame)>;
}

/// The exact length of a bit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitTime {
    cycles: u64,
    divisor: u64,
}

impl BitTime {
    /// The bit time of a rate in bit/s.
    pub fn of_rate(bitrate_bps: u32, clock: Clock) -> Self {
        Self { cycles: clock.hz(), divisor: bitrate_bps.into() }
    }

    /// The same, with a clock that is `ppm` parts per million too fast (negative: too slow).
    pub fn of_rate_off_by(bitrate_bps: u32, ppm: i32, clock: Clock) -> Self {
        let divisor = u64::from(bitrate_bps) * 1_000_000u64.saturating_add_signed(ppm.into());
        Self { cycles: clock.hz() * 1_000_000, divisor }
    }

    /// A bit time of a whole number of core cycles.
    pub fn of_cycles(cycles: u64) -> Self {
        Self { cycles, divisor: 1 }
    }

    /// Core cycles of `bits` bits, rounded down.
    pub fn cycles(&self, bits: u64) -> u64 {
        (u128::from(bits) * u128::from(self.cycles) / u128::from(self.divisor)) as u64
    }

    /// Whether two nodes with these bit times can reliably understand each other: within 0.5 %.
    pub fn agrees_with(&self, other: &Self) -> bool {
        let (a, b) = (self.cycles(1_000_000), other.cycles(1_000_000));
        a.abs_diff(b) * 200 <= a.min(b)
    }
}

/// A simulated node.
pub struct Node {
    pub(super) bit: BitTime,
    pub(super) acknowledges: bool,
    pub(super) counters: ErrorCounters,
    /// Nothing is sent before this cycle: bus-off, or the pause of an error-passive sender.
    pub(super) not_before: u64,
    queue: VecDeque<(u64, Frame)>,
    source: Option<Box<dyn Source>>,
    sent: u64,
}

impl Node {
    /// A node that acknowledges every good frame and has nothing to send.
    pub fn new(bit: BitTime) -> Self {
        Self {
            bit,
            acknowledges: true,
            counters: ErrorCounters::default(),
            not_before: 0,
            queue: VecDeque::new(),
            source: None,
            sent: 0,
        }
    }

    /// The same without acknowledging.
    #[must_use]
    pub fn without_acknowledging(self) -> Self {
        Self { acknowledges: false, ..self }
    }

    /// Sets whether it acknowledges from now on.
    pub fn acknowledge(&mut self, acknowledge: bool) {
        self.acknowledges = acknowledge;
    }

    /// The same, with frames from `source` whenever its queue is empty.
    #[must_use]
    pub fn with_source(self, source: impl Source + 'static) -> Self {
        Self { source: Some(Box::new(source)), ..self }
    }

    /// Continues with another bit time and other frames.
    pub fn restart(&mut self, bit: BitTime, source: Option<Box<dyn Source>>) {
        self.bit = bit;
        self.queue.clear();
        self.source = source;
        self.refill();
    }

    /// Queues a frame that is sent at core cycle `at` or as soon as possible after it.
    pub fn send_at(&mut self, at: u64, frame: Frame) {
        self.queue.push_back((at, frame));
    }

    /// No more frames: neither from the queue nor from a source.
    pub fn stop_sending(&mut self) {
        self.queue.clear();
        self.source = None;
    }

    /// Frames it has sent without error.
    pub fn sent(&self) -> u64 {
        self.sent
    }

    /// Its error counters.
    pub fn counters(&self) -> ErrorCounters {
        self.counters
    }

    /// The frame it wants to send, and the earliest time for it.
    pub(super) fn wanted(&self) -> Option<(u64, Frame)> {
        self.queue.front().map(|(at, frame)| ((*at).max(self.not_before), *frame))
    }

    /// Fills the queue from the source if it is empty.
    pub(super) fn refill(&mut self) {
        if self.queue.is_empty()
            && let Some(source) = &mut self.source
        {
            self.queue.extend(source.next_frame(self.bit));
        }
    }

    pub(super) fn frame_sent(&mut self) {
        self.counters.sent();
        self.queue.pop_front();
        self.sent += 1;
    }
}

impl Source for Box<dyn Source> {
    fn next_frame(&mut self, bit: BitTime) -> Option<(u64, Frame)> {
        self.as_mut().next_frame(bit)
    }
}
