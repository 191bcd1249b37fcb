//! Equal frames on both channels: which wait, and which were paired since one was last alone.

use std::collections::VecDeque;

use cantap_trace::{Id, Moment};

/// A frame of the first channel that waits for its other.
#[derive(Clone, Copy, Debug)]
pub struct Waiting {
    pub number: u64,
    pub at: Moment,
    pub deadline_ns: i64,
    pub id: Id,
    pub late: bool,
    /// How long before an equal one came, within the window.
    pub repeat_ns: Option<i64>,
    /// A newer frame of its rule came within the period.
    pub replaceable: bool,
}

impl Waiting {
    /// Whether it can be found as a frame at this time.
    fn takes(&self, to_ns: i64) -> bool {
        (self.at.time_ns..=self.deadline_ns).contains(&to_ns)
    }
}

/// A pair; which of the run's delays is whose is decided when the run ends.
#[derive(Clone, Copy, Debug)]
pub struct Pair {
    pub from: Waiting,
    pub to: Moment,
    pub to_late: bool,
}

/// Frames that are all alike.
#[derive(Debug, Default)]
pub struct Run {
    /// In order of time.
    waiting: VecDeque<Waiting>,
    pairs: Vec<Pair>,
    /// A pair had to be changed afterwards: another reading of the trace is as good.
    is_rearranged: bool,
    last: Option<Moment>,
}

/// No frame of a run waits any more.
pub struct Ended {
    pub pairs: Vec<Pair>,
    pub is_certain: bool,
}

/// In longer runs of equal frames, pairs stay as they are.
const MOST_REARRANGED: usize = 256;

/// The same frames, first with first and last with last.
fn in_order(mut pairs: Vec<Pair>) -> Vec<Pair> {
    let mut causes: Vec<_> = pairs.iter().map(|pair| pair.from).collect();
    causes.sort_by_key(|from| from.at.time_ns);
    pairs.sort_by_key(|pair| pair.to.time_ns);
    pairs.iter_mut().zip(causes).for_each(|(pair, from)| pair.from = from);
    pairs
}

impl Run {
    /// A frame on the first channel.
    pub fn push(&mut self, waiting: Waiting) {
        let time_ns = waiting.at.time_ns;
        if self.last.is_none_or(|last| last.time_ns < time_ns) {
            self.last = Some(waiting.at);
        }
        let at = self.waiting.partition_point(|other| other.at.time_ns <= time_ns);
        self.waiting.insert(at, waiting);
    }

    /// When the newest frame before a time came.
    pub fn last_before(&self, time_ns: i64) -> Option<Moment> {
        self.last.filter(|last| last.time_ns <= time_ns)
    }

    /// The time of the nearest frame that waits for one at `to_ns`.
    pub fn nearest(&self, to_ns: i64) -> Option<i64> {
        self.position(to_ns).map(|at| self.waiting[at].at.time_ns)
    }

    fn position(&self, to_ns: i64) -> Option<usize> {
        self.waiting.iter().rposition(|from| from.takes(to_ns))
    }

    /// Pairs it with the nearest, or, if none is left for it, with one that was paired and is replaced there by one that waits.
    pub fn pair(&mut self, to: Moment, to_late: bool) -> Option<Ended> {
        if let Some(from) = self.position(to.time_ns).and_then(|at| self.waiting.remove(at)) {
            self.pairs.push(Pair { from, to, to_late });
        } else {
            let (at, pairs) = self.rearranged(to, to_late)?;
            self.waiting.remove(at);
            (self.pairs, self.is_rearranged) = (pairs, true);
        }
        if !self.waiting.is_empty() {
            return None;
        }
        let is_certain = !std::mem::take(&mut self.is_rearranged);
        Some(Ended { pairs: in_order(std::mem::take(&mut self.pairs)), is_certain })
    }

    /// Whether [`Self::pair`] has a frame for it.
    pub fn has_one_for(&self, to: Moment, to_late: bool) -> bool {
        self.position(to.time_ns).is_some() || self.rearranged(to, to_late).is_some()
    }

    /// All pairs with one more, and the place of the waiting frame that this takes.
    fn rearranged(&self, to: Moment, to_late: bool) -> Option<(usize, Vec<Pair>)> {
        if self.pairs.is_empty() || self.pairs.len() + self.waiting.len() > MOST_REARRANGED {
            return None;
        }
        (0..self.waiting.len()).rev().find_map(|at| {
            let mut pairs = self.pairs.clone();
            pairs.push(Pair { from: self.waiting[at], to, to_late });
            let pairs = in_order(pairs);
            pairs.iter().all(|pair| pair.from.takes(pair.to.time_ns)).then_some((at, pairs))
        })
    }

    /// The frame of this number, if it still waits: taken out, with the pairs of which it is now unknown which is whose.
    pub fn expire(&mut self, number: u64) -> Option<(Waiting, Vec<Pair>)> {
        let at = self.waiting.iter().position(|from| from.number == number)?;
        self.is_rearranged = false;
        Some((self.waiting.remove(at)?, std::mem::take(&mut self.pairs)))
    }

    /// A newer frame of its rule may replace it.
    pub fn set_replaceable(&mut self, number: u64) {
        if let Some(from) = self.waiting.iter_mut().find(|from| from.number == number) {
            from.replaceable = true;
        }
    }

    /// Nothing waits, and nothing came since `time_ns`.
    pub fn is_over(&self, time_ns: i64) -> bool {
        self.waiting.is_empty()
            && self.pairs.is_empty()
            && self.last.is_none_or(|last| last.time_ns <= time_ns)
    }
}
