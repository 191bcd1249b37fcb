//! What a simulated host takes of what its device has for it: nothing while it stalls, and not the frames that it loses.

use std::collections::VecDeque;

use cantap_can::LossStage;

use crate::faults::Losing;

/// Frames that the device of a host that stalls keeps for it.
pub const MOST_WAITING: usize = 4096;

/// Frames that are lost on purpose.
#[derive(Clone, Copy, Debug, Default)]
pub struct Losses {
    frames: u64,
    until_ns: u64,
}

impl Losses {
    /// These too.
    pub const fn add(&mut self, losing: Losing, now_ns: u64) {
        match losing {
            Losing::Frames(frames) => self.frames = self.frames.saturating_add(frames),
            Losing::For(for_ns) => self.until_ns = now_ns.saturating_add(for_ns),
        }
    }

    /// Whether the next frame is one of them.
    pub fn take(&mut self, now_ns: u64) -> bool {
        let is_counted = now_ns >= self.until_ns && self.frames > 0;
        self.frames -= u64::from(is_counted);
        is_counted || now_ns < self.until_ns
    }
}

/// The way to one host.
#[derive(Debug)]
pub struct Intake<T> {
    stalled_until_ns: u64,
    waiting: VecDeque<T>,
    frames_waiting: usize,
    losses: Losses,
}

/// What becomes of something on its way to a host.
#[derive(Debug, PartialEq, Eq)]
pub enum Taken<T> {
    /// The host has it.
    Now(T),
    /// It waits for the host.
    Later,
    /// It was lost there.
    Lost(LossStage),
}

impl<T> Intake<T> {
    pub const fn new() -> Self {
        Self {
            stalled_until_ns: 0,
            waiting: VecDeque::new(),
            frames_waiting: 0,
            losses: Losses { frames: 0, until_ns: 0 },
        }
    }

    /// The host takes nothing before this time.
    pub const fn stall_until(&mut self, until_ns: u64) {
        if until_ns > self.stalled_until_ns {
            self.stalled_until_ns = until_ns;
        }
    }

    /// When the host does something again; 0 if it does not stall.
    pub const fn stalled_until_ns(&self) -> u64 {
        self.stalled_until_ns
    }

    /// When it takes what waits for it, if anything does.
    pub fn due_ns(&self) -> Option<u64> {
        (!self.waiting.is_empty()).then_some(self.stalled_until_ns)
    }

    /// Loses frames.
    pub const fn lose(&mut self, losing: Losing, now_ns: u64) {
        self.losses.add(losing, now_ns);
    }

    /// Another node's frame is on its way to the host, which loses it anyway if `is_lost`.
    pub fn take_frame(&mut self, now_ns: u64, frame: T, is_lost: bool) -> Taken<T> {
        if self.losses.take(now_ns) || is_lost {
            return Taken::Lost(LossStage::Host);
        }
        if !self.is_waiting(now_ns) {
            return Taken::Now(frame);
        }
        if self.frames_waiting >= MOST_WAITING {
            return Taken::Lost(LossStage::Queue);
        }
        self.frames_waiting += 1;
        self.waiting.push_back(frame);
        Taken::Later
    }

    /// Something else is on its way, which takes no place: returns it if the host takes it now.
    pub fn take_other(&mut self, now_ns: u64, other: T) -> Option<T> {
        if !self.is_waiting(now_ns) {
            return Some(other);
        }
        self.waiting.push_back(other);
        None
    }

    /// What comes last of what waits.
    pub fn last_waiting(&mut self) -> Option<&mut T> {
        self.waiting.back_mut()
    }

    /// The next of what waited, when the host goes on.
    pub fn next(&mut self, now_ns: u64) -> Option<T> {
        if now_ns < self.stalled_until_ns {
            return None;
        }
        self.frames_waiting = 0;
        self.waiting.pop_front()
    }

    /// Nothing waits any more, and the host does not stall.
    pub fn clear(&mut self) {
        *self = Self::new();
    }

    fn is_waiting(&self, now_ns: u64) -> bool {
        now_ns < self.stalled_until_ns || !self.waiting.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_that_stalls_gets_what_its_device_kept_in_order_and_the_rest_is_lost() {
        let mut intake = Intake::new();
        assert_eq!(intake.take_frame(0, 7, false), Taken::Now(7));
        intake.stall_until(10);
        for frame in 0..MOST_WAITING {
            assert_eq!(intake.take_frame(5, frame, false), Taken::Later);
        }
        assert_eq!(intake.take_frame(6, 0, false), Taken::Lost(LossStage::Queue));
        assert_eq!(intake.take_other(7, 9999), None);
        assert_eq!((intake.due_ns(), intake.next(9)), (Some(10), None));
        let all: Vec<usize> = std::iter::from_fn(|| intake.next(10)).collect();
        assert_eq!(all.len(), MOST_WAITING + 1);
        assert_eq!((all[1], all[MOST_WAITING]), (1, 9999));
        assert_eq!(intake.take_frame(10, 3, false), Taken::Now(3));
    }

    #[test]
    fn frames_are_lost_by_number_and_by_time() {
        let mut losses = Losses::default();
        losses.add(Losing::For(10), 5);
        losses.add(Losing::Frames(2), 5);
        let lost: Vec<u64> = (5..20).filter(|now_ns| losses.take(*now_ns)).collect();
        assert_eq!(lost, (5..17).collect::<Vec<u64>>());
    }
}
