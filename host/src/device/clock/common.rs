//! Puts two devices on one clock: that of the USB host controller that both are connected to.
//!
//! Every device on a controller hears the same frames with the same numbers at the same moments. So a tick of one device corresponds to
//! a frame time, and that to a tick of the other, with no error but the jitter of two marks (a tenth of a microsecond): no round trip
//! is involved. What has to be found out is from which wrap of the frame number (every 2.048 s) each device counts, and whether they
//! are on one controller at all. UTC answers both: at one UTC, the devices' frame times must differ by whole wraps, to within the
//! millisecond or less to which UTC is known. On two controllers the numbers are unrelated, and agree that closely by chance once in a
//! thousand.

use super::units::{FrameNs, Ticks};
use super::{ClockMap, FrameClock, FrameDoubt};

/// Nanoseconds until the frame number wraps: 2¹¹ frames.
const TURN_NS: i64 = 2_048_000_000;
/// How far apart two devices' frame times may be at one UTC, in addition to the uncertainty of UTC.
const MARGIN_NS: i64 = 500_000;
/// How many moments are compared: marks of the first device, about one a second.
const MOMENTS: usize = 256;
/// The newest of them, which are also judged on their own: frames that drift apart should be noticed within seconds.
const NEWEST: usize = 5;

/// Why two devices have no clock in common.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotCommon {
    /// A device's marks cannot be relied on.
    #[error("{0}")]
    Doubt(FrameDoubt),
    /// The devices were not marked at the same time.
    #[error("the devices have not marked USB frames at the same time")]
    Apart,
    /// At one moment, the two devices number their frames differently.
    #[error(
        "the devices are on different USB host controllers: their frames are {off_us} us apart, and UTC is known to {known_us} us"
    )]
    Controllers {
        /// How far apart, in microseconds.
        off_us: i64,
        /// How far apart they could be, given the uncertainty of UTC.
        known_us: i64,
    },
}

/// Maps one device's ticks to another's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CommonClock {
    /// The second device's frame time minus the first's: whole wraps.
    turns_ns: i64,
    disagreement_ns: i64,
    outliers: usize,
}

/// A device's mark with its UTC.
struct Dated {
    utc: i64,
    /// The uncertainty of that UTC.
    unsure_ns: i64,
    frame: FrameNs,
}

/// Both devices' frame times at one UTC.
#[derive(Clone, Copy)]
struct Moment {
    difference_ns: i64,
    /// How far apart they may be, apart from whole wraps.
    known_ns: i64,
}

impl Moment {
    fn off_ns(&self, turns_ns: i64) -> i64 {
        (self.difference_ns - turns_ns).abs()
    }
}

impl CommonClock {
    /// Relates two devices whose maps have marks and round trips from the same minutes.
    ///
    /// Each of the last marks is compared, with what was known of UTC at that time. The majority of them decides, and the
    /// majority of the newest: a single late mark or answer is counted ([`Self::outliers`]) and decides nothing, and frames that
    /// drift apart are noticed within seconds. Repeat this after a device's marks were interrupted, since it may then count from
    /// another wrap.
    pub fn between(first: &ClockMap, second: &ClockMap) -> Result<Self, NotCommon> {
        for frames in [first.frames(), second.frames()] {
            let last = frames.marks().next_back().map_or(Ticks(0), |(at, _)| at);
            frames.trust(last).map_err(NotCommon::Doubt)?;
        }
        let dated = |map: &ClockMap| -> Vec<Dated> {
            let date = |(at, frame)| {
                let (utc, unsure_ns) = map.utc_within(at);
                Dated { utc: utc.0, unsure_ns, frame }
            };
            map.frames().marks().map(date).collect()
        };
        let (first, second) = (dated(first), dated(second));
        let compared = first.iter().rev().filter_map(|mark| {
            let (frame, unsure_ns) = interpolated(&second, mark.utc)?;
            let known_ns = MARGIN_NS + mark.unsure_ns + unsure_ns;
            Some(Moment { difference_ns: frame.since(mark.frame), known_ns })
        });
        let newest_first: Vec<Moment> = compared.take(MOMENTS).collect();
        let Some(usual_ns) = middle(&newest_first, |moment| moment.difference_ns) else {
            return Err(NotCommon::Apart);
        };
        let turns_ns = (usual_ns + TURN_NS / 2).div_euclid(TURN_NS) * TURN_NS;
        let outlies = |moment: &&Moment| moment.off_ns(turns_ns) > moment.known_ns;
        let newest = &newest_first[..newest_first.len().min(NEWEST)];
        for moments in [newest, &newest_first] {
            if moments.iter().filter(outlies).count() * 2 > moments.len() {
                let off_ns = middle(moments, |moment| moment.off_ns(turns_ns)).unwrap_or(0);
                let known_ns = middle(moments, |moment| moment.known_ns).unwrap_or(0);
                return Err(NotCommon::Controllers { off_us: off_ns / 1000, known_us: known_ns / 1000 });
            }
        }
        Ok(Self {
            turns_ns,
            disagreement_ns: newest_first.iter().map(|moment| moment.off_ns(turns_ns)).max().unwrap_or(0),
            outliers: newest_first.iter().filter(outlies).count(),
        })
    }

    /// The second device's time when the first one's is `ticks`. `None` if either has too few marks for this.
    pub fn to_second(&self, first: &FrameClock, ticks: Ticks, second: &FrameClock) -> Option<Ticks> {
        second.ticks_at(first.at(ticks)?.plus(self.turns_ns))
    }

    /// The first device's time when the second one's is `ticks`.
    pub fn to_first(&self, first: &FrameClock, ticks: Ticks, second: &FrameClock) -> Option<Ticks> {
        first.ticks_at(second.at(ticks)?.plus(-self.turns_ns))
    }

    /// The largest difference between the devices' UTC, each from its own round trips, and what the frames say, in nanoseconds:
    /// the error that a common clock avoids. It includes late marks and answers.
    pub const fn disagreement_ns(&self) -> i64 {
        self.disagreement_ns
    }

    /// How many of the compared moments were farther apart than the uncertainty of UTC then allowed: late marks or late
    /// answers.
    pub const fn outliers(&self) -> usize {
        self.outliers
    }
}

/// The median of a value; `None` if there are no moments.
fn middle(moments: &[Moment], value: impl Fn(&Moment) -> i64) -> Option<i64> {
    let mut values: Vec<i64> = moments.iter().map(value).collect();
    values.sort_unstable();
    values.get(values.len() / 2).copied()
}

/// The frame time at a UTC between two marks, and the uncertainty of that UTC.
fn interpolated(marks: &[Dated], utc: i64) -> Option<(FrameNs, i64)> {
    let next = marks.partition_point(|mark| mark.utc <= utc);
    let (from, to) = (marks.get(next.checked_sub(1)?)?, marks.get(next)?);
    let share = (utc - from.utc) as f64 / (to.utc - from.utc) as f64;
    let frame = from.frame.plus((to.frame.since(from.frame) as f64 * share) as i64);
    Some((frame, from.unsure_ns.max(to.unsure_ns)))
}
