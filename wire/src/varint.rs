//! postcard's unsigned integers, for what is read thousands of times a second: seven bits per byte, the low ones first,
//! with bit 7 set in all bytes but the last.

/// Bytes of the longest `u32`.
const MAX_U32: usize = 5;

/// Writes a `u32` and returns its length. `out` must have room for it.
#[inline]
pub(crate) fn put_u32(mut value: u32, out: &mut [u8]) -> usize {
    let mut len = 0;
    while value >= 0x80 {
        out[len] = value as u8 | 0x80;
        value >>= 7;
        len += 1;
    }
    out[len] = value as u8;
    len + 1
}

/// Reads a `u64`, with the bytes that follow.
#[inline]
pub(crate) fn take_u64(bytes: &[u8]) -> Option<(u64, &[u8])> {
    // Most are short, and 64-bit shifts are slow on the device.
    if let Some((value, rest)) = take_short(bytes) {
        return Some((value.into(), rest));
    }
    let mut value = 0;
    for (index, &byte) in bytes.iter().enumerate() {
        let bits = u64::from(byte & 0x7F);
        let shift = 7 * index as u32;
        // Ten bytes can hold more than 64 bits.
        if shift >= u64::BITS || bits > u64::MAX >> shift {
            return None;
        }
        value |= bits << shift;
        if byte < 0x80 {
            return Some((value, &bytes[index + 1..]));
        }
    }
    None
}

/// Reads a value of at most four bytes.
#[inline]
fn take_short(bytes: &[u8]) -> Option<(u32, &[u8])> {
    let mut value = 0;
    for (index, &byte) in bytes.iter().enumerate().take(4) {
        value |= u32::from(byte & 0x7F) << (7 * index);
        if byte < 0x80 {
            return Some((value, &bytes[index + 1..]));
        }
    }
    None
}

/// Reads a `u32`, with the bytes that follow.
#[inline]
pub(crate) fn take_u32(bytes: &[u8]) -> Option<(u32, &[u8])> {
    if let Some(short) = take_short(bytes) {
        return Some(short);
    }
    let (value, rest) = take_u64(bytes)?;
    let is_short = bytes.len() - rest.len() <= MAX_U32;
    Some((u32::try_from(value).ok().filter(|_| is_short)?, rest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encoded(value: u64) -> Vec<u8> {
        postcard::to_slice(&value, &mut [0; 10]).unwrap().to_vec()
    }

    proptest! {
        #[test]
        fn any_bytes_are_what_postcard_says(
            bytes in prop_oneof![
                proptest::collection::vec(any::<u8>(), 0..12),
                // Long values, many of them too long.
                proptest::collection::vec(0x7E..0x82u8, 0..12),
                (any::<u64>(), 0..64u32).prop_map(|(value, bits)| encoded(value >> bits)),
            ],
        ) {
            prop_assert_eq!(take_u32(&bytes), postcard::take_from_bytes(&bytes).ok());
            prop_assert_eq!(take_u64(&bytes), postcard::take_from_bytes(&bytes).ok());
        }

        #[test]
        fn what_is_written_is_what_postcard_writes(value: u32, bits in 0..32u32) {
            let mut out = [0; MAX_U32];
            let len = put_u32(value >> bits, &mut out);
            prop_assert_eq!(&out[..len], &encoded((value >> bits).into())[..]);
        }
    }

    #[test]
    fn the_largest_are_read_and_what_is_larger_or_longer_is_not() {
        let [ones, zeros] = [[0xFF; 9], [0x80; 9]];
        let long = |bytes: &[u8], last: u8| {
            take_u64(&[bytes, &[last]].concat()).map(|(value, rest)| (value, rest.len()))
        };
        assert_eq!(
            (long(&ones, 1), long(&ones, 2), long(&zeros, 1)),
            (Some((u64::MAX, 0)), None, Some((1 << 63, 0)))
        );
        assert_eq!((long(&zeros, 2), long(&[0x80; 10], 0), long(&[0x80; 11], 1)), (None, None, None));
        let short = |bytes: &[u8], last: u8| {
            take_u32(&[bytes, &[last]].concat()).map(|(value, rest)| (value, rest.len()))
        };
        assert_eq!((short(&ones[..4], 15), short(&ones[..4], 16)), (Some((u32::MAX, 0)), None));
        // A sixth byte would only be another way to write a number.
        assert_eq!((short(&zeros[..4], 0), short(&zeros[..5], 0)), (Some((0, 0)), None));
    }
}
