//! Takes records, finds frames again, and counts.

use std::cmp::Reverse;
use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, BinaryHeap, HashMap, VecDeque};

use cantap_trace::{Id, LossStage, Moment, TraceEvent, TraceFrame, TraceRecord};

use super::run::{Pair, Run, Waiting};
use super::{DelayOptions, Expected, Figures, Key, MOST_IDS, Outcome};

/// Records of two channels may be this much out of order.
const DISORDER_NS: i64 = 10_000_000;
/// Steps of stamps below this are of no interest.
const FINE_NS: u64 = 1_000;

/// A frame of the second channel for which none of the first waited.
struct Extra {
    at: Moment,
    frame: TraceFrame,
    late: bool,
    counts: bool,
}

/// From the last frame before a loss to the first one after it, in nanoseconds.
struct Gap {
    from_ns: i64,
    until_ns: Option<i64>,
}

/// What is known of one of the channels.
#[derive(Default)]
struct Side {
    last_ns: Option<i64>,
    gaps: VecDeque<Gap>,
}

impl Side {
    fn frame(&mut self, time_ns: i64) {
        if let Some(gap) = self.gaps.back_mut().filter(|gap| gap.until_ns.is_none()) {
            gap.until_ns = Some(time_ns);
        }
        self.last_ns = Some(time_ns);
    }

    fn lost(&mut self, start_ns: i64) {
        if self.gaps.back().is_none_or(|gap| gap.until_ns.is_some()) {
            self.gaps.push_back(Gap { from_ns: self.last_ns.unwrap_or(start_ns), until_ns: None });
        }
    }

    fn has_gap(&self, from_ns: i64, until_ns: i64) -> bool {
        self.gaps
            .iter()
            .any(|gap| gap.from_ns <= until_ns && gap.until_ns.is_none_or(|until| until >= from_ns))
    }

    fn forget_before(&mut self, time_ns: i64) {
        while self.gaps.front().is_some_and(|gap| gap.until_ns.is_some_and(|until| until < time_ns)) {
            self.gaps.pop_front();
        }
    }
}

/// Finds the frames of one channel again on another.
///
/// Records must be in order of time, each channel's at least; between channels 10 ms of disorder do no harm.
pub struct Matching<M> {
    options: DelayOptions,
    /// What is expected for a frame of the first channel; `None` if nothing is.
    map: M,
    now_ns: i64,
    start_ns: Option<i64>,
    first_ns: i64,
    number: u64,
    runs: HashMap<Key, Run>,
    /// The bits that are unknown in frames of an identifier, in all ways that are expected.
    unknown: HashMap<Id, Vec<[u8; 8]>>,
    /// When to decide on the frame of a number.
    deadlines: BinaryHeap<Reverse<(i64, u64)>>,
    /// Where it waits or waited, and since when.
    keys: HashMap<u64, (Key, i64)>,
    extras: VecDeque<Extra>,
    newest_of_rule: HashMap<usize, (i64, u64)>,
    from: Side,
    to: Side,
    longest_ns: i64,
    step_ns: u64,
    total: Figures,
    ids: BTreeMap<Id, Figures>,
    outcome: Outcome,
}

impl<M: FnMut(&TraceFrame) -> Option<Expected>> Matching<M> {
    /// Begins. `map` says what is expected on the second channel for a frame of the first; it is called for each, in order.
    pub fn new(options: DelayOptions, map: M) -> Self {
        Self {
            options,
            map,
            now_ns: i64::MIN,
            start_ns: None,
            first_ns: 0,
            number: 0,
            runs: HashMap::new(),
            unknown: HashMap::new(),
            deadlines: BinaryHeap::new(),
            keys: HashMap::new(),
            extras: VecDeque::new(),
            newest_of_rule: HashMap::new(),
            from: Side::default(),
            to: Side::default(),
            longest_ns: options.within_ns,
            step_ns: 0,
            total: Figures::default(),
            ids: BTreeMap::new(),
            outcome: Outcome::default(),
        }
    }

    /// Takes the next record. `counts` is false for one that a filter hides: on the first channel it is not expected, on the second it can be what
    /// a frame is found as, and is never extra.
    pub fn push(&mut self, record: &TraceRecord, counts: bool) {
        let time_ns = record.time_ns;
        // Two traces were joined, or the clock was set back.
        if self.start_ns.is_some()
            && time_ns < self.now_ns.saturating_sub(self.longest_ns.saturating_add(DISORDER_NS))
        {
            self.end();
            self.outcome.breaks += 1;
            (self.start_ns, self.now_ns) = (None, i64::MIN);
        }
        if self.start_ns.is_none() {
            self.start_ns = Some(time_ns);
            self.first_ns = time_ns;
        }
        let in_order = time_ns >= self.now_ns;
        self.now_ns = self.now_ns.max(time_ns);
        self.advance(self.now_ns.saturating_sub(DISORDER_NS));
        let (is_from, is_to) = (record.channel == self.options.from, record.channel == self.options.to);
        if !is_from && !is_to {
            return;
        }
        match &record.event {
            TraceEvent::Frame { frame, late, .. } => {
                self.step_ns = gcd(self.step_ns, time_ns.abs_diff(self.first_ns));
                if is_from {
                    self.from.frame(time_ns);
                    self.take_from(record.moment(), frame, *late, counts, in_order);
                } else {
                    self.to.frame(time_ns);
                    self.take_to(record.moment(), frame, *late, counts);
                }
            }
            event @ TraceEvent::Lost { stage, .. } => {
                if *event == TraceEvent::UNCOUNTED {
                    self.outcome.uncounted = true;
                } else if *stage != GATEWAY_STAGE {
                    let side = if is_from { &mut self.from } else { &mut self.to };
                    side.lost(self.start_ns.unwrap_or(time_ns));
                }
            }
            _ => {}
        }
    }

    /// How much is kept at the moment.
    #[cfg(test)]
    pub(super) fn remembered(&self) -> usize {
        self.runs.len() + self.keys.len() + self.deadlines.len() + self.extras.len()
    }

    /// The trace is at its end.
    pub fn finish(mut self) -> Outcome {
        self.end();
        self.outcome.step_ns = Some(self.step_ns).filter(|step| *step >= FINE_NS);
        self.outcome.total = self.total;
        self.outcome.ids = self.ids.into_iter().collect();
        self.outcome
    }

    fn take_from(&mut self, at: Moment, frame: &TraceFrame, late: bool, counts: bool, in_order: bool) {
        let time_ns = at.time_ns;
        // The map has to see each frame: rules may count.
        let Some(expected) = (self.map)(frame).filter(|_| counts) else {
            self.outcome.not_expected += 1;
            return;
        };
        let key = Key::new(&expected.frame, expected.unknown);
        if expected.unknown != [0; 8] {
            let known = self.unknown.entry(expected.frame.id()).or_default();
            if !known.contains(&expected.unknown) {
                known.push(expected.unknown);
            }
        }
        let allowed =
            self.options.within_ns.saturating_add(expected.period_ns).saturating_add(expected.held_ns);
        self.longest_ns = self.longest_ns.max(allowed);
        self.number += 1;
        let number = self.number;
        if let Some((before_ns, before)) = self.newest_of_rule.insert(expected.rule, (time_ns, number))
            && expected.period_ns > 0
            && time_ns.saturating_sub(before_ns) <= expected.period_ns
            && let Some(run) = self.keys.get(&before).and_then(|(key, _)| self.runs.get_mut(key))
        {
            run.set_replaceable(before);
        }
        let run = self.runs.entry(key).or_default();
        let repeat_ns = run.last_before(time_ns).map(|last| at.since_ns(last)).filter(|gap| *gap <= allowed);
        let deadline_ns = time_ns.saturating_add(allowed);
        let id = frame.id();
        run.push(Waiting { number, at, deadline_ns, id, late, repeat_ns, replaceable: false });
        // One window later than it can be found: a pair of equal frames may still have to be changed for another.
        self.deadlines.push(Reverse((deadline_ns.saturating_add(allowed), number)));
        self.keys.insert(number, (key, time_ns));
        if !in_order {
            self.look_back(time_ns, deadline_ns, &key);
        }
    }

    /// A frame of the second channel may stand before its cause, if the trace is not in order.
    fn look_back(&mut self, from_ns: i64, until_ns: i64, key: &Key) {
        let found = self.extras.iter().position(|extra| {
            (from_ns..=until_ns).contains(&extra.at.time_ns) && Key::new(&extra.frame, key.unknown) == *key
        });
        if let Some(extra) = found.and_then(|at| self.extras.remove(at)) {
            self.pair(*key, extra.at, extra.late);
        }
    }

    fn take_to(&mut self, at: Moment, frame: &TraceFrame, late: bool, counts: bool) {
        let none = [0; 8];
        let ways = self.unknown.get(&frame.id()).into_iter().flatten();
        let keys = std::iter::once(&none).chain(ways).map(|unknown| Key::new(frame, *unknown));
        let runs: Vec<_> = keys.filter_map(|key| Some((self.runs.get(&key)?, key))).collect();
        let nearest = runs.iter().filter_map(|(run, key)| Some((run.nearest(at.time_ns)?, *key)));
        let found = nearest.max_by_key(|(from_ns, _)| *from_ns).map(|(_, key)| key);
        let found =
            found.or_else(|| runs.iter().find(|(run, _)| run.has_one_for(at, late)).map(|(_, key)| *key));
        match found {
            Some(key) => self.pair(key, at, late),
            None => self.extras.push_back(Extra { at, frame: *frame, late, counts }),
        }
    }

    fn pair(&mut self, key: Key, to: Moment, to_late: bool) {
        if let Some(ended) = self.runs.get_mut(&key).and_then(|run| run.pair(to, to_late)) {
            for pair in &ended.pairs {
                self.count_pair(pair, ended.is_certain);
            }
        }
    }

    fn count_pair(&mut self, pair: &Pair, is_certain: bool) {
        let delay = pair.to.interval_since(pair.from.at);
        self.count(pair.from.id, |figures| {
            figures.matched += 1;
            figures.late += u64::from(pair.from.late || pair.to_late);
            if let Some(repeat) = pair.from.repeat_ns {
                figures.repeated += 1;
                figures.shortest_repeat_ns =
                    Some(figures.shortest_repeat_ns.map_or(repeat, |shortest| shortest.min(repeat)));
            }
            if is_certain {
                figures.delays.add(delay.ns.max(0).unsigned_abs());
                figures.by_device += u64::from(delay.by_device);
            } else {
                figures.ambiguous += 1;
            }
        });
    }

    fn count(&mut self, id: Id, mut add: impl FnMut(&mut Figures)) {
        add(&mut self.total);
        let has_room = self.ids.len() < MOST_IDS;
        match self.ids.get_mut(&id) {
            Some(figures) => add(figures),
            None if has_room => add(self.ids.entry(id).or_default()),
            None => self.outcome.beyond += 1,
        }
    }

    /// Decides what was due before a time.
    fn advance(&mut self, until_ns: i64) {
        while let Some(Reverse((deadline_ns, number))) = self.deadlines.peek().copied()
            && deadline_ns < until_ns
        {
            self.deadlines.pop();
            self.expire(number, false);
        }
        let longest_ns = self.longest_ns;
        while self.extras.front().is_some_and(|extra| extra.at.time_ns.saturating_add(longest_ns) < until_ns)
        {
            self.judge_extra();
        }
        let old_ns = until_ns.saturating_sub(longest_ns.saturating_mul(2).saturating_add(DISORDER_NS));
        self.from.forget_before(old_ns);
        self.to.forget_before(old_ns);
    }

    fn expire(&mut self, number: u64, at_end: bool) {
        let Some((key, since_ns)) = self.keys.remove(&number) else { return };
        let Entry::Occupied(mut entry) = self.runs.entry(key) else { return };
        let expired = entry.get_mut().expire(number);
        if entry.get().is_over(since_ns) {
            entry.remove();
        }
        let Some((waiting, pairs)) = expired else { return };
        for pair in pairs {
            self.count_pair(&pair, false);
        }
        let may_come = at_end && waiting.deadline_ns >= self.now_ns;
        let was_lost = self.to.has_gap(waiting.at.time_ns, waiting.deadline_ns);
        self.count(waiting.id, |figures| {
            let count = if waiting.replaceable {
                &mut figures.replaced
            } else if may_come {
                &mut figures.undecided.end
            } else if was_lost {
                &mut figures.undecided.loss
            } else {
                &mut figures.missing
            };
            *count += 1;
        });
    }

    fn judge_extra(&mut self) {
        let Some(extra) = self.extras.pop_front() else { return };
        if !extra.counts {
            return;
        }
        let earliest_ns = extra.at.time_ns.saturating_sub(self.longest_ns);
        let before_start = self.start_ns.is_some_and(|start| earliest_ns < start);
        let was_lost = self.from.has_gap(earliest_ns, extra.at.time_ns);
        self.count(extra.frame.id(), |figures| {
            let count = if was_lost {
                &mut figures.undecided.loss
            } else if before_start {
                &mut figures.undecided.start
            } else {
                &mut figures.extra
            };
            *count += 1;
        });
    }

    /// Nothing comes after this: the trace's end, or a break in it.
    fn end(&mut self) {
        while let Some(Reverse((_, number))) = self.deadlines.pop() {
            self.expire(number, true);
        }
        while !self.extras.is_empty() {
            self.judge_extra();
        }
        self.runs.clear();
        self.newest_of_rule.clear();
        (self.from, self.to) = (Side::default(), Side::default());
    }
}

/// Frames that a gateway itself lost are missing.
const GATEWAY_STAGE: Option<LossStage> = Some(LossStage::Gateway);

fn gcd(a: u64, b: u64) -> u64 {
    let (mut a, mut b) = (a, b);
    while b != 0 {
        (a, b) = (b, a % b);
    }
    a
}
