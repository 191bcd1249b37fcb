//! Maps device time to UTC.
//!
//! The host asks for the device's time now and then, and fits a line to the round trips ([`corridor`]). In between, a ruler measures the
//! device's time: the frames of the USB host controller if the device marks them ([`FrameClock`]), otherwise the device's own crystal.
//! Neither is UTC. But crystals wander by some parts per million with temperature, so a line over the device's ticks is straight for a
//! minute or so; the frames reveal all wander of the device against the controller. If the computer's clock runs from the same crystal as
//! its controller, or from one as steady, the line against the frames is straight for many minutes, and ten minutes of round trips locate
//! it.
//!
//! An operating system does not tell programs which frame it is. So the relation of frames to UTC comes from the round trips, too, and frames
//! cannot reveal what these cannot: whether the way there takes as long as the way back.
//!
//! Records are mapped by a line that bends at every round trip and never runs backwards: it meets the best estimate some seconds later.

mod common;
mod corridor;
mod follower;
mod frames;
mod units;

use std::collections::VecDeque;

pub use common::{CommonClock, NotCommon};
pub use follower::{Follower, FollowerReport};
pub use frames::{FrameClock, FrameDoubt, SofMark};
pub use units::{FrameNs, Ticks, UtcClock, UtcNs};

use corridor::Gate;

/// How many round trips are kept: ten minutes' worth, at one a second.
const GATES: usize = 600;
/// Of round trips that are closer than this, in nanoseconds, only the quickest is kept: a program that asks often must not crowd out the old ones,
/// which tell the drift.
const GATES_APART_NS: f64 = 400e6;
/// So many are kept in any case, at the beginning.
const FIRST_GATES: usize = 8;
/// How many bends are kept, so that a time can be mapped again: 17 minutes' worth.
const BENDS: usize = 1024;
/// How much the rate between ruler and UTC may change during the time for which round trips are kept. For a crystal in a box that warms
/// up, a part per million; against the frames, the system's clock changes only if something disciplines it.
const CRYSTAL_WANDER: f64 = 1e-6;
const FRAMES_WANDER: f64 = 0.1e-6;
/// Drift is reported once the round trips leave no more doubt than this, in parts per million.
const MAX_DOUBT_PPM: f64 = 20.0;
/// An error of the mapping is corrected over this time.
const CATCH_UP_NS: f64 = 10e9;
/// But never so fast that intervals would suffer: the distance between frames matters more than the time of
/// day.
const MAX_CATCH_UP: f64 = 100e-6;

/// What measures device time between two round trips.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockSource {
    /// USB's start of frame.
    Frames,
    /// The device's crystal, because its marks are missing or not trusted.
    RoundTrips(FrameDoubt),
}

/// What is known about the device's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockReport {
    /// What measures the times.
    pub source: ClockSource,
    /// How much faster than the computer's the device's clock runs, in parts per million; `None` until it has
    /// been measured, and for a device that does not run in real time.
    pub drift_ppm: Option<f64>,
    /// How much faster the USB host controller's frames are than the computer's clock, likewise.
    pub frames_ppm: Option<f64>,
    /// The uncertainty of a device time's UTC, in nanoseconds. It is a bound as long as clocks keep their rates; the error is usually
    /// much smaller. `None` for a device that does not run in real time.
    pub uncertainty_ns: Option<i64>,
    /// The quickest round trip, in nanoseconds.
    pub round_trip_ns: i64,
}

impl Default for ClockReport {
    /// Nothing is known yet.
    fn default() -> Self {
        Self {
            source: ClockSource::RoundTrips(FrameDoubt::NoMarks),
            drift_ppm: None,
            frames_ppm: None,
            uncertainty_ns: None,
            round_trip_ns: 0,
        }
    }
}

/// A question for the device's time.
#[derive(Clone, Copy, Debug)]
struct RoundTrip {
    at: Ticks,
    asked: UtcNs,
    answered: UtcNs,
}

/// A piece of the line: from here on, it has this slope.
#[derive(Clone, Copy, Debug)]
struct Bend {
    at: Ticks,
    utc: UtcNs,
    ns_per_tick: f64,
    /// Its uncertainty at that time.
    unsure_ns: i64,
}

impl Bend {
    fn utc(&self, ticks: Ticks) -> UtcNs {
        self.utc.plus((ticks.since(self.at) as f64 * self.ns_per_tick) as i64)
    }
}

/// Maps device ticks to UTC.
#[derive(Clone, Debug)]
pub struct ClockMap {
    nominal_ns_per_tick: f64,
    round_trips: VecDeque<RoundTrip>,
    frames: FrameClock,
    /// Never empty; the last one applies from its start on.
    bends: VecDeque<Bend>,
    /// Whether the line goes on straight by the device's ticks.
    keeps_intervals: bool,
    report: ClockReport,
}

impl ClockMap {
    /// A map without any round trip: tick 0 is `utc`.
    pub fn new(tick_hz: u32, utc: UtcNs) -> Self {
        let nominal_ns_per_tick = 1e9 / f64::from(tick_hz.max(1));
        Self {
            nominal_ns_per_tick,
            round_trips: VecDeque::new(),
            frames: FrameClock::new(tick_hz),
            bends: VecDeque::from([Bend {
                at: Ticks(0),
                utc,
                ns_per_tick: nominal_ns_per_tick,
                unsure_ns: 0,
            }]),
            keeps_intervals: false,
            report: ClockReport::default(),
        }
    }

    /// From `now` on, a second is as long as the device's crystal says, and no interval is ever corrected towards UTC: what the times are
    /// off by is part of [`ClockReport::uncertainty_ns`]. They do not jump.
    pub fn keep_intervals(&mut self, now: Ticks) {
        self.keeps_intervals = true;
        let last = self.bends[self.bends.len() - 1];
        let at = now.max(last.at);
        self.push(Bend { at, utc: last.utc(at), ns_per_tick: self.nominal_ns_per_tick, ..last });
    }

    /// The length of so many ticks, in nanoseconds of the device's crystal.
    pub fn nominal_ns(&self, ticks: u64) -> u32 {
        (ticks as f64 * self.nominal_ns_per_tick) as u32
    }

    /// The UTC time of a device time. A past time keeps the UTC it had then, for the last 17 minutes.
    #[inline]
    pub fn utc(&self, ticks: Ticks) -> UtcNs {
        self.bend_at(ticks).utc(ticks)
    }

    /// The same with its uncertainty in nanoseconds, as known at that time: past parts of the line do not change, so later knowledge
    /// does not improve them. 0 for a device that does not run in real time.
    pub fn utc_within(&self, ticks: Ticks) -> (UtcNs, i64) {
        let bend = self.bend_at(ticks);
        (bend.utc(ticks), bend.unsure_ns)
    }

    #[inline]
    fn bend_at(&self, ticks: Ticks) -> &Bend {
        let last = &self.bends[self.bends.len() - 1];
        if ticks.since(last.at) >= 0 {
            return last;
        }
        &self.bends[self.bends.partition_point(|bend| bend.at <= ticks).saturating_sub(1)]
    }

    /// The device time of a UTC time, to the nearest tick: the inverse of [`Self::utc`]. What was before the device started is tick 0.
    pub fn ticks(&self, utc: UtcNs) -> Ticks {
        let bend = self.bends[self.bends.partition_point(|bend| bend.utc <= utc).saturating_sub(1)];
        let since = (utc.since(bend.utc) as f64 / bend.ns_per_tick).round() as i64;
        Ticks(bend.at.0.saturating_add_signed(since))
    }

    /// The device's time by USB frames.
    pub const fn frames(&self) -> &FrameClock {
        &self.frames
    }

    /// Takes a mark of a frame's start.
    pub fn mark(&mut self, mark: SofMark) {
        self.frames.add(mark);
    }

    /// Takes one round trip: the device's time, and UTC before the question and after the answer.
    pub fn add(&mut self, at: Ticks, asked: UtcNs, answered: UtcNs) {
        if self.round_trips.is_empty() {
            let half_ns = answered.since(asked) / 2;
            let (utc, ns_per_tick) = (asked.plus(half_ns), self.nominal_ns_per_tick);
            self.bends = VecDeque::from([Bend { at, utc, ns_per_tick, unsure_ns: half_ns }]);
        }
        self.keep(RoundTrip { at, asked, answered });
        let round_trips = self.round_trips.iter().map(|trip| trip.answered.since(trip.asked));
        self.report.round_trip_ns = round_trips.min().unwrap_or(0);
        self.bend(at, CATCH_UP_NS);
    }

    fn keep(&mut self, trip: RoundTrip) {
        if let Some(last) = self.round_trips.back().copied()
            && self.round_trips.len() >= FIRST_GATES
            && (trip.at.since(last.at) as f64 * self.nominal_ns_per_tick) < GATES_APART_NS
        {
            if trip.answered.since(trip.asked) > last.answered.since(last.asked) {
                return;
            }
            self.round_trips.pop_back();
        } else if self.round_trips.len() == GATES {
            self.round_trips.pop_front();
        }
        self.round_trips.push_back(trip);
    }

    /// Moves the line exactly onto the best estimate. Only before anything was mapped.
    pub fn settle(&mut self) {
        if let Some(last) = self.round_trips.back() {
            let at = last.at;
            self.bends.drain(..self.bends.len() - 1);
            self.bend(at, 0.0);
        }
    }

    /// What is known about the clock.
    pub const fn report(&self) -> ClockReport {
        self.report
    }

    /// Continues the line from `now` towards the best estimate, which it meets after `catch_up_ns`; immediately if that
    /// is 0.
    fn bend(&mut self, now: Ticks, catch_up_ns: f64) {
        let trust = self.frames.trust(now);
        let (wander, rate) = match trust {
            Ok(()) => (FRAMES_WANDER, self.frames.rate()),
            Err(_) => (CRYSTAL_WANDER, 1.0),
        };
        let at = self.utc(now);
        let line = loop {
            let gates = self.gates(now, at, trust.is_ok());
            match corridor::line(&gates, wander) {
                Some(line) => break Some(line),
                // One of the clocks was set: the newer half has the change behind it.
                None if gates.len() > 2 => drop(self.round_trips.drain(..gates.len() / 2)),
                None => break None,
            }
        };
        let ruler = self.nominal_ns_per_tick * rate;
        self.report.source = trust.map_or_else(ClockSource::RoundTrips, |()| ClockSource::Frames);
        let Some(line) = line else {
            // It does not run in real time. Its frames are as far apart as it says.
            self.push(Bend { at: now, utc: at, ns_per_tick: self.nominal_ns_per_tick, unsure_ns: 0 });
            let ClockReport { source, round_trip_ns, .. } = self.report;
            self.report = ClockReport { source, round_trip_ns, ..ClockReport::default() };
            return;
        };
        let correction = (line.now_ns / catch_up_ns.max(1.0)).clamp(-MAX_CATCH_UP, MAX_CATCH_UP);
        let (correction, utc) =
            if catch_up_ns > 0.0 { (correction, at) } else { (0.0, at.plus(line.now_ns as i64)) };
        let true_ns_per_tick = ruler * (1.0 + line.rate);
        let off_ns = utc.since(at) as f64;
        let unsure_ns = (line.range_ns.1 - off_ns).abs().max((off_ns - line.range_ns.0).abs()).ceil() as i64;
        let ns_per_tick = if self.keeps_intervals {
            self.nominal_ns_per_tick
        } else {
            true_ns_per_tick * (1.0 + correction)
        };
        self.push(Bend { at: now, utc, ns_per_tick, unsure_ns });
        let faster_ppm = |utc_per_nominal: f64| (1.0 / utc_per_nominal - 1.0) * 1e6;
        let sure = line.rate_doubt * 1e6 <= MAX_DOUBT_PPM;
        self.report.drift_ppm = sure.then(|| faster_ppm(rate * (1.0 + line.rate)));
        self.report.frames_ppm = (sure && trust.is_ok()).then(|| faster_ppm(1.0 + line.rate));
        self.report.uncertainty_ns = Some(unsure_ns);
    }

    fn push(&mut self, bend: Bend) {
        if self.bends.back().is_some_and(|last| last.at >= bend.at) {
            // A second one at the same time replaces the first.
            self.bends.pop_back();
        } else if self.bends.len() == BENDS {
            self.bends.pop_front();
        }
        self.bends.push_back(bend);
    }

    /// The round trips as gates relative to `now`, which the present line maps to `at`.
    fn gates(&self, now: Ticks, at: UtcNs, by_frames: bool) -> Vec<Gate> {
        let frames_now = self.frames.at(now).filter(|_| by_frames);
        let gate = |trip: &RoundTrip| {
            let by_frames = frames_now.zip(self.frames.at(trip.at)).map(|(now, then)| then.since(now) as f64);
            let at_ns = by_frames.unwrap_or_else(|| trip.at.since(now) as f64 * self.nominal_ns_per_tick);
            Gate {
                at_ns,
                asked_ns: trip.asked.since(at) as f64 - at_ns,
                answered_ns: trip.answered.since(at) as f64 - at_ns,
            }
        };
        self.round_trips.iter().map(gate).collect()
    }
}

#[cfg(test)]
mod tests;
