//! One direction of a gateway: which of the frames that the other channel has received are sent on this one, how, and when.
//!
//! Belongs to the channel that sends. Only [`Lane::admit`] looks through the rules, once for each frame received, so its 32 comparisons are
//! the bound. Everything that waits has a fixed place; what finds none is counted by rule, and reported as lost.

use core::cmp::Ordering;

use cantap_wire::message::{GatewayRule, MAX_GATEWAY_RULES, MAX_RULE_COUNTS, RuleCounts};
use cantap_wire::{Channel, Frame};
use heapless::binary_heap::{BinaryHeap, Min};
use heapless::{Deque, Vec};

use crate::TICKS_PER_US;
use crate::bus::periodic::apply;
use crate::bus::time::NEVER;

/// Frames that wait for a mailbox: 7 ms of the longest at 1 Mbit/s.
pub const READY: usize = 64;
/// Frames that wait for their time, and rules that hold one back.
pub const LATER: usize = 128;
/// Frames that one call takes out of those that waited for their time. Those left are due, and make the alarm come again at once.
const RELEASED_AT_ONCE: usize = 4;

/// Both channels see the end of a frame on one bus at the same moment, and each stamp is late by a microsecond or two. No frame is shorter
/// than 47 µs, so this is never the one before.
const ECHO_WITHIN_TICKS: u64 = 8 * TICKS_PER_US as u64;
/// So many frames in a row, each received by the other channel as this one sent it, are a loop.
const ECHOES: u32 = 32;

/// What waits for its time.
struct Later {
    due: u64,
    /// Keeps those due at the same time in order; wraps, which swaps two of four billion.
    sequence: u32,
    rule: u8,
    /// `None`: the frame that the rule holds back.
    frame: Option<Frame>,
}

impl Ord for Later {
    fn cmp(&self, other: &Self) -> Ordering {
        (self.due, self.sequence).cmp(&(other.due, other.sequence))
    }
}

impl PartialOrd for Later {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Later {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Later {}

struct RuleState {
    rule: GatewayRule,
    counts: RuleCounts,
    /// Frames passed on so far, for counters.
    step: u32,
    /// Before this, a frame is held back.
    open_from: u64,
    held: Option<Frame>,
}

/// Whether what this channel sends comes back on the other.
struct Echo {
    sent: Option<(Frame, u64)>,
    received: Option<(Frame, u64)>,
    row: u32,
}

impl Echo {
    const fn new() -> Self {
        Self { sent: None, received: None, row: 0 }
    }

    fn is_one(a: Option<(Frame, u64)>, b: Option<(Frame, u64)>) -> bool {
        matches!((a, b), (Some(a), Some(b)) if a.1.abs_diff(b.1) <= ECHO_WITHIN_TICKS && a.0 == b.0)
    }

    fn count(&mut self) {
        self.row += 1;
        (self.sent, self.received) = (None, None);
    }

    /// The other channel has received a frame.
    fn received(&mut self, frame: Frame, at: u64) {
        self.received = Some((frame, at));
        if Self::is_one(self.sent, self.received) {
            self.count();
        }
    }

    /// This channel has sent a frame. Which of the two is noticed first depends on the tasks under way.
    fn sent(&mut self, frame: Frame, at: u64) {
        // The one before has not come back.
        if self.sent.is_some() {
            self.row = 0;
        }
        self.sent = Some((frame, at));
        if Self::is_one(self.sent, self.received) {
            self.count();
        }
    }
}

/// One direction: its rules, and the frames on their way. Some ten kilobytes, constructed in place, never on a stack.
pub struct Lane {
    rules: Vec<RuleState, MAX_GATEWAY_RULES>,
    unmatched: u32,
    ready: Deque<(u8, Frame), READY>,
    later: BinaryHeap<Later, Min, LATER>,
    sequence: u32,
    echo: Echo,
}

impl Lane {
    /// No rules.
    pub const fn new() -> Self {
        Self {
            rules: Vec::new(),
            unmatched: 0,
            ready: Deque::new(),
            later: BinaryHeap::new(),
            sequence: 0,
            echo: Echo::new(),
        }
    }

    /// Sets a rule, or removes it and all after it; false if there is no such slot.
    pub fn set_rule(&mut self, slot: usize, rule: Option<GatewayRule>) -> bool {
        if slot > self.rules.len() {
            return false;
        }
        let Some(rule) = rule else {
            self.rules.truncate(slot);
            return true;
        };
        let state = RuleState { rule, counts: RuleCounts::default(), step: 0, open_from: 0, held: None };
        match self.rules.get_mut(slot) {
            Some(place) => *place = state,
            None => return self.rules.push(state).is_ok(),
        }
        true
    }

    /// A rule.
    pub fn rule(&self, slot: usize) -> Option<&GatewayRule> {
        self.rules.get(slot).map(|state| &state.rule)
    }

    /// How many rules there are.
    pub fn rules(&self) -> usize {
        self.rules.len()
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.restart();
        self.rules.clear();
    }

    /// Nothing is on its way, and all counts are zero.
    pub fn restart(&mut self) {
        for state in &mut self.rules {
            (state.counts, state.step, state.open_from, state.held) = (RuleCounts::default(), 0, 0, None);
        }
        self.unmatched = 0;
        self.ready.clear();
        self.later.clear();
        self.echo = Echo::new();
    }

    /// Frames that no rule matched, and the counts of some rules.
    pub fn counts(&self, first: usize) -> (u32, Vec<RuleCounts, MAX_RULE_COUNTS>) {
        let counts = self.rules.iter().skip(first).take(MAX_RULE_COUNTS).map(|state| state.counts).collect();
        (self.unmatched, counts)
    }

    /// Frames on their way.
    pub fn waiting(&self) -> usize {
        self.ready.len() + self.later.len()
    }

    /// Whether a frame waits for a mailbox.
    #[inline]
    pub fn is_ready(&self) -> bool {
        !self.ready.is_empty()
    }

    /// When [`Self::release`] is to be called next.
    #[inline]
    pub fn due(&self) -> u64 {
        self.later.peek().map_or(NEVER, |first| first.due)
    }

    /// Whether both channels are on one bus.
    pub const fn is_loop(&self) -> bool {
        self.echo.row >= ECHOES
    }

    /// A frame that the other channel received at `at`. Returns how many frames were lost to make room: none or one.
    pub fn admit(&mut self, frame: &Frame, at: u64) -> u32 {
        self.echo.received(*frame, at);
        let Some(slot) = self.rules.iter().position(|state| state.rule.filter.matches(frame)) else {
            self.unmatched = self.unmatched.wrapping_add(1);
            return 0;
        };
        let state = &mut self.rules[slot];
        state.counts.matched = state.counts.matched.wrapping_add(1);
        let Some(pass) = &state.rule.pass else { return 0 };
        if pass.period_ticks > 0 {
            if state.held.replace(*frame).is_some() {
                state.counts.overtaken = state.counts.overtaken.wrapping_add(1);
                return 0;
            }
            if at < state.open_from {
                let due = state.open_from;
                let kept = self.defer(due, slot, None);
                if !kept {
                    self.rules[slot].held = None;
                }
                return u32::from(!kept);
            }
            state.held = None;
            state.open_from = at + u64::from(pass.period_ticks);
        }
        self.pass_on(slot, frame, at)
    }

    /// Applies a rule's changes, and puts the frame where it waits. Returns how many were lost.
    fn pass_on(&mut self, slot: usize, frame: &Frame, at: u64) -> u32 {
        let state = &mut self.rules[slot];
        let Some(pass) = &state.rule.pass else { return 0 };
        let delay = u64::from(pass.delay_ticks);
        let is_full = if delay > 0 { self.later.len() == LATER } else { self.ready.is_full() };
        // Cannot fail otherwise: the rule was checked when it was set.
        let Some(changed) = pass.changed(frame).filter(|_| !is_full) else {
            state.counts.lost = state.counts.lost.wrapping_add(1);
            return 1;
        };
        let changed = apply(&pass.modifiers, &changed, state.step, 0);
        state.step = state.step.wrapping_add(1);
        if delay > 0 {
            self.defer(at + delay, slot, Some(changed));
        } else {
            // Cannot fail: checked above.
            let _ = self.ready.push_back((slot as u8, changed));
        }
        0
    }

    /// Keeps something for later; if there is no room, counts its frame as lost and returns false.
    fn defer(&mut self, due: u64, slot: usize, frame: Option<Frame>) -> bool {
        self.sequence = self.sequence.wrapping_add(1);
        let later = Later { due, sequence: self.sequence, rule: slot as u8, frame };
        let kept = self.later.push(later).is_ok();
        if !kept {
            let counts = &mut self.rules[slot].counts;
            counts.lost = counts.lost.wrapping_add(1);
        }
        kept
    }

    /// Makes ready what has become due, a few at a time. Returns how many frames were lost.
    pub fn release(&mut self, now: u64) -> u32 {
        let mut lost = 0;
        for _ in 0..RELEASED_AT_ONCE {
            if self.due() > now {
                break;
            }
            let Some(Later { due, rule, frame, .. }) = self.later.pop() else { break };
            let slot = usize::from(rule);
            let Some(state) = self.rules.get_mut(slot) else { continue };
            if let Some(frame) = frame {
                if self.ready.push_back((rule, frame)).is_err() {
                    state.counts.lost = state.counts.lost.wrapping_add(1);
                    lost += 1;
                }
            } else if let Some(frame) = state.held.take() {
                let period = state.rule.pass.as_ref().map_or(0, |pass| pass.period_ticks);
                state.open_from = due + u64::from(period);
                lost += self.pass_on(slot, &frame, due);
            }
        }
        lost
    }

    /// The frame that goes next into a mailbox, with its rule; [`Self::loaded`] follows.
    #[inline]
    pub fn next(&self) -> Option<&(u8, Frame)> {
        self.ready.front()
    }

    /// The frame that [`Self::next`] returned is in a mailbox.
    #[inline]
    pub fn loaded(&mut self) {
        self.ready.pop_front();
    }

    /// A frame of a rule's has been sent, at this time, or was given up.
    pub fn ended(&mut self, slot: usize, sent: Option<(Frame, u64)>) {
        if let Some(state) = self.rules.get_mut(slot) {
            let counter = if sent.is_some() { &mut state.counts.sent } else { &mut state.counts.failed };
            *counter = counter.wrapping_add(1);
        }
        if let Some((frame, at)) = sent {
            self.echo.sent(frame, at);
        }
    }

    /// Gives up what waits, as lost. Returns how many frames that were.
    pub fn give_up(&mut self) -> u32 {
        let mut lost = 0;
        let ready = self.ready.iter().map(|&(rule, _)| rule);
        for rule in ready.chain(self.later.iter().map(|later| later.rule)) {
            if let Some(state) = self.rules.get_mut(usize::from(rule)) {
                state.counts.lost = state.counts.lost.wrapping_add(1);
                lost += 1;
            }
        }
        self.rules.iter_mut().for_each(|state| state.held = None);
        self.ready.clear();
        self.later.clear();
        lost
    }
}

impl Default for Lane {
    fn default() -> Self {
        Self::new()
    }
}

/// The other channel.
pub const fn other(channel: Channel) -> Channel {
    match channel {
        Channel::Can1 => Channel::Can2,
        Channel::Can2 => Channel::Can1,
    }
}
