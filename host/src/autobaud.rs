//! Finds a bus's bit rate without a word: the channel only listens, at one rate after the other.
//!
//! A rate is right when several frames in a row arrive without an error. Near rates pass that test too, since controllers
//! resynchronise: 253.97 kbit/s may be heard at 250. So a common rate must be heard again with the sample point as late
//! as it can be, where 1.5 % are too much; and for any other the rates around are listened to, until the frames themselves tell
//! how fast the bus is (`hearing.rs`).

mod hearing;
mod rates;

use std::time::Duration;

use cantap_wire::message::ChannelConfig;
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};
use cantap_wire::{BitTiming, Channel, Command, Frame};

use self::hearing::Bounds;
pub use self::rates::COMMON_BPS;
use self::rates::{SAME, clocks_of, next_to_study, round_rates, scan_rates, sharpest};
use crate::device::Records;
use crate::{Device, DeviceError, Direction, TraceEvent, TraceFrame, bits_on_bus};

/// Good frames in a row that make a candidate.
const GOOD_FRAMES: u32 = 4;
/// Good frames in a row that a common rate needs with the sharpest timing: at a neighbour some frames pass, and more in a row
/// rarely.
const SHARP_FRAMES: u32 = 10;
/// Frames and errors that are weighed where there are both: a frame may have been destroyed at the right rate, too.
const WEIGHED_FRAMES: u32 = 24;
/// The right rate is wrong about fewer than one frame in this many.
const FRAMES_PER_ERROR: u32 = 8;
/// Frames and errors that are looked at where both tell something.
const STUDY_FRAMES: u32 = 8;
/// A rate at which a frame was heard is listened to for this long at least.
const PATIENCE: Duration = Duration::from_secs(2);
/// How often the device is asked.
const ASK_EVERY: Duration = Duration::from_millis(2);
/// Frames of one rate that are measured.
const MOST_MEASURED: u32 = 32;
/// Frames that are kept to compare with.
const KEPT_FRAMES: usize = 16;
/// Rates around a candidate that are studied.
const MOST_STUDIED: usize = 12;
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
        /// Good frames heard at the end.
        frames: u32,
    },
    /// Nothing happened on the bus.
    NoTraffic,
    /// Something did, and no rate fitted.
    NoMatch {
        /// Errors seen.
        errors: u64,
        /// The bus's bit rate in bit/s, where frames told it, and no rate that the controller's clock reaches is near
        /// enough to receive every frame.
        about_bps: Option<f64>,
    },
    /// It was asked to stop.
    Stopped,
}

/// How long to look, by the device's clock.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// At each rate while nothing at all happens; the first round. Later rounds take longer.
    pub dwell: Duration,
    /// Altogether, while the bus is silent; but each common rate is tried once.
    pub silence: Duration,
}

impl Default for Limits {
    /// For 20 frames a second and more; a silent bus is given up after ten seconds.
    fn default() -> Self {
        Self { dwell: Duration::from_millis(60), silence: Duration::from_secs(10) }
    }
}

/// What was heard at one rate.
#[derive(Clone, Copy, Debug)]
struct Heard {
    frames: u32,
    errors: u32,
    /// Shortest bit that the stamps of neighbouring frames allow, as the highest rate, in bit/s.
    fastest_bps: Option<f64>,
    /// Of the bus's rate, by the frames themselves.
    bounds: Bounds,
}

impl Default for Heard {
    fn default() -> Self {
        Self { frames: 0, errors: 0, fastest_bps: None, bounds: Bounds::NONE }
    }
}

impl Heard {
    const fn is_good(&self) -> bool {
        let seen = self.frames + self.errors;
        self.frames >= GOOD_FRAMES && self.errors == 0
            || seen >= WEIGHED_FRAMES && self.errors * FRAMES_PER_ERROR < seen
    }
}

struct Search<'a> {
    device: &'a Device,
    channel: Channel,
    records: Records,
    /// Some that were received, near the bus's rate.
    frames: Vec<Frame>,
    progress: &'a mut dyn FnMut(Progress) -> bool,
    errors: u64,
    /// Something was heard, be it an error.
    heard: bool,
    /// The device's time at which a bus that is still silent is given up.
    give_up: u64,
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
    let mut search = Search {
        device,
        channel,
        records,
        frames: Vec::new(),
        progress,
        errors: 0,
        heard: false,
        give_up: u64::MAX,
        stopped: false,
    };
    let give_up = device.time()?.saturating_add(search.ticks(limits.silence));
    let mut dwell = limits.dwell;
    loop {
        // Traffic that is there and fits none of the common rates is worth the long scan. Before it they are tried
        // again: what came first at the right one may have been a frame that was destroyed.
        let of = COMMON_BPS.len();
        for _ in 0..2 {
            let common = COMMON_BPS.into_iter().enumerate();
            let rates = common.map(|(at, bitrate_bps)| Progress::Common { bitrate_bps, at, of });
            if let Some(found) = search.try_all(rates, dwell)? {
                return Ok(found);
            }
            if search.errors == 0 {
                break;
            }
        }
        if search.errors > 0 {
            let grid = scan_rates(device.hello().can_clock_hz);
            let of = grid.len();
            let rates = grid.into_iter().enumerate();
            let rates = rates.map(|(at, bitrate_bps)| Progress::Scan { bitrate_bps, at, of });
            let found = search.try_all(rates, dwell)?;
            return Ok(found.unwrap_or(Outcome::NoMatch { errors: search.errors, about_bps: None }));
        }
        search.give_up = give_up;
        // A quiet bus needs longer looks.
        dwell *= 3;
    }
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
            if !self.heard && self.device.time()? > self.give_up {
                return Ok(Some(Outcome::NoTraffic));
            }
            let Ok(timing) = self.device.timing(bitrate_bps) else { continue };
            let heard = self.find(timing, Purpose::Find, dwell)?;
            self.errors += u64::from(heard.errors);
            self.heard |= heard.frames + heard.errors > 0;
            if heard.is_good()
                && let Some(found) = self.make_sure(bitrate_bps, heard, dwell)?
            {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }

    /// A time in the device's ticks.
    fn ticks(&self, time: Duration) -> u64 {
        (time.as_secs_f64() * f64::from(self.device.hello().tick_hz)) as u64
    }

    /// Listens with a timing whether it is the right one. Where there are frames and errors, again, to weigh them.
    fn find(&mut self, timing: BitTiming, purpose: Purpose, dwell: Duration) -> Result<Heard, DeviceError> {
        let heard = self.listen(timing, purpose, dwell)?;
        if heard.frames > 0 && heard.errors > 0 {
            self.listen(timing, Purpose::Weigh, dwell)
        } else {
            Ok(heard)
        }
    }

    /// Listens with a timing until there is evidence or the time is over.
    fn listen(&mut self, timing: BitTiming, purpose: Purpose, dwell: Duration) -> Result<Heard, DeviceError> {
        let clock_hz = self.device.hello().can_clock_hz;
        if !(MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(&timing.bitrate_bps(clock_hz)) {
            // Beyond what a device opens. Nothing of the bus can be there either.
            return Ok(Heard::default());
        }
        let index = self.channel.index();
        let before = self.device.status()?.channels[index];
        while self.records.next_batch(Duration::ZERO)?.is_some_and(|batch| !batch.is_empty()) {}
        self.device.open_channel(self.channel, Some(ChannelConfig::listen_only(timing)))?;
        // The device's time, not ours: an emulated one may be slower.
        let started = self.device.time()?;
        let mut dwell = self.ticks(dwell);
        let mut heard = Heard::default();
        loop {
            std::thread::sleep(ASK_EVERY);
            let status = self.device.status()?;
            let now = status.channels[index];
            heard.frames = now.frames.wrapping_sub(before.frames);
            heard.errors = now.bus_errors.wrapping_sub(before.bus_errors);
            let enough = match purpose {
                // A wrong rate shows at once.
                Purpose::Find => heard.errors > 0 || heard.frames >= GOOD_FRAMES,
                Purpose::Doubt { frames } => heard.errors > 0 || heard.frames >= frames,
                Purpose::Weigh => heard.errors + heard.frames >= WEIGHED_FRAMES,
                Purpose::Study => heard.errors + heard.frames >= STUDY_FRAMES,
            };
            if enough || status.ticks.saturating_sub(started) > dwell {
                break;
            }
            // Frames are worth waiting for the next.
            if heard.frames > 0 {
                dwell = dwell.max(self.ticks(PATIENCE));
            }
        }
        self.device.request(Command::Close { channel: self.channel })?;
        self.measure(&mut heard, timing)?;
        Ok(heard)
    }

    /// What the frames tell of the bus's rate. Each by itself bounds it. And from the end of one to the end of the next are
    /// at least the next one's bits, so their stamps show the highest rate that is possible.
    fn measure(&mut self, heard: &mut Heard, timing: BitTiming) -> Result<(), DeviceError> {
        let mut last_ns = None;
        let mut studied = 0;
        while let Some(batch) =
            self.records.next_batch(Duration::from_millis(1))?.filter(|batch| !batch.is_empty())
        {
            for record in batch.iter().filter(|record| record.channel == self.channel.number()) {
                let TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction: Direction::Rx, late } =
                    &record.event
                else {
                    last_ns = None;
                    continue;
                };
                if studied < MOST_MEASURED {
                    heard.bounds.narrow(Bounds::of(frame, timing, self.device.hello().can_clock_hz));
                    studied += 1;
                    if self.frames.len() < KEPT_FRAMES && !self.frames.contains(frame) {
                        self.frames.push(*frame);
                    }
                }
                if let Some(last_ns) = last_ns.filter(|_| !late) {
                    let between_ns = (record.time_ns - last_ns) as f64 + STAMP_ERROR_NS;
                    let bps = f64::from(bits_on_bus(frame)) * 1e9 / between_ns;
                    heard.fastest_bps = Some(heard.fastest_bps.map_or(bps, |fastest| fastest.max(bps)));
                }
                last_ns = (!late).then_some(record.time_ns);
            }
        }
        // Stamps are good to half a per cent only where frames are long; they bound the rate from below.
        if let Some(fastest) = heard.fastest_bps {
            heard.bounds.narrow(Bounds { least_bps: fastest * (1.0 - SAME), ..Bounds::NONE });
        }
        Ok(())
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
        // It was heard, so silence from now on only means that more time is needed.
        let dwell = dwell * 3;
        let clock_hz = self.device.hello().can_clock_hz;
        let rate = f64::from(candidate_bps);
        let too_slow = heard.fastest_bps.is_some_and(|fastest| fastest > rate * (1.0 + SAME));
        if COMMON_BPS.contains(&candidate_bps)
            && !too_slow
            && let Some(timing) = sharpest(clocks_of(clock_hz, rate))
            && self.find(timing, Purpose::Doubt { frames: SHARP_FRAMES }, dwell)?.is_good()
            && !self.is_slower_than(rate, dwell)?
        {
            return Ok(self.found(candidate_bps, heard));
        }
        // Each rate around that is heard, if only at times, narrows the bounds, and so does one at which what was heard
        // before would have been heard too.
        let mut bounds = heard.bounds;
        let (mut tried, mut clean) = (Vec::new(), Vec::new());
        while let Some(clocks) = next_to_study(clock_hz, &bounds, &tried)
            && tried.len() < MOST_STUDIED
        {
            tried.push(clocks);
            let usual = self.device.timing((f64::from(clock_hz) / f64::from(clocks)).round() as u32);
            for timing in sharpest(clocks).into_iter().chain(usual) {
                let heard = self.listen(timing, Purpose::Study, dwell)?;
                bounds.narrow(heard.bounds);
                if heard.is_good() && timing.jump_width == 1 && Some(timing) == sharpest(clocks) {
                    clean.push(timing.bitrate_bps(clock_hz));
                }
                if heard.frames == 0 && heard.errors >= GOOD_FRAMES {
                    bounds.exclude(Bounds::of_sure_reception(&self.frames, timing, clock_hz));
                }
            }
        }
        let Some(middle) = bounds.middle_bps() else { return Ok(None) };
        let distance = |bps: &u32| (f64::from(*bps) - middle).abs();
        let inside = |bps: &u32| (bounds.least_bps..=bounds.most_bps).contains(&f64::from(*bps));
        let same = |bps: &u32| distance(bps) < middle * SAME;
        let nearest = |a: &u32, b: &u32| distance(a).total_cmp(&distance(b));
        // Buses have round rates. On a long or badly terminated one no edge is where it should be, and nothing is heard with the
        // sharpest timing: then a common rate is the likeliest.
        let candidates = [
            COMMON_BPS.into_iter().find(same),
            round_rates(clock_hz, &bounds).min_by(nearest),
            clean.into_iter().min_by(nearest),
            COMMON_BPS.into_iter().filter(inside).min_by(nearest),
        ];
        if candidates == [None; 4] {
            return Ok(Some(Outcome::NoMatch { errors: self.errors, about_bps: Some(middle) }));
        }
        for bitrate_bps in candidates.into_iter().flatten() {
            let heard = self.find(self.device.timing(bitrate_bps)?, Purpose::Find, dwell)?;
            if heard.is_good() {
                return Ok(self.found(bitrate_bps, heard));
            }
        }
        Ok(None)
    }

    /// Whether the bus runs at a rate somewhat below the candidate's: then frames are heard a little below it that would not
    /// be at the candidate's.
    fn is_slower_than(&mut self, rate: f64, dwell: Duration) -> Result<bool, DeviceError> {
        /// Nearer, the difference does not matter; farther down, nothing of either would be heard.
        const REACH: [f64; 2] = [0.012, 0.05];
        /// A smaller share of failing frames would take too many to be noticed.
        const LEAST_SHARE: f64 = 0.15;
        /// How likely it may be that none of this many frames is one that tells.
        const CHANCE: f64 = 0.02;
        /// Rates that are thought of.
        const MOST_RATES: usize = 6;
        /// Frames that each timing is tried with.
        const SAMPLE: usize = 4;
        let clock_hz = self.device.hello().can_clock_hz;
        let failing = |timing: BitTiming| {
            let fails = |frame: &&Frame| Bounds::of(frame, timing, clock_hz).most_bps < rate;
            self.frames.iter().filter(fails).count() as f64 / self.frames.len().max(1) as f64
        };
        let [from, to] = REACH.map(|reach| clocks_of(clock_hz, rate * (1.0 - reach)));
        let below = (from.max(clocks_of(clock_hz, rate) + 1)..=to)
            .filter(|clocks| BitTiming::of_clocks(*clocks).next().is_some())
            .take(MOST_RATES);
        // Of the timings that would not take everything from the candidate, the one that takes most from a slower bus.
        let sample = &self.frames[..self.frames.len().min(SAMPLE)];
        let sure = |timing: BitTiming| Bounds::of_sure_reception(sample, timing, clock_hz).most_bps;
        let best = below
            .flat_map(BitTiming::of_clocks)
            .map(|timing| BitTiming { jump_width: 1, ..timing })
            .map(|timing| (timing, failing(timing)))
            .filter(|(_, share)| *share >= LEAST_SHARE)
            .map(|(timing, share)| (timing, share, sure(timing)))
            .max_by(|(.., a), (.., b)| a.total_cmp(b));
        let Some((timing, share, _)) = best else { return Ok(false) };
        let frames = (CHANCE.ln() / (1.0 - share.min(0.9)).ln()).ceil() as u32;
        let heard = self.listen(timing, Purpose::Doubt { frames }, dwell)?;
        Ok(heard.bounds.most_bps < rate)
    }

    fn found(&self, bitrate_bps: u32, heard: Heard) -> Option<Outcome> {
        let timing = self.device.timing(bitrate_bps).ok()?;
        Some(Outcome::Found { bitrate_bps, timing, frames: heard.frames })
    }
}

/// Why a rate is listened to.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Purpose {
    /// Is it this one?
    Find,
    /// Is it this one, though not all that is heard is good?
    Weigh,
    /// Is it this one rather than the one that was heard?
    Doubt {
        /// Good ones that answer yes.
        frames: u32,
    },
    /// It may be near: which frames are heard, and which are not?
    Study,
}
