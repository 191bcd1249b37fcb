//! A receiver whose bit rate is not the sender's: it samples the real waveform at its own pace,
//! resynchronises on edges as ISO 11898-1 requires, and so finds that nothing fits. Now and then it
//! does receive a frame at a nearly equal bit rate, as real controllers do.

use cantap_can::BusErrorKind;

use super::bits::{END_OF_FRAME, crc15};
use crate::can::BitTiming;

/// How such a receiver sees a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reception {
    /// It received it.
    Frame,
    /// It saw an error, this many core cycles after the start of frame.
    Error {
        /// When it noticed.
        after: u64,
        /// What it takes the error for.
        kind: BusErrorKind,
    },
}

/// Listens with `timing` to bits of `bit_cycles(n)` core cycles from the start of frame to bit `n`'s
/// start. After the last bit the bus is recessive.
pub fn listen(levels: &[bool], bit_start: impl Fn(usize) -> u64, timing: &BitTiming) -> Reception {
    let mut bus = Waveform { levels, bit_start, at: 0 };
    let mut parser = Parser::default();
    let (bit, to_sample) = (timing.bit(), timing.quantum * (1 + timing.segment1));
    let jump = (timing.jump * timing.quantum) as i64;
    let mut start = 0u64;
    loop {
        let sample_at = start + to_sample;
        let level = bus.level(sample_at);
        if let Some(end) = parser.take(level) {
            return match end {
                Ok(()) => Reception::Frame,
                Err(kind) => Reception::Error { after: sample_at, kind },
            };
        }
        let mut next = start + bit;
        // Only an edge to dominant after a recessive sample moves the next bit, once, by at most the
        // jump width; the error is measured in whole quanta.
        if level && let Some(edge) = bus.next_falling_edge(sample_at, next + to_sample) {
            let quanta = (edge as i64 - next as i64) / timing.quantum as i64;
            let error = quanta * timing.quantum as i64;
            next = next.saturating_add_signed(error.clamp(-jump, jump));
        }
        start = next;
    }
}

/// The bus level over time, read forwards.
struct Waveform<'a, F> {
    levels: &'a [bool],
    bit_start: F,
    at: usize,
}

impl<F: Fn(usize) -> u64> Waveform<'_, F> {
    fn level(&mut self, time: u64) -> bool {
        while self.at < self.levels.len() && (self.bit_start)(self.at + 1) <= time {
            self.at += 1;
        }
        self.levels.get(self.at).copied().unwrap_or(true)
    }

    fn next_falling_edge(&self, after: u64, before: u64) -> Option<u64> {
        (self.at.max(1)..self.levels.len())
            .map(|bit| (bit, (self.bit_start)(bit)))
            .skip_while(|(_, time)| *time <= after)
            .take_while(|(_, time)| *time < before)
            .find(|(bit, _)| self.levels[bit - 1] && !self.levels[*bit])
            .map(|(_, time)| time)
    }
}

/// A receiver's view of the bits, to the end or to the first error.
#[derive(Default)]
pub(super) struct Parser {
    /// Destuffed bits up to the CRC's end.
    bits: Vec<bool>,
    run: u32,
    last: Option<bool>,
    /// Fixed-form bits seen: CRC delimiter, ACK slot, ACK delimiter, end of frame.
    tail: usize,
    crc_ok: bool,
}

impl Parser {
    /// Whether the next bit is the ACK slot of a frame whose CRC is right.
    pub(super) fn is_to_acknowledge(&self) -> bool {
        self.tail == 1 && self.crc_ok
    }

    /// Takes the next bit, `true` for recessive. Returns how the frame ends, if it does.
    pub(super) fn take(&mut self, level: bool) -> Option<Result<(), BusErrorKind>> {
        if self.wanted() == Some(self.bits.len()) && (self.run != 5 || self.tail > 0) {
            return self.take_tail(level);
        }
        let same = self.last == Some(level);
        if self.run == 5 {
            if same {
                return Some(Err(BusErrorKind::Stuff));
            }
            (self.run, self.last) = (1, Some(level));
            return None;
        }
        self.run = if same { self.run + 1 } else { 1 };
        self.last = Some(level);
        self.bits.push(level);
        if self.bits.len() == 1 && level {
            return Some(Err(BusErrorKind::Form));
        }
        None
    }

    fn take_tail(&mut self, level: bool) -> Option<Result<(), BusErrorKind>> {
        self.tail += 1;
        match self.tail {
            1 => self.crc_ok = crc15(&self.bits) == 0,
            2 => return None,
            3 if !self.crc_ok => return Some(Err(BusErrorKind::Crc)),
            _ => {}
        }
        if !level {
            return Some(Err(BusErrorKind::Form));
        }
        // All but the last bit of the end of frame.
        (self.tail == 3 + END_OF_FRAME - 1).then_some(Ok(()))
    }

    /// Bits from the start of frame to the end of the CRC, once the length is known.
    fn wanted(&self) -> Option<usize> {
        let extended = *self.bits.get(13)?;
        let (rtr, dlc) = if extended { (32, 35) } else { (12, 15) };
        let code = self.bits.get(dlc..dlc + 4)?;
        let length = code.iter().fold(0usize, |value, bit| value << 1 | usize::from(*bit));
        let data = if self.bits[rtr] { 0 } else { length.min(8) * 8 };
        Some(dlc + 4 + data + 15)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::bits::FrameBits;

    fn timing(bit: u64) -> BitTiming {
        // 12 quanta, sample point at 75 %.
        BitTiming { quantum: bit / 12, segment1: 8, segment2: 3, jump: 1 }
    }

    fn hear(text: &str, sender_bit: u64, receiver_bit: u64) -> Reception {
        let mut bits = FrameBits::new(&text.parse().unwrap()).levels().to_vec();
        let ack = bits.len() - END_OF_FRAME - 2;
        bits[ack] = false;
        listen(&bits, |n| n as u64 * sender_bit, &timing(receiver_bit))
    }

    #[test]
    fn the_right_rate_and_a_near_one_receive() {
        for text in ["123#", "7FF#FFFFFFFFFFFFFFFF", "1ABCDEF0#1122334455667788", "000#R8"] {
            assert_eq!(hear(text, 1440, 1440), Reception::Frame, "{text}");
            assert_eq!(hear(text, 1448, 1440), Reception::Frame, "{text} 0.5 % slower");
        }
    }

    #[test]
    fn other_rates_see_errors() {
        for text in ["123#", "7FF#FFFFFFFFFFFFFFFF", "1ABCDEF0#1122334455667788"] {
            for receiver in [360, 720, 1152, 1800, 2880, 5760] {
                let heard = hear(text, 1440, receiver);
                assert!(matches!(heard, Reception::Error { .. }), "{text} at {receiver}: {heard:?}");
            }
        }
    }
}
