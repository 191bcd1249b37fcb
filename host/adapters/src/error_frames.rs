//! Linux's error frames, as interfaces and gs_usb adapters report them, with what they leave out: the state that goes on.

use cantap_trace::TraceEvent;
use cantap_trace::socketcan::ErrorFrame;
use cantap_wire::Channel;
use cantap_wire::record::{ErrorState, LossStage};

use crate::driver::{At, Incoming, Oddities};

/// The errors of one channel.
#[derive(Default)]
pub(crate) struct ErrorFrames {
    state: Option<(ErrorState, (u8, u8))>,
}

impl ErrorFrames {
    /// The last state, if one was reported.
    pub fn state(&self) -> Option<ErrorState> {
        self.state.map(|(state, _)| state)
    }

    /// Reports what an error frame says. Returns whether the controller has overrun.
    pub fn take(
        &mut self,
        error: ErrorFrame,
        channel: Channel,
        at: At,
        reports: &mut Vec<Incoming>,
        oddities: &mut Oddities,
    ) -> bool {
        if !error.is_told_whole() {
            oddities.count("details of errors that have no place here, such as their position in the frame");
        }
        let mut has_overrun = false;
        let (first, second) = error.events();
        for event in [Some(first), second].into_iter().flatten() {
            match event {
                TraceEvent::Lost { stage: None | Some(LossStage::Controller), .. } => {
                    has_overrun = true;
                    let stage = LossStage::Controller;
                    reports.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
                }
                TraceEvent::State { state, counters } => self.set(state, counters, channel, at, reports),
                TraceEvent::BusError { counters, .. } => {
                    if let (Some(_), Some(state)) = (counters, self.state()) {
                        self.set(state, counters, channel, at, reports);
                    }
                    reports.extend(Incoming::of(&event, channel, at));
                }
                TraceEvent::TransmitFailed { .. } => oddities.count("attempts to send that failed"),
                _ => reports.extend(Incoming::of(&event, channel, at)),
            }
        }
        has_overrun
    }

    /// The state is this, which is reported if it is news. Counters that are not given are as before.
    pub fn set(
        &mut self,
        state: ErrorState,
        counters: Option<(u8, u8)>,
        channel: Channel,
        at: At,
        reports: &mut Vec<Incoming>,
    ) {
        let counters = counters.or(self.state.map(|(_, counters)| counters)).unwrap_or((0, 0));
        if self.state.replace((state, counters)) != Some((state, counters)) {
            reports.push(Incoming::State { channel, state, counters, at });
        }
    }
}
