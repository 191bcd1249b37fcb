//! Data frames in a form for programs that go through millions of them and look at identifier and bytes alone.

use cantap_can::Id;

use crate::{TraceFrame, TraceRecord};

/// A data frame of classical CAN, which most records of a trace are: what decoding its signals needs, in a third of a
/// [`TraceRecord`]'s room. Direction, the code behind the length, and whether the time is an upper bound are not in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlainFrame {
    /// As [`TraceRecord::time_ns`].
    pub time_ns: i64,
    /// The data bytes, the first one lowest, with zeros beyond the length.
    pub data: u64,
    /// The identifier.
    pub id: Id,
    /// As [`TraceRecord::channel`].
    pub channel: u8,
    /// How many data bytes there are, 0 to 8.
    pub len: u8,
}

impl PlainFrame {
    /// The record's frame, if it is such a one.
    #[inline]
    pub fn of(record: &TraceRecord) -> Option<Self> {
        match record.frame()? {
            TraceFrame::Classic(frame) if !frame.is_remote() => Some(Self {
                time_ns: record.time_ns,
                data: u64::from_le_bytes(frame.padded_data()),
                id: frame.id(),
                channel: record.channel,
                len: frame.data_len() as u8,
            }),
            _ => None,
        }
    }

    /// A frame of the first `len` of these bytes; 8 if there are said to be more.
    #[inline]
    pub const fn new(time_ns: i64, channel: u8, id: Id, len: u8, bytes: [u8; 8]) -> Self {
        const USED: [u64; 9] = [
            0,
            0xFF,
            0xFFFF,
            0xFF_FFFF,
            0xFFFF_FFFF,
            0xFF_FFFF_FFFF,
            0xFFFF_FFFF_FFFF,
            0xFF_FFFF_FFFF_FFFF,
            u64::MAX,
        ];
        let len = if len > 8 { 8 } else { len };
        let data = u64::from_le_bytes(bytes) & USED[len as usize];
        Self { time_ns, data, id, channel, len }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::record_or_fd;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_plain_frame_has_the_bytes_of_the_records(record in record_or_fd(1), beyond: [u8; 8]) {
            let plain = PlainFrame::of(&record);
            let frame = record.frame().filter(|frame| !frame.is_fd() && !frame.is_remote());
            prop_assert_eq!(plain.is_some(), frame.is_some());
            let (Some(plain), Some(frame)) = (plain, frame) else { return Ok(()) };
            prop_assert_eq!(&plain.data.to_le_bytes()[..usize::from(plain.len)], frame.data());
            let mut bytes = beyond;
            bytes[..frame.data_len()].copy_from_slice(frame.data());
            prop_assert_eq!(PlainFrame::new(record.time_ns, record.channel, frame.id(), frame.dlc(), bytes), plain);
        }
    }
}
