//! What the records of classical and of CAN FD frames have in common.

use crate::Id;
use crate::varint::put_u32;

/// Bytes of the longest time difference: 64 bits, 7 a byte.
pub(super) const MAX_TICKS: usize = 10;

pub(super) const FRAME: u8 = 0x80;
pub(super) const UPPER_BOUND: u8 = 1;
pub(super) const NO_STAMP: u8 = 2;
pub(super) const NO_DATA: u8 = 4;

/// What the stamp of a received frame means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Stamp {
    /// Read at the end of the frame, plus the interrupt's latency.
    Exact,
    /// The frame was found queued behind another one: it ended at this time or earlier.
    UpperBound,
    /// Left out on request; the record's time is that of the previous record.
    Omitted,
}

/// A record cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BadRecord;

/// postcard's `i64`.
#[inline]
pub(super) fn encode_ticks(ticks: i64, out: &mut [u8]) -> usize {
    // Nearly all fit into 32 bits, which on the device takes half the registers.
    let Ok(ticks) = i32::try_from(ticks) else { return encode_long_ticks(ticks, out) };
    put_u32(((ticks << 1) ^ (ticks >> 31)) as u32, out)
}

#[cold]
#[inline(never)]
fn encode_long_ticks(ticks: i64, out: &mut [u8]) -> usize {
    // Cannot fail: the buffer holds the longest record.
    postcard::to_slice(&ticks, out).map_or(0, |written| written.len())
}

/// postcard's `i64`, with what follows it. Always inline: a call would return the result through memory, for each record that the
/// device packs.
#[inline(always)]
#[expect(clippy::inline_always, reason = "measured: a tenth of the time for packing")]
pub(super) fn decode_ticks(bytes: &[u8]) -> Result<(i64, &[u8]), BadRecord> {
    // Nearly all take one or two bytes; postcard reads the rest.
    let (zigzag, rest) = match *bytes {
        [a, ref rest @ ..] if a < 0x80 => (u32::from(a), rest),
        [a, b, ref rest @ ..] if b < 0x80 => (u32::from(a & 0x7F) | u32::from(b) << 7, rest),
        _ => return decode_long_ticks(bytes),
    };
    Ok((i64::from((zigzag >> 1) as i32 ^ -((zigzag & 1) as i32)), rest))
}

#[cold]
#[inline(never)]
fn decode_long_ticks(bytes: &[u8]) -> Result<(i64, &[u8]), BadRecord> {
    postcard::take_from_bytes(bytes).map_err(|_| BadRecord)
}

/// The identifier behind a header, and what follows it.
#[inline(always)]
#[allow(clippy::inline_always, reason = "a part of `decode_frame`")]
pub(super) fn take_id(header: u8, rest: &[u8]) -> Result<(Id, &[u8]), BadRecord> {
    let (id, rest) = if header & 0x20 == 0 {
        let (raw, rest) = rest.split_first_chunk::<2>().ok_or(BadRecord)?;
        (Id::standard(u32::from(u16::from_le_bytes(*raw))), rest)
    } else {
        let (raw, rest) = rest.split_first_chunk::<4>().ok_or(BadRecord)?;
        (Id::extended(u32::from_le_bytes(*raw)), rest)
    };
    Ok((id.ok_or(BadRecord)?, rest))
}
