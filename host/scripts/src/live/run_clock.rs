//! The time of a run on a device: the device's own, so that what is due after a time is due by the clock that stamps the frames.

use std::time::Instant;

use cantap::TraceRecord;
use cantap::device::DeviceTime;

/// Nanoseconds since a run began.
pub(super) struct RunClock {
    began: Instant,
    /// None for an adapter of another make, which has no clock that is known here.
    device: Option<DeviceTime>,
    /// The device's time when the run began, in nanoseconds, once its clock is known or its first record has come.
    began_device_ns: Option<i64>,
    /// The stamp, of UTC, that is the run's time zero, for records without a time of the device's.
    began_utc_ns: Option<i64>,
}

impl RunClock {
    /// It begins now.
    pub fn start(device: Option<DeviceTime>) -> Self {
        Self { began: Instant::now(), device, began_device_ns: None, began_utc_ns: None }
    }

    /// The time by the device's clock, or by this computer's as long as that is not known. It may go back by as much as the device's is
    /// uncertain.
    pub fn now_ns(&mut self) -> u64 {
        let here_ns = self.began.elapsed().as_nanos() as u64;
        let Some(device_ns) = self.device.as_ref().and_then(DeviceTime::now_ns) else { return here_ns };
        let device_ns = device_ns as i64;
        let began_ns = *self.began_device_ns.get_or_insert(device_ns.saturating_sub_unsigned(here_ns));
        device_ns.saturating_sub(began_ns).try_into().unwrap_or(0)
    }

    /// When a record was, and when it came; what was before the run was at its beginning.
    pub fn stamp_ns(&mut self, record: &TraceRecord) -> (u64, u64) {
        let now_ns = self.now_ns();
        let (stamp_ns, began_ns) = match record.device_ns {
            Some(device_ns) => (device_ns.get() as i64, &mut self.began_device_ns),
            None => (record.time_ns, &mut self.began_utc_ns),
        };
        // If the first record comes before the device's clock is known, it decides for good: stamps are as far apart as they say.
        let began_ns = *began_ns.get_or_insert(stamp_ns.saturating_sub_unsigned(now_ns));
        let since_ns = stamp_ns.saturating_sub(began_ns);
        (since_ns.try_into().unwrap_or(0), now_ns)
    }
}
