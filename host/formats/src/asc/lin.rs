//! Lines of LIN channels in ASC: frames, and headers whose answer was missing or wrong. Other LIN events are counted.
//!
//! The forms of the lines are those of Tobias Lorenz's vector_asc (`LinMessage`, `LinChecksumError`, `LinTransmissionError`,
//! `LinReceiveError`).

use cantap_trace::{Direction, LinFault, LinFrame, TraceEvent};

use super::super::codec::OTHER_LIN;
use super::super::event_text;
use super::super::issue::Fault;
use super::super::text;
use super::content::{OnChannel, direction};

const NO_RESPONSE: &str = "TransmErr";
const WRONG_RESPONSE: &str = "RcvError:";
const WRONG_CHECKSUM: &str = "CSErr";

/// The number of a LIN channel: `Li` is 1, `L2` is 2; some programs write `LIN2`.
pub(super) fn channel(word: &[u8]) -> Option<u8> {
    let number = [&b"LIN"[..], b"Li", b"L"].iter().find_map(|letters| word.strip_prefix(*letters))?;
    if number.is_empty() {
        return (word == b"Li").then_some(1);
    }
    text::decimal(number).and_then(|number| u8::try_from(number).ok())
}

/// A line after its channel. `identifier` and `byte` read numbers in the file's base.
pub(super) fn line(
    rest: &[u8],
    identifier: impl Fn(&[u8]) -> Option<u32>,
    byte: impl Fn(&[u8]) -> Option<u8>,
) -> Result<OnChannel, Fault> {
    if let Some(event) = event_text::marked(rest) {
        return Ok(OnChannel::Event(event));
    }
    let (word, rest) = text::word(rest);
    let Some(raw) = identifier(word) else { return Ok(OnChannel::LeftOut(OTHER_LIN)) };
    let id = u8::try_from(raw).ok().filter(|id| *id <= LinFrame::MAX_ID);
    let id = id.ok_or_else(|| Fault::malformed("an identifier of LIN up to 3F", word))?;
    let frame = |data: &[u8], fault| {
        let frame = LinFrame::new(id, data).map(|frame| frame.with(None, fault));
        frame.ok_or_else(|| Fault::malformed("up to 8 data bytes", data.len().to_string().as_bytes()))
    };
    let received = |frame| OnChannel::Event(TraceEvent::Lin { frame, direction: Direction::Rx });
    let (word, behind) = text::word(rest);
    if word == NO_RESPONSE.as_bytes() {
        return Ok(received(frame(&[], Some(LinFault::NoResponse))?));
    }
    if text::word(behind).0 == WRONG_RESPONSE.as_bytes() {
        // Whatever came of the response.
        let came = memchr::memmem::find(behind, b"HasDatabytes = 1").map(|at| &behind[at + 16..]);
        let bytes = came.unwrap_or_default().split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let data: Vec<u8> = bytes.map_while(&byte).take(8).collect();
        return Ok(received(frame(&data, Some(LinFault::Response))?));
    }
    let (fault, way, behind) = if word == WRONG_CHECKSUM.as_bytes() {
        let (way, behind) = text::word(behind);
        (Some(LinFault::Checksum), way, behind)
    } else {
        (None, word, behind)
    };
    let direction = match way {
        b"TxRq" => return Ok(OnChannel::Request),
        way => match direction(way) {
            Some(direction) => direction,
            // A name such as that of a change of the schedule may be hexadecimal digits.
            None => return Ok(OnChannel::LeftOut(OTHER_LIN)),
        },
    };
    let (len, mut rest) = text::word(behind);
    let number = text::decimal(len).filter(|len| *len <= 8);
    let number = number.ok_or_else(|| Fault::malformed("a number of up to 8 data bytes", len))?;
    let mut data = Vec::with_capacity(8);
    for _ in 0..number {
        let (word, behind) = text::word(rest);
        data.push(byte(word).ok_or_else(|| Fault::malformed(format!("{number} data bytes"), word))?);
        rest = behind;
    }
    let frame = frame(&data, fault)?.with(checksum(rest, byte), fault);
    Ok(OnChannel::Event(TraceEvent::Lin { frame, direction }))
}

/// The checksum behind the data.
fn checksum(rest: &[u8], byte: impl Fn(&[u8]) -> Option<u8>) -> Option<u8> {
    const MARK: &[u8] = b"checksum = ";
    let at = memchr::memmem::find(rest, MARK)?;
    let digits = text::word(&rest[at + MARK.len()..]).0;
    byte(digits).or_else(|| text::hex(digits).and_then(|sum| u8::try_from(sum).ok()))
}

/// Writes what follows the time of a LIN frame; what its line has no form for stands in a comment.
pub(super) fn push(out: &mut Vec<u8>, channel: u8, frame: &LinFrame, direction: Direction) {
    let name = if channel == 1 { "Li".to_owned() } else { format!("L{channel}") };
    let way = if direction == Direction::Tx { "Tx" } else { "Rx" };
    out.extend_from_slice(format!("{name:<4} {:<14x} ", frame.id()).as_bytes());
    match frame.fault {
        None => out.extend_from_slice(format!("{way:<6} {}", frame.data().len()).as_bytes()),
        Some(LinFault::Checksum) => {
            out.extend_from_slice(format!("{WRONG_CHECKSUM} {way} {}", frame.data().len()).as_bytes());
        }
        Some(LinFault::NoResponse) => out.extend_from_slice(NO_RESPONSE.as_bytes()),
        Some(LinFault::Response) => {
            out.extend_from_slice(format!("{} {WRONG_RESPONSE}", frame.data().len()).as_bytes());
        }
    }
    if matches!(frame.fault, Some(LinFault::NoResponse | LinFault::Response)) {
        out.extend_from_slice(b"  // ");
        event_text::push_marked(out, &TraceEvent::Lin { frame: *frame, direction });
        return;
    }
    for byte in frame.data() {
        out.push(b' ');
        text::push_hex_byte(out, *byte);
    }
    if let Some(sum) = frame.checksum {
        out.extend_from_slice(format!("  checksum = {sum:02x}").as_bytes());
    }
}
