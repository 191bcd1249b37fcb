//! The table that Saleae's Logic 2 exports of its CAN analyser: a row for each field of a frame (`identifier_field`, `control_field`, `data_field`,
//! `crc_field`, `ack_field`), with the columns that its fields have and that were chosen. What other analysers decoded may stand between them.
//!
//! Source: the rows that `saleae/can-analyzer` makes, and Logic 2's exports. Logic 1's table has a frame in each row, and is a [`super::table`].

use super::frame_fields::{FrameFields, Payload, identifier};
use super::interfaces::Interfaces;
use super::issue::Fault;
use super::row_format::{Line, RowFormat};
use super::table::{date, split_cells};
use super::text::{self, NS_PER_S};
use super::zone::Zone;
use cantap_trace::{Direction, TraceRecord, counted};

const OTHERS: &str = "what other analysers decoded, and fields of no frame";
const ERRORS: &str = "errors that the analyser saw, of which the table does not say enough";
const NOT_ACKNOWLEDGED: &str = "frames that no other node acknowledged";

/// Reads the rows.
#[derive(Default)]
pub(crate) struct Decoder {
    columns: Option<Places>,
    interfaces: Interfaces,
    /// The frame whose fields are being read.
    open: Option<Open>,
    note: Option<&'static str>,
}

/// Where in a row everything is, from 0.
struct Places {
    name: usize,
    kind: usize,
    start: usize,
    identifier: usize,
    count: Option<usize>,
    data: Option<usize>,
    extended: Option<usize>,
    remote: Vec<usize>,
    ack: Option<usize>,
}

/// A frame of which not all fields were read.
struct Open {
    time_ns: i64,
    channel: u8,
    raw: u32,
    extended: bool,
    remote: bool,
    len: Option<usize>,
    bytes: Vec<u8>,
}

/// Whether a line is the names above the columns of such a table with CAN frames in it.
pub(crate) fn is_head(line: &[u8]) -> bool {
    Places::of(line).is_some()
}

impl Places {
    fn of(line: &[u8]) -> Option<Self> {
        let names = split_cells(b',', line);
        let at = |name: &str| names.iter().position(|own| own.eq_ignore_ascii_case(name.as_bytes()));
        let all = |wanted: [&str; 2]| wanted.into_iter().filter_map(at).collect();
        Some(Self {
            name: at("name")?,
            kind: at("type")?,
            start: at("start_time")?,
            identifier: at("identifier")?,
            count: at("num_data_bytes"),
            data: at("data"),
            extended: at("extended"),
            // The analyser spells it in both ways, for identifiers of 11 and of 29 bits.
            remote: all(["remote_frame", "RemoteFrame"]),
            ack: at("ack"),
        })
    }
}

/// A number in the base that was chosen: decimal, or behind `0x` or `0b`.
fn number(cell: &[u8]) -> Option<u64> {
    let text = std::str::from_utf8(cell).ok()?;
    match text.get(..2) {
        Some("0x" | "0X") => u64::from_str_radix(&text[2..], 16).ok(),
        Some("0b" | "0B") => u64::from_str_radix(&text[2..], 2).ok(),
        _ => text.parse().ok(),
    }
}

impl Open {
    fn record(&self) -> Result<TraceRecord, Fault> {
        let found = || format!("{} of them", self.bytes.len());
        let code = match self.len {
            Some(code) if code <= 15 && (self.remote || self.bytes.len() == code.min(8)) => code,
            Some(code) => return Err(Fault::malformed(counted(code, "data byte"), found().as_bytes())),
            None if self.remote => return Err(Fault::malformed("a frame's length", b"none")),
            // The column of lengths was not chosen.
            None => self.bytes.len(),
        };
        let id = identifier(self.raw, self.extended, format!("{:X}", self.raw).as_bytes())?;
        let data = if self.remote { Some(Payload::EMPTY) } else { Payload::of(&self.bytes) };
        let data = data.filter(|data| data.as_slice().len() <= 8);
        let data = data.ok_or_else(|| Fault::malformed("up to 8 data bytes", found().as_bytes()))?;
        let fields =
            FrameFields { id, remote: self.remote, direction: Direction::Rx, len: code as u8, fd: None };
        let (time_ns, channel) = (self.time_ns, self.channel);
        Ok(TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? })
    }
}

impl Decoder {
    /// Ends the frame that is open.
    fn close(&mut self) -> Result<Line, Fault> {
        self.open.take().map_or(Ok(Line::Nothing), |open| open.record().map(Line::Record))
    }

    fn row(&mut self, places: &Places, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        let row = split_cells(b',', line);
        let cell = |at: usize| row.get(at).copied().unwrap_or_default();
        let is_true = |at: usize| cell(at).eq_ignore_ascii_case(b"true");
        let wanted = |expected: &'static str, at: usize| {
            number(cell(at)).ok_or_else(|| Fault::malformed(expected, cell(at)))
        };
        match (cell(places.kind), &mut self.open) {
            (b"identifier_field", _) => {
                let raw = wanted("an identifier", places.identifier)?;
                let raw = u32::try_from(raw).unwrap_or(u32::MAX);
                let start = cell(places.start);
                let time_ns = text::time(start, NS_PER_S, b'.').or_else(|| date(start, zone));
                let time_ns = time_ns.ok_or_else(|| Fault::malformed("a time: seconds or a date", start))?;
                // One that was not acknowledged in this table has ended all the same.
                let last = self.close();
                self.open = Some(Open {
                    time_ns,
                    channel: self.interfaces.channel(cell(places.name)),
                    raw,
                    extended: places.extended.is_some_and(is_true) || raw > 0x7FF,
                    remote: places.remote.iter().any(|at| is_true(*at)),
                    len: None,
                    bytes: Vec::new(),
                });
                last
            }
            (b"control_field", Some(open)) => {
                open.len = match places.count {
                    Some(at) => Some(wanted("a length", at)? as usize),
                    None => None,
                };
                Ok(Line::Nothing)
            }
            (b"data_field", Some(open)) => {
                let at = places
                    .data
                    .ok_or_else(|| Fault::malformed("a column 'data': export the table with it", b"none"))?;
                let byte = wanted("a data byte", at)?;
                let byte = u8::try_from(byte).map_err(|_| Fault::malformed("a data byte", cell(at)))?;
                if open.bytes.len() < 8 {
                    open.bytes.push(byte);
                    return Ok(Line::Nothing);
                }
                self.open = None;
                Err(Fault::malformed("up to 8 data bytes", b"more"))
            }
            (b"crc_field", Some(_)) => Ok(Line::Nothing),
            (b"ack_field", Some(_)) => {
                self.note = places.ack.filter(|at| !is_true(*at)).map(|_| NOT_ACKNOWLEDGED);
                self.close()
            }
            (b"can_error", _) => {
                self.open = None;
                Ok(Line::LeftOut(ERRORS))
            }
            _ => Ok(Line::LeftOut(OTHERS)),
        }
    }
}

impl RowFormat for Decoder {
    fn line(&mut self, line: &[u8], zone: &Zone) -> Result<Line, Fault> {
        if line.is_empty() {
            return Ok(Line::Nothing);
        }
        let Some(places) = self.columns.take() else {
            let expected = "names above the columns: name, type, start_time, identifier and others";
            self.columns = Some(Places::of(line).ok_or_else(|| Fault::malformed(expected, line))?);
            return Ok(Line::Nothing);
        };
        let found = self.row(&places, line, zone);
        self.columns = Some(places);
        found
    }

    fn may_be_cut(&self, _line: &[u8], _record: &TraceRecord) -> bool {
        false
    }

    fn note(&mut self) -> Option<&'static str> {
        self.note.take()
    }

    fn missing(&self) -> Option<&'static str> {
        self.open.is_some().then_some("the rest of the last frame, up to its acknowledgement")
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    const HEAD: &str = "name,type,start_time,duration,\"identifier\",\"num_data_bytes\",\"data\",\"crc\",\"ack\",\"remote_frame\",\"extended\"\n";

    fn frame(time: &str, id: &str, bytes: &[&str], marks: &str) -> String {
        let identifier = format!("\"CAN\",\"identifier_field\",{time},2e-05,{id},,,,,{marks}\n");
        let control = format!("\"CAN\",\"control_field\",{time},1e-05,,{},,,,,\n", bytes.len());
        let data = bytes.iter().map(|byte| format!("\"CAN\",\"data_field\",{time},1e-05,,,{byte},,,,\n"));
        let rows = identifier + &control + &data.collect::<String>();
        rows + "\"CAN\",\"crc_field\",0.1,1e-05,,,,0x1234,,,\n\"CAN\",\"ack_field\",0.1,1e-05,,,,,true,,\n"
    }

    #[test]
    fn frames_are_put_together_from_their_fields() {
        let file = [
            HEAD,
            &frame("-0.001", "0x0000000000000123", &["0x11", "0x22"], ","),
            "\"SPI\",\"result\",0.001,1e-05,,,0x11,,,,\n",
            &frame("0.001", "291", &["17", "0b00100010"], ",true"),
            &frame("2026-09-22T08:20:18.204048396+00:00", "0x456", &[], "true,"),
        ]
        .concat();
        assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Saleae));
        let (log, issues) = tests::as_log(Format::Saleae, file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(-0.001000) can0 123#1122\n(0.001000) can0 00000123#1122\n(1790065218.204048) can0 456#R\n"
        );
    }

    #[test]
    fn a_frame_that_was_destroyed_or_is_not_whole_is_none() {
        let whole = frame("1.5", "0x7FF", &["0x11"], ",");
        let destroyed =
            "\"CAN\",\"identifier_field\",1,1e-05,0x1,,,,,,\n\"CAN\",\"can_error\",1,1e-05,,,,,,,\n";
        let short = "\"CAN\",\"identifier_field\",1,1e-05,0x2,,,,,,\n\"CAN\",\"control_field\",1,1e-05,,2,,,,,\n\
                     \"CAN\",\"data_field\",1,1e-05,,,0x11,,,,\n";
        let file = [HEAD, destroyed, short, &whole, short].concat();
        let (records, issues) = tests::read(Format::Saleae, file);
        assert_eq!(tests::write(Format::Candump, &records), "(1.500000) can0 7FF#11\n");
        assert_eq!(issues.len(), 2, "{issues:#?}");
        assert!(issues[0].contains("expected 2 data bytes, found '1 of them'"), "{issues:#?}");
        assert!(issues[1].contains("up to its acknowledgement"), "{issues:#?}");
        // Rows before any frame, nonsense in cells, and nine bytes.
        let nine = frame("1", "0x1", &["1"; 9], ",");
        let odd =
            [HEAD, "\"CAN\",\"data_field\",1,1,,,x,,,,\n\"CAN\",\"identifier_field\",1,1,x,,,,,,\n", &nine]
                .concat();
        let (records, issues) = tests::read(Format::Saleae, odd);
        assert_eq!((records.len(), issues.len()), (0, 2), "{issues:#?}");
    }
}
