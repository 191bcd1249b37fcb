//! Microchip's CAN Bus Analyzer: `1247;RX;0xC2;8;0x5C;0x87;…`, times in milliseconds from the start. The date in the header is
//! not used: whether its first number is the day or the month depends on the computer that wrote it.

use super::frame_fields::{FrameFields, Payload, direction, identifier, length_code};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text;
use super::zone::Zone;
use cantap_trace::TraceRecord;

/// Reads a log.
#[derive(Default)]
pub(crate) struct Decoder {
    /// Between the two dashed lines around the header.
    in_head: bool,
}

/// Whether a text begins like such a file.
pub(crate) fn is_head(text: &[u8]) -> bool {
    text.starts_with(b"//-----") && memchr::memmem::find(text, b"Microchip").is_some()
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        const NS_PER_MS: i64 = 1_000_000;
        if line.starts_with(b"//") {
            self.in_head = !self.in_head;
            return Ok(Line::Nothing);
        }
        if self.in_head || line.is_empty() {
            return Ok(Line::Nothing);
        }
        let mut cells = line.split(|byte| *byte == b';').map(<[u8]>::trim_ascii);
        let mut next = || cells.next().unwrap_or_default();
        let [time, way, id, len] = [(); 4].map(|()| next());
        let time_ns = text::time(time, NS_PER_MS, b'.');
        let time_ns =
            time_ns.ok_or_else(|| Fault::malformed("a line such as '1247;RX;0xC2;1;0x5C'", line))?;
        let direction = direction(way)?;
        let (digits, marked) = match id {
            [digits @ .., b'x'] => (digits, true),
            _ => (id, false),
        };
        let raw =
            text::number(digits, true).ok_or_else(|| Fault::malformed("an identifier such as 0xC2", id))?;
        let id = identifier(raw, marked || raw > 0x7FF, id)?;
        let fields = FrameFields { id, remote: false, direction, len: length_code(len)?, fd: None };
        let byte = |word: &[u8]| text::number(word, true).and_then(|byte| u8::try_from(byte).ok());
        let data = Payload::exactly(cells, fields.data_len(), byte)?;
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel: 1, event: fields.event(&data)? }))
    }

    fn missing(&self) -> Option<&'static str> {
        self.in_head.then_some("a second line of '//---' that ends the head")
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    const HEAD: &str = "//---------------------------------\nMicrochip Technology Inc.\nCAN BUS Analyzer\nSavvyCAN Exporter\n\
                        Logging Started: 3/5/2016 12:0:0\n//---------------------------------\n";

    #[test]
    fn rows_are_read() {
        let file = format!(
            "{HEAD}1247;RX;0xC2;8;0x5C;0x87;0x00;0x00;0x01;0x00;0x00;0x1C\n1248;TX;0x18DAF110;1;0x05;\n1249.5;RX;0x00000012;0;\n"
        );
        let (records, issues) = tests::read(Format::Microchip, file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1.247000) can0 0C2#5C8700000100001C\n(1.248000) can0 18DAF110#05 T\n(1.249500) can0 012#\n"
        );
    }

    #[test]
    fn broken_rows_are_named() {
        let file = format!(
            "{HEAD}x;RX;0xC2;0\n1;PX;0xC2;0\n1;RX;0xG;0\n1;RX;0xC2;16\n1;RX;0xC2;2;0x11\n1;RX;0xC2;1;0x11;0x22\n1;RX;0xC2;1;0x111\n1;RX;0xC2;1;0x1"
        );
        let (records, issues) = tests::read(Format::Microchip, file);
        assert_eq!((records.len(), issues.len()), (0, 8), "{issues:#?}");
        assert!(issues[7].contains("line 14: the file ends inside a line"), "{issues:#?}");
    }
}
