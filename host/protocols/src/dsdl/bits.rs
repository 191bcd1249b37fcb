//! Bits of a message, in the order of either language.

use super::model::Generation;

/// The rest of the data is not long enough.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooShort;

/// A place in a message.
#[derive(Clone, Copy, Debug)]
pub struct Bits<'a> {
    data: &'a [u8],
    generation: Generation,
    /// In bits.
    at: usize,
    end: usize,
}

impl<'a> Bits<'a> {
    /// From the beginning.
    pub const fn of(data: &'a [u8], generation: Generation) -> Self {
        Self { data, generation, at: 0, end: data.len() * 8 }
    }

    /// How many there are from here on.
    pub const fn left(&self) -> usize {
        self.end.saturating_sub(self.at)
    }

    /// The next ones, at most 64, as a number. In Cyphal, what is missing at the end is zero.
    pub fn take(&mut self, count: u8) -> Result<u64, TooShort> {
        let count = usize::from(count);
        if self.generation == Generation::DroneCan && count > self.left() {
            self.at = self.end;
            return Err(TooShort);
        }
        let (mut number, mut done) = (0_u64, 0);
        while done < count {
            let (byte, within) = ((self.at + done) / 8, (self.at + done) % 8);
            let now = match self.generation {
                // Whole bytes of the number, the lowest first, whose highest bit is sent first.
                Generation::DroneCan => (8 - within).min(8 - done % 8).min(count - done),
                Generation::Cyphal => (8 - within).min(count - done),
            };
            let byte = if self.at + done < self.end { u64::from(self.data[byte]) } else { 0 };
            let mask = (1 << now) - 1;
            match self.generation {
                Generation::DroneCan => {
                    let piece = byte >> (8 - within - now) & mask;
                    // What has been read of the number's current byte stands above this.
                    let (whole, begun) = (done / 8 * 8, done % 8);
                    let before = if begun == 0 { 0 } else { number >> whole };
                    let lower = if whole == 0 { 0 } else { number & ((1 << whole) - 1) };
                    number = lower | (before << now | piece) << whole;
                }
                Generation::Cyphal => number |= (byte >> within & mask) << done,
            }
            done += now;
        }
        self.at += count;
        Ok(number)
    }

    /// Leaves out this many.
    pub fn skip(&mut self, count: usize) {
        self.at += count;
    }

    /// Goes to the next whole byte.
    pub fn align(&mut self) {
        self.at = self.at.div_ceil(8) * 8;
    }

    /// The next bytes as a message of their own, and goes behind them.
    pub fn part(&mut self, bytes: usize) -> Result<Self, TooShort> {
        if bytes.saturating_mul(8) > self.left() {
            self.at = self.end;
            return Err(TooShort);
        }
        let part = Self { end: self.at + bytes * 8, ..*self };
        self.at = part.end;
        Ok(part)
    }

    /// The whole bytes that are left.
    pub fn rest(&self) -> &'a [u8] {
        &self.data[(self.at.div_ceil(8)).min(self.end / 8)..self.end / 8]
    }
}

/// A float of 16 bits (IEEE 754 binary16), which one of 32 can hold.
pub fn half(bits: u16) -> f32 {
    let (sign, exponent, fraction) =
        (u32::from(bits >> 15) << 31, bits >> 10 & 0x1F, u32::from(bits & 0x3FF));
    match exponent {
        0 => {
            // Exact: ten bits and a power of two.
            let value = fraction as f32 / 16_777_216.0;
            if sign == 0 { value } else { -value }
        }
        0x1F => f32::from_bits(sign | 0x7F80_0000 | fraction << 13),
        _ => f32::from_bits(sign | (u32::from(exponent) + 112) << 23 | fraction << 13),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values of the standard's table of examples.
    #[test]
    fn halves_are_read_exactly() {
        for (bits, value) in [
            (0x0000, 0.0),
            (0x0001, 5.960_464_5e-8),
            (0x03FF, 6.097_555e-5),
            (0x0400, 6.103_515_6e-5),
            (0x3555, 0.333_251_95),
            (0x3BFF, 0.999_511_7),
            (0x3C00, 1.0),
            (0x7BFF, 65_504.0),
            (0x7C00, f32::INFINITY),
            (0xC000, -2.0),
            (0x8001, -5.960_464_5e-8),
        ] {
            assert_eq!(half(bits).to_bits(), f32::to_bits(value), "{bits:04X}");
        }
        assert!(half(0x7E00).is_nan());
    }

    #[test]
    fn numbers_are_read_in_the_order_of_their_language() {
        // Twelve bits 0xABC behind four: DroneCAN sends BC, then the A.
        let mut bits = Bits::of(&[0x5B, 0xCA], Generation::DroneCan);
        assert_eq!((bits.take(4), bits.take(12)), (Ok(5), Ok(0xABC)));
        assert_eq!(bits.take(1), Err(TooShort));
        let mut bits = Bits::of(&[0xC5, 0xAB], Generation::Cyphal);
        assert_eq!((bits.take(4), bits.take(12), bits.take(9)), (Ok(5), Ok(0xABC), Ok(0)));
    }
}
