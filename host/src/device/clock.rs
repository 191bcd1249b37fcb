//! Device time to UTC.
//!
//! The host asks for the device's time now and then. The reply was made somewhere between question and
//! answer; the quicker the round trip, the better the sample. The mapping is a line that bends at every
//! new sample and never runs backwards: it meets the best estimate half a minute later.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Samples are kept for so long, one for each slot; the best in each slot stays.
const SLOT: Duration = Duration::from_secs(10);
/// Slots kept: drift is measured over the last five minutes.
const SLOTS: usize = 30;
/// Drift is reported when samples span so long.
const MIN_SPAN: Duration = Duration::from_secs(5);
/// A device whose rate differs by more does not run in real time (an emulated one): it is not followed.
const MAX_DRIFT_PPM: f64 = 1000.0;
/// Drift is taken from samples that leave no more doubt of it, in parts per million: half of both round trips over the time
/// between them. A busy computer's round trips say nothing of a crystal.
const MAX_DOUBT_PPM: f64 = 200.0;
/// An error of the mapping is worked off over this time.
const CATCH_UP_NS: f64 = 30e9;
/// But never so fast that intervals would suffer: what frames are apart matters more than what time it is.
const MAX_CATCH_UP_PPM: f64 = 100.0;

/// The computer's UTC clock, read once and continued with the monotonic one: a step of the system's
/// clock in mid-capture moves no frame.
#[derive(Clone, Copy, Debug)]
pub struct UtcClock {
    instant: Instant,
    utc_ns: i64,
}

impl UtcClock {
    /// Reads the system's clock.
    pub fn start() -> Self {
        let utc_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as i64);
        Self { instant: Instant::now(), utc_ns }
    }

    /// Nanoseconds since the Unix epoch.
    pub fn at(&self, instant: Instant) -> i64 {
        self.utc_ns + instant.saturating_duration_since(self.instant).as_nanos() as i64
    }
}

/// One question for the device's time.
#[derive(Clone, Copy, Debug)]
struct Sample {
    ticks: u64,
    /// Midway between question and answer.
    utc_ns: i64,
    round_trip_ns: i64,
}

/// What is known about the device's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockReport {
    /// How much faster than the computer's the device's clock runs, in parts per million; `None` before
    /// it could be measured, and for a device that does not run in real time.
    pub drift_ppm: Option<f64>,
    /// The quickest round trip, in nanoseconds: device times are off by at most half of it.
    pub round_trip_ns: i64,
}

/// Maps device ticks to UTC.
#[derive(Clone, Debug)]
pub struct ClockMap {
    nominal_ns_per_tick: f64,
    samples: Vec<Sample>,
    /// The current line: from this point on, this slope.
    from_ticks: u64,
    from_ns: i64,
    ns_per_tick: f64,
    drift_ppm: Option<f64>,
}

impl ClockMap {
    /// A map without any sample: tick 0 is `utc_ns`.
    pub fn new(tick_hz: u32, utc_ns: i64) -> Self {
        let nominal_ns_per_tick = 1e9 / f64::from(tick_hz.max(1));
        Self {
            nominal_ns_per_tick,
            samples: Vec::new(),
            from_ticks: 0,
            from_ns: utc_ns,
            ns_per_tick: nominal_ns_per_tick,
            drift_ppm: None,
        }
    }

    /// The UTC time of a device time, in nanoseconds since the epoch.
    #[inline]
    pub fn utc_ns(&self, ticks: u64) -> i64 {
        let ahead = ticks.wrapping_sub(self.from_ticks) as i64;
        self.from_ns + (ahead as f64 * self.ns_per_tick) as i64
    }

    /// Takes one round trip: the device's time, and UTC before the question and after the answer.
    pub fn add(&mut self, ticks: u64, asked_ns: i64, answered_ns: i64) {
        let sample = Sample {
            ticks,
            utc_ns: asked_ns + (answered_ns - asked_ns) / 2,
            round_trip_ns: answered_ns - asked_ns,
        };
        if self.samples.is_empty() {
            self.from_ticks = ticks;
            self.from_ns = sample.utc_ns;
        }
        self.keep(sample);
        self.bend(sample);
    }

    /// Before anything was mapped: forgets all but the best sample and lies exactly on it.
    pub fn settle(&mut self) {
        let best = self.samples.iter().min_by_key(|sample| sample.round_trip_ns).copied();
        if let Some(best) = best {
            self.samples = vec![best];
            self.from_ticks = best.ticks;
            self.from_ns = best.utc_ns;
            self.ns_per_tick = self.nominal_ns_per_tick;
        }
    }

    /// What is known.
    pub fn report(&self) -> ClockReport {
        let round_trip_ns = self.samples.iter().map(|sample| sample.round_trip_ns).min().unwrap_or(0);
        ClockReport { drift_ppm: self.drift_ppm, round_trip_ns }
    }

    /// Keeps the quickest sample of each slot.
    fn keep(&mut self, sample: Sample) {
        let slot = |sample: &Sample| sample.utc_ns.div_euclid(SLOT.as_nanos() as i64);
        match self.samples.last_mut() {
            Some(last) if slot(last) == slot(&sample) => {
                if sample.round_trip_ns < last.round_trip_ns {
                    *last = sample;
                }
            }
            _ => {
                if self.samples.len() == SLOTS {
                    self.samples.remove(0);
                }
                self.samples.push(sample);
            }
        }
    }

    /// Continues the line from `now` towards the best estimate.
    fn bend(&mut self, now: Sample) {
        let (Some(first), Some(last)) = (self.samples.first(), self.samples.last()) else { return };
        let span_ns = (last.utc_ns - first.utc_ns) as f64;
        if span_ns < MIN_SPAN.as_nanos() as f64 {
            return;
        }
        let nominal_ns = last.ticks.wrapping_sub(first.ticks) as f64 * self.nominal_ns_per_tick;
        let drift_ppm = (nominal_ns / span_ns - 1.0) * 1e6;
        if drift_ppm.abs() > MAX_DRIFT_PPM {
            self.drift_ppm = None;
            return;
        }
        let doubt_ppm = (first.round_trip_ns + last.round_trip_ns) as f64 / 2.0 / span_ns * 1e6;
        if doubt_ppm <= MAX_DOUBT_PPM {
            self.drift_ppm = Some(drift_ppm);
        }
        let true_rate = self.nominal_ns_per_tick / (1.0 + self.drift_ppm.unwrap_or(0.0) * 1e-6);
        // Where the line is at `now`, and where the best sample says it should be.
        let at_ns = self.utc_ns(now.ticks);
        let since_best = now.ticks.wrapping_sub(last.ticks) as i64 as f64;
        let error_ns = last.utc_ns as f64 + since_best * true_rate - at_ns as f64;
        let most = MAX_CATCH_UP_PPM * 1e-6;
        let correction = (error_ns / CATCH_UP_NS).clamp(-most, most);
        self.from_ticks = now.ticks;
        self.from_ns = at_ns;
        self.ns_per_tick = true_rate * (1.0 + correction);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TICK_HZ: u32 = 12_000_000;
    const START_NS: i64 = 1_700_000_000_000_000_000;

    /// A device whose clock is fast by `ppm`, asked once a second with jittering round trips.
    fn run(ppm: f64, seconds: i64) -> (ClockMap, f64, bool) {
        let ticks_at = |ns: i64| ((ns - START_NS) as f64 * (1.0 + ppm * 1e-6) * 0.012) as u64 + 5_000_000;
        let mut map = ClockMap::new(TICK_HZ, START_NS);
        let (mut worst_ns, mut monotonic, mut previous) = (0.0_f64, true, i64::MIN);
        for second in 0..seconds {
            let asked = START_NS + second * 1_000_000_000;
            // Odd delays: the answer comes late by up to 2 ms, the device reads early in the round trip.
            let delay = 200_000 + (second * 7919 % 10) * 200_000;
            map.add(ticks_at(asked + 100_000), asked, asked + delay);
            if second == 0 {
                map.settle();
            }
            for step in 0..10 {
                let truth = asked + delay + step * 90_000_000;
                let mapped = map.utc_ns(ticks_at(truth));
                monotonic &= mapped >= previous;
                previous = mapped;
                if second > 60 {
                    worst_ns = worst_ns.max((mapped - truth).abs() as f64);
                }
            }
        }
        (map, worst_ns, monotonic)
    }

    #[test]
    fn a_drifting_clock_is_measured_and_followed_without_running_backwards() {
        for ppm in [-80.0, 0.0, 37.0, 250.0] {
            let (map, worst_ns, monotonic) = run(ppm, 300);
            let measured = map.report().drift_ppm.unwrap();
            assert!((measured - ppm).abs() < 3.0, "{measured} ppm for {ppm}");
            assert!(worst_ns < 500_000.0, "{worst_ns} ns off at {ppm} ppm");
            assert!(monotonic);
        }
    }

    #[test]
    fn a_busy_computer_does_not_stretch_the_time_between_frames() {
        let ticks_at = |ns: i64| ((ns - START_NS) as f64 * 0.012) as u64 + 5_000_000;
        let mut map = ClockMap::new(TICK_HZ, START_NS);
        let mut times = Vec::new();
        for second in 0..60 {
            let asked = START_NS + second * 1_000_000_000;
            // The answer takes up to 300 ms, and the device reads its clock anywhere in that.
            let delay = 1_000_000 + (second * 7919 % 13) * 23_000_000;
            map.add(ticks_at(asked + delay * (second * 31 % 11) / 11), asked, asked + delay);
            if second == 0 {
                map.settle();
            }
            times.push(map.utc_ns(ticks_at(START_NS + second * 1_000_000_000)));
        }
        for pair in times.windows(13) {
            let off_ns = (pair[12] - pair[0] - 12_000_000_000).abs();
            assert!(off_ns < 12_000 * 300, "{off_ns} ns in 12 s");
        }
    }

    #[test]
    fn a_device_in_its_own_time_keeps_its_spacing() {
        let (map, _, monotonic) = run(-900_000.0, 100);
        assert_eq!(map.report().drift_ppm, None);
        assert!(monotonic);
        let spacing = map.utc_ns(5_000_000 + 120_000_000) - map.utc_ns(5_000_000);
        assert_eq!(spacing, 10_000_000_000);
    }
}
