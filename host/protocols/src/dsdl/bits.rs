//! Bits of a message, in the order of either language.

use super::model::Generation;

/// The rest of the data is not long enough.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooShort;

/// A place in a message.
#[derive(Clone, Copy, Debug)]
pub struct BitReader<'a> {
    data: &'a [u8],
    generation: Generation,
    /// In bits.
    at: usize,
    end: usize,
}

impl<'a> BitReader<'a> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_in_the_order_of_their_language() {
        // Twelve bits 0xABC behind four: DroneCAN sends BC, then the A.
        let mut bits = BitReader::of(&[0x5B, 0xCA], Generation::DroneCan);
        assert_eq!((bits.take(4), bits.take(12)), (Ok(5), Ok(0xABC)));
        assert_eq!(bits.take(1), Err(TooShort));
        let mut bits = BitReader::of(&[0xC5, 0xAB], Generation::Cyphal);
        assert_eq!((bits.take(4), bits.take(12), bits.take(9)), (Ok(5), Ok(0xABC), Ok(0)));
    }
}
