//! SavvyCAN's own CSV, which GVRET boards and their tools write too: `Time Stamp,ID,Extended,Dir,Bus,LEN,D1,…,D8`, times in
//! microseconds, buses from 0. Older files have no direction.

use super::codec::{Encode, HeadLine};
use super::found::Row;
use super::frame_fields::{FdFields, FrameFields, Payload, direction, hex_byte, identifier};
use super::issue::Fault;
use super::left_out::LeftOut;
use super::text;
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};
use serde::{Deserialize, Serialize};

/// Reads the rows.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct RowDecoder {
    has_direction: bool,
}

const HEAD: &[u8] = b"Time Stamp,ID,Extended,";

/// Whether a line is the header of such a file.
pub(crate) fn is_head(line: &[u8]) -> bool {
    line.get(..HEAD.len()).is_some_and(|start| start.eq_ignore_ascii_case(HEAD))
}

/// Whether a line is a row of such a file, from which somebody cut out what he needed.
pub(crate) fn is_row(line: &[u8]) -> bool {
    let mut cells = line.split(|byte| *byte == b',').map(<[u8]>::trim_ascii);
    let mut next = || cells.next().unwrap_or_default();
    let (time, id, extended) = (next(), next(), next());
    let is_start = text::decimal(time).is_some()
        && id.len() == 8
        && (extended.eq_ignore_ascii_case(b"false") || extended.eq_ignore_ascii_case(b"true"));
    is_start && RowDecoder { has_direction: direction(next()).is_ok() }.line(line).is_ok()
}

/// Nanoseconds per unit of time in the file.
const NS_PER_US: i64 = 1000;

impl RowDecoder {
    /// Takes a line that may be the header; true if it is.
    pub(crate) fn head(&mut self, line: &[u8]) -> bool {
        self.has_direction =
            line.split(|byte| *byte == b',').nth(3).is_some_and(|name| name.eq_ignore_ascii_case(b"Dir"));
        is_head(line)
    }

    /// Takes a row of a file without its header; true if it is one.
    pub(crate) fn headless(&mut self, line: &[u8]) -> bool {
        let fourth = line.split(|byte| *byte == b',').nth(3).map(<[u8]>::trim_ascii);
        self.has_direction = fourth.is_some_and(|way| direction(way).is_ok());
        is_row(line)
    }

    /// A row.
    pub(crate) fn line(&self, line: &[u8]) -> Result<Row, Fault> {
        let mut cells = line.split(|byte| *byte == b',').map(<[u8]>::trim_ascii);
        let mut next = || cells.next().unwrap_or_default();
        let (time, id, extended) = (next(), next(), next());
        let time_ns = text::time(time, NS_PER_US, b'.');
        let time_ns = time_ns.ok_or_else(|| Fault::malformed("a time in microseconds", time))?;
        let digits = id.strip_prefix(b"0x").unwrap_or(id);
        let raw =
            text::hex(digits).ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id))?;
        let extended = match extended {
            // Some files leave the mark out if the identifier alone shows it.
            b"false" | b"False" | b"FALSE" | b"0" => raw > 0x7FF,
            b"true" | b"True" | b"TRUE" | b"1" => true,
            other => return Err(Fault::malformed("'true' or 'false' under Extended", other)),
        };
        let direction = if self.has_direction { direction(next())? } else { Direction::Rx };
        let bus = next();
        let channel = text::decimal(bus).and_then(|bus| u8::try_from(bus.checked_add(1)?).ok());
        let channel = channel.ok_or_else(|| Fault::malformed("a bus of 0 to 254", bus))?;
        let len = next();
        let number = text::decimal(len).filter(|len| *len <= 64);
        let len = number.ok_or_else(|| Fault::malformed("a length of 0 to 64", len))? as u8;
        let fd = (len > 8).then(FdFields::default);
        let fields = FrameFields { id: identifier(raw, extended, id)?, remote: false, direction, len, fd };
        // Some programs write 0x before bytes, and some no zero before a single digit.
        let byte = |cell: &[u8]| match cell.strip_prefix(b"0x").unwrap_or(cell) {
            [digit] => text::hex_digit(*digit),
            digits => hex_byte(digits),
        };
        let data = Payload::words(cells, fields.data_len(), byte)?;
        Ok(Some((TraceRecord { time_ns, device_ns: None, channel, event: fields.event(&data)? }, None)))
    }
}

/// The header written before the rows.
const WRITTEN_HEAD: &str = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8";

/// Writes the rows.
pub(crate) struct Encoder(HeadLine);

impl Default for Encoder {
    fn default() -> Self {
        Self(HeadLine::of(WRITTEN_HEAD))
    }
}

impl Encode for Encoder {
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut) {
        self.0.write(out);
        let (frame, direction) = match &record.event {
            TraceEvent::Frame { frame, .. } if frame.is_remote() => {
                return left_out.note("remote frames, which SavvyCAN's CSV has no form for");
            }
            TraceEvent::Frame { frame, direction, .. } => (frame, direction),
            _ => return left_out.note("errors, states and losses, which SavvyCAN's CSV has no form for"),
        };
        let Some(bus) = record.channel.checked_sub(1) else {
            return left_out.note("frames of channel 0, which SavvyCAN's CSV has no number for");
        };
        match frame {
            TraceFrame::Fd(frame) => {
                if frame.data_len() <= 8 {
                    left_out
                        .note("that short CAN FD frames are such, which SavvyCAN's CSV has no column for");
                }
                if frame.flags() != 0 {
                    left_out.note("the flags of CAN FD frames, which SavvyCAN's CSV has no column for");
                }
            }
            TraceFrame::Classic(frame) if frame.dlc() > 8 => {
                left_out.note("length codes above 8, which SavvyCAN's CSV has no form for");
            }
            TraceFrame::Classic(_) => {}
        }
        text::push_time(out, record.time_ns, NS_PER_US, 0, b'.');
        out.push(b',');
        text::push_hex(out, frame.id().raw(), 8);
        out.extend_from_slice(if frame.id().is_extended() { b",true," } else { b",false," });
        out.extend_from_slice(if *direction == Direction::Tx { b"Tx," } else { b"Rx," });
        text::push_decimal(out, u64::from(bus));
        out.push(b',');
        text::push_decimal(out, frame.data_len() as u64);
        out.push(b',');
        for byte in frame.data() {
            text::push_hex_byte(out, *byte);
            out.push(b',');
        }
        out.push(b'\n');
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.0.write(out);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::{CsvDialect, Format, WriteOptions};

    const CSV: Format = Format::Csv(CsvDialect::Gvret);

    #[test]
    fn files_with_and_without_directions_are_read() {
        let file = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n\
                    39747828,000005EB,false,Rx,0,8,E8,45,85,4B,4A,28,36,69,\n\
                    39747829,18DAF110,true,Tx,1,2,E8,45,00,00,00,00,00,00,\n\
                    1410714882622188,00000012,false,Rx,2,0,\n";
        let (records, issues) = tests::read(CSV, file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(39.747828) can0 5EB#E845854B4A283669\n(39.747829) can1 18DAF110#E845 T\n\
             (1410714882.622188) can2 012#\n"
        );
        let old =
            "Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n166064000,0000021A,false,0,3,FE,36,12\n";
        let (records, issues) = tests::read(CSV, old);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Candump, &records), "(166.064000) can0 21A#FE3612\n");
        // What `grep` leaves of it.
        for rows in [
            "370458000,00000394,false,0,3,00,E0,98\r\n370478000,18DAF110,true,1,2,FE,36\r\n",
            "370458000,00000394,false,Rx,0,3,00,E0,98,\n370478000,18DAF110,true,Rx,1,2,FE,36,00,00,00,00,00,00,\n",
        ] {
            assert_eq!(Format::of_content(rows.as_bytes()), Some(CSV));
            let (log, issues) = tests::as_log(CSV, rows);
            assert_eq!(log, "(370.458000) can0 394#00E098\n(370.478000) can1 18DAF110#FE36\n");
            assert_eq!(issues, Vec::<String>::new());
        }
    }

    #[test]
    fn rows_are_savvycans_and_what_they_have_no_form_for_is_counted() {
        let log = "(1410714882.622188) can0 123#1122\n(1410714882.622189) can1 18DAF110#0102030405060708 T\n\
                   (1410714882.622190) can0 124##1000102030405060708090A0B\n(1410714882.622191) can0 124##011\n\
                   (1410714882.622192) can0 125#0102030405060708_C\n(1410714882.622193) can0 123#R4\n\
                   (1410714882.622194) channel0 123#11\n(1410714882.622195) can0 20000088#0000040000000000\n\
                   (-1.500000) can0 123#\n";
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!((records.len(), issues), (9, vec![]));
        let options = WriteOptions { format: Some(CSV), ..WriteOptions::default() };
        let (bytes, left_out) = tests::write_with(&options, &records);
        assert_eq!(
            String::from_utf8(bytes.clone()).unwrap(),
            "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n\
             1410714882622188,00000123,false,Rx,0,2,11,22,\n\
             1410714882622189,18DAF110,true,Tx,1,8,01,02,03,04,05,06,07,08,\n\
             1410714882622190,00000124,false,Rx,0,12,00,01,02,03,04,05,06,07,08,09,0A,0B,\n\
             1410714882622191,00000124,false,Rx,0,1,11,\n\
             1410714882622192,00000125,false,Rx,0,8,01,02,03,04,05,06,07,08,\n\
             -1500000,00000123,false,Rx,0,0,\n"
        );
        let counts: Vec<_> =
            left_out.iter().map(|(what, count)| (what.split(',').next().unwrap(), count)).collect();
        let expected = [
            ("errors", 1),
            ("frames of channel 0", 1),
            ("length codes above 8", 1),
            ("remote frames", 1),
            ("that short CAN FD frames are such", 1),
            ("the flags of CAN FD frames", 1),
        ];
        assert_eq!(counts, expected);
        let (read, issues) = tests::read(CSV, bytes);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &read),
            "(1410714882.622188) can0 123#1122\n(1410714882.622189) can1 18DAF110#0102030405060708 T\n\
             (1410714882.622190) can0 124##0000102030405060708090A0B\n(1410714882.622191) can0 124#11\n\
             (1410714882.622192) can0 125#0102030405060708\n(-1.500000) can0 123#\n"
        );
    }

    #[test]
    fn bytes_with_0x_in_front_are_read() {
        let file = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2\n1,0x123,false,Rx,0,2,0x11,0xFF\n2,0x123,false,Rx,0,1,0x1,\n";
        let (records, issues) = tests::read(CSV, file);
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(0.000001) can0 123#11FF\n(0.000002) can0 123#01\n"
        );
        assert_eq!(issues, Vec::<String>::new());
    }

    /// As two collections of real files have them, of which most lines were lost.
    #[test]
    fn bytes_without_a_leading_zero_are_read() {
        let file = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3\n1,123,false,Rx,0,3,3,E8,0,\n2,123,false,Rx,0,3,3,E8,G,\n3,123,false,Rx,0,3,3,E8,0";
        let (records, issues) = tests::read(CSV, file);
        assert_eq!(tests::write(Format::Candump, &records), "(0.000001) can0 123#03E800\n");
        assert_eq!(
            issues,
            [
                "test, line 3: expected 3 data bytes, found 'G'",
                "test, line 4: the file ends inside a line; everything before it was read",
            ]
        );
    }

    #[test]
    fn broken_rows_are_named() {
        let file = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2\n\
                    x,1,false,Rx,0,0,\n1,G,false,Rx,0,0,\n1,1,maybe,Rx,0,0,\n1,1,false,Px,0,0,\n1,1,false,Rx,300,0,\n\
                    1,1,false,Rx,0,65,\n1,1,false,Rx,0,2,11,\n1,20000000,true,Rx,0,0,\n2,1,false,Rx,0,1,AA,\n3,1,fal";
        let (records, issues) = tests::read(CSV, file);
        assert_eq!(tests::write(Format::Candump, &records), "(0.000002) can0 001#AA\n");
        assert_eq!(
            issues,
            [
                "test, line 2: expected a time in microseconds, found 'x'",
                "test, line 3: expected an identifier in hexadecimal digits, found 'G'",
                "test, line 4: expected 'true' or 'false' under Extended, found 'maybe'",
                "test, line 5: expected 'Rx' or 'Tx', found 'Px'",
                "test, line 6: expected a bus of 0 to 254, found '300'",
                "test, line 7: expected a length of 0 to 64, found '65'",
                "test, line 8: expected 2 data bytes, found nothing",
                "test, line 9: expected an identifier up to 1FFFFFFF, found '20000000'",
                "test, line 11: the file ends inside a line; everything before it was read",
            ]
        );
    }
}
