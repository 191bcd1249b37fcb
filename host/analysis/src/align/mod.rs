//! Traces of several recorders that heard the same bus, set on one clock by the frames themselves.
//!
//! Recorders on different computers have different clocks, and the difference changes while they record. A bus gives every
//! one of them the same frames in the same order, so the frames tell: runs of frames that occur once in each trace are found
//! ([`Sketch`]), those whose times agree with each other are kept, and a piecewise straight [`ClockMap`] is laid through
//! them. [`Verifier`] then compares the traces frame by frame and says how far apart the stamps of the same frame still are,
//! and which frames only one of them has.
//!
//! Nothing is assumed of how the clocks are set: one trace may have dates and the other only seconds since its start. Frames
//! that repeat themselves exactly, without a counter or a measured value anywhere, cannot be told apart; then
//! [`AlignError`] says so rather than guessing.

mod chain;
mod clock_map;
mod sketch;
#[cfg(test)]
mod tests;
mod verify;

use std::collections::BTreeMap;

use chain::{Chain, FEWEST, Unclear, chains};
pub use clock_map::ClockMap;
use sketch::Pair;
pub use sketch::Sketch;
pub use verify::{Agreement, Verifier};

/// Frames in a run, for one attempt after the other: where little changes on a bus, only long runs occur once.
pub const RUN_LENGTHS: [usize; 3] = [4, 32, 256];

/// How far the stamps of two neighbouring moments may be off, from the best recorders to those with stamps of milliseconds
/// that come late. The first at which most moments agree is taken.
const SLACKS_NS: [i64; 3] = [100_000, 2_000_000, 20_000_000];

/// How the second trace's clock and channels relate to the first one's.
#[derive(Clone, Debug)]
pub struct Alignment {
    /// The second trace's times in terms of the first one's.
    pub map: ClockMap,
    /// Channels of the first trace, each with that of the second on the same bus.
    pub channels: Vec<(u8, u8)>,
    /// How many moments the map rests on.
    pub moments: usize,
    /// The first and the last of them, in the first trace's time.
    pub common_ns: (i64, i64),
    /// How far stamps may be off for frames to be taken for the same.
    tolerance_ns: i64,
}

/// Why two traces cannot be aligned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AlignError {
    /// Hardly any run of frames is in both.
    #[error("no stretch of the one is found in the other: did both hear the same bus at the same time?")]
    NothingInCommon,
    /// The times of what both have do not agree with each other.
    #[error("the same frames are in both, but their times do not fit together")]
    TimesDisagree,
    /// Several answers are equally good.
    #[error("the traffic repeats itself, so that several time differences fit equally well")]
    Ambiguous,
}

/// Finds out how the second trace's clock relates to the first one's. Both sketches must be of runs of the same length.
pub fn align(first: &Sketch, second: &Sketch) -> Result<Alignment, AlignError> {
    let mut pairs = first.pairs(second);
    keep_partners(&mut pairs);
    if pairs.len() < FEWEST {
        return Err(AlignError::NothingInCommon);
    }
    let mut best: Result<(Vec<Chain>, i64), Unclear> = Err(Unclear::TooFew);
    for slack_ns in SLACKS_NS {
        match chains(&pairs, slack_ns) {
            Ok(found) => {
                let most = covered(&found) * 2 >= pairs.len();
                if most
                    || best.as_ref().is_ok_and(|(best, _)| covered(&found) > covered(best))
                    || best.is_err()
                {
                    best = Ok((found, slack_ns));
                }
                if most {
                    break;
                }
            }
            Err(unclear) if best.is_err() => best = Err(unclear),
            Err(_) => {}
        }
    }
    let (chains, slack_ns) = best.map_err(|unclear| match unclear {
        Unclear::TooFew => AlignError::TimesDisagree,
        Unclear::Ambiguous => AlignError::Ambiguous,
    })?;
    let used = || chains.iter().flat_map(|chain| &chain.pairs);
    let mut channels: Vec<_> = used().map(|pair| (pair.a_channel, pair.b_channel)).collect();
    channels.sort_unstable();
    channels.dedup();
    let times = || used().map(|pair| pair.a_ns);
    let common_ns = (times().min().unwrap_or_default(), times().max().unwrap_or_default());
    Ok(Alignment {
        map: ClockMap::new(&chains),
        channels,
        moments: covered(&chains),
        common_ns,
        tolerance_ns: 5 * slack_ns,
    })
}

fn covered(chains: &[Chain]) -> usize {
    chains.iter().map(|chain| chain.pairs.len()).sum()
}

/// Keeps the pairs of channels that have the most in common with each other: those are on the same bus.
fn keep_partners(pairs: &mut Vec<Pair>) {
    let mut counts: BTreeMap<(u8, u8), usize> = BTreeMap::new();
    for pair in &*pairs {
        *counts.entry((pair.a_channel, pair.b_channel)).or_default() += 1;
    }
    let mut by_count: Vec<_> = counts.into_iter().collect();
    by_count.sort_by_key(|&(channels, count)| (std::cmp::Reverse(count), channels));
    let mut partners: Vec<(u8, u8)> = Vec::new();
    for ((a, b), count) in by_count {
        if count >= FEWEST && partners.iter().all(|partner| partner.0 != a && partner.1 != b) {
            partners.push((a, b));
        }
    }
    pairs.retain(|pair| partners.contains(&(pair.a_channel, pair.b_channel)));
}
