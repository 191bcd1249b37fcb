//! What time it is for a device, without asking it each time.

use std::sync::Arc;
use std::time::Instant;

use super::reader::Shared;

/// Says what time it is on a device's own clock, by the round trips so far. It outlives its device, whose clock it then continues.
#[derive(Clone)]
pub struct DeviceTime {
    pub(super) shared: Arc<Shared>,
    pub(super) tick_hz: u32,
}

impl DeviceTime {
    /// Nanoseconds on the device's clock since it started, as in [`crate::TraceRecord::device_ns`], within
    /// [`super::ClockReport::uncertainty_ns`]. `None` before the first round trips, and for a device that does not run in real time.
    /// Corrections may let it go back by as much as that.
    pub fn now_ns(&self) -> Option<u64> {
        self.shared.published().clock.uncertainty_ns?;
        let utc = self.shared.utc.at(Instant::now());
        let now = self.shared.clock_map()?.ticks(utc);
        now.device_ns(self.tick_hz).map(cantap_trace::DeviceNs::get)
    }
}
