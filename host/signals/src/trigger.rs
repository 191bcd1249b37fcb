//! Keeps what happened around an event: a ring of records before it, and everything for a while after it.
//!
//! A [`Trigger`] sits between a source of records and their destination. Until its condition holds, it
//! remembers the last records and passes nothing on; then it passes on the remembered ones and everything
//! that follows until the time after the event is over. Another event before that restarts the time.
//!
//! For a condition about signals alone, the event is when it begins to hold: `Speed > 80` occurs once,
//! however long the car stays fast. A condition about frames is an event for each frame for which it holds.

use std::collections::VecDeque;

use crate::condition::Condition;
use cantap_trace::TraceRecord;

/// How many records can be remembered: 96 MiB.
const MAX_REMEMBERED: usize = (96 << 20) / size_of::<TraceRecord>();

/// Which records a trigger keeps, by time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// How long before the event records are kept, in nanoseconds.
    pub pre_ns: i64,
    /// How long after the event records are kept, in nanoseconds.
    pub post_ns: i64,
    /// Only this many events count: later ones do not extend the time. `None` for all.
    pub events: Option<u64>,
}

/// Counts so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TriggerCounts {
    /// Number of events.
    pub events: u64,
    /// Number of records passed on.
    pub kept: u64,
    /// Number of records within the time before an event that had to be forgotten because of the limit.
    pub forgotten: u64,
}

/// Passes on records around events.
#[derive(Debug)]
pub struct Trigger {
    condition: Condition,
    window: Window,
    capacity: usize,
    ring: VecDeque<TraceRecord>,
    /// Number of records dropped from the full ring, by time of the last; they matter if an event follows
    /// soon.
    overflowed: VecDeque<(i64, u64)>,
    held: bool,
    /// Open until this time.
    open_until_ns: Option<i64>,
    counts: TriggerCounts,
}

impl Trigger {
    /// A trigger on `condition`.
    pub fn new(condition: Condition, window: Window) -> Self {
        Self::with_capacity(condition, window, MAX_REMEMBERED)
    }

    fn with_capacity(condition: Condition, window: Window, capacity: usize) -> Self {
        Self {
            condition,
            window,
            capacity,
            ring: VecDeque::new(),
            overflowed: VecDeque::new(),
            held: false,
            open_until_ns: None,
            counts: TriggerCounts::default(),
        }
    }

    /// Takes the next record; `keep` gets every record to be kept, in order and once.
    pub fn push<E>(
        &mut self,
        record: &TraceRecord,
        mut keep: impl FnMut(&TraceRecord) -> Result<(), E>,
    ) -> Result<(), E> {
        let now_ns = record.time_ns;
        self.forget_before(now_ns.saturating_sub(self.window.pre_ns));
        let holds = self.condition.holds(record);
        let is_event = holds && (!self.held || self.condition.is_about_frames());
        if is_event && self.window.events.is_none_or(|most| self.counts.events < most) {
            self.counts.events += 1;
            self.counts.forgotten += self.overflowed.drain(..).map(|(_, count)| count).sum::<u64>();
            self.open_until_ns = Some(now_ns.saturating_add(self.window.post_ns));
            for remembered in self.ring.drain(..) {
                self.counts.kept += 1;
                keep(&remembered)?;
            }
        }
        // An irrelevant record does not change the condition.
        if self.condition.was_concerned() {
            self.held = holds;
        }
        if self.open_until_ns.is_some_and(|until| now_ns <= until) {
            self.counts.kept += 1;
            return keep(record);
        }
        self.open_until_ns = None;
        self.remember(*record);
        Ok(())
    }

    fn remember(&mut self, record: TraceRecord) {
        if self.window.pre_ns == 0 {
            return;
        }
        self.ring.push_back(record);
        if self.ring.len() > self.capacity
            && let Some(oldest) = self.ring.pop_front()
        {
            /// Losses are counted in steps of this length, so that counting them does not itself take memory.
            const STEP_NS: i64 = 1_000_000;
            match self.overflowed.back_mut() {
                Some((since_ns, count)) if oldest.time_ns - *since_ns < STEP_NS => *count += 1,
                _ => self.overflowed.push_back((oldest.time_ns, 1)),
            }
        }
    }

    fn forget_before(&mut self, limit_ns: i64) {
        while self.ring.front().is_some_and(|record| record.time_ns < limit_ns) {
            self.ring.pop_front();
        }
        while self.overflowed.front().is_some_and(|&(time_ns, _)| time_ns < limit_ns) {
            self.overflowed.pop_front();
        }
    }

    /// Whether records are currently passed on.
    pub fn is_open(&self) -> bool {
        self.open_until_ns.is_some()
    }

    /// The counts so far.
    pub fn counts(&self) -> TriggerCounts {
        self.counts
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use super::*;
    use crate::{Decoder, Source, dbc};
    use cantap_trace::{Direction, TraceEvent};

    const SECOND: i64 = 1_000_000_000;

    /// One frame per second; its number is its first byte. Returns the numbers of those kept.
    fn kept(trigger: &mut Trigger, numbers: std::ops::Range<u8>) -> Vec<u8> {
        let mut kept = Vec::new();
        for number in numbers {
            let id = cantap_trace::Id::standard(1).unwrap();
            let frame = cantap_trace::Frame::data_frame(id, &[number]).unwrap().into();
            let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
            let record =
                TraceRecord { time_ns: i64::from(number) * SECOND, device_ns: None, channel: 1, event };
            let Ok(()) = trigger.push(&record, |record| {
                kept.push(record.frame().unwrap().data()[0]);
                Ok::<_, Infallible>(())
            });
        }
        kept
    }

    fn trigger(condition: &str, pre: i64, post: i64, capacity: usize) -> Trigger {
        let text = b"BO_ 1 M: 1 A\n SG_ Number : 0|8@1+ (1,0) [0|0] \"\" A\n";
        let database = dbc::parse("x.dbc", text).unwrap();
        let decoder = Decoder::new(vec![Source { channel: None, database }]);
        let condition = Condition::new(condition, &decoder).unwrap();
        Trigger::with_capacity(
            condition,
            Window { pre_ns: pre * SECOND, post_ns: post * SECOND, events: None },
            capacity,
        )
    }

    #[test]
    fn records_before_and_after_the_event_are_kept() {
        let mut trigger = trigger("byte[0] == 10", 2, 3, 100);
        assert_eq!(kept(&mut trigger, 0..30), [8, 9, 10, 11, 12, 13]);
        assert_eq!(trigger.counts(), TriggerCounts { events: 1, kept: 6, forgotten: 0 });
    }

    #[test]
    fn another_event_keeps_it_open_and_nothing_comes_twice() {
        let mut trigger = trigger("byte[0] == 10 or byte[0] == 12 or byte[0] == 16", 2, 3, 100);
        assert_eq!(kept(&mut trigger, 0..30), (8..20).collect::<Vec<_>>());
        assert_eq!(trigger.counts().events, 3);
    }

    #[test]
    fn a_signal_that_stays_is_one_event_and_frames_are_one_each() {
        let mut signal = trigger("Number >= 10", 0, 1, 100);
        assert_eq!(kept(&mut signal, 0..30), [10, 11]);
        assert_eq!(signal.counts().events, 1);
        let mut frames = trigger("byte[0] >= 10", 0, 1, 100);
        assert_eq!(kept(&mut frames, 0..30), (10..30).collect::<Vec<_>>());
        assert_eq!(frames.counts().events, 20);
    }

    #[test]
    fn the_only_event_that_counts_is_over_though_others_follow() {
        let mut once = trigger("byte[0] >= 10", 2, 3, 100);
        once.window.events = Some(1);
        assert_eq!(kept(&mut once, 0..30), [8, 9, 10, 11, 12, 13]);
        assert_eq!(once.counts().events, 1);
        assert!(!once.is_open());
    }

    #[test]
    fn memory_is_bounded_and_what_is_forgotten_is_counted() {
        let mut trigger = trigger("byte[0] == 50", 20, 0, 5);
        assert_eq!(kept(&mut trigger, 0..60), [45, 46, 47, 48, 49, 50]);
        assert_eq!(trigger.counts(), TriggerCounts { events: 1, kept: 6, forgotten: 15 });
    }
}
