//! Puts frames on the bus: a queue in order, frames at their time, periodic frames, replies.
//!
//! One per channel, in the highest-priority interrupts. Mailboxes leave in the order in which they were requested.
//! Whenever one is free, a reply goes first, then a periodic frame that is due, then the queue's head once
//! its time has come.

use cantap_wire::message::{DEVICE_TAG, Modifier, Periodic, TRIGGER_TAG, Trigger, TxFrame};
use cantap_wire::record::TransmitFailure;
use cantap_wire::{Channel, Event, Frame};
use heapless::Deque;

use crate::TICKS_PER_US;
use crate::checksum::checksum;
use crate::mailboxes::Mailboxes;
use crate::ports::{Outcome, Traffic};
use crate::recorder::Recorder;

/// Transmit mailboxes of a controller.
pub const MAILBOXES: usize = 3;
/// Frames that the queue holds: 28 ms of the shortest eight-byte frames at 1 Mbit/s.
pub const TX_QUEUE: usize = 256;
/// Periodic entries.
pub const PERIODIC_SLOTS: usize = 32;
/// Replies.
pub const TRIGGER_SLOTS: usize = 8;

/// Shortest period: no frame is shorter than 47 µs.
pub const MIN_PERIOD_TICKS: u32 = 47 * TICKS_PER_US;
/// Periodic entries are looked at no more often than this, so that many short periods cannot take
/// the processor from the capture.
const LOOK_EVERY_TICKS: u64 = 20 * TICKS_PER_US as u64;
/// "Never", for due times.
pub const NEVER: u64 = u64::MAX;

#[derive(Clone, Copy)]
struct Queued {
    tag: u32,
    frame: Frame,
    /// 0: at once.
    at: u64,
}

struct PeriodicState {
    entry: Periodic,
    next_due: u64,
    /// Left to send; `None` for ever.
    left: Option<u32>,
    /// Due, and waiting for a mailbox.
    waiting: bool,
    step: u32,
}

struct TriggerState {
    entry: Trigger,
    left: Option<u32>,
    waiting: bool,
}

/// One channel's transmissions.
pub struct Transmitter {
    channel: Channel,
    queue: Deque<Queued, TX_QUEUE>,
    mailboxes: Mailboxes,
    periodic: [Option<PeriodicState>; PERIODIC_SLOTS],
    /// When the periodic entries are to be looked at: at the earliest due time among them, but not before `look_from`.
    periodic_due: u64,
    look_from: u64,
    periodic_waiting: u8,
    triggers: [Option<TriggerState>; TRIGGER_SLOTS],
    triggers_armed: bool,
    replies_waiting: u8,
    random: u32,
    /// Finished and not recorded yet. What finds no room in the queue would break "each one is confirmed", so nothing more
    /// is sent until it is written; what was in the mailboxes by then has room here too.
    unconfirmed: Deque<Event, { 2 * MAILBOXES }>,
    /// The queue is being given up, as fast as its records find room.
    dropping: Option<TransmitFailure>,
    sent: u32,
    failed: u32,
}

impl Transmitter {
    /// Nothing to send.
    pub const fn new(channel: Channel) -> Self {
        Self {
            channel,
            queue: Deque::new(),
            mailboxes: Mailboxes::new(),
            periodic: [const { None }; PERIODIC_SLOTS],
            periodic_due: NEVER,
            look_from: 0,
            periodic_waiting: 0,
            triggers: [const { None }; TRIGGER_SLOTS],
            triggers_armed: false,
            replies_waiting: 0,
            random: 0x1234_5678,
            unconfirmed: Deque::new(),
            dropping: None,
            sent: 0,
            failed: 0,
        }
    }

    /// Frames sent, and frames not sent, since [`Self::reset_counters`].
    pub const fn counters(&self) -> (u32, u32) {
        (self.sent, self.failed)
    }

    /// Starts the counters over.
    pub const fn reset_counters(&mut self) {
        self.sent = 0;
        self.failed = 0;
    }

    /// Frames in the queue or a mailbox.
    pub fn pending(&self) -> usize {
        self.queue.len() + self.mailboxes.len()
    }

    /// Whether everything has ended and is recorded.
    pub fn is_idle(&self) -> bool {
        self.pending() == 0 && self.unconfirmed.is_empty()
    }

    /// Places in the queue for new frames.
    pub fn free(&self) -> usize {
        if self.dropping.is_some() { 0 } else { TX_QUEUE - self.queue.len() }
    }

    /// Queues one frame; false if the queue is full. A frame that comes while the queue is being given up is given up
    /// with it, and recorded like the others.
    pub fn enqueue(&mut self, frame: &TxFrame) -> bool {
        let queued = Queued { tag: frame.tag, frame: frame.frame, at: frame.at_ticks.unwrap_or(0) };
        self.queue.push_back(queued).is_ok()
    }

    /// Sets or clears a periodic entry; its first transmission is due at `now`.
    pub fn set_periodic(&mut self, slot: usize, entry: Option<Periodic>, now: u64) {
        let Some(place) = self.periodic.get_mut(slot) else { return };
        *place = entry.map(|entry| PeriodicState {
            left: (entry.count > 0).then_some(entry.count),
            entry,
            next_due: now,
            waiting: false,
            step: 0,
        });
        self.count_periodic();
    }

    fn count_periodic(&mut self) {
        let entries = || self.periodic.iter().flatten();
        self.periodic_waiting = entries().filter(|entry| entry.waiting).count() as u8;
        let due = entries().map(|entry| entry.next_due).min();
        self.periodic_due = due.map_or(NEVER, |due| due.max(self.look_from));
    }

    /// Sets or clears a reply.
    pub fn set_trigger(&mut self, slot: usize, entry: Option<Trigger>) {
        let Some(place) = self.triggers.get_mut(slot) else { return };
        *place = entry.map(|entry| TriggerState {
            left: (entry.count > 0).then_some(entry.count),
            entry,
            waiting: false,
        });
        self.count_triggers();
    }

    fn count_triggers(&mut self) {
        self.triggers_armed = self.triggers.iter().any(Option::is_some);
        self.replies_waiting = self.triggers.iter().flatten().filter(|entry| entry.waiting).count() as u8;
    }

    /// Gives up everything queued or in a mailbox; each frame is recorded with `reason`. What cannot be
    /// taken back any more may still be sent.
    pub fn drop_all(&mut self, reason: TransmitFailure, traffic: &mut impl Traffic) {
        if !self.queue.is_empty() {
            self.dropping = Some(reason);
        }
        if self.mailboxes.len() > 0 {
            traffic.abort();
        }
    }

    /// The controller is off the bus and reports its mailboxes no more: records them with `reason`.
    pub fn give_up_mailboxes<const N: usize>(
        &mut self,
        recorder: &mut Recorder<'_, N>,
        now: u64,
        reason: TransmitFailure,
    ) {
        while let Some((mailbox, tag)) = self.mailboxes.first() {
            if !recorder.event(&Event::TransmitFailed { channel: self.channel, tag, reason }, now) {
                return;
            }
            self.failed = self.failed.wrapping_add(1);
            self.mailboxes.take(mailbox);
        }
    }

    /// Forgets the periodic entries and the replies.
    pub fn clear_entries(&mut self) {
        self.periodic = [const { None }; PERIODIC_SLOTS];
        self.triggers = [const { None }; TRIGGER_SLOTS];
        self.count_periodic();
        self.count_triggers();
    }

    /// Forgets everything, unrecorded, for when nobody listens any more.
    pub fn clear(&mut self) {
        self.clear_entries();
        self.queue.clear();
        self.unconfirmed.clear();
        self.mailboxes = Mailboxes::new();
        self.dropping = None;
    }

    /// A frame was received: arms the replies that it asks for. Returns whether there is one.
    #[inline]
    pub fn on_frame(&mut self, frame: &Frame) -> bool {
        if !self.triggers_armed {
            return false;
        }
        for trigger in self.triggers.iter_mut().flatten() {
            if trigger.left != Some(0) && !trigger.waiting && trigger.entry.filter.matches(frame) {
                trigger.waiting = true;
                self.replies_waiting += 1;
            }
        }
        self.replies_waiting > 0
    }

    /// Mailboxes may have finished: records how, and fills them again. `reason` names what an abort was for.
    pub fn on_finished<const N: usize>(
        &mut self,
        traffic: &mut impl Traffic,
        recorder: &mut Recorder<'_, N>,
        now: u64,
        reason: TransmitFailure,
    ) {
        self.collect(traffic, reason);
        self.service(traffic, recorder, now);
    }

    /// First part of [`Self::on_finished`]: empties the mailboxes that have finished. [`Self::prepare_head`] may follow before
    /// [`Self::record`], so that a busy bus need not wait for the record.
    pub fn collect(&mut self, traffic: &mut impl Traffic, reason: TransmitFailure) {
        while !self.unconfirmed.is_full() {
            let Some((mailbox, outcome)) = traffic.take_finished() else { break };
            let Some((tag, frame)) = self.mailboxes.take(mailbox) else { continue };
            let channel = self.channel;
            let failed = |reason| Event::TransmitFailed { channel, tag, reason };
            let event = match outcome {
                Outcome::Sent => Event::Transmitted { channel, tag, frame },
                Outcome::ArbitrationLost => failed(TransmitFailure::ArbitrationLost),
                Outcome::Error => failed(TransmitFailure::BusError),
                Outcome::Aborted => failed(reason),
            };
            let counter = if outcome == Outcome::Sent { &mut self.sent } else { &mut self.failed };
            *counter = counter.wrapping_add(1);
            // Cannot fail: checked above.
            let _ = self.unconfirmed.push_back(event);
        }
    }

    /// Whether something other than the queue's frames is waiting, for [`Self::service`].
    pub fn has_more(&self, now: u64) -> bool {
        let waiting = self.replies_waiting > 0 || self.periodic_waiting > 0 || self.dropping.is_some();
        waiting || self.periodic_due <= now
    }

    /// Fills free mailboxes with the queue's frames that are due, unless something else goes first.
    fn load_due(&mut self, traffic: &mut impl Traffic, now: u64) {
        while self.head_due() <= now
            && let Some(mailbox) = self.prepare_head(traffic, now)
        {
            traffic.request(mailbox);
            self.requested(mailbox);
        }
    }

    /// Writes the queue's head to a mailbox, unless something else goes first at this time. It is sent by [`Traffic::request`],
    /// with [`Self::requested`] afterwards.
    #[inline]
    pub fn prepare_head(&mut self, traffic: &mut impl Traffic, at: u64) -> Option<u8> {
        // Whatever is in a mailbox must find room to be kept when it has finished.
        let kept = self.unconfirmed.len() + self.mailboxes.len();
        if kept >= self.unconfirmed.capacity() || self.has_more(at) {
            return None;
        }
        traffic.prepare(&self.queue.front()?.frame)
    }

    /// The queue's head is in this mailbox, and was requested.
    #[inline]
    pub fn requested(&mut self, mailbox: u8) {
        if let Some(Queued { tag, frame, .. }) = self.queue.pop_front() {
            self.mailboxes.put(mailbox, tag, frame);
        }
    }

    /// Records what has finished, at `ended`; false if the queue has no room for all of it.
    pub fn record<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, ended: u64) -> bool {
        while let Some(event) = self.unconfirmed.front() {
            if !recorder.event(event, ended) {
                return false;
            }
            self.unconfirmed.pop_front();
        }
        true
    }

    /// Fills free mailboxes with what is due.
    pub fn service<const N: usize>(
        &mut self,
        traffic: &mut impl Traffic,
        recorder: &mut Recorder<'_, N>,
        now: u64,
    ) {
        if !self.record(recorder, now) {
            return;
        }
        if let Some(reason) = self.dropping {
            while let Some(&Queued { tag, .. }) = self.queue.front() {
                if !recorder.event(&Event::TransmitFailed { channel: self.channel, tag, reason }, now) {
                    return;
                }
                self.failed = self.failed.wrapping_add(1);
                self.queue.pop_front();
            }
            self.dropping = None;
        }
        if self.periodic_due <= now {
            self.start_due(recorder, now);
        }
        while self.replies_waiting > 0 {
            if !self.send_reply(traffic) {
                return;
            }
        }
        while self.periodic_waiting > 0 {
            if !self.send_periodic(traffic) {
                return;
            }
        }
        self.load_due(traffic, now);
    }

    /// When the queue's head is due, if there is one and a mailbox is free: one that is due waits for a mailbox, not for time. 0
    /// if it has no time.
    #[inline]
    pub fn head_due(&self) -> u64 {
        match self.queue.front() {
            Some(head) if !self.mailboxes.are_full() => head.at,
            _ => NEVER,
        }
    }

    /// When the periodic entries are to be looked at; [`NEVER`] if there are none.
    #[inline]
    pub const fn periodic_due(&self) -> u64 {
        self.periodic_due
    }

    /// The next time at which [`Self::service`] has something to do that no interrupt of the controller tells.
    #[inline]
    pub fn next_due(&self) -> u64 {
        // What waits for room in the record queue is tried again every millisecond; an alarm would come again and again and
        // keep USB, which makes the room, from running.
        if !self.unconfirmed.is_empty() || self.dropping.is_some() {
            return NEVER;
        }
        let head = self.head_due();
        // Without a time it waits for something else.
        self.periodic_due.min(if head == 0 { NEVER } else { head })
    }

    fn load(&mut self, tag: u32, frame: &Frame, traffic: &mut impl Traffic) -> bool {
        let Some(mailbox) = traffic.prepare(frame) else { return false };
        traffic.request(mailbox);
        self.mailboxes.put(mailbox, tag, *frame);
        true
    }

    fn start_due<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64) {
        self.look_from = now + LOOK_EVERY_TICKS;
        for (slot, place) in self.periodic.iter_mut().enumerate() {
            let Some(periodic) = place else { continue };
            while periodic.next_due <= now {
                if periodic.waiting {
                    self.failed = self.failed.wrapping_add(1);
                    let tag = DEVICE_TAG + slot as u32;
                    let reason = TransmitFailure::Overtaken;
                    // Without room the status counter still tells of it.
                    recorder.event(&Event::TransmitFailed { channel: self.channel, tag, reason }, now);
                }
                periodic.waiting = true;
                let period = u64::from(periodic.entry.period_ticks.max(1));
                periodic.next_due += period;
                // Far behind (the bus was blocked): due times stay multiples of the period. No record for each, but all are counted.
                if let Some(behind) = now.checked_sub(periodic.next_due + period * 4) {
                    self.failed = self.failed.wrapping_add((behind / period) as u32);
                    periodic.next_due += behind / period * period;
                }
            }
        }
        self.count_periodic();
    }

    fn send_reply(&mut self, traffic: &mut impl Traffic) -> bool {
        let next = self.triggers.iter().position(|place| place.as_ref().is_some_and(|entry| entry.waiting));
        let Some((slot, frame)) =
            next.and_then(|slot| Some((slot, self.triggers[slot].as_ref()?.entry.reply)))
        else {
            self.replies_waiting = 0;
            return false;
        };
        if !self.load(TRIGGER_TAG + slot as u32, &frame, traffic) {
            return false;
        }
        if let Some(trigger) = &mut self.triggers[slot] {
            trigger.waiting = false;
            trigger.left = trigger.left.map(|left| left.saturating_sub(1));
        }
        self.replies_waiting -= 1;
        true
    }

    fn send_periodic(&mut self, traffic: &mut impl Traffic) -> bool {
        let random = self.next_random();
        let next = self.periodic.iter().position(|place| place.as_ref().is_some_and(|entry| entry.waiting));
        let Some((slot, frame)) =
            next.and_then(|slot| Some((slot, modified(self.periodic[slot].as_ref()?, random))))
        else {
            self.periodic_waiting = 0;
            return false;
        };
        if !self.load(DEVICE_TAG + slot as u32, &frame, traffic) {
            return false;
        }
        let place = &mut self.periodic[slot];
        if let Some(periodic) = place {
            periodic.waiting = false;
            periodic.step = periodic.step.wrapping_add(1);
            periodic.left = periodic.left.map(|left| left.saturating_sub(1));
            if periodic.left == Some(0) {
                *place = None;
            }
        }
        self.count_periodic();
        true
    }

    /// xorshift32 (Marsaglia, "Xorshift RNGs", 2003).
    fn next_random(&mut self) -> u32 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 17;
        self.random ^= self.random << 5;
        self.random
    }
}

/// A periodic entry's frame with its modifiers applied.
fn modified(periodic: &PeriodicState, mut random: u32) -> Frame {
    let frame = &periodic.entry.frame;
    let mut data = frame.padded_data();
    let len = frame.data_len();
    for modifier in &periodic.entry.modifiers {
        match *modifier {
            Modifier::Counter { byte, low_bit, bits } => {
                let mask = ((1u16 << bits) - 1) as u8;
                if let Some(value) = data[..len].get_mut(byte as usize) {
                    let counted = (*value >> low_bit).wrapping_add(periodic.step as u8) & mask;
                    *value = *value & !(mask << low_bit) | counted << low_bit;
                }
            }
            Modifier::Checksum { byte, algorithm } => {
                let sum = checksum(algorithm, &data[..len], byte as usize);
                if let Some(value) = data[..len].get_mut(byte as usize) {
                    *value = sum;
                }
            }
            Modifier::Random { byte } => {
                if let Some(value) = data[..len].get_mut(byte as usize) {
                    *value = random as u8;
                }
                random = random.rotate_right(8);
            }
        }
    }
    Frame::from_bus(frame.id(), frame.is_remote(), frame.dlc(), data)
}

/// Whether an entry can be applied: a period, and modifiers inside the frame's data.
pub fn is_valid(entry: &Periodic) -> bool {
    let len = entry.frame.data_len();
    entry.period_ticks >= MIN_PERIOD_TICKS
        && entry.modifiers.iter().all(|modifier| match *modifier {
            Modifier::Counter { byte, low_bit, bits } => {
                (byte as usize) < len && low_bit < 8 && (1..=8 - low_bit).contains(&bits)
            }
            Modifier::Checksum { byte, .. } | Modifier::Random { byte } => (byte as usize) < len,
        })
}
