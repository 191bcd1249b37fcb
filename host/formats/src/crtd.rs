//! CRTD, the log of the Open Vehicle Monitoring System: `1320745424.002 1R11 402 FA 01 C3`. `R` or `T` is followed by the
//! bits of the identifier and preceded by the number of the bus; lines that begin with `C` are comments.

use super::frame_fields::{FrameFields, Payload, hex_byte, identifier};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord};

/// Reads a log.
#[derive(Default)]
pub(crate) struct Decoder;

/// The meaning of a line's second word.
enum Kind {
    Frame { direction: Direction, extended: bool },
    Comment,
}

/// The bus, 1 if none is given, and the kind of line.
fn kind(word: &[u8]) -> Option<(u8, Kind)> {
    let digits = word.iter().take_while(|byte| byte.is_ascii_digit()).count();
    let bus = if digits == 0 { 1 } else { text::decimal(&word[..digits])? };
    let frame = |direction, extended| Kind::Frame { direction, extended };
    let kind = match &word[digits..] {
        b"R11" => frame(Direction::Rx, false),
        b"R29" => frame(Direction::Rx, true),
        b"T11" => frame(Direction::Tx, false),
        b"T29" => frame(Direction::Tx, true),
        // As the trace window of CANalyzer has it: `CAN 1`.
        b"CAN" => return None,
        [b'C', b'A'..=b'Z', b'A'..=b'Z'] => Kind::Comment,
        _ => return None,
    };
    u8::try_from(bus).ok().map(|bus| (bus, kind))
}

/// Whether a line is in this format.
pub(crate) fn is_line(line: &[u8]) -> bool {
    let (time, rest) = text::word(line);
    text::time(time, NS_PER_S, b'.').is_some() && kind(text::word(rest).0).is_some()
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        // Its own comments are lines of the type CXX; people add others.
        if line.is_empty() || line.starts_with(b"#") {
            return Ok(Line::Nothing);
        }
        let (time, rest) = text::word(line);
        let (word, rest) = text::word(rest);
        let fault = || Fault::malformed("a line such as '1320745424.002 1R11 402 FA 01'", line);
        let time_ns = text::time(time, NS_PER_S, b'.').ok_or_else(fault)?;
        let (channel, kind) = kind(word).ok_or_else(fault)?;
        let Kind::Frame { direction, extended } = kind else { return Ok(Line::Nothing) };
        let (id, rest) = text::word(rest);
        let raw = text::hex(id).ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id))?;
        let id = identifier(raw, extended, id)?;
        let words = || rest.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let len = words().count();
        if len > 8 {
            return Err(Fault::malformed("up to 8 data bytes", rest.trim_ascii()));
        }
        let data = Payload::words(words(), len, hex_byte)?;
        let fields = FrameFields { id, remote: false, direction, len: len as u8, fd: None };
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? }))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    #[test]
    fn frames_of_all_buses_are_read_and_comments_passed_over() {
        let file = "1320745424.000 CXX OVMS Tesla Roadster cando2crtd converted log\n1320745424.002 R11 402 FA 01 C3 A0 96 00 07 01\n\
                    1320745424.106 R11 100\n1320745424.106 CEV Open charge port door\n123.431 2R29 18DAF110 00 \n\
                    1542473901.020305 3T11 7DF 02\n1542473901.021 2CER rx err\n";
        let (records, issues) = tests::read(Format::Crtd, file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1320745424.002000) can0 402#FA01C3A096000701\n(1320745424.106000) can0 100#\n\
             (123.431000) can1 18DAF110#00\n(1542473901.020305) can2 7DF#02 T\n"
        );
    }

    #[test]
    fn broken_lines_are_named() {
        let file = "x R11 402\n1.0 R12 402\n1.0 R11 G\n1.0 R11 800\n1.0 R11 402 1 22\n1.0 R11 402 00 01 02 03 04 05 06 07 08\n\
                    1.0 300R11 402\n2.0 R11 402 11\n3.0 R11 402 11 22";
        let (records, issues) = tests::read(Format::Crtd, file);
        assert_eq!(tests::write(Format::Candump, &records), "(2.000000) can0 402#11\n");
        assert_eq!(issues.len(), 8, "{issues:#?}");
        assert_eq!(
            issues[5],
            "test, line 6: expected up to 8 data bytes, found '00 01 02 03 04 05 06 07 08'"
        );
        assert!(issues[7].contains("line 9: the file ends inside a line"), "{issues:#?}");
    }
}
