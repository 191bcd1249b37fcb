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
/// Moments that are compared.
const MOMENTS: usize = 256;

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
}

impl CommonClock {
    /// Of two devices whose maps have marks and round trips of the same minutes.
    ///
    /// Each of the last marks is a moment that is compared, so that frames which run apart are noticed. To be repeated
    /// after a device's marks were interrupted, since it may then count from another turn.
    pub fn between(first: &ClockMap, second: &ClockMap) -> Result<Self, NotCommon> {
        let unsure = |map: &ClockMap| map.report().uncertainty_ns.unwrap_or(0);
        let known_ns = MARGIN_NS + unsure(first) + unsure(second);
        Self::by_utc(first.frames(), |at| first.utc(at).0, second.frames(), |at| second.utc(at).0, known_ns)
    }

    /// The same for any clocks, whose ticks the functions map to one time in nanoseconds, so well that two of them differ
    /// by no more than `known_ns` at one moment.
    pub fn by_utc(
        first: &FrameClock,
        first_utc: impl Fn(Ticks) -> i64,
        second: &FrameClock,
        second_utc: impl Fn(Ticks) -> i64,
        known_ns: i64,
    ) -> Result<Self, NotCommon> {
        for frames in [first, second] {
            let last = frames.marks().next_back().map_or(Ticks(0), |(at, _)| at);
            frames.trust(last).map_err(NotCommon::Doubt)?;
        }
        let dated = |frames: &FrameClock, utc: &dyn Fn(Ticks) -> i64| -> Vec<(i64, FrameNs)> {
            frames.marks().map(|(at, frame)| (utc(at), frame)).collect()
        };
        let (first, second) = (dated(first, &first_utc), dated(second, &second_utc));
        let mut differences: Vec<i64> = first
            .iter()
            .rev()
            .filter_map(|(utc, frame)| Some(interpolated(&second, *utc)?.since(*frame)))
            .take(MOMENTS)
            .collect();
        differences.sort_unstable();
        let Some(middle) = differences.get(differences.len() / 2) else { return Err(NotCommon::Apart) };
        let turns_ns = (middle + TURN_NS / 2).div_euclid(TURN_NS) * TURN_NS;
        let off = |difference: i64| (difference - turns_ns).abs();
        let disagreement_ns = differences.iter().copied().map(off).max().unwrap_or(0);
        if disagreement_ns > known_ns {
            let (off_us, known_us) = (disagreement_ns / 1000, known_ns / 1000);
            return Err(NotCommon::Controllers { off_us, known_us });
        }
        Ok(Self { turns_ns, disagreement_ns })
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
    /// [`Self::between`] found out by, and what a common clock saves.
    pub const fn disagreement_ns(&self) -> i64 {
        self.disagreement_ns
    }
}

/// The frame time at a UTC time between two marks.
fn interpolated(marks: &[(i64, FrameNs)], utc: i64) -> Option<FrameNs> {
    let next = marks.partition_point(|(at, _)| *at <= utc);
    let ((from_utc, from), (to_utc, to)) = (marks.get(next.checked_sub(1)?)?, marks.get(next)?);
    let share = (utc - from_utc) as f64 / (to_utc - from_utc) as f64;
    Some(from.plus((to.since(*from) as f64 * share) as i64))
}
