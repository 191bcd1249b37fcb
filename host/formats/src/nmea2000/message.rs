//! What a line of a gateway says: a message, or a frame of one.

use super::super::frame_fields::Payload;
use cantap_trace::Direction;

/// When a message was on the bus.
#[derive(Clone, Copy)]
pub(super) enum Time<'a> {
    OfDay(i64),
    /// With a date, to be read only if the line is a frame's.
    Date(&'a [u8]),
    /// Nanoseconds since the gateway started.
    Ns(i64),
    /// The stamp of `$PCDIN`.
    Ticks(&'a [u8]),
    Unknown,
}

/// What a line is of.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// A frame.
    Frame,
    /// A frame, unless others in the file were put together.
    FrameIfAll,
    /// A message, of one frame or of several.
    Message,
}

/// The fields of a line.
pub(super) struct Message<'a> {
    pub time: Time<'a>,
    pub direction: Direction,
    /// The identifier of 29 bits; `None` if the group is not one of NMEA 2000, but a gateway's own.
    pub id: Option<u32>,
    pub data: Payload,
    /// How many bytes there are, which may be more than a frame has.
    pub len: usize,
    pub form: Form,
}

/// Whether the messages of a group have a destination: of those below F0 in their second byte (SAE J1939-21).
pub(super) const fn is_addressed(group: u32) -> bool {
    group >> 8 & 0xFF < 0xF0
}

/// The identifier of a message's frames.
pub(crate) fn id(priority: u32, group: u32, source: u32, destination: u32) -> Option<u32> {
    let is_of_bus = priority <= 7 && group <= 0x3_FFFF && !(is_addressed(group) && group & 0xFF != 0);
    let low = if is_addressed(group) { destination << 8 } else { 0 };
    is_of_bus.then_some(priority << 26 | group << 8 | low | source)
}
