//! How a message is framed in the byte stream: COBS of (message, CRC), then a zero byte.
//!
//! COBS only says where a message ends; a damaged message can still be well-formed COBS. The CRC
//! proves that it is intact.

use core::fmt;

use crc::Crc;
use serde::Serialize;

/// Largest message before CRC and COBS, in bytes, in either direction.
pub const MAX_MESSAGE: usize = 2048;
/// Largest request before CRC and COBS, in bytes: which a device must be able to hold. The longest request sets
/// [`MAX_FILTERS`](crate::message::MAX_FILTERS) filters of 12 bytes each.
pub const MAX_REQUEST: usize = 704;
/// Bytes of the CRC, which follows the message, little-endian.
pub const CRC_LEN: usize = 4;

/// The most bytes that a message of `len` bytes takes on the wire: CRC, one COBS byte for each
/// started run of 254, and the zero.
pub const fn max_encoded_len(len: usize) -> usize {
    let sealed = len + CRC_LEN;
    sealed + sealed.div_ceil(254) + 1
}

/// Largest encoded message, its zero byte included.
pub const MAX_ENCODED: usize = max_encoded_len(MAX_MESSAGE);

/// CRC-32/ISO-HDLC, the one of Ethernet and zip. The small table is slower, but takes 1 KiB of
/// flash instead of 16.
#[cfg(target_os = "none")]
static CRC: Crc<u32, crc::Table<1>> = Crc::<u32, crc::Table<1>>::new(&crc::CRC_32_ISO_HDLC);
/// CRC-32/ISO-HDLC, the one of Ethernet and zip.
#[cfg(not(target_os = "none"))]
static CRC: Crc<u32, crc::Table<16>> = Crc::<u32, crc::Table<16>>::new(&crc::CRC_32_ISO_HDLC);

/// The CRC of a message.
pub fn crc32(message: &[u8]) -> u32 {
    CRC.checksum(message)
}

/// The CRC of some bytes.
pub fn checksum(bytes: impl Iterator<Item = u8>) -> u32 {
    let mut digest = CRC.digest();
    bytes.for_each(|byte| digest.update(&[byte]));
    digest.finalize()
}

/// Why bytes between two zeros are not a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FramingError {
    /// Not COBS.
    Cobs,
    /// Shorter than a CRC.
    Short,
    /// The CRC does not match.
    Crc,
}

impl fmt::Display for FramingError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cobs => "not COBS",
            Self::Short => "shorter than a CRC",
            Self::Crc => "the CRC does not match",
        })
    }
}

impl core::error::Error for FramingError {}

/// Writes `message` to `out` as it goes over the wire and returns the length. `buffer` holds the message and its CRC
/// meanwhile. `None` if either is too short.
pub fn encode(message: &impl Serialize, buffer: &mut [u8], out: &mut [u8]) -> Option<usize> {
    let room = buffer.len().checked_sub(CRC_LEN)?;
    let len = postcard::to_slice(message, &mut buffer[..room]).ok()?.len();
    seal(buffer, len, out)
}

/// Encodes the first `len` bytes of `message` into `out` and returns the encoded length, zero byte
/// included. The [`CRC_LEN`] bytes after them are overwritten. `None` if `message` has no room for
/// the CRC or `out` is shorter than [`max_encoded_len`].
pub fn seal(message: &mut [u8], len: usize, out: &mut [u8]) -> Option<usize> {
    seal_with(message, len, out, crc32)
}

/// The same, for callers that have a faster way than [`crc32`] to compute a message's CRC.
pub fn seal_with(
    message: &mut [u8],
    len: usize,
    out: &mut [u8],
    crc32: impl FnOnce(&[u8]) -> u32,
) -> Option<usize> {
    let crc = crc32(message.get(..len)?).to_le_bytes();
    message.get_mut(len..len + CRC_LEN)?.copy_from_slice(&crc);
    if out.len() < max_encoded_len(len) {
        return None;
    }
    let encoded = encode_cobs(&message[..len + CRC_LEN], out);
    out[encoded] = 0;
    Some(encoded + 1)
}

/// Decodes what is between two zero bytes into `out`, which must be at least as long, and
/// returns the message without its CRC.
pub fn unseal<'a>(encoded: &[u8], out: &'a mut [u8]) -> Result<&'a [u8], FramingError> {
    unseal_with(encoded, out, crc32)
}

/// The same, for callers that have a faster way than [`crc32`] to compute a message's CRC.
pub fn unseal_with<'a>(
    encoded: &[u8],
    out: &'a mut [u8],
    crc32: impl FnOnce(&[u8]) -> u32,
) -> Result<&'a [u8], FramingError> {
    if out.len() < encoded.len() {
        return Err(FramingError::Cobs);
    }
    let len = decode_cobs(encoded, out).ok_or(FramingError::Cobs)?;
    let body = len.checked_sub(CRC_LEN).ok_or(FramingError::Short)?;
    let (message, crc) = out[..len].split_at(body);
    if crc32(message).to_le_bytes() == crc { Ok(message) } else { Err(FramingError::Crc) }
}

/// Encodes COBS into `out`, which is long enough. Checks and copies four bytes at a time: `cobs::encode` goes byte by byte,
/// which costs the device a tenth of its time for USB.
fn encode_cobs(message: &[u8], out: &mut [u8]) -> usize {
    const MAX_RUN: usize = 254;
    // The positions of the run's length and of its next byte.
    let (mut code, mut len) = (0, 1);
    let mut rest = message;
    loop {
        let run = len - code - 1;
        let zero = if let Some((word, behind)) = rest.split_first_chunk::<4>()
            && run + 4 <= MAX_RUN
        {
            // What is copied after a zero gets overwritten.
            out[len..len + 4].copy_from_slice(word);
            let bytes = u32::from_le_bytes(*word);
            // The lowest bit 7 that is set belongs to the first byte that is zero: subtracting 1 borrows there first.
            let zeros = bytes.wrapping_sub(0x0101_0101) & !bytes & 0x8080_8080;
            if zeros == 0 {
                len += 4;
                rest = behind;
                false
            } else {
                let before = zeros.trailing_zeros() as usize / 8;
                len += before;
                rest = &rest[before + 1..];
                true
            }
        } else if let Some((&byte, behind)) = rest.split_first() {
            rest = behind;
            if byte != 0 {
                out[len] = byte;
                len += 1;
            }
            byte == 0
        } else {
            out[code] = run as u8 + 1;
            return len;
        };
        let run = len - code - 1;
        if zero {
            out[code] = run as u8 + 1;
        } else if run == MAX_RUN {
            // No zero follows a full run, and nothing at all follows it at the end of the message.
            out[code] = u8::MAX;
            if rest.is_empty() {
                return len;
            }
        } else {
            continue;
        }
        code = len;
        len += 1;
    }
}

/// Decodes COBS in whole runs: `cobs::decode` goes byte by byte, which costs the host a fifth of its decoding time.
fn decode_cobs(mut encoded: &[u8], out: &mut [u8]) -> Option<usize> {
    let mut len = 0;
    while let Some((&code, rest)) = encoded.split_first() {
        let run = usize::from(code).checked_sub(1)?;
        if let Some(eight) = rest.first_chunk::<8>()
            && run <= 8
            && let Some(room) = out.get_mut(len..len + 8)
        {
            // Where there are many zeros, runs are short. What is copied past the run gets overwritten.
            room.copy_from_slice(eight);
            encoded = &rest[run..];
        } else {
            let (bytes, rest) = rest.split_at_checked(run)?;
            out.get_mut(len..len + run)?.copy_from_slice(bytes);
            encoded = rest;
        }
        len += run;
        // A zero follows each run that is not full, except the last.
        if code != u8::MAX && !encoded.is_empty() {
            *out.get_mut(len)? = 0;
            len += 1;
        }
    }
    Some(len)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn cobs_is_the_crate_s_in_both_directions(
            // Few zeros, so that there are full runs, or many. Never empty: a message always has its CRC, and the crate encodes nothing
            // as nothing.
            message in prop_oneof![
                proptest::collection::vec(0..=255u8, 1..600),
                proptest::collection::vec(0..3u8, 1..600),
                proptest::collection::vec(1..=255u8, 250..520),
            ],
        ) {
            let mut encoded = [0; 1024];
            let encoded_len = cobs::encode(&message, &mut encoded);
            let mut ours = [0; 1024];
            let our_len = encode_cobs(&message, &mut ours);
            prop_assert_eq!(&ours[..our_len], &encoded[..encoded_len]);
            let mut decoded = [0; 1024];
            let len = decode_cobs(&encoded[..encoded_len], &mut decoded).unwrap();
            prop_assert_eq!(&decoded[..len], &message[..]);
        }

        #[test]
        fn cobs_takes_any_bytes_without_a_panic(bytes: Vec<u8>, room in 0..300usize) {
            let mut out = [0; 300];
            if let Some(len) = decode_cobs(&bytes, &mut out[..room]) {
                prop_assert!(len <= room);
            }
        }
    }

    #[test]
    fn the_crc_is_the_one_of_ethernet() {
        assert_eq!(CRC.checksum(b"123456789"), 0xCBF4_3926);
    }

    #[test]
    fn the_largest_message_fits_its_bound() {
        let mut message = [0xAA; MAX_MESSAGE + CRC_LEN];
        let mut out = [0; MAX_ENCODED];
        let len = seal(&mut message, MAX_MESSAGE, &mut out).unwrap();
        assert!(len <= MAX_ENCODED && !out[..len - 1].contains(&0));
        let mut decoded = [0; MAX_ENCODED];
        assert_eq!(unseal(&out[..len - 1], &mut decoded).unwrap(), &[0xAA; MAX_MESSAGE]);
    }

    #[test]
    fn what_does_not_fit_is_refused_and_what_just_fits_is_not() {
        let sealed = |room: usize, out: usize| seal(&mut vec![0xAA; room], 300, &mut vec![0; out]);
        // 304 bytes with the CRC, of which 254 fill one run: two bytes of COBS, and the zero.
        assert_eq!((max_encoded_len(300), sealed(304, 307)), (307, Some(307)));
        assert_eq!((sealed(303, 307), sealed(304, 306), sealed(299, 307)), (None, None, None));
        assert_eq!((max_encoded_len(0), max_encoded_len(250), max_encoded_len(251)), (6, 256, 258));
        let encoded =
            |buffer: usize, out: usize| encode(&[7_u8; 20], &mut vec![0; buffer], &mut vec![0; out]);
        assert_eq!(
            (encoded(24, 26), encoded(23, 26), encoded(24, 25), encoded(3, 26)),
            (Some(26), None, None, None)
        );
    }

    #[test]
    fn what_is_not_a_message_is_said_by_its_kind() {
        let read = |bytes: &[u8], room: usize| unseal(bytes, &mut vec![0; room]).map(<[u8]>::to_vec);
        let mut out = [0; 32];
        let len = seal(&mut [1, 0, 2, 0, 0, 0, 0], 3, &mut out).unwrap() - 1;
        assert_eq!(read(&out[..len], len), Ok(vec![1, 0, 2]));
        assert_eq!(read(&out[..len], len - 1), Err(FramingError::Cobs));
        assert_eq!(read(&out[..len - 1], 32), Err(FramingError::Cobs));
        assert_eq!(read(&[4, 1, 2, 3], 32), Err(FramingError::Short));
        let mut damaged = out;
        damaged[1] ^= 2;
        assert_eq!(read(&damaged[..len], 32), Err(FramingError::Crc));
        // A message may be empty: then only its CRC is there.
        let len = seal(&mut [0; 4], 0, &mut out).unwrap() - 1;
        assert_eq!(read(&out[..len], 32), Ok(Vec::new()));
        let words =
            [FramingError::Cobs, FramingError::Short, FramingError::Crc].map(|error| error.to_string());
        assert_eq!(words, ["not COBS", "shorter than a CRC", "the CRC does not match"]);
    }

    #[test]
    fn a_checksum_of_bytes_one_by_one_is_that_of_all() {
        assert_eq!((crc32(b"123456789"), checksum(b"123456789".iter().copied())), (0xCBF4_3926, 0xCBF4_3926));
    }
}
