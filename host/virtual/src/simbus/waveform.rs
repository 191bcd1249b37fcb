//! The level of a simulated bus over time, for watching a receive pin.

use std::collections::VecDeque;

use cantap_trace::levels::{ACK_SLOT_FROM_END, levels};
use cantap_wire::Frame;
use cantap_wire::record::BusErrorKind;

/// Dominant bits of an error flag.
const FLAG_BITS: u64 = 6;
/// How much later an edge to recessive comes than one to dominant: a bus is actively driven only to dominant. This is about the
/// delay of a transceiver and a short line.
const SLOW_RECESSIVE_NS: u64 = 60;

/// A change in the bus's level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge {
    /// The time.
    pub at_ns: u64,
    /// The level after it.
    pub dominant: bool,
}

/// Edges in their order, until they are taken.
#[derive(Debug, Default)]
pub struct Waveform {
    edges: VecDeque<Edge>,
    /// The level after the last edge, whether taken or not.
    dominant: bool,
}

impl Waveform {
    /// Puts a frame on the bus that starts at `start_ns` and ends well, or with an error after this many of its bits.
    pub fn frame(
        &mut self,
        frame: &Frame,
        start_ns: u64,
        bitrate_bps: u32,
        end: Option<(BusErrorKind, u64)>,
    ) {
        let mut bits = levels(frame);
        match end {
            None => {
                let ack = bits.len() - ACK_SLOT_FROM_END;
                bits[ack] = false;
            }
            // A node that saw the error signals it to all.
            Some((_, after)) => {
                bits.truncate(after as usize);
                bits.extend([false; FLAG_BITS as usize]);
            }
        }
        // What follows is recessive.
        for (n, recessive) in bits.into_iter().chain([true]).enumerate() {
            if recessive == self.dominant {
                let at_ns = start_ns + n as u64 * 1_000_000_000 / u64::from(bitrate_bps.max(1));
                let late_ns = if recessive { SLOW_RECESSIVE_NS } else { 0 };
                self.edges.push_back(Edge { at_ns: at_ns + late_ns, dominant: !recessive });
                self.dominant = !recessive;
            }
        }
    }

    /// Takes the next edge whose time has come.
    pub fn pass(&mut self, now_ns: u64) -> Option<Edge> {
        self.edges.pop_front_if(|edge| edge.at_ns <= now_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn edges(end: Option<(BusErrorKind, u64)>) -> Vec<(u64, bool)> {
        let mut wave = Waveform::default();
        wave.frame(&"555#".parse().unwrap(), 5_000, 1_000_000, end);
        std::iter::from_fn(|| wave.pass(u64::MAX)).map(|edge| (edge.at_ns - 5_000, edge.dominant)).collect()
    }

    #[test]
    fn a_frame_begins_dominant_and_is_acknowledged() {
        let good = edges(None);
        assert_eq!(good[..4], [(0, true), (1_060, false), (2_000, true), (3_060, false)]);
        let [.., ack, end] = good[..] else { panic!("{good:?}") };
        // 48 bits with the intermission, of which eleven follow the ACK slot.
        assert_eq!((ack, end), ((36_000, true), (37_060, false)));
    }

    #[test]
    fn an_error_flag_cuts_a_frame_short() {
        let broken = edges(Some((BusErrorKind::Stuff, 20)));
        assert_eq!(broken.last(), Some(&(26_060, false)));
    }
}
