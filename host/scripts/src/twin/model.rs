//! What is known of a bus after its trace was read.

use super::content::Content;
use super::exchanges::{self, Exchange};
use super::learner::{Key, Observed, Seen};
use super::role::Role;
use super::timing::{self, Period};

/// The most identifiers in a script.
const MAX_STREAMS: usize = 1024;
/// The most steps of all lists of a script together.
const MAX_STEPS: usize = 100_000;
/// The most steps of one list, and the fewest that it may have whatever else there is.
const MAX_LIST: usize = 500;
const MIN_LIST: usize = 20;

/// A bus.
#[derive(Clone, Debug)]
pub struct Model {
    /// Of the trace, in nanoseconds.
    pub duration_ns: u64,
    /// Each identifier that is in a script.
    pub streams: Vec<Stream>,
    /// Who asks and who answers.
    pub exchanges: Vec<Exchange>,
    /// Identifiers that are in no script because there are too many, and their frames.
    pub omitted: (usize, usize),
    /// Frames of answers that are in no script because there are too many.
    pub omitted_answers: usize,
}

/// The frames of one identifier.
#[derive(Clone, Debug)]
pub struct Stream {
    /// Which ones.
    pub key: Key,
    /// Their number in the trace.
    pub frames: usize,
    /// The first one's time in nanoseconds since the trace's first frame.
    pub first_ns: u64,
    /// Who sends them, and why.
    pub role: Role,
    /// When they come.
    pub timing: Timing,
    /// What is in them.
    pub content: Content,
}

/// When frames come.
#[derive(Clone, Debug, PartialEq)]
pub enum Timing {
    /// Periodically, until a time in nanoseconds since the first frame if the sender stopped before the trace ended.
    Periodic {
        /// The period.
        period: Period,
        /// Until when.
        until_ns: Option<u64>,
    },
    /// As recorded: each frame, with the time since the one before in nanoseconds; for the first since the trace began.
    Recorded(Vec<(u64, cantap_can::Frame)>),
}

impl Model {
    /// Learns a bus.
    pub fn learn(observed: &Observed) -> Self {
        let mut chosen: Vec<(&Key, &Vec<Seen>)> = observed.streams.iter().collect();
        // Of equally many frames, the lower identifier stays.
        chosen.sort_by_key(|(key, seen)| (std::cmp::Reverse(seen.len()), **key));
        let rest = chosen.split_off(chosen.len().min(MAX_STREAMS));
        chosen.sort_by_key(|(key, _)| **key);
        let omitted = (rest.len(), rest.iter().map(|(_, seen)| seen.len()).sum());
        let periods: Vec<Option<Period>> = chosen.iter().map(|(_, seen)| timing::period(seen)).collect();
        let roles = exchanges::roles(&chosen, &periods);
        let (exchanges, omitted_answers) = exchanges::learn(&chosen, &roles);
        let longest = (MAX_STEPS / chosen.len().max(1)).clamp(MIN_LIST, MAX_LIST);
        let streams = chosen.into_iter().zip(&periods).zip(roles.of).map(|(((key, seen), period), role)| {
            let period = period.filter(|_| role == Role::Sender);
            let timing = match period {
                Some(period) => {
                    let until_ns = timing::stop_ns(seen, period, observed.duration_ns);
                    Timing::Periodic { period, until_ns }
                }
                None => Timing::Recorded(recorded(seen, longest)),
            };
            Stream {
                key: *key,
                frames: seen.len(),
                first_ns: seen.first().map_or(0, |seen| seen.at_ns),
                role,
                timing,
                content: Content::of(seen, longest),
            }
        });
        let streams = streams.collect();
        Self { duration_ns: observed.duration_ns, streams, exchanges, omitted, omitted_answers }
    }
}

/// The first frames with their delays.
fn recorded(seen: &[Seen], longest: usize) -> Vec<(u64, cantap_can::Frame)> {
    let mut before_ns = 0;
    let step = |seen: &Seen| (seen.at_ns - std::mem::replace(&mut before_ns, seen.at_ns), seen.frame);
    seen.iter().take(longest).map(step).collect()
}
