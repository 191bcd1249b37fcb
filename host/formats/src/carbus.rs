//! The trace of CARBUS Analyzer, the successor of CANHacker: a head `@ TEXT @ 3 @ 64 @ 0 @ 10094 @ …`, then lines of columns between tabs:
//! `15,316000`, channel, flags, identifier, length, bytes, and what they look like as text. Version 2 has milliseconds after the comma, version 3
//! microseconds. The fifth part of the head is the number of frames.
//!
//! As shown by SavvyCAN's example and by a trace in rusefi's can-log-tools.

use super::frame_fields::{FrameFields, Payload, hex_byte, identifier, length_code};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord};

const HEAD: &[u8] = b"@ TEXT @";

/// The flag of an identifier of 29 bits.
const EXTENDED: u32 = 1;

/// Reads a trace.
#[derive(Default)]
pub(crate) struct Decoder {
    /// What the number after the comma counts, in nanoseconds; 0 before the head.
    unit_ns: i64,
    /// How many frames the head says there are, and how many lines there were.
    frames: Option<u64>,
    lines: u64,
}

/// Whether a text begins like such a file.
pub(crate) fn is_head(text: &[u8]) -> bool {
    text.starts_with(HEAD)
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() || line.starts_with(b"#") {
            return Ok(Line::Nothing);
        }
        if self.unit_ns == 0 {
            return self.head(line).map(|()| Line::Nothing);
        }
        self.lines += 1;
        let mut cells = line.split(|byte| *byte == b'\t');
        let mut next = || cells.next().unwrap_or_default().trim_ascii();
        let [time, channel, flags, id, len, bytes] = [(); 6].map(|()| next());
        let time_ns = self.time_ns(time).ok_or_else(|| Fault::malformed("a time such as 15,316000", time))?;
        let number = text::decimal(channel).and_then(|channel| u8::try_from(channel).ok());
        let channel = number.ok_or_else(|| Fault::malformed("a channel of 0 to 255", channel))?;
        let flags = text::hex(flags).ok_or_else(|| Fault::malformed("flags in hexadecimal digits", flags))?;
        let raw = text::hex(id).ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id))?;
        let id = identifier(raw, flags & EXTENDED != 0, id)?;
        let len = length_code(len)?;
        let fields = FrameFields { id, remote: false, direction: Direction::Rx, len, fd: None };
        let words = bytes.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let data = Payload::exactly(words, fields.data_len(), hex_byte)?;
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? }))
    }

    fn missing(&self) -> Option<&'static str> {
        let missing = self.frames.is_some_and(|frames| self.lines < frames);
        missing.then_some("as many frames as the head of the file says")
    }
}

impl Decoder {
    fn head(&mut self, line: &[u8]) -> Result<(), Fault> {
        let fault =
            || Fault::malformed("the head of version 2 or 3, such as '@ TEXT @ 3 @ 64 @ 0 @ …'", line);
        let mut parts = line.strip_prefix(HEAD).ok_or_else(fault)?.split(|byte| *byte == b'@');
        let mut number = || parts.next().and_then(|part| text::decimal(part.trim_ascii()));
        self.unit_ns = match number() {
            Some(2) => 1_000_000,
            Some(3) => 1_000,
            _ => return Err(fault()),
        };
        let (_, _) = (number(), number());
        self.frames = number();
        Ok(())
    }

    /// The part after the comma is a count, not a fraction: programs other than CARBUS Analyzer leave out its leading zeros.
    fn time_ns(&self, text: &[u8]) -> Option<i64> {
        let at = memchr::memchr(b',', text)?;
        let seconds = i64::try_from(text::decimal(&text[..at])?).ok()?.checked_mul(NS_PER_S)?;
        let part = i64::try_from(text::decimal(&text[at + 1..])?).ok()?.checked_mul(self.unit_ns)?;
        seconds.checked_add(part).filter(|_| part < NS_PER_S)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    fn as_log(file: &str) -> (String, Vec<String>) {
        tests::as_log(Format::Carbus, file)
    }

    #[test]
    fn both_versions_and_both_line_ends_are_read() {
        let lines = "# $LocalTime=17:42:06.357\r15,316000\t1\t00000004\t30B\t8\t10 2E 02 00 08 00 00 14\t00000000\t .      \t\r\
                     15,6000\t2\t00000005\t1B000067\t2\t67 00\t00000000\tg \t\r";
        let (log, issues) = as_log(&format!("@ TEXT @ 3 @ 64 @ 0 @ 2 @ 20672 @ 00:00:20.672 @\r{lines}"));
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(log, "(15.316000) can0 30B#102E020008000014\n(15.006000) can1 1B000067#6700\n");
        let lines =
            "46,016\t1\t0004\t45A\t2\t5A 04\t00000000\tZ \t\r\n46,734\t1\t0004\t4E0\t0\t\t00000000\t\t\r\n";
        let (log, issues) = as_log(&format!("@ TEXT @ 2 @ 64 @ 0 @ 2 @ 10078 @ 00:00:10.078 @\r\n{lines}"));
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(log, "(46.016000) can0 45A#5A04\n(46.734000) can0 4E0#\n");
    }

    #[test]
    fn a_missing_end_and_broken_lines_are_named() {
        let (log, issues) = as_log(
            "@ TEXT @ 3 @ 64 @ 0 @ 9 @ 20672 @ 00:00:20.672 @\n15,1000000\t1\t4\t30B\t0\t\n15\t1\t4\t30B\t0\t\n15,1\t300\t4\t30B\t0\t\n\
             15,1\t1\tG\t30B\t0\t\n15,1\t1\t4\t80B\t0\t\n15,1\t1\t4\t30B\t16\t\n15,1\t1\t4\t30B\t1\t11 22\t0\n15,1\t1\t4\t30B\t1\t1",
        );
        assert_eq!((log.as_str(), issues.len()), ("", 9), "{issues:#?}");
        assert!(issues[7].contains("the file ends inside a line"), "{issues:#?}");
        assert!(issues[8].contains("as many frames as the head"), "{issues:#?}");
        let (_, issues) = as_log("@ TEXT @ 4 @\n15,1\t1\t4\t30B\t1\t11\n");
        assert_eq!(issues.len(), 2, "{issues:#?}");
    }
}
