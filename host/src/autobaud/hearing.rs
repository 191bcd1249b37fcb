//! What a received frame says about the bus's bit rate: at which rates a receiver with this bit timing takes just this
//! frame, and at which it would have seen an error.
//!
//! A controller resynchronises, so it hears rates beside its own: 250 kbit/s as well as 253.97, if its sample point is not
//! late. How far beside depends on the frame's edges. Played through a model of the receiver (ISO 11898-1:2015, 11.3.2:
//! hard synchronisation at the start of frame, then one resynchronisation per edge to dominant, by at most the jump
//! width), each frame bounds the bus's rate from both sides, and several at different rates and sample points leave little.

use cantap_wire::{BitTiming, Frame};

use cantap_trace::bits::FrameBits;

/// Relative step in which rates are tried.
const STEP: f64 = 0.000_5;
/// Steps to either side: 6 %, more than a receiver takes of any frame with edges.
const STEPS: u32 = 120;
/// Quanta that a start of frame may lie before the receiver sees it.
const PHASES: [f64; 2] = [0.0, 0.5];
/// From the end: the acknowledgement, whose level a receiver does not look at.
const ACK_FROM_END: usize = 2;
/// Equal bits in a row, after which the sender puts in a different one.
const STUFF_AFTER: usize = 5;

/// Bounds of a bus's bit rate, in bit/s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Not slower.
    pub least_bps: f64,
    /// Not faster.
    pub most_bps: f64,
}

impl Bounds {
    /// Nothing is known.
    pub const NONE: Self = Self { least_bps: 0.0, most_bps: f64::INFINITY };

    /// Those of the bus that a frame was received from with `timing` on a controller of `clock_hz`.
    pub fn of(frame: &Frame, timing: BitTiming, clock_hz: u32) -> Self {
        let levels = levels(frame);
        let own_bps = f64::from(clock_hz) / f64::from(timing.clocks_per_bit());
        let farthest = |direction: f64| {
            // The farthest, not the first at which it fails: an error of less than a quantum is not corrected, so a
            // rate that is a little farther off may fare better.
            let rates = (1..=STEPS).rev().map(|step| 1.0 + direction * STEP * f64::from(step));
            let mut heard =
                rates.filter(|rate| PHASES.iter().any(|phase| hears(&levels, timing, *rate, *phase)));
            heard.next().unwrap_or(1.0)
        };
        // It may lie anywhere up to the next step.
        Self { least_bps: own_bps * (farthest(-1.0) - STEP), most_bps: own_bps * (farthest(1.0) + STEP) }
    }

    /// Between these, every one of the frames would be received with `timing`.
    pub fn of_sure_reception(frames: &[Frame], timing: BitTiming, clock_hz: u32) -> Self {
        let own_bps = f64::from(clock_hz) / f64::from(timing.clocks_per_bit());
        let mut sure = Self::NONE;
        for levels in frames.iter().map(levels) {
            let farthest = |direction: f64| {
                let rates = (0..=STEPS).map(|step| 1.0 + direction * STEP * f64::from(step));
                let heard =
                    rates.take_while(|rate| PHASES.iter().all(|phase| hears(&levels, timing, *rate, *phase)));
                heard.last().unwrap_or(1.0)
            };
            sure.narrow(Self { least_bps: own_bps * farthest(-1.0), most_bps: own_bps * farthest(1.0) });
        }
        sure
    }

    /// The bus is not between `other`'s. Where that is in the middle, nothing is learnt.
    pub fn exclude(&mut self, other: Self) {
        if (other.least_bps..other.most_bps).contains(&self.least_bps) {
            self.least_bps = other.most_bps.min(self.most_bps);
        } else if (other.least_bps..other.most_bps).contains(&self.most_bps) {
            self.most_bps = other.least_bps.max(self.least_bps);
        }
    }

    /// Both hold. Measured bounds may contradict each other a little; then the middle is still the best guess.
    pub fn narrow(&mut self, other: Self) {
        self.least_bps = self.least_bps.max(other.least_bps);
        self.most_bps = self.most_bps.min(other.most_bps);
    }

    /// Half way between them, if there are any.
    pub fn middle_bps(&self) -> Option<f64> {
        (self.least_bps > 0.0 && self.most_bps.is_finite()).then(|| (self.least_bps * self.most_bps).sqrt())
    }
}

/// Whether a receiver takes these bits if the bus is `rate` times as fast as itself and it saw the start of frame `phase`
/// quanta late.
fn hears(levels: &[bool], timing: BitTiming, rate: f64, phase: f64) -> bool {
    let quanta = f64::from(timing.quanta());
    let to_sample = f64::from(1 + timing.segment1);
    let jump = f64::from(timing.jump_width);
    let bus_bit = quanta / rate;
    let level_at = |time: f64| levels.get((time / bus_bit) as usize).copied().unwrap_or(true);
    let mut start = phase;
    for (n, level) in levels.iter().enumerate() {
        let sample_at = start + to_sample;
        if level_at(sample_at) != *level && n + ACK_FROM_END != levels.len() {
            return false;
        }
        let mut next = start + quanta;
        // Only after a recessive sample.
        if *level {
            let first = (sample_at / bus_bit) as usize + 1;
            let last = ((next + to_sample) / bus_bit) as usize;
            let edge = (first..=last).find(|bit| {
                level_at((*bit as f64 - 0.5) * bus_bit) && !level_at((*bit as f64 + 0.5) * bus_bit)
            });
            if let Some(bit) = edge {
                next += (bit as f64 * bus_bit - next).trunc().clamp(-jump, jump);
            }
        }
        start = next;
    }
    true
}

/// The bits from the start of frame to the end of the acknowledgement, true for recessive, stuff bits among them.
fn levels(frame: &Frame) -> Vec<bool> {
    let id = frame.id();
    let mut bits = vec![false];
    let mut put = |value: u32, count: u32| bits.extend((0..count).rev().map(|bit| value >> bit & 1 != 0));
    let remote = u32::from(frame.is_remote());
    if id.is_extended() {
        put(id.raw() >> 18, 11);
        // SRR and IDE.
        put(0b11, 2);
        put(id.raw() & 0x3_FFFF, 18);
        // RTR, r1, r0.
        put(remote << 2, 3);
    } else {
        put(id.raw(), 11);
        // RTR, IDE, r0.
        put(remote << 2, 3);
    }
    put(frame.dlc().into(), 4);
    frame.data().iter().for_each(|byte| put((*byte).into(), 8));
    put(FrameBits::of(frame).crc.into(), 15);
    let mut sent: Vec<bool> = Vec::with_capacity(bits.len() * 5 / 4 + 3);
    let mut run = 0;
    for bit in bits {
        run = if sent.last() == Some(&bit) { run + 1 } else { 1 };
        sent.push(bit);
        if run == STUFF_AFTER {
            sent.push(!bit);
            run = 1;
        }
    }
    // CRC delimiter, acknowledgement, its delimiter: after the last edge that matters.
    sent.extend([true, false, true]);
    sent
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::bits::{INTERMISSION_BITS, bits_on_bus};

    const CLOCK_HZ: u32 = 36_000_000;

    fn frames() -> impl Iterator<Item = Frame> {
        let texts = ["123#", "7FF#FFFFFFFFFFFFFFFF", "1ABCDEF0#1122334455667788", "000#R8", "2AA#5555"];
        texts.into_iter().map(|text| text.parse().unwrap())
    }

    #[test]
    fn the_bits_are_as_many_as_on_the_bus() {
        for frame in frames() {
            let end_of_frame = 7;
            let whole = levels(&frame).len() as u32 + end_of_frame + INTERMISSION_BITS;
            assert_eq!(whole, bits_on_bus(&frame), "{frame}");
        }
    }

    #[test]
    fn a_late_sample_point_tells_a_bus_that_is_faster_by_one_and_a_half_per_cent() {
        let timing = BitTiming { prescaler: 8, segment1: 16, segment2: 1, jump_width: 1 };
        for frame in frames() {
            let bounds = Bounds::of(&frame, timing, CLOCK_HZ);
            assert!(bounds.least_bps < 250_000.0 && bounds.most_bps > 250_000.0, "{frame}: {bounds:?}");
            assert!(bounds.most_bps < 253_968.0 && bounds.least_bps > 235_000.0, "{frame}: {bounds:?}");
        }
    }

    #[test]
    fn a_rate_at_which_nothing_is_heard_is_excluded_with_those_around() {
        let timing = BitTiming { prescaler: 4, segment1: 16, segment2: 2, jump_width: 1 };
        let sure = Bounds::of_sure_reception(&frames().collect::<Vec<_>>(), timing, CLOCK_HZ);
        assert!(
            sure.least_bps < 473_684.0 && sure.most_bps > 474_500.0 && sure.most_bps < 480_000.0,
            "{sure:?}"
        );
        let mut bounds = Bounds { least_bps: 470_000.0, most_bps: 480_500.0 };
        bounds.exclude(sure);
        assert_eq!(bounds, Bounds { least_bps: sure.most_bps, most_bps: 480_500.0 });
        bounds.exclude(Bounds { least_bps: 478_000.0, most_bps: 479_000.0 });
        assert_eq!(bounds.least_bps.to_bits(), sure.most_bps.to_bits());
    }

    #[test]
    fn bounds_narrow_and_their_middle_is_between() {
        let mut bounds = Bounds::NONE;
        assert_eq!(bounds.middle_bps(), None);
        bounds.narrow(Bounds { least_bps: 90.0, most_bps: 160.0 });
        bounds.narrow(Bounds { least_bps: 100.0, most_bps: 400.0 });
        assert!((bounds.middle_bps().unwrap() - 126.5).abs() < 0.1);
    }
}
