//! The checksums that periodic frames can carry.

use cantap_wire::message::Checksum;
use crc::{CRC_8_SAE_J1850, Crc, Table};

static J1850: Crc<u8, Table<1>> = Crc::<u8, Table<1>>::new(&CRC_8_SAE_J1850);

/// The checksum of all data bytes but the one that will hold it.
pub fn checksum(algorithm: Checksum, data: &[u8], holder: usize) -> u8 {
    let (before, after) = data.split_at(holder.min(data.len()));
    let after = after.get(1..).unwrap_or(&[]);
    let bytes = before.iter().chain(after);
    match algorithm {
        Checksum::Xor => bytes.fold(0, |sum, byte| sum ^ byte),
        Checksum::Sum => bytes.fold(0, |sum, byte| sum.wrapping_add(*byte)),
        Checksum::Crc8J1850 => {
            let mut digest = J1850.digest();
            digest.update(before);
            digest.update(after);
            digest.finalize()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The check value is the CRC catalogue's for CRC-8/SAE-J1850.
    #[test]
    fn checksums_leave_their_own_byte_out() {
        let mut data = *b"\xFF123456789";
        assert_eq!(checksum(Checksum::Crc8J1850, &data, 0), 0x4B);
        data.rotate_left(1);
        assert_eq!(checksum(Checksum::Crc8J1850, &data, 9), 0x4B);
        assert_eq!(checksum(Checksum::Xor, &[1, 2, 0xEE, 4], 2), 7);
        assert_eq!(checksum(Checksum::Sum, &[0xFF, 2, 0xEE], 2), 1);
    }
}
