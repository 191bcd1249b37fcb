//! The frames that simulated nodes send: an endless sequence, the same for the same seed.

use std::fmt;
use std::str::FromStr;

use cantap_wire::{Frame, Id};

use cantap_trace::bits::bits_on_bus;

/// Length of the shortest standard data frame: without data and with a single stuff bit.
const SHORTEST_STANDARD_BITS: u32 = 48;
/// A step through the identifiers that visits each before repeating any: prime, and larger than their number.
const STRIDE: u64 = 2053;
/// The same for 29-bit identifiers.
const EXTENDED_STRIDE: u64 = 0x0A5A_5A5B;

/// A kind of frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Frames {
    /// Standard without data, 48 bits each: the most frames that a bus can carry.
    Std0,
    /// Standard with eight bytes.
    Std8,
    /// Extended without data.
    Ext0,
    /// Extended with eight bytes.
    Ext8,
    /// Standard remote frames.
    Rtr,
    /// Everything, at random.
    #[default]
    Mix,
}

impl Frames {
    const NAMES: [(&'static str, Self); 6] = [
        ("std0", Self::Std0),
        ("std8", Self::Std8),
        ("ext0", Self::Ext0),
        ("ext8", Self::Ext8),
        ("rtr", Self::Rtr),
        ("mix", Self::Mix),
    ];
}

impl fmt::Display for Frames {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::NAMES.iter().find(|(_, frames)| frames == self);
        f.write_str(name.map_or("", |(name, _)| name))
    }
}

/// A text is not the name of a kind of frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("choose one of std0, std8, ext0, ext8, rtr, mix")]
pub struct UnknownFrames;

impl FromStr for Frames {
    type Err = UnknownFrames;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let known = Self::NAMES.iter().find(|(name, _)| *name == text);
        known.map(|(_, frames)| *frames).ok_or(UnknownFrames)
    }
}

/// The sequence. Neighbours differ, so that a missing or swapped frame is noticed.
#[derive(Clone, Debug)]
pub struct FrameSource {
    frames: Frames,
    random: fastrand::Rng,
    count: u64,
    /// Identifiers of the shortest frames.
    shortest: Vec<u32>,
}

impl FrameSource {
    /// The sequence for a kind and a seed.
    pub fn new(frames: Frames, seed: u64) -> Self {
        let shortest = match frames {
            Frames::Std0 => shortest_identifiers(),
            _ => Vec::new(),
        };
        Self { frames, random: fastrand::Rng::with_seed(seed), count: seed, shortest }
    }

    /// Eight bytes: half a counter, half noise.
    fn bytes(&mut self) -> [u8; 8] {
        (self.count << 32 | u64::from(self.random.u32(..))).to_be_bytes()
    }

    fn standard(&self) -> Id {
        Id::standard_truncated(self.count.wrapping_mul(STRIDE) as u32)
    }

    fn extended(&self) -> Id {
        Id::extended_truncated(self.count.wrapping_mul(EXTENDED_STRIDE) as u32)
    }
}

impl Iterator for FrameSource {
    type Item = Frame;

    fn next(&mut self) -> Option<Frame> {
        self.count = self.count.wrapping_add(1);
        let no_data = [0; 8];
        Some(match self.frames {
            Frames::Std0 => {
                let index = self.count.wrapping_mul(STRIDE) % self.shortest.len() as u64;
                Frame::from_bus(Id::standard_truncated(self.shortest[index as usize]), false, 0, no_data)
            }
            Frames::Std8 => Frame::from_bus(self.standard(), false, 8, self.bytes()),
            Frames::Ext0 => Frame::from_bus(self.extended(), false, 0, no_data),
            Frames::Ext8 => Frame::from_bus(self.extended(), false, 8, self.bytes()),
            Frames::Rtr => Frame::from_bus(self.standard(), true, self.random.u8(0..=8), no_data),
            Frames::Mix => {
                let id = if self.random.u8(..4) == 0 { self.extended() } else { self.standard() };
                let remote = self.random.u8(..32) == 0;
                let dlc = self.random.u8(0..=8);
                Frame::from_bus(id, remote, dlc, self.bytes())
            }
        })
    }
}

/// Identifiers whose data frame without data has a single stuff bit.
fn shortest_identifiers() -> Vec<u32> {
    let is_shortest = |raw: &u32| {
        bits_on_bus(&Frame::from_bus(Id::standard_truncated(*raw), false, 0, [0; 8]))
            == SHORTEST_STANDARD_BITS
    };
    (0..=Id::MAX_STANDARD).filter(is_shortest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_case_is_the_shortest_frame_every_time_and_neighbours_differ() {
        let frames: Vec<Frame> = FrameSource::new(Frames::Std0, 7).take(5000).collect();
        assert!(frames.iter().all(|frame| bits_on_bus(frame) == 48));
        assert!(frames.windows(2).all(|pair| pair[0] != pair[1]));
        let mut different = frames;
        different.sort_by_key(Frame::id);
        different.dedup();
        assert!(different.len() > 100);
    }

    #[test]
    fn a_mix_has_every_kind_and_the_same_seed_gives_the_same() {
        let frames: Vec<Frame> = FrameSource::new(Frames::Mix, 1).take(1000).collect();
        assert!(frames.iter().any(Frame::is_remote) && frames.iter().any(|frame| frame.id().is_extended()));
        assert!((0..=8).all(|dlc| frames.iter().any(|frame| frame.dlc() == dlc)));
        assert_eq!(frames, FrameSource::new(Frames::Mix, 1).take(1000).collect::<Vec<_>>());
        assert_ne!(frames, FrameSource::new(Frames::Mix, 2).take(1000).collect::<Vec<_>>());
    }

    #[test]
    fn names_round_trip() {
        for (name, frames) in Frames::NAMES {
            assert_eq!((name.parse(), frames.to_string()), (Ok(frames), name.to_owned()));
        }
        assert_eq!("all".parse::<Frames>(), Err(UnknownFrames));
    }
}
