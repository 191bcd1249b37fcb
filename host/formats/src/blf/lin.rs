//! LIN's objects in a BLF file: frames, and headers whose answer was missing or wrong. Others are counted.
//!
//! Layouts as in Tobias Lorenz's vector_blf (`LinMessage`, `LinCrcError`, `LinSendError`, `LinReceiveError`, and those of the same
//! names with a 2, which begin with the times of a frame's parts).

use cantap_trace::{Direction, LinFault, LinFrame, TraceEvent};

use super::super::issue::Fault;
use super::{DIRECTION, REQUESTED, SENT};

const MESSAGE: u32 = 11;
const CHECKSUM_ERROR: u32 = 12;
const RECEIVE_ERROR: u32 = 14;
const SEND_ERROR: u32 = 15;
const MESSAGE_2: u32 = 57;
const SEND_ERROR_2: u32 = 58;
const CHECKSUM_ERROR_2: u32 = 60;
const RECEIVE_ERROR_2: u32 = 61;

/// Where an object has its parts.
struct Layout {
    fault: Option<LinFault>,
    channel: usize,
    /// The identifier, then the length.
    id: usize,
    /// Eight bytes, then the checksum in a word, then the direction, the last two of them this far behind; none in an object without data.
    data: Option<(usize, usize)>,
}

const fn layout(kind: u32) -> Option<Layout> {
    let (fault, data) = match kind {
        MESSAGE => (None, Some((4, 16))),
        MESSAGE_2 => (None, Some((112, 120))),
        CHECKSUM_ERROR => (Some(LinFault::Checksum), Some((4, 16))),
        CHECKSUM_ERROR_2 => (Some(LinFault::Checksum), Some((112, 120))),
        SEND_ERROR | SEND_ERROR_2 => (Some(LinFault::NoResponse), None),
        // How many of its bytes came is not said.
        RECEIVE_ERROR | RECEIVE_ERROR_2 => (Some(LinFault::Response), None),
        _ => return None,
    };
    let (channel, id) = if kind < MESSAGE_2 { (0, 2) } else { (12, 37) };
    Some(Layout { fault, channel, id, data })
}

/// What an object's fields are: a channel and what happened there, or only the request to send a frame. `None` if it is no such object.
pub(super) fn event(kind: u32, fields: &[u8]) -> Option<Result<Option<(u8, TraceEvent)>, Fault>> {
    Some(read(&layout(kind)?, kind, fields))
}

fn read(layout: &Layout, kind: u32, fields: &[u8]) -> Result<Option<(u8, TraceEvent)>, Fault> {
    let need = layout.data.map_or(layout.id + 2, |(_, sum)| sum + 3);
    if fields.len() < need {
        let expected = format!("at least {need} bytes of fields in an object of type {kind}");
        return Err(Fault::malformed(expected, fields.len().to_string().as_bytes()));
    }
    let number = |at: usize| u16::from_le_bytes([fields[at], fields[at + 1]]);
    let channel = number(layout.channel);
    let channel = u8::try_from(channel)
        .map_err(|_| Fault::malformed("a channel of 0 to 255", channel.to_string().as_bytes()))?;
    let (id, len) = (fields[layout.id], fields[layout.id + 1]);
    let (mut data, mut checksum, mut direction) = (&[][..], None, Direction::Rx);
    if let Some((at, sum)) = layout.data {
        direction = match fields[sum + 2] & DIRECTION {
            SENT => Direction::Tx,
            REQUESTED => return Ok(None),
            _ => Direction::Rx,
        };
        data = fields[at..at + 8].get(..usize::from(len)).unwrap_or(&fields[at..]);
        checksum = u8::try_from(number(sum)).ok();
    }
    let frame = LinFrame::new(id, data).map(|frame| frame.with(checksum, layout.fault));
    let frame = frame.ok_or_else(|| {
        let found = format!("{id:X} with {len}");
        Fault::malformed("an identifier of LIN up to 3F with at most 8 bytes", found.as_bytes())
    })?;
    Ok(Some((channel, TraceEvent::Lin { frame, direction })))
}

/// The object for a frame, its type and its fields; `None` if there is none that says everything about it.
pub(super) fn object(channel: u8, frame: &LinFrame, direction: Direction) -> Option<(u32, [u8; 24])> {
    let kind = match frame.fault {
        None => MESSAGE,
        Some(LinFault::Checksum) => CHECKSUM_ERROR,
        Some(LinFault::NoResponse | LinFault::Response) => return None,
    };
    let mut fields = [0; 24];
    (fields[0], fields[2], fields[3]) = (channel, frame.id(), frame.data().len() as u8);
    fields[4..4 + frame.data().len()].copy_from_slice(frame.data());
    fields[16] = frame.checksum?;
    fields[18] = if direction == Direction::Tx { SENT } else { 0 };
    Some((kind, fields))
}
