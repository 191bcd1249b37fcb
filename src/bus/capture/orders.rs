//! What commands ask of the capture: sessions, channels on and off their buses, counters.

use cantap_wire::message::{ChannelConfig, ChannelStatus, GatewayEnd, GatewayState, Registers};
use cantap_wire::record::{LossStage, Stamp, TransmitFailure};
use cantap_wire::{CHANNELS, Channel, Event};

use super::gaps::{Gap, Gaps};
use super::{Capture, LOOKS_PER_DRAIN, Leaving};
use crate::bus::errors::ErrorMonitor;
use crate::bus::transmit::{Transmitter, forget_finished};
use crate::ports::{Clock, Traffic};

/// How far a step of [`Capture::finish_close`] has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Closing {
    /// The channel is closed, and its last record is written.
    Done,
    /// There is more to record, and room for it: the next step may follow at once.
    Continue,
    /// The queue has no room, or a mailbox has not yet reported its end.
    Wait,
}

impl<'q, const N: usize> Capture<'q, N> {
    /// Starts a session: counters at zero. Both channels are closed and the queue is empty.
    ///
    /// Returns the time from which the first record's difference counts. The sender must start from the
    /// same value: a later reading would shift every stamp of the session.
    pub fn restart(&mut self, clock: &impl Clock) -> u64 {
        let now = self.now(clock);
        self.recorder.restart(now);
        self.forget_gateway();
        for state in &mut self.channels {
            state.frames = 0;
            state.overruns = 0;
            state.gaps = Gaps::new();
            state.errors = ErrorMonitor::new(state.errors.channel());
            state.transmitter.clear();
            state.transmitter.reset_counters();
        }
        now
    }

    /// Starts a session beside a gateway that goes on: as [`Self::restart`], but what is the gateway's is not forgotten.
    pub fn restart_beside_gateway<T: Traffic>(
        &mut self,
        both: &mut [T; CHANNELS],
        clock: &impl Clock,
    ) -> u64 {
        let now = self.now(clock);
        self.recorder.restart(now);
        for (state, traffic) in self.channels.iter_mut().zip(both) {
            state.abort_reason = TransmitFailure::Aborted;
            state.transmitter.forget_host(traffic);
            state.frames = 0;
            state.overruns = 0;
            state.transmitter.reset_counters();
        }
        now
    }

    /// The channel is about to join the bus.
    pub fn open(&mut self, channel: Channel, config: ChannelConfig, clock: &impl Clock) {
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        state.open = Some(config);
        state.abort_reason = TransmitFailure::Aborted;
        (state.leaving, state.left, state.gaps) = (Leaving::No, None, Gaps::new());
        state.errors.restart();
        self.recorder.event(&Event::Started { channel }, now);
    }

    /// The channel's filters let nothing pass for a moment. The controller does not even count what arrived then.
    pub fn was_deaf(&mut self, channel: Channel, clock: &impl Clock) {
        let now = self.now(clock);
        let lost = Event::Lost { channel, stage: LossStage::Controller, count: 0, at_least: true };
        self.recorder.event(&lost, now);
    }

    /// First part of closing: a gateway, periodic frames and replies end. [`Self::begin_close`] follows, under a lock of its own.
    pub fn end_entries(&mut self, channel: Channel, clock: &impl Clock) {
        self.end_gateway(GatewayState::Ended(GatewayEnd::ChannelClosed));
        let now = self.now(clock);
        self.channels[channel.index()].transmitter.clear_entries(now);
    }

    /// Second part of closing: aborts transmissions, and drains a FIFO whose last drain was given up. Any other is left to its interrupt, which
    /// knows when a frame ended. The channel is still on the bus.
    pub fn begin_close<T: Traffic>(
        &mut self,
        channel: Channel,
        both: &mut [T; CHANNELS],
        clock: &impl Clock,
    ) {
        if self.channels[channel.index()].held {
            self.drain_late(channel, both, clock);
        }
        let traffic = &mut both[channel.index()];
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        state.abort_reason = TransmitFailure::Closed;
        state.transmitter.drop_all(TransmitFailure::Closed, traffic);
        state.transmitter.on_finished(traffic, &mut self.recorder, now, state.abort_reason);
    }

    /// Third part of closing, immediately before the channel is asked to leave the bus: from here on its FIFO is not released any more. In a lock
    /// of its own, so that frames which ended during the one before have been taken as usual.
    pub fn begin_leaving(&mut self, channel: Channel) {
        self.channels[channel.index()].leaving = Leaving::Closing { front_is_recorded: false };
    }

    /// Fourth part of closing: the channel has left the bus. Takes what is still in its FIFO, and returns whether that is empty now. Call
    /// it until it is.
    ///
    /// No manual promises that a frame can be released in initialisation mode. But none arrives any more, so their number says
    /// whether the frame in front is another one: none is taken twice.
    pub fn close_fifo(&mut self, channel: Channel, traffic: &mut impl Traffic, clock: &impl Clock) -> bool {
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        let mut left = state.left.unwrap_or_else(|| traffic.pending());
        if traffic.take_overrun() {
            state.gaps.overrun(traffic);
        }
        Self::record_gap(state, &mut self.recorder, channel, now);
        while left > 0 && traffic.pending() <= left {
            let Some(frame) = traffic.receive() else { break };
            left -= 1;
            if !state.leaving.take_recorded() {
                Self::write_frame(state, &mut self.recorder, channel, frame, now, Stamp::UpperBound);
            }
            if state.gaps.taken() {
                Self::record_gap(state, &mut self.recorder, channel, now);
            }
        }
        state.left = Some(left);
        left == 0 && traffic.pending() == 0
    }

    /// The FIFO of a channel that has left the bus does not release its frames, and the controller's reset is about to empty it: records
    /// those that were not taken as lost.
    pub fn lose_fifo(&mut self, channel: Channel, clock: &impl Clock) {
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        let left = state.left.replace(0).unwrap_or(0);
        let left = left.saturating_sub(u8::from(state.leaving.take_recorded()));
        let gap = state.gaps.rest();
        if left > 0 || gap != Gap::None {
            let count = left + u8::from(gap == Gap::Certain);
            Self::lose(state, &mut self.recorder, channel, count.into(), now);
        }
    }

    /// Last part of closing, in steps, each with as few records as one lock allows: records what is left of the channel, and its end. If
    /// `overdue`, mailboxes are no longer waited for.
    pub fn finish_close(
        &mut self,
        channel: Channel,
        traffic: &mut impl Traffic,
        clock: &impl Clock,
        overdue: bool,
    ) -> Closing {
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        let transmitter = &mut state.transmitter;
        let go_on = |has_room: bool| if has_room { Closing::Continue } else { Closing::Wait };
        if !transmitter.is_idle() {
            if transmitter.waits_for_mailboxes() && overdue {
                transmitter.give_up_mailboxes(traffic, &mut self.recorder, now, state.abort_reason);
                return go_on(transmitter.is_idle());
            }
            let more = transmitter.on_finished(traffic, &mut self.recorder, now, state.abort_reason);
            return go_on(more || transmitter.is_idle() || transmitter.waits_for_mailboxes() && overdue);
        }
        if transmitter.owes() {
            return go_on(transmitter.tell_rest(&mut self.recorder, now));
        }
        state.errors.flush(&mut self.recorder, now);
        self.recorder.flush_losses(now);
        if !self.recorder.event(&Event::Stopped { channel }, now) {
            return Closing::Wait;
        }
        state.open = None;
        self.arm(clock);
        Closing::Done
    }

    /// Nobody listens any more: nothing more is sent. The channel is still on the bus.
    pub fn begin_abandon(&mut self, channel: Channel, traffic: &mut impl Traffic) {
        self.forget_gateway();
        let state = &mut self.channels[channel.index()];
        state.leaving = Leaving::Abandoned;
        state.transmitter.clear();
        traffic.abort();
    }

    /// The channel has left the bus and nobody listens: forgets it, unrecorded. Returns whether its FIFO is empty now.
    pub fn abandon(&mut self, channel: Channel, traffic: &mut impl Traffic) -> bool {
        // What is still in a mailbox would otherwise be sent in the next session.
        traffic.abort();
        // Of a FIFO's three frames, the last may still be on its way out.
        for _ in 0..LOOKS_PER_DRAIN {
            if traffic.receive().is_none() && traffic.pending() == 0 {
                break;
            }
        }
        traffic.take_overrun();
        forget_finished(traffic);
        let state = &mut self.channels[channel.index()];
        state.transmitter.clear();
        state.open = None;
        traffic.pending() == 0
    }

    /// The configuration the channel was opened with; `None` if it is closed.
    pub const fn config(&self, channel: Channel) -> Option<&ChannelConfig> {
        self.channels[channel.index()].open.as_ref()
    }

    /// The channel's transmissions; call [`Self::kick`] afterwards.
    pub const fn transmitter(&mut self, channel: Channel) -> &mut Transmitter<'q> {
        &mut self.channels[channel.index()].transmitter
    }

    /// Sends what is due, after a change to [`Self::transmitter`].
    pub fn kick(&mut self, channel: Channel, traffic: &mut impl Traffic, clock: &impl Clock) {
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        state.transmitter.service(traffic, &mut self.recorder, now);
        self.arm(clock);
    }

    /// Gives up everything queued for transmission.
    pub fn abort(&mut self, channel: Channel, traffic: &mut impl Traffic, clock: &impl Clock) {
        let state = &mut self.channels[channel.index()];
        state.abort_reason = TransmitFailure::Aborted;
        state.transmitter.drop_all(TransmitFailure::Aborted, traffic);
        self.kick(channel, traffic, clock);
    }

    /// The channel's part of the status.
    pub fn status(&mut self, channel: Channel, clock: &impl Clock) -> ChannelStatus {
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        state.transmitter.count_overtaken(now);
        let errors = state.errors.status();
        let (transmitted, transmit_failures) = state.transmitter.counters();
        ChannelStatus {
            open: state.open,
            state: errors.state,
            tec: errors.tec,
            rec: errors.rec,
            last_error: state.errors.last_error(),
            frames: state.frames.wrapping_add(self.recorder.lost_sent(channel)),
            lost_controller: state.overruns,
            lost_queue: self.recorder.lost(channel),
            bus_errors: state.errors.errors(),
            transmitted,
            transmit_failures,
            tx_pending: state.transmitter.pending() as u16,
        }
    }

    /// The controller's registers now and at the last error.
    pub fn registers(&self, channel: Channel, traffic: &impl Traffic) -> Registers {
        let at_last_error = self.channels[channel.index()].errors.registers();
        Registers { now: traffic.registers(), at_last_error }
    }
}
