//! The checksums that networks use within a frame: for scripts, and for finding them in a trace.

/// CRC-8 over `bytes`, the most significant bit first, without its usual 0x100 in `polynomial`. SAE J1850 has polynomial 0x1D, start 0xFF and
/// `xor_out` 0xFF; AUTOSAR's 8H2F the same with 0x2F.
pub fn crc8(bytes: impl IntoIterator<Item = u8>, polynomial: u8, start: u8, xor_out: u8) -> u8 {
    let shift = |crc: u8, _| if crc & 0x80 == 0 { crc << 1 } else { crc << 1 ^ polynomial };
    let crc = bytes.into_iter().fold(start, |crc, byte| (0..8).fold(crc ^ byte, shift));
    crc ^ xor_out
}

/// The same with the least significant bit first; parameters as in catalogues of CRCs, where the polynomial is not reflected.
pub fn crc8_reflected(bytes: impl IntoIterator<Item = u8>, polynomial: u8, start: u8, xor_out: u8) -> u8 {
    crc8(bytes.into_iter().map(u8::reverse_bits), polynomial, start, 0).reverse_bits() ^ xor_out
}

/// The exclusive or of all bytes.
pub fn xor8(bytes: impl IntoIterator<Item = u8>) -> u8 {
    bytes.into_iter().fold(0, |sum, byte| sum ^ byte)
}

/// The low eight bits of the sum of all bytes.
pub fn sum8(bytes: impl IntoIterator<Item = u8>) -> u8 {
    bytes.into_iter().fold(0, u8::wrapping_add)
}

/// The low eight bits of the sum of all half bytes.
pub fn nibble_sum(bytes: impl IntoIterator<Item = u8>) -> u8 {
    sum8(bytes.into_iter().flat_map(|byte| [byte >> 4, byte & 15]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check values of the catalogues, over the digits 1 to 9.
    #[test]
    fn each_crc_has_its_catalogues_check_value() {
        let check = *b"123456789";
        assert_eq!(crc8(check, 0x07, 0x00, 0x00), 0xF4, "SMBUS");
        assert_eq!(crc8(check, 0x1D, 0xFF, 0xFF), 0x4B, "SAE J1850");
        assert_eq!(crc8(check, 0x2F, 0xFF, 0xFF), 0xDF, "AUTOSAR");
        assert_eq!(crc8_reflected(check, 0x31, 0x00, 0x00), 0xA1, "MAXIM-DOW");
        assert_eq!(crc8_reflected(check, 0x07, 0xFF, 0x00), 0xD0, "ROHC");
    }

    #[test]
    fn sums_wrap_at_eight_bits() {
        assert_eq!((xor8([0x12, 0x34]), sum8([0xFF, 0x03]), nibble_sum([0x12, 0xF0])), (0x26, 2, 18));
        assert_eq!(nibble_sum([0xFF; 9]), 14);
    }
}
