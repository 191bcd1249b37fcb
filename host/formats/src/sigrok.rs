//! What sigrok's CAN decoder prints (`sigrok-cli -P can`) and PulseView exports: a line for each field of a frame, `can-1: Identifier: 291 (0x123)`,
//! from its start to its end. Numbers of samples may stand before a line; the rate that would make times of them is not in the text.
//!
//! Source: `decoders/can/pd.py` of libsigrokdecode.

use super::frame_fields::{FdFields, FrameFields, Payload, fd_len, identifier};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text;
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord};

const NO_TIMES: &str = "no times in the text: all frames stand at 0";
const WRONG: &str = "frames that the decoder found to be wrong";
const OTHERS: &str = "what other decoders printed";

/// Reads the text.
#[derive(Default)]
pub(crate) struct Decoder {
    /// The decoders' names, in the order in which they came: their places are the channels.
    buses: Vec<Bus>,
    /// Whether the missing times were reported.
    noted: bool,
    note: Option<&'static str>,
}

/// One decoder and the frame that it is in.
struct Bus {
    name: Vec<u8>,
    open: Option<Open>,
}

/// A frame up to here.
#[derive(Default)]
struct Open {
    raw: Option<u32>,
    extended: bool,
    remote: bool,
    fd: Option<FdFields>,
    code: Option<u8>,
    bytes: Vec<u8>,
    is_wrong: bool,
}

/// The decoder's name and what it says. `1024-1056 can-1: Start of frame`, `1024-1056 CAN: Fields: Start of frame`.
fn parts(line: &[u8]) -> Option<(&[u8], &[u8])> {
    let (first, rest) = text::word(line);
    let is_samples = first.iter().all(|byte| byte.is_ascii_digit() || *byte == b'-') && first.contains(&b'-');
    let line = if is_samples { rest.trim_ascii_start() } else { line };
    let at = memchr::memmem::find(line, b": ")?;
    let (name, mut said) = (&line[..at], line[at + 2..].trim_ascii());
    if !name.to_ascii_lowercase().starts_with(b"can") {
        return None;
    }
    for row in ["Fields: ", "Warnings: "] {
        said = said.strip_prefix(row.as_bytes()).unwrap_or(said);
    }
    Some((name, said))
}

/// Whether a line is the first field of a frame.
pub(crate) fn is_line(line: &[u8]) -> bool {
    parts(line).is_some_and(|(_, said)| said == b"Start of frame" || said.starts_with(b"Identifier: "))
}

/// The last number of `291 (0x123)` or `Data byte 0: 0x11`.
fn hexadecimal(said: &[u8]) -> Option<u32> {
    let at = memchr::memmem::find(said, b"0x")?;
    text::hex(said[at + 2..].trim_ascii_end().strip_suffix(b")").unwrap_or(&said[at + 2..]))
}

impl Open {
    /// Takes a field; false if it says nothing that a trace keeps.
    fn take(&mut self, said: &[u8]) -> Result<(), Fault> {
        let number = |name: &str| said.strip_prefix(name.as_bytes());
        let malformed = || Fault::malformed("a field of a frame with its number", said);
        if said.starts_with(b"Identifier: ") || said.starts_with(b"Full Identifier: ") {
            self.raw = Some(hexadecimal(said).ok_or_else(malformed)?);
            self.extended = said.starts_with(b"Full");
        } else if let Some(code) = number("Data length code: ") {
            let code = text::decimal(code).filter(|code| *code <= 15).ok_or_else(malformed)?;
            self.code = Some(code as u8);
        } else if said.starts_with(b"Data byte ") {
            let byte = hexadecimal(said).and_then(|byte| u8::try_from(byte).ok()).ok_or_else(malformed)?;
            self.bytes.push(byte);
        } else if let Some(kind) = number("Remote transmission request: ") {
            self.remote = kind.starts_with(b"remote");
        } else if let Some(bit) = number("Flexible data format: ") {
            self.fd = (bit == b"1").then(FdFields::default);
        } else if let (Some(bit), Some(fd)) = (number("Bit rate switch: "), &mut self.fd) {
            fd.brs = bit == b"1";
        } else if let (Some(bit), Some(fd)) = (number("Error state indicator: "), &mut self.fd) {
            fd.esi = bit == b"1";
        } else if said.windows(7).any(|part| part == b"must be")
            || said == b"CRC is invalid"
            || said.ends_with(b"not allowed")
        {
            self.is_wrong = true;
        }
        Ok(())
    }

    fn record(&self, channel: u8) -> Result<Line, Fault> {
        if self.is_wrong {
            return Ok(Line::LeftOut(WRONG));
        }
        let (Some(raw), Some(code)) = (self.raw, self.code) else {
            return Err(Fault::malformed("an identifier and a length before the end of a frame", b"none"));
        };
        let id = identifier(raw, self.extended, format!("{raw:X}").as_bytes())?;
        let len = if self.fd.is_some() { fd_len(code) } else { code };
        let fields = FrameFields { id, remote: self.remote, direction: Direction::Rx, len, fd: self.fd };
        let data = Payload::of(&self.bytes).filter(|data| data.as_slice().len() == fields.data_len());
        let found = || self.bytes.len().to_string();
        let data = data.ok_or_else(|| {
            Fault::malformed(format!("{} data bytes", fields.data_len()), found().as_bytes())
        })?;
        let event = fields.event(&data)?;
        Ok(Line::Record(TraceRecord { time_ns: 0, device_ns: None, channel, event }))
    }
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        let Some((name, said)) = parts(line) else {
            return Ok(if line.is_empty() { Line::Nothing } else { Line::LeftOut(OTHERS) });
        };
        let at = self.buses.iter().position(|bus| bus.name == name).unwrap_or_else(|| {
            self.buses.push(Bus { name: name.to_vec(), open: None });
            self.buses.len() - 1
        });
        let bus = &mut self.buses[at];
        if said == b"Start of frame" || bus.open.is_none() && said.starts_with(b"Identifier: ") {
            bus.open = Some(Open::default());
        }
        if said == b"End of frame" {
            let channel = u8::try_from(at + 1).unwrap_or(u8::MAX);
            if !std::mem::replace(&mut self.noted, true) {
                self.note = Some(NO_TIMES);
            }
            return bus.open.take().map_or(Ok(Line::Nothing), |open| open.record(channel));
        }
        match &mut bus.open {
            Some(open) => open.take(said).map(|()| Line::Nothing),
            None => Ok(Line::Nothing),
        }
    }

    /// The last line is no frame's only one.
    fn may_be_cut(&self, _line: &[u8], _record: &TraceRecord) -> bool {
        false
    }

    fn note(&mut self) -> Option<&'static str> {
        self.note.take()
    }

    fn missing(&self) -> Option<&'static str> {
        if self.buses.is_empty() {
            return Some("fields of frames, such as 'can-1: Identifier: 291 (0x123)'");
        }
        self.buses.iter().any(|bus| bus.open.is_some()).then_some("the end of the last frame")
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    const STANDARD: &str = "can-1: Start of frame\ncan-1: Identifier: 291 (0x123)\ncan-1: Remote transmission request: data frame\n\
                            can-1: Identifier extension bit: standard frame\ncan-1: Reserved bit 0: 0\ncan-1: Data length code: 2\n\
                            can-1: Data byte 0: 0x11\ncan-1: Data byte 1: 0x0a\ncan-1: CRC-15 sequence: 0x1234\ncan-1: CRC delimiter: 1\n\
                            can-1: ACK slot: ACK\ncan-1: ACK delimiter: 1\ncan-1: End of frame\n";
    const EXTENDED: &str = "8-9 can-1: Start of frame\n10-20 can-1: Identifier: 1597 (0x63d)\n21-21 can-1: Identifier extension bit: extended frame\n\
                            22-40 can-1: Extended Identifier: 192 (0xc0)\n22-40 can-1: Full Identifier: 418644160 (0x18f400c0)\n\
                            41-41 can-1: Remote transmission request: remote frame\n42-46 can-1: Data length code: 4\n90-99 can-1: End of frame\n";

    #[test]
    fn fields_make_frames() {
        let file = format!("{STANDARD}uart-1: 41\n{EXTENDED}");
        assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Sigrok));
        let (records, issues) = tests::read(Format::Sigrok, &file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(0.000000) can0 123#110A\n(0.000000) can0 18F400C0#R4\n"
        );
        let export = EXTENDED.replace("can-1: ", "CAN: Fields: ");
        assert_eq!(Format::of_content(export.as_bytes()), Some(Format::Sigrok));
        assert_eq!(tests::read(Format::Sigrok, &export).0.len(), 1);
    }

    #[test]
    fn frames_that_are_wrong_or_not_whole_are_none() {
        let wrong = STANDARD.replace("can-1: CRC delimiter: 1\n", "can-1: CRC is invalid\n");
        let short = STANDARD.replace("can-1: Data byte 1: 0x0a\n", "");
        let (records, issues) = tests::read(Format::Sigrok, format!("{wrong}{short}{}", &STANDARD[..120]));
        assert_eq!(records.len(), 0);
        assert_eq!(issues.len(), 2, "{issues:?}");
        assert!(
            issues[0].contains("2 data bytes") && issues[1].contains("the end of the last frame"),
            "{issues:?}"
        );
    }
}
