//! Finds a bus's bit rate without a word: the channel only listens, at one rate after the other.
//!
//! A rate is right when several frames in a row arrive without an error. Near rates pass that test too, since controllers
//! resynchronise: 253.97 kbit/s may be heard at 250. So a candidate is checked twice more. Frames that
//! follow one another at once tell the bit's length by their stamps. And a rate in the middle of those that
//! are heard has neighbours on both sides that are heard, or not, alike.

use std::time::{Duration, Instant};

use cantap_wire::message::ChannelConfig;
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};
use cantap_wire::{BitTiming, Channel, Command};

use crate::device::Records;
use crate::{Device, DeviceError, Direction, TraceEvent, bits_on_bus};

/// Bit rates in use, in bit/s, those of CiA and of vehicles, the likeliest first.
pub const COMMON_BPS: [u32; 14] = [
    500_000, 250_000, 125_000, 1_000_000, 100_000, 50_000, 83_333, 33_333, 800_000, 20_000, 10_000, 5_000,
    95_238, 62_500,
];

/// Good frames in a row that make a candidate.
const GOOD_FRAMES: u32 = 4;
/// How often the device is asked.
const ASK_EVERY: Duration = Duration::from_millis(2);
/// The scan's step: near enough that one of two neighbours is heard.
const SCAN_STEP: f64 = 1.007;
/// Rates nearer than this cannot be told apart by listening, and need not be.
const SAME: f64 = 0.005;
/// Distance of the neighbours that are compared: with 253.97 kbit/s for 250, the wrong one's are at 0 and 3.2 %.
const NEIGHBOUR: f64 = 0.016;
/// Error of a stamp's difference, in ns: the interrupt's latency.
const STAMP_ERROR_NS: f64 = 3_000.0;

/// What the search is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Trying one of the common rates: which, of how many.
    Common {
        /// In bit/s.
        bitrate_bps: u32,
        /// From 0.
        at: usize,
        /// How many.
        of: usize,
    },
    /// Trying every reachable rate.
    Scan {
        /// In bit/s.
        bitrate_bps: u32,
        /// From 0.
        at: usize,
        /// How many.
        of: usize,
    },
    /// Frames arrive; making sure of it.
    Checking {
        /// In bit/s.
        bitrate_bps: u32,
    },
}

/// What the search found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Outcome {
    /// The bit rate.
    Found {
        /// In bit/s.
        bitrate_bps: u32,
        /// The timing that it was heard with.
        timing: BitTiming,
        /// Good frames in a row.
        frames: u32,
        /// Bit rate by the stamps of frames that followed one another at once, in bit/s; a lower bound.
        measured_bps: Option<f64>,
    },
    /// Nothing happened on the bus.
    NoTraffic,
    /// Something did, and no rate fitted.
    NoMatch {
        /// Errors seen.
        errors: u64,
    },
    /// It was asked to stop.
    Stopped,
}

/// How long to look.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// At each rate while nothing at all happens; the first round. Later rounds take longer.
    pub dwell: Duration,
    /// Altogether, while the bus is silent.
    pub silence: Duration,
}

impl Default for Limits {
    /// For 20 frames a second and more; a silent bus is given up after six seconds.
    fn default() -> Self {
        Self { dwell: Duration::from_millis(60), silence: Duration::from_secs(6) }
    }
}

/// What was heard at one rate.
#[derive(Clone, Copy, Debug, Default)]
struct Heard {
    frames: u32,
    errors: u32,
    /// Shortest bit that the stamps of neighbouring frames allow, as the highest rate, in bit/s.
    fastest_bps: Option<f64>,
}

impl Heard {
    const fn is_good(&self) -> bool {
        self.frames >= GOOD_FRAMES && self.errors == 0
    }
}

struct Search<'a> {
    device: &'a Device,
    channel: Channel,
    records: Records,
    progress: &'a mut dyn FnMut(Progress) -> bool,
    errors: u64,
    stopped: bool,
}

/// Finds the bit rate of a channel's bus. `progress` is called for each rate and ends the search by returning
/// false. The channel has to be closed, and is so afterwards.
pub fn search(
    device: &Device,
    channel: Channel,
    limits: &Limits,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Outcome, DeviceError> {
    let records = device.records();
    let mut search = Search { device, channel, records, progress, errors: 0, stopped: false };
    let started = Instant::now();
    let mut dwell = limits.dwell;
    loop {
        // Traffic that is there and fits none of the common rates is worth the long scan.
        let of = COMMON_BPS.len();
        let common = COMMON_BPS.into_iter().enumerate();
        let rates = common.map(|(at, bitrate_bps)| Progress::Common { bitrate_bps, at, of });
        if let Some(found) = search.try_all(rates, dwell)? {
            return Ok(found);
        }
        if search.errors > 0 {
            let grid = scan_rates(device.hello().can_clock_hz);
            let of = grid.len();
            let rates = grid.into_iter().enumerate();
            let rates = rates.map(|(at, bitrate_bps)| Progress::Scan { bitrate_bps, at, of });
            let found = search.try_all(rates, dwell)?;
            return Ok(found.unwrap_or(Outcome::NoMatch { errors: search.errors }));
        }
        if started.elapsed() > limits.silence {
            return Ok(Outcome::NoTraffic);
        }
        // A quiet bus needs longer looks.
        dwell *= 3;
    }
}

/// Every reachable rate, thinned to one in each [`SCAN_STEP`], from the fastest down.
fn scan_rates(clock_hz: u32) -> Vec<u32> {
    let mut rates: Vec<u32> = Vec::new();
    for clocks in (clock_hz / MAX_BITRATE_BPS).max(1)..=clock_hz / MIN_BITRATE_BPS {
        let rate = f64::from(clock_hz) / f64::from(clocks);
        let far = rates.last().is_none_or(|last| f64::from(*last) / rate >= SCAN_STEP);
        if far && BitTiming::of_clocks(clocks).next().is_some() {
            rates.push(rate.round() as u32);
        }
    }
    rates
}

impl Search<'_> {
    fn try_all(
        &mut self,
        rates: impl Iterator<Item = Progress>,
        dwell: Duration,
    ) -> Result<Option<Outcome>, DeviceError> {
        for step in rates {
            let (Progress::Common { bitrate_bps, .. }
            | Progress::Scan { bitrate_bps, .. }
            | Progress::Checking { bitrate_bps }) = step;
            if self.stopped || !(self.progress)(step) {
                return Ok(Some(Outcome::Stopped));
            }
            let Some(heard) = self.listen(bitrate_bps, dwell)? else { continue };
            self.errors += u64::from(heard.errors);
            if heard.is_good()
                && let Some(found) = self.make_sure(bitrate_bps, heard, dwell)?
            {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }

    /// Listens at a rate until there is evidence or the time is over; `None` if the clock does not reach it.
    fn listen(&mut self, bitrate_bps: u32, dwell: Duration) -> Result<Option<Heard>, DeviceError> {
        let Ok(timing) = self.device.timing(bitrate_bps) else { return Ok(None) };
        let index = self.channel.index();
        let before = self.device.status()?.channels[index];
        while self.records.next_batch(Duration::ZERO)?.is_some_and(|batch| !batch.is_empty()) {}
        self.device.open_channel(self.channel, Some(ChannelConfig::listen_only(timing)))?;
        let started = Instant::now();
        let mut dwell = dwell;
        let mut heard = Heard::default();
        loop {
            std::thread::sleep(ASK_EVERY);
            let now = self.device.status()?.channels[index];
            heard.frames = now.frames.wrapping_sub(before.frames);
            heard.errors = now.bus_errors.wrapping_sub(before.bus_errors);
            // A wrong rate shows at once; frames are worth waiting for the next.
            if heard.errors > 0 || heard.frames >= GOOD_FRAMES || started.elapsed() > dwell {
                break;
            }
            if heard.frames > 0 {
                dwell = dwell.max(Duration::from_secs(2));
            }
        }
        self.device.request(Command::Close { channel: self.channel })?;
        heard.fastest_bps = self.measure()?;
        Ok(Some(heard))
    }

    /// The highest rate that neighbouring frames' stamps show: from the end of one to the end of the next are at least the
    /// next one's bits.
    fn measure(&mut self) -> Result<Option<f64>, DeviceError> {
        let mut fastest: Option<f64> = None;
        let mut last_ns = None;
        while let Some(batch) =
            self.records.next_batch(Duration::from_millis(1))?.filter(|batch| !batch.is_empty())
        {
            for record in batch.iter().filter(|record| record.channel == self.channel.number()) {
                let TraceEvent::Frame { frame, direction: Direction::Rx, late } = &record.event else {
                    last_ns = None;
                    continue;
                };
                if let Some(last_ns) = last_ns.filter(|_| !late) {
                    let between_ns = (record.time_ns - last_ns) as f64 + STAMP_ERROR_NS;
                    let bps = f64::from(bits_on_bus(frame)) * 1e9 / between_ns;
                    fastest = Some(fastest.map_or(bps, |fastest| fastest.max(bps)));
                }
                last_ns = (!late).then_some(record.time_ns);
            }
        }
        Ok(fastest)
    }

    /// Tells a candidate from its neighbours. `None` if it was a neighbour and none of them fits.
    fn make_sure(
        &mut self,
        candidate_bps: u32,
        heard: Heard,
        dwell: Duration,
    ) -> Result<Option<Outcome>, DeviceError> {
        if !(self.progress)(Progress::Checking { bitrate_bps: candidate_bps }) {
            return Ok(Some(Outcome::Stopped));
        }
        let rate = f64::from(candidate_bps);
        let is_common = COMMON_BPS.contains(&candidate_bps);
        let too_slow = heard.fastest_bps.is_some_and(|fastest| fastest > rate * (1.0 + SAME));
        if is_common && !too_slow {
            let below = self.is_heard_near(rate * (1.0 - NEIGHBOUR), dwell)?;
            let above = self.is_heard_near(rate * (1.0 + NEIGHBOUR), dwell)?;
            // A neighbour that the clock does not reach tells nothing.
            let alike = below.zip(above).is_none_or(|(below, above)| below == above);
            if alike {
                return Ok(self.found(candidate_bps, heard));
            }
        }
        // Not the middle of what is heard: hear all around, and take what lies between.
        let clock_hz = self.device.hello().can_clock_hz;
        let mut heard_at = Vec::new();
        for bitrate_bps in rates_around(clock_hz, rate) {
            if self.is_heard_at(bitrate_bps, dwell)? {
                heard_at.push(f64::from(bitrate_bps));
            }
        }
        let (Some(fastest), Some(slowest)) = (heard_at.first(), heard_at.last()) else { return Ok(None) };
        let middle = (fastest * slowest).sqrt();
        let common = COMMON_BPS.into_iter().find(|bps| (f64::from(*bps) / middle - 1.0).abs() < SAME);
        let Some(best_bps) = common.or_else(|| nearest(clock_hz, middle)) else { return Ok(None) };
        let heard = self.listen(best_bps, dwell * 3)?.unwrap_or_default();
        Ok(if heard.is_good() { self.found(best_bps, heard) } else { None })
    }

    fn found(&self, bitrate_bps: u32, heard: Heard) -> Option<Outcome> {
        let timing = self.device.timing(bitrate_bps).ok()?;
        Some(Outcome::Found { bitrate_bps, timing, frames: heard.frames, measured_bps: heard.fastest_bps })
    }

    /// Whether frames arrive without error at about `rate`; `None` if the clock reaches nothing near it.
    fn is_heard_near(&mut self, rate: f64, dwell: Duration) -> Result<Option<bool>, DeviceError> {
        let near = |bps: &u32| (f64::from(*bps) / rate - 1.0).abs() < NEIGHBOUR / 2.0;
        match nearest(self.device.hello().can_clock_hz, rate).filter(near) {
            Some(bitrate_bps) => self.is_heard_at(bitrate_bps, dwell).map(Some),
            None => Ok(None),
        }
    }

    /// Whether frames arrive without error. They did near by, so silence only means that more time is needed.
    fn is_heard_at(&mut self, bitrate_bps: u32, dwell: Duration) -> Result<bool, DeviceError> {
        Ok(self.listen(bitrate_bps, dwell * 3)?.unwrap_or_default().is_good())
    }
}

/// Reachable rates around one, a half per cent apart where the clock has so many, the fastest first.
fn rates_around(clock_hz: u32, rate: f64) -> Vec<u32> {
    const REACH: f64 = 0.025;
    let clocks = |rate: f64| (f64::from(clock_hz) / rate).round() as u32;
    let mut rates: Vec<u32> = Vec::new();
    for clocks in clocks(rate * (1.0 + REACH)).max(1)..=clocks(rate * (1.0 - REACH)) {
        let rate = f64::from(clock_hz) / f64::from(clocks);
        let far = rates.last().is_none_or(|last| f64::from(*last) / rate > 1.0 + SAME / 2.0);
        let in_range = (f64::from(MIN_BITRATE_BPS)..=f64::from(MAX_BITRATE_BPS)).contains(&rate);
        if far && in_range && BitTiming::of_clocks(clocks).next().is_some() {
            rates.push(rate.round() as u32);
        }
    }
    rates
}

/// The reachable bit rate nearest to `rate`, in bit/s, if there is one within 2 %.
fn nearest(clock_hz: u32, rate: f64) -> Option<u32> {
    let exact = (f64::from(clock_hz) / rate).round() as u32;
    let reach = exact / 50 + 1;
    (exact.saturating_sub(reach).max(1)..=exact + reach)
        .filter(|clocks| BitTiming::of_clocks(*clocks).next().is_some())
        .map(|clocks| f64::from(clock_hz) / f64::from(clocks))
        .filter(|found| (f64::from(MIN_BITRATE_BPS)..=f64::from(MAX_BITRATE_BPS)).contains(found))
        .min_by(|a, b| (a - rate).abs().total_cmp(&(b - rate).abs()))
        .map(|found| found.round() as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scan_leaves_no_gap_that_a_rate_could_hide_in() {
        let rates = scan_rates(36_000_000);
        assert_eq!(rates.first(), Some(&1_000_000));
        assert!(rates.iter().all(|rate| (5_000..=1_000_000).contains(rate)));
        // Fast rates have few dividers: there the clock itself sets the steps.
        for pair in rates.windows(2).filter(|pair| pair[0] < 300_000) {
            assert!(f64::from(pair[0]) / f64::from(pair[1]) < 1.03, "{pair:?}");
        }
        assert!(rates.len() < 800, "{}", rates.len());
    }

    #[test]
    fn neighbours_are_reachable_rates() {
        assert_eq!(nearest(36_000_000, 250_000.0), Some(250_000));
        let above = nearest(36_000_000, 254_000.0).unwrap();
        assert!((251_000..257_000).contains(&above), "{above}");
    }
}

#[cfg(all(test, feature = "virtual"))]
mod on_the_virtual_device {
    use super::*;
    use crate::Address;

    fn search_on(options: &str) -> (Outcome, Duration) {
        let device = Device::open(&format!("virtual:{options}").parse::<Address>().unwrap()).unwrap();
        let started = Instant::now();
        let limits = Limits { silence: Duration::from_millis(500), ..Limits::default() };
        let outcome = search(&device, Channel::Can1, &limits, &mut |_| true).unwrap();
        let taken = started.elapsed();
        assert!(device.status().unwrap().channels[0].open.is_none());
        assert_eq!(device.status().unwrap().channels[0].transmitted, 0);
        (outcome, taken)
    }

    #[test]
    fn every_common_rate_is_found() {
        for bitrate in COMMON_BPS {
            let (outcome, _) = search_on(&format!("bitrate={bitrate},load=50"));
            assert!(
                matches!(outcome, Outcome::Found { bitrate_bps, .. } if bitrate_bps == bitrate),
                "{bitrate}: {outcome:?}"
            );
        }
    }

    /// 16 kbit/s of load at 125 kbit/s are about 50 frames a second, each in its own time.
    #[test]
    fn fifty_frames_a_second_are_enough_for_an_answer_within_a_second() {
        let (outcome, taken) = search_on("bitrate=125k,burst=1/20ms");
        assert!(matches!(outcome, Outcome::Found { bitrate_bps: 125_000, .. }), "{outcome:?}");
        assert!(taken < Duration::from_secs(1), "{taken:?}");
    }

    /// The clock does not reach 253.97 kbit/s itself; the simulated controller hears what is within 1 %.
    #[test]
    fn an_odd_rate_is_not_taken_for_its_common_neighbour() {
        for bitrate in [253_968, 255_319, 480_000, 117_647] {
            let (outcome, _) = search_on(&format!("bitrate={bitrate},load=60"));
            let Outcome::Found { bitrate_bps, .. } = outcome else { panic!("{bitrate}: {outcome:?}") };
            let off = f64::from(bitrate_bps) / f64::from(bitrate) - 1.0;
            assert!(off.abs() < 0.01 && !COMMON_BPS.contains(&bitrate_bps), "{bitrate}: {bitrate_bps}");
        }
    }

    #[test]
    fn silence_and_noise_are_told_apart() {
        assert_eq!(search_on("load=0").0, Outcome::NoTraffic);
        let (outcome, _) = search_on("bitrate=500k,load=80,errors=100");
        assert!(matches!(outcome, Outcome::NoMatch { errors: 1.. }), "{outcome:?}");
    }
}
