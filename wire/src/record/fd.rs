//! The records of received and of sent CAN FD frames. No board of ours sends them: its controllers are classical. They come from devices on a computer, which
//! stand before other makers' adapters, and from servers that share one.

use cantap_can::FdFrame;
use cantap_can::fd::{FD_LENGTHS, FD_MAX_BYTES};

use super::parts::{
    BadRecord, FRAME, MAX_TICKS, NO_DATA, NO_STAMP, Stamp, UPPER_BOUND, decode_ticks, encode_ticks, take_id,
};
use crate::Channel;
use crate::varint::{put_u32, take_u32};

/// Bytes of the longest record of an FD frame: qualifiers, header, ID, tag, time difference, data.
pub const MAX_FD_RECORD: usize = 1 + 1 + 4 + MAX_TAG + MAX_TICKS + FD_MAX_BYTES;
/// Bytes of the longest tag, which only a sent frame has.
const MAX_TAG: usize = 5;

/// The first byte's upper three bits.
pub(super) const FD: u8 = 0x60;
/// The first byte of the last of them.
pub(super) const LAST_FD: u8 = 0x7F;
/// A sent frame's first byte: its upper six bits.
pub(super) const SENT: u8 = 0x50;
/// The first byte of the last of them.
pub(super) const LAST_SENT: u8 = 0x53;
const SENT_BRS: u8 = 1;
const SENT_ESI: u8 = 2;
const BRS: u8 = 8;
const ESI: u8 = 16;
/// The bit that a header has for remote frames, of which FD has none.
const REMOTE: u8 = 0x10;

/// A received CAN FD frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ReceivedFd {
    /// Where it was received.
    pub channel: Channel,
    /// The frame. With [`Self::data_omitted`] its data bytes read zero.
    pub frame: FdFrame,
    /// What its stamp means.
    pub stamp: Stamp,
    /// Whether the data bytes were left out on request.
    pub data_omitted: bool,
}

/// An FD frame of ours is on the bus, complete and acknowledged. Its time is the end of the frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct TransmittedFd {
    /// Where.
    pub channel: Channel,
    /// As in [`crate::Event::Transmitted`].
    pub tag: u32,
    /// The frame as sent.
    pub frame: FdFrame,
}

/// Writes a received FD frame and returns its length. `ticks` is the time since the previous record.
pub fn encode_received_fd(received: &ReceivedFd, ticks: i64, out: &mut [u8; MAX_FD_RECORD]) -> usize {
    let frame = &received.frame;
    let flag = |is: bool, bit: u8| if is { bit } else { 0 };
    let stamp = match received.stamp {
        Stamp::Exact => 0,
        Stamp::UpperBound => UPPER_BOUND,
        Stamp::Omitted => NO_STAMP,
    };
    out[0] =
        FD | stamp | flag(received.data_omitted, NO_DATA) | flag(frame.brs(), BRS) | flag(frame.esi(), ESI);
    let mut len = put_head(received.channel, frame, out);
    if received.stamp != Stamp::Omitted {
        len += encode_ticks(ticks, &mut out[len..]);
    }
    if !received.data_omitted {
        len += put_data(frame, &mut out[len..]);
    }
    len
}

/// Writes the confirmation of an FD frame and returns its length. `ticks` is the time since the previous record.
pub fn encode_transmitted_fd(sent: &TransmittedFd, ticks: i64, out: &mut [u8; MAX_FD_RECORD]) -> usize {
    let frame = &sent.frame;
    out[0] = SENT | if frame.brs() { SENT_BRS } else { 0 } | if frame.esi() { SENT_ESI } else { 0 };
    let mut len = put_head(sent.channel, frame, out);
    len += put_u32(sent.tag, &mut out[len..]);
    len += encode_ticks(ticks, &mut out[len..]);
    len + put_data(frame, &mut out[len..])
}

/// Writes header and identifier after the first byte, and returns the length of all of it.
fn put_head(channel: Channel, frame: &FdFrame, out: &mut [u8; MAX_FD_RECORD]) -> usize {
    let id = frame.id();
    out[1] = FRAME | (channel.index() as u8) << 6 | if id.is_extended() { 0x20 } else { 0 } | frame.dlc();
    out[2..6].copy_from_slice(&id.raw().to_le_bytes());
    if id.is_extended() { 6 } else { 4 }
}

fn put_data(frame: &FdFrame, out: &mut [u8]) -> usize {
    let data = frame.data();
    out[..data.len()].copy_from_slice(data);
    data.len()
}

/// Reads a received FD frame.
pub(super) fn decode(bytes: &[u8]) -> Result<(ReceivedFd, i64, &[u8]), BadRecord> {
    let [qualifiers @ FD..=LAST_FD, header @ FRAME..=0xFF, ref rest @ ..] = *bytes else {
        return Err(BadRecord);
    };
    let stamp = match qualifiers & (UPPER_BOUND | NO_STAMP) {
        0 => Stamp::Exact,
        UPPER_BOUND => Stamp::UpperBound,
        NO_STAMP => Stamp::Omitted,
        _ => return Err(BadRecord),
    };
    if header & REMOTE != 0 {
        return Err(BadRecord);
    }
    let (id, rest) = take_id(header, rest)?;
    let (ticks, rest) = if stamp == Stamp::Omitted { (0, rest) } else { decode_ticks(rest)? };
    let data_omitted = qualifiers & NO_DATA != 0;
    let len = usize::from(FD_LENGTHS[usize::from(header & 15)]);
    let (data, rest) = if data_omitted {
        (&[0; FD_MAX_BYTES][..len], rest)
    } else {
        rest.split_at_checked(len).ok_or(BadRecord)?
    };
    let channel = channel_of(header);
    let frame = FdFrame::new(id, qualifiers & BRS != 0, qualifiers & ESI != 0, data).ok_or(BadRecord)?;
    Ok((ReceivedFd { channel, frame, stamp, data_omitted }, ticks, rest))
}

/// Reads the confirmation of an FD frame.
pub(super) fn decode_sent(bytes: &[u8]) -> Result<(TransmittedFd, i64, &[u8]), BadRecord> {
    let [flags @ SENT..=LAST_SENT, header @ FRAME..=0xFF, ref rest @ ..] = *bytes else {
        return Err(BadRecord);
    };
    if header & REMOTE != 0 {
        return Err(BadRecord);
    }
    let (id, rest) = take_id(header, rest)?;
    let (tag, rest) = take_u32(rest).ok_or(BadRecord)?;
    let (ticks, rest) = decode_ticks(rest)?;
    let len = usize::from(FD_LENGTHS[usize::from(header & 15)]);
    let (data, rest) = rest.split_at_checked(len).ok_or(BadRecord)?;
    let frame = FdFrame::new(id, flags & SENT_BRS != 0, flags & SENT_ESI != 0, data).ok_or(BadRecord)?;
    Ok((TransmittedFd { channel: channel_of(header), tag, frame }, ticks, rest))
}

const fn channel_of(header: u8) -> Channel {
    if header & 0x40 == 0 { Channel::Can1 } else { Channel::Can2 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Id;
    use crate::Record;
    use crate::record::Outline;
    use proptest::prelude::*;

    fn received() -> impl Strategy<Value = ReceivedFd> {
        let id = prop_oneof![
            (0..=Id::MAX_STANDARD).prop_map(|raw| Id::standard(raw).unwrap()),
            (0..=Id::MAX_EXTENDED).prop_map(|raw| Id::extended(raw).unwrap()),
        ];
        let stamp = prop_oneof![Just(Stamp::Exact), Just(Stamp::UpperBound), Just(Stamp::Omitted)];
        let flags = (any::<bool>(), any::<bool>(), any::<bool>(), any::<bool>());
        (id, flags, 0..16_usize, prop::collection::vec(any::<u8>(), FD_MAX_BYTES), stamp).prop_map(
            |(id, (second, brs, esi, data_omitted), dlc, data, stamp)| {
                let data = if data_omitted { &[0; FD_MAX_BYTES] } else { &data[..] };
                ReceivedFd {
                    channel: Channel::ALL[usize::from(second)],
                    frame: FdFrame::new(id, brs, esi, &data[..usize::from(FD_LENGTHS[dlc])]).unwrap(),
                    stamp,
                    data_omitted,
                }
            },
        )
    }

    proptest! {
        #[test]
        fn any_fd_frame_round_trips(received in received(), ticks: i64, tail: Vec<u8>) {
            let mut out = [0; MAX_FD_RECORD];
            let len = encode_received_fd(&received, ticks, &mut out);
            let bytes = [&out[..len], &tail].concat();
            let ticks = if received.stamp == Stamp::Omitted { 0 } else { ticks };
            prop_assert_eq!(crate::record::decode(&bytes), Ok((Record::ReceivedFd(received), ticks, &tail[..])));
            let frame_of = Some(received.channel);
            prop_assert_eq!(crate::record::outline(&bytes), Ok(Outline { len, ticks, frame_of }));
        }

        #[test]
        fn a_cut_record_is_refused(received in received(), ticks: i64, cut in any::<prop::sample::Index>()) {
            let mut out = [0; MAX_FD_RECORD];
            let len = encode_received_fd(&received, ticks, &mut out);
            prop_assert_eq!(crate::record::decode(&out[..cut.index(len)]), Err(BadRecord));
        }

        #[test]
        fn any_confirmation_round_trips(received in received(), tag: u32, ticks: i64, tail: Vec<u8>, cut in any::<prop::sample::Index>()) {
            let sent = TransmittedFd { channel: received.channel, tag, frame: received.frame };
            let mut out = [0; MAX_FD_RECORD];
            let len = encode_transmitted_fd(&sent, ticks, &mut out);
            let bytes = [&out[..len], &tail].concat();
            prop_assert_eq!(crate::record::decode(&bytes), Ok((Record::TransmittedFd(sent), ticks, &tail[..])));
            prop_assert_eq!(crate::record::outline(&bytes), Ok(Outline { len, ticks, frame_of: None }));
            prop_assert_eq!(crate::record::decode(&out[..cut.index(len)]), Err(BadRecord));
        }

        #[test]
        fn any_bytes_are_a_record_or_refused(first in SENT..=LAST_FD, header: u8, rest: Vec<u8>) {
            let bytes = [&[first, header], &rest[..]].concat();
            let found = crate::record::decode(&bytes).map(|(_, _, rest)| bytes.len() - rest.len());
            prop_assert_eq!(crate::record::outline(&bytes).map(|outline| outline.len), found);
        }
    }

    #[test]
    fn the_longest_record_fits() {
        let frame = FdFrame::new(Id::extended(Id::MAX_EXTENDED).unwrap(), true, true, &[0xFF; 64]).unwrap();
        let received = ReceivedFd { channel: Channel::Can2, frame, stamp: Stamp::Exact, data_omitted: false };
        let mut out = [0; MAX_FD_RECORD];
        assert_eq!(encode_received_fd(&received, i64::MIN, &mut out), MAX_FD_RECORD - MAX_TAG);
        let sent = TransmittedFd { channel: Channel::Can2, tag: u32::MAX, frame };
        assert_eq!(encode_transmitted_fd(&sent, i64::MIN, &mut out), MAX_FD_RECORD);
    }
}
