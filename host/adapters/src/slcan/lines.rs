//! The lines of slcan for frames.

use std::fmt::Write;

use cantap_wire::Frame;

/// A frame as a command.
pub(super) fn line_of(frame: &Frame) -> Vec<u8> {
    let id = frame.id();
    let kind = match (id.is_extended(), frame.is_remote()) {
        (false, false) => 't',
        (true, false) => 'T',
        (false, true) => 'r',
        (true, true) => 'R',
    };
    let width = if id.is_extended() { 8 } else { 3 };
    let mut line = format!("{kind}{:0width$X}{:X}", id.raw(), frame.dlc().min(8));
    for byte in frame.data() {
        // Writing to a text cannot fail.
        let _ = write!(line, "{byte:02X}");
    }
    line.push('\r');
    line.into_bytes()
}
