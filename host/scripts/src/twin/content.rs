//! What is in the frames of one identifier: what is computed, and the rest as recorded.

use std::collections::BTreeSet;

use cantap_can::Frame;

use super::checksums::{self, Checksum};
use super::counters::{self, Counter};
use super::learner::Seen;

/// Payloads in a row that stay together when a list is thinned.
const SEGMENT: usize = 50;
/// The fewest pairs that show that a byte depends on a counter in an unknown way, and the share that is enough.
const FEWEST: usize = 6;
const MOSTLY: f64 = 0.9;

/// What is in the frames of one identifier.
#[derive(Clone, Debug)]
pub struct Content {
    /// What counts, if all frames have the same length.
    pub counters: Vec<Counter>,
    /// The values of the counters in the first frame.
    pub begin: Vec<i32>,
    /// The checksum.
    pub checksum: Option<Checksum>,
    /// The frames without what is computed, and how often each was there in a row.
    pub steps: Vec<(Frame, u32)>,
    /// How many steps there were before the list was thinned.
    pub all_steps: usize,
    /// The numbers of bytes that frames have, each once.
    pub lengths: Vec<usize>,
    mask: [u8; 8],
    known: BTreeSet<[u8; 8]>,
    known_whole: BTreeSet<[u8; 8]>,
}

impl Content {
    /// Finds out; the list has at most about `longest` steps.
    pub fn of(seen: &[Seen], longest: usize) -> Self {
        let lengths: BTreeSet<usize> = seen.iter().map(|seen| seen.frame.data_len()).collect();
        let lengths: Vec<usize> = lengths.into_iter().collect();
        let plain = seen.iter().all(|seen| !seen.frame.is_remote() && seen.frame.dlc() <= 8);
        let (mut counters, mut checksum) = (Vec::new(), None);
        if let [len] = lengths[..]
            && plain
        {
            let neighbours = seen.windows(2).filter(|pair| pair[0].stretch == pair[1].stretch);
            let pairs: Vec<([u8; 8], [u8; 8])> =
                neighbours.map(|pair| (pair[0].frame.padded_data(), pair[1].frame.padded_data())).collect();
            let payloads: Vec<[u8; 8]> = seen.iter().map(|seen| seen.frame.padded_data()).collect();
            counters = counters::find(&pairs, len);
            checksum = checksums::find(&payloads, len, &counters);
            if let Some(checksum) = &checksum {
                // What looked like a counter in it is none.
                let is_apart = |counter: &Counter| {
                    counter.field.mask()[checksum.byte] & checksum.mask()[checksum.byte] == 0
                };
                counters.retain(is_apart);
            }
            if !counters.is_empty() && checksum.is_none() && has_unknown_checksum(&pairs, len, &counters) {
                // Counted anew, the recorded checksum would be wrong.
                counters.clear();
            }
        }
        let mut mask = [0xFF; 8];
        let computed = counters.iter().map(|counter| counter.field.mask());
        for bits in computed.chain(checksum.as_ref().map(Checksum::mask)) {
            (0..8).for_each(|at| mask[at] &= !bits[at]);
        }
        let first = seen.first().map(|seen| seen.frame.padded_data()).unwrap_or_default();
        let begin = counters.iter().map(|counter| counter.field.get(first)).collect();
        let masked = |frame: &Frame| {
            Frame::from_bus(frame.id(), frame.is_remote(), frame.dlc(), and(frame.padded_data(), mask))
        };
        let mut all: Vec<(Frame, u32)> = Vec::new();
        for seen in seen {
            let frame = masked(&seen.frame);
            match all.last_mut() {
                Some((last, times)) if *last == frame => *times += 1,
                _ => all.push((frame, 1)),
            }
        }
        let known = seen.iter().map(|seen| masked(&seen.frame).padded_data()).collect();
        let known_whole = seen.iter().map(|seen| seen.frame.padded_data()).collect();
        let all_steps = all.len();
        let steps = thinned(all, longest);
        Self { counters, begin, checksum, steps, all_steps, lengths, mask, known, known_whole }
    }

    /// Whether the trace had a frame with these data.
    pub fn has(&self, frame: &Frame) -> bool {
        self.known_whole.contains(&frame.padded_data())
    }

    /// Whether it had one, counters and checksums aside.
    pub fn has_rest(&self, frame: &Frame) -> bool {
        self.known.contains(&and(frame.padded_data(), self.mask))
    }
}

fn and(data: [u8; 8], mask: [u8; 8]) -> [u8; 8] {
    std::array::from_fn(|at| data[at] & mask[at])
}

/// Whether a byte changes with the counter although nothing else does.
fn has_unknown_checksum(pairs: &[([u8; 8], [u8; 8])], len: usize, counters: &[Counter]) -> bool {
    let counted: [u8; 8] =
        std::array::from_fn(|at| counters.iter().fold(0, |bits, counter| bits | counter.field.mask()[at]));
    (0..len).filter(|at| counted[*at] == 0).any(|at| {
        let same = |pair: &&([u8; 8], [u8; 8])| {
            (0..len).all(|other| other == at || (pair.0[other] ^ pair.1[other]) & !counted[other] == 0)
        };
        let alike: Vec<_> = pairs.iter().filter(same).collect();
        let changed = alike.iter().filter(|pair| pair.0[at] != pair.1[at]).count();
        alike.len() >= FEWEST && changed as f64 >= MOSTLY * alike.len() as f64
    })
}

/// A list of about `longest` steps: rows of neighbours from all over a longer one.
fn thinned(all: Vec<(Frame, u32)>, longest: usize) -> Vec<(Frame, u32)> {
    if all.len() <= longest {
        return all;
    }
    let segment = SEGMENT.min(longest);
    let segments = (longest / segment).max(1);
    let begins =
        (0..segments).map(|number| number * (all.len() - segment) / segments.saturating_sub(1).max(1));
    begins.flat_map(|begin| all[begin..begin + segment].to_vec()).collect()
}
