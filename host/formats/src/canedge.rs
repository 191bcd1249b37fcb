//! The CSV that CSS Electronics' converters make of a CANedge logger's files:
//! `TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;ESI;RTR;DataBytes`. Which columns there are varies with the version; their names say
//! what they are.

use super::frame_fields::{FdFields, FrameFields, Payload, identifier};
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord};

/// How a file begins.
const FIRST: &[u8] = b"TimestampEpoch";

/// The columns that are read. The first ones must be there.
const COLUMNS: [&[u8]; 12] = [
    FIRST,
    b"ID",
    b"IDE",
    b"DataBytes",
    b"BusChannel",
    b"DLC",
    b"DataLength",
    b"Dir",
    b"EDL",
    b"BRS",
    b"ESI",
    b"RTR",
];
const NEEDED: usize = 4;

/// Reads the rows.
#[derive(Default)]
pub(crate) struct Decoder {
    /// What separates cells; 0 before the head.
    separator: u8,
    /// Where each of [`COLUMNS`] is.
    places: [Option<usize>; COLUMNS.len()],
    /// How many cells a row has.
    cells: usize,
}

/// Whether a line is the head of such a file.
pub(crate) fn is_head(line: &[u8]) -> bool {
    line.strip_prefix(FIRST)
        .and_then(<[u8]>::first)
        .is_some_and(|separator| matches!(separator, b';' | b',' | b'\t'))
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], _zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() {
            return Ok(Line::Nothing);
        }
        if self.separator == 0 {
            return self.head(line).map(|()| Line::Nothing);
        }
        let cells: Vec<_> = line.split(|byte| *byte == self.separator).map(<[u8]>::trim_ascii).collect();
        if cells.len() != self.cells {
            return Err(Fault::malformed(format!("{} cells, as in the head", self.cells), line));
        }
        let cell = |column: usize| self.places[column].and_then(|place| cells.get(place).copied());
        let number = |column: usize, most: u64, expected: &'static str| match cell(column) {
            None => Ok(None),
            Some(text) => {
                let number = text::decimal(text).filter(|number| *number <= most);
                number.map(Some).ok_or_else(|| Fault::malformed(expected, text))
            }
        };
        let flag = |column: usize| number(column, 1, "0 or 1").map(|flag| flag == Some(1));
        let time = cell(0).unwrap_or_default();
        let time_ns = text::time_of_any_mark(time, NS_PER_S);
        let time_ns = time_ns.ok_or_else(|| Fault::malformed("a time in seconds since 1970", time))?;
        let id = cell(1).unwrap_or_default();
        let raw = text::hex(id).ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id))?;
        let id = identifier(raw, flag(2)?, id)?;
        let channel = number(4, 255, "a channel of 0 to 255")?.unwrap_or(1) as u8;
        let code = number(5, 15, "a data length code of 0 to 15")?;
        let data_length = number(6, 64, "a length of 0 to 64")?;
        let direction = if flag(7)? { Direction::Tx } else { Direction::Rx };
        let fd = if flag(8)? { Some(FdFields { brs: flag(9)?, esi: flag(10)? }) } else { None };
        let remote = flag(11)?;
        let bytes = cell(3).unwrap_or_default();
        let len = bytes.len() / 2;
        let expected = || format!("{} data bytes", data_length.unwrap_or(len as u64));
        let is_whole =
            bytes.len().is_multiple_of(2) && (remote || data_length.is_none_or(|said| said == len as u64));
        if !is_whole {
            return Err(Fault::malformed(expected(), bytes));
        }
        let byte = |pair: &[u8]| match pair {
            [high, low] => text::hex_pair(*high, *low),
            _ => None,
        };
        // A remote frame's bytes, if there are any, are what it asks for and nobody sent.
        let data = if remote { Payload::EMPTY } else { Payload::words(bytes.chunks_exact(2), len, byte)? };
        let code = code.map_or(len, |code| code as usize);
        let len = if fd.is_some() {
            len
        } else if remote || len == 8 && code > 8 {
            code
        } else {
            len
        };
        let fields = FrameFields { id, remote, direction, len: len as u8, fd };
        if fd.is_none() && fields.data_len() != data.as_slice().len() {
            return Err(Fault::malformed("up to 8 data bytes", bytes));
        }
        Ok(Line::Record(TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? }))
    }

    fn may_be_cut(&self, _line: &[u8], record: &TraceRecord) -> bool {
        // There are as many bytes as the length says, if it says one.
        self.places[6].is_none()
            || record.frame().is_none_or(|frame| frame.is_remote() || frame.data().is_empty())
    }
}

impl Decoder {
    fn head(&mut self, line: &[u8]) -> Result<(), Fault> {
        let fault =
            || Fault::malformed("the names TimestampEpoch, ID, IDE and DataBytes above the columns", line);
        let separator = line.get(FIRST.len()).copied().filter(|_| is_head(line)).ok_or_else(fault)?;
        let names: Vec<_> = line.split(|byte| *byte == separator).map(<[u8]>::trim_ascii).collect();
        let places = COLUMNS.map(|column| names.iter().position(|name| *name == column));
        if places[..NEEDED].contains(&None) {
            return Err(fault());
        }
        (self.separator, self.places, self.cells) = (separator, places, names.len());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    const HEAD: &str = "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;ESI;RTR;DataBytes\n";

    fn as_log(file: &str) -> (String, Vec<String>) {
        tests::as_log(Format::CanEdgeCsv, file)
    }

    #[test]
    fn every_kind_of_frame_is_read() {
        let (log, issues) = as_log(&format!(
            "{HEAD}1670926807.419500;1;000;0;1;1;0;0;0;0;0;AA\n1670926807.419700;9;7FF;0;8;8;1;0;0;0;0;0102030405060708\n\
             1670926807.419900;1;00000000;1;9;12;0;1;1;0;0;000102030405060708090A0B\n\
             1670926807.420000;2;123;0;2;2;0;1;0;1;0;AABB\n1670926807.420100;1;123;0;12;8;0;0;0;0;0;0102030405060708\n\
             1670926807.420200;1;123;0;4;0;0;0;0;0;1;\n1670926807.420300;1;123;0;0;0;0;0;0;0;0;\n"
        ));
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(1670926807.419500) can0 000#AA\n(1670926807.419700) can8 7FF#0102030405060708 T\n\
             (1670926807.419900) can0 00000000##1000102030405060708090A0B\n(1670926807.420000) can1 123##2AABB\n\
             (1670926807.420100) can0 123#0102030405060708_C\n(1670926807.420200) can0 123#R4\n\
             (1670926807.420300) can0 123#\n"
        );
    }

    #[test]
    fn columns_are_found_by_their_names() {
        let (log, issues) = as_log(
            "TimestampEpoch,IDE,ID,DataBytes\n1578922367.777150,1,14FF0121,6A0A\n1578922367,8,0,123,\n",
        );
        assert_eq!(log, "(1578922367.777150) can0 14FF0121#6A0A\n");
        assert_eq!(issues.len(), 1, "{issues:?}");
        let (log, issues) = as_log("TimestampEpoch;ID;DataBytes\n1.0;123;00\n");
        assert_eq!((log.as_str(), issues.len()), ("", 2), "{issues:?}");
    }

    #[test]
    fn broken_rows_are_named() {
        let rows = [
            "x;1;123;0;1;1;0;0;0;0;0;AA",
            "1.0;300;123;0;1;1;0;0;0;0;0;AA",
            "1.0;1;XYZ;0;1;1;0;0;0;0;0;AA",
            "1.0;1;800;0;1;1;0;0;0;0;0;AA",
            "1.0;1;123;2;1;1;0;0;0;0;0;AA",
            "1.0;1;123;0;16;1;0;0;0;0;0;AA",
            "1.0;1;123;0;2;2;0;0;0;0;0;AA",
            "1.0;1;123;0;1;1;0;0;0;0;0;AAB",
            "1.0;1;123;0;1;1;0;0;0;0;0;GG",
            "1.0;1;123;0;9;12;0;0;0;0;0;000102030405060708090A0B",
            "1.0;1;123;0;1;1;0;0;0;0;AA",
            "2.0;1;123;0;1;1;0;0;0;0;0;AA",
            "3.0;1;123;0;2;2;0;0;0;0;0;AA",
        ];
        let (log, issues) = as_log(&format!("{HEAD}{}", rows.join("\n")));
        assert_eq!(log, "(2.000000) can0 123#AA\n");
        assert_eq!(issues.len(), 12, "{issues:#?}");
        assert!(issues[11].contains("the file ends inside a line"), "{issues:#?}");
    }
}
