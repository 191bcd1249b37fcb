//! The output of python-can's Printer and its command `can_logger`: `Timestamp: 1410714882.000000 ID: 123 S Rx DL: 2
//! 11 22 Channel: can0`.

use super::error_frames::ErrorFrames;
use super::frame_fields::{FdFields, FrameFields, Payload, direction, hex_byte, identifier};
use super::interfaces::Interfaces;
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::socketcan::ERROR_FLAG;
use cantap_trace::{Direction, TraceRecord};

/// Reads the output.
#[derive(Default)]
pub(crate) struct Decoder {
    interfaces: Interfaces,
    errors: ErrorFrames,
}

/// Whether a line is in this format.
pub(crate) fn is_line(line: &[u8]) -> bool {
    let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    words.next() == Some(b"Timestamp:") && words.nth(1) == Some(b"ID:")
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() {
            return Ok(Line::Nothing);
        }
        let fault = || Fault::malformed("a message as python-can prints it: Timestamp, ID, DL, bytes", line);
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).peekable();
        let mut next = || words.next().unwrap_or_default();
        let [first, time, second, id, format, way] = [(); 6].map(|()| next());
        if first != b"Timestamp:" || second != b"ID:" {
            return Err(fault());
        }
        let time_ns = text::time(time, NS_PER_S, b'.');
        let time_ns = time_ns.ok_or_else(|| Fault::malformed("a time in seconds", time))?;
        let raw = text::hex(id).ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id))?;
        let (mut error, mut remote, mut is_fd, mut flags) = (false, false, false, FdFields::default());
        // Version 1 had a digit each for remote, extended and error.
        let old = <[u8; 3]>::try_from(format)
            .ok()
            .filter(|digits| digits.iter().all(|digit| matches!(digit, b'0' | b'1')));
        let extended = match (format, old) {
            (b"X", _) => true,
            (b"S", _) => false,
            (_, Some(digits)) => {
                (remote, error) = (digits[0] == b'1', digits[2] == b'1');
                digits[1] == b'1'
            }
            (other, None) => return Err(Fault::malformed("X for extended or S for standard", other)),
        };
        // Before version 4 there was no direction.
        let (direction, mut word) = match direction(way) {
            Ok(direction) => (direction, words.next().unwrap_or_default()),
            Err(_) => (Direction::Rx, way),
        };
        loop {
            match std::mem::take(&mut word) {
                b"E" => error = true,
                b"R" => remote = true,
                b"F" => is_fd = true,
                b"BS" => flags.brs = true,
                b"EI" => flags.esi = true,
                b"DL:" | b"DLC:" => break,
                other => return Err(Fault::malformed("'Rx' or 'Tx', flags, then 'DL:'", other)),
            }
            word = words.next().unwrap_or_default();
        }
        let len = words.next().unwrap_or_default();
        let number = text::decimal(len).filter(|number| *number <= if is_fd { 64 } else { 15 });
        let len = number.ok_or_else(|| Fault::malformed("a length", len))? as u8;
        let needed = if remote {
            0
        } else if is_fd {
            usize::from(len)
        } else {
            usize::from(len.min(8))
        };
        let data = Payload::exactly(&mut words, needed, hex_byte)?;
        let name = memchr::memmem::rfind(line, b"Channel: ").map(|at| line[at + 9..].trim_ascii());
        let channel = self.interfaces.channel(name.unwrap_or(b"can0"));
        let record = |event| TraceRecord { time_ns, device_ns: None, channel, event };
        if error {
            let (event, second) = self.errors.read(raw | ERROR_FLAG, data.first_eight());
            return Ok(match second {
                Some(second) => Line::Two(record(event), second),
                None => Line::Record(record(event)),
            });
        }
        let id = identifier(raw, extended, id)?;
        let fields = FrameFields { id, remote, direction, len, fd: is_fd.then_some(flags) };
        Ok(Line::Record(record(fields.event(&data)?)))
    }

    fn note(&mut self) -> Option<&'static str> {
        self.errors.note()
    }
}
