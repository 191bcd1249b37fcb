//! CANHacker's trace: `00.000 00004000 8 36 47 19 43 01 00 00 80` below `Time ID DLC Data`. Its seconds restart each minute
//! and have a point or a comma; extended identifiers have eight digits.

use super::frame_fields::{FrameFields, Payload, hex_byte, identifier, length_code};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord};

const MINUTES: &str =
    "times restart each minute: for a pause of more than a minute, only the seconds are known";

const NS_PER_MINUTE: i64 = 60 * NS_PER_S;

/// Reads a trace.
#[derive(Default)]
pub(crate) struct Decoder {
    minutes_ns: i64,
    last_ns: i64,
    note: Option<&'static str>,
}

/// Whether a line is the header of such a file.
pub(crate) fn is_head(line: &[u8]) -> bool {
    let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    [&b"Time"[..], b"ID", b"DLC", b"Data"].iter().all(|name| words.next() == Some(*name))
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() || is_head(line) {
            return Ok(Line::Nothing);
        }
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let mut next = || words.next().unwrap_or_default();
        let [time, id, len] = [(); 3].map(|()| next());
        let mark = if time.contains(&b',') { b',' } else { b'.' };
        let fault = || Fault::malformed("a line such as '00.000 301 2 A6 07'", line);
        let shown_ns = text::time(time, NS_PER_S, mark).filter(|time| *time >= 0).ok_or_else(fault)?;
        // Also of a line that cannot be read further: the next one counts from it.
        if shown_ns < self.last_ns {
            self.minutes_ns = self.minutes_ns.saturating_add(NS_PER_MINUTE);
            self.note = Some(MINUTES);
        }
        self.last_ns = shown_ns;
        let raw = text::hex(id).ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id))?;
        let id = identifier(raw, id.len() > 4, id)?;
        let len = length_code(len)?;
        let fields = FrameFields { id, remote: false, direction: Direction::Rx, len, fd: None };
        let data = Payload::exactly(words, fields.data_len(), hex_byte)?;
        let event = fields.event(&data)?;
        let time_ns = self.minutes_ns.saturating_add(shown_ns);
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel: 1, event }))
    }

    fn note(&mut self) -> Option<&'static str> {
        self.note.take()
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

    const HEAD: &str = "Time   ID     DLC Data                    Comment\n";

    #[test]
    fn minutes_are_counted_and_both_marks_of_fractions_read() {
        let file = format!(
            "{HEAD}00.500 18EA0003 8 BE FE 00 00 FF FF FF FF \n59.900 301      2 A6 07 \n00.100 301      0 \n"
        );
        let expected =
            "(0.500000) can0 18EA0003#BEFE0000FFFFFFFF\n(59.900000) can0 301#A607\n(60.100000) can0 301#\n";
        for file in [file.replace("0.5", "0,5").replace("9.9", "9,9").replace("0.1", "0,1"), file] {
            let (records, issues) = tests::read(Format::CanHacker, file);
            assert_eq!(issues, Vec::<String>::new());
            assert_eq!(tests::write(Format::Candump, &records), expected);
        }
    }

    #[test]
    fn a_minute_that_begins_behind_a_broken_line_or_a_pause_is_counted() {
        for (rows, expected) in [
            (
                "00.500 123 1 11 \n59.900 12G 1 A6 \n00.100 301 0 \n",
                "(0.500000) can0 123#11\n(60.100000) can0 301#\n",
            ),
            ("00.500 123 1 11 \n00.100 301 0 \n", "(0.500000) can0 123#11\n(60.100000) can0 301#\n"),
        ] {
            let (records, _) = tests::read(Format::CanHacker, format!("{HEAD}{rows}"));
            assert_eq!(tests::write(Format::Candump, &records), expected);
        }
    }

    #[test]
    fn broken_lines_are_named() {
        let file = format!(
            "{HEAD}rubbish\n00.1 12G 0\n00.1 900 0\n00.1 301 9x\n00.1 301 2 11\n00.1 301 1 11 22\n00.2 301 1 1G\n00.3 301 1 1"
        );
        let (records, issues) = tests::read(Format::CanHacker, file);
        assert_eq!((records.len(), issues.len()), (0, 8), "{issues:#?}");
    }
}
