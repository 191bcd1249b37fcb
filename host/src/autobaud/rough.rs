//! Estimates the length of a bit when no frame can be read completely: next to a channel under full load, the device may miss a part of every
//! frame, and on a bad bus every frame may be destroyed.
//!
//! What remains are distances from one edge to the next of the same kind, each a whole number of bits, ten at most. The bit time is the
//! one that they are all multiples of and at which single bits occur. That is not proof, so the result counts only if the controller then
//! receives frames.

use super::measure::{Measured, ROUNDING_TICKS};
use super::reading::PinEdge;

/// Step from one trial bit time to the next: a third of a per cent is a sixtieth of a bit over five bits.
const STEP: f64 = 1.003;
/// Five bits of one level and five of the other are the most that stuffing allows.
const MOST_BITS: f64 = 10.5;
/// How near a distance must be to a whole number of bits. One in five random distances is that near by
/// chance.
const NEAR_BITS: f64 = 0.1;
/// Distances needed at least.
const LEAST_DISTANCES: usize = 100;
/// The fraction of all distances that must be short enough, and the fraction of those that must be near a whole
/// number.
const LEAST_SHORT: f64 = 0.6;
const LEAST_NEAR: f64 = 0.75;
/// The fraction of all pulses that must be single bits: nearly half of them are.
const LEAST_SINGLE: f64 = 0.2;

/// Estimates a bit that is between `least` and `most` ticks long.
pub(super) fn estimate(edges: &[PinEdge], least: f64, most: f64) -> Option<Measured> {
    let in_turn = edges
        .windows(3)
        .filter(|three| !three[1].unsure && !three[2].unsure)
        .filter(|three| three[0].dominant != three[1].dominant && three[1].dominant != three[2].dominant);
    let (distances, pulses): (Vec<f64>, Vec<f64>) =
        in_turn.map(|three| (three[2].at - three[0].at, three[1].at - three[0].at)).unzip();
    if distances.len() < LEAST_DISTANCES {
        return None;
    }
    let mut best = (0.0, least);
    let mut tried = least / STEP;
    while tried <= most * STEP {
        let score = score(&distances, &pulses, tried);
        if score > best.0 {
            best = (score, tried);
        }
        tried *= STEP;
    }
    let (score, mut bit_ticks) = best;
    if score <= 0.0 {
        return None;
    }
    let mut error = 1.0;
    for _ in 0..3 {
        let near = distances.iter().filter_map(|distance| {
            let bits = bits_of(*distance, bit_ticks)?;
            Some((bits, distance - bits * bit_ticks))
        });
        let (count, squares, up, off) = near.fold((0.0, 0.0, 0.0, 0.0), |sum, (bits, off)| {
            (sum.0 + 1.0, sum.1 + bits * bits, sum.2 + bits * off, sum.3 + off * off)
        });
        bit_ticks += up / squares;
        let scatter: f64 = off / count;
        error = scatter.sqrt().max(ROUNDING_TICKS) / squares.sqrt() / bit_ticks;
    }
    Some(Measured { bit_ticks, error, frames: 0, acknowledged: 0 })
}

/// The whole number of bits in a distance.
fn bits_of(distance: f64, bit_ticks: f64) -> Option<f64> {
    let bits = distance / bit_ticks;
    (bits < MOST_BITS && (bits - bits.round()).abs() < NEAR_BITS && bits > 1.5).then_some(bits.round())
}

/// How well a bit time fits; 0 if it does not.
fn score(distances: &[f64], pulses: &[f64], bit_ticks: f64) -> f64 {
    let part = |count: usize, of: usize| count as f64 / of.max(1) as f64;
    let short = distances.iter().filter(|distance| **distance < MOST_BITS * bit_ticks).count();
    let near = distances.iter().filter(|distance| bits_of(**distance, bit_ticks).is_some()).count();
    let single = pulses.iter().filter(|pulse| (**pulse / bit_ticks).round() as u32 == 1).count();
    let fits = part(short, distances.len()) >= LEAST_SHORT
        && part(near, short) >= LEAST_NEAR
        && part(single, pulses.len()) >= LEAST_SINGLE;
    if fits { part(near, short) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::autobaud::measure::tests::{FRAMES, LEAST, MOST, Pin, RATES, TICK_HZ};

    #[test]
    fn pieces_of_frames_are_enough_for_a_guess() {
        for bps in RATES {
            let mut pin = Pin::at(bps);
            pin.slow = 0.2 * pin.bit;
            for text in FRAMES.into_iter().cycle().take(30) {
                pin.frame(text);
            }
            // Blind for a third of the time.
            let (period, hole) = (48.0 * pin.bit, 16.0 * pin.bit);
            pin.edges.retain(|edge| edge.at % period > hole);
            for n in 1..pin.edges.len() {
                pin.edges[n].unsure = pin.edges[n].at - pin.edges[n - 1].at > hole;
            }
            let measured = estimate(&pin.edges, LEAST, MOST).unwrap_or_else(|| panic!("{bps}"));
            let off = (TICK_HZ / measured.bit_ticks / bps - 1.0).abs();
            assert!(off < 0.002, "{bps}: {off}");
        }
    }

    #[test]
    fn destroyed_frames_tell_their_bits() {
        for bps in RATES {
            let mut pin = Pin::at(bps);
            for n in 0..40 {
                pin.destroyed(FRAMES[n % 5], 15 + n % 20);
            }
            let measured = estimate(&pin.edges, LEAST, MOST).unwrap_or_else(|| panic!("{bps}"));
            let off = (TICK_HZ / measured.bit_ticks / bps - 1.0).abs();
            assert!(off < 0.002, "{bps}: {off}");
        }
    }

    #[test]
    fn few_edges_and_noise_tell_nothing() {
        let mut pin = Pin::at(500e3);
        pin.frame("123#");
        assert_eq!(estimate(&pin.edges, LEAST, MOST), None);
        let mut random = 99_u64;
        let mut at = 0.0;
        let noise: Vec<PinEdge> = (0..600)
            .map(|n| {
                random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                at += 20.0 + (random >> 40) as f64 % 300.0;
                PinEdge { at, dominant: n % 2 == 0, unsure: false }
            })
            .collect();
        assert_eq!(estimate(&noise, LEAST, MOST), None);
    }
}
