//! Where a signal's bits are in the data bytes.
//!
//! Bits are numbered as in DBC files: bit 0 is the least significant of the first byte, bit 7 its
//! most significant, bit 8 the least significant of the second. A little-endian (Intel) signal
//! starts at its least significant bit, a big-endian (Motorola) one at its most significant.

/// The order of a signal's bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ByteOrder {
    /// Least significant byte first; Intel.
    Little,
    /// Most significant byte first; Motorola.
    Big,
}

/// The bit's position when bits are counted in the order in which they are sent: the most significant of
/// the first byte is 0.
pub fn wire_position(bit: u32) -> u32 {
    bit / 8 * 8 + 7 - bit % 8
}

/// How many data bytes a frame must have to hold the signal.
pub fn bytes_needed(order: ByteOrder, start: u16, length: u16) -> u32 {
    let (start, length) = (u32::from(start), u32::from(length));
    match order {
        ByteOrder::Little => (start + length).div_ceil(8),
        ByteOrder::Big => (wire_position(start) + length).div_ceil(8),
    }
}

/// The signal's bits from `data` of any length, or `None` if they are not all there. `length` is 1 to 64.
pub fn extract(order: ByteOrder, start: u16, length: u16, data: &[u8]) -> Option<u64> {
    if bytes_needed(order, start, length) as usize > data.len() {
        return None;
    }
    // 64 bits that start inside a byte touch nine bytes.
    let mut window = [0; 16];
    let (first, shift, word) = match order {
        ByteOrder::Little => {
            let first = usize::from(start / 8);
            let bytes = &data[first..data.len().min(first + 9)];
            window[..bytes.len()].copy_from_slice(bytes);
            (first, u32::from(start % 8), u128::from_le_bytes(window))
        }
        ByteOrder::Big => {
            let position = wire_position(start.into());
            let first = (position / 8) as usize;
            let bytes = &data[first..data.len().min(first + 9)];
            window[..bytes.len()].copy_from_slice(bytes);
            (first, 128 - position % 8 - u32::from(length), u128::from_be_bytes(window))
        }
    };
    debug_assert!(first < data.len(), "a signal has at least one bit");
    Some((word >> shift) as u64 & mask(length))
}

/// Writes the low `length` bits of `raw` into `data`. The signal must fit.
pub fn insert(order: ByteOrder, start: u16, length: u16, raw: u64, data: &mut [u8]) {
    // Encoding happens once per frame that a person requested: clarity before speed.
    for bit in 0..u32::from(length) {
        let place = match order {
            ByteOrder::Little => u32::from(start) + bit,
            ByteOrder::Big => wire_position(wire_position(start.into()) + u32::from(length) - 1 - bit),
        };
        let byte = &mut data[(place / 8) as usize];
        let flag = 1 << (place % 8);
        if raw >> bit & 1 == 1 { *byte |= flag } else { *byte &= !flag }
    }
}

/// The low `length` bits set; `length` is 1 to 64.
pub fn mask(length: u16) -> u64 {
    u64::MAX >> (64 - u32::from(length))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn motorola_bits_run_down_and_into_the_next_byte() {
        let data = [0x12, 0x34, 0x56, 0x78, 0, 0, 0, 0];
        assert_eq!(extract(ByteOrder::Big, 7, 16, &data), Some(0x1234));
        assert_eq!(extract(ByteOrder::Big, 3, 8, &data), Some(0x23));
        assert_eq!(extract(ByteOrder::Little, 0, 16, &data), Some(0x3412));
        assert_eq!(extract(ByteOrder::Little, 4, 8, &data), Some(0x41));
        assert_eq!(extract(ByteOrder::Little, 56, 9, &data), None);
        assert_eq!(extract(ByteOrder::Big, 56, 2, &data), None);
    }

    proptest! {
        #[test]
        fn what_is_inserted_is_extracted_and_nothing_else_changes(
            big: bool, start in 0u16..120, length in 1u16..=64, raw: u64, before: [u8; 16],
        ) {
            let order = if big { ByteOrder::Big } else { ByteOrder::Little };
            prop_assume!(bytes_needed(order, start, length) <= 16);
            let mut data = before;
            insert(order, start, length, raw, &mut data);
            prop_assert_eq!(extract(order, start, length, &data), Some(raw & mask(length)));
            let changed: u32 = data.iter().zip(before).map(|(a, b)| (a ^ b).count_ones()).sum();
            prop_assert!(changed <= length.into());
            let old = extract(order, start, length, &before).unwrap();
            insert(order, start, length, old, &mut data);
            prop_assert_eq!(data, before);
        }
    }
}
