//! The record of a disturbance.

use cantap_wire::Event;

use super::Capture;

impl<const N: usize> Capture<'_, N> {
    /// Records a disturbance; returns whether there was room.
    pub fn disturbed(&mut self, event: &Event, at: u64) -> bool {
        self.recorder.event(event, at)
    }
}
