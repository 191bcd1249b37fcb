//! Identifiers as the controller's registers hold them.

use cantap_can::Frame;

/// A frame's identifier as TIxR and RIxR hold it: STID or EXID, IDE, RTR.
pub fn identifier_word(frame: &Frame) -> u32 {
    let id = frame.id();
    let identifier = if id.is_extended() { id.raw() << 3 | 1 << 2 } else { id.raw() << 21 };
    identifier | u32::from(frame.is_remote()) << 1
}
