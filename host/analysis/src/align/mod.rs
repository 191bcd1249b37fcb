//! Puts traces of several recorders on the same bus on one clock, by means of the frames themselves.
//!
//! Recorders on different computers have different clocks, and the difference changes while they record. But a bus gives all
//! of them the same frames in the same order. So runs of frames that occur once in each trace are found ([`Sketch`]), those
//! whose times are consistent with each other are kept, and a piecewise linear [`ClockMap`] is fitted to them. [`Verifier`]
//! then compares the traces frame by frame and says how far apart the stamps of the same frame still are, and which frames
//! only one of them has.
//!
//! Nothing is assumed about how the clocks are set: one trace may have dates and the other only seconds since its start.
//! Frames that repeat exactly, without any counter or measured value, cannot be told apart; in that case there is an
//! [`AlignError`] rather than a guess.

mod chain;
mod clock_map;
mod compare;
#[cfg(test)]
mod compare_tests;
mod sketch;
#[cfg(test)]
mod tests;
mod verify;

use std::collections::BTreeMap;

use chain::{Chain, FEWEST, Unclear, chains};
pub use clock_map::ClockMap;
pub use compare::{Comparison, Differences, Side, compare};
use sketch::Pair;
pub use sketch::Sketch;
pub use verify::{Agreement, Verifier};

/// Lengths of runs in frames, tried one after the other: if little changes on a bus, only long runs occur
/// once.
pub const RUN_LENGTHS: [usize; 3] = [4, 32, 256];

/// How far off the stamps of two neighbouring moments may be, from the best recorders to those with late stamps in
/// milliseconds. The first value for which most moments agree is used.
const SLACKS_NS: [i64; 3] = [100_000, 2_000_000, 20_000_000];

/// How the second trace's clock and channels relate to the first one's.
#[derive(Clone, Debug)]
pub struct Alignment {
    /// Converts the second trace's times to the first one's.
    pub map: ClockMap,
    /// Channels of the first trace, each with that of the second on the same bus.
    pub channels: Vec<(u8, u8)>,
    /// Number of moments on which the map is based.
    pub moments: usize,
    /// The first and the last of them, in the first trace's time.
    pub common_ns: (i64, i64),
    /// How far apart stamps of the same frame may be.
    tolerance_ns: i64,
}

/// Why two traces cannot be aligned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AlignError {
    /// Hardly any run of frames is in both.
    #[error("no part of one is found in the other: did both record the same bus at the same time?")]
    NothingInCommon,
    /// The times of what both have do not agree.
    #[error("the same frames are in both, but their times do not fit together")]
    TimesDisagree,
    /// There are several equally good answers.
    #[error("the traffic repeats itself, so that several time differences fit equally well")]
    Ambiguous,
}

/// Determines how the second trace's clock relates to the first one's. Both sketches must have runs of the same length.
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

/// Keeps the pairs of channels that have the most in common: those are on the same bus.
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
