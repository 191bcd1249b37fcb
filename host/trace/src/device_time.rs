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

/// How long something took.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Interval {
    /// Nanoseconds.
    pub ns: i64,
    /// Whether a device measured it. Otherwise it is a difference of UTC, which is corrected while a trace is recorded.
    pub by_device: bool,
}

impl Moment {
    /// How long after `earlier` it was: as the device measured it if both have its time; otherwise, and if the two clocks disagree so much
    /// that the device was restarted or replaced in between, or that two devices stamped them, by UTC. Negative if `earlier` was later.
    #[inline]
    pub fn interval_since(self, earlier: Self) -> Interval {
        /// What no crystal, no RC oscillator and no correction towards UTC is off by: one part in this many. The constant is for stamps in
        /// microseconds; it bounds the error if two devices' clocks happen to agree.
        const PARTS: u64 = 50;
        const CONSTANT_NS: u64 = 20_000;
        let by_utc = Interval { ns: self.time_ns.saturating_sub(earlier.time_ns), by_device: false };
        let (Some(now), Some(then)) = (self.device_ns, earlier.device_ns) else { return by_utc };
        let by_device = Interval { ns: now.get().wrapping_sub(then.get()).cast_signed(), by_device: true };
        let is_one_clock = by_device.ns.abs_diff(by_utc.ns) <= by_utc.ns.unsigned_abs() / PARTS + CONSTANT_NS;
        if is_one_clock { by_device } else { by_utc }
    }

    /// The moment of a time by UTC among stamped ones: `earlier` are those before it, `later` those from it on, the nearest first. The
    /// device's time is what it was between the nearest of both that have it, if they are of one clock. Not more than 64 of each are
    /// looked at.
    pub fn at(
        time_ns: i64,
        earlier: impl IntoIterator<Item = Self>,
        later: impl IntoIterator<Item = Self>,
    ) -> Self {
        const NEAR: usize = 64;
        let by_utc = Self { time_ns, device_ns: None };
        let is_known = |moment: &Self| moment.device_ns.is_some();
        let Some(after) = later.into_iter().take(NEAR).find(is_known) else { return by_utc };
        if after.time_ns == time_ns {
            return after;
        }
        let Some(before) = earlier.into_iter().take(NEAR).find(is_known) else { return by_utc };
        let whole = after.interval_since(before);
        let (Some(device_ns), true) = (before.device_ns, whole.by_device) else { return by_utc };
        let part = i128::from(time_ns.saturating_sub(before.time_ns));
        let utc = i128::from(after.time_ns.saturating_sub(before.time_ns)).max(1);
        let passed = (i128::from(whole.ns) * part / utc) as i64;
        Self { time_ns, device_ns: DeviceNs::new(device_ns.get().wrapping_add_signed(passed)) }
    }

    /// The nanoseconds of [`Self::interval_since`].
    #[inline]
    pub fn since_ns(self, earlier: Self) -> i64 {
        self.interval_since(earlier).ns
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

    #[test]
    fn a_time_between_stamps_is_the_devices_too() {
        // 400 ppm fast, every 10 ms, and one in three without the device's time.
        let all: Vec<_> = (0..30_i64)
            .map(|n| at(n * 10_000_000, if n % 3 == 0 { 0 } else { 7_000_000_000 + n as u64 * 10_004_000 }))
            .collect();
        let moment = |time_ns: i64| {
            let place = all.partition_point(|moment| moment.time_ns < time_ns);
            Moment::at(time_ns, all[..place].iter().rev().copied(), all[place..].iter().copied())
        };
        for ms in [10, 15, 30, 33, 277] {
            let expected = 7_000_000_000 + ms * 1_000_400;
            assert_eq!(DeviceNs::or_zero(moment(ms as i64 * 1_000_000).device_ns), expected, "{ms}");
        }
        for ms in [-1, 5, 295, 1000] {
            assert_eq!(moment(ms * 1_000_000), at(ms * 1_000_000, 0));
        }
        // Not between two devices.
        let two = |time_ns| Moment::at(time_ns, [at(0, 5_000_000)], [at(10_000_000, 900_000_000)]);
        assert_eq!(two(4_000_000), at(4_000_000, 0));
    }

    /// Its clock began again, or another device went on.
    #[test]
    fn clocks_that_contradict_each_other_are_not_one_clock() {
        let before = at(1_000_000_000, 900_000_000_000);
        assert_eq!(at(3_000_000_000, 1_500_000_000).since_ns(before), 2_000_000_000);
        assert_eq!(at(3_000_000_000, 990_000_000_000).since_ns(before), 2_000_000_000);
        assert_eq!(at(i64::MAX, u64::MAX).since_ns(at(i64::MIN, 1)), i64::MAX);
        // Two boards that were switched on within half a millisecond.
        let other = at(1_000_000_000, 900_000_500_000);
        assert_eq!(at(1_005_000_000, 900_005_000_000).since_ns(other), 5_000_000);
    }

    #[test]
    fn an_interval_tells_whose_it_is() {
        let before = at(1_000_000_000, 4_000_000_000);
        assert_eq!(
            at(2_000_000_000, 5_000_400_000).interval_since(before),
            Interval { ns: 1_000_400_000, by_device: true }
        );
        assert_eq!(
            at(2_000_000_000, 0).interval_since(before),
            Interval { ns: 1_000_000_000, by_device: false }
        );
    }

    /// A fiftieth, and 20 µs: what is between is a slow or fast clock, what is beyond is another one.
    #[test]
    fn a_clock_may_be_off_by_a_fiftieth_and_a_few_microseconds() {
        let since = |utc_ns: i64, device_ns: u64| {
            at(1_000_000_000 + utc_ns, 7_000_000_000 + device_ns).since_ns(at(1_000_000_000, 7_000_000_000))
        };
        assert_eq!((since(0, 20_000), since(0, 20_001)), (20_000, 0));
        assert_eq!(
            (since(1_000_000_000, 1_020_020_000), since(1_000_000_000, 1_020_020_001)),
            (1_020_020_000, 1_000_000_000)
        );
        assert_eq!(
            (since(1_000_000_000, 979_980_000), since(1_000_000_000, 979_979_999)),
            (979_980_000, 1_000_000_000)
        );
    }
}
