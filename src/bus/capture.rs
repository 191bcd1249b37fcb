//! What the tasks of priority 4 do: drain the FIFOs, confirm, record errors, send what is due.
//!
//! The receive interrupt, one priority higher, only reads the stamp timer. If the FIFO holds a single frame, that frame
//! raised the interrupt, so its stamp is its end plus the interrupt's latency. Frames queued behind another, or that arrive
//! while the FIFO is being drained, ended at some unknown earlier time: their stamps say so, and the host tightens them.

mod foreign;
mod gaps;
mod gateway;
mod orders;

pub use orders::Closing;

use cantap_wire::message::{ChannelConfig, GatewayState};
use cantap_wire::record::{ErrorState, LossStage, Stamp, TransmitFailure};
use cantap_wire::{CHANNELS, Channel, Event, Frame, Received};
use gaps::{Gap, Gaps};

use crate::QUEUE_BYTES;
use crate::bus::errors::{ErrorMonitor, StormGuard};
use crate::bus::gateway::Lane;
use crate::bus::queue::Producer;
use crate::bus::recorder::Recorder;
use crate::bus::sof::SofMark;
use crate::bus::time::NEVER;
use crate::bus::transmit::{Transmitter, TxQueue};
use crate::lights::Activity;
use crate::oddities::ChannelOddities;
use crate::ports::{Clock, Traffic};

/// Times that a drain looks at its FIFO. Two suffice for the three frames of a FIFO and one that arrives meanwhile; as many again, because
/// the last frame may still be counted while it is being released; and as many again for nothing.
const LOOKS_PER_DRAIN: usize = 8;
/// Frames that a drain takes: a FIFO's three, and as many again. More cannot have arrived meanwhile: three more take 141 µs, and no drain is
/// as long. A FIFO that has more repeats itself.
const FRAMES_PER_DRAIN: u32 = 6;

/// How often a tick calls [`Capture::on_tick_queues`], each time under a lock of its own: 16 frames that are given up in a millisecond.
pub const CALLS_PER_TICK: usize = 4;

/// An alarm is never set farther ahead than this, a quarter of the timer's range. When it fires, the next one is set.
const ALARM_AHEAD_TICKS: u64 = 1 << 30;

/// How far draining a FIFO has got.
#[derive(Clone, Copy)]
struct Drain {
    /// Frames and overrun as just seen, and not handled yet.
    look: Option<(u8, bool)>,
    /// So many looks are left, [`Self::look`] included.
    looks: usize,
    /// So many frames may still be taken.
    room: u32,
    /// When the interrupt was entered, if nothing has been taken since; otherwise nothing is known about when a frame ended.
    entered: Option<u32>,
}

impl Drain {
    /// One that has only had its first look.
    #[inline]
    const fn whole(look: (u8, bool)) -> Self {
        Self { look: Some(look), looks: LOOKS_PER_DRAIN, room: FRAMES_PER_DRAIN, entered: None }
    }
}

/// Whether a channel was asked to leave its bus. Its FIFO is released again only once it has, since what a release does in between is not
/// known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Leaving {
    No,
    /// What it still receives is recorded. As a rule that is a single frame, the one that was on the bus.
    Closing {
        /// The frame in front is in the FIFO, and already recorded.
        front_is_recorded: bool,
    },
    /// Nobody listens any more.
    Abandoned,
}

impl Leaving {
    /// Whether the FIFO must not be released now.
    #[inline]
    fn keeps_fifo(self, traffic: &impl Traffic) -> bool {
        match self {
            Self::No => false,
            Self::Closing { .. } => traffic.is_leaving(),
            Self::Abandoned => true,
        }
    }

    /// Whether the frame that is now taken out of the FIFO, or given up, has been recorded already.
    const fn take_recorded(&mut self) -> bool {
        let recorded = matches!(self, Self::Closing { front_is_recorded: true });
        if recorded {
            *self = Self::Closing { front_is_recorded: false };
        }
        recorded
    }
}

/// One channel's state.
struct ChannelState<'q> {
    open: Option<ChannelConfig>,
    /// Why its transmissions are aborted, if they are.
    abort_reason: TransmitFailure,
    frames: u32,
    overruns: u32,
    /// Where in the FIFO frames were lost.
    gaps: Gaps,
    leaving: Leaving,
    /// Since the channel left its bus: frames in its FIFO that have not been taken yet.
    left: Option<u8>,
    /// The last drain was given up: the receive interrupt stays silent until the next millisecond.
    held: bool,
    /// How often a drain was given up, since the start.
    drains_given_up: u32,
    errors: ErrorMonitor,
    error_storms: StormGuard,
    transmitter: Transmitter<'q>,
}

/// Everything the tasks of priority 4 share.
pub struct Capture<'q, const N: usize = QUEUE_BYTES> {
    recorder: Recorder<'q, N>,
    channels: [ChannelState<'q>; CHANNELS],
    /// The time at which the alarm is to fire, its lead already taken off; [`NEVER`] if it is off.
    alarm: u64,
    gateway: GatewayState,
    /// The gateway was started without a host, and goes on without one.
    standalone: bool,
    /// Per channel, the counts of frames and of errors and losses at the last [`Self::take_activity`].
    seen: [(u32, u32); CHANNELS],
}

impl<'q, const N: usize> Capture<'q, N> {
    /// Both channels closed, with the memory of their queues.
    pub const fn new(
        producer: Producer<'q, N>,
        queues: &'q mut [TxQueue; CHANNELS],
        lanes: &'q mut [Lane; CHANNELS],
    ) -> Self {
        const fn state<'q>(channel: Channel, queue: &'q mut TxQueue, lane: &'q mut Lane) -> ChannelState<'q> {
            ChannelState {
                open: None,
                abort_reason: TransmitFailure::Aborted,
                frames: 0,
                overruns: 0,
                gaps: Gaps::new(),
                leaving: Leaving::No,
                left: None,
                held: false,
                drains_given_up: 0,
                errors: ErrorMonitor::new(channel),
                error_storms: StormGuard::new(),
                transmitter: Transmitter::new(channel, queue, lane),
            }
        }
        let [first, second] = queues;
        let [to_first, to_second] = lanes;
        Self {
            recorder: Recorder::new(producer),
            channels: [state(Channel::Can1, first, to_first), state(Channel::Can2, second, to_second)],
            alarm: NEVER,
            gateway: GatewayState::Off,
            standalone: false,
            seen: [(0, 0); CHANNELS],
        }
    }

    /// Drains the FIFO. `entered` is the clock, read by the receive interrupt before anything else.
    ///
    /// Returns whether the FIFO is empty, so that the interrupt may come again. If the FIFO does not release its frames, or repeats them, the
    /// interrupt would come at once and for ever, and nothing below it would run: it must stay silent until [`Self::on_tick_receive`].
    #[inline]
    pub fn on_receive<T: Traffic>(
        &mut self,
        channel: Channel,
        both: &mut [T; CHANNELS],
        clock: &impl Clock,
        entered: u32,
    ) -> bool {
        let state = &mut self.channels[channel.index()];
        let traffic = &mut both[channel.index()];
        if state.leaving.keeps_fifo(traffic) {
            self.record_front(channel, traffic, entered);
            return false;
        }
        let mut drain = Drain { entered: Some(entered), ..Drain::whole(traffic.look()) };
        // Nearly always: one frame, which raised the interrupt, and none after it. Apart from all the rest, it takes a tenth less time (measured).
        if drain.look == Some((1, false)) && !state.transmitter.is_watching() {
            drain.entered = None;
            drain.looks -= 1;
            let frame = traffic.receive();
            let taken = u8::from(frame.is_some());
            drain.room -= u32::from(taken);
            if let Some(frame) = frame {
                let at = self.recorder.time(entered);
                Self::record(state, &mut self.recorder, channel, frame, at, Stamp::Exact);
            }
            state.gaps.looked(1, taken, traffic);
            let look = traffic.look();
            if look == (0, false) {
                state.held = false;
                state.gaps.emptied();
                return true;
            }
            drain.look = Some(look);
        }
        self.drain(channel, both, clock, drain)
    }

    /// Part of [`Self::on_tick`]: drains a FIFO whose last drain was given up. Returns whether the receive interrupt, which was left silent
    /// then, may come again.
    pub fn on_tick_receive<T: Traffic>(
        &mut self,
        channel: Channel,
        both: &mut [T; CHANNELS],
        clock: &impl Clock,
    ) -> bool {
        let now = self.recorder.time(clock.now());
        let state = &mut self.channels[channel.index()];
        let traffic = &mut both[channel.index()];
        if state.held && state.leaving != Leaving::No && traffic.take_overrun() {
            state.gaps.overrun(traffic);
            Self::record_gap(state, &mut self.recorder, channel, now);
        }
        state.held && state.leaving == Leaving::No && self.drain_late(channel, both, clock)
    }

    /// Records that frames are missing before the next one in the FIFO, if they are.
    #[cold]
    #[inline(never)]
    fn record_gap(state: &mut ChannelState<'_>, recorder: &mut Recorder<'_, N>, channel: Channel, at: u64) {
        match state.gaps.here() {
            Gap::None => {}
            Gap::Certain => Self::lose(state, recorder, channel, 1, at),
            Gap::Possible => Self::lose(state, recorder, channel, 0, at),
        }
    }

    /// Records that a controller lost this many frames, or more.
    fn lose(
        state: &mut ChannelState<'_>,
        recorder: &mut Recorder<'_, N>,
        channel: Channel,
        count: u32,
        at: u64,
    ) {
        state.overruns = state.overruns.wrapping_add(count);
        recorder.event(&Event::Lost { channel, stage: LossStage::Controller, count, at_least: true }, at);
    }

    /// Counts and records a frame.
    #[inline(always)]
    #[expect(clippy::inline_always, reason = "measured, as for `Recorder::frame`")]
    fn write_frame(
        state: &mut ChannelState<'_>,
        recorder: &mut Recorder<'_, N>,
        channel: Channel,
        frame: Frame,
        at: u64,
        quality: Stamp,
    ) {
        let (data_omitted, omit_stamps) = match &state.open {
            Some(config) => (config.omit_data, config.omit_stamps),
            None => (false, false),
        };
        state.frames = state.frames.wrapping_add(1);
        let stamp = if omit_stamps { Stamp::Omitted } else { quality };
        recorder.frame(&Received { channel, frame, stamp, data_omitted }, at);
    }

    /// Records a frame that was taken out of the FIFO.
    #[inline(always)]
    #[expect(clippy::inline_always, reason = "measured, as for `Recorder::frame`")]
    fn record(
        state: &mut ChannelState<'_>,
        recorder: &mut Recorder<'_, N>,
        channel: Channel,
        frame: Frame,
        at: u64,
        quality: Stamp,
    ) {
        Self::write_frame(state, recorder, channel, frame, at, quality);
        if state.gaps.taken() {
            Self::record_gap(state, recorder, channel, at);
        }
    }

    /// A frame has ended while its channel leaves the bus: records it now, with the interrupt's stamp, and leaves it in the FIFO. From here on
    /// the interrupt stays silent. The stamp is that of a single frame only.
    #[cold]
    #[inline(never)]
    fn record_front(&mut self, channel: Channel, traffic: &impl Traffic, entered: u32) {
        let state = &mut self.channels[channel.index()];
        let was_silent = core::mem::replace(&mut state.held, true);
        if was_silent
            || state.leaving != (Leaving::Closing { front_is_recorded: false })
            || traffic.pending() != 1
        {
            return;
        }
        let Some(frame) = traffic.front() else { return };
        let at = self.recorder.time(entered);
        Self::write_frame(state, &mut self.recorder, channel, frame, at, Stamp::Exact);
        state.leaving = Leaving::Closing { front_is_recorded: true };
    }

    /// Drains the FIFO when nothing is known about when its frames ended. Returns whether it is empty.
    fn drain_late<T: Traffic>(
        &mut self,
        channel: Channel,
        both: &mut [T; CHANNELS],
        clock: &impl Clock,
    ) -> bool {
        let drain = Drain::whole(both[channel.index()].look());
        self.drain(channel, both, clock, drain)
    }

    /// What is left of draining the FIFO. Returns whether it is empty.
    #[inline(never)]
    fn drain<T: Traffic>(
        &mut self,
        channel: Channel,
        both: &mut [T; CHANNELS],
        clock: &impl Clock,
        drain: Drain,
    ) -> bool {
        let index = channel.index();
        let Drain { mut look, looks, mut room, mut entered } = drain;
        let mut reply = false;
        let mut emptied = false;
        for _ in 0..looks {
            let (pending, overrun) = look.take().unwrap_or_else(|| both[index].look());
            if pending == 0 && !overrun {
                emptied = true;
                break;
            }
            // A single frame raised the interrupt; of several, the last may have ended after it was entered.
            let raised = entered.take().filter(|_| pending <= 1).map(|entered| self.recorder.time(entered));
            if overrun {
                let at = raised.unwrap_or_else(|| self.recorder.time(clock.now()));
                let state = &mut self.channels[index];
                state.gaps.overrun(&both[index]);
                Self::record_gap(state, &mut self.recorder, channel, at);
            }
            let mut taken = 0;
            for _ in 0..u32::from(pending).min(room) {
                let Some(frame) = both[index].receive() else { break };
                // Read only now: while the one before was being released, another may have ended.
                let (at, quality) = match raised {
                    Some(at) => (at, Stamp::Exact),
                    None => (self.recorder.time(clock.now()), Stamp::UpperBound),
                };
                room -= 1;
                taken += 1;
                if self.channels[index].transmitter.is_watching() {
                    reply |= self.answer(channel, both, clock, &frame, at);
                }
                let state = &mut self.channels[index];
                Self::record(state, &mut self.recorder, channel, frame, at, quality);
            }
            self.channels[index].gaps.looked(pending, taken, &both[index]);
        }
        let state = &mut self.channels[index];
        state.held = !emptied;
        if emptied {
            state.gaps.emptied();
        } else {
            state.drains_given_up = state.drains_given_up.wrapping_add(1);
        }
        if reply {
            let now = self.recorder.time(clock.now());
            state.transmitter.service(&mut both[index], &mut self.recorder, now);
        }
        emptied
    }

    /// A mailbox has finished. `entered` is the clock, read by the transmit interrupt before anything else; `None` if another task of
    /// this priority, waiting for a due time, has already collected the mailbox.
    pub fn on_transmit<T: Traffic, C: Clock>(
        &mut self,
        channel: Channel,
        traffic: &mut [T; CHANNELS],
        clock: &C,
        entered: Option<u32>,
    ) {
        let ended = if let Some(entered) = entered {
            self.collect(channel, &mut traffic[channel.index()], clock, entered)
        } else {
            traffic[channel.index()].await_finished();
            self.recorder.time(clock.now())
        };
        let patience = ended + Self::patience_ticks::<C>();
        // On a busy bus the next frame is due at once: there is no time to record first, or to return and wait for the
        // alarm.
        self.load_in_time(traffic, clock, patience);
        let state = &mut self.channels[channel.index()];
        let recorded = state.transmitter.record(&mut self.recorder);
        let now = self.recorder.time(clock.now());
        if !recorded || state.transmitter.has_more(now) || state.transmitter.has_passing(now) {
            state.transmitter.service(&mut traffic[channel.index()], &mut self.recorder, now);
        }
        if state.transmitter.has_passed() {
            self.compare_sent();
        }
        // Recording took a while, and the other channel's frame may be due: the alarm would be too late for it.
        self.load_in_time(traffic, clock, patience);
        self.arm(clock);
    }

    /// Waits until `at` and collects the mailboxes that finish meanwhile. Left to their own task, they would keep the interrupt from
    /// stamping the next transmission.
    fn collect_until<T: Traffic, C: Clock>(&mut self, traffic: &mut [T; CHANNELS], clock: &C, at: u32) {
        for channel in Channel::ALL {
            // Collecting takes at most 3 µs per channel.
            if at.wrapping_sub(clock.now()) as i32 <= (C::ALARM_EARLY_TICKS / 4) as i32 {
                return;
            }
            if let Some(stamp) = traffic[channel.index()].stamped() {
                self.collect(channel, &mut traffic[channel.index()], clock, stamp);
            }
        }
    }

    /// Empties the mailboxes that have finished, so that the interrupt can stamp the next. Returns the time of the stamp.
    fn collect(
        &mut self,
        channel: Channel,
        traffic: &mut impl Traffic,
        clock: &impl Clock,
        stamp: u32,
    ) -> u64 {
        let ended = self.recorder.time(stamp);
        let Self { recorder, channels, .. } = self;
        let state = &mut channels[channel.index()];
        let now = || recorder.time(clock.now());
        state.transmitter.collect(traffic, state.abort_reason, ended, now);
        ended
    }

    /// How long a call keeps waiting for what is due: twice the lead of the alarms, so that both the frame it was called for and one
    /// due soon afterwards on the other channel leave in time. For anything later the alarm is set again, since the tasks that drain
    /// the FIFOs come first.
    const fn patience_ticks<C: Clock>() -> u64 {
        2 * C::ALARM_EARLY_TICKS as u64
    }

    /// Setting the alarm, returning, and coming back with the next frame prepared takes up to 9 µs. A frame due sooner is waited for.
    const fn return_ticks<C: Clock>() -> u32 {
        C::ALARM_EARLY_TICKS / 4 * 3
    }

    /// Sends the queued frames that are due, and waits for those due too soon for the alarm: until `patience` ends, and beyond that
    /// only from one frame to the next while they are too close together for the alarm. That is six frames at most, one per mailbox.
    /// Everything but the request itself is done ahead of time, so that two frames due at the same moment leave at the same moment.
    #[inline]
    fn load_in_time<T: Traffic, C: Clock>(&mut self, traffic: &mut [T; CHANNELS], clock: &C, patience: u64) {
        let heads = self.due(Transmitter::head_due);
        // Usually the mailboxes have just been filled.
        if heads.iter().any(|&at| at != NEVER) {
            self.load_heads(traffic, clock, patience, heads);
        }
    }

    /// The rest of [`Self::load_in_time`]; `heads` are the times at which the queues' first frames are due.
    #[inline(never)]
    fn load_heads<T: Traffic, C: Clock>(
        &mut self,
        traffic: &mut [T; CHANNELS],
        clock: &C,
        patience: u64,
        mut heads: [u64; CHANNELS],
    ) {
        let early = C::ALARM_EARLY_TICKS;
        loop {
            let now = self.recorder.time(clock.now());
            if heads.iter().all(|&at| at == 0 || at == NEVER) {
                // These frames have no due time: there is nothing to wait for.
                for ((state, traffic), at) in self.channels.iter_mut().zip(traffic).zip(heads) {
                    if at == 0 {
                        state.transmitter.load_due(traffic, now);
                    }
                }
                return;
            }
            // Ticks from now, or 0 if the time has passed. 32 bits halve the work.
            let ahead = |at: u64| u32::try_from(at.saturating_sub(now)).unwrap_or(u32::MAX);
            let [first, second] = heads.map(ahead);
            let next = first.min(second);
            if next > early.min(ahead(patience)).max(Self::return_ticks::<C>()) {
                return;
            }
            // Prepare now what is due soon after: there is no time for it between the two. Never wait past a periodic frame's due
            // time; if it is already due, waiting does not matter.
            let periodic = self.due(Transmitter::periodic_due).map(ahead);
            let periodic = periodic.into_iter().filter(|ahead| *ahead > 0).min().unwrap_or(u32::MAX);
            let until = (next + early / 2).min(periodic);
            let mut mailboxes = [None; CHANNELS];
            for (channel, ahead) in [first, second].into_iter().enumerate() {
                if ahead <= until {
                    let transmitter = &mut self.channels[channel].transmitter;
                    mailboxes[channel] =
                        transmitter.prepare_head(&mut traffic[channel], now.max(heads[channel]));
                }
            }
            if mailboxes.iter().all(Option::is_none) {
                return;
            }
            for channel in if first <= second { [0, 1] } else { [1, 0] } {
                let Some(mailbox) = mailboxes[channel] else { continue };
                if heads[channel] > now {
                    let at = heads[channel] as u32;
                    self.collect_until(traffic, clock, at);
                    clock.wait_until(at);
                }
                traffic[channel].request(mailbox);
            }
            for (state, mailbox) in self.channels.iter_mut().zip(mailboxes) {
                if let Some(mailbox) = mailbox {
                    state.transmitter.requested(mailbox);
                }
            }
            heads = self.due(Transmitter::head_due);
            if heads.iter().all(|&at| at == NEVER) {
                return;
            }
        }
    }

    /// The error interrupt. Returns whether it may come again. If its flag does not clear, it would come at once and for ever: it must stay
    /// silent until [`Self::take_errors_held`].
    pub fn on_error(&mut self, channel: Channel, traffic: &mut impl Traffic, entered: u32) -> bool {
        let now = self.recorder.time(entered);
        let state = &mut self.channels[channel.index()];
        state.errors.update(traffic, &mut self.recorder, now);
        Self::give_up_when_off(state, traffic);
        state.error_storms.admits(entered)
    }

    /// Part of [`Self::on_tick`]: whether an open channel's error interrupt, which was left silent, may come again.
    pub const fn take_errors_held(&mut self, channel: Channel) -> bool {
        let state = &mut self.channels[channel.index()];
        state.open.is_some() && state.error_storms.take_held()
    }

    /// The alarm: something is due for transmission.
    pub fn on_alarm<T: Traffic, C: Clock>(&mut self, traffic: &mut [T; CHANNELS], clock: &C) {
        let patience = self.recorder.time(clock.now()) + Self::patience_ticks::<C>();
        self.load_in_time(traffic, clock, patience);
        let mut now = self.recorder.time(clock.now());
        let [first, second] = self.due(Transmitter::periodic_due);
        let due = first.min(second);
        if due > now && due <= patience.min(now + u64::from(C::ALARM_EARLY_TICKS)) {
            clock.wait_until(due as u32);
            now = self.recorder.time(clock.now());
        }
        let mut serviced = false;
        for (state, traffic) in self.channels.iter_mut().zip(traffic.iter_mut()) {
            let due = state.transmitter.has_more(now) || state.transmitter.has_passing(now);
            if state.open.is_some() && due {
                state.transmitter.service(traffic, &mut self.recorder, now);
                serviced = true;
            }
        }
        if serviced {
            self.load_in_time(traffic, clock, patience);
        }
        self.arm(clock);
    }

    /// Once a millisecond: keeps time, reads what no interrupt reports, retries what had no room.
    pub fn on_tick<T: Traffic>(&mut self, both: &mut [T; CHANNELS], clock: &impl Clock) {
        for channel in Channel::ALL {
            self.on_tick_receive(channel, both, clock);
            let traffic = &mut both[channel.index()];
            self.take_errors_held(channel);
            if self.on_tick_errors(channel, traffic, clock) {
                for _ in 0..CALLS_PER_TICK {
                    if !self.on_tick_queues(channel, traffic, clock) {
                        break;
                    }
                }
                self.on_tick_losses(channel, clock);
            }
        }
    }

    /// A USB frame has started.
    pub fn on_sof(&mut self, mark: SofMark) {
        let at = self.recorder.time(mark.at);
        self.recorder.aside(&mark.event, at);
    }

    /// Part of [`Self::on_tick`], for callers that must let the alarm in between the parts: handles a channel's errors. Returns whether
    /// the channel is open; if it is not, the parts that follow have nothing to do.
    pub fn on_tick_errors(
        &mut self,
        channel: Channel,
        traffic: &mut impl Traffic,
        clock: &impl Clock,
    ) -> bool {
        let now = self.recorder.time(clock.now());
        let state = &mut self.channels[channel.index()];
        if state.open.is_none() {
            return false;
        }
        state.errors.update(traffic, &mut self.recorder, now);
        state.errors.tick(&mut self.recorder, now);
        Self::give_up_when_off(state, traffic);
        true
    }

    /// Part of [`Self::on_tick`]: what a channel sends. Returns whether to call it again, at most [`CALLS_PER_TICK`] times in all.
    pub fn on_tick_queues(
        &mut self,
        channel: Channel,
        traffic: &mut impl Traffic,
        clock: &impl Clock,
    ) -> bool {
        let now = self.recorder.time(clock.now());
        let state = &mut self.channels[channel.index()];
        state.transmitter.retry_mailboxes(traffic);
        // Mailboxes that finish meanwhile are left to the interrupt, which knows when they did.
        state.transmitter.service(traffic, &mut self.recorder, now)
    }

    /// Last part of [`Self::on_tick`]: periods that passed without a frame, and what was lost; sets the alarm.
    pub fn on_tick_losses(&mut self, channel: Channel, clock: &impl Clock) {
        let now = self.recorder.time(clock.now());
        self.channels[channel.index()].transmitter.tick(&mut self.recorder, now);
        self.recorder.tick(now);
        self.arm(clock);
    }

    /// A controller that stays bus-off sends nothing more: its queue is given up, frame by frame, and periodic frames wait. The
    /// next tick begins with the records.
    fn give_up_when_off(state: &mut ChannelState<'_>, traffic: &mut impl Traffic) {
        let off = state.errors.status().state == ErrorState::BusOff;
        if off {
            state.transmitter.lose_ready();
        }
        let off = off && state.open.is_some_and(|config| config.manual_recovery);
        state.transmitter.set_off(off);
        if off && state.transmitter.pending() > 0 {
            state.abort_reason = TransmitFailure::BusOff;
            state.transmitter.drop_all(TransmitFailure::BusOff, traffic);
        }
    }

    /// When something is due on each open channel; [`NEVER`] on the others.
    #[inline]
    fn due(&self, of: impl Fn(&Transmitter<'q>) -> u64) -> [u64; CHANNELS] {
        self.channels
            .each_ref()
            .map(|state| if state.open.is_some() { of(&state.transmitter) } else { NEVER })
    }

    /// Sets the alarm for what is due next.
    pub fn arm<C: Clock>(&mut self, clock: &C) {
        let [first, second] = self.due(Transmitter::next_due);
        let next = first.min(second);
        if next == NEVER {
            if self.alarm != NEVER {
                self.alarm = NEVER;
                clock.set_alarm(None);
            }
            return;
        }
        let now = self.recorder.time(clock.now());
        let early = next.saturating_sub(u64::from(C::ALARM_EARLY_TICKS));
        // Not earlier than now: the 32-bit timer would take a time long past for one far ahead.
        let at = early.clamp(now, now + ALARM_AHEAD_TICKS);
        // An alarm that is still to come is already set.
        if at != self.alarm || at <= now {
            self.alarm = at;
            clock.set_alarm(Some(at as u32));
        }
    }

    /// The 64-bit time now.
    pub fn now(&mut self, clock: &impl Clock) -> u64 {
        self.recorder.time(clock.now())
    }

    /// What happened since the last call, for the LEDs.
    pub fn take_activity(&mut self) -> Activity {
        let seen = Channel::ALL.map(|channel| {
            let state = &self.channels[channel.index()];
            let (sent, failed) = state.transmitter.counters();
            let lost = self.recorder.lost(channel).wrapping_add(state.overruns);
            let traffic = state.frames.wrapping_add(sent);
            (traffic, state.errors.errors().wrapping_add(lost).wrapping_add(failed))
        });
        let bus_off = self.channels.iter().any(|state| state.errors.status().state == ErrorState::BusOff);
        let new = |part: fn(&(u32, u32)) -> u32| seen.iter().map(part).ne(self.seen.iter().map(part));
        let activity = Activity {
            traffic: new(|seen| seen.0),
            error: bus_off || new(|seen| seen.1),
            standalone: self.is_standalone(),
        };
        self.seen = seen;
        activity
    }

    /// How often each channel's hardware did not do as it should, since the start.
    pub fn oddities(&self) -> [ChannelOddities; CHANNELS] {
        self.channels.each_ref().map(|state| ChannelOddities {
            drains_given_up: state.drains_given_up,
            error_storms: state.error_storms.storms(),
            mailboxes_stuck: state.transmitter.mailboxes_stuck(),
        })
    }

    /// Bytes in the queue, and the most there ever were.
    pub fn fill(&self) -> (u32, u32) {
        self.recorder.fill()
    }
}

#[cfg(any(feature = "disturb", not(target_os = "none")))]
mod disturb;
