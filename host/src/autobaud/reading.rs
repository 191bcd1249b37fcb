//! Frames read from the edges of a receive pin, at a bit time that is only a guess: if it is wrong, stuffing or the CRC says so.

use cantap_wire::{Frame, Id};

use cantap_trace::bits::FrameBits;

/// A change of the pin's level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PinEdge {
    /// In ticks.
    pub at: f64,
    /// The level behind it.
    pub dominant: bool,
    /// Edges before it may be missing.
    pub unsure: bool,
}

/// An edge of a frame, and the bit that it begins, counted from the start of frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PlacedEdge {
    pub bit: u32,
    pub edge: PinEdge,
}

/// A frame whose CRC is right.
#[derive(Clone, Debug)]
pub(super) struct ReadFrame {
    /// Its sender's edges: up to the CRC's end, without those that may have been earlier.
    pub edges: Vec<PlacedEdge>,
    /// Somebody acknowledged it.
    pub acknowledged: bool,
}

/// Before a start of frame the bus was recessive for eleven bits at least: the end of a frame, or of an error frame, and the intermission.
const IDLE_BITS: f64 = 9.5;
/// Pulses shorter than this part of a bit are none.
const GLITCH_BITS: f64 = 0.3;
/// Where a dominant pulse is cut into bits: edges to recessive come late rather than early.
const LATE_BITS: f64 = 0.15;
/// Equal bits that stuffing allows.
const STUFF_AFTER: u32 = 5;
/// Recessive bits that a bus without further edges shows for certain.
const SILENT_BITS: u32 = 11;

/// Every frame that can be read at this bit time, also across a moment in which edges may be missing: if one is, the levels do not alternate,
/// or the CRC is wrong.
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

/// The frame that begins with an edge, and the first edge behind it.
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
            // From one edge to dominant to the next, which asymmetry does not touch.
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
                // The delimiter behind the CRC: what follows is somebody else's.
                Step::End => {
                    let end = bit + n as u32;
                    placed.retain(|placed| placed.bit <= end && !placed.edge.unsure);
                    // The delimiter alone, and then dominant: the acknowledgement.
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

/// The next edge, without pulses that are too short to be a bit.
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
    /// This was the recessive bit behind a CRC that is right.
    End,
}

/// A frame's bits as they come.
#[derive(Default)]
struct Parser {
    /// Without stuff bits; true for recessive.
    bits: Vec<bool>,
    last: Option<bool>,
    run: u32,
}

impl Parser {
    /// Takes a bit; `None` if there is no such frame.
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

    /// Whether there are 29 bits of identifier, and where RTR and the DLC are.
    fn layout(&self) -> Option<(bool, usize, usize)> {
        let extended = *self.bits.get(13)?;
        Some(if extended { (true, 32, 35) } else { (false, 12, 15) })
    }

    fn value(&self, from: usize, count: usize) -> Option<u32> {
        let bits = self.bits.get(from..from + count)?;
        Some(bits.iter().fold(0, |value, bit| value << 1 | u32::from(*bit)))
    }

    /// Bits up to the CRC's end, once the DLC is there.
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
            // Reserved bits count as dominant here: CAN FD's frames have another CRC anyway.
            let frame = Frame::from_bus(id, remote, code as u8, data);
            let crc = self.value(dlc + 4 + 8 * bytes, 15)?;
            Some(u32::from(FrameBits::of(&frame).crc) == crc)
        };
        told().unwrap_or(false)
    }
}
