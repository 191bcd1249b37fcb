//! The log of Battery-Emulator, an inverter's gateway to car batteries: `(51.26) RX0 17FC007B [8] 11 22 …`. Its number is twice that of the interface,
//! plus one for what was sent. Times count from the start of the computer, in hundredths or thousandths of a second.

use super::frame_fields::{FdFields, FrameFields, Payload, hex_byte, identifier};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const EXPECTED: &str = "a line such as '(51.26) RX0 17FC007B [2] 11 22'";

/// Reads a log.
#[derive(Default)]
pub(crate) struct Decoder {
    last_ns: i64,
    last_channel: u8,
}

/// A line's time, its direction and channel from 1, and the rest of it.
fn begin(line: &[u8]) -> Option<(i64, Direction, u8, &[u8])> {
    let end = memchr::memchr(b')', line)?;
    let time_ns = text::time(line[..end].strip_prefix(b"(")?, NS_PER_S, b'.')?;
    let (word, rest) = text::word(&line[end + 1..]);
    let (direction, number) = match word {
        [b'R', b'X', number @ ..] => (Direction::Rx, number),
        [b'T', b'X', number @ ..] => (Direction::Tx, number),
        _ => return None,
    };
    let channel = u8::try_from(text::decimal(number)? / 2 + 1).ok()?;
    Some((time_ns, direction, channel, rest))
}

/// Whether a line is in this format.
pub(crate) fn is_line(line: &[u8]) -> bool {
    begin(line.trim_ascii()).is_some()
}

/// What it prints where its port was too slow: how many frames are missing.
fn not_printed(line: &[u8]) -> Option<u32> {
    let number = line.strip_prefix(b"[")?.strip_suffix(b" CAN frames not printed]")?;
    text::decimal(number).map(|number| u32::try_from(number).unwrap_or(u32::MAX))
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() || line.starts_with(b"#") {
            return Ok(Line::Nothing);
        }
        if let Some(count) = not_printed(line) {
            let event = TraceEvent::Lost { stage: None, count, at_least: false };
            return Ok(Line::Record(TraceRecord {
                time_ns: self.last_ns,
                device_ns: None,
                channel: self.last_channel.max(1),
                event,
            }));
        }
        let fault = || Fault::malformed(EXPECTED, line);
        let (time_ns, direction, channel, rest) = begin(line).ok_or_else(fault)?;
        let (id, rest) = text::word(rest);
        let raw = text::hex(id).ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id))?;
        // Nothing else says which it is.
        let id = identifier(raw, raw > 0x7FF, id)?;
        let (len, rest) = text::word(rest);
        let number = len.strip_prefix(b"[").and_then(|len| text::decimal(len.strip_suffix(b"]")?));
        let number =
            number.filter(|len| *len <= 64).ok_or_else(|| Fault::malformed("a length such as [8]", len))?;
        let fd = (number > 8).then(FdFields::default);
        let fields = FrameFields { id, remote: false, direction, len: number as u8, fd };
        let words = rest.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let data = Payload::exactly(words, fields.data_len(), hex_byte)?;
        (self.last_ns, self.last_channel) = (time_ns, channel);
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? }))
    }

    fn may_be_cut(&self, _line: &[u8], record: &TraceRecord) -> bool {
        // There are as many bytes as the length says.
        record.frame().is_none_or(|frame| frame.data().is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    #[test]
    fn frames_of_both_directions_and_what_was_not_printed_are_read() {
        let file = "(0.05) RX0 17FC007B [8] 11 22 33 44 55 66 77 88\r\n(0.05) TX1 3C0 [2] 00 FF\r\n(0.05) RX2 7 [0]\r\n\
                    [12 CAN frames not printed]\r\n(51.261) TX3 1FFFFFFF [12] 00 01 02 03 04 05 06 07 08 09 0A 0B\r\n\
                    (52.00) RX0 3C0 [2] 00\r\n(52.00) XX0 3C0 [0]\r\n(52.00) RX0 3C0 [9] 00\r\n(52.00) RX0 3C0 [1] 0";
        let (records, issues) = tests::read(Format::BatteryEmulator, file);
        assert_eq!(issues.len(), 4, "{issues:#?}");
        assert!(issues[3].contains("the file ends inside a line"), "{issues:#?}");
        let frames: Vec<_> = records.iter().filter(|record| record.frame().is_some()).copied().collect();
        let log = tests::write(Format::Candump, &frames);
        let lines: Vec<_> = log.lines().collect();
        assert_eq!(
            lines,
            [
                "(0.050000) can0 17FC007B#1122334455667788",
                "(0.050000) can0 3C0#00FF T",
                "(0.050000) can1 007#",
                "(51.261000) can1 1FFFFFFF##0000102030405060708090A0B T",
            ]
        );
        assert!(
            records
                .iter()
                .any(|record| matches!(record.event, cantap_trace::TraceEvent::Lost { count: 12, .. }))
        );
    }
}
