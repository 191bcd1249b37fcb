//! What commands ask of the capture: sessions, channels on and off their buses, counters.

use cantap_wire::Channel;
use cantap_wire::Event;
use cantap_wire::message::{ChannelConfig, ChannelStatus, Registers};
use cantap_wire::record::{LossStage, TransmitFailure};

use super::Capture;
use crate::bus::errors::ErrorMonitor;
use crate::bus::transmit::Transmitter;
use crate::ports::{Clock, Traffic};

impl<'q, const N: usize> Capture<'q, N> {
    /// Starts a session: counters at zero. Both channels are closed and the queue is empty.
    ///
    /// Returns the time from which the first record's difference counts. The sender must start from the
    /// same value: a later reading would shift every stamp of the session.
    pub fn restart(&mut self, clock: &impl Clock) -> u64 {
        let now = self.now(clock);
        self.recorder.restart(now);
        for state in &mut self.channels {
            state.frames = 0;
            state.overruns = 0;
            state.errors = ErrorMonitor::new(state.errors.channel());
            state.transmitter.clear();
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
        state.errors.restart();
        self.recorder.event(&Event::Started { channel }, now);
    }

    /// The channel's filters let nothing pass for a moment. The controller does not even count what arrived then.
    pub fn was_deaf(&mut self, channel: Channel, clock: &impl Clock) {
        let now = self.now(clock);
        let lost = Event::Lost { channel, stage: LossStage::Controller, count: 0, at_least: true };
        self.recorder.event(&lost, now);
    }

    /// First half of closing: aborts transmissions. The channel is still on the bus.
    pub fn begin_close(&mut self, channel: Channel, traffic: &mut impl Traffic, clock: &impl Clock) {
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        state.abort_reason = TransmitFailure::Closed;
        state.transmitter.clear_entries(now);
        state.transmitter.drop_all(TransmitFailure::Closed, traffic);
        state.transmitter.on_finished(traffic, &mut self.recorder, now, state.abort_reason);
    }

    /// Second half of closing: the channel has left the bus. Records the rest and returns true; or false if
    /// the queue has no room for it yet, or a mailbox has not yet reported its abort. If `overdue`, mailboxes
    /// are no longer waited for.
    pub fn finish_close(
        &mut self,
        channel: Channel,
        traffic: &mut impl Traffic,
        clock: &impl Clock,
        overdue: bool,
    ) -> bool {
        let entered = clock.now();
        self.on_receive(channel, traffic, clock, entered);
        let now = self.now(clock);
        let state = &mut self.channels[channel.index()];
        state.transmitter.on_finished(traffic, &mut self.recorder, now, state.abort_reason);
        if overdue {
            state.transmitter.give_up_mailboxes(traffic, &mut self.recorder, now, state.abort_reason);
        }
        let all_told = state.transmitter.tell_rest(&mut self.recorder, now);
        state.errors.flush(&mut self.recorder, now);
        self.recorder.flush_losses(now);
        if !all_told || !state.transmitter.is_idle() || !self.recorder.event(&Event::Stopped { channel }, now)
        {
            return false;
        }
        state.open = None;
        self.arm(clock);
        true
    }

    /// Nobody listens any more: nothing more is sent. The channel is still on the bus.
    pub fn begin_abandon(&mut self, channel: Channel, traffic: &mut impl Traffic) {
        self.channels[channel.index()].transmitter.clear();
        traffic.abort();
    }

    /// The channel has left the bus and nobody listens: forgets it, unrecorded.
    pub fn abandon(&mut self, channel: Channel, traffic: &mut impl Traffic) {
        // What is still in a mailbox would otherwise be sent in the next session.
        traffic.abort();
        while traffic.receive().is_some() {}
        traffic.take_overrun();
        while traffic.take_finished().is_some() {}
        let state = &mut self.channels[channel.index()];
        state.transmitter.clear();
        state.open = None;
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
            frames: state.frames,
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
