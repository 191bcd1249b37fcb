//! The log of ESPHome's component `canbus`: `[12:34:56][D][canbus:070]: received can message (#1) std can_id=0x305 size=8`, and below it, at the
//! level VERBOSE, a line for each byte. At the level DEBUG the log has no bytes: such frames are counted.
//!
//! Source: `esphome/components/canbus/canbus.cpp` of ESPHome.

use super::frame_fields::{FrameFields, Payload, hex_byte, identifier};
use super::issue::Fault;
use super::line_clock::LineClock;
use super::row_format::{Line, RowFormat};
use super::text;
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord};

const NO_BYTES: &str = "frames without their bytes, which ESPHome logs with `logger: level: VERBOSE` (sent ones with VERY_VERBOSE)";
const OTHERS: &str = "lines of other components";

/// Reads a log.
#[derive(Default)]
pub(crate) struct Decoder {
    clock: LineClock,
    open: Option<Open>,
    /// Frames that ended without their bytes, to be reported.
    without_bytes: u64,
    /// Whether there was a line of the component.
    has_lines: bool,
}

/// A frame whose bytes are in the next lines.
struct Open {
    fields: FrameFields,
    time_ns: i64,
    bytes: Vec<u8>,
}

/// What the component says in a line, behind its name; `None` in lines of others.
fn message_of(line: &[u8]) -> Option<&[u8]> {
    let at = memchr::memmem::find(line, b"[canbus:")?;
    let rest = &line[at..];
    let end = memchr::memmem::find(rest, b"]:")?;
    // Colours end with the line.
    let text = &rest[end + 2..];
    let end = memchr::memchr(0x1B, text).unwrap_or(text.len());
    Some(text[..end].trim_ascii())
}

/// Whether a file has such lines near its beginning, below what ESPHome says when it starts.
pub(crate) fn is_head(head: &[u8]) -> bool {
    head.split(|byte| *byte == b'\n').filter_map(message_of).any(|text| matches!(fields(text), Some(Ok(_))))
}

/// The frame that a line announces.
fn fields(text: &[u8]) -> Option<Result<FrameFields, Fault>> {
    let (direction, rest) = if let Some(rest) = text.strip_prefix(b"received can message (#") {
        (Direction::Rx, &rest[memchr::memchr(b')', rest)? + 1..])
    } else {
        (Direction::Tx, text.strip_prefix(b"send ")?)
    };
    let words: Vec<&[u8]> = rest.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).collect();
    let value = |name: &str| words.iter().find_map(|word| word.strip_prefix(name.as_bytes()));
    let shown = value("can_id=0x").or_else(|| value("id=0x"))?;
    let extended = match words.first() {
        Some(&b"extended") => true,
        Some(&b"std" | &b"standard") => false,
        _ => return None,
    };
    let len = text::decimal(value("size=")?).and_then(|len| u8::try_from(len).ok()).filter(|len| *len <= 8);
    let remote = value("rtr=").is_some_and(|rtr| rtr == b"TRUE");
    let malformed = || Fault::malformed("a frame such as 'std can_id=0x305 size=8'", text);
    let id = text::hex(shown).ok_or_else(malformed).and_then(|raw| identifier(raw, extended, shown));
    Some(
        id.and_then(|id| {
            Ok(FrameFields { id, remote, direction, len: len.ok_or_else(malformed)?, fd: None })
        }),
    )
}

impl Open {
    fn record(&self) -> Result<Line, Fault> {
        let data = Payload::of(&self.bytes).unwrap_or(Payload::EMPTY);
        let event = self.fields.event(&data)?;
        Ok(Line::Record(TraceRecord { time_ns: self.time_ns, device_ns: None, channel: 1, event }))
    }
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        let plain = match line.strip_prefix(b"\x1B[") {
            Some(rest) => &rest[memchr::memchr(b'm', rest).map_or(0, |at| at + 1)..],
            None => line,
        };
        self.clock.take(plain, zone);
        let Some(text) = message_of(plain) else {
            return Ok(if plain.is_empty() { Line::Nothing } else { Line::LeftOut(OTHERS) });
        };
        self.has_lines = true;
        if let Some(fields) = fields(text) {
            self.without_bytes += u64::from(self.open.take().is_some());
            let open = Open { fields: fields?, time_ns: self.clock.time_ns, bytes: Vec::new() };
            if open.fields.data_len() == 0 {
                return open.record();
            }
            self.open = Some(open);
            return Ok(Line::Nothing);
        }
        let byte = text.strip_prefix(b"can_message.data[").or_else(|| text.strip_prefix(b"data["));
        let (Some(rest), Some(open)) = (byte, &mut self.open) else { return Ok(Line::LeftOut(OTHERS)) };
        let end = memchr::memmem::find(rest, b"]=").unwrap_or(rest.len());
        let at = text::decimal(&rest[..end]).and_then(|at| usize::try_from(at).ok());
        let byte = rest.get(end + 2..).and_then(hex_byte);
        let (Some(byte), true) = (byte, at == Some(open.bytes.len())) else {
            self.open = None;
            return Err(Fault::malformed("the bytes of a frame, one after the other", text));
        };
        open.bytes.push(byte);
        let is_whole = open.bytes.len() == open.fields.data_len();
        self.open.take_if(|_| is_whole).map_or(Ok(Line::Nothing), |open| open.record())
    }

    fn note(&mut self) -> Option<&'static str> {
        let left = self.without_bytes.checked_sub(1)?;
        self.without_bytes = left;
        Some(NO_BYTES)
    }

    fn missing(&self) -> Option<&'static str> {
        match self.open {
            Some(_) => Some(NO_BYTES),
            None => (!self.has_lines)
                .then_some("lines of the component canbus, such as '[D][canbus:070]: received can message'"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    #[test]
    fn frames_have_the_bytes_of_the_lines_below_them() {
        let file = "INFO ESPHome 2024.6.0\n\x1B[0;36m[12:00:01][D][canbus:070]: received can message (#1) std can_id=0x305 size=2\x1B[0m\n\
                    \x1B[0;37m[12:00:01][V][canbus:077]:   can_message.data[0]=0a\x1B[0m\n[12:00:01][V][canbus:077]:   can_message.data[1]=FF\n\
                    [12:00:02][D][canbus:067]: received can message (#2) extended can_id=0x18fef100 size=0\n\
                    [12:00:03][D][light:035]: 'Builtin LED' Setting:\n[12:00:04][D][canbus:033]: send standard id=0x351 rtr=FALSE size=1\n\
                    [12:00:04][VV][canbus:046]:   data[0]=28\n";
        assert_eq!(Format::of_content(file.as_bytes()), Some(Format::EspHome));
        let (records, issues) = tests::read(Format::EspHome, file);
        assert_eq!(issues, Vec::<String>::new());
        let log =
            "(43201.000000) can0 305#0AFF\n(43202.000000) can0 18FEF100#\n(43204.000000) can0 351#28 T\n";
        assert_eq!(tests::write(Format::Candump, &records), log);
    }

    #[test]
    fn frames_without_bytes_are_no_frames_of_zeros() {
        let line = "[12:00:01][D][canbus:070]: received can message (#1) std can_id=0x305 size=8\n";
        let (records, issues) = tests::read(Format::EspHome, line.repeat(3));
        assert_eq!(records.len(), 0);
        assert!(issues.len() == 1 && issues[0].contains("level: VERBOSE"), "{issues:?}");
        let gap = format!("{line}[12:00:01][V][canbus:077]:   can_message.data[1]=0a\n");
        let (records, issues) = tests::read(Format::EspHome, &gap);
        assert!(records.is_empty() && issues[0].contains("one after the other"), "{issues:?}");
    }
}
