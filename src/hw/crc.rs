//! The chip's CRC unit, which does four bytes in as many clocks: CRC-32 with the wire's polynomial, but with the highest bit first. So
//! words go in, and the result comes out, with bits reversed.

use stm32f4xx_hal::pac::CRC;
use stm32f4xx_hal::rcc::{Enable, Rcc};

/// The wire's polynomial, 04C11DB7, with the lowest bit first.
const POLYNOMIAL: u32 = 0xEDB8_8320;

/// The unit. It is used at only one priority.
pub struct CrcUnit(CRC);

impl CrcUnit {
    /// Starts its clock.
    pub fn start(unit: CRC, rcc: &mut Rcc) -> Self {
        CRC::enable(rcc);
        Self(unit)
    }

    /// CRC-32/ISO-HDLC, as [`cantap_wire::framing::crc32`].
    pub fn crc32(&mut self, message: &[u8]) -> u32 {
        self.0.cr().write(|w| w.reset().reset());
        let (words, rest) = message.as_chunks::<4>();
        for word in words {
            self.0.dr().write(|w| w.dr().set(u32::from_le_bytes(*word).reverse_bits()));
        }
        let words_crc = self.0.dr().read().bits().reverse_bits();
        !rest.iter().fold(words_crc, |crc, byte| {
            (0..8).fold(crc ^ u32::from(*byte), |crc, _| crc >> 1 ^ if crc & 1 == 0 { 0 } else { POLYNOMIAL })
        })
    }
}
