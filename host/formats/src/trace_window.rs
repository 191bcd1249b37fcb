//! The trace window of CANalyzer and CANoe, copied as text: `0.010640 CAN 1 18FEF100x EEC1 CAN Frame Rx 8 8 11 22 …`, with tabs or blanks
//! between the columns. Which columns there are, and whether numbers are hexadecimal, is the user's choice; a direction stands in every row
//! of a frame, behind it the length and the bytes.
//!
//! What stands below a message whose signals are shown has no time, and is counted; so are rows of other buses and of variables.

use super::frame_fields::{
    FdFields, FrameFields, Payload, bytes_are_decimal, decimal_byte, direction, fd_len, hex_byte, identifier,
};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::table::date;
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{TraceEvent, TraceRecord};

/// Reads a text.
#[derive(Default)]
pub(crate) struct Decoder {
    is_decimal: bool,
    /// To be reported before anything is read.
    untold: bool,
    /// Whether there was the row of a frame.
    has_rows: bool,
}

const TAKEN_AS_DECIMAL: &str =
    "identifiers and bytes were taken as decimal numbers, because they are not written as hexadecimal ones";
const SIGNALS: &str = "lines without a time, such as the signals of a message";
const OTHER_ROWS: &str = "rows of something else than CAN frames";
const REQUESTS: &str = "requests to send";

/// The columns of a row.
struct Columns<'a> {
    time_ns: i64,
    channel: u8,
    /// What stands behind the channel.
    rest: Vec<&'a [u8]>,
}

/// A row's words; a message that can be unfolded has a sign before its time.
fn words(line: &[u8]) -> Vec<&[u8]> {
    let words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    words.skip_while(|word| matches!(word, [b'+' | b'-'])).take(120).collect()
}

fn time_of(word: &[u8], zone: &Zone) -> Option<i64> {
    let has_fraction = word.iter().any(|byte| matches!(byte, b'.' | b','));
    if !has_fraction {
        return None;
    }
    text::time_of_any_mark(word, NS_PER_S).or_else(|| date(word, zone))
}

/// The columns of a row on a CAN bus; `None` if it is none.
fn columns<'a>(words: &[&'a [u8]], zone: &Zone) -> Option<Columns<'a>> {
    let (time, rest) = words.split_first()?;
    let (first, rest) = rest.split_first()?;
    let upper = first.to_ascii_uppercase();
    let number = upper.strip_prefix(b"CANFD").or_else(|| upper.strip_prefix(b"CAN"))?;
    let (number, rest) = match number {
        b"" => rest.split_first().map(|(number, rest)| (*number, rest))?,
        number => (&first[first.len() - number.len()..], rest),
    };
    let channel = text::decimal(number).and_then(|channel| u8::try_from(channel).ok())?;
    let time_ns = time_of(time, zone)?;
    (channel > 0).then(|| Columns { time_ns, channel, rest: rest.to_vec() })
}

/// Where the direction stands.
fn direction_at(rest: &[&[u8]]) -> Option<usize> {
    rest.iter().position(|word| direction(word).is_ok() || word.eq_ignore_ascii_case(b"TxRq"))
}

/// Whether a line is the row of a frame.
pub(crate) fn is_line(line: &[u8]) -> bool {
    let Some(Columns { rest, .. }) = columns(&words(line), &Zone::default()) else { return false };
    is_error(&rest) || direction_at(&rest).is_some_and(|at| at > 0)
}

/// Whether a line has the names of such columns.
pub(crate) fn is_names(line: &[u8]) -> bool {
    let words = words(line);
    let has = |wanted: &[&[u8]]| wanted.iter().any(|name| words.iter().any(|word| word == name));
    has(&[b"Time", b"Zeit"])
        && has(&[b"Chn", b"Channel", b"Kanal"])
        && has(&[b"ID"])
        && has(&[b"Dir", b"Richtung"])
}

/// Whether a file begins like this: a row, or names and a row below them. With tabs between the names it is a table as any.
pub(crate) fn is_head(text: &[u8]) -> bool {
    let mut lines = text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).filter(|line| !line.is_empty());
    let Some(first) = lines.next() else { return false };
    is_line(first) || is_names(first) && !first.contains(&b'\t') && lines.any(is_line)
}

fn is_error(rest: &[&[u8]]) -> bool {
    let is = |word: &[u8], wanted: &str| word.eq_ignore_ascii_case(wanted.as_bytes());
    rest.iter().any(|word| is(word, "ErrorFrame"))
        || rest.windows(2).any(|pair| is(pair[0], "Error") && is(pair[1], "Frame"))
}

impl Decoder {
    fn row(&self, columns: &Columns<'_>, line: &[u8]) -> Result<Line, Fault> {
        let Columns { time_ns, channel, rest } = columns;
        let record = |event| TraceRecord { time_ns: *time_ns, device_ns: None, channel: *channel, event };
        if is_error(rest) {
            return Ok(Line::Record(record(TraceEvent::BusError { kind: None, counters: None })));
        }
        let Some(at) = direction_at(rest).filter(|at| *at > 0) else { return Ok(Line::LeftOut(OTHER_ROWS)) };
        let (before, after) = rest.split_at(at);
        let (way, after) = (after[0], &after[1..]);
        if way.eq_ignore_ascii_case(b"TxRq") {
            return Ok(Line::LeftOut(REQUESTS));
        }
        let (id, described) = (before[0], &before[1..]);
        let (digits, marked) = match id {
            [digits @ .., b'x' | b'X'] => (digits, true),
            digits => (digits, false),
        };
        let raw = if let (Some(digits), false) = (text::after_0x(digits), self.is_decimal) {
            text::hex(digits)
        } else if self.is_decimal {
            text::decimal(digits).and_then(|raw| u32::try_from(raw).ok())
        } else {
            text::hex(digits)
        };
        let raw = raw.ok_or_else(|| Fault::malformed("an identifier", id))?;
        let id = identifier(raw, marked || raw > 0x7FF, id)?;
        let says = |wanted: &str| described.iter().any(|word| word.eq_ignore_ascii_case(wanted.as_bytes()));
        let (remote, switched) = (says("Remote"), says("BRS"));
        let (code, after) =
            after.split_first().ok_or_else(|| Fault::malformed("a length after the direction", line))?;
        let code = text::decimal(code).or_else(|| text::hex(code).map(u64::from)).filter(|code| *code <= 15);
        let code = code.ok_or_else(|| Fault::malformed("a data length code of 0 to 15", line))? as u8;
        // A longer one can only be of CAN FD.
        let is_fd = says("FD") || says("CANFD") || switched || after.len() > 9 && code > 8;
        let fd = is_fd.then_some(FdFields { brs: switched, esi: false });
        let len = if is_fd { fd_len(code) } else { code };
        let fields = FrameFields { id, remote, direction: direction(way)?, len, fd };
        let wanted = fields.data_len();
        let number = |word: &[u8]| text::decimal(word).and_then(|len| usize::try_from(len).ok());
        let bytes = match after {
            // A column with the number of bytes.
            [len, bytes @ ..] if bytes.len() == wanted && number(len) == Some(wanted) => bytes,
            [_] if remote => &[],
            bytes => bytes,
        };
        if bytes.len() != wanted {
            return Err(Fault::malformed(format!("{wanted} data bytes"), line));
        }
        let byte = if self.is_decimal { decimal_byte } else { hex_byte };
        let data = Payload::words(bytes.iter().copied(), wanted, byte)?;
        Ok(Line::Record(record(fields.event(&data)?)))
    }
}

impl RowFormat for Decoder {
    fn begin(&mut self, buffered: &[u8]) {
        let rows = buffered.split(|byte| *byte == b'\n').map(words);
        let bytes = rows.flat_map(|words| {
            let at = direction_at(&words).map_or(words.len(), |at| at + 2);
            words.into_iter().skip(at).collect::<Vec<_>>()
        });
        self.is_decimal = bytes_are_decimal(bytes);
        self.untold = self.is_decimal;
    }

    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() || is_names(line) {
            return Ok(Line::Nothing);
        }
        let words = words(line);
        match columns(&words, zone) {
            Some(columns) => {
                let row = self.row(&columns, line);
                self.has_rows |= !matches!(row, Ok(Line::LeftOut(OTHER_ROWS)));
                row
            }
            None if words.first().is_some_and(|word| time_of(word, zone).is_some()) => {
                Ok(Line::LeftOut(OTHER_ROWS))
            }
            None => Ok(Line::LeftOut(SIGNALS)),
        }
    }

    fn missing(&self) -> Option<&'static str> {
        (!self.has_rows).then_some("a row such as '0.010640 CAN 1 123 Rx 2 11 22'")
    }

    /// What was copied often ends without a line's end; a row says how many bytes it has, with two digits each.
    fn may_be_cut(&self, _line: &[u8], _record: &TraceRecord) -> bool {
        self.is_decimal
    }

    fn note(&mut self) -> Option<&'static str> {
        std::mem::take(&mut self.untold).then_some(TAKEN_AS_DECIMAL)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use super::TAKEN_AS_DECIMAL;
    use crate::{Format, ReadOptions, TraceReader};

    fn log(file: &str) -> (String, Vec<String>) {
        let (records, issues) = tests::read(Format::TraceWindow, file);
        (tests::write(Format::Candump, &records), issues)
    }

    #[test]
    fn each_layout_has_the_same_frames() {
        let wanted =
            "(0.010640) can0 123#1122\n(0.020000) can1 18FEF100#0102030405060708 T\n(0.030000) can0 7DF#R\n";
        for file in [
            // By default, with and without a database.
            "0.010640\tCAN 1\t123\tEngine\tCAN Frame\tRx\t2\t2\t11 22\n0.020000\tCAN 2\t18FEF100x\t\tCAN Frame\tTx\t8\t8\t01 02 03 04 05 06 07 08\n\
             0.030000\tCAN 1\t7DF\t\tRemote Frame\tRx\t0\t0\t",
            "  0.010640 CAN1   0x123        Rx   2  11 22\n- 0.020000 CAN 2   18FEF100x  Tx   8  01 02 03 04 05 06 07 08\n\
             0.030000 CAN 1   7DF  Remote Rx 0\n",
            "Time      Chn    ID          Name    Event Type    Dir  DLC  Data length  Data\r\n\
             0,010640  CAN 1  123         Engine  CAN Frame     Rx   2    2            11 22\r\n\
             0,020000  CAN 2  18FEF100x   EEC1    CAN Frame     Tx   8    8            01 02 03 04 05 06 07 08\r\n\
             0,030000  CAN 1  7DF                 Remote Frame  Rx   0    0\r\n",
        ] {
            assert_eq!(log(file), (wanted.to_owned(), Vec::new()), "{file}");
            assert_eq!(Format::of_content(file.as_bytes()), Some(Format::TraceWindow), "{file}");
        }
    }

    #[test]
    fn decimal_numbers_show_as_such_and_are_reported() {
        let (frames, issues) =
            log("0.5 CAN 1 291 Rx 3 17 255 0\n0.6 CAN 1 419361024x EEC1 Tx 2 1 2\n0.7 CAN 1 5 Rx 0\n");
        assert_eq!(
            frames,
            "(0.500000) can0 123#11FF00\n(0.600000) can0 18FEF100#0102 T\n(0.700000) can0 005#\n"
        );
        assert_eq!(issues, Vec::<String>::new());
        let source = std::io::Cursor::new("0.5 CAN 1 291 Rx 3 17 255 0\n");
        let mut reader =
            TraceReader::from_source("test", source, Format::TraceWindow, &ReadOptions::default()).unwrap();
        reader.by_ref().count();
        assert!(reader.notes().iter().any(|(what, _)| what == TAKEN_AS_DECIMAL));
    }

    #[test]
    fn can_fd_and_error_frames_are_read_and_what_else_there_is_is_counted() {
        let bytes = "AA ".repeat(12);
        let file = format!(
            "0.1 CAN 1 123 Fd CAN FD Frame Rx 9 12 {bytes}\n0.2 CAN 1 Error Frame Rx\n  - EngSpeed 1200 rpm 4B0\n\
             0.3 LIN 1 3C Rx 1 00\n0.4 CAN 1 Statistic: D 12 R 0\n0.5 CAN 1 100 TxRq 1 22\n0.6 CAN 1 101 Rx 2 11\n12:04:59.500 CAN 2 101 Rx 1 11\n"
        );
        let (frames, issues) = log(&file);
        let data = "AA".repeat(12);
        assert_eq!(
            frames,
            format!(
                "(0.100000) can0 123##0{data}\n(0.200000) can0 20000080#0000000000000000\n(43499.500000) can1 101#11\n"
            )
        );
        assert_eq!(issues.len(), 1, "{issues:?}");
        assert!(issues[0].contains("line 7") && issues[0].contains("2 data bytes"), "{issues:?}");
    }
}
