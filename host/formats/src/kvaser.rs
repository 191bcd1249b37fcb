//! Kvaser's text of a Memorator's log: `0.123456 1 123x Rx R 8 11 22 … counter`. The header says whether identifiers and bytes
//! are hexadecimal. Times count from the start of the measurement, which the header does not give.

use std::collections::VecDeque;

use super::frame_fields::{FdFields, FrameFields, Payload, decimal_byte, hex_byte, identifier, length_code};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const REQUESTS: &str = super::codec::REQUESTS_TO_SEND;

/// Reads a text.
#[derive(Default)]
pub(crate) struct Decoder {
    ids_are_decimal: bool,
    bytes_are_decimal: bool,
    /// The rows have begun.
    in_rows: bool,
    /// The names of the columns were seen.
    has_columns: bool,
    notes: VecDeque<&'static str>,
}

/// Whether a text begins like such a file.
pub(crate) fn is_head(text: &[u8]) -> bool {
    memchr::memmem::find(text, b"Kvaser Memorator Log").is_some()
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        if !self.in_rows {
            self.head(line);
            return Ok(Line::Nothing);
        }
        if line.is_empty() || line.starts_with(b"DateTime:") {
            return Ok(Line::Nothing);
        }
        let fault = || Fault::malformed("a line such as '0.123456  1  123  Rx  8  11 22'", line);
        let (time, rest) = text::word(line);
        let time_ns = text::time(time, NS_PER_S, b'.').ok_or_else(fault)?;
        let (channel, rest) = text::word(rest);
        if channel == b"Trigger" {
            return Ok(Line::Nothing);
        }
        let number = text::decimal(channel).and_then(|channel| u8::try_from(channel).ok());
        let channel = number.ok_or_else(|| Fault::malformed("a channel of 0 to 255", channel))?;
        let record = |event| TraceRecord { time_ns, device_ns: None, channel, event };
        let (id, mut rest) = text::word(rest);
        let (mut word, behind) = text::word(rest);
        // The mark of an extended identifier may be a separate word.
        let (digits, extended) = match id {
            [digits @ .., b'x'] => (digits, true),
            _ if word == b"x" => (id, true),
            _ => (id, false),
        };
        rest = behind;
        if word == b"x" {
            (word, rest) = text::word(rest);
        }
        let direction = match word {
            b"Rx" => Direction::Rx,
            b"Tx" => Direction::Tx,
            b"TxRq" => {
                self.notes.push_back(REQUESTS);
                return Ok(Line::Nothing);
            }
            other => return Err(Fault::malformed("'Rx' or 'Tx'", other)),
        };
        let mut flags = Vec::new();
        let (mut len, mut behind) = text::word(rest);
        while !len.is_empty() && len.iter().all(|flag| b"EFBPRW#".contains(flag)) {
            flags.extend_from_slice(len);
            // `ERROR FRAME` is in the place of the bytes and is not flags.
            (len, behind) = text::word(behind);
        }
        let has = |flag: u8| flags.contains(&flag);
        // A frame before this one was overwritten in the device.
        let lost = has(b'#').then_some(TraceEvent::Lost { stage: None, count: 1, at_least: true });
        if digits.eq_ignore_ascii_case(b"ErrorFrame") {
            let event = TraceEvent::BusError { kind: None, counters: None };
            return Ok(with(lost, record(event)));
        }
        let raw = if self.ids_are_decimal {
            text::decimal(digits).and_then(|raw| u32::try_from(raw).ok())
        } else {
            text::hex(digits)
        };
        let raw = raw.ok_or_else(|| Fault::malformed("an identifier", id))?;
        let id = identifier(raw, extended, id)?;
        let code = length_code(len)?;
        let fd = has(b'F').then(|| FdFields { brs: has(b'B'), esi: has(b'P') });
        let len = if fd.is_some() { super::frame_fields::fd_len(code) } else { code };
        let fields = FrameFields { id, remote: has(b'R'), direction, len, fd };
        let byte = if self.bytes_are_decimal { decimal_byte } else { hex_byte };
        let words = behind.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let data = Payload::words(words, fields.data_len(), byte)?;
        Ok(with(lost, record(fields.event(&data)?)))
    }

    fn missing(&self) -> Option<&'static str> {
        (!self.in_rows).then_some("a line of '=' below the names of columns, followed by rows")
    }

    fn note(&mut self) -> Option<&'static str> {
        self.notes.pop_front()
    }
}

/// A loss comes before the frame that reports it.
fn with(lost: Option<TraceEvent>, record: TraceRecord) -> Line {
    match lost {
        Some(lost) => Line::Two(TraceRecord { event: lost, ..record }, record.event),
        None => Line::Record(record),
    }
}

impl Decoder {
    fn head(&mut self, line: &[u8]) {
        let says_decimal = || line.ends_with(b"DEC");
        if line.starts_with(b"Format of data field") {
            self.bytes_are_decimal = says_decimal();
        } else if line.starts_with(b"Format of id field") {
            self.ids_are_decimal = says_decimal();
        } else {
            self.in_rows = line.starts_with(b"=======") && self.has_columns;
            self.has_columns |= line.starts_with(b"Time");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    fn as_log(format: &str, rows: &str) -> (String, Vec<String>) {
        let file = format!(
            "                              Kvaser Memorator Log\n                              ====================\n\n\
             Memorator Binary logfile created at: 2016-05-03 12:00:00\n\n\nSettings:\n   Format of data field: {format}\n   \
             Format of id field:   {format}\n   Timestamp Offset:     0.000000           s\n   CAN channel:          1 2\n\n        \
             Time Chan   Identifier Flags        DLC  Data                           Counter\n\
             ==================================================================================\n{rows}"
        );
        tests::as_log(Format::Kvaser, file)
    }

    #[test]
    fn rows_with_all_flags_are_read() {
        let (log, issues) = as_log(
            "HEX",
            "    0.000000  Trigger (type=0x1, active=0x00, pre-trigger=0, post-trigger=-1)\nDateTime: 2016-05-03 12:00:01\n    \
             0.000100  1         123    Rx            2  11 22                            1\n    \
             0.000200  2    18DAF110x   Tx            0                                   2\n    \
             0.000300  1         123    Rx      R     4  RTR                              3\n    \
             0.000400  1  ErrorFrame    Rx                 ERROR FRAME                     4\n    \
             0.000500  1         123    Rx        #   1  AA                               5\n    \
             0.000600  1         123    TxRq          1  AA                               6\n",
        );
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(0.000100) can0 123#1122\n(0.000200) can1 18DAF110# T\n(0.000300) can0 123#R4\n\
             (0.000400) can0 20000080#0000000000000000\n(0.000500) can0 20000084#8001010000000000\n(0.000500) can0 123#AA\n"
        );
        let (log, issues) =
            as_log("DEC", "    0.000100  1         291    Rx            2   17 255                   1\n");
        assert_eq!((log.as_str(), issues.len()), ("(0.000100) can0 123#11FF\n", 0), "{issues:?}");
    }

    #[test]
    fn broken_rows_are_named() {
        let (log, issues) = as_log(
            "HEX",
            "x 1 123 Rx 0\n0.1 300 123 Rx 0\n0.1 1 123 Px 0\n0.1 1 12G Rx 0\n0.1 1 800 Rx 0\n0.1 1 123 Rx 16\n0.1 1 123 Rx 2 11 5\n\
             0.1 1 123 Rx 1 AA 7",
        );
        assert_eq!((log.as_str(), issues.len()), ("", 8), "{issues:#?}");
        assert!(issues[7].contains("line 22: the file ends inside a line"), "{issues:#?}");
    }
}
