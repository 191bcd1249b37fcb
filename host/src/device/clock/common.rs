//! Two devices on one clock: that of the USB host controller which both hang on.
//!
//! Every device on a controller hears the same frames with the same numbers at the same moments. So a tick of one device is a frame
//! time, and that is a tick of the other: two marks' jitter, a tenth of a microsecond, and no round trip is in it. What must be
//! found out is which turn of the frame number, of 2.048 s, each device counts from, and whether they are on one controller at all. UTC
//! tells both: at one moment of it, the devices' frame times must differ by whole turns, to the millisecond or less that UTC is
//! known to. On two controllers the numbers have nothing to do with one another, and are that close by chance once in a thousand.

use super::units::{FrameNs, Ticks};
use super::{ClockMap, FrameClock, FrameDoubt};

/// Nanoseconds of a turn of the frame number: 2¹¹ frames.
const TURN_NS: i64 = 2_048_000_000;
/// What two devices' frame times may differ by at one UTC beside what UTC is known to.
const MARGIN_NS: i64 = 500_000;
/// Moments that are compared: marks of the first device, about one a second.
const MOMENTS: usize = 256;
/// The newest of them, which are judged by themselves too: frames that have run apart are to be noticed within seconds.
const NEWEST: usize = 5;

/// Why two devices have no clock in common.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotCommon {
    /// A device's marks are not to be built on.
    #[error("{0}")]
    Doubt(FrameDoubt),
    /// They were not marked at the same time.
    #[error("the devices have not marked USB frames at the same time")]
    Apart,
    /// At one moment, the frames of one are numbered differently from those of the other.
    #[error(
        "the devices are on different USB host controllers: their frames are {off_us} us apart, and UTC is known to {known_us} us"
    )]
    Controllers {
        /// How far apart, in microseconds.
        off_us: i64,
        /// How far apart they could be, by what is known of UTC.
        known_us: i64,
    },
}

/// Maps one device's ticks to another's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CommonClock {
    /// The second device's frame time less the first's: whole turns.
    turns_ns: i64,
    disagreement_ns: i64,
    outliers: usize,
}

/// A device's mark with its UTC.
struct Dated {
    utc: i64,
    /// How far off that may be.
    unsure_ns: i64,
    frame: FrameNs,
}

/// Two devices' frame times at one UTC.
#[derive(Clone, Copy)]
struct Moment {
    difference_ns: i64,
    /// What they may differ by beside whole turns.
    known_ns: i64,
}

impl Moment {
    fn off_ns(&self, turns_ns: i64) -> i64 {
        (self.difference_ns - turns_ns).abs()
    }
}

impl CommonClock {
    /// Of two devices whose maps have marks and round trips of the same minutes.
    ///
    /// Each of the last marks is a moment that is compared, by what was known of UTC then. What most of them say is so, and
    /// what most of the newest say: a mark or an answer that was late once is counted ([`Self::outliers`]) and decides nothing,
    /// and frames that run apart are noticed within seconds. To be repeated after a device's marks were interrupted, since it may
    /// then count from another turn.
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

    /// The second device's time when the first one's is `ticks`. `None` if either has too few marks to tell.
    pub fn to_second(&self, first: &FrameClock, ticks: Ticks, second: &FrameClock) -> Option<Ticks> {
        second.ticks_at(first.at(ticks)?.plus(self.turns_ns))
    }

    /// The first device's time when the second one's is `ticks`.
    pub fn to_first(&self, first: &FrameClock, ticks: Ticks, second: &FrameClock) -> Option<Ticks> {
        first.ticks_at(second.at(ticks)?.plus(-self.turns_ns))
    }

    /// The most that the two devices' UTC, each by its own round trips, was apart from what the frames say, in nanoseconds: what
    /// [`Self::between`] found out by, and what a common clock saves. Late marks and answers are in it.
    pub const fn disagreement_ns(&self) -> i64 {
        self.disagreement_ns
    }

    /// How many of the moments compared were farther apart than what was known of UTC then allows: late marks, late answers.
    pub const fn outliers(&self) -> usize {
        self.outliers
    }
}

/// The middle one of some values; `None` of none.
fn middle(moments: &[Moment], value: impl Fn(&Moment) -> i64) -> Option<i64> {
    let mut values: Vec<i64> = moments.iter().map(value).collect();
    values.sort_unstable();
    values.get(values.len() / 2).copied()
}

/// The frame time at a UTC time between two marks, and how far off that UTC may be.
fn interpolated(marks: &[Dated], utc: i64) -> Option<(FrameNs, i64)> {
    let next = marks.partition_point(|mark| mark.utc <= utc);
    let (from, to) = (marks.get(next.checked_sub(1)?)?, marks.get(next)?);
    let share = (utc - from.utc) as f64 / (to.utc - from.utc) as f64;
    let frame = from.frame.plus((to.frame.since(from.frame) as f64 * share) as i64);
    Some((frame, from.unsure_ns.max(to.unsure_ns)))
}
