//! DroneCAN's signatures, and the CRC of both protocols' transfers.

/// A CRC-64-WE that goes on from a value.
#[derive(Clone, Copy, Debug)]
pub struct Signature(u64);

impl Signature {
    /// Of nothing.
    pub const fn new() -> Self {
        Self(u64::MAX)
    }

    /// Goes on where one has ended.
    pub const fn from(value: u64) -> Self {
        Self(value ^ u64::MAX)
    }

    /// With more bytes.
    #[must_use]
    pub fn with(mut self, bytes: &[u8]) -> Self {
        for byte in bytes {
            self.0 ^= u64::from(*byte) << 56;
            for _ in 0..8 {
                let carry = self.0 >> 63;
                self.0 = (self.0 << 1) ^ (carry * 0x42F0_E1EB_A9EA_3693);
            }
        }
        self
    }

    /// Its value.
    pub const fn value(self) -> u64 {
        self.0 ^ u64::MAX
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check values of the catalogue of CRCs.
    #[test]
    fn the_check_values_come_out() {
        assert_eq!(Signature::new().with(b"123456789").value(), 0x62EC_59E3_F1A4_F00A);
        let first = Signature::new().with(b"1234");
        assert_eq!(Signature::from(first.value()).with(b"56789").value(), 0x62EC_59E3_F1A4_F00A);
    }
}
