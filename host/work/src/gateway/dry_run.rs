//! Applies rules to a trace, with what applies them in a device.

use cantap::Channel;
use cantap::wire::Frame;
use cantap::wire::message::{MAX_RULE_COUNTS, RuleCounts};
use cantap_firmware::TICK_HZ;
use cantap_firmware::bus::gateway::{Lane, other};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

use super::Rules;

/// Ticks of a device's clock in a second.
const TICKS: i128 = TICK_HZ as i128;
const NS_PER_S: i128 = 1_000_000_000;

/// A frame that a gateway would have sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sent {
    /// When: at once if the other bus is free.
    pub time_ns: i64,
    /// The channel that sends it.
    pub channel: Channel,
    /// The frame.
    pub frame: Frame,
}

impl Sent {
    /// As a trace has it.
    pub fn record(&self) -> TraceRecord {
        let event = TraceEvent::Frame { frame: self.frame.into(), direction: Direction::Tx, late: false };
        TraceRecord { time_ns: self.time_ns, device_ns: None, channel: self.channel.number(), event }
    }
}

/// What became of frames.
#[derive(Clone, Debug, Default)]
pub struct DryRunCounts {
    /// By rule, in the file's order, and how many frames it changed. `failed` is 0.
    pub rules: Vec<(RuleCounts, u64)>,
    /// By channel, frames that no rule matched.
    pub unmatched: [u64; 2],
    /// Frames that no device with classical CAN receives: FD, and of other channels.
    pub not_received: u64,
}

/// A gateway that receives a trace, between buses that are never busy.
pub struct DryRun {
    rules: Rules,
    /// By the channel that receives.
    lanes: [Box<Lane>; 2],
    /// For each place of a lane, the frames that were changed.
    changed: [Vec<u64>; 2],
    start_ns: Option<i64>,
    now_ns: i64,
    not_received: u64,
}

impl DryRun {
    /// Nothing has been received.
    pub fn new(rules: Rules) -> Self {
        let lanes = Channel::ALL.map(|from| {
            let mut lane = Box::new(Lane::new());
            for (slot, rule) in rules.of_device(from, TICK_HZ).into_iter().enumerate() {
                // Cannot fail: [`Rules`] has seen to it that they fit.
                lane.set_rule(slot, Some(rule));
            }
            lane
        });
        let changed = [0, 1].map(|lane| vec![0; lanes[lane].rules()]);
        Self { rules, lanes, changed, start_ns: None, now_ns: i64::MIN, not_received: 0 }
    }

    /// Takes a record of the trace; adds what is sent until then, in order of time.
    pub fn push(&mut self, record: &TraceRecord, sent: &mut Vec<Sent>) {
        self.start_ns.get_or_insert(record.time_ns);
        // A clock that was set back does not make the device's go back.
        self.now_ns = self.now_ns.max(record.time_ns);
        self.release(self.ticks(self.now_ns), sent);
        let TraceEvent::Frame { frame, .. } = &record.event else { return };
        let from = Channel::ALL.into_iter().find(|channel| channel.number() == record.channel);
        let Some((from, frame)) = from.zip(frame.classic()) else {
            self.not_received += 1;
            return;
        };
        let now = self.ticks(self.now_ns);
        let slot = self.slot(from, frame);
        if let Some(slot) = slot
            && let Some(pass) = self.lanes[from.index()].rule(slot).and_then(|rule| rule.pass.as_ref())
        {
            let changes = pass.changed(frame) != Some(*frame) || !pass.modifiers.is_empty();
            self.changed[from.index()][slot] += u64::from(changes);
        }
        let lane = &mut self.lanes[from.index()];
        lane.admit(frame, now);
        take(lane, from, self.now_ns, now, sent);
    }

    /// The trace is at its end: what still waits is sent, and what became of all is counted.
    pub fn finish(mut self, sent: &mut Vec<Sent>) -> DryRunCounts {
        self.release(u64::MAX - 1, sent);
        let mut rules = vec![(RuleCounts::default(), 0); self.rules.rules.len()];
        let mut unmatched = [0; 2];
        for from in Channel::ALL {
            let lane = &self.lanes[from.index()];
            unmatched[from.index()] = u64::from(lane.counts(0).0);
            let slots = (0..).step_by(MAX_RULE_COUNTS).take_while(|first| *first < lane.rules());
            let counts = slots.flat_map(|first| lane.counts(first).1);
            for ((number, counts), changed) in
                self.rules.places(from).zip(counts).zip(&self.changed[from.index()])
            {
                let (sum, all_changed) = &mut rules[number];
                sum.matched += counts.matched;
                sum.sent += counts.sent;
                sum.overtaken += counts.overtaken;
                sum.lost += counts.lost;
                *all_changed += changed;
            }
        }
        DryRunCounts { rules, unmatched, not_received: self.not_received }
    }

    fn slot(&self, from: Channel, frame: &Frame) -> Option<usize> {
        let lane = &self.lanes[from.index()];
        (0..lane.rules()).find(|slot| lane.rule(*slot).is_some_and(|rule| rule.filter.matches(frame)))
    }

    /// Device time: from the trace's start.
    fn ticks(&self, time_ns: i64) -> u64 {
        let since = i128::from(time_ns) - i128::from(self.start_ns.unwrap_or(time_ns));
        u64::try_from(since * TICKS / NS_PER_S).unwrap_or(0)
    }

    fn nanoseconds(&self, ticks: u64) -> i64 {
        let since = i128::from(ticks) * NS_PER_S / TICKS;
        i64::try_from(i128::from(self.start_ns.unwrap_or(0)) + since).unwrap_or(i64::MAX)
    }

    /// Sends what becomes due until `now`.
    fn release(&mut self, now: u64, sent: &mut Vec<Sent>) {
        let before = sent.len();
        for from in Channel::ALL {
            while self.lanes[from.index()].due() <= now {
                let due = self.lanes[from.index()].due();
                let time_ns = self.nanoseconds(due);
                let lane = &mut self.lanes[from.index()];
                lane.release(due);
                take(lane, from, time_ns, due, sent);
            }
        }
        sent[before..].sort_by_key(|sent| sent.time_ns);
    }
}

/// What is ready is sent at once: the other bus is free.
fn take(lane: &mut Lane, from: Channel, time_ns: i64, now: u64, sent: &mut Vec<Sent>) {
    while let Some(&(slot, frame)) = lane.next() {
        lane.loaded();
        lane.ended(usize::from(slot), Some((frame, now)));
        sent.push(Sent { time_ns, channel: other(from), frame });
    }
}
