//! Other content of ASC files: other buses, and messages of the measuring program. Everything known is counted by kind;
//! everything unknown is an issue, for it may be a frame on a damaged line.

use super::super::issue::Fault;
use super::super::text;
use super::content::{Content, OnChannel};

/// Events by the word after their time.
const KINDS: [(&[&str], &str); 10] = [
    (&["ETH"], "Ethernet frames and events"),
    (&["Fr", "FR", "FlexRay"], "FlexRay frames and events"),
    (&["SV:", "EV:"], "environment and system variables"),
    (&["CANXL"], "CAN XL frames"),
    (&["Comment:", "Comment", "GMARKER", "AMARKER", "Marker"], "comments and texts"),
    (&["log", "Log", "trigger", "Trigger"], "triggers and markers"),
    (&["TFS:", "Diag", "DIAG"], "diagnostics and tests"),
    (&["J1587", "J1708"], "J1708 frames"),
    (&["AFDX", "A429"], "AFDX and ARINC 429 frames and events"),
    (&["WLAN", "GPS", "GPS:", "GPS-Device:"], "WLAN and GPS events"),
];

/// Classifies a line, after its time, that belongs to no CAN channel.
pub(super) fn kind(line: &[u8]) -> Result<Content, Fault> {
    let (first, rest) = text::word(line);
    if line.to_ascii_lowercase().starts_with(b"start of measurement") {
        return Ok(Content::Other);
    }
    if first.starts_with(b"//") {
        return Ok(Content::LeftOut("comments and texts"));
    }
    if let Some((_, what)) =
        KINDS.iter().find(|(words, _)| words.iter().any(|known| known.as_bytes() == first))
    {
        return Ok(Content::LeftOut(what));
    }
    // MOST channels have their number after the letters.
    let numbered = |letters: &[u8]| {
        let number = first.strip_prefix(letters);
        number.is_some_and(|number| !number.is_empty() && number.iter().all(u8::is_ascii_digit))
    };
    if first.starts_with(b"MOST") || numbered(b"M") {
        return Ok(Content::LeftOut("MOST frames and events"));
    }
    if numbered(b"COM") {
        return Ok(Content::LeftOut("serial port events"));
    }
    // `name := value`.
    if text::word(rest).0 == b":=" {
        return Ok(Content::LeftOut("environment and system variables"));
    }
    let expected = "a channel of 0 to 255, CAN, CANFD, or another event of ASC after the time";
    Err(Fault::malformed(expected, line))
}

/// What a line is that looks like one on a CAN channel until after the identifier, if it is known: a marker has numbers there.
pub(super) fn like_a_frame(rest: &[u8]) -> Option<&'static str> {
    memchr::memmem::find(rest, b" GMGroup:").map(|_| "triggers and markers")
}

/// A line on a CAN channel that is neither a frame nor an error: `word` is in the identifier's place.
pub(super) fn on_channel(word: &[u8]) -> Result<OnChannel, Fault> {
    Ok(OnChannel::LeftOut(match word {
        b"Statistic:" | b"Statistic" => "CAN statistics",
        b"OverloadFrame" => "CAN overload frames",
        b"J1939TP" => "J1939 transport events, made of frames that are in the trace",
        _ => {
            return Err(Fault::malformed(
                "an identifier in hexadecimal digits (decimal with base dec)",
                word,
            ));
        }
    }))
}
