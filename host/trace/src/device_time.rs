//! The time of the device that stamped a record, beside UTC.
//!
//! UTC is worked out from the device's time and is corrected now and then, so an interval of it is not quite what the device measured.

use std::num::NonZeroU64;

/// Nanoseconds of a device's own clock, from 1 to 2⁶⁴ − 1; most devices count from when they were switched on or reset. Nothing corrects it: it
/// runs as its crystal does. Of a clock whose ticks are not whole nanoseconds, each time is rounded down.
///
/// An [`Option`] of it takes no more room than the number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct DeviceNs(NonZeroU64);

impl DeviceNs {
    /// So many nanoseconds; `None` for 0, which stands for an unknown time in files.
    #[inline]
    pub const fn new(ns: u64) -> Option<Self> {
        match NonZeroU64::new(ns) {
            Some(ns) => Some(Self(ns)),
            None => None,
        }
    }

    /// The number of nanoseconds.
    #[inline]
    pub const fn get(self) -> u64 {
        self.0.get()
    }

    /// The number of nanoseconds of an optional time; 0 if it is unknown.
    #[inline]
    pub const fn or_zero(time: Option<Self>) -> u64 {
        match time {
            Some(time) => time.get(),
            None => 0,
        }
    }
}

/// A moment by UTC and, if it is known, by the device's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Moment {
    /// As [`TraceRecord::time_ns`](crate::TraceRecord::time_ns).
    pub time_ns: i64,
    /// As [`TraceRecord::device_ns`](crate::TraceRecord::device_ns).
    pub device_ns: Option<DeviceNs>,
}

impl Moment {
    /// How long after `earlier` it was, in nanoseconds: as the device measured it if both have its time; otherwise, and if the two clocks
    /// disagree so much that the device was restarted or replaced in between, by UTC. Negative if `earlier` was later.
    #[inline]
    pub fn since_ns(self, earlier: Self) -> i64 {
        /// What no crystal, no RC oscillator and no correction towards UTC is off by: one part in this many, and a constant.
        const PARTS: u64 = 50;
        const CONSTANT_NS: u64 = 1_000_000;
        let by_utc = self.time_ns.saturating_sub(earlier.time_ns);
        let (Some(now), Some(then)) = (self.device_ns, earlier.device_ns) else { return by_utc };
        let by_device = now.get().wrapping_sub(then.get()).cast_signed();
        let is_one_clock = by_device.abs_diff(by_utc) <= by_utc.unsigned_abs() / PARTS + CONSTANT_NS;
        if is_one_clock { by_device } else { by_utc }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(time_ns: i64, device_ns: u64) -> Moment {
        Moment { time_ns, device_ns: DeviceNs::new(device_ns) }
    }

    #[test]
    fn an_unknown_time_takes_no_room() {
        assert_eq!(size_of::<Option<DeviceNs>>(), 8);
        assert_eq!(DeviceNs::new(0), None);
        assert_eq!([0, 7].map(|ns| DeviceNs::or_zero(DeviceNs::new(ns))), [0, 7]);
    }

    #[test]
    fn an_interval_is_the_devices_where_both_ends_have_its_time() {
        assert_eq!(
            at(2_000_010_000, 5_000_000_000).since_ns(at(1_000_000_000, 4_000_000_000)),
            1_000_000_000
        );
        assert_eq!(
            at(1_000_000_000, 4_000_000_000).since_ns(at(2_000_010_000, 5_000_000_000)),
            -1_000_000_000
        );
        assert_eq!(at(2_000_010_000, 5_000_000_000).since_ns(at(1_000_000_000, 0)), 1_000_010_000);
        assert_eq!(at(2_000_010_000, 0).since_ns(at(1_000_000_000, 4_000_000_000)), 1_000_010_000);
    }

    /// Its clock began again, or another device went on.
    #[test]
    fn clocks_that_contradict_each_other_are_not_one_clock() {
        let before = at(1_000_000_000, 900_000_000_000);
        assert_eq!(at(3_000_000_000, 1_500_000_000).since_ns(before), 2_000_000_000);
        assert_eq!(at(3_000_000_000, 990_000_000_000).since_ns(before), 2_000_000_000);
        assert_eq!(at(i64::MAX, u64::MAX).since_ns(at(i64::MIN, 1)), i64::MAX);
    }

    /// A fiftieth, and a millisecond: what is between is a slow or fast clock, what is beyond is another one.
    #[test]
    fn a_clock_may_be_off_by_a_fiftieth_and_a_millisecond() {
        let since = |utc_ns: i64, device_ns: u64| {
            at(1_000_000_000 + utc_ns, 7_000_000_000 + device_ns).since_ns(at(1_000_000_000, 7_000_000_000))
        };
        assert_eq!((since(0, 1_000_000), since(0, 1_000_001)), (1_000_000, 0));
        assert_eq!(
            (since(1_000_000_000, 1_021_000_000), since(1_000_000_000, 1_021_000_001)),
            (1_021_000_000, 1_000_000_000)
        );
        assert_eq!(
            (since(1_000_000_000, 979_000_000), since(1_000_000_000, 978_999_999)),
            (979_000_000, 1_000_000_000)
        );
    }
}
