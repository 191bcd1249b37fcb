//! What a line means that an ELM327 or an STN chip prints while it monitors a bus.

use cantap_wire::{Frame, Id};

use crate::text_lines::hex;

/// The meaning of a line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Content {
    /// A frame as it was on the bus.
    Frame(Frame),
    /// A frame that the chip itself marks as damaged (`<DATA ERROR`): its bytes are not to be believed.
    Damaged,
    /// Something on the bus that was no frame (`<RX ERROR`): a bit error, or the wrong bit rate.
    BusError,
    /// The chip's buffer ran over (`BUFFER FULL`), and it stops monitoring.
    BufferFull,
    /// The bus cannot be used (`CAN ERROR`, `UNABLE TO CONNECT` and others), and the chip stops monitoring.
    Unusable(&'static str),
    /// It stops monitoring because a byte reached it.
    Stopped,
    /// It has started again, with none of the settings that it was given.
    Restarted(&'static str),
    /// The command was not understood.
    Refused,
    /// `OK`, nothing, or what it prints on its way to monitoring.
    Nothing,
    /// Nothing of this.
    Unreadable,
}

/// Messages that end monitoring because of the bus (ELM327 data sheet, "Error Messages and Alerts"), and those of the STN family.
const UNUSABLE: [&str; 9] = [
    "CAN ERROR",
    "UNABLE TO CONNECT",
    "BUS ERROR",
    "BUS BUSY",
    "FB ERROR",
    "DATA ERROR",
    "NO DATA",
    "ACT ALERT",
    "OUT OF MEMORY",
];
/// Messages of a chip that has started, or is about to.
const RESTARTS: [&str; 4] = ["ELM32", "LV RESET", "LP ALERT", "ERR"];
/// Words that come before monitoring.
const PREPARATION: [&str; 3] = ["SEARCHING", "BUS INIT", "OK"];

/// Reads a line. `has_dlc`: each frame's data length code is between its identifier and its data (`ATD1`).
pub(super) fn read(line: &[u8], has_dlc: bool) -> Content {
    // A chip may print spaces, although it was told not to.
    let compact: Vec<u8> = line.iter().copied().filter(|byte| *byte != b' ').collect();
    if compact.is_empty() {
        return Content::Nothing;
    }
    if let Some(frame) = frame(&compact, has_dlc) {
        return Content::Frame(frame);
    }
    let text = String::from_utf8_lossy(line);
    let text = text.trim().trim_start_matches('!');
    let found = |words: &'static [&'static str]| words.iter().find(|word| text.starts_with(**word)).copied();
    if text == "?" {
        Content::Refused
    } else if text.ends_with("BUFFER FULL") {
        // What is before it is a frame's beginning at most.
        Content::BufferFull
    } else if text.ends_with("<DATA ERROR") {
        Content::Damaged
    } else if text.ends_with("<RX ERROR") {
        Content::BusError
    } else if text.starts_with("STOPPED") {
        Content::Stopped
    } else if let Some(word) = found(&RESTARTS) {
        Content::Restarted(word)
    } else if let Some(word) = found(&UNUSABLE) {
        Content::Unusable(word)
    } else if found(&PREPARATION).is_some() {
        Content::Nothing
    } else {
        Content::Unreadable
    }
}

/// A frame: three digits of a standard identifier, or eight of an extended one, and then two for each byte. An identifier's length is known by
/// whether the number of digits is odd.
fn frame(digits: &[u8], has_dlc: bool) -> Option<Frame> {
    let (digits, is_remote) = digits.strip_suffix(b"RTR").map_or((digits, false), |digits| (digits, true));
    // A remote frame has no data, and with or without a code no other length is possible.
    let (id_len, dlc_len) = match (is_remote, digits.len()) {
        (true, 3) => (3, 0),
        (true, 4) => (3, 1),
        (true, 8) => (8, 0),
        (true, 9) => (8, 1),
        (true, _) => return None,
        (false, len) => (if (len % 2 == 1) == has_dlc { 8 } else { 3 }, usize::from(has_dlc)),
    };
    let (id, rest) = digits.split_at_checked(id_len)?;
    let (dlc, data) = rest.split_at_checked(dlc_len)?;
    let raw = hex(id)?;
    let id = if id_len == 3 { Id::standard(raw) } else { Id::extended(raw) }?;
    let bytes = data.len() / 2;
    let dlc = if dlc.is_empty() { u8::try_from(bytes).ok()? } else { hex(dlc)? as u8 };
    // A code of 9 to 15 means eight bytes, too.
    if bytes > 8 || !is_remote && bytes != usize::from(dlc.min(8)) {
        return None;
    }
    let mut payload = [0; 8];
    for (byte, digits) in payload.iter_mut().zip(data.chunks(2)) {
        *byte = hex(digits)? as u8;
    }
    Some(Frame::from_bus(id, is_remote, dlc, payload))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn read_text(line: &str, has_dlc: bool) -> Content {
        read(line.as_bytes(), has_dlc)
    }

    fn frame_of(text: &str) -> Content {
        Content::Frame(text.parse().unwrap())
    }

    #[test]
    fn frames_are_read_with_and_without_spaces_and_length_codes() {
        for (line, text) in [
            ("7E8064100BE3EA813", "7E8#064100BE3EA813"),
            ("7E8 06 41 00 ", "7E8#064100"),
            ("18DAF110064100", "18DAF110#064100"),
            ("18 DA F1 10 06", "18DAF110#06"),
            ("123", "123#"),
            ("12345678", "12345678#"),
            ("123 RTR", "123#R"),
            ("12345678RTR", "12345678#R"),
        ] {
            assert_eq!(read_text(line, false), frame_of(text), "{line}");
        }
        for (line, text) in [
            ("1232DEAD", "123#DEAD"),
            ("1230", "123#"),
            ("18DAF1101AA", "18DAF110#AA"),
            ("123456780", "12345678#"),
            ("1234RTR", "123#R4"),
        ] {
            assert_eq!(read_text(line, true), frame_of(text), "{line}");
        }
    }

    #[test]
    fn what_lies_about_its_length_or_identifier_is_no_frame() {
        for line in [
            "800",
            "7E80",
            "FFFFFFFF",
            "7E8064100BE3EA8130000",
            "7E8G6",
            "1",
            "12",
            "RTR",
            "12RTR",
            "12301RTR",
        ] {
            assert_eq!(read_text(line, false), Content::Unreadable, "{line}");
        }
        for line in ["1233DEAD", "1231DEAD", "123", "18DAF1102AA", "800100", "1238112233445566778899"] {
            assert_eq!(read_text(line, true), Content::Unreadable, "{line}");
        }
    }

    #[test]
    fn messages_are_known_and_half_a_frame_before_one_is_none() {
        for (line, content) in [
            ("BUFFER FULL", Content::BufferFull),
            ("7E8064BUFFER FULL", Content::BufferFull),
            ("7E8 06 41 <DATA ERROR", Content::Damaged),
            ("7E806<RX ERROR", Content::BusError),
            ("CAN ERROR", Content::Unusable("CAN ERROR")),
            ("UNABLE TO CONNECT", Content::Unusable("UNABLE TO CONNECT")),
            ("STOPPED", Content::Stopped),
            ("?", Content::Refused),
            ("!LP ALERT", Content::Restarted("LP ALERT")),
            ("ERR94", Content::Restarted("ERR")),
            ("ELM327 v1.5", Content::Restarted("ELM32")),
            ("SEARCHING...", Content::Nothing),
            ("", Content::Nothing),
            ("hello", Content::Unreadable),
        ] {
            assert_eq!(read_text(line, false), content, "{line}");
        }
    }

    proptest! {
        /// Whatever arrives is read without a panic, and no frame is longer than its line.
        #[test]
        fn any_bytes_are_read(line in proptest::collection::vec(any::<u8>(), 0..140), has_dlc: bool) {
            if let Content::Frame(frame) = read(&line, has_dlc) {
                prop_assert!(frame.data().len() * 2 + 3 <= line.len());
            }
        }
    }
}
