//! Reads frames from the edges of a receive pin at a bit time that is only a guess: if the guess is wrong, stuffing or the CRC
//! shows it.

use cantap_wire::{Frame, Id};

use cantap_trace::bits::FrameBits;

/// A change of the pin's level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PinEdge {
    /// In ticks.
    pub at: f64,
    /// The level after it.
    pub dominant: bool,
    /// Edges may be missing before it.
    pub unsure: bool,
}

/// An edge of a frame, and the bit that it begins, counted from the start of frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PlacedEdge {
    pub bit: u32,
    pub edge: PinEdge,
}

/// A frame with a correct CRC.
#[derive(Clone, Debug)]
pub(super) struct ReadFrame {
    /// Its sender's edges up to the end of the CRC, except for those that may have come too early.
    pub edges: Vec<PlacedEdge>,
    /// Whether anybody acknowledged it.
    pub acknowledged: bool,
}

/// Before a start of frame the bus is recessive for at least eleven bits: the end of a frame or error frame, and the intermission.
const IDLE_BITS: f64 = 9.5;
/// Pulses shorter than this fraction of a bit are ignored.
const GLITCH_BITS: f64 = 0.3;
/// Where to cut a dominant pulse into bits, as a fraction of a bit: edges to recessive come late rather than
/// early.
const LATE_BITS: f64 = 0.15;
/// How many equal bits stuffing allows.
const STUFF_AFTER: u32 = 5;
/// Recessive bits that are certain once a bus shows no further edge.
const SILENT_BITS: u32 = 11;

/// Reads every frame that can be read at this bit time, even across a moment in which edges may be missing: if one is missing, the levels do
/// not alternate or the CRC is wrong.
pub(super) fn read_frames(edges: &[PinEdge], bit_ticks: f64) -> Vec<ReadFrame> {
    let mut frames = Vec::new();
    let mut at = 0;
    while at < edges.len() {
        match read_frame(edges, at, bit_ticks) {
            Some((frame, next)) => {
                frames.push(frame);
                at = next;
            }
            None => at += 1,
        }
    }
    frames
}

/// The frame that begins at an edge, and the first edge after it.
fn read_frame(edges: &[PinEdge], start: usize, bit_ticks: f64) -> Option<(ReadFrame, usize)> {
    let first = edges[start];
    let idle = |before: &PinEdge| first.unsure || first.at - before.at > IDLE_BITS * bit_ticks;
    if !first.dominant || !start.checked_sub(1).is_none_or(|before| idle(&edges[before])) {
        return None;
    }
    let mut bits = Parser::default();
    let mut placed = vec![PlacedEdge { bit: 0, edge: first }];
    let (mut bit, mut falling) = (0, first);
    let mut at = start;
    loop {
        let (up, rising) = next_pulse(edges, at, bit_ticks)?;
        let dominant = ((rising.at - falling.at) / bit_ticks - LATE_BITS).round();
        let down = next_pulse(edges, up, bit_ticks);
        if rising.dominant || !(1.0..=f64::from(STUFF_AFTER)).contains(&dominant) {
            return None;
        }
        let dominant = dominant as u32;
        let recessive = match down {
            // Measured from one edge to dominant to the next, which asymmetry does not affect.
            Some((_, next)) if next.dominant => {
                let whole = ((next.at - falling.at) / bit_ticks).round();
                if whole <= f64::from(dominant) {
                    return None;
                }
                (whole as u32 - dominant).min(SILENT_BITS)
            }
            Some(_) => return None,
            None => SILENT_BITS,
        };
        placed.push(PlacedEdge { bit: bit + dominant, edge: rising });
        let levels = (0..dominant).map(|_| false).chain((0..recessive).map(|_| true));
        for (n, level) in levels.enumerate() {
            match bits.push(level)? {
                Step::More => {}
                // The delimiter after the CRC: what follows comes from other nodes.
                Step::End => {
                    let end = bit + n as u32;
                    placed.retain(|placed| placed.bit <= end && !placed.edge.unsure);
                    // Only the delimiter and then dominant: the acknowledgement.
                    let acknowledged = down.is_some() && bit + dominant + recessive == end + 1;
                    let next = down.map_or(edges.len(), |(next, _)| next);
                    return Some((ReadFrame { edges: placed, acknowledged }, next));
                }
            }
        }
        let (next, edge) = down?;
        bit += dominant + recessive;
        placed.push(PlacedEdge { bit, edge });
        (at, falling) = (next, edge);
    }
}

/// The next edge, skipping pulses too short to be a bit.
fn next_pulse(edges: &[PinEdge], mut at: usize, bit_ticks: f64) -> Option<(usize, PinEdge)> {
    loop {
        at += 1;
        let edge = *edges.get(at)?;
        match edges.get(at + 1) {
            Some(behind) if behind.at - edge.at < GLITCH_BITS * bit_ticks && !behind.unsure => at += 1,
            _ => return Some((at, edge)),
        }
    }
}

enum Step {
    More,
    /// This was the recessive bit after a correct CRC.
    End,
}

/// Collects a frame's bits as they arrive.
#[derive(Default)]
struct Parser {
    /// Without stuff bits; true for recessive.
    bits: Vec<bool>,
    last: Option<bool>,
    run: u32,
}

impl Parser {
    /// Takes a bit; `None` if this cannot be a frame.
    fn push(&mut self, recessive: bool) -> Option<Step> {
        let same = self.last == Some(recessive);
        let (run, whole) = (self.run, self.wanted() == Some(self.bits.len()));
        self.run = if same { run + 1 } else { 1 };
        self.last = Some(recessive);
        if run == STUFF_AFTER {
            return (!same).then_some(Step::More);
        }
        if whole {
            return (recessive && self.crc_is_right()).then_some(Step::End);
        }
        self.bits.push(recessive);
        Some(Step::More)
    }

    /// Whether the identifier has 29 bits, and where RTR and the DLC are.
    fn layout(&self) -> Option<(bool, usize, usize)> {
        let extended = *self.bits.get(13)?;
        Some(if extended { (true, 32, 35) } else { (false, 12, 15) })
    }

    fn value(&self, from: usize, count: usize) -> Option<u32> {
        let bits = self.bits.get(from..from + count)?;
        Some(bits.iter().fold(0, |value, bit| value << 1 | u32::from(*bit)))
    }

    /// Number of bits up to the end of the CRC, once the DLC is known.
    fn wanted(&self) -> Option<usize> {
        let (_, rtr, dlc) = self.layout()?;
        let bytes = self.value(dlc, 4)?.min(8) as usize;
        let data = if self.bits[rtr] { 0 } else { 8 * bytes };
        Some(dlc + 4 + data + 15)
    }

    fn crc_is_right(&self) -> bool {
        let told = || {
            let (extended, rtr, dlc) = self.layout()?;
            let base = self.value(1, 11)?;
            let id = if extended {
                Id::extended_truncated(base << 18 | self.value(14, 18)?)
            } else {
                Id::standard_truncated(base)
            };
            let (remote, code) = (self.bits[rtr], self.value(dlc, 4)?);
            let mut data = [0; 8];
            let bytes = if remote { 0 } else { code.min(8) as usize };
            for (n, byte) in data.iter_mut().enumerate().take(bytes) {
                *byte = self.value(dlc + 4 + 8 * n, 8)? as u8;
            }
            // Reserved bits are taken as dominant: CAN FD frames have a different CRC anyway.
            let frame = Frame::from_bus(id, remote, code as u8, data);
            let crc = self.value(dlc + 4 + 8 * bytes, 15)?;
            Some(u32::from(FrameBits::of(&frame).crc) == crc)
        };
        told().unwrap_or(false)
    }
}
