//! The meaning of objects in a BLF file.

use cantap_can::BusErrorKind;
use cantap_can::{Frame, Id};

use super::super::bit_rates::{self, BitRates};
use super::super::event_text;
use super::super::issue::Fault;
use super::super::sja1000;
use super::kinds::{group, is_bookkeeping};
use super::lin;
use super::{
    CAN_ERROR, CAN_ERROR_EXT, CAN_FD_ERROR_64, CAN_FD_MESSAGE, CAN_FD_MESSAGE_64, CAN_MESSAGE, CAN_MESSAGE2,
    DATA_LOST_END, DIRECTION, EVENT_COMMENT, EXTENDED, FD_FORMAT, FD_PASSIVE_SENDER, FD_SWITCHED_BIT_RATE,
    FD64_FORMAT, FD64_PASSIVE_SENDER, FD64_REMOTE, FD64_SWITCHED_BIT_RATE, HAS_SJA1000_CODE, OWN_MARK,
    REMOTE, REQUESTED, SENT,
};
use cantap_trace::counted;
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame};

/// The numbers of [`OWN_MARK`]'s kinds, from 1.
pub(crate) const KINDS: [BusErrorKind; 6] = [
    BusErrorKind::Stuff,
    BusErrorKind::Form,
    BusErrorKind::Acknowledgment,
    BusErrorKind::BitRecessive,
    BusErrorKind::BitDominant,
    BusErrorKind::Crc,
];

#[inline]
pub(super) fn u16_at(bytes: &[u8], at: usize) -> u16 {
    bytes.get(at..at + 2).map_or(0, |field| u16::from_le_bytes([field[0], field[1]]))
}

#[inline]
pub(super) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |field| u32::from_le_bytes(*field))
}

#[inline]
pub(super) fn u64_at(bytes: &[u8], at: usize) -> u64 {
    bytes.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |field| u64::from_le_bytes(*field))
}

/// The meaning of an object's fields.
pub(super) enum Content {
    /// A channel and what happened there.
    Event(u8, TraceEvent),
    /// What a comment says of the channels' bit rates.
    BitRates(BitRates),
    /// Only the request to send a frame.
    Request,
    /// Something that a CAN trace does not hold, by kind.
    LeftOut(&'static str),
    /// Something that nobody would miss.
    Other,
}

#[inline]
pub(super) fn event(kind: u32, fields: &[u8], loss_told: bool) -> Result<Content, Fault> {
    let need = |len: usize| {
        let found = fields.len();
        if found >= len {
            return Ok(());
        }
        let expected =
            format!("at least {len} of fields in an object of type {kind}", len = counted(len, "byte"));
        Err(Fault::malformed(expected, counted(found, "byte").as_bytes()))
    };
    let channel = || {
        let channel = u16_at(fields, 0);
        u8::try_from(channel)
            .map_err(|_| Fault::malformed("a channel of 0 to 255", channel.to_string().as_bytes()))
    };
    let unknown_error = TraceEvent::BusError { kind: None, counters: None };
    let on = |channel| {
        move |event: Option<_>| event.map_or(Content::Request, |event| Content::Event(channel, event))
    };
    Ok(match kind {
        CAN_MESSAGE | CAN_MESSAGE2 => {
            need(16)?;
            frame(fields[2], fields[3], u32_at(fields, 4), &fields[8..16]).map(on(channel()?))?
        }
        CAN_FD_MESSAGE => {
            need(28)?;
            let (flags, dlc, id) = (fields[2], fields[3], u32_at(fields, 4));
            let has = |flag| fields[13] & flag != 0;
            if has(FD_FORMAT) {
                let (brs, esi) = (has(FD_SWITCHED_BIT_RATE), has(FD_PASSIVE_SENDER));
                fd_frame(flags, dlc, id, brs, esi, valid(&fields[20..], fields[14])).map(on(channel()?))?
            } else {
                frame(flags, dlc, id, &fields[20..28]).map(on(channel()?))?
            }
        }
        CAN_FD_MESSAGE_64 => {
            need(40)?;
            let (dlc, id) = (fields[1], u32_at(fields, 4));
            let has = |flag| u32_at(fields, 12) & flag != 0;
            let direction = fields[34] & DIRECTION;
            let data = valid(&fields[40..], fields[2]);
            if has(FD64_FORMAT) {
                let (brs, esi) = (has(FD64_SWITCHED_BIT_RATE), has(FD64_PASSIVE_SENDER));
                fd_frame(direction, dlc, id, brs, esi, data).map(on(fields[0]))?
            } else {
                let remote = if has(FD64_REMOTE) { REMOTE } else { 0 };
                frame(remote | direction, dlc, id, data).map(on(fields[0]))?
            }
        }
        CAN_ERROR => Content::Event(channel()?, unknown_error),
        CAN_FD_ERROR_64 => Content::Event(fields.first().copied().unwrap_or_default(), unknown_error),
        CAN_ERROR_EXT => {
            need(32)?;
            Content::Event(channel()?, error_ext(fields))
        }
        DATA_LOST_END if !loss_told => {
            need(16)?;
            let count = u32_at(fields, 12);
            let lost = TraceEvent::Lost { stage: None, count: count.max(1), at_least: count == 0 };
            Content::Event(1, lost)
        }
        EVENT_COMMENT => {
            let len = u32_at(fields, 4) as usize;
            let text = fields.get(16..).unwrap_or_default();
            let text = &text[..text.len().min(len)];
            let mut rates = BitRates::new();
            if bit_rates::learn_note(&mut rates, text) {
                return Ok(Content::BitRates(rates));
            }
            let channel = text.strip_prefix(b"CAN ").and_then(|rest| {
                let (number, _) = super::super::text::word(rest);
                u8::try_from(super::super::text::decimal(number)?).ok()
            });
            let event = channel.zip(event_text::marked(text));
            event.map_or(Content::LeftOut(group(kind)), |(channel, event)| Content::Event(channel, event))
        }
        DATA_LOST_END => Content::Other,
        _ if let Some(found) = lin::event(kind, fields) => {
            found?.map_or(Content::Request, |(channel, event)| Content::Event(channel, event))
        }
        _ if is_bookkeeping(kind) => Content::Other,
        _ => Content::LeftOut(group(kind)),
    })
}

/// The first `len` bytes. If there are fewer, the missing ones are zero.
fn valid(data: &[u8], len: u8) -> &[u8] {
    &data[..data.len().min(usize::from(len))]
}

/// A frame's direction; `None` if it is only the request to send one.
#[inline]
fn direction(flags: u8) -> Option<Direction> {
    match flags & DIRECTION {
        SENT => Some(Direction::Tx),
        REQUESTED => None,
        _ => Some(Direction::Rx),
    }
}

/// A frame's identifier and length code, checked.
#[inline]
fn id_and_dlc(id: u32, dlc: u8) -> Result<Id, Fault> {
    let raw = id & !EXTENDED;
    let parsed = if id & EXTENDED != 0 { Id::extended(raw) } else { Id::standard(raw) };
    let fault =
        |expected: &'static str, found: u32| Fault::malformed(expected, format!("{found:#x}").as_bytes());
    let parsed = parsed.ok_or_else(|| fault("an identifier up to 0x7ff, or up to 0x1fffffff", id))?;
    if dlc > 15 {
        return Err(fault("a data length code of 0 to 0xf", u32::from(dlc)));
    }
    Ok(parsed)
}

/// A CAN FD frame; `None` if it is only the request to send one.
fn fd_frame(
    flags: u8,
    dlc: u8,
    id: u32,
    brs: bool,
    esi: bool,
    data: &[u8],
) -> Result<Option<TraceEvent>, Fault> {
    let Some(direction) = direction(flags) else { return Ok(None) };
    let id = id_and_dlc(id, dlc)?;
    let mut bytes = [0; FD_MAX_BYTES];
    let len = usize::from(FD_LENGTHS[usize::from(dlc)]);
    let present = data.len().min(len);
    bytes[..present].copy_from_slice(&data[..present]);
    let frame = FdFrame::new(id, brs, esi, &bytes[..len]);
    Ok(frame.map(|frame| TraceEvent::Frame { frame: TraceFrame::Fd(frame), direction, late: false }))
}

/// A classical frame; `None` if it is only the request to send one.
#[inline]
fn frame(flags: u8, dlc: u8, id: u32, data: &[u8]) -> Result<Option<TraceEvent>, Fault> {
    let Some(direction) = direction(flags) else { return Ok(None) };
    let parsed = id_and_dlc(id, dlc)?;
    let mut bytes = [0; 8];
    let len = data.len().min(8);
    bytes[..len].copy_from_slice(&data[..len]);
    let frame = Frame::from_bus(parsed, flags & REMOTE != 0, dlc, bytes);
    Ok(Some(TraceEvent::Frame { frame: frame.into(), direction, late: false }))
}

/// An error object: exact for our own, for others as far as the controller's code says.
fn error_ext(fields: &[u8]) -> TraceEvent {
    if fields[10] == 0 && fields[24] == OWN_MARK {
        let kind = fields[25].checked_sub(1).and_then(|at| KINDS.get(usize::from(at)).copied());
        let counters = (fields[26] != 0).then_some((fields[27], fields[28]));
        return TraceEvent::BusError { kind, counters };
    }
    let has_code = u32_at(fields, 4) & HAS_SJA1000_CODE != 0;
    let kind = if has_code { sja1000::kind(fields[8]) } else { extended_code(u16_at(fields, 20)) };
    TraceEvent::BusError { kind, counters: None }
}

/// The kind in bits 6 to 11 of an error object's extended flags, as Vector's interfaces report it.
fn extended_code(flags: u16) -> Option<BusErrorKind> {
    match flags >> 6 & 0x3F {
        1 => Some(BusErrorKind::Form),
        2 => Some(BusErrorKind::Stuff),
        4 => Some(BusErrorKind::Crc),
        5 | 7 => Some(BusErrorKind::Acknowledgment),
        _ => None,
    }
}
