//! Equal frames on both channels: which wait, and which were paired since one was last alone.

use std::collections::VecDeque;

use cantap_trace::Id;

/// A frame of the first channel that waits for its other.
#[derive(Clone, Copy, Debug)]
pub struct Waiting {
    pub number: u64,
    pub time_ns: i64,
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
        (self.time_ns..=self.deadline_ns).contains(&to_ns)
    }
}

/// A pair; which of the run's delays is whose is decided when the run ends.
#[derive(Clone, Copy, Debug)]
pub struct Pair {
    pub from: Waiting,
    pub to_ns: i64,
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
    last_ns: Option<i64>,
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
    causes.sort_by_key(|from| from.time_ns);
    pairs.sort_by_key(|pair| pair.to_ns);
    pairs.iter_mut().zip(causes).for_each(|(pair, from)| pair.from = from);
    pairs
}

impl Run {
    /// A frame on the first channel; returns how long before the one before it came.
    pub fn push(&mut self, waiting: Waiting) {
        self.last_ns = Some(self.last_ns.map_or(waiting.time_ns, |last| last.max(waiting.time_ns)));
        let at = self.waiting.partition_point(|other| other.time_ns <= waiting.time_ns);
        self.waiting.insert(at, waiting);
    }

    /// The newest frame before a time, in nanoseconds.
    pub fn last_before(&self, time_ns: i64) -> Option<i64> {
        self.last_ns.filter(|last| *last <= time_ns)
    }

    /// The time of the nearest frame that waits for one at `to_ns`.
    pub fn nearest(&self, to_ns: i64) -> Option<i64> {
        self.position(to_ns).map(|at| self.waiting[at].time_ns)
    }

    fn position(&self, to_ns: i64) -> Option<usize> {
        self.waiting.iter().rposition(|from| from.takes(to_ns))
    }

    /// Pairs it with the nearest, or, if none is left for it, with one that was paired and is replaced there by one that waits.
    pub fn pair(&mut self, to_ns: i64, to_late: bool) -> Option<Ended> {
        if let Some(from) = self.position(to_ns).and_then(|at| self.waiting.remove(at)) {
            self.pairs.push(Pair { from, to_ns, to_late });
        } else {
            let (at, pairs) = self.rearranged(to_ns, to_late)?;
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
    pub fn has_one_for(&self, to_ns: i64, to_late: bool) -> bool {
        self.position(to_ns).is_some() || self.rearranged(to_ns, to_late).is_some()
    }

    /// All pairs with one more, and the place of the waiting frame that this takes.
    fn rearranged(&self, to_ns: i64, to_late: bool) -> Option<(usize, Vec<Pair>)> {
        if self.pairs.is_empty() || self.pairs.len() + self.waiting.len() > MOST_REARRANGED {
            return None;
        }
        (0..self.waiting.len()).rev().find_map(|at| {
            let mut pairs = self.pairs.clone();
            pairs.push(Pair { from: self.waiting[at], to_ns, to_late });
            let pairs = in_order(pairs);
            pairs.iter().all(|pair| pair.from.takes(pair.to_ns)).then_some((at, pairs))
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
        self.waiting.is_empty() && self.pairs.is_empty() && self.last_ns.is_none_or(|last| last <= time_ns)
    }
}
