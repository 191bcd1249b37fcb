//! How comma.ai's panda numbers buses, in openpilot's logs and in Cabana's tables.
//!
//! Source: openpilot's `panda.h`, `CAN_RETURNED_BUS_OFFSET` and `CAN_REJECTED_BUS_OFFSET`.

use cantap_trace::Direction;

pub(crate) const REJECTED: &str = "frames that the panda was asked to send and rejected";

/// The channel and direction of a bus's number; `None` if the frame was not sent.
pub(crate) fn bus(number: u8) -> Option<(u8, Direction)> {
    const RETURNED: u8 = 0x80;
    const REJECTED_FROM: u8 = 0xC0;
    match number {
        REJECTED_FROM.. => None,
        RETURNED.. => Some((number - RETURNED + 1, Direction::Tx)),
        _ => Some((number + 1, Direction::Rx)),
    }
}
