//! The table of the earlier CANanalyser, shared by its CSV and DIF files: an index, the time from the start,
//! the frame, its errors, and its length on the bus.
//!
//! `Index;TimeStamps;D/R;S/E;CANId;DLC;D1;…;D8;ACK;FRM;CRC;STF;DE;SE;OVRBUF;FSiZ;SFF`: D or R for data or
//! remote, S or E for standard or extended, hexadecimal ID and data, Y in the column of the row's error, Y if
//! data and stamps were recorded, Y if frames were lost after this one, and the bits of the frame without
//! stuffing and of stuffing. Channel, direction, states and numbers of losses have no column.

mod csv;
mod decode;
mod encode;
mod style;

pub(crate) use csv::CsvLayout;
pub(crate) use decode::{RowDecoder, date};
pub(crate) use encode::{Cell, Layout, TableEncoder, TableRow};
pub use style::{DifConvention, LineEnd, TableStyle};

use cantap_can::BusErrorKind;
use cantap_trace::TraceEvent;

/// The names of the columns.
pub(crate) const COLUMNS: [&str; 23] = [
    "Index",
    "TimeStamps",
    "D/R",
    "S/E",
    "CANId",
    "DLC",
    "D1",
    "D2",
    "D3",
    "D4",
    "D5",
    "D6",
    "D7",
    "D8",
    "ACK",
    "FRM",
    "CRC",
    "STF",
    "DE",
    "SE",
    "OVRBUF",
    "FSiZ",
    "SFF",
];

/// Whether a text begins with the first names of the table's columns.
pub(crate) fn is_head(text: &[u8]) -> bool {
    let rest = text.strip_prefix(COLUMNS[0].as_bytes()).and_then(|rest| rest.get(1..));
    rest.is_some_and(|rest| rest.starts_with(COLUMNS[1].as_bytes()))
}

/// The error for each of the four columns from `ACK` on.
const ERRORS: [BusErrorKind; 4] =
    [BusErrorKind::Acknowledgment, BusErrorKind::Form, BusErrorKind::Crc, BusErrorKind::Stuff];

/// What the mark of a loss says: not how many, not where.
const OVERRUN: TraceEvent = TraceEvent::Lost { stage: None, count: 1, at_least: true };

#[cfg(test)]
mod tests {
    use super::super::tests;
    use super::*;
    use crate::{CsvDialect, Format, WriteOptions};
    use cantap_trace::testing::{frame, record};
    use cantap_trace::{Direction, TraceRecord};
    use proptest::prelude::*;

    const CSV: Format = Format::Csv(CsvDialect::Analyser);

    fn options(format: Format, table: TableStyle) -> WriteOptions {
        WriteOptions { format: Some(format), table, ..WriteOptions::default() }
    }

    /// The part of the records that the table can hold.
    fn kept(records: &[TraceRecord]) -> Vec<TraceRecord> {
        let mut kept: Vec<TraceRecord> = Vec::new();
        for record in records {
            let time_ns = record.time_ns;
            let event = match record.event {
                TraceEvent::Frame { frame, .. } => {
                    TraceEvent::Frame { frame, direction: Direction::Rx, late: false }
                }
                TraceEvent::BusError { kind, .. } => {
                    TraceEvent::BusError { kind: kind.filter(|kind| ERRORS.contains(kind)), counters: None }
                }
                TraceEvent::Lost { .. } => match kept.last() {
                    Some(TraceRecord { event: TraceEvent::Lost { .. }, .. }) | None => continue,
                    Some(before) => {
                        let lost = TraceEvent::Lost { stage: None, count: 1, at_least: true };
                        let record = TraceRecord { event: lost, ..*before };
                        kept.push(record);
                        continue;
                    }
                },
                _ => continue,
            };
            kept.push(TraceRecord { time_ns, device_ns: None, channel: 1, event });
        }
        kept
    }

    proptest! {
        #[test]
        fn any_trace_round_trips_as_far_as_the_table_carries(
            records in prop::collection::vec(record(1), 0..12),
            (comma, lf, rows) in any::<(bool, bool, bool)>(),
        ) {
            let style = TableStyle {
                separator: if comma { b',' } else { b';' },
                decimal_mark: if comma { b'.' } else { b',' },
                line_end: if lf { LineEnd::Lf } else { LineEnd::CrLf },
                dif: if rows { DifConvention::Rows } else { DifConvention::Columns },
            };
            for format in [CSV, Format::Dif] {
                let (bytes, left_out) = tests::write_with(&options(format, style), &records);
                let (read, issues) = tests::read(format, bytes);
                prop_assert_eq!(issues, Vec::<String>::new());
                let expected = kept(&records);
                prop_assert!(expected == records || !left_out.is_empty());
                prop_assert_eq!(read, expected);
            }
        }

        #[test]
        fn frames_of_channel_1_lose_nothing(frames in prop::collection::vec(frame(), 0..12)) {
            let event = |frame: cantap_trace::Frame| {
                let frame = frame.into();
                TraceEvent::Frame { frame, direction: Direction::Rx, late: false }
            };
            let record = |(at, frame)| TraceRecord { time_ns: at as i64, device_ns: None, channel: 1, event: event(frame) };
            let records: Vec<_> = frames.into_iter().enumerate().map(record).collect();
            prop_assert_eq!(tests::round_trip(CSV, &records), records.clone());
            prop_assert_eq!(tests::round_trip(Format::Dif, &records), records);
        }
    }

    /// The row from the analyser's own documentation.
    #[test]
    fn rows_are_the_analysers() {
        let frame = "000#55".parse().unwrap();
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        let record = TraceRecord { time_ns: 97_125, device_ns: None, channel: 1, event };
        let row = "1;0,000097125;D;S;0;1;55;;;;;;;;;;;;Y;Y;N;55;3";
        let csv = tests::write(CSV, &[record]);
        let lines: Vec<_> = csv.split("\r\n").collect();
        assert_eq!(
            lines[2],
            "Index;TimeStamps;D/R;S/E;CANId;DLC;D1;D2;D3;D4;D5;D6;D7;D8;ACK;FRM;CRC;STF;DE;SE;OVRBUF;FSiZ;SFF"
        );
        assert_eq!(lines[3..], [row, ""]);
        // Read from a file with comments of unknown meaning.
        let file =
            format!("CANanalyser\r\nDate : 14/09/2014 17:14:42\r\nFilter : all\r\n{}\r\n{row}\r\n", lines[2]);
        let (records, issues) = tests::read(CSV, file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Candump, &records), "(1410714882.000097) can0 000#55\n");
    }

    #[test]
    fn broken_rows_are_named() {
        let head = COLUMNS.join(";");
        let file =
            format!("{head}\n1;x;D;S;0;0\n2;0,1;Q;S;0;0\n3;0,1;D;S;800;0\n4;0,1;D;S;0;2;55\n5;0,1;D;S;0;0\n");
        let (records, issues) = tests::read(CSV, file);
        assert_eq!(records.len(), 1);
        assert_eq!(
            issues,
            [
                "test, line 2: expected a time in seconds under TimeStamps, found 'x'",
                "test, line 3: expected D or R, found 'Q'",
                "test, line 4: expected an identifier that fits its format, found '800'",
                "test, line 5: expected a byte under D2, found nothing",
            ]
        );
    }
}
