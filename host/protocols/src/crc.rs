//! The CRC that CANopen, DroneCAN and Cyphal have in common.

/// CRC-16 with the polynomial 1021, from a value on: from 0 in CANopen's blocks (CiA 301, 7.2.4.3.16), from FFFF in transfers of DroneCAN and
/// Cyphal (CRC-16/CCITT-FALSE).
pub(crate) fn crc16(from: u16, bytes: &[u8]) -> u16 {
    bytes.iter().fold(from, |crc, byte| {
        (0..8).fold(
            crc ^ u16::from(*byte) << 8,
            |crc, _| {
                if crc & 0x8000 == 0 { crc << 1 } else { crc << 1 ^ 0x1021 }
            },
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check values of the catalogue of CRCs.
    #[test]
    fn the_check_values_come_out() {
        assert_eq!(crc16(0, b"123456789"), 0x31C3);
        assert_eq!(crc16(0xFFFF, b"123456789"), 0x29B1);
    }
}
