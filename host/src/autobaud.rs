//! Finds the bit rate of a bus by measuring it, without sending anything.
//!
//! The device reports the edges on the channel's receive pin while its controller is off the bus. One frame is enough to know the length of
//! a bit to a thousandth (`measure`), whatever the bit rate; if none is whole, pieces of many frames give a guess (`rough`). `rates` picks
//! the bit rate that the controller's clock can reach. The controller then listens at that rate and confirms it with frames that it
//! receives itself. Nothing is ever driven.

mod measure;
mod rates;
mod reading;
mod rough;

use std::time::Duration;

use cantap_wire::message::{ChannelConfig, Edges, MAX_EDGES};
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};
use cantap_wire::{BitTiming, Channel};

use self::measure::{Measured, measure};
pub use self::rates::COMMON_BPS;
use self::rates::{Reached, reach};
use self::reading::PinEdge;
use self::rough::estimate;
use crate::{Device, DeviceError};

/// Frames that the controller has to receive.
const GOOD_FRAMES: u32 = 4;
/// With fewer frames, the answer is given after this time, so that it is there within a second.
const ANSWER_AFTER: Duration = Duration::from_millis(900);
/// The controller listens for at least this long if it receives nothing.
const LISTEN: Duration = Duration::from_millis(100);
/// The same after two frames were read bit by bit: they prove the bit rate, so only errors could still contradict it.
const LISTEN_PROVEN: Duration = Duration::from_millis(10);
/// This many errors without a frame between them mean that the measured rate was wrong, or that no frame ends
/// well.
const MOST_ERRORS: u32 = 12;
/// How often to measure again in that case.
const ROUNDS: u32 = 3;
/// How often to ask the device.
const ASK_EVERY: Duration = Duration::from_millis(2);
/// A measurement with this standard error is good enough; otherwise measuring continues for a while.
const GOOD_ERROR: f64 = 0.000_3;
/// If the measurement has not improved after this time, it is used as it is.
const BETTER_WITHIN: Duration = Duration::from_millis(150);
/// Another frame may follow the first at once and makes the measurement certain; after a pause of this many bits, none does.
const PAUSE_BITS: f64 = 30.0;
/// The minimum for that pause, which matters at high bit rates.
const PAUSE: Duration = Duration::from_millis(5);
/// How far off a guess may be, as a fraction of the bit rate: interrupts make the device see edges late, and not all of them
/// equally late.
const GUESS_ERROR: f64 = 0.004;
/// Edges evaluated together: those of half a dozen frames.
const MOST_EDGES: usize = 700;
/// New edges that are worth evaluating while there is no pause: those of two frames.
const MANY_EDGES: usize = 120;
/// With this many edges seen for [`GUESS_AFTER`] and not one whole frame, a guess has to do.
const GUESS_EDGES: u64 = 300;
/// See [`GUESS_EDGES`].
const GUESS_AFTER: Duration = Duration::from_millis(250);
/// Without a pause between frames, evaluate after this time.
const LOOK_EVERY: Duration = Duration::from_millis(40);

/// What the search is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Measuring bits.
    Measuring {
        /// Edges seen so far.
        edges: u64,
    },
    /// Frames were measured; the controller listens for more at their rate.
    Confirming {
        /// In bit/s.
        bitrate_bps: u32,
        /// Good frames so far.
        frames: u32,
    },
}

/// What the search found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Outcome {
    /// The bit rate.
    Found {
        /// In bit/s, as the controller has it.
        bitrate_bps: u32,
        /// What was measured, in bit/s by the device's clock.
        measured_bps: f64,
        /// The timing that it was heard with.
        timing: BitTiming,
        /// Good frames, measured and heard.
        frames: u32,
    },
    /// Nothing happened on the bus.
    NoTraffic,
    /// The bus is dominant, and stays so.
    Stuck,
    /// Something happened, but nothing of it was a whole frame.
    Unreadable {
        /// Level changes.
        edges: u64,
    },
    /// No rate that the controller's clock reaches is near enough to receive every frame.
    Unreachable {
        /// What was measured, in bit/s.
        measured_bps: f64,
        /// The nearest that the clock reaches, in bit/s.
        nearest_bps: Option<u32>,
    },
    /// The bits were measured, but then no good frame was received.
    Unconfirmed {
        /// In bit/s, as the controller has it.
        bitrate_bps: u32,
        /// What was measured, in bit/s.
        measured_bps: f64,
        /// Whether anybody acknowledged the measured frames; true if no frame was whole.
        acknowledged: bool,
        /// Errors that the controller counted.
        errors: u32,
    },
    /// The caller asked to stop.
    Stopped,
}

/// How long to search, by the device's clock.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Give up after this long without anything new.
    pub silence: Duration,
}

impl Default for Limits {
    /// A silent bus is given up after ten seconds.
    fn default() -> Self {
        Self { silence: Duration::from_secs(10) }
    }
}

struct Search<'a> {
    device: &'a Device,
    channel: Channel,
    limits: &'a Limits,
    progress: &'a mut dyn FnMut(Progress) -> bool,
    /// The device's time at the beginning, and when something was last heard.
    began: u64,
    heard: u64,
    /// Level changes in total.
    seen: u64,
    /// The latest edges, and the time of the very last one, in ticks since the measurement began.
    edges: Vec<PinEdge>,
    at: f64,
}

/// Finds the bit rate of a channel's bus. `progress` is called repeatedly and ends the search by returning false. The channel must be
/// closed, and is closed afterwards.
pub fn search(
    device: &Device,
    channel: Channel,
    limits: &Limits,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Outcome, DeviceError> {
    let began = device.time()?;
    let mut search = Search {
        device,
        channel,
        limits,
        progress,
        began,
        heard: began,
        seen: 0,
        edges: Vec::new(),
        at: 0.0,
    };
    let outcome = search.run();
    // Also when the search was abandoned half-way.
    let ended = device.measure_edges(None);
    let outcome = outcome?;
    ended.map(|()| outcome)
}

/// The result of one measurement.
enum Round {
    /// Frames, or a guess that has none.
    Frames(Measured),
    /// The search is over.
    Over(Outcome),
}

impl Search<'_> {
    fn run(&mut self) -> Result<Outcome, DeviceError> {
        let mut rounds = 0;
        // Before saying that the clock does not reach a rate, read two frames; after a contradiction, measure
        // again.
        let mut wanted = 1;
        let mut goes_on = false;
        loop {
            if !std::mem::take(&mut goes_on) {
                self.begin()?;
            }
            let measured = match self.measure(wanted)? {
                Round::Frames(measured) => measured,
                Round::Over(outcome) => return Ok(outcome),
            };
            let measured_bps = f64::from(self.device.hello().tick_hz) / measured.bit_ticks;
            let is_guess = measured.frames == 0;
            let error = if is_guess { measured.error.max(GUESS_ERROR) } else { measured.error };
            let bitrate_bps = match reach(self.device.hello().can_clock_hz, measured_bps, error) {
                Reached::At { bitrate_bps } => bitrate_bps,
                Reached::Not { .. } if measured.frames == 1 && wanted == 1 => {
                    (wanted, goes_on) = (2, true);
                    continue;
                }
                // A guess is not certain enough to call a rate out of reach.
                Reached::Not { .. } if is_guess => return Ok(Outcome::Unreadable { edges: self.seen }),
                Reached::Not { nearest_bps } => {
                    return Ok(Outcome::Unreachable { measured_bps, nearest_bps });
                }
            };
            rounds += 1;
            match self.confirm(bitrate_bps, measured, measured_bps)? {
                Outcome::Unconfirmed { errors: MOST_ERRORS.., .. } if rounds < ROUNDS => {}
                outcome => return Ok(outcome),
            }
        }
    }

    /// A time in the device's ticks.
    fn ticks(&self, time: Duration) -> u64 {
        (time.as_secs_f64() * f64::from(self.device.hello().tick_hz)) as u64
    }

    /// Starts a measurement from scratch.
    fn begin(&mut self) -> Result<(), DeviceError> {
        self.device.measure_edges(Some(self.channel))?;
        self.edges.clear();
        self.at = 0.0;
        Ok(())
    }

    /// Measures until this many frames were read, or nothing new arrives. Everything read since the measurement began
    /// counts.
    fn measure(&mut self, wanted: u32) -> Result<Round, DeviceError> {
        let tick_hz = f64::from(self.device.hello().tick_hz);
        // Slightly wider than what a device can open, so that a rate beyond it is named rather than mistaken
        // for another.
        let [least, most] = [MAX_BITRATE_BPS, MIN_BITRATE_BPS].map(|bps| tick_hz / f64::from(bps));
        let (mut unread, mut looked) = (0, self.began);
        let begun = self.device.time()?;
        let guess_at = begun + self.ticks(GUESS_AFTER);
        // When the first frame was read, and the result of all frames so far.
        let mut found = measure(&self.edges, least, most).map(|measured| (begun, measured));
        loop {
            let told = self.device.edges()?;
            let (new, now) = (told.edges.len(), told.ticks);
            for edge in &told.edges {
                self.at += f64::from(edge.ticks);
                self.edges.push(PinEdge { at: self.at, dominant: edge.dominant, unsure: edge.unsure });
            }
            if new > 0 {
                self.heard = now;
                self.seen += new as u64;
                unread += new;
            }
            if new == MAX_EDGES && unread < MOST_EDGES {
                continue;
            }
            let is_due =
                new == 0 || unread >= MANY_EDGES || now.saturating_sub(looked) > self.ticks(LOOK_EVERY);
            if unread > 0 && is_due {
                self.edges.drain(..self.edges.len().saturating_sub(MOST_EDGES));
                (unread, looked) = (0, now);
                if let Some(measured) = measure(&self.edges, least, most) {
                    found = Some((found.map_or(now, |(since, _)| since), measured));
                } else if found.is_none()
                    && self.seen >= GUESS_EDGES
                    && now > guess_at
                    && let Some(guess) = estimate(&self.edges, least, most)
                {
                    return Ok(Round::Frames(guess));
                }
            }
            if let Some((since, measured)) = found {
                let is_good =
                    measured.error <= GOOD_ERROR || now.saturating_sub(since) > self.ticks(BETTER_WITHIN);
                let pause = self.ticks(PAUSE).max((PAUSE_BITS * measured.bit_ticks) as u64);
                let is_alone = now.saturating_sub(self.heard) > pause;
                if measured.frames >= wanted && is_good && (measured.frames > 1 || is_alone) {
                    return Ok(Round::Frames(measured));
                }
            }
            if let Some(over) = self.is_over(&told, found.is_some()) {
                return Ok(found.map_or(Round::Over(over), |(_, measured)| Round::Frames(measured)));
            }
            if !(self.progress)(Progress::Measuring { edges: self.seen }) {
                return Ok(Round::Over(Outcome::Stopped));
            }
            std::thread::sleep(ASK_EVERY);
        }
    }

    /// Whether it is time to give up, and with which outcome.
    fn is_over(&self, told: &Edges, has_frames: bool) -> Option<Outcome> {
        let limit = self.ticks(self.limits.silence);
        let quiet = told.ticks.saturating_sub(self.heard) > limit;
        let fruitless = !has_frames && told.ticks.saturating_sub(self.began) > limit;
        match self.seen {
            _ if quiet && told.dominant => Some(Outcome::Stuck),
            0 if quiet => Some(Outcome::NoTraffic),
            edges if quiet || edges > 0 && fruitless => Some(Outcome::Unreadable { edges }),
            _ => None,
        }
    }

    /// Lets the controller listen at a measured rate.
    fn confirm(
        &mut self,
        bitrate_bps: u32,
        measured: Measured,
        measured_bps: f64,
    ) -> Result<Outcome, DeviceError> {
        let timing = self.device.timing(bitrate_bps)?;
        let index = self.channel.index();
        let before = self.device.status()?.channels[index];
        self.device.open_channel(self.channel, Some(ChannelConfig::listen_only(timing)))?;
        let outcome =
            self.listen(bitrate_bps, measured, measured_bps, timing, before.frames, before.bus_errors);
        self.device.close_channel(self.channel)?;
        outcome
    }

    fn listen(
        &mut self,
        bitrate_bps: u32,
        measured: Measured,
        measured_bps: f64,
        timing: BitTiming,
        frames_before: u32,
        errors_before: u32,
    ) -> Result<Outcome, DeviceError> {
        // The device's time, not the host's: an emulated device may run slower.
        let opened = self.device.time()?;
        let is_proven = measured.frames > 1 && measured.acknowledged > 0;
        let listen = if is_proven { LISTEN_PROVEN } else { LISTEN };
        let answer_at = (self.began + self.ticks(ANSWER_AFTER)).max(opened + self.ticks(listen));
        loop {
            std::thread::sleep(ASK_EVERY);
            let status = self.device.status()?;
            let now = status.channels[self.channel.index()];
            let frames = now.frames.wrapping_sub(frames_before);
            let errors = now.bus_errors.wrapping_sub(errors_before);
            // One frame that the controller received, or two that were read bit by bit with nothing to contradict
            // them.
            let is_enough = frames > 0 || is_proven && errors == 0;
            if frames >= GOOD_FRAMES || is_enough && status.ticks >= answer_at {
                let frames = frames + measured.frames;
                return Ok(Outcome::Found { bitrate_bps, measured_bps, timing, frames });
            }
            let is_late = status.ticks.saturating_sub(opened) > self.ticks(self.limits.silence);
            if is_late || frames == 0 && errors >= MOST_ERRORS {
                let acknowledged = measured.acknowledged > 0 || measured.frames == 0;
                return Ok(Outcome::Unconfirmed { bitrate_bps, measured_bps, acknowledged, errors });
            }
            if !(self.progress)(Progress::Confirming { bitrate_bps, frames }) {
                return Ok(Outcome::Stopped);
            }
        }
    }
}
