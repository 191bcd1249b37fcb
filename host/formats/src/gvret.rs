//! SavvyCAN's own CSV, which GVRET boards and their tools write too: `Time Stamp,ID,Extended,Dir,Bus,LEN,D1,…,D8`, times in
//! microseconds, buses from 0. Older files have no direction.

use super::found::Row;
use super::frame_fields::{FdFields, FrameFields, Payload, direction, hex_byte, identifier};
use super::issue::Fault;
use super::text;
use cantap_trace::{Direction, TraceRecord};

/// Reads the rows.
#[derive(Default)]
pub(crate) struct RowDecoder {
    has_direction: bool,
}

const HEAD: &[u8] = b"Time Stamp,ID,Extended,";

/// Whether a text begins as such a file does.
pub(crate) fn is_head(line: &[u8]) -> bool {
    line.get(..HEAD.len()).is_some_and(|start| start.eq_ignore_ascii_case(HEAD))
}

impl RowDecoder {
    /// Looks at a line that may be the head; true if it is.
    pub(crate) fn head(&mut self, line: &[u8]) -> bool {
        self.has_direction =
            line.split(|byte| *byte == b',').nth(3).is_some_and(|name| name.eq_ignore_ascii_case(b"Dir"));
        is_head(line)
    }

    /// A row.
    pub(crate) fn line(&self, line: &[u8]) -> Result<Row, Fault> {
        const NS_PER_US: i64 = 1000;
        let mut cells = line.split(|byte| *byte == b',').map(<[u8]>::trim_ascii);
        let mut next = || cells.next().unwrap_or_default();
        let (time, id, extended) = (next(), next(), next());
        let time_ns = text::time(time, NS_PER_US, b'.');
        let time_ns = time_ns.ok_or_else(|| Fault::malformed("a time in microseconds", time))?;
        let digits = id.strip_prefix(b"0x").unwrap_or(id);
        let raw =
            text::hex(digits).ok_or_else(|| Fault::malformed("an identifier in hexadecimal digits", id))?;
        let extended = match extended {
            // Files are about that leave the mark out, where the identifier alone says it.
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
        let data = Payload::words(cells, fields.data_len(), hex_byte)?;
        Ok(Some((TraceRecord { time_ns, channel, event: fields.event(&data)? }, None)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::{CsvDialect, Format};

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
