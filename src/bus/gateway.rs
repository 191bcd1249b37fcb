//! One direction of a gateway: which of the frames that the other channel has received are sent on this one, how, and when.
//!
//! Belongs to the channel that sends. Only [`Lane::admit`] looks through the rules, once for each frame received, so its 32 comparisons are
//! the bound. Everything that waits has a fixed place; what finds none is counted by rule, and reported as lost.

use core::cmp::Ordering;

use cantap_wire::message::{Filter, FrameKind, GatewayRule, MAX_GATEWAY_RULES, MAX_RULE_COUNTS, RuleCounts};
use cantap_wire::{Channel, Frame, Id};
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

/// A receiver takes a frame on the same bus one bit before its sender (RM0090 Rev 21 §32.7.3), and each stamp is late by a microsecond or
/// two. This is added to the bit. No frame is shorter than 47 bits, so it is never the one before.
const ECHO_WITHIN_TICKS: u64 = 8 * TICKS_PER_US as u64;
/// So many frames in a row, each received by the other channel as this one sent it, are a loop.
const ECHOES: u32 = 32;
/// After so many, this channel pauses once. Equal frames that follow each other on two buses no longer end together then.
const PAUSE_AFTER: u32 = ECHOES / 2;
/// Half of the shortest frame and the intermission: as far as possible from the frames before and after.
const PAUSE_BITS: u64 = 25;

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

/// A filter as two words: identifier, bit 31 for its length, bit 30 for remote frames.
#[derive(Clone, Copy)]
struct Key {
    value: u32,
    mask: u32,
}

impl Key {
    const EXTENDED: u32 = 1 << 31;
    const REMOTE: u32 = 1 << 30;

    fn of(filter: &Filter) -> Self {
        let remote = if filter.kind == FrameKind::Remote { Self::REMOTE } else { 0 };
        let kinds = if filter.kind == FrameKind::Any { 0 } else { Self::REMOTE };
        Self {
            value: filter.id | remote | if filter.extended { Self::EXTENDED } else { 0 },
            mask: filter.mask | kinds | Self::EXTENDED,
        }
    }

    #[inline]
    fn word(frame: &Frame) -> u32 {
        let id = frame.id();
        id.raw()
            | if id.is_extended() { Self::EXTENDED } else { 0 }
            | if frame.is_remote() { Self::REMOTE } else { 0 }
    }
}

struct RuleState {
    rule: GatewayRule,
    counts: RuleCounts,
    /// Frames passed on so far, for counters.
    step: u32,
    /// Before this, a frame is held back.
    open_from: u64,
    held: Option<Frame>,
}

/// A frame and its time; 0 if there was none. All zero at first, so that it takes no flash.
#[derive(Clone, Copy)]
struct Seen {
    frame: Frame,
    at: u64,
}

impl Seen {
    const NONE: Self =
        Self { frame: Frame::from_clean_parts(Id::standard_truncated(0), false, 0, [0; 8]), at: 0 };
}

/// How far a lane has come with the pause that tells a loop from a coincidence.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Pause {
    No,
    /// It begins when a frame waits and none of the gateway's is in a mailbox.
    Wanted,
    Until(u64),
}

/// Whether what this channel sends comes back on the other.
struct Echo {
    sent: Seen,
    received: Seen,
    row: u32,
    pause: Pause,
    /// The bit time.
    bit_ticks: u64,
    /// The rule that sent last.
    slot: u8,
}

impl Echo {
    const fn new(bit_ticks: u32) -> Self {
        let bit_ticks = bit_ticks as u64;
        Self { sent: Seen::NONE, received: Seen::NONE, row: 0, pause: Pause::No, bit_ticks, slot: 0 }
    }

    /// Counts a frame that came back.
    fn compare(&mut self) {
        let Self { sent, received, bit_ticks, .. } = self;
        let together = sent.at.abs_diff(received.at) <= ECHO_WITHIN_TICKS + *bit_ticks && sent.at != 0;
        if together && sent.frame == received.frame {
            self.row += 1;
            (self.sent, self.received) = (Seen::NONE, Seen::NONE);
            if self.row == PAUSE_AFTER {
                self.pause = Pause::Wanted;
            }
        }
    }

    /// Whether both channels have sent this frame at once.
    fn is_twin(&self, other: &Self) -> bool {
        let (a, b) = (&self.sent, &other.sent);
        let within = ECHO_WITHIN_TICKS + self.bit_ticks;
        a.at != 0 && b.at != 0 && a.at.abs_diff(b.at) <= within && a.frame == b.frame
    }

    /// The other channel has sent this frame as well: as good as received there, but it proves nothing after the pause.
    fn twin_sent(&mut self) {
        self.sent = Seen::NONE;
        if self.row < PAUSE_AFTER {
            self.row += 1;
        }
    }

    /// The other channel has received a frame.
    fn received(&mut self, frame: Frame, at: u64) {
        self.received = Seen { frame, at };
        self.compare();
    }

    /// This channel has sent a frame. Which of the two is noticed first depends on the tasks under way.
    fn sent(&mut self, frame: Frame, at: u64) {
        // The one before has not come back.
        if self.sent.at != 0 {
            self.row = 0;
        }
        self.sent = Seen { frame, at };
        self.compare();
    }
}

/// One direction: its rules, and the frames on their way. Some ten kilobytes, constructed in place, never on a stack.
pub struct Lane {
    /// What the rules' filters compare, apart from the rest: every frame is compared with all of them.
    keys: Vec<Key, MAX_GATEWAY_RULES>,
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
            keys: Vec::new(),
            rules: Vec::new(),
            unmatched: 0,
            ready: Deque::new(),
            later: BinaryHeap::new(),
            sequence: 0,
            echo: Echo::new(0),
        }
    }

    /// Sets a rule, or removes it and all after it; false if there is no such slot.
    pub fn set_rule(&mut self, slot: usize, rule: Option<GatewayRule>) -> bool {
        if slot > self.rules.len() {
            return false;
        }
        let Some(rule) = rule else {
            self.rules.truncate(slot);
            self.keys.truncate(slot);
            return true;
        };
        let key = Key::of(&rule.filter);
        let state = RuleState { rule, counts: RuleCounts::default(), step: 0, open_from: 0, held: None };
        match self.rules.get_mut(slot) {
            Some(place) => {
                *place = state;
                self.keys[slot] = key;
                true
            }
            None => self.rules.push(state).is_ok() && self.keys.push(key).is_ok(),
        }
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
        self.restart(0);
        self.rules.clear();
        self.keys.clear();
    }

    /// Nothing is on its way, and all counts are zero. This channel's bits take so many ticks.
    pub fn restart(&mut self, bit_ticks: u32) {
        for state in &mut self.rules {
            (state.counts, state.step, state.open_from, state.held) = (RuleCounts::default(), 0, 0, None);
        }
        self.unmatched = 0;
        self.ready.clear();
        self.later.clear();
        self.echo = Echo::new(bit_ticks);
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

    /// The rule that sent the last of the frames that came back.
    pub const fn looped(&self) -> u8 {
        self.echo.slot
    }

    /// On one bus with long bits, both channels begin to send a frame in the same bit, as one, and neither receives it. So one of them pauses
    /// before each frame once that has happened often enough: what both then receive is a loop. Two buses that carry the same at
    /// the same time are none: nothing comes back.
    pub fn compare_sent(first: &mut Self, second: &mut Self) {
        let (first, second) = (&mut first.echo, &mut second.echo);
        if first.is_twin(second) {
            first.twin_sent();
            second.twin_sent();
            if second.row >= PAUSE_AFTER && second.pause == Pause::No {
                second.pause = Pause::Wanted;
            }
        }
    }

    /// Whether a frame was sent that [`Self::compare_sent`] has not seen and that has not come back.
    #[inline]
    pub const fn has_sent(&self) -> bool {
        self.echo.sent.at != 0
    }

    /// Whether nothing may go into a mailbox at the moment. `loaded`: some of the gateway's frames are still in one.
    #[inline]
    pub fn pauses(&mut self, now: u64, loaded: impl FnOnce() -> bool) -> bool {
        self.echo.pause != Pause::No && self.still_pauses(now, loaded())
    }

    #[cold]
    fn still_pauses(&mut self, now: u64, loaded: bool) -> bool {
        match self.echo.pause {
            Pause::Wanted if loaded || !self.is_ready() => return true,
            Pause::Wanted => self.echo.pause = Pause::Until(now + PAUSE_BITS * self.echo.bit_ticks),
            Pause::Until(end) if end > now => {}
            Pause::Until(_) | Pause::No => self.echo.pause = Pause::No,
        }
        self.echo.pause != Pause::No
    }

    /// The end of a pause, if a frame waits for it.
    #[inline]
    pub fn pause_ends(&self) -> u64 {
        match self.echo.pause {
            Pause::Until(end) if self.is_ready() => end,
            _ => NEVER,
        }
    }

    /// A frame that the other channel received at `at`. Returns how many frames were lost to make room: none or one.
    pub fn admit(&mut self, frame: &Frame, at: u64) -> u32 {
        self.echo.received(*frame, at);
        let word = Key::word(frame);
        let Some(slot) = self.keys.iter().position(|key| (word ^ key.value) & key.mask == 0) else {
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
        let changed = match &pass.modifiers[..] {
            [] => changed,
            modifiers => apply(modifiers, &changed, state.step, 0),
        };
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
            self.echo.slot = slot as u8;
            self.echo.sent(frame, at);
        }
    }

    /// The bus is off: what waits for a mailbox would be old when it is back. Returns how many frames were lost.
    pub fn lose_ready(&mut self) -> u32 {
        let lost = self.ready.len() as u32;
        while let Some((rule, _)) = self.ready.pop_front() {
            if let Some(state) = self.rules.get_mut(usize::from(rule)) {
                state.counts.lost = state.counts.lost.wrapping_add(1);
            }
        }
        lost
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
