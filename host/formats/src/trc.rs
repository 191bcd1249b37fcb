//! PEAK's TRC, versions 1.0 to 2.1 (document "PEAK CAN TRC File Format", last update 2020-07-27): columns of text with
//! times relative to a date in the header, and lines ended by CR LF.
//!
//! What each version can carry differs; what it cannot is counted. Everything that is not a frame is written
//! in the version's own form, accompanied by an exact text. Dates are taken as UTC.

mod decode;
mod encode;
mod layout;

pub(crate) use decode::{Decoder, is_head};
pub(crate) use encode::Encoder;

use cantap_can::{BusErrorKind, ErrorState, LossStage};

use super::sja1000;
use cantap_trace::TraceEvent;

/// A version of the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum TrcVersion {
    /// Whole milliseconds, no direction, no bus number.
    V1_0,
    /// Tenths of milliseconds and the direction.
    V1_1,
    /// Microseconds and the bus number.
    V1_2,
    /// A reserved column.
    V1_3,
    /// Columns named in the header; no bus number.
    V2_0,
    /// With the bus number again.
    V2_1,
}

impl TrcVersion {
    /// The oldest first.
    const ALL: [Self; 6] = [Self::V1_0, Self::V1_1, Self::V1_2, Self::V1_3, Self::V2_0, Self::V2_1];

    /// The name in the file's header; 1.0 has none.
    fn name(self) -> &'static str {
        match self {
            Self::V1_0 => "1.0",
            Self::V1_1 => "1.1",
            Self::V1_2 => "1.2",
            Self::V1_3 => "1.3",
            Self::V2_0 => "2.0",
            Self::V2_1 => "2.1",
        }
    }

    /// Whether there is a column for the bus.
    fn has_bus(self) -> bool {
        matches!(self, Self::V1_2 | Self::V1_3 | Self::V2_1)
    }

    /// Whether the length column is a number of bytes instead of the bus's length code.
    fn has_length(self) -> bool {
        matches!(self, Self::V1_1 | Self::V2_0)
    }

    /// Decimal digits of a millisecond.
    fn decimals(self) -> u32 {
        match self {
            Self::V1_0 => 0,
            Self::V1_1 => 1,
            _ => 3,
        }
    }
}

/// The last column of the table of buses in the head, as PCAN-Explorer has it.
const BIT_RATE: &str = "Bit rate";

/// `500 kBit/s`, as PEAK's programs write a bit rate; exact.
fn bit_rate_text(bps: u32) -> String {
    if bps.is_multiple_of(1_000_000) {
        format!("{} MBit/s", bps / 1_000_000)
    } else {
        format!("{} kBit/s", f64::from(bps) / 1e3)
    }
}

/// The bus and its bit rate, outside data phases, in a row of the table of buses: `1  PCAN  Untitled@pcan_usb  CAN  500 kbit/s`; of
/// a bus with CAN FD `Nominal 1 MBit/s, Data 8 MBit/s`.
fn bus_row(row: &[u8]) -> Option<(u8, u32)> {
    let row = std::str::from_utf8(row).ok()?;
    let words: Vec<_> = row.split_ascii_whitespace().collect();
    let channel = words.first()?.parse().ok()?;
    let rate = words.windows(2).skip(1).find_map(|pair| {
        let number: f64 = pair[0].parse().ok()?;
        let factor = match pair[1].trim_end_matches(',').to_ascii_lowercase().as_str() {
            "bit/s" => 1.0,
            "kbit/s" => 1e3,
            "mbit/s" => 1e6,
            _ => return None,
        };
        Some((number * factor).round() as u32)
    });
    Some((channel, rate?))
}

/// Days from the format's day 0, 1899-12-30, to the Unix epoch.
const EPOCH_DAY: i64 = 25_569;

/// The identifier of a row that is a warning.
const WARNING_ID: &[u8] = b"FFFFFFFF";

// The hardware's status, as in PCAN-Basic's PCAN_ERROR_ codes.
const OVERRUN: u32 = 0x02;
const BUS_LIGHT: u32 = 0x04;
const BUS_WARNING: u32 = 0x08;
const BUS_OFF: u32 = 0x10;
const QUEUE_OVERRUN: u32 = 0x40;
const BUS_PASSIVE: u32 = 0x4_0000;

// The types of errors in error rows.
const BIT: u8 = 1;
const FORM: u8 = 2;
const STUFF: u8 = 4;
const OTHER: u8 = 8;

/// The status for an event; 0 if there is none.
fn status_of(event: &TraceEvent) -> u32 {
    match event {
        TraceEvent::Lost { stage: Some(LossStage::Controller), .. } => OVERRUN,
        TraceEvent::Lost { .. } => QUEUE_OVERRUN,
        TraceEvent::State { state: ErrorState::Warning, .. } => BUS_WARNING,
        TraceEvent::State { state: ErrorState::Passive, .. } => BUS_PASSIVE,
        TraceEvent::State { state: ErrorState::BusOff, .. } => BUS_OFF,
        _ => 0,
    }
}

/// The event for a status; `None` if it concerns neither the bus nor a loss.
fn event_of(status: u32) -> Option<TraceEvent> {
    let state = |state| Some(TraceEvent::State { state, counters: None });
    match status {
        _ if status & OVERRUN != 0 => {
            Some(TraceEvent::Lost { stage: Some(LossStage::Controller), count: 1, at_least: true })
        }
        _ if status & QUEUE_OVERRUN != 0 => Some(TraceEvent::Lost { stage: None, count: 1, at_least: true }),
        _ if status & BUS_OFF != 0 => state(ErrorState::BusOff),
        _ if status & BUS_PASSIVE != 0 => state(ErrorState::Passive),
        _ if status & (BUS_WARNING | BUS_LIGHT) != 0 => state(ErrorState::Warning),
        0 => state(ErrorState::Active),
        _ => None,
    }
}

/// An error row's type and position.
fn error_code(kind: Option<BusErrorKind>) -> (u8, u8) {
    const SEGMENT: u8 = 0x1F;
    let class = match kind {
        Some(BusErrorKind::Stuff) => STUFF,
        Some(BusErrorKind::Form) => FORM,
        Some(BusErrorKind::BitRecessive | BusErrorKind::BitDominant) => BIT,
        Some(BusErrorKind::Acknowledgment | BusErrorKind::Crc) | None => OTHER,
    };
    (class, kind.map_or(0, |kind| sja1000::code(kind) & SEGMENT))
}

/// The error of an error row.
fn error_of(class: u32, position: u8, counters: (u8, u8)) -> TraceEvent {
    let other = 3 << 6 | position & 0x1F;
    let kind = match class {
        class if class == u32::from(STUFF) => Some(BusErrorKind::Stuff),
        class if class == u32::from(FORM) => Some(BusErrorKind::Form),
        class if class == u32::from(OTHER) => sja1000::kind(other),
        _ => None,
    };
    TraceEvent::BusError { kind, counters: Some(counters) }
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use super::*;
    use crate::{Format, LeftOut, WriteOptions};
    use cantap_can::Frame;
    use cantap_trace::testing::record_or_fd;
    use cantap_trace::{Direction, TraceFrame, TraceRecord};
    use proptest::prelude::*;

    const VERSIONS: [TrcVersion; 6] = [
        TrcVersion::V1_0,
        TrcVersion::V1_1,
        TrcVersion::V1_2,
        TrcVersion::V1_3,
        TrcVersion::V2_0,
        TrcVersion::V2_1,
    ];

    /// What a version keeps of a record.
    fn kept(version: TrcVersion, record: &TraceRecord) -> Option<TraceRecord> {
        if version < TrcVersion::V2_0 && record.frame().is_some_and(TraceFrame::is_fd) {
            return None;
        }
        let mut kept = *record;
        let is_frame = record.frame().is_some();
        // The texts of events include the channel.
        if !version.has_bus() && is_frame {
            kept.channel = 1;
        }
        if let TraceEvent::Frame { frame, direction, .. } = &mut kept.event {
            if version == TrcVersion::V1_0 {
                *direction = Direction::Rx;
            }
            if let (true, TraceFrame::Classic(frame)) = (version.has_length(), frame) {
                *frame =
                    Frame::from_bus(frame.id(), frame.is_remote(), frame.dlc().min(8), frame.padded_data());
            }
        }
        Some(kept)
    }

    /// As programs without a clock write it: times run from 0 and not from 1899.
    #[test]
    fn a_start_of_0_is_no_date() {
        let rows = "      1)         5.0  Rx         0120  1  11\r\n";
        let first = |head: &str| {
            let (records, issues) =
                tests::read(Format::Trc(TrcVersion::V1_1), format!(";$FILEVERSION=1.1\r\n{head}{rows}"));
            assert_eq!(issues, Vec::<String>::new());
            records[0].time_ns
        };
        assert_eq!(first(";$STARTTIME=0\r\n"), 5_000_000);
        assert_eq!(first(";$STARTTIME=0.0000000000\r\n"), 5_000_000);
        assert_eq!(first(";$STARTTIME=25569\r\n"), 5_000_000);
    }

    /// A part of a file, as it is copied into a report of a fault.
    #[test]
    fn rows_without_a_header_show_their_version() {
        let rows = [
            ("     1)      1841  0123  2  11 22", "(1.841000) can0 123#1122\n"),
            ("     1)      1841.0  Tx     0123  2  11 22", "(1.841000) can0 123#1122 T\n"),
            ("     1)      1841.000 2  Rx     0123  2  11 22", "(1.841000) can1 123#1122\n"),
            ("     1)      1841.000 2  Rx     0123  -  2  11 22", "(1.841000) can1 123#1122\n"),
            ("      1      1841.000 DT     0123 Tx 2  11 22", "(1.841000) can0 123#1122 T\n"),
            ("      1      1841.000 DT 2      0123 Rx -  2  11 22", "(1.841000) can1 123#1122\n"),
        ];
        for (row, expected) in rows {
            let file = format!("{row}\r\n");
            // Once it had to be said: its times, in milliseconds, were proposed as seconds of a table.
            assert!(
                Format::of_content(file.as_bytes())
                    .is_some_and(|of| of.is_kind_of(Format::Trc(TrcVersion::V2_1))),
                "{row}"
            );
            let (records, issues) = tests::read(Format::Trc(TrcVersion::V2_1), file);
            assert_eq!(issues, Vec::<String>::new(), "{row}");
            assert_eq!(tests::write(Format::Candump, &records), expected, "{row}");
        }
    }

    proptest! {
        #[test]
        fn any_trace_round_trips_as_far_as_the_version_carries(
            records in prop::collection::vec(record_or_fd(1_000_000), 0..12)
        ) {
            for version in VERSIONS {
                let options = WriteOptions { format: Some(Format::Trc(version)), ..WriteOptions::default() };
                let (bytes, left_out) = tests::write_with(&options, &records);
                let (read, issues) = tests::read(Format::Trc(version), bytes);
                let expected: Vec<_> = records.iter().filter_map(|record| kept(version, record)).collect();
                prop_assert_eq!(issues, Vec::<String>::new());
                prop_assert_eq!(&read, &expected, "{:?}", version);
                prop_assert_eq!(left_out == LeftOut::default(), expected == records, "{:?}", version);
            }
        }

        #[test]
        fn the_latest_version_keeps_microseconds(records in prop::collection::vec(record_or_fd(1000), 0..12)) {
            prop_assert_eq!(tests::round_trip(Format::Trc(TrcVersion::V2_1), &records), records);
        }
    }

    /// Rows as PEAK's own programs write them.
    #[test]
    fn peaks_own_rows_are_read() {
        let files = [
            ";   Start time: 18.12.2021 14:28:07.062\r\n\
             \x20    1)     17535  00000100  2  01 02\r\n\
             \x20    2)     17540  FFFFFFFF  4  00 00 00 08 -- -- -- -- BUSHEAVY\r\n\
             \x20    3)     17541      0008  4  ERROR 00 19 08 09\r\n\
             \x20    4)     48937      0704  1  RTR",
            ";$FILEVERSION=1.1\r\n;$STARTTIME=44548.6028595139\r\n\
             \x20    1)     17535.0  Rx     00000100  2  01 02 \r\n\
             \x20    2)     17540.0  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY \r\n\
             \x20    3)     17541.0  Error      0008  4  00 19 08 09\r\n\
             \x20    4)     48937.0  Rx         0704  1  RTR",
            ";$FILEVERSION=1.3\r\n;$STARTTIME=44548.6028595139\r\n\
             \x20    1)     17535.000 1  Rx    00000100 -  2    01 02\r\n\
             \x20    2)     17540.000 1  Warng FFFFFFFF -  4    00 00 00 08 BUSHEAVY\r\n\
             \x20    3)     17541.000 1  Error     0008 -  4    00 19 08 09\r\n\
             \x20    4)     48937.000 1  Rx        0704 -  1    RTR",
            ";$FILEVERSION=2.0\r\n;$STARTTIME=44548.6028595139\r\n;$COLUMNS=N,O,T,I,d,l,D\r\n\
             \x20     1     17535.000 DT 00000100 Rx 2  01 02\r\n\
             \x20     2     17540.000 ST          Rx    00 00 00 08\r\n\
             \x20     3     17541.000 ER          Rx    08 00 19 08 09\r\n\
             \x20     4     48937.000 RR     0704 Rx 1",
            ";$FILEVERSION=2.1\r\n;$STARTTIME=44548.6028595139\r\n;$COLUMNS=N,O,T,B,I,d,R,L,D\r\n\
             \x20     1     17535.000 DT 1  00000100 Rx -  2    01 02\r\n\
             \x20     2     17540.000 ST 1         - Rx -  4    00 00 00 08\r\n\
             \x20     3     17541.000 ER 1         - Rx -  5    08 00 19 08 09\r\n\
             \x20     4     48937.000 RR 1      0704 Rx -  1",
        ];
        for file in files {
            let (mut records, issues) = tests::read(Format::Trc(TrcVersion::V2_1), file);
            assert_eq!(issues, Vec::<String>::new(), "{file}");
            // The day's fraction has a resolution of 9 µs.
            for record in &mut records {
                record.time_ns = (record.time_ns + 500_000) / 1_000_000 * 1_000_000;
            }
            assert_eq!(
                tests::write(Format::Candump, &records),
                "(1639837704.597000) can0 00000100#0102\n\
                 (1639837704.602000) can0 20000084#000C000000000000\n\
                 (1639837704.603000) can0 200002A0#0000000000000908\n\
                 (1639837735.999000) can0 704#R1\n",
                "{file}"
            );
        }
    }

    /// As in a file of PEAK-Converter 3.0: its head has no semicolons, and the columns another order.
    #[test]
    fn the_table_that_peak_converter_makes_is_read() {
        let head = "$STARTTIME=45628.5\r\nStart time: 02/12/2024 12:00:00.000\r\n\r\nC:\\logs\\a.csv\r\n\r\n    Generated by PEAK-Converter Version 3.0.3.557\r\n\
            ------\r\n   Glossary:\r\n     Rx: The frame was received\r\n     DT: CAN or J1939 data frame\r\n------\r\n\r\n";
        let rows = "Number Time (ms) Bus Direction Type ID (hex) Reserved Length D0 D1 D2 D3 D4 D5 D6 D7 D... \r\n\
            1 0.100 1 Rx DT 0593 - 6 00 00 FF FF FF FF\r\n2 1.700 2 Tx RR 18FEF100 - 0\r\n\
            3 1.900 1 Rx FB 0356 - 12 00 01 02 03 04 05 06 07 08 09 0A 0B\r\n";
        let expected = "(1733140800.000100) can0 593#0000FFFFFFFF\n(1733140800.001700) can1 18FEF100#R T\n\
            (1733140800.001900) can0 356##1000102030405060708090A0B\n";
        let with_semicolons = rows
            .replace("Time (ms)", "Time_(ms)")
            .replace("ID (hex)", "ID_(hex)")
            .replace(' ', ";")
            .replace('_', " ");
        for rows in [rows.to_owned(), with_semicolons] {
            let file = format!("{head}{rows}");
            assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Trc(TrcVersion::V2_1)));
            let (log, issues) = tests::as_log(Format::Trc(TrcVersion::V2_1), file);
            assert_eq!((log.as_str(), issues), (expected, Vec::new()));
        }
    }

    #[test]
    fn broken_rows_are_named() {
        let file = ";$FILEVERSION=2.1\r\n;$STARTTIME=44548.6\r\n;$COLUMNS=N,O,T,B,I,d,R,L,D\r\n\
                    1 1.0 DT 1 0100 Rx - 2 01\r\n2 x DT 1 0100 Rx - 0\r\n3 1.0 FD 1 0100 Rx - 9 01 02\r\n\
                    4 1.0 DT 1 0900 Rx - 0\r\n5 1.0 DT\r\n6 1.0 DT 1 0100 Rx - 0\r\n";
        let (records, issues) = tests::read(Format::Trc(TrcVersion::V2_1), file);
        assert_eq!(records.len(), 1);
        assert_eq!(
            issues,
            [
                "test, line 4: expected 2 data bytes, found '01'",
                "test, line 5: expected a time in milliseconds, found 'x'",
                "test, line 6: expected 12 data bytes, found '01 02'",
                "test, line 7: expected an identifier of 4 digits up to 07FF or 8 up to 1FFFFFFF, found '0900'",
                "test, line 8: expected a bus number, found nothing",
            ]
        );
        for row in [
            "1 1.0 D7 1 0100 Rx - 0",
            "1 1.0 T 1 0100 Rx - 0",
            "1 1.0 DTX 1 0100 Rx - 0",
            "1 1.0 R 1 0100 Rx - 0",
            "1 1.0 DT 1 0100 Px - 0",
            "1 1.0 DT 1 0100 Rx - 1 00 01",
        ] {
            let file = format!(";$FILEVERSION=2.1\r\n;$STARTTIME=44548.6\r\n{row}\r\n");
            let (records, issues) = tests::read(Format::Trc(TrcVersion::V2_1), file);
            assert_eq!((records.len(), issues.len()), (0, 1), "{row}: {issues:?}");
        }
    }

    #[test]
    fn a_comma_in_front_of_fractions_is_read() {
        let file = ";$FILEVERSION=1.1\n;$STARTTIME=44548,5\n;\n     1)      1004,8  Rx         079B  1  02\n";
        let (records, issues) = tests::read(Format::Trc(TrcVersion::V1_1), file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Candump, &records), "(1639828801.004800) can0 79B#02\n");
    }
}
