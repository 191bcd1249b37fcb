//! Puts the second of two devices that capture at the same time on the first one's clock, record by record.
//!
//! [`CommonClock`] relates two devices' times once there are marks of both. A capture begins before that, and records that were
//! handed out cannot be moved any more. So the second device's times begin where its own round trips put them, move to where the
//! frames say, slowly enough to distort no interval, and stay there. While the relation is unknown (a suspended bus, an absent
//! device), the last known one continues.

use std::sync::Arc;

use super::common::{CommonClock, NotCommon};
use super::units::UtcNs;
use super::{ClockMap, FrameDoubt};

/// Times are moved no faster than this: intervals stay right to within a two-thousandth, and it is faster than the two devices'
/// own maps, which may each move by 100 ppm while they settle.
const MAX_PACE: f64 = 500e-6;

/// Within this distance of where the frames say, in nanoseconds, a time counts as there: marks and ticks are
/// no more exact.
const THERE_NS: f64 = 1_000.0;

/// How well a device's times match the first one's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FollowerReport {
    /// If USB frames cannot relate the devices, the reason: then each device's times are as good as its own
    /// round trips.
    pub common: Result<(), NotCommon>,
    /// Since when they have been where the frames say, in UTC nanoseconds since the Unix epoch; `None` while they are not.
    pub since_ns: Option<i64>,
    /// How far the device's times were moved, in nanoseconds: the error of its own round trips.
    pub moved_ns: i64,
}

/// Puts a second device's UTC times on the first one's clock.
#[derive(Clone, Debug)]
pub struct Follower {
    maps: Option<(Arc<ClockMap>, Arc<ClockMap>)>,
    common: Result<CommonClock, NotCommon>,
    moved_ns: f64,
    /// The latest time placed so far in this session; `None` if there is none, when times may jump.
    latest: Option<UtcNs>,
    since: Option<UtcNs>,
}

impl Default for Follower {
    /// Nothing is known yet.
    fn default() -> Self {
        Self {
            maps: None,
            common: Err(NotCommon::Doubt(FrameDoubt::NoMarks)),
            moved_ns: 0.0,
            latest: None,
            since: None,
        }
    }
}

impl Follower {
    /// Takes the two devices' current maps. Call it before placing the records that were mapped with them.
    pub fn update(&mut self, first: Arc<ClockMap>, second: Arc<ClockMap>) {
        let is_known = self
            .maps
            .as_ref()
            .is_some_and(|(known, other)| Arc::ptr_eq(known, &first) && Arc::ptr_eq(other, &second));
        if !is_known {
            self.common = CommonClock::between(&first, &second);
            self.maps = Some((first, second));
        }
    }

    /// The second device begins a new session: after a gap, times may jump.
    pub fn begin_session(&mut self) {
        *self = Self { moved_ns: self.moved_ns, ..Self::default() };
    }

    /// Converts a time from the second device's own map to the first device's time, in UTC nanoseconds. The result never goes
    /// back when `utc_ns` does not.
    pub fn place(&mut self, utc_ns: i64) -> i64 {
        let utc = UtcNs(utc_ns);
        let passed_ns = self.latest.map(|latest| utc.since(latest).max(0) as f64);
        let off_ns = match self.target_ns(utc) {
            Some(target_ns) => target_ns - self.moved_ns,
            // Not on one controller: only the device's own time is available.
            None if matches!(self.common, Err(NotCommon::Controllers { .. })) => -self.moved_ns,
            None => 0.0,
        };
        let step_ns = match passed_ns {
            Some(passed_ns) => off_ns.clamp(-MAX_PACE * passed_ns, MAX_PACE * passed_ns),
            None => off_ns,
        };
        self.moved_ns += step_ns;
        self.latest = Some(self.latest.map_or(utc, |latest| latest.max(utc)));
        let is_there = self.common.is_ok() && (off_ns - step_ns).abs() < THERE_NS;
        self.since = self.since.or(Some(utc)).filter(|_| is_there);
        utc_ns + self.moved_ns.round() as i64
    }

    /// How well the times match the first device's clock.
    pub fn report(&self) -> FollowerReport {
        FollowerReport {
            common: self.common.map(|_| ()),
            since_ns: self.since.map(|since| since.0),
            moved_ns: self.moved_ns.round() as i64,
        }
    }

    /// How far a time should be moved, according to frames that both devices have marked; `None` if unknown.
    fn target_ns(&self, utc: UtcNs) -> Option<f64> {
        let (first, second) = self.maps.as_ref()?;
        let common = self.common.as_ref().ok()?;
        let ticks = second.ticks(utc);
        second.frames().trust(ticks).ok()?;
        let others = common.to_first(first.frames(), ticks, second.frames())?;
        first.frames().trust(others).ok()?;
        Some(first.utc(others).since(second.utc(ticks)) as f64)
    }
}
