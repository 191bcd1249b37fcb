//! A device's time measured by the frames of its USB host controller.
//!
//! A mark gives the tick at which a frame of a certain number started, latched by the hardware: it is free of interrupt, driver and
//! round-trip delays. What remains is the tick (83 ns) and the controller's own jitter, which a line through a few marks evens out. So
//! the frames are a ruler without noise, and the same ruler for every device on the controller.
//!
//! Frame numbers have 11 bits. How many frames lie between two marks is known from the device's time, to a fraction of a frame; the
//! frame number must then agree. Marks that do not agree are left out, and after a few in a row the past is given up: the bus was
//! suspended, a chip or host makes two SOFs in a millisecond, or the device has a new host.

use std::collections::VecDeque;

use super::units::{FrameNs, Ticks};

/// How many marks are kept: those of 17 minutes.
const KNOTS: usize = 1024;
/// Frame numbers until they wrap: 11 bits (USB 2.0, 8.4.3).
const NUMBERS: i64 = 2048;
/// Nanoseconds of a frame, by the controller's own clock.
const FRAME_NS: i64 = 1_000_000;
/// Marks on each side used to fit a line. A crystal's rate changes by a few hundredths of a part per million per second, so two
/// seconds are straight to within tens of nanoseconds.
const REACH: usize = 2;
/// Marks that must agree before they are trusted: two intervals.
const ENOUGH: usize = 3;
/// Marks in a row that may disagree with those before; after that, the old ones are given up.
const MOST_STRIKES: u32 = 3;
/// Limit on the milliseconds with more than one SOF, out of about a thousand between two marks. A few occur where the device's and
/// the host's milliseconds drift past one another.
const MOST_DOUBLED: u16 = 500;
/// How far off a single mark may be, in nanoseconds: USB allows a host 500 from frame to frame (2.0, 7.1.12), and hubs add to
/// it.
const JITTER_NS: f64 = 5_000.0;
/// How far apart two crystals may be: 500 ppm for the host (USB 2.0, 7.1.12), and ours.
const UNKNOWN_RATE: f64 = 1e-3;
/// How much a known rate may have changed.
const KNOWN_RATE: f64 = 10e-6;
/// After this long without a mark, the next frame numbers may begin anywhere.
const SILENCE_NS: f64 = 3e9;
/// After this long, nothing is compared with earlier marks: any frame number would be possible.
const FORGET_NS: f64 = 30e9;

/// A device's report of when a frame started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SofMark {
    /// The frame's number: 11 bits.
    pub frame: u16,
    /// When it started, to the tick.
    pub at: Ticks,
    /// Milliseconds since the last mark in which more than one SOF was latched.
    pub doubled: u16,
}

/// Why a device's marks are not trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameDoubt {
    /// It has sent none.
    #[error("the device has marked no start of a USB frame")]
    NoMarks,
    /// It has sent too few to check them.
    #[error("too few USB frames are marked so far")]
    TooFew,
    /// Each millisecond has two, so half of them are not the start of a frame.
    #[error("the device sees two starts of a USB frame in each millisecond")]
    Doubled,
    /// They do not fit the device's own time.
    #[error("the USB frames' numbers do not fit the device's time")]
    Disagree,
    /// There were marks, and then no more.
    #[error("no USB frame has been marked for a while: the bus is suspended")]
    Silent,
}

/// A mark, placed.
#[derive(Clone, Copy, Debug)]
struct Knot {
    at: Ticks,
    /// Its number, without wrapping.
    frame: i64,
    /// The line through it and its neighbours: nanoseconds above the mark, and frame time per nominal time.
    above_ns: f64,
    rate: f64,
}

impl Knot {
    fn raw(&self) -> FrameNs {
        FrameNs(self.frame * FRAME_NS)
    }
}

/// Maps a device's ticks to its controller's frames and back.
#[derive(Clone, Debug)]
pub struct FrameClock {
    /// Nominal.
    ns_per_tick: f64,
    knots: VecDeque<Knot>,
    strikes: u32,
    /// Why there are too few marks.
    doubt: FrameDoubt,
}

impl FrameClock {
    /// A clock without any mark, for a device with this tick rate.
    pub fn new(tick_hz: u32) -> Self {
        Self {
            ns_per_tick: 1e9 / f64::from(tick_hz.max(1)),
            knots: VecDeque::new(),
            strikes: 0,
            doubt: FrameDoubt::NoMarks,
        }
    }

    /// Takes the next mark, in stream order.
    pub fn add(&mut self, mark: SofMark) {
        if mark.doubled > MOST_DOUBLED {
            self.knots.clear();
            self.doubt = FrameDoubt::Doubled;
            return;
        }
        let Some(last) = self.knots.back() else { return self.begin(mark) };
        let elapsed_ns = mark.at.since(last.at) as f64 * self.ns_per_tick;
        if let Some(frame) = self.unwrapped(mark, last, elapsed_ns) {
            self.push(mark.at, frame);
            self.strikes = 0;
            return;
        }
        self.strikes += 1;
        if self.strikes >= MOST_STRIKES || elapsed_ns > FORGET_NS {
            self.doubt = FrameDoubt::Disagree;
            self.begin(mark);
        }
    }

    fn begin(&mut self, mark: SofMark) {
        self.knots.clear();
        self.strikes = 0;
        if self.doubt == FrameDoubt::NoMarks {
            self.doubt = FrameDoubt::TooFew;
        }
        self.push(mark.at, i64::from(mark.frame) % NUMBERS);
    }

    fn push(&mut self, at: Ticks, frame: i64) {
        if self.knots.len() == KNOTS {
            self.knots.pop_front();
        }
        self.knots.push_back(Knot { at, frame, above_ns: 0.0, rate: 1.0 });
        if self.knots.len() >= ENOUGH {
            self.doubt = FrameDoubt::TooFew;
        }
        for index in self.knots.len().saturating_sub(1 + REACH)..self.knots.len() {
            let (above_ns, rate) = self.line(index);
            let knot = &mut self.knots[index];
            (knot.above_ns, knot.rate) = (above_ns, rate);
        }
    }

    /// The mark's frame number without wrapping, if it agrees with the time since the last one.
    fn unwrapped(&self, mark: SofMark, last: &Knot, elapsed_ns: f64) -> Option<i64> {
        if elapsed_ns <= 0.0 || elapsed_ns > FORGET_NS {
            return None;
        }
        let known = self.knots.len() > 1;
        let expected = elapsed_ns * last.rate / FRAME_NS as f64;
        let step = i64::from(mark.frame) - last.frame;
        let turns = ((expected - step as f64) / NUMBERS as f64).round() as i64;
        let frames = step + turns * NUMBERS;
        let off_ns = (frames as f64 - expected).abs() * FRAME_NS as f64;
        let doubt = if known { KNOWN_RATE } else { UNKNOWN_RATE };
        (frames > 0 && off_ns <= JITTER_NS + elapsed_ns * doubt).then_some(last.frame + frames)
    }

    /// The straight line through a mark and its neighbours, by least squares: its height above the mark and its slope.
    fn line(&self, index: usize) -> (f64, f64) {
        let knot = &self.knots[index];
        let first = index.saturating_sub(REACH);
        let last = (index + REACH).min(self.knots.len() - 1);
        // At the end there are neighbours on one side only: use as many of them.
        let first = first.min(last.saturating_sub(2 * REACH));
        let points = self.knots.range(first..=last).map(|near| {
            let x = near.at.since(knot.at) as f64 * self.ns_per_tick;
            (x, near.raw().since(knot.raw()) as f64)
        });
        let (mut n, mut sum_x, mut sum_y) = (0.0, 0.0, 0.0);
        for (x, y) in points.clone() {
            (n, sum_x, sum_y) = (n + 1.0, sum_x + x, sum_y + y);
        }
        let (mean_x, mean_y) = (sum_x / n, sum_y / n);
        let (mut above, mut below) = (0.0, 0.0);
        for (x, y) in points {
            above += (x - mean_x) * (y - mean_y);
            below += (x - mean_x) * (x - mean_x);
        }
        let rate = if below > 0.0 { above / below } else { 1.0 };
        (mean_y - rate * mean_x, rate)
    }

    /// Whether the marks can be relied on at this time, or why not.
    pub fn trust(&self, now: Ticks) -> Result<(), FrameDoubt> {
        match self.knots.back() {
            Some(last) if self.knots.len() >= ENOUGH => {
                let silent = now.since(last.at) as f64 * self.ns_per_tick > SILENCE_NS;
                if silent { Err(FrameDoubt::Silent) } else { Ok(()) }
            }
            _ => Err(self.doubt),
        }
    }

    /// The frame time of a device time. Beyond the first and the last mark, the line continues at its rate. `None` without
    /// two marks.
    pub fn at(&self, ticks: Ticks) -> Option<FrameNs> {
        let (from, to) = self.around(self.knots.partition_point(|knot| knot.at <= ticks))?;
        let ahead_ns = ticks.since(from.at) as f64 * self.ns_per_tick;
        let above_ns = match to {
            Some(to) => {
                let span_ns = to.at.since(from.at) as f64 * self.ns_per_tick;
                let rise = to.raw().since(from.raw()) as f64 + to.above_ns - from.above_ns;
                from.above_ns + ahead_ns * (rise / span_ns)
            }
            None => from.above_ns + ahead_ns * from.rate,
        };
        Some(from.raw().plus(above_ns.round() as i64))
    }

    /// The device time of a frame time, to the nearest tick: the inverse of [`Self::at`].
    pub fn ticks_at(&self, time: FrameNs) -> Option<Ticks> {
        let (from, to) = self.around(self.knots.partition_point(|knot| knot.raw() <= time))?;
        let ahead = time.since(from.raw()) as f64 - from.above_ns;
        let nominal_ns = match to {
            Some(to) => {
                let span_ns = to.at.since(from.at) as f64 * self.ns_per_tick;
                let rise = to.raw().since(from.raw()) as f64 + to.above_ns - from.above_ns;
                ahead * (span_ns / rise)
            }
            None => ahead / from.rate,
        };
        Some(from.at.plus((nominal_ns / self.ns_per_tick).round() as i64))
    }

    /// The marks before and after place `next`; only one if there is none on the other side.
    fn around(&self, next: usize) -> Option<(&Knot, Option<&Knot>)> {
        if self.knots.len() < 2 {
            return None;
        }
        match (next.checked_sub(1), self.knots.get(next)) {
            (None, _) => Some((self.knots.front()?, None)),
            (Some(from), to) => Some((self.knots.get(from)?, to)),
        }
    }

    /// Frame time per nominal device time at the last mark: above 1 if the device's crystal is slower than the controller's.
    pub fn rate(&self) -> f64 {
        self.knots.back().map_or(1.0, |last| last.rate)
    }

    /// The root mean square distance of the marks from the lines through them, in nanoseconds: what the controller's jitter and the
    /// tick do to one mark.
    pub fn scatter_ns(&self) -> f64 {
        let squares: f64 = self.knots.iter().map(|knot| knot.above_ns * knot.above_ns).sum();
        (squares / self.knots.len().max(1) as f64).sqrt()
    }

    /// The marks that are kept: device time, and the frame time at which the frame started.
    pub fn marks(&self) -> impl DoubleEndedIterator<Item = (Ticks, FrameNs)> {
        self.knots.iter().map(|knot| (knot.at, knot.raw()))
    }
}
