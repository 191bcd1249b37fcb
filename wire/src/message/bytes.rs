//! Requests and answers as bytes, for where a value with room for the longest would have to be moved around, or cannot be built.

use heapless::Vec;

use super::{Filter, MAX_SEND, MAX_SEND_FD, Refusal, Reply, TxFrame};
use crate::Channel;
use crate::packed::{Packed, take_packed};
use crate::packed_fd::PackedFd;
use crate::varint::{take_u32, take_u64};

/// The index of [`super::Command::Send`], as in the pinned bytes.
const SEND: u32 = 6;

/// Reads a request that is a [`super::Command::Send`] into `frames`, which is empty, and returns its id and channel. `None` if it is
/// another request or cannot be read; `frames` is then meaningless.
///
/// A streaming host sends thousands of these a second: as a [`super::Request`], each would be moved around with room for the
/// longest command.
pub fn read_send(request: &[u8], frames: &mut Vec<TxFrame, MAX_SEND>) -> Option<(u16, Channel)> {
    let ((id, command), rest) = postcard::take_from_bytes::<(u16, u32)>(request).ok()?;
    if command != SEND {
        return None;
    }
    let ((channel, count), mut rest) = postcard::take_from_bytes::<(Channel, usize)>(rest).ok()?;
    for _ in 0..count {
        let (tag, behind) = take_u32(rest)?;
        let (frame, behind) = take_packed(behind)?;
        let (at_ticks, behind) = match *behind {
            [0, ref behind @ ..] => (None, behind),
            [1, ref behind @ ..] => take_u64(behind).map(|(at, behind)| (Some(at), behind))?,
            _ => return None,
        };
        frames.push(TxFrame { tag, frame, at_ticks }).ok()?;
        rest = behind;
    }
    Some((id, channel))
}

/// Writes a [`super::DeviceMessage::Response`] to `out` and returns its length, `None` if there is no room. The answer stays where
/// it is: moving it into a [`super::Response`] would copy room for the longest.
pub fn write_response(id: u16, result: &Result<Reply, Refusal>, out: &mut [u8]) -> Option<usize> {
    /// The variant's index, as in the pinned bytes.
    const RESPONSE: u32 = 1;
    postcard::to_slice(&(RESPONSE, id, result), out).ok().map(|written| written.len())
}

/// Why a request that arrived undamaged cannot be read: [`Refusal::BadId`] or [`Refusal::BadDlc`] if it carries an
/// impossible frame, otherwise [`Refusal::Malformed`].
pub fn why_unreadable(request: &[u8]) -> Refusal {
    // The indices of the other commands that carry frames, as the pinned bytes have them.
    const SET_PERIODIC: u32 = 8;
    const SET_TRIGGER: u32 = 9;
    const SEND_FD: u32 = 28;
    type Head = (u16, u32, Channel);
    let fault = || {
        let ((_, command, _), rest) = postcard::take_from_bytes::<Head>(request).ok()?;
        match command {
            SEND => {
                type Frames = Vec<(u32, Packed, Option<u64>), MAX_SEND>;
                let (frames, _) = postcard::take_from_bytes::<Frames>(rest).ok()?;
                frames.iter().find_map(|(_, frame, _)| frame.frame().err())
            }
            SEND_FD => {
                type Frames = Vec<(u32, PackedFd, Option<u64>), MAX_SEND_FD>;
                let (frames, _) = postcard::take_from_bytes::<Frames>(rest).ok()?;
                frames.iter().find_map(|(_, frame, _)| frame.frame().err())
            }
            SET_PERIODIC => postcard::take_from_bytes::<(u8, u8, Packed)>(rest).ok()?.0.2.frame().err(),
            SET_TRIGGER => {
                postcard::take_from_bytes::<(u8, u8, Filter, Packed)>(rest).ok()?.0.3.frame().err()
            }
            _ => None,
        }
    };
    fault().unwrap_or(Refusal::Malformed)
}
