//! When simulated nodes send.

use std::collections::VecDeque;
use std::fmt::Debug;

use cantap_wire::Frame;

use super::frames::FrameSource;
use cantap_trace::bits::FrameBits;

/// Simulated nodes that decide for themselves: several may want to send at the same time, and they hear what
/// others send.
///
/// Times are the simulation's, in nanoseconds.
pub trait Senders: Debug + Send {
    /// When one of them wants to send next.
    fn due(&mut self, now_ns: u64) -> Option<u64>;
    /// Of the frames that they want to send at this time, the one with the lowest identifier.
    fn bid(&mut self, now_ns: u64) -> Option<Frame>;
    /// That frame is on the bus.
    fn take(&mut self, now_ns: u64);
    /// It has ended well.
    fn delivered(&mut self);
    /// It was destroyed.
    fn destroyed(&mut self, frame: &Frame, now_ns: u64);
    /// Another node's frame has ended well.
    fn hear(&mut self, frame: &Frame, now_ns: u64);
}

/// When the next frame is due.
#[derive(Debug)]
pub enum Schedule {
    /// Nothing is sent.
    Silent,
    /// The bus is busy for this percentage of the time; from 100 on, frames are back to back.
    Load {
        /// The frames.
        source: FrameSource,
        /// Percentage of the time.
        percent: f64,
    },
    /// Frames back to back, then a pause.
    Bursts {
        /// The frames.
        source: FrameSource,
        /// Number of frames in a burst.
        length: u32,
        /// From the start of a burst to the start of the next, in nanoseconds.
        period_ns: u64,
    },
    /// Frames with their own timing.
    Log {
        /// Nanoseconds since the log's start, in order, with the frame.
        entries: std::vec::IntoIter<(u64, Frame)>,
    },
    /// Nodes decide for themselves.
    Nodes(Box<dyn Senders>),
}

/// The frames that simulated nodes want to send, one after the other.
#[derive(Debug)]
pub struct Traffic {
    schedule: Schedule,
    next: Option<(u64, Frame)>,
    /// Planned, but overtaken by a frame that must be sent again.
    waiting: VecDeque<(u64, Frame)>,
    /// Number of frames handed out, for bursts.
    count: u64,
    /// Fractions of a nanosecond carried over, so that a load is met exactly.
    due_ns: f64,
    started: bool,
    /// The schedule's time zero.
    start_ns: u64,
}

impl Traffic {
    /// Traffic that begins when it is first queried.
    pub const fn new(schedule: Schedule) -> Self {
        Self {
            schedule,
            next: None,
            waiting: VecDeque::new(),
            count: 0,
            due_ns: 0.0,
            started: false,
            start_ns: 0,
        }
    }

    /// The earliest time at which the next frame may start, as from [`Self::peek`].
    pub fn due(&mut self, now_ns: u64, bitrate_bps: u32) -> Option<u64> {
        match &mut self.schedule {
            Schedule::Nodes(nodes) => nodes.due(now_ns),
            _ => self.peek(now_ns, bitrate_bps).map(|(due_ns, _)| due_ns),
        }
    }

    /// The next frame, and the earliest time at which it may start. `now_ns` is when the bus became free.
    pub fn peek(&mut self, now_ns: u64, bitrate_bps: u32) -> Option<(u64, Frame)> {
        if let Schedule::Nodes(nodes) = &mut self.schedule {
            return nodes.bid(now_ns).map(|frame| (now_ns, frame));
        }
        if !self.started {
            self.started = true;
            self.start_ns = now_ns;
            self.due_ns = now_ns as f64;
        }
        if self.next.is_none() {
            self.next = self.waiting.pop_front().or_else(|| self.plan(now_ns, bitrate_bps));
        }
        self.next
    }

    /// Nobody listened for this long, so nobody sent: everything planned is postponed, so that it does not come
    /// all at once.
    pub fn postpone(&mut self, by_ns: u64) {
        self.start_ns += by_ns;
        self.due_ns += by_ns as f64;
        for (due_ns, _) in self.next.iter_mut().chain(&mut self.waiting) {
            *due_ns += by_ns;
        }
    }

    /// The frame is on the bus.
    pub fn take(&mut self, now_ns: u64) {
        self.next = None;
        if let Schedule::Nodes(nodes) = &mut self.schedule {
            nodes.take(now_ns);
        }
    }

    /// The frame has ended well.
    pub fn delivered(&mut self) {
        if let Schedule::Nodes(nodes) = &mut self.schedule {
            nodes.delivered();
        }
    }

    /// Another node's frame has ended well.
    pub fn hear(&mut self, frame: &Frame, now_ns: u64) {
        if let Schedule::Nodes(nodes) = &mut self.schedule {
            nodes.hear(frame, now_ns);
        }
    }

    /// The frame was destroyed: it is sent again as soon as the bus is free.
    pub fn put_back(&mut self, frame: Frame, now_ns: u64) {
        if let Schedule::Nodes(nodes) = &mut self.schedule {
            return nodes.destroyed(&frame, now_ns);
        }
        if let Some((at_ns, next)) = self.next.replace((0, frame)) {
            self.waiting.push_front((at_ns, next));
        }
    }

    fn plan(&mut self, now_ns: u64, bitrate_bps: u32) -> Option<(u64, Frame)> {
        match &mut self.schedule {
            // Nodes are queried each time.
            Schedule::Silent | Schedule::Nodes(_) => None,
            Schedule::Load { source, percent } => {
                let frame = source.next()?;
                if *percent >= 100.0 {
                    return Some((now_ns, frame));
                }
                let due_ns = self.due_ns.max(0.0);
                self.due_ns += FrameBits::of(&frame).duration_ns(bitrate_bps) as f64 * 100.0 / *percent;
                Some((due_ns as u64, frame))
            }
            Schedule::Bursts { source, length, period_ns } => {
                let burst = self.count / u64::from((*length).max(1));
                self.count += 1;
                Some((self.start_ns + burst * *period_ns, source.next()?))
            }
            Schedule::Log { entries } => {
                let (at_ns, frame) = entries.next()?;
                Some((self.start_ns + at_ns, frame))
            }
        }
    }
}
