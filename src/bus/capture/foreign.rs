//! Records of controllers that are not a board's own: other makers' adapters stamp their frames and count their losses themselves.
//! The board's own tasks use none of this.

use cantap_wire::record::{LossStage, Stamp};
use cantap_wire::{Channel, Event, FdFrame, Frame, ReceivedFd};

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
        let reply = state.transmitter.on_frame(&frame);
        Self::record(state, &mut self.recorder, channel, frame, at, stamp);
        if reply {
            let now = self.recorder.time(clock.now());
            state.transmitter.service(traffic, &mut self.recorder, now);
        }
    }

    /// The same for a CAN FD frame. It has no replies: a reply answers a classical frame.
    pub fn on_stamped_fd_frame(&mut self, channel: Channel, frame: FdFrame, at: u64, stamp: Stamp) {
        let state = &mut self.channels[channel.index()];
        let (data_omitted, omit_stamps) =
            state.open.as_ref().map_or((false, false), |config| (config.omit_data, config.omit_stamps));
        state.frames = state.frames.wrapping_add(1);
        let stamp = if omit_stamps { Stamp::Omitted } else { stamp };
        self.recorder.fd_frame(&ReceivedFd { channel, frame, stamp, data_omitted }, at);
        if state.gaps.taken() {
            Self::record_gap(state, &mut self.recorder, channel, at);
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
