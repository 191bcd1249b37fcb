//! The text of Kvaser's CanKing, as saved from its output window: ` 0 0CFBFFDB X 8 1B 31 … 100.000139 R`. Channels count from 0. Times
//! count from the start of the measurement, whose date no line gives.
//!
//! Nor does anything say whether numbers are hexadecimal, which CanKing's user can choose. Hexadecimal ones are written with all
//! their digits, eight for an identifier and two for a byte, so the rows show it: see [`Decoder::is_decimal`].

use super::frame_fields::{
    FdFields, FrameFields, Payload, bytes_are_decimal, decimal_byte, fd_len, hex_byte, identifier,
    length_code,
};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceEvent, TraceRecord};

/// Reads a text.
#[derive(Default)]
pub(crate) struct Decoder {
    is_decimal: bool,
    /// To be reported before anything is read.
    untold: bool,
}

const TAKEN_AS_DECIMAL: &str = "identifiers and bytes were taken as decimal numbers, because they have not all digits of hexadecimal ones";

/// Whether a line is the header of such a file.
pub(crate) fn is_head(line: &[u8]) -> bool {
    is_names(line)
}

fn is_names(line: &[u8]) -> bool {
    line.starts_with(b"Chn") && text::word(&line[3..]).0 == b"Identifier"
}

/// Splits a line into words, at most as many as in a line with 64 bytes.
fn words(line: &[u8]) -> Vec<&[u8]> {
    line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).take(80).collect()
}

/// The columns between the identifier and the time.
struct Columns<'a> {
    channel: &'a [u8],
    id: &'a [u8],
    flags: Vec<u8>,
    len: &'a [u8],
    bytes: Vec<&'a [u8]>,
    time: &'a [u8],
    direction: &'a [u8],
}

/// The columns of a row; `None` if it is not a row.
fn columns(line: &[u8]) -> Option<Columns<'_>> {
    let words = words(line);
    let [channel, id, middle @ .., time, direction] = &words[..] else { return None };
    let letters = |word: &&&[u8]| word.iter().all(u8::is_ascii_alphabetic);
    let (flags, rest) = middle.split_at(middle.iter().take_while(letters).count());
    let (len, bytes) = rest.split_first().map_or((&b""[..], &[][..]), |(len, bytes)| (*len, bytes));
    Some(Columns { channel, id, flags: flags.concat(), len, bytes: bytes.to_vec(), time, direction })
}

impl Decoder {
    fn is_decimal(rows: &[u8]) -> bool {
        let rows = rows.split(|byte| *byte == b'\n').filter_map(columns);
        bytes_are_decimal(rows.flat_map(|columns| columns.bytes))
    }

    fn row(&self, columns: &Columns<'_>, line: &[u8]) -> Result<TraceRecord, Fault> {
        let Columns { channel, id, flags, len, bytes, time, direction } = columns;
        let number = text::decimal(channel).and_then(|channel| u8::try_from(channel.checked_add(1)?).ok());
        let channel = number.ok_or_else(|| Fault::malformed("a channel of 0 to 254", channel))?;
        let time_ns = text::time_of_any_mark(time, NS_PER_S).filter(|_| time.len() > 1);
        let time_ns = time_ns.ok_or_else(|| Fault::malformed("a time in seconds", time))?;
        let direction = match *direction {
            b"R" => Direction::Rx,
            b"T" => Direction::Tx,
            other => return Err(Fault::malformed("'R' or 'T' after the time", other)),
        };
        let record = |event| TraceRecord { time_ns, device_ns: None, channel, event };
        if flags.eq_ignore_ascii_case(b"ErrorFrame") || flags.eq_ignore_ascii_case(b"XErrorFrame") {
            return Ok(record(TraceEvent::BusError { kind: None, counters: None }));
        }
        if let Some(flag) = flags.iter().find(|flag| !b"XRFBE".contains(flag)) {
            return Err(Fault::malformed("flags: X, R, F, B or E", &[*flag]));
        }
        let has = |flag: u8| flags.contains(&flag);
        let raw = if self.is_decimal {
            text::decimal(id).and_then(|raw| u32::try_from(raw).ok())
        } else {
            text::hex(id)
        };
        let raw = raw.ok_or_else(|| Fault::malformed("an identifier", id))?;
        let id = identifier(raw, has(b'X'), id)?;
        let code = length_code(len)?;
        let fd = has(b'F').then(|| FdFields { brs: has(b'B'), esi: has(b'E') });
        let len = if fd.is_some() { fd_len(code) } else { code };
        let fields = FrameFields { id, remote: has(b'R'), direction, len, fd };
        if bytes.len() != fields.data_len() {
            return Err(Fault::malformed(format!("{} data bytes", fields.data_len()), line));
        }
        let byte = if self.is_decimal { decimal_byte } else { hex_byte };
        let data = Payload::words(bytes.iter().copied(), fields.data_len(), byte)?;
        Ok(record(fields.event(&data)?))
    }
}

impl RowFormat for Decoder {
    fn begin(&mut self, buffered: &[u8]) {
        self.is_decimal = Self::is_decimal(buffered);
        self.untold = self.is_decimal;
    }

    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        // CanKing's own messages, such as `Logging stopped.`
        if line.is_empty() || is_names(line) || line.starts_with(b"Logging ") {
            return Ok(Line::Nothing);
        }
        let fault = || Fault::malformed("a row such as '0  0CFBFFDB X  2  1B 31  100.000139 R'", line);
        self.row(&columns(line).ok_or_else(fault)?, line).map(Line::Record)
    }

    /// A row that has its direction is complete.
    fn may_be_cut(&self, _line: &[u8], _record: &TraceRecord) -> bool {
        false
    }

    fn note(&mut self) -> Option<&'static str> {
        std::mem::take(&mut self.untold).then_some(TAKEN_AS_DECIMAL)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::{Format, ReadOptions, TraceReader};

    const NAMES: &str = "Chn Identifier Flg   DLC  D0...1...2...3...4...5...6..D7       Time     Dir\n";

    fn as_log(rows: &str) -> (String, Vec<String>) {
        let (records, issues) = tests::read(Format::CanKing, format!("{NAMES}{rows}"));
        (tests::write(Format::Candump, &records), issues)
    }

    #[test]
    fn rows_with_all_flags_are_read() {
        let (log, issues) = as_log(
            " 0    0CFBFFDB X       8  1B  31  20  EB  B3  FF  D9  FF     100.000139 R\n \
             0    0000014B         1  00                                1675.570498 T\n \
             1    000007E8 R       3                                    1675.570500 R\n \
             0    00000000         0                                    1675.570501 R\n \
             0    00000123 FB      9  00  01  02  03  04  05  06  07  08  09  0A  0B  1676.000000 R\n \
             0    00000000            ErrorFrame                        1677.095270 R\n\
             Logging stopped.\n",
        );
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(100.000139) can0 0CFBFFDB#1B3120EBB3FFD9FF\n(1675.570498) can0 14B#00 T\n(1675.570500) can1 7E8#R3\n\
             (1675.570501) can0 000#\n(1676.000000) can0 123##1000102030405060708090A0B\n\
             (1677.095270) can0 20000080#0000000000000000\n"
        );
    }

    #[test]
    fn decimal_rows_are_recognised_and_that_is_told() {
        let rows = " 0         291         3   1  12 255                         1.000000 R\n";
        let (log, issues) = as_log(rows);
        assert_eq!((log.as_str(), issues), ("(1.000000) can0 123#010CFF\n", vec![]));
        let source = std::io::Cursor::new(format!("{NAMES}{rows}"));
        let options = ReadOptions::default();
        let mut reader = TraceReader::from_source("test", source, Format::CanKing, &options).unwrap();
        assert_eq!(reader.by_ref().count(), 1);
        assert_eq!(reader.notes().iter().collect::<Vec<_>>(), [(super::TAKEN_AS_DECIMAL, 1)]);
    }

    #[test]
    fn broken_rows_are_named() {
        let rows = "rubbish\n 0 00000123 2 11 1.0 R\n 0 00000123 1 1G 1.0 R\n 0 00000123 Q 1 11 1.0 R\n 300 00000123 0 1.0 R\n \
                    0 00000923 0 1.0 R\n 0 00000123 0 1.0 Q\n 0 00000123 0 x R\n 0 00000123 16 1.0 R\n 0 00000123 1 11 2.0";
        let (log, issues) = as_log(rows);
        assert_eq!((log.as_str(), issues.len()), ("", 10), "{issues:#?}");
        assert!(issues[9].contains("line 11: the file ends inside a line"), "{issues:#?}");
        // However much of a row is cut off, the rest is never a different row.
        let row = " 0    0CFBFFDB X       8  1B  31  20  EB  B3  FF  D9  FF     100.000139 R";
        for keep in 1..row.len() {
            let (log, issues) = as_log(&row[..keep]);
            assert_eq!((log.as_str(), issues.len()), ("", usize::from(keep > 1)), "{keep}: {issues:?}");
        }
    }
}
