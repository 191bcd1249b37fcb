//! Records: what a device saw or did, in the order of its capture queue. Each begins with a byte that gives its kind:
//!
//! | first byte | then |
//! |---|---|
//! | `0x00..=0x3F` | an [`Event`]: this byte is postcard's enum index, its fields follow, then the time difference |
//! | `0x40..=0x47` | qualifiers of the frame that follows: bit 0 the stamp is only an upper bound, bit 1 no time difference, bit 2 no data |
//! | `0x50..=0x53` | the confirmation of a CAN FD frame that was sent: bit 0 its bit rate is switched, bit 1 its sender is error passive; then a frame's header and ID, the tag, the time difference, the data. Never from a board |
//! | `0x60..=0x7F` | a received CAN FD frame: bits 2..0 as above, bit 3 its bit rate is switched, bit 4 its sender is error passive; then as below, without remote frames, with up to 64 bytes of data. Never from a board |
//! | `0x80..=0xFF` | a received frame: bit 6 channel, bit 5 extended, bit 4 remote, bits 3..0 DLC; then the ID (2 or 4 bytes, little-endian), the time difference, the data |
//!
//! Time differences are postcard's `i64` (zigzag, 7 bits a byte), in ticks since the previous record. They are signed because a stamp may be
//! before the other channel's last one, and wide because a host may open a channel hours after its greeting, or read nothing for hours.

pub use cantap_can::{BusErrorKind, ErrorState, LossStage, TransmitFailure};
use serde::{Deserialize, Serialize};

use crate::packed::{put_packed, take_data};
use crate::varint::{put_u32, take_u32};
use crate::{Channel, Frame};

mod fd;
mod parts;

pub use fd::{MAX_FD_RECORD, ReceivedFd, TransmittedFd, encode_received_fd, encode_transmitted_fd};
pub use parts::{BadRecord, Stamp};
use parts::{FRAME, MAX_TICKS, NO_DATA, NO_STAMP, UPPER_BOUND, decode_ticks, encode_ticks, take_id};

/// Bytes of the longest received-frame record: qualifier, header, ID, time difference, data.
pub const MAX_FRAME_RECORD: usize = 1 + 1 + 4 + MAX_TICKS + 8;
/// Bytes of the longest record of any kind, an [`Event::Transmitted`]: index, channel, tag, packed ID, DLC, length, data, time difference.
pub const MAX_RECORD: usize = 1 + 1 + 5 + 5 + 1 + 1 + 8 + MAX_TICKS;
/// The index of [`Event::Transmitted`].
const TRANSMITTED: u8 = 6;
const QUALIFIED: u8 = 0x40;
const QUALIFIER_MASK: u8 = 0xF8;
/// A received frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Received {
    /// Where it was received.
    pub channel: Channel,
    /// The frame. With [`Self::data_omitted`] its data bytes read zero.
    pub frame: Frame,
    /// What its stamp means.
    pub stamp: Stamp,
    /// Whether the data bytes were left out on request.
    pub data_omitted: bool,
}

/// Everything in the stream that is not a received frame. The order of the variants is the wire format: append only, and at most 64.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Event {
    /// Frames are missing at this place.
    Lost {
        /// The channel they would have come from.
        channel: Channel,
        /// The stage that lost them.
        stage: LossStage,
        /// How many.
        count: u32,
        /// Whether there may have been more (a hardware overrun cannot count).
        at_least: bool,
    },
    /// The controller saw an error on the bus.
    BusError {
        /// Where.
        channel: Channel,
        /// What.
        kind: BusErrorKind,
        /// Transmit error counter after it.
        tec: u8,
        /// Receive error counter after it.
        rec: u8,
    },
    /// Bus errors that were counted but not reported one by one, because there were too many.
    ErrorsSuppressed {
        /// Where.
        channel: Channel,
        /// How many.
        count: u32,
    },
    /// The controller's fault confinement changed.
    State {
        /// Where.
        channel: Channel,
        /// The new state.
        state: ErrorState,
        /// Transmit error counter.
        tec: u8,
        /// Receive error counter.
        rec: u8,
    },
    /// The channel takes part in the bus from here on.
    Started {
        /// Which.
        channel: Channel,
    },
    /// The channel was closed: nothing more of it follows.
    Stopped {
        /// Which.
        channel: Channel,
    },
    /// A frame of ours is on the bus, complete and acknowledged. Its time is the end of the frame.
    Transmitted {
        /// Where.
        channel: Channel,
        /// The tag from the request ([`crate::message::TxFrame`]), or of what the device sends on its own ([`crate::message::DEVICE_TAG`]).
        tag: u32,
        /// The frame as sent.
        #[serde(with = "crate::packed")]
        frame: Frame,
    },
    /// A frame was not sent and will not be; or periods passed without one ([`TransmitFailure::Overtaken`]).
    TransmitFailed {
        /// Where.
        channel: Channel,
        /// As in [`Event::Transmitted`].
        tag: u32,
        /// Why.
        reason: TransmitFailure,
    },
    /// The start of a USB frame. The record's time is the stamp timer as the hardware latched it when the frame's SOF token had been
    /// received. About once a second in a session, whether a channel is open or not; none where no SOF was latched.
    SofMark {
        /// The frame number in that token: 11 bits, one more each millisecond, 0 after 2047.
        frame: u16,
        /// Milliseconds since the last mark in which more than one SOF was latched: near 1000 if a host or chip doubles each.
        doubled: u16,
    },
    /// The device has driven the bus dominant, as asked. The record's time is when the level began, or was to begin.
    #[cfg(any(feature = "disturb", not(target_os = "none")))]
    Disturbed {
        /// Where.
        channel: Channel,
        /// For how many ticks; 0 if it came to nothing, because the device was busy at that moment.
        ticks: u16,
    },
}

/// One entry of the stream. The decoder knows its absolute time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Record {
    /// A received frame.
    Received(Received),
    /// Anything else.
    Event(Event),
    /// A received CAN FD frame: never from a board of ours.
    ReceivedFd(ReceivedFd),
    /// A CAN FD frame of ours is on the bus: as [`Event::Transmitted`], never from a board of ours.
    TransmittedFd(TransmittedFd),
}

impl Record {
    /// Where it was received, if it is a received frame.
    #[inline]
    pub const fn received_on(&self) -> Option<Channel> {
        match self {
            Self::Received(received) => Some(received.channel),
            Self::ReceivedFd(received) => Some(received.channel),
            Self::Event(_) | Self::TransmittedFd(_) => None,
        }
    }
}

/// Writes a received frame and returns its length. `ticks` is the time since the previous record.
#[inline]
pub fn encode_received(received: &Received, ticks: i64, out: &mut [u8; MAX_RECORD]) -> usize {
    let frame = &received.frame;
    let mut qualifiers = match received.stamp {
        Stamp::Exact => 0,
        Stamp::UpperBound => UPPER_BOUND,
        Stamp::Omitted => NO_STAMP,
    };
    if received.data_omitted {
        qualifiers |= NO_DATA;
    }
    let mut len = 0;
    if qualifiers != 0 {
        out[0] = QUALIFIED | qualifiers;
        len = 1;
    }
    let id = frame.id();
    out[len] = FRAME
        | (received.channel.index() as u8) << 6
        | u8::from(id.is_extended()) << 5
        | u8::from(frame.is_remote()) << 4
        | frame.dlc();
    len += 1;
    let raw = id.raw().to_le_bytes();
    let id_len = if id.is_extended() { 4 } else { 2 };
    out[len..len + 4].copy_from_slice(&raw);
    len += id_len;
    if received.stamp != Stamp::Omitted {
        len += encode_ticks(ticks, &mut out[len..]);
    }
    if !received.data_omitted {
        let data_len = frame.data_len();
        out[len..len + 8].copy_from_slice(&frame.padded_data());
        len += data_len;
    }
    len
}

/// Writes an event and returns its length. `ticks` is the time since the previous record.
#[inline]
pub fn encode_event(event: &Event, ticks: i64, out: &mut [u8; MAX_RECORD]) -> usize {
    // While a host streams, nearly all events are confirmations.
    let len = match event {
        Event::Transmitted { channel, tag, frame } => put_transmitted(*channel, *tag, frame, out),
        _ => put_event(event, out),
    };
    len + encode_ticks(ticks, &mut out[len..])
}

fn put_event(event: &Event, out: &mut [u8]) -> usize {
    // Cannot fail: the buffer holds the longest event there is (tested below).
    postcard::to_slice(event, out).map_or(0, |written| written.len())
}

#[inline]
fn put_transmitted(channel: Channel, tag: u32, frame: &Frame, out: &mut [u8; MAX_RECORD]) -> usize {
    out[0] = TRANSMITTED;
    out[1] = channel.index() as u8;
    let len = 2 + put_u32(tag, &mut out[2..]);
    let Some(room) = out[len..].first_chunk_mut() else { return len };
    len + put_packed(frame, room)
}

/// Reads one record: the record, its time difference in ticks, and what follows it.
#[inline]
pub fn decode(bytes: &[u8]) -> Result<(Record, i64, &[u8]), BadRecord> {
    // Nearly every record is a frame without qualifiers.
    match *bytes {
        [header @ FRAME..=0xFF, ref rest @ ..] => decode_frame(0, header, rest),
        [fd::FD..=fd::LAST_FD, ..] => {
            fd::decode(bytes).map(|(received, ticks, rest)| (Record::ReceivedFd(received), ticks, rest))
        }
        [fd::SENT..=fd::LAST_SENT, ..] => {
            fd::decode_sent(bytes).map(|(sent, ticks, rest)| (Record::TransmittedFd(sent), ticks, rest))
        }
        [qualified @ QUALIFIED..fd::FD, header @ FRAME..=0xFF, ref rest @ ..] => {
            let qualifiers = qualified & !QUALIFIER_MASK;
            if qualified & QUALIFIER_MASK != QUALIFIED || qualifiers == 0 {
                return Err(BadRecord);
            }
            decode_frame(qualifiers, header, rest)
        }
        [0..QUALIFIED, ..] => decode_event(bytes),
        _ => Err(BadRecord),
    }
}

#[cold]
fn decode_event(bytes: &[u8]) -> Result<(Record, i64, &[u8]), BadRecord> {
    let (event, rest) = postcard::take_from_bytes::<Event>(bytes).map_err(|_| BadRecord)?;
    let (ticks, rest) = decode_ticks(rest)?;
    Ok((Record::Event(event), ticks, rest))
}

/// Reads a received frame after its header byte.
#[inline(always)]
#[allow(clippy::inline_always, reason = "the host's decoder is a third slower without")]
fn decode_frame(qualifiers: u8, header: u8, rest: &[u8]) -> Result<(Record, i64, &[u8]), BadRecord> {
    let stamp = match qualifiers & (UPPER_BOUND | NO_STAMP) {
        0 => Stamp::Exact,
        UPPER_BOUND => Stamp::UpperBound,
        NO_STAMP => Stamp::Omitted,
        _ => return Err(BadRecord),
    };
    let (id, rest) = take_id(header, rest)?;
    let (ticks, rest) = if stamp == Stamp::Omitted { (0, rest) } else { decode_ticks(rest)? };
    let remote = header & 0x10 != 0;
    let dlc = header & 15;
    let data_omitted = qualifiers & NO_DATA != 0;
    let data_len = if remote || data_omitted { 0 } else { dlc.min(8) as usize };
    let (data, rest) = take_data(data_len, rest).ok_or(BadRecord)?;
    let channel = if header & 0x40 == 0 { Channel::Can1 } else { Channel::Can2 };
    let frame = Frame::from_clean_parts(id, remote, dlc, data);
    Ok((Record::Received(Received { channel, frame, stamp, data_omitted }), ticks, rest))
}

/// What must be known about a record to pass it on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outline {
    /// Bytes of it.
    pub len: usize,
    /// Its time difference, in ticks.
    pub ticks: i64,
    /// Its channel, if it is a received frame.
    pub frame_of: Option<Channel>,
}

/// Finds a record's end without reading its contents, for the device, which packs what it wrote itself. Accepts
/// everything that [`decode`] accepts, and reports the same about it.
#[inline]
pub fn outline(bytes: &[u8]) -> Result<Outline, BadRecord> {
    // A received frame without qualifiers: nearly every record.
    if let [header @ FRAME..=u8::MAX, ref rest @ ..] = *bytes {
        let id_len = if header & 0x20 == 0 { 2 } else { 4 };
        let remote = header & 0x10 != 0;
        let data_len = if remote { 0 } else { usize::from(header & 15).min(8) };
        let channel = if header & 0x40 == 0 { Channel::Can1 } else { Channel::Can2 };
        let after_id = rest.get(id_len..).ok_or(BadRecord)?;
        let (ticks, after) = decode_ticks(after_id)?;
        let len = bytes.len() - after.len() + data_len;
        if len > bytes.len() {
            return Err(BadRecord);
        }
        return Ok(Outline { len, ticks, frame_of: Some(channel) });
    }
    // A confirmation: nearly everything else, while a host streams.
    if let [TRANSMITTED, 0 | 1, ref rest @ ..] = *bytes {
        let (_tag, rest) = take_u32(rest).ok_or(BadRecord)?;
        let (_id, rest) = take_u32(rest).ok_or(BadRecord)?;
        if let [_dlc, len @ 0..=8, ref rest @ ..] = *rest {
            let (ticks, after) = decode_ticks(rest.get(usize::from(len)..).ok_or(BadRecord)?)?;
            return Ok(Outline { len: bytes.len() - after.len(), ticks, frame_of: None });
        }
    }
    outline_by_decoding(bytes)
}

/// Out of line: a whole record, with room for 64 bytes of data, has no place in the loop that packs.
#[cold]
#[inline(never)]
fn outline_by_decoding(bytes: &[u8]) -> Result<Outline, BadRecord> {
    let (record, ticks, after) = decode(bytes)?;
    let frame_of = record.received_on();
    Ok(Outline { len: bytes.len() - after.len(), ticks, frame_of })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Id;
    use proptest::prelude::*;

    fn id() -> impl Strategy<Value = Id> {
        prop_oneof![
            (0..=Id::MAX_STANDARD).prop_map(|raw| Id::standard(raw).unwrap()),
            (0..=Id::MAX_EXTENDED).prop_map(|raw| Id::extended(raw).unwrap()),
        ]
    }

    fn received() -> impl Strategy<Value = Received> {
        let stamp = prop_oneof![Just(Stamp::Exact), Just(Stamp::UpperBound), Just(Stamp::Omitted)];
        (id(), any::<bool>(), any::<bool>(), 0..16u8, any::<[u8; 8]>(), stamp, any::<bool>()).prop_map(
            |(id, second, remote, dlc, data, stamp, data_omitted)| Received {
                channel: Channel::ALL[usize::from(second)],
                frame: Frame::from_bus(id, remote, dlc, if data_omitted { [0; 8] } else { data }),
                stamp,
                data_omitted,
            },
        )
    }

    proptest! {
        #[test]
        fn any_frame_round_trips(received in received(), ticks: i64, tail: Vec<u8>) {
            let mut out = [0; MAX_RECORD];
            let len = encode_received(&received, ticks, &mut out);
            prop_assert!(len <= MAX_FRAME_RECORD);
            let mut bytes = out[..len].to_vec();
            bytes.extend_from_slice(&tail);
            let ticks = if received.stamp == Stamp::Omitted { 0 } else { ticks };
            prop_assert_eq!(decode(&bytes), Ok((Record::Received(received), ticks, &tail[..])));
            prop_assert_eq!(outline(&bytes), Ok(Outline { len, ticks, frame_of: Some(received.channel) }));
        }

        #[test]
        fn a_confirmation_s_outline_says_what_decoding_says(
            received in received(),
            tag: u32,
            ticks: i64,
            tail: Vec<u8>,
        ) {
            let event = Event::Transmitted { channel: received.channel, tag, frame: received.frame };
            let mut out = [0; MAX_RECORD];
            let len = encode_event(&event, ticks, &mut out);
            let bytes = [&out[..len], &tail].concat();
            prop_assert_eq!(decode(&bytes), Ok((Record::Event(event), ticks, &tail[..])));
            prop_assert_eq!(outline(&bytes), Ok(Outline { len, ticks, frame_of: None }));
        }

        #[test]
        fn an_outline_says_what_decoding_says(bytes: Vec<u8>) {
            if let Ok((record, ticks, rest)) = decode(&bytes) {
                let frame_of = record.received_on();
                prop_assert_eq!(outline(&bytes), Ok(Outline { len: bytes.len() - rest.len(), ticks, frame_of }));
            } else if let Ok(outline) = outline(&bytes) {
                // It does not check whether an identifier is too large.
                prop_assert!(outline.len <= bytes.len());
            }
        }

        #[test]
        fn any_bytes_decode_or_are_refused(bytes: Vec<u8>) {
            if let Ok((_, _, rest)) = decode(&bytes) {
                prop_assert!(rest.len() < bytes.len());
            }
        }
    }

    #[test]
    fn the_longest_event_fits() {
        let frame = Frame::data_frame(Id::extended(Id::MAX_EXTENDED).unwrap(), &[0xFF; 8]).unwrap();
        let event = Event::Transmitted { channel: Channel::Can2, tag: u32::MAX, frame };
        let mut out = [0; MAX_RECORD];
        let len = encode_event(&event, i64::MIN, &mut out);
        assert_eq!(len, MAX_RECORD);
        assert_eq!(decode(&out), Ok((Record::Event(event), i64::MIN, &[][..])));
    }

    /// Records of a loaded bus are a few hundred ticks apart, and one of the other channel may be a little earlier.
    #[test]
    fn differences_of_every_length_round_trip_with_their_sign() {
        let event = Event::Started { channel: Channel::Can1 };
        let powers = (0..63).flat_map(|bit| [(1_i64 << bit) - 1, 1 << bit, (1 << bit) + 1]);
        for ticks in (-20_000..20_000)
            .chain(powers.clone())
            .chain(powers.map(|ticks| -ticks))
            .chain([i64::MIN, i64::MAX])
        {
            let mut out = [0; MAX_RECORD];
            let len = encode_event(&event, ticks, &mut out);
            assert_eq!(decode(&out[..len]), Ok((Record::Event(event), ticks, &[][..])));
            let mut by_postcard = [0; MAX_RECORD];
            assert_eq!(&out[2..len], &*postcard::to_slice(&ticks, &mut by_postcard).unwrap());
        }
    }

    #[test]
    fn a_qualifier_that_qualifies_nothing_or_is_not_known_is_refused() {
        let frame = [FRAME | 1, 0x23, 0x01, 0x00, 0xAA];
        assert!(decode(&frame).is_ok() && decode(&[&[QUALIFIED | UPPER_BOUND], &frame[..]].concat()).is_ok());
        for qualified in (QUALIFIED..fd::FD).filter(|first| !(fd::SENT..=fd::LAST_SENT).contains(first)) {
            let known = (QUALIFIED | 1..=QUALIFIED | 7).contains(&qualified) && qualified & 3 != 3;
            assert_eq!(decode(&[&[qualified], &frame[..]].concat()).is_ok(), known, "{qualified:02X}");
        }
    }
}
