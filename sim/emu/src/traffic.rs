//! What simulated nodes send: seeded traffic of a kind and a load, or a recorded log at its own times.

use std::str::FromStr;

use cantap_can::{Frame, Id};
use fastrand::Rng;

use crate::Clock;
use crate::bus::bits::bus_bits;
use crate::bus::{BitTime, Source};

/// Kinds of frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Standard frames without data of the shortest possible length: 48 bits with intermission.
    Std0,
    /// Standard frames with 8 random bytes.
    Std8,
    /// Extended frames without data.
    Ext0,
    /// Extended frames with 8 random bytes.
    Ext8,
    /// Standard remote frames of the shortest possible length: 47 bits with intermission.
    Rtr,
    /// Everything: both formats, data and remote, every length.
    Mix,
}

impl Kind {
    /// All kinds, with the names that the command uses.
    pub const ALL: [(&'static str, Kind); 6] = [
        ("std0", Kind::Std0),
        ("std8", Kind::Std8),
        ("ext0", Kind::Ext0),
        ("ext8", Kind::Ext8),
        ("rtr", Kind::Rtr),
        ("mix", Kind::Mix),
    ];
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let known = Self::ALL.iter().find(|(name, _)| *name == text);
        known.map(|(_, kind)| *kind).ok_or_else(|| {
            let names: Vec<&str> = Self::ALL.iter().map(|(name, _)| *name).collect();
            format!("no such kind of frames: {text}; there are {}", names.join(", "))
        })
    }
}

/// Random frames of one kind, all from one seed.
pub struct Frames {
    kind: Kind,
    random: Rng,
    /// The shortest frames, for the kinds that use them.
    shortest: Vec<Frame>,
}

impl Frames {
    /// Frames of `kind` from `seed`.
    pub fn new(kind: Kind, seed: u64) -> Self {
        let all_standard = || (0..=Id::MAX_STANDARD).map(Id::standard_truncated);
        let shortest = match kind {
            Kind::Std0 => all_standard()
                .filter_map(|id| Frame::data_frame(id, &[]))
                .filter(|f| bus_bits(f) == 48)
                .collect(),
            Kind::Rtr => all_standard()
                .flat_map(|id| (1..=8).filter_map(move |dlc| Frame::remote_frame(id, dlc)))
                .filter(|frame| bus_bits(frame) == 47)
                .collect(),
            _ => Vec::new(),
        };
        Self { kind, random: Rng::with_seed(seed), shortest }
    }

    /// The next frame.
    pub fn next_frame(&mut self) -> Frame {
        let random = &mut self.random;
        if !self.shortest.is_empty() {
            return self.shortest[random.usize(..self.shortest.len())];
        }
        let (extended, remote, dlc) = match self.kind {
            Kind::Std0 | Kind::Rtr | Kind::Std8 => (false, false, 8),
            Kind::Ext0 => (true, false, 0),
            Kind::Ext8 => (true, false, 8),
            Kind::Mix => (random.bool(), random.u8(..8) == 0, random.u8(..=8)),
        };
        let id = if extended {
            Id::extended_truncated(random.u32(..))
        } else {
            Id::standard_truncated(random.u32(..))
        };
        Frame::from_bus(id, remote, dlc, random.u64(..).to_le_bytes())
    }
}

/// Traffic at a constant average load.
pub struct Traffic {
    frames: Frames,
    load_percent: f64,
    from: u64,
    until: u64,
    /// Bits sent so far, with intermission, divided by the load: the earliest start of the next frame.
    due_bits: f64,
}

impl Traffic {
    /// Random frames of `kind` from `seed` that occupy `load_percent` of the bus (0 to 100; 100 is back to
    /// back), from core cycle `from` to `until`.
    pub fn new(kind: Kind, seed: u64, load_percent: f64, from: u64, until: u64) -> Self {
        Self { frames: Frames::new(kind, seed), load_percent, from, until, due_bits: 0.0 }
    }
}

impl Source for Traffic {
    fn next_frame(&mut self, bit: BitTime) -> Option<(u64, Frame)> {
        if self.load_percent <= 0.0 {
            return None;
        }
        let at = self.from + bit.cycles(self.due_bits as u64);
        if at >= self.until {
            return None;
        }
        let frame = self.frames.next_frame();
        self.due_bits += f64::from(bus_bits(&frame)) * 100.0 / self.load_percent.min(100.0);
        Some((at, frame))
    }
}

/// Bursts of frames, back to back, at a fixed period.
pub struct Bursts {
    frames: Frames,
    in_burst: u32,
    left: u32,
    period: u64,
    at: u64,
    until: u64,
}

impl Bursts {
    /// Bursts of `in_burst` frames of `kind` from `seed` each `period` core cycles, from core cycle `from` to `until`.
    pub fn new(kind: Kind, seed: u64, in_burst: u32, period: u64, from: u64, until: u64) -> Self {
        Self { frames: Frames::new(kind, seed), in_burst, left: in_burst, period, at: from, until }
    }
}

impl Source for Bursts {
    fn next_frame(&mut self, _bit: BitTime) -> Option<(u64, Frame)> {
        if self.left == 0 {
            self.left = self.in_burst;
            self.at += self.period;
        }
        if self.at >= self.until || self.in_burst == 0 {
            return None;
        }
        self.left -= 1;
        Some((self.at, self.frames.next_frame()))
    }
}

/// Frames at given core cycles, in order.
pub struct Script(std::vec::IntoIter<(u64, Frame)>);

impl Script {
    /// Sends each frame at its core cycle, or as soon as possible after it.
    pub fn new(frames: Vec<(u64, Frame)>) -> Self {
        Self(frames.into_iter())
    }
}

impl Source for Script {
    fn next_frame(&mut self, _bit: BitTime) -> Option<(u64, Frame)> {
        self.0.next()
    }
}

/// Why a log cannot be replayed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} is not a candump log line: {text}; expected (SECONDS) INTERFACE FRAME")]
pub struct LogError {
    /// Which line, from 1.
    pub line: usize,
    /// Its text.
    pub text: String,
}

/// Frames of a candump log (`candump -l`) as core cycles from `from` on, with each line's interface. Comments,
/// empty lines and error frames are left out.
pub fn parse_log(text: &str, from: u64, clock: Clock) -> Result<Vec<(u64, String, Frame)>, LogError> {
    let mut frames = Vec::new();
    let mut origin = None;
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let fault = || LogError { line: number + 1, text: line.to_owned() };
        let (micros, interface, frame) = parse_line(line).ok_or_else(fault)?;
        let Some(frame) = frame else { continue };
        let origin = *origin.get_or_insert(micros);
        let at = from + clock.us(micros.saturating_sub(origin));
        frames.push((at, interface.to_owned(), frame));
    }
    Ok(frames)
}

/// Microseconds, interface and frame of a line; no frame if it is an error frame.
fn parse_line(line: &str) -> Option<(u64, &str, Option<Frame>)> {
    let mut words = line.split_whitespace();
    let (seconds, fraction) = words.next()?.strip_prefix('(')?.strip_suffix(')')?.split_once('.')?;
    let fraction: String = fraction.chars().chain("000000".chars()).take(6).collect();
    let micros = seconds.parse::<u64>().ok()?.checked_mul(1_000_000)? + fraction.parse::<u64>().ok()?;
    let interface = words.next()?;
    let text = words.next()?;
    let is_error_frame = text
        .split_once('#')
        .and_then(|(id, _)| u32::from_str_radix(id, 16).ok())
        .is_some_and(|id| id > Id::MAX_EXTENDED);
    if is_error_frame {
        return Some((micros, interface, None));
    }
    Some((micros, interface, Some(text.parse().ok()?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CLOCK: Clock = Clock::new(144_000_000);

    #[test]
    fn the_worst_cases_have_their_least_lengths() {
        for (kind, bits) in [(Kind::Std0, 48), (Kind::Rtr, 47)] {
            let mut frames = Frames::new(kind, 1);
            assert!((0..1000).all(|_| bus_bits(&frames.next_frame()) == bits));
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_frames() {
        let take = |seed| {
            let mut frames = Frames::new(Kind::Mix, seed);
            (0..100).map(|_| frames.next_frame()).collect::<Vec<_>>()
        };
        assert_eq!(take(7), take(7));
        assert_ne!(take(7), take(8));
    }

    #[test]
    fn traffic_keeps_its_load() {
        let bit = BitTime::of_rate(1_000_000, CLOCK);
        let mut traffic = Traffic::new(Kind::Mix, 3, 25.0, 0, CLOCK.hz());
        let bits: u32 =
            std::iter::from_fn(|| traffic.next_frame(bit)).map(|(_, frame)| bus_bits(&frame)).sum();
        assert!((249_000..=251_000).contains(&bits), "{bits}");
    }

    #[test]
    fn a_log_is_replayed_from_its_first_line() {
        let text = "# a comment\n(1410714882.622188) can0 123#11\n\n(1410714882.622190) can1 20000004#00\n\
                    (1410714883.622188) can1 09F80102#36729A16021AB80D R\n";
        let frames = parse_log(text, 1000, CLOCK).unwrap();
        assert_eq!(frames.len(), 2);
        assert_eq!((frames[0].0, &frames[0].1[..]), (1000, "can0"));
        assert_eq!((frames[1].0, &frames[1].1[..]), (1000 + CLOCK.hz(), "can1"));
        assert_eq!(parse_log("(1.0) can0", 0, CLOCK).unwrap_err().line, 1);
    }
}
