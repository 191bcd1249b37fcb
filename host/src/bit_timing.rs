//! Bit timing as users give it and judge it: parsing it, choosing one, and what each choice is worth on a
//! real bus.
//!
//! The integer arithmetic of dividers is in [`BitTiming`]; this module has what needs fractions.
//!
//! bxCAN programs propagation and phase segment 1 as one ("segment 1"), so how much of it absorbs delay is up to the
//! bus. All figures here take phase segment 1 as long as the jump width, the least that resynchronisation
//! needs, and leave the rest to propagation:
//!
//! - *Oscillator tolerance* ("The Configuration of the CAN Bit Timing",
//!   Hartwich and Bassemir, 1999): the smaller of `min(PS1, PS2) / (2 · (13 · tbit − PS2))` and `SJW / (20 · tbit)`.
//! - *Cable length*: a bit goes to the far end and the answer comes back within the propagation segment, so
//!   `length = (PROP / 2 − 150 ns) / 5 ns/m`: 150 ns for a controller, a transceiver and back; 5 ns/m for the
//!   line. This gives 28 m at 1 Mbit/s and 520 m at 125 kbit/s; 25 m and 500 m are the usual rule.

use std::fmt;

use cantap_wire::BitTiming;
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS, NoTiming};

use crate::session::no_timing;

/// Delay of a node, in and out, that the cable lengths assume, in ns.
pub const NODE_DELAY_NS: f64 = 150.0;
/// Delay of the line that the cable lengths assume, in ns per metre.
pub const LINE_DELAY_NS_PER_M: f64 = 5.0;

/// Why a request cannot be turned into a timing.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TimingError {
    /// The bit rate cannot be reached.
    #[error("{}", no_timing(*bitrate_bps, reason))]
    BitRate {
        /// The requested rate, in bit/s.
        bitrate_bps: u32,
        /// Why not, and which rates are near.
        reason: NoTiming,
    },
    /// Only timings with a shorter phase segment 2 reach this bit rate.
    #[error("no timing of {bitrate_bps} bit/s allows a jump width of {sjw} quanta")]
    JumpWidth {
        /// The requested rate, in bit/s.
        bitrate_bps: u32,
        /// The requested jump width, in quanta.
        sjw: u8,
    },
    /// Segments outside the controller's registers.
    #[error(
        "{} is out of range; the controller takes a prescaler of 1 to 1024, a segment 1 (PROP+PS1) of 1 to 16 quanta, \
         a segment 2 (PS2) of 1 to 8, and a jump width of 1 to 4 that is not above segment 2",
        out_of_range(*.0)
    )]
    Segments(BitTiming),
    /// Segments that make an impossible bit rate.
    #[error("these segments make {0} bit/s; the device takes {MIN_BITRATE_BPS} to {MAX_BITRATE_BPS}")]
    Rate(u32),
    /// Bits of the register that are not timing.
    #[error(
        "register value 0x{0:08X} sets bits that are not bit timing; give bits 25..24 SJW, 22..20 TS2, 19..16 TS1, \
         9..0 BRP"
    )]
    Register(u32),
    /// Not four numbers.
    #[error("write segments as BRP,SEG1,SEG2,SJW, such as 9,13,2,2")]
    NotSegments,
    /// bxCAN samples once.
    #[error("this controller (bxCAN) samples each bit once; triple sampling does not exist in it")]
    TripleSampling,
}

/// Says which part of a timing makes it invalid.
fn out_of_range(timing: BitTiming) -> &'static str {
    if !(1..=1024).contains(&timing.prescaler) {
        "the prescaler"
    } else if !(1..=16).contains(&timing.segment1) {
        "segment 1 (PROP+PS1)"
    } else if !(1..=8).contains(&timing.segment2) {
        "segment 2 (PS2)"
    } else {
        "the jump width"
    }
}

/// How a user gives a bit timing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TimingRequest {
    /// By bit rate, with optional wishes.
    Rate {
        /// In bit/s.
        bitrate_bps: u32,
        /// In per cent of the bit; `None` for CiA's recommendation.
        sample_point_percent: Option<f64>,
        /// Jump width in quanta; `None` for an eighth of the bit, at least one.
        sjw: Option<u8>,
    },
    /// Used as it is.
    Exact(BitTiming),
}

impl TimingRequest {
    /// Computes the timing for a CAN clock.
    pub fn resolve(&self, clock_hz: u32) -> Result<BitTiming, TimingError> {
        match *self {
            Self::Rate { bitrate_bps, sample_point_percent, sjw } => {
                let sample_point = sample_point_percent.map(|percent| (percent * 10.0).round() as u32);
                let chosen = BitTiming::choose(clock_hz, bitrate_bps, sample_point)
                    .map_err(|reason| TimingError::BitRate { bitrate_bps, reason })?;
                let Some(sjw) = sjw else { return Ok(chosen) };
                let wanted =
                    sample_point.unwrap_or_else(|| BitTiming::recommended_sample_point_permille(bitrate_bps));
                BitTiming::all(clock_hz, bitrate_bps)
                    .filter(|timing| timing.jump_width >= sjw)
                    .min_by_key(|timing| timing.sample_point_permille().abs_diff(wanted))
                    .map(|timing| BitTiming { jump_width: sjw, ..timing })
                    .ok_or(TimingError::JumpWidth { bitrate_bps, sjw })
            }
            Self::Exact(timing) => {
                if !timing.is_valid() {
                    return Err(TimingError::Segments(timing));
                }
                let rate = timing.bitrate_bps(clock_hz);
                if (MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(&rate) {
                    Ok(timing)
                } else {
                    Err(TimingError::Rate(rate))
                }
            }
        }
    }
}

/// Reads `BRP,SEG1,SEG2,SJW`, in quanta as people count them, not as registers hold them.
pub fn parse_segments(text: &str) -> Result<BitTiming, TimingError> {
    let numbers: Vec<u16> = text
        .split(',')
        .map(|part| part.trim().parse().map_err(|_| TimingError::NotSegments))
        .collect::<Result<_, _>>()?;
    let [prescaler, segment1, segment2, jump_width] = numbers[..] else {
        return Err(TimingError::NotSegments);
    };
    // What does not fit in a byte is out of range anyway.
    let narrow = |value: u16| u8::try_from(value).unwrap_or(u8::MAX);
    let timing = BitTiming {
        prescaler,
        segment1: narrow(segment1),
        segment2: narrow(segment2),
        jump_width: narrow(jump_width),
    };
    if timing.is_valid() { Ok(timing) } else { Err(TimingError::Segments(timing)) }
}

/// Reads the value of bxCAN's bit timing register (RM0090, "CAN bit timing register").
pub fn from_register(btr: u32) -> Result<BitTiming, TimingError> {
    const TIMING_BITS: u32 = 0x037F_03FF;
    if btr & !TIMING_BITS != 0 {
        return Err(TimingError::Register(btr));
    }
    let timing = BitTiming {
        prescaler: (btr & 0x3FF) as u16 + 1,
        segment1: (btr >> 16 & 0xF) as u8 + 1,
        segment2: (btr >> 20 & 7) as u8 + 1,
        jump_width: (btr >> 24 & 3) as u8 + 1,
    };
    if timing.is_valid() { Ok(timing) } else { Err(TimingError::Segments(timing)) }
}

/// The value of bxCAN's bit timing register for a valid timing.
pub const fn to_register(timing: &BitTiming) -> u32 {
    (timing.jump_width as u32 - 1) << 24
        | (timing.segment2 as u32 - 1) << 20
        | (timing.segment1 as u32 - 1) << 16
        | (timing.prescaler as u32 - 1)
}

/// What a timing is worth on a bus, under the assumptions of this module.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Assessment {
    /// The timing.
    pub timing: BitTiming,
    /// Exact bit rate, in bit/s.
    pub bitrate_bps: f64,
    /// One time quantum, in ns.
    pub quantum_ns: f64,
    /// Exact sample point, in per cent of the bit.
    pub sample_point_percent: f64,
    /// Quanta left to propagation.
    pub propagation: u8,
    /// Quanta of phase segment 1.
    pub phase1: u8,
    /// Widest jump that the segments allow, in quanta.
    pub max_jump_width: u8,
    /// How far each node's clock may be off, in per cent.
    pub oscillator_tolerance_percent: f64,
    /// Longest cable between two nodes, in m; 0 if the nodes' delays alone are too long.
    pub cable_m: f64,
}

impl Assessment {
    /// Assesses a valid timing.
    pub fn of(timing: &BitTiming, clock_hz: u32) -> Self {
        let quanta = f64::from(timing.quanta());
        let quantum_ns = f64::from(timing.prescaler) * 1e9 / f64::from(clock_hz);
        let phase1 = timing.jump_width.min(timing.segment1);
        let propagation = timing.segment1 - phase1;
        let segment2 = f64::from(timing.segment2);
        let after_error = f64::from(phase1.min(timing.segment2)) / (2.0 * (13.0 * quanta - segment2));
        let between_edges = f64::from(timing.jump_width) / (20.0 * quanta);
        let one_way_ns = f64::from(propagation) * quantum_ns / 2.0;
        Self {
            timing: *timing,
            bitrate_bps: f64::from(clock_hz) / f64::from(timing.clocks_per_bit()),
            quantum_ns,
            sample_point_percent: (1.0 + f64::from(timing.segment1)) / quanta * 100.0,
            propagation,
            phase1,
            max_jump_width: timing.segment2.min(4),
            oscillator_tolerance_percent: after_error.min(between_edges) * 100.0,
            cable_m: ((one_way_ns - NODE_DELAY_NS) / LINE_DELAY_NS_PER_M).max(0.0),
        }
    }

    /// How far the bit rate is from another, in parts per million.
    pub fn error_ppm(&self, bitrate_bps: u32) -> f64 {
        (self.bitrate_bps / f64::from(bitrate_bps) - 1.0) * 1e6
    }

    /// A drawing of the bit: a cell per quantum and a mark at the sample point.
    pub const fn drawing(&self) -> Drawing<'_> {
        Drawing(self)
    }
}

/// Every timing of a bit rate, assessed. The jump width is `sjw` where the segments allow it, otherwise the widest
/// that they do. Without `sjw`, it is an eighth of the bit, as in the timing that is chosen by default.
pub fn all(clock_hz: u32, bitrate_bps: u32, sjw: Option<u8>) -> Vec<Assessment> {
    BitTiming::all(clock_hz, bitrate_bps)
        .map(|timing| {
            let wanted = sjw.unwrap_or((timing.quanta() / 8).clamp(1, 4) as u8);
            let jump_width = wanted.min(timing.jump_width);
            Assessment::of(&BitTiming { jump_width, ..timing }, clock_hz)
        })
        .collect()
}

/// See [`Assessment::drawing`].
pub struct Drawing<'a>(&'a Assessment);

impl fmt::Display for Drawing<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Assessment { timing, propagation, phase1, sample_point_percent, .. } = self.0;
        let cells = [("SY", 1), ("PR", *propagation), ("P1", *phase1), ("P2", timing.segment2)].map(
            |(name, quanta)| {
                let mut part = String::new();
                for _ in 0..quanta {
                    part.push('|');
                    part.push_str(name);
                }
                part
            },
        );
        writeln!(f, "{}|", cells.concat())?;
        let before = 3 * (1 + usize::from(timing.segment1));
        write!(f, "{:before$}^ sample point {sample_point_percent:.1} %", "")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CLOCK: u32 = 36_000_000;

    fn rate(bitrate_bps: u32, sample_point_percent: Option<f64>, sjw: Option<u8>) -> TimingRequest {
        TimingRequest::Rate { bitrate_bps, sample_point_percent, sjw }
    }

    /// The examples of Hartwich and Bassemir: 10 MHz, 1 Mbit/s, tTSeg1 = 7, tTSeg2 = 2, SJW = 1 has 0.39 %; 2 MHz,
    /// 100 kbit/s, tTSeg1 = 5, tTSeg2 = 4, SJW = 4 has 1.58 %.
    #[test]
    fn tolerance_is_that_of_boschs_examples() {
        let fast = BitTiming { prescaler: 1, segment1: 7, segment2: 2, jump_width: 1 };
        let found = Assessment::of(&fast, 10_000_000);
        assert_eq!((found.propagation, found.phase1), (6, 1));
        assert!((found.oscillator_tolerance_percent - 0.390_625).abs() < 1e-9, "{found:?}");
        let slow = BitTiming { prescaler: 2, segment1: 5, segment2: 4, jump_width: 4 };
        let found = Assessment::of(&slow, 2_000_000);
        assert_eq!((found.propagation, found.phase1), (1, 4));
        assert!((found.oscillator_tolerance_percent - 1.587).abs() < 1e-3, "{found:?}");
    }

    #[test]
    fn cables_are_about_as_long_as_the_usual_rule_has_it() {
        for (bitrate_bps, rule_m) in
            [(1_000_000, 25.0), (800_000, 50.0), (500_000, 100.0), (250_000, 250.0), (125_000, 500.0)]
        {
            let timing = rate(bitrate_bps, None, None).resolve(CLOCK).unwrap();
            let cable_m = Assessment::of(&timing, CLOCK).cable_m;
            assert!((cable_m / rule_m - 1.0).abs() < 0.25, "{bitrate_bps}: {cable_m} m");
        }
    }

    #[test]
    fn requested_sample_points_are_kept_or_refused() {
        let timing = rate(500_000, Some(80.0), Some(2)).resolve(CLOCK).unwrap();
        assert!(timing.jump_width == 2 && timing.sample_point_permille().abs_diff(800) < 40, "{timing:?}");
        // The recommended timing has no room for it; another one has.
        let timing = rate(500_000, None, Some(2)).resolve(CLOCK).unwrap();
        assert!(timing.segment2 >= 2 && timing.bitrate_bps(CLOCK) == 500_000, "{timing:?}");
        let error = rate(999_999, None, None).resolve(CLOCK).unwrap_err().to_string();
        assert!(error.contains("947368 and 1000000"), "{error}");
    }

    #[test]
    fn registers_round_trip_and_foreign_bits_are_refused() {
        for timing in BitTiming::all(CLOCK, 125_000) {
            assert_eq!(from_register(to_register(&timing)), Ok(timing));
        }
        assert_eq!(from_register(0x8000_0000), Err(TimingError::Register(0x8000_0000)));
        assert!(matches!(from_register(0x0300_0000), Err(TimingError::Segments(_))), "SJW 4 over TS2 1");
    }

    #[test]
    fn segments_are_four_numbers_in_range() {
        let timing = BitTiming { prescaler: 9, segment1: 13, segment2: 2, jump_width: 2 };
        assert_eq!(parse_segments("9,13,2,2"), Ok(timing));
        for text in ["", "9,13,2", "9,13,2,2,1", "a,1,1,1", "-1,1,1,1"] {
            assert_eq!(parse_segments(text), Err(TimingError::NotSegments), "{text}");
        }
        for text in ["0,13,2,2", "1025,13,2,2", "9,17,2,2", "9,13,9,2", "9,13,2,3", "9,269,2,2"] {
            assert!(matches!(parse_segments(text), Err(TimingError::Segments(_))), "{text}");
        }
        for (text, part) in [
            ("0,13,2,2", "the prescaler"),
            ("9,300,2,2", "segment 1 (PROP+PS1)"),
            ("9,13,9,2", "segment 2 (PS2)"),
            ("9,6,1,2", "the jump width"),
        ] {
            let message = parse_segments(text).unwrap_err().to_string();
            assert!(
                message.starts_with(&format!("{part} is out of range; the controller takes")),
                "{message}"
            );
            assert!(!message.contains('{'), "{message}");
        }
        let too_fast = TimingRequest::Exact(BitTiming { prescaler: 1, ..timing });
        assert_eq!(too_fast.resolve(CLOCK), Err(TimingError::Rate(2_250_000)));
    }

    #[test]
    fn the_drawing_has_a_cell_per_quantum_and_the_mark_behind_segment_1() {
        let timing = BitTiming { prescaler: 9, segment1: 5, segment2: 2, jump_width: 1 };
        let drawing = Assessment::of(&timing, CLOCK).drawing().to_string();
        assert_eq!(drawing, "|SY|PR|PR|PR|PR|P1|P2|P2|\n                  ^ sample point 75.0 %");
    }
}
