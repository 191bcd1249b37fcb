//! What is counted, in all and for each identifier.

use hdrhistogram::Histogram;

/// The lower limits of [`Delays::steps`], in nanoseconds: 1, 2, 5 of each power of ten from a microsecond to ten seconds. The first step also has
/// what is shorter.
pub const STEPS_NS: [u64; 22] = {
    let mut steps = [0; 22];
    let (mut at, mut power) = (0, 1_000);
    while at < steps.len() {
        steps[at] = power * [1, 2, 5][at % 3];
        if at % 3 == 2 {
            power *= 10;
        }
        at += 1;
    }
    steps
};

/// The delays of frames, in nanoseconds.
#[derive(Clone, Debug)]
pub struct Delays {
    count: u64,
    min: u64,
    max: u64,
    sum: u128,
    steps: [u64; STEPS_NS.len()],
    spread: Histogram<u32>,
}

impl Default for Delays {
    fn default() -> Self {
        // It grows with the longest; two digits are 1 %.
        let spread = Histogram::new(2).expect("two digits are allowed");
        Self { count: 0, min: u64::MAX, max: 0, sum: 0, steps: [0; STEPS_NS.len()], spread }
    }
}

impl Delays {
    pub(super) fn add(&mut self, delay_ns: u64) {
        self.count += 1;
        self.min = self.min.min(delay_ns);
        self.max = self.max.max(delay_ns);
        self.sum += u128::from(delay_ns);
        let step = STEPS_NS.partition_point(|&from| from <= delay_ns).saturating_sub(1);
        self.steps[step] += 1;
        // Only what has more than 63 bits is refused.
        let _ = self.spread.record(delay_ns);
    }

    /// How many there are.
    pub const fn count(&self) -> u64 {
        self.count
    }

    /// The shortest.
    pub fn min_ns(&self) -> Option<u64> {
        (self.count > 0).then_some(self.min)
    }

    /// The longest.
    pub fn max_ns(&self) -> Option<u64> {
        (self.count > 0).then_some(self.max)
    }

    /// Their mean.
    pub fn mean_ns(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum as f64 / self.count as f64)
    }

    /// The delay that this percentage of them does not exceed, to 1 %.
    pub fn percentile_ns(&self, percent: f64) -> Option<u64> {
        (self.count > 0).then(|| self.spread.value_at_percentile(percent).clamp(self.min, self.max))
    }

    /// How many are in each step that begins at a value of [`STEPS_NS`].
    pub const fn steps(&self) -> &[u64; STEPS_NS.len()] {
        &self.steps
    }
}

/// Frames of which the trace does not show whether they are missing or extra, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Undecided {
    /// On the second channel, so soon after the trace's beginning that the first channel's frame may have been before it.
    pub start: u64,
    /// On the first channel, so soon before the trace's end that the second channel's frame may come after it.
    pub end: u64,
    /// Frames were lost meanwhile on the channel where theirs should be.
    pub loss: u64,
}

impl Undecided {
    /// All of them.
    pub const fn total(&self) -> u64 {
        self.start + self.end + self.loss
    }
}

/// What became of frames. Of those expected, `matched + missing + replaced + undecided.end` and a part of `undecided.loss`.
#[derive(Clone, Debug, Default)]
pub struct Figures {
    /// On both channels.
    pub matched: u64,
    /// On the first channel, and never on the second.
    pub missing: u64,
    /// On the second channel without a cause on the first.
    pub extra: u64,
    /// Never on the second channel, where a newer one of its rule came instead.
    pub replaced: u64,
    /// Neither missing nor extra, as far as the trace shows.
    pub undecided: Undecided,
    /// Of the matched: an equal one was missing meanwhile, and which of them it was is not known. They have no delay.
    pub ambiguous: u64,
    /// Of the matched: one of the two stamps is only an upper bound.
    pub late: u64,
    /// Of the matched: an equal frame came on the first channel within the window before. The delay is theirs only if no frame
    /// takes longer than such frames are apart.
    pub repeated: u64,
    /// The shortest time between two equal frames on the first channel within the window, in nanoseconds.
    pub shortest_repeat_ns: Option<i64>,
    /// The delays: as the device measured them where it stamped both frames, otherwise differences of UTC.
    pub delays: Delays,
    /// Of the delays: as a device measured them.
    pub by_device: u64,
}
