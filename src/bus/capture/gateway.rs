//! The gateway: frames that one channel receives are sent on the other.
//!
//! The drain passes each frame on before it records it. Without a gateway nothing of this is reached: what decides is the flag that replies
//! have anyway, read once per drain.

use cantap_wire::message::{GatewayEnd, GatewayRule, GatewayState, GatewayStatus, Mode};
use cantap_wire::{CHANNELS, Channel, Frame, Refusal};

use super::Capture;
use crate::bus::gateway::{Lane, other};
use crate::ports::{Clock, Traffic};
use crate::{CAN_CLOCK_HZ, TICK_HZ};

impl<const N: usize> Capture<'_, N> {
    /// A frame was taken out of a FIFO, and is not recorded yet: the gateway passes it on, since its bus is waiting. Returns whether there
    /// are replies to it, which follow once the FIFO is empty.
    #[inline(never)]
    pub(super) fn answer<T: Traffic>(
        &mut self,
        channel: Channel,
        both: &mut [T; CHANNELS],
        clock: &impl Clock,
        frame: &Frame,
        at: u64,
    ) -> bool {
        let replies = self.channels[channel.index()].transmitter.on_frame(frame);
        if self.gateway == GatewayState::Running {
            self.pass_on(other(channel), both, clock, frame, at);
        }
        replies
    }

    /// This channel sends what the rules make of a frame that the other has just received: it is compared with 32 rules, and two frames go into
    /// mailboxes.
    #[inline(never)]
    fn pass_on<T: Traffic>(
        &mut self,
        to: Channel,
        traffic: &mut [T; CHANNELS],
        clock: &impl Clock,
        frame: &Frame,
        at: u64,
    ) {
        let now = self.recorder.time(clock.now());
        let transmitter = &mut self.channels[to.index()].transmitter;
        transmitter.pass(frame, at);
        if transmitter.lane().is_loop() {
            transmitter.found_loop();
            return self.end_gateway(GatewayState::Ended(GatewayEnd::Loop));
        }
        transmitter.service(&mut traffic[to.index()], &mut self.recorder, now);
        self.arm(clock);
    }

    /// The gateway has sent a frame: whether the other channel has sent it at the same time, as it does on one bus.
    #[cold]
    #[inline(never)]
    pub(super) fn compare_sent(&mut self) {
        let [first, second] = &mut self.channels;
        Lane::compare_sent(first.transmitter.lane(), second.transmitter.lane());
    }

    /// Sets a rule for what this channel receives, or removes it and those after it.
    pub fn set_rule(&mut self, from: Channel, slot: usize, rule: Option<GatewayRule>) -> Result<(), Refusal> {
        if self.gateway == GatewayState::Running {
            return Err(Refusal::GatewayRunning);
        }
        let set = self.transmitter(other(from)).lane().set_rule(slot, rule);
        if set { Ok(()) } else { Err(Refusal::BadSlot) }
    }

    /// A rule for what this channel receives.
    pub fn rule(&mut self, from: Channel, slot: usize) -> Option<GatewayRule> {
        self.transmitter(other(from)).lane().rule(slot).cloned()
    }

    /// How many rules there are for what this channel receives.
    pub fn rules(&mut self, from: Channel) -> usize {
        self.transmitter(other(from)).lane().rules()
    }

    /// Starts the gateway.
    pub fn start_gateway(&mut self, standalone: bool) -> Result<(), Refusal> {
        if self.gateway == GatewayState::Running {
            return Err(Refusal::GatewayRunning);
        }
        let mut bits_ticks = [0; CHANNELS];
        for (state, bit_ticks) in self.channels.iter().zip(&mut bits_ticks) {
            match &state.open {
                None => return Err(Refusal::ChannelClosed),
                Some(config) if config.mode != Mode::Normal => return Err(Refusal::NotNormal),
                Some(config) => *bit_ticks = config.timing.clocks_per_bit().div_ceil(CAN_CLOCK_HZ / TICK_HZ),
            }
        }
        for (state, bit_ticks) in self.channels.iter_mut().zip(bits_ticks) {
            state.transmitter.start_passing(bit_ticks);
        }
        (self.gateway, self.standalone) = (GatewayState::Running, standalone);
        Ok(())
    }

    /// Ends the gateway, if it runs.
    #[cold]
    #[inline(never)]
    pub fn end_gateway(&mut self, state: GatewayState) {
        if self.gateway == GatewayState::Running {
            self.channels.iter_mut().for_each(|channel| channel.transmitter.stop_passing());
            self.gateway = state;
        }
        self.standalone &= state == GatewayState::Ended(GatewayEnd::Loop);
    }

    /// No gateway has run in this session. That one without a host has found a loop is for the next host.
    pub(super) fn forget_gateway(&mut self) {
        if !self.standalone || self.gateway == GatewayState::Running {
            (self.gateway, self.standalone) = (GatewayState::Off, false);
        }
    }

    /// Whether a gateway runs that was started without a host.
    pub fn is_standalone(&self) -> bool {
        self.standalone && self.gateway == GatewayState::Running
    }

    /// One direction's state, with the counts of the rules from `first` on.
    pub fn gateway_status(&mut self, from: Channel, first: usize) -> GatewayStatus {
        let (state, standalone) = (self.gateway, self.is_standalone());
        let lane = self.transmitter(other(from)).lane();
        let (unmatched, counts) = lane.counts(first);
        GatewayStatus {
            state,
            standalone,
            from,
            unmatched,
            waiting: lane.waiting() as u16,
            rules: lane.rules() as u8,
            first: first as u8,
            counts,
        }
    }
}
