//! The frames of a trace, sorted by where they belong, in bounded memory.

use std::collections::{BTreeMap, BTreeSet};

use cantap_can::{Frame, FrameBits, Id};
use cantap_trace::{TraceEvent, TraceRecord};

use super::clock::Clock;

/// The most frames that are kept: 80 MB.
const MAX_FRAMES: usize = 2_000_000;
/// The most identifiers that are kept.
const MAX_KEYS: usize = 8192;
/// Channels that a script reaches.
const CHANNELS: usize = 2;

/// Frames that belong together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key {
    /// From 1.
    pub channel: u8,
    /// The identifier.
    pub id: Id,
    /// Whether they are remote frames.
    pub remote: bool,
}

/// A frame of a trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seen {
    /// Nanoseconds since the trace's first frame.
    pub at_ns: u64,
    /// Its number among all frames.
    pub order: u32,
    /// How often anything was missing before it: between two frames of one stretch nothing is known to be.
    pub stretch: u32,
    /// The frame.
    pub frame: Frame,
}

/// Collects the frames of a trace, or of a run.
#[derive(Clone, Debug)]
pub struct Learner {
    bitrates_bps: [u32; CHANNELS],
    clock: Clock,
    /// When the last frame of each channel ended.
    last_ns: BTreeMap<u8, u64>,
    stretch: u32,
    frames: usize,
    observed: Observed,
}

/// What a trace contains.
#[derive(Clone, Debug, Default)]
pub struct Observed {
    /// The frames of each identifier, in the order of the trace.
    pub streams: BTreeMap<Key, Vec<Seen>>,
    /// From the first frame to the last, in nanoseconds.
    pub duration_ns: u64,
    /// Frames that the trace says are missing.
    pub lost: u64,
    /// How often the recorder's clock jumped.
    pub jumps: u64,
    /// Frames that ended sooner after another than their length allows, and got a later time.
    pub too_close: u64,
    /// What is not among the frames, and how often, by kind.
    pub left_out: BTreeMap<&'static str, u64>,
}

impl Learner {
    /// Has seen nothing yet. The bit rates of both channels, in bit/s, say how close to each other frames can be.
    pub fn new(bitrates_bps: [u32; CHANNELS]) -> Self {
        Self {
            bitrates_bps,
            clock: Clock::default(),
            last_ns: BTreeMap::new(),
            stretch: 0,
            frames: 0,
            observed: Observed::default(),
        }
    }

    /// Takes the next record.
    pub fn push(&mut self, record: &TraceRecord) {
        let frame = match &record.event {
            TraceEvent::Frame { frame, .. } => frame,
            TraceEvent::Lost { count, at_least, .. } => {
                self.observed.lost += u64::from(*count);
                if *count > 0 || *at_least {
                    self.stretch += 1;
                }
                return;
            }
            TraceEvent::BusError { .. } => return self.leave_out("errors on the bus"),
            TraceEvent::Lin { .. } => return self.leave_out("LIN frames"),
            TraceEvent::ErrorsSuppressed { .. }
            | TraceEvent::State { .. }
            | TraceEvent::TransmitFailed { .. }
            | TraceEvent::Disturbed { .. } => {
                return self.leave_out("other events");
            }
        };
        let Some(frame) = frame.classic() else { return self.leave_out("FD frames") };
        let key = Key { channel: record.channel, id: frame.id(), remote: frame.is_remote() };
        if self.frames >= MAX_FRAMES {
            return self.leave_out("frames after the first two million");
        }
        if self.observed.streams.len() >= MAX_KEYS && !self.observed.streams.contains_key(&key) {
            return self.leave_out("frames with other identifiers than the first 8192");
        }
        let (at_ns, jumped) = self.clock.advance(record.time_ns);
        if jumped {
            self.observed.jumps += 1;
            self.stretch += 1;
        }
        let at_ns = self.possible(record.channel, frame, at_ns);
        self.observed.duration_ns = self.observed.duration_ns.max(at_ns);
        let order = self.frames as u32;
        self.frames += 1;
        self.observed.streams.entry(key).or_default().push(Seen {
            at_ns,
            order,
            stretch: self.stretch,
            frame: *frame,
        });
    }

    /// The time of a frame's end, or the first that is possible after the one before: stamps may be coarse, or stand still.
    fn possible(&mut self, channel: u8, frame: &Frame, at_ns: u64) -> u64 {
        let bitrate_bps = self.bitrates_bps[usize::from(channel == 2)];
        // The last bits of a frame are after its end; a stamp is not more exact than a microsecond.
        let shortest_ns = FrameBits::of(frame).duration_ns(bitrate_bps).saturating_sub(2_000);
        let possible_ns = self.last_ns.get(&channel).map_or(0, |last_ns| last_ns + shortest_ns);
        self.observed.too_close += u64::from(at_ns < possible_ns);
        let at_ns = at_ns.max(possible_ns);
        self.last_ns.insert(channel, at_ns);
        at_ns
    }

    fn leave_out(&mut self, what: &'static str) {
        *self.observed.left_out.entry(what).or_default() += 1;
    }

    /// All that there was. Of more than two channels the first two with frames remain, as 1 and 2.
    pub fn finish(self) -> Observed {
        let mut observed = self.observed;
        let used: BTreeSet<u8> = observed.streams.keys().map(|key| key.channel).collect();
        let is_named = used.iter().all(|channel| (1..=CHANNELS).contains(&usize::from(*channel)));
        if is_named {
            return observed;
        }
        for (key, frames) in std::mem::take(&mut observed.streams) {
            let place = used.iter().position(|channel| *channel == key.channel).unwrap_or_default();
            if place < CHANNELS {
                observed.streams.insert(Key { channel: place as u8 + 1, ..key }, frames);
            } else {
                *observed.left_out.entry("frames of a third channel and more").or_default() +=
                    frames.len() as u64;
            }
        }
        observed
    }
}

impl Observed {
    /// How many frames there are.
    pub fn frames(&self) -> usize {
        self.streams.values().map(Vec::len).sum()
    }
}
