//! ResponseOnEvent: the content of its requests and responses, by event. The fields are those of the
//! Python package py-uds, with which a test compares them.

use super::cursor::Cursor;
use super::names;
use super::obd_identifiers::data_identifier;
use crate::Field;

/// The bits of the sub-function that are the event, without whether it is stored.
const EVENT: u8 = 0x3F;
const REPORT_ACTIVATED: u8 = 4;

/// The content of a request after the sub-function.
pub fn request(sub: u8, cursor: &mut Cursor<'_, '_>) -> Option<()> {
    cursor.byte("event_window", window)?;
    record(sub & EVENT, cursor)
}

/// The content of a positive response after the sub-function. Anything repeated from a request that was `heard` is left out.
pub fn response(heard: bool, sub: u8, cursor: &mut Cursor<'_, '_>) -> Option<()> {
    if sub & EVENT == REPORT_ACTIVATED {
        return cursor.number("activated_events", 1, "");
    }
    cursor.number("identified_events", 1, "")?;
    if heard {
        cursor.skip();
        return Some(());
    }
    request(sub, cursor)
}

/// What the event is about, and the request that the server carries out when it happens.
fn record(event: u8, cursor: &mut Cursor<'_, '_>) -> Option<()> {
    match event {
        0x01 => cursor.hex("status_mask", 1).map(drop)?,
        0x02 => cursor
            .byte("schedule", |rate| {
                ["slow", "medium", "fast"].get(usize::from(rate).wrapping_sub(1)).copied()
            })
            .map(drop)?,
        0x03 => did(cursor)?,
        0x07 => {
            did(cursor)?;
            let logic = ["less", "greater", "equal", "not equal"];
            cursor.byte("comparison", |byte| logic.get(usize::from(byte).wrapping_sub(1)).copied())?;
            cursor.hex("compared_with", 4)?;
            cursor.hex("hysteresis", 1)?;
            cursor.hex("localization", 2)?;
        }
        0x08 | 0x09 => cursor.byte("report", |report| names::sub_function(0x19, report)).map(drop)?,
        _ => return None,
    }
    if matches!(event, 0x01..=0x03 | 0x07) && cursor.left() > 0 {
        cursor.byte("response_service", names::uds_service)?;
    }
    Some(())
}

fn did(cursor: &mut Cursor<'_, '_>) -> Option<()> {
    let did = cursor.take(2)?;
    let did = u16::from_be_bytes([did[0], did[1]]);
    cursor.push(Field::hex("did", did, 4).meaning(data_identifier(did)));
    Some(())
}

/// How long the server watches for the event.
fn window(byte: u8) -> Option<&'static str> {
    Some(match byte {
        2 => "infinite",
        3 => "short",
        4 => "medium",
        5 => "long",
        6 => "power window",
        7 => "ignition window",
        8 => "triggered by the manufacturer's event",
        _ => return None,
    })
}
