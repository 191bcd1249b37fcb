//! A type for each clock's time: a device's, UTC, and that of a USB host controller.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use cantap_trace::DeviceNs;

/// Time by a device's stamp timer: ticks since it started, at the rate that `Hello` gives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Ticks(pub u64);

impl Ticks {
    /// Ticks from `other` to this time.
    pub const fn since(self, other: Self) -> i64 {
        self.0.wrapping_sub(other.0) as i64
    }

    /// The time in nanoseconds, rounded down; `None` for tick 0, which stands for a time that is not known, and for one beyond 584 years.
    #[inline]
    pub fn device_ns(self, tick_hz: u32) -> Option<DeviceNs> {
        const NS_PER_S: u64 = 1_000_000_000;
        let hz = u64::from(tick_hz.max(1));
        let part_ns = self.0 % hz * NS_PER_S / hz;
        DeviceNs::new((self.0 / hz).checked_mul(NS_PER_S)?.checked_add(part_ns)?)
    }

    /// This time plus a number of ticks.
    #[must_use]
    pub const fn plus(self, ticks: i64) -> Self {
        Self(self.0.wrapping_add_signed(ticks))
    }
}

/// UTC: nanoseconds since the Unix epoch. A device that lies about its clock may lead beyond what can be counted, where the count stays.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct UtcNs(pub i64);

impl UtcNs {
    /// Nanoseconds from `other` to this time.
    pub const fn since(self, other: Self) -> i64 {
        self.0.saturating_sub(other.0)
    }

    /// This time plus a number of nanoseconds.
    #[must_use]
    pub const fn plus(self, ns: i64) -> Self {
        Self(self.0.saturating_add(ns))
    }
}

/// Time by the frames of a USB host controller: each frame lasts 10⁶ nanoseconds, whatever other clocks say, and starts at the
/// multiple of 10⁶ that equals its frame number, modulo 2048 of them. The wrap from which it counts is arbitrary and different
/// for each device ([`super::CommonClock`] finds the difference).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FrameNs(pub i64);

impl FrameNs {
    /// Nanoseconds from `other` to this time.
    pub const fn since(self, other: Self) -> i64 {
        self.0.saturating_sub(other.0)
    }

    /// This time plus a number of nanoseconds.
    #[must_use]
    pub const fn plus(self, ns: i64) -> Self {
        Self(self.0.saturating_add(ns))
    }
}

/// The computer's UTC clock, read once and continued with the monotonic one: if the system's clock is set
/// during a capture, no frame moves.
#[derive(Clone, Copy, Debug)]
pub struct UtcClock {
    instant: Instant,
    utc: UtcNs,
}

impl UtcClock {
    /// Reads the system's clock.
    pub fn start() -> Self {
        let utc_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as i64);
        Self { instant: Instant::now(), utc: UtcNs(utc_ns) }
    }

    /// UTC at a moment.
    pub fn at(&self, instant: Instant) -> UtcNs {
        self.utc.plus(instant.saturating_duration_since(self.instant).as_nanos() as i64)
    }
}
