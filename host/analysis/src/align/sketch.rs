//! Extracts what can be recognised in another trace: runs of consecutive frames that occur only once.
//!
//! Memory is bounded: in a long trace, runs are sampled by their own hash, so that two traces keep the same ones.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};

use cantap_trace::{TraceEvent, TraceRecord};

/// How many runs are kept of a trace: seven a second over ten hours at 5000 frames a second, in about 16 MiB.
const MOST_RUNS: usize = 1 << 18;
/// An odd number without structure (2⁶⁴ divided by the golden ratio), for the rolling hash.
const FACTOR: u64 = 0x9E37_79B9_7F4A_7C15;

/// A trace's runs of consecutive frames, by content.
#[derive(Debug)]
pub struct Sketch {
    /// Number of frames in a run.
    length: usize,
    /// Runs with a hash above this are not kept.
    threshold: u64,
    channels: BTreeMap<u8, Rolling>,
    runs: HashMap<(u64, u8), Run>,
    highest_channel: u8,
    frames: u64,
    /// A stamp that is only an upper bound is a moment, too.
    takes_bounds: bool,
}

/// A run of frames: when it ended, if that is known and it occurred only once.
#[derive(Clone, Copy, Debug)]
struct Run {
    ended_ns: Option<i64>,
}

/// The hash over the last frames of a channel.
#[derive(Debug, Default)]
struct Rolling {
    frames: VecDeque<u64>,
    sum: u64,
}

/// One moment in two traces: the same run of frames ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Pair {
    pub a_ns: i64,
    pub b_ns: i64,
    pub a_channel: u8,
    pub b_channel: u8,
}

impl Sketch {
    /// A sketch with runs of this many frames: longer ones are easier to distinguish, shorter ones survive more
    /// losses.
    pub fn new(length: usize) -> Self {
        Self {
            length: length.max(1),
            threshold: u64::MAX,
            channels: BTreeMap::new(),
            runs: HashMap::new(),
            highest_channel: 0,
            frames: 0,
            takes_bounds: false,
        }
    }

    /// Takes stamps that are only upper bounds for moments, too: a device may have no others.
    pub(super) fn with_bounds(self) -> Self {
        Self { takes_bounds: true, ..self }
    }

    /// Takes the next record.
    pub fn add(&mut self, record: &TraceRecord) {
        self.highest_channel = self.highest_channel.max(record.channel);
        let TraceEvent::Frame { frame, late, .. } = &record.event else { return };
        self.frames += 1;
        let hash = BuildHasherDefault::<DefaultHasher>::default().hash_one(frame);
        let rolling = self.channels.entry(record.channel).or_default();
        let Some(hash) = rolling.push(hash, self.length) else { return };
        if hash > self.threshold {
            return;
        }
        // A stamp that is only an upper bound would be a wrong moment.
        let ended_ns = (self.takes_bounds || !late).then_some(record.time_ns);
        self.runs
            .entry((hash, record.channel))
            .and_modify(|run| run.ended_ns = None)
            .or_insert(Run { ended_ns });
        while self.runs.len() > MOST_RUNS {
            self.threshold /= 2;
            let threshold = self.threshold;
            self.runs.retain(|(hash, _), _| *hash <= threshold);
        }
    }

    /// The highest channel number of any record; 0 if there is none.
    pub fn highest_channel(&self) -> u8 {
        self.highest_channel
    }

    /// The number of frames so far.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// The moments that both traces have, in the order of `self`'s times.
    pub(super) fn pairs(&self, other: &Self) -> Vec<Pair> {
        let mut by_hash: HashMap<u64, Vec<(u8, i64)>> = HashMap::new();
        for ((hash, channel), run) in &other.runs {
            if let Some(ended_ns) = run.ended_ns {
                by_hash.entry(*hash).or_default().push((*channel, ended_ns));
            }
        }
        let mut pairs = Vec::new();
        for ((hash, a_channel), run) in &self.runs {
            let (Some(a_ns), Some(others)) = (run.ended_ns, by_hash.get(hash)) else { continue };
            pairs.extend(others.iter().map(|&(b_channel, b_ns)| Pair {
                a_ns,
                b_ns,
                a_channel: *a_channel,
                b_channel,
            }));
        }
        pairs.sort_unstable_by_key(|pair| (pair.a_ns, pair.b_ns, pair.a_channel, pair.b_channel));
        pairs
    }
}

impl Rolling {
    /// Takes the next frame's hash and returns that of the run that it ends, once there are enough frames.
    fn push(&mut self, hash: u64, length: usize) -> Option<u64> {
        self.sum = self.sum.wrapping_mul(FACTOR).wrapping_add(hash);
        self.frames.push_back(hash);
        if self.frames.len() > length {
            let gone = self.frames.pop_front()?;
            self.sum = self.sum.wrapping_sub(gone.wrapping_mul(FACTOR.wrapping_pow(length as u32)));
        }
        // The low bits of the sum depend little on earlier frames: mix them, since sampling looks at the whole hash.
        (self.frames.len() == length).then(|| (self.sum ^ self.sum >> 32).wrapping_mul(FACTOR))
    }
}
