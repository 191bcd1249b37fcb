//! Records of controllers that are not a board's own: other makers' adapters stamp their frames and count their losses themselves.
//! The board's own tasks use none of this.

use cantap_wire::record::{LossStage, Stamp};
use cantap_wire::{Channel, Event, Frame};

use super::Capture;
use crate::ports::{Clock, Traffic};

impl<const N: usize> Capture<'_, N> {
    /// Records a received frame with the time that its controller gives, in ticks of this device's clock, and what that means. Replies to
    /// it follow.
    pub fn on_stamped_frame(
        &mut self,
        channel: Channel,
        frame: Frame,
        at: u64,
        stamp: Stamp,
        traffic: &mut impl Traffic,
        clock: &impl Clock,
    ) {
        let state = &mut self.channels[channel.index()];
        if Self::record(state, &mut self.recorder, channel, frame, at, stamp) {
            let now = self.recorder.time(clock.now());
            state.transmitter.service(traffic, &mut self.recorder, now);
        }
    }

    /// Records an event that the controller reports. Returns whether there was room for it: if not, report it again later.
    pub fn on_reported(&mut self, event: &Event, at: u64) -> bool {
        let written = self.recorder.event(event, at);
        if let (true, Event::Lost { channel, stage: LossStage::Controller, count, .. }) = (written, event) {
            let state = &mut self.channels[channel.index()];
            state.overruns = state.overruns.wrapping_add(*count);
        }
        written
    }
}
