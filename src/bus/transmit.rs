//! Puts frames on the bus: a queue in order, frames at their time, periodic frames, replies.
//!
//! One per channel, in the tasks of priority 4. Mailboxes are sent in the order in which they were requested. Whenever one is free, a
//! reply goes first, then a periodic frame that is due ([`crate::bus::periodic`]), then the head of the queue once its time has come. A gateway's
//! frames ([`crate::bus::gateway`]) go before a head without a time, and leave one mailbox to all the others.
//!
//! Each call does a bounded amount of work: it fills the free mailboxes, three at most, and writes at most
//! [`RECORDS_PER_CALL`] records of frames that are given up. `docs/architecture.md` says how long this takes.

use cantap_wire::message::{GATEWAY_TAG, Periodic, TRIGGER_TAG, Trigger, TxFrame};
use cantap_wire::record::{LossStage, TransmitFailure};
use cantap_wire::{Channel, Event, Frame};
#[cfg(not(target_os = "none"))]
use cantap_wire::{TransmittedFd, message::TxFdFrame};
use heapless::Deque;

use crate::bus::gateway::Lane;
use crate::bus::mailboxes::{MAILBOXES, Mailboxes};
use crate::bus::outgoing::Outgoing;
use crate::bus::periodic::PeriodicTable;
use crate::bus::recorder::{RECORDS_PER_CALL, Recorder};
use crate::bus::time::NEVER;
use crate::ports::{Outcome, Traffic};

/// Frames that the queue holds: 28 ms of the shortest eight-byte frames at 1 Mbit/s.
pub const TX_QUEUE: usize = 256;
/// Replies.
pub const TRIGGER_SLOTS: usize = 8;

#[derive(Clone, Copy)]
struct Queued {
    tag: u32,
    frame: Outgoing,
    /// Due time; 0 means at once.
    at: u64,
}

/// A transmission that has ended.
struct Ended {
    tag: u32,
    frame: Outgoing,
    /// `None` if it was sent.
    failure: Option<TransmitFailure>,
    at: u64,
}

struct TriggerState {
    entry: Trigger,
    left: Option<u32>,
    waiting: bool,
}

/// The memory of a channel's queue: eight kilobytes, constructed in place, never on a stack.
pub struct TxQueue(Deque<Queued, TX_QUEUE>);

impl TxQueue {
    /// Nothing in it.
    pub const fn new() -> Self {
        Self(Deque::new())
    }
}

impl Default for TxQueue {
    fn default() -> Self {
        Self::new()
    }
}

/// One channel's transmissions.
pub struct Transmitter<'q> {
    channel: Channel,
    queue: &'q mut Deque<Queued, TX_QUEUE>,
    mailboxes: Mailboxes,
    periodic: PeriodicTable,
    triggers: [Option<TriggerState>; TRIGGER_SLOTS],
    /// Received frames are looked at: there are replies, or a gateway passes them on.
    watching: bool,
    replies_waiting: u8,
    /// The frames to be sent for a gateway.
    lane: &'q mut Lane,
    /// The gateway runs.
    passing: bool,
    /// Frames that the gateway has lost and that no record reports yet.
    unpassed: u32,
    /// The gateway has found a loop, by a frame of this rule, and no record reports it yet.
    looped: Option<u8>,
    /// Frames of a gateway that was stopped, which come before those of the present one.
    stale: u8,
    /// Finished but not recorded yet. Every transmission must be confirmed, so if the record queue has no room, nothing
    /// more is sent until these are written. There is room here for what is then still in the mailboxes, too.
    unconfirmed: Deque<Ended, { 2 * MAILBOXES }>,
    /// The queue is being given up, as fast as there is room for the records.
    dropping: Option<TransmitFailure>,
    /// The controller is to stay off the bus: no mailbox is filled.
    off: bool,
    sent: u32,
    failed: u32,
    /// A mailbox goes on saying that it has finished: the transmit interrupt stays silent until the next millisecond.
    held: bool,
    /// The controller took no frame although it should have a free mailbox. The next tick tries again, or what finishes before it.
    refused: bool,
    /// How often a mailbox stayed finished, since the start.
    mailboxes_stuck: u32,
}

impl<'q> Transmitter<'q> {
    /// Nothing to send; `queue` and `lane` are empty.
    pub const fn new(channel: Channel, queue: &'q mut TxQueue, lane: &'q mut Lane) -> Self {
        Self {
            channel,
            queue: &mut queue.0,
            mailboxes: Mailboxes::new(),
            periodic: PeriodicTable::new(channel),
            triggers: [const { None }; TRIGGER_SLOTS],
            watching: false,
            replies_waiting: 0,
            lane,
            passing: false,
            unpassed: 0,
            looped: None,
            stale: 0,
            unconfirmed: Deque::new(),
            dropping: None,
            off: false,
            sent: 0,
            failed: 0,
            held: false,
            refused: false,
            mailboxes_stuck: 0,
        }
    }

    /// Frames sent, and frames not sent, since [`Self::reset_counters`]. The second includes periods that passed without a
    /// frame as of the last [`Self::count_overtaken`].
    pub const fn counters(&self) -> (u32, u32) {
        (self.sent, self.failed.wrapping_add(self.periodic.overtaken()))
    }

    /// Counts the periods that have passed without a frame.
    pub fn count_overtaken(&mut self, now: u64) {
        self.periodic.count_overtaken(now);
    }

    /// Resets the counters to zero.
    pub const fn reset_counters(&mut self) {
        self.sent = 0;
        self.failed = 0;
        self.periodic.reset_counter();
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

    /// Queues one frame; false if the queue is full. A frame queued while the queue is being given up is given up
    /// with it, and recorded like the others.
    pub fn enqueue(&mut self, frame: &TxFrame) -> bool {
        let queued = Queued { tag: frame.tag, frame: frame.frame.into(), at: frame.at_ticks.unwrap_or(0) };
        self.queue.push_back(queued).is_ok()
    }

    /// The same for a CAN FD frame: for other makers' adapters, see [`Traffic::prepare_fd`].
    #[cfg(not(target_os = "none"))]
    pub fn enqueue_fd(&mut self, frame: &TxFdFrame) -> bool {
        let (tag, at) = (frame.tag, frame.at_ticks.unwrap_or(0));
        self.queue.push_back(Queued { tag, frame: Outgoing::Fd(frame.frame), at }).is_ok()
    }

    /// Sets or clears a periodic entry; its first transmission is due at `now`.
    pub fn set_periodic(&mut self, slot: usize, entry: Option<Periodic>, now: u64) {
        self.periodic.set(slot, entry, now);
    }

    /// Whether the controller stays off the bus until a command brings it back. Nothing goes into its mailboxes until then.
    pub const fn set_off(&mut self, off: bool) {
        self.off = off;
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
        self.watching = self.passing || self.triggers.iter().any(Option::is_some);
        self.replies_waiting = self.triggers.iter().flatten().filter(|entry| entry.waiting).count() as u8;
    }

    /// Gives up everything queued or in a mailbox; each frame is recorded with `reason`. A frame that
    /// can no longer be withdrawn may still be sent.
    pub fn drop_all(&mut self, reason: TransmitFailure, traffic: &mut impl Traffic) {
        if !self.queue.is_empty() {
            self.dropping = Some(reason);
        }
        if self.mailboxes.len() > 0 {
            traffic.abort();
        }
    }

    /// The controller is off the bus and no longer reports its mailboxes: records their frames with `reason` and aborts them for
    /// good, so that none is sent when it is back on a bus.
    pub fn give_up_mailboxes<const N: usize>(
        &mut self,
        traffic: &mut impl Traffic,
        recorder: &mut Recorder<'_, N>,
        now: u64,
        reason: TransmitFailure,
    ) {
        traffic.abort();
        while let Some((mailbox, tag)) = self.mailboxes.first() {
            if !recorder.event(&Event::TransmitFailed { channel: self.channel, tag, reason }, now) {
                return;
            }
            self.failed = self.failed.wrapping_add(1);
            self.mailboxes.take(mailbox);
            if tag >= GATEWAY_TAG {
                self.lane.ended((tag - GATEWAY_TAG) as usize, None);
            }
        }
        // Their end has just been recorded.
        forget_finished(traffic);
    }

    /// Whether all that is left is in mailboxes.
    pub fn waits_for_mailboxes(&self) -> bool {
        self.queue.is_empty() && self.unconfirmed.is_empty() && self.mailboxes.len() > 0
    }

    /// Forgets the periodic entries and the replies.
    pub fn clear_entries(&mut self, now: u64) {
        self.periodic.clear(now);
        self.clear_triggers();
    }

    fn clear_triggers(&mut self) {
        self.triggers = [const { None }; TRIGGER_SLOTS];
        self.count_triggers();
    }

    /// Forgets everything without recording it, for when nobody is listening any more.
    pub fn clear(&mut self) {
        self.periodic.forget();
        self.passing = false;
        (self.unpassed, self.looped, self.stale) = (0, None, 0);
        self.lane.clear();
        self.clear_triggers();
        self.queue.clear();
        self.unconfirmed.clear();
        self.mailboxes = Mailboxes::new();
        self.dropping = None;
        self.off = false;
    }

    /// A gateway goes on without the host: what that has asked for is forgotten, unrecorded. A frame that can no longer be withdrawn is
    /// recorded as nobody's.
    pub fn forget_host(&mut self, traffic: &mut impl Traffic) {
        self.periodic.forget();
        self.clear_triggers();
        self.queue.clear();
        self.dropping = None;
        for _ in 0..self.unconfirmed.len() {
            if let Some(ended) = self.unconfirmed.pop_front().filter(|ended| ended.tag >= GATEWAY_TAG) {
                // Cannot fail: one was just taken out.
                let _ = self.unconfirmed.push_back(ended);
            }
        }
        if self.mailboxes.disown() {
            traffic.abort();
        }
    }

    /// Once a millisecond: records how many periods passed without a frame, rather than each of them.
    pub fn tick<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64) {
        self.periodic.tick(recorder, now);
        if (self.unpassed > 0 || self.looped.is_some()) && recorder.takes_frames() {
            self.tell_unpassed(recorder, now);
        }
    }

    /// Records why the gateway has ended, and what it has lost. Returns whether there was room.
    #[cold]
    #[inline(never)]
    fn tell_unpassed<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64) -> bool {
        let (channel, count) = (self.channel, self.unpassed);
        if let Some(slot) = self.looped {
            let (tag, reason) = (GATEWAY_TAG + u32::from(slot), TransmitFailure::Loop);
            if !recorder.event(&Event::TransmitFailed { channel, tag, reason }, now) {
                return false;
            }
            self.looped = None;
            self.failed = self.failed.wrapping_add(1);
        }
        if count == 0 {
            return true;
        }
        let lost = Event::Lost { channel, stage: LossStage::Gateway, count, at_least: false };
        let written = recorder.event(&lost, now);
        if written {
            self.unpassed = 0;
        }
        written
    }

    /// Whether periods that passed without a frame, or losses of the gateway, are still to be recorded.
    pub const fn owes(&self) -> bool {
        self.periodic.owes() || self.unpassed > 0 || self.looped.is_some()
    }

    /// The channel is closed: records what [`Self::tick`] has not recorded yet, a little per call. Returns whether there was room.
    pub fn tell_rest<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64) -> bool {
        self.tell_unpassed(recorder, now) && self.periodic.tell_rest(recorder, now)
    }

    /// The gateway's frames on this channel.
    pub const fn lane(&mut self) -> &mut Lane {
        self.lane
    }

    /// The gateway starts on a bus whose bits take so many ticks.
    pub fn start_passing(&mut self, bit_ticks: u32) {
        self.lane.restart(bit_ticks);
        (self.passing, self.watching, self.looped) = (true, true, None);
        let ended = self.unconfirmed.iter().filter(|ended| ended.tag >= GATEWAY_TAG).count();
        self.stale = (self.mailboxes.passed() + ended) as u8;
    }

    /// The gateway has found that what this channel sends comes back.
    pub const fn found_loop(&mut self) {
        self.looped = Some(self.lane.looped());
    }

    /// The bus is off: what waits for it is lost.
    pub fn lose_ready(&mut self) {
        if self.lane.is_ready() {
            self.unpassed = self.unpassed.saturating_add(self.lane.lose_ready());
        }
    }

    /// The gateway ends: what waits is lost. What is in a mailbox is still sent.
    pub fn stop_passing(&mut self) {
        self.passing = false;
        self.count_triggers();
        self.unpassed = self.unpassed.saturating_add(self.lane.give_up());
    }

    /// The gateway is to send on this channel what its rules make of a frame that the other has received.
    #[inline]
    pub fn pass(&mut self, frame: &Frame, at: u64) {
        self.unpassed = self.unpassed.saturating_add(self.lane.admit(frame, at));
    }

    /// A frame was received: arms the replies that it triggers. Returns whether there is one.
    #[inline]
    pub fn on_frame(&mut self, frame: &Frame) -> bool {
        self.watching && self.arm_replies(frame)
    }

    /// Whether received frames are looked at.
    #[inline]
    pub const fn is_watching(&self) -> bool {
        self.watching
    }

    /// Separate from [`Self::on_frame`] and out of line, so that without replies the draining loop has the registers to itself.
    #[inline(never)]
    fn arm_replies(&mut self, frame: &Frame) -> bool {
        for trigger in self.triggers.iter_mut().flatten() {
            if trigger.left != Some(0) && !trigger.waiting && trigger.entry.filter.matches(frame) {
                trigger.waiting = true;
                self.replies_waiting += 1;
            }
        }
        self.replies_waiting > 0
    }

    /// Mailboxes may have finished: records how, and fills them again. `reason` says why frames were aborted, if they were. Returns what
    /// [`Self::service`] does.
    pub fn on_finished<const N: usize>(
        &mut self,
        traffic: &mut impl Traffic,
        recorder: &mut Recorder<'_, N>,
        now: u64,
        reason: TransmitFailure,
    ) -> bool {
        self.collect(traffic, reason, now, || now);
        self.service(traffic, recorder, now)
    }

    /// First part of [`Self::on_finished`]: empties the mailboxes that have finished. [`Self::prepare_head`] may follow before
    /// [`Self::record`], so that a busy bus need not wait for the record.
    ///
    /// The first ended at `ended`. Any others finished later, at unknown times: they get the time at which they were found.
    pub fn collect(
        &mut self,
        traffic: &mut impl Traffic,
        reason: TransmitFailure,
        ended: u64,
        mut now: impl FnMut() -> u64,
    ) {
        self.refused = false;
        // With the interrupt held, its stamp is an old one.
        let mut first = !self.held;
        // A mailbox finishes once until it is filled again, so after as many as there are, nothing is left.
        let mut stuck = true;
        for _ in 0..=MAILBOXES {
            if self.unconfirmed.is_full() {
                stuck = false;
                break;
            }
            let Some((mailbox, outcome)) = traffic.take_finished() else {
                stuck = false;
                break;
            };
            let Some((tag, frame)) = self.mailboxes.take(mailbox) else { continue };
            let failure = match outcome {
                Outcome::Sent => None,
                Outcome::ArbitrationLost => Some(TransmitFailure::ArbitrationLost),
                Outcome::Error => Some(TransmitFailure::BusError),
                Outcome::Aborted => Some(reason),
            };
            let counter = if failure.is_none() { &mut self.sent } else { &mut self.failed };
            *counter = counter.wrapping_add(1);
            let at = if first { ended } else { now() };
            first = false;
            // Cannot fail: checked above.
            let _ = self.unconfirmed.push_back(Ended { tag, frame, failure, at });
        }
        self.held = stuck;
        if stuck {
            // The interrupt would come at once and for ever, and nothing below it would run.
            self.mailboxes_stuck = self.mailboxes_stuck.wrapping_add(1);
            return;
        }
        // No matter which task collects: a stamp that stays would be mistaken for the next transmission's.
        traffic.await_finished();
    }

    /// Once a millisecond: lets the transmit interrupt come again, if a mailbox that would not be emptied has kept it silent.
    pub fn retry_mailboxes(&mut self, traffic: &mut impl Traffic) {
        self.refused = false;
        if self.held {
            traffic.await_finished();
        }
    }

    /// How often a mailbox went on saying that it had finished, since the start.
    pub const fn mailboxes_stuck(&self) -> u32 {
        self.mailboxes_stuck
    }

    /// Whether anything but queued frames is waiting for [`Self::service`].
    pub fn has_more(&self, now: u64) -> bool {
        let waiting = self.replies_waiting > 0 || self.periodic.is_waiting() || self.dropping.is_some();
        waiting || self.periodic.due() <= now
    }

    /// Whether the gateway waits for [`Self::service`].
    #[inline]
    pub fn has_passing(&self, now: u64) -> bool {
        self.passing && (self.lane.is_ready() || self.lane.due() <= now)
    }

    /// Whether the gateway has sent a frame that is to be compared with what the other channel has sent.
    #[inline]
    pub const fn has_passed(&self) -> bool {
        self.passing && self.lane.has_sent()
    }

    /// Fills free mailboxes with the queue's frames that are due, unless something else goes first.
    pub fn load_due(&mut self, traffic: &mut impl Traffic, now: u64) {
        for _ in 0..MAILBOXES {
            if self.head_due() > now {
                return;
            }
            let Some(mailbox) = self.prepare_head(traffic, now) else { return };
            traffic.request(mailbox);
            self.requested(mailbox);
        }
    }

    /// Writes the queue's head to a mailbox, unless something else goes first at this time. Send it with [`Traffic::request`],
    /// then call [`Self::requested`].
    #[inline]
    pub fn prepare_head(&mut self, traffic: &mut impl Traffic, at: u64) -> Option<u8> {
        // There must be room for everything in a mailbox once it has finished.
        let kept = self.unconfirmed.len() + self.mailboxes.len();
        if kept >= self.unconfirmed.capacity() || self.off || self.has_more(at) {
            return None;
        }
        let head = self.queue.front()?;
        if self.passing && head.at == 0 && self.lane.is_ready() {
            return None;
        }
        let mailbox = head.frame.prepare(traffic);
        self.refused = mailbox.is_none() && !self.mailboxes.are_full();
        mailbox
    }

    /// The queue's head is in this mailbox, and its transmission was requested.
    #[inline]
    pub fn requested(&mut self, mailbox: u8) {
        if let Some(Queued { tag, frame, .. }) = self.queue.pop_front() {
            self.mailboxes.put(mailbox, tag, frame);
        }
    }

    /// Records what has finished, each at its time; false if the record queue has no room for all of them.
    pub fn record<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>) -> bool {
        let mut all = usize::MAX;
        self.record_some(recorder, &mut all)
    }

    /// As [`Self::record`], but at most as many as there is `room` for, from which they are deducted.
    #[inline]
    fn record_some<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, room: &mut usize) -> bool {
        let channel = self.channel;
        while let Some(&Ended { tag, frame, failure, at }) = self.unconfirmed.front() {
            if *room == 0 {
                return false;
            }
            let event = match (failure, frame) {
                (Some(reason), _) => Event::TransmitFailed { channel, tag, reason },
                (None, Outgoing::Classic(frame)) => Event::Transmitted { channel, tag, frame },
                #[cfg(not(target_os = "none"))]
                (None, Outgoing::Fd(frame)) => {
                    if !recorder.fd_confirmation(&TransmittedFd { channel, tag, frame }, at) {
                        return false;
                    }
                    self.unconfirmed.pop_front();
                    *room -= 1;
                    continue;
                }
            };
            if tag >= GATEWAY_TAG {
                self.confirm_passed(recorder, &event, at);
            } else if !recorder.event(&event, at) {
                return false;
            }
            self.unconfirmed.pop_front();
            *room -= 1;
        }
        true
    }

    /// A frame of the gateway has ended. A full record queue does not hold it up: a host that is slow must not disturb the buses.
    #[inline(never)]
    fn confirm_passed<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, event: &Event, at: u64) {
        let is_stale = self.stale > 0;
        self.stale = self.stale.saturating_sub(1);
        match *event {
            Event::Transmitted { channel, tag, frame } => {
                if !is_stale {
                    self.lane.ended((tag - GATEWAY_TAG) as usize, Some((frame, at)));
                }
                recorder.confirm(event, channel, at);
            }
            Event::TransmitFailed { tag, .. } => {
                if !is_stale {
                    self.lane.ended((tag - GATEWAY_TAG) as usize, None);
                }
                // Counted by the rule in any case.
                recorder.aside(event, at);
            }
            _ => {}
        }
    }

    /// Records what has finished or is given up, [`RECORDS_PER_CALL`] at most, and fills free mailboxes with what is due. Returns whether
    /// there are more records, and room for them: then it is to be called again.
    pub fn service<const N: usize>(
        &mut self,
        traffic: &mut impl Traffic,
        recorder: &mut Recorder<'_, N>,
        now: u64,
    ) -> bool {
        let mut room = RECORDS_PER_CALL;
        if !self.record_some(recorder, &mut room) {
            return room == 0;
        }
        if let Some(reason) = self.dropping {
            while let Some(&Queued { tag, .. }) = self.queue.front() {
                if room == 0 {
                    return true;
                }
                if !recorder.event(&Event::TransmitFailed { channel: self.channel, tag, reason }, now) {
                    return false;
                }
                self.failed = self.failed.wrapping_add(1);
                self.queue.pop_front();
                room -= 1;
            }
            self.dropping = None;
        }
        self.fill(traffic, now);
        false
    }

    /// Fills free mailboxes with what is due: at most eight replies and as many frames as there are mailboxes.
    fn fill(&mut self, traffic: &mut impl Traffic, now: u64) {
        if self.off {
            return;
        }
        if self.periodic.due() <= now {
            self.periodic.look(now);
        }
        while self.replies_waiting > 0 {
            if !self.send_reply(traffic) {
                return;
            }
        }
        while self.periodic.is_waiting() {
            if !self.send_periodic(traffic, now) {
                return;
            }
        }
        self.load_due(traffic, now);
        if self.passing {
            self.fill_passing(traffic, now);
        }
    }

    /// Fills all but one of the mailboxes with the gateway's frames, then with those of the queue that gave way to them.
    #[inline(never)]
    fn fill_passing(&mut self, traffic: &mut impl Traffic, now: u64) {
        if self.lane.due() <= now {
            self.unpassed = self.unpassed.saturating_add(self.lane.release(now));
        }
        let mailboxes = &self.mailboxes;
        if self.lane.pauses(now, || mailboxes.passed() > 0) {
            return self.load_due(traffic, now);
        }
        while self.mailboxes.len() < MAILBOXES - 1 {
            let Some(&(rule, frame)) = self.lane.next() else { return self.load_due(traffic, now) };
            // There must be room for everything in a mailbox once it has finished.
            let kept = self.unconfirmed.len() + self.mailboxes.len();
            if kept >= self.unconfirmed.capacity()
                || !self.load(GATEWAY_TAG + u32::from(rule), &frame, traffic)
            {
                return;
            }
            self.lane.loaded();
        }
    }

    /// Whether a frame that becomes due can leave. Otherwise it waits for something other than time: for a mailbox, which an
    /// interrupt announces, or for room in the record queue or a controller that takes frames, which are tried every millisecond. An alarm for it would fire again
    /// and again, and keep USB, which makes the room, from running.
    #[inline]
    fn can_load(&self) -> bool {
        !self.mailboxes.are_full()
            && self.unconfirmed.is_empty()
            && self.dropping.is_none()
            && !self.off
            && !self.refused
    }

    /// When the queue's head is due, if there is one and a mailbox is free: a frame that is already due waits for a mailbox, not
    /// for time. 0 if it has no due time.
    #[inline]
    pub fn head_due(&self) -> u64 {
        if self.mailboxes.are_full() {
            return NEVER;
        }
        self.queue.front().map_or(NEVER, |head| head.at)
    }

    /// When the next periodic entry is due, if its frame can leave then.
    #[inline]
    pub fn periodic_due(&self) -> u64 {
        if self.can_load() { self.periodic.due() } else { NEVER }
    }

    /// The next time at which [`Self::service`] has something to do that no controller interrupt announces.
    #[inline]
    pub fn next_due(&self) -> u64 {
        if !self.can_load() {
            return NEVER;
        }
        let head = self.head_due();
        // A frame without a due time waits for something other than time.
        let due = self.periodic.due().min(if head == 0 { NEVER } else { head });
        if self.passing { due.min(self.lane.due()).min(self.lane.pause_ends()) } else { due }
    }

    fn load(&mut self, tag: u32, frame: &Frame, traffic: &mut impl Traffic) -> bool {
        let Some(mailbox) = traffic.prepare(frame) else {
            self.refused = !self.mailboxes.are_full();
            return false;
        };
        traffic.request(mailbox);
        self.mailboxes.put(mailbox, tag, (*frame).into());
        true
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

    fn send_periodic(&mut self, traffic: &mut impl Traffic, now: u64) -> bool {
        if self.mailboxes.are_full() {
            return false;
        }
        let Some((tag, frame)) = self.periodic.next_frame() else { return false };
        let loaded = self.load(tag, &frame, traffic);
        if loaded {
            self.periodic.loaded(now);
        }
        loaded
    }
}

/// Takes finished transmissions that nobody waits for: one for each mailbox, so that one that goes on reporting cannot hold up the caller.
pub fn forget_finished(traffic: &mut impl Traffic) {
    for _ in 0..MAILBOXES {
        if traffic.take_finished().is_none() {
            return;
        }
    }
}
