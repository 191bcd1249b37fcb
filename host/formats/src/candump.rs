//! can-utils' log format, as `candump -l` writes it: `(1410714882.622188) can0 09F80102#36729A16`, with
//! an optional ` R` or ` T` for the direction. Times have microseconds; error frames follow
//! SocketCAN.

mod decode;
mod encode;
mod lengths;

pub(crate) use decode::{Decoder, is_untimed};
pub(crate) use encode::Encoder;

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::{Format, ReadOptions, TraceReader};
    use cantap_trace::testing::record_or_fd;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_trace_round_trips(records in prop::collection::vec(record_or_fd(1000), 0..20)) {
            prop_assert_eq!(tests::round_trip(Format::Candump, &records), records);
        }

        #[test]
        fn the_short_way_agrees_with_the_long_one(
            line in "\\([0-9]{9,11}[.,][0-9]{5,7}\\) (can0|x|) ?([0-7]?[0-9A-Fa-f]{2}|[012][0-9A-F]{7})#([0-9A-Fa-fR]{2}){0,9}( [RTQ])?",
        ) {
            let (mut short, mut long) = (super::Decoder::default(), super::Decoder::default());
            if let Some((record, len)) = short.plain(format!("{line}\n(").as_bytes()) {
                prop_assert_eq!(len, line.len() + 1);
                prop_assert_eq!(long.parse(line.as_bytes()).ok(), Some((record, None)));
            }
        }
    }

    #[test]
    fn can_xl_is_counted_and_damage_is_not_taken_for_it() {
        let log = "(1.0) can0 123#81:00:12345678#11223344.55\n(1.0) can0 45123#81:00:12345678#11\n(1.0) can0 123#8G:00:12345678#11\n\
                   (1.0) can0 123##111\n";
        let source = std::io::Cursor::new(log);
        let options = crate::ReadOptions::default();
        let mut reader = crate::TraceReader::from_source("test", source, Format::Candump, &options).unwrap();
        let items: Vec<_> = reader.by_ref().collect();
        assert_eq!((items.len(), items[0].is_err(), items[1].is_ok()), (2, true, true));
        assert_eq!(reader.left_out().iter().collect::<Vec<_>>(), [("CAN XL frames", 2)]);
    }

    #[test]
    fn lists_of_frames_for_cansend_are_read_without_times_and_only_as_whole_files() {
        let (records, issues) =
            tests::read(Format::Candump, "# doors\n309#40\n00000123#R2\n\n7E0##1AABB\n123#1\nrubbish\n");
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(0.000000) can0 309#40\n(0.000000) can0 00000123#R2\n(0.000000) can0 7E0##1AABB\n"
        );
        assert_eq!(issues.len(), 2, "{issues:?}");
        let (records, issues) = tests::read(Format::Candump, "cansend vcan0 1D0#0A\ncansend vcan1 158#19\n");
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(0.000000) can0 1D0#0A\n(0.000000) can1 158#19\n"
        );
        assert_eq!(issues, Vec::<String>::new());
        // A fragment at the beginning or within a log is no frame.
        for log in ["123#11\n(1.0) can0 123#11\n", "(1.0) can0 123#11\n123#11\n"] {
            let (records, issues) = tests::read(Format::Candump, log);
            assert_eq!((records.len(), issues.len()), (1, 1), "{log}");
        }
    }

    /// As programs write them that print SocketCAN's number of the identifier.
    #[test]
    fn identifiers_with_the_flag_of_29_bits_are_read() {
        let (records, issues) =
            tests::read(Format::Candump, "(1.000000) can0 98f010fe#35\n(1.000000) can0 8cf150fe#\n");
        let log = tests::write(Format::Candump, &records);
        assert_eq!(log, "(1.000000) can0 18F010FE#35\n(1.000000) can0 0CF150FE#\n");
        assert_eq!(issues, Vec::<String>::new());
        let (_, issues) =
            tests::read(Format::Candump, "(1.000000) can0 C8F010FE#\n(1.000000) can0 58F010FE#\n");
        assert_eq!(issues.len(), 2, "{issues:?}");
    }

    /// As people's scripts print times since the start.
    #[test]
    fn times_with_blanks_before_them_are_read() {
        let (records, issues) = tests::read(
            Format::Candump,
            "(         0.191254) can0 123#11\n(        10.200196) can0 06314000#\n",
        );
        assert_eq!((records.len(), issues), (2, vec![]));
        assert_eq!(records[1].time_ns, 10_200_196_000);
    }

    #[test]
    fn a_time_beyond_nanoseconds_is_refused_and_not_wrapped() {
        let (records, issues) = tests::read(Format::Candump, "(9999999999.000000) can0 123#11\n");
        assert_eq!((records.len(), issues.len()), (0, 1));
    }

    #[test]
    fn ordinary_lines_go_the_short_way() {
        for frame in ["09F80102#36729A16021AB80D", "123#", "7FF#11 R", "000#0102030405060708 T"] {
            let line = format!("(1410714882.622188) can0 {frame}\n");
            let record = super::Decoder::default().plain(line.as_bytes()).map(|(record, _)| record);
            assert_eq!(record, tests::read(Format::Candump, line.as_str()).0.first().copied(), "{frame}");
            assert!(record.is_some(), "{frame}");
        }
    }

    /// A complete log may lack its last line end, and a cut line can look whole.
    #[test]
    fn a_last_line_without_its_end_counts_unless_the_identifier_had_longer_frames() {
        // The frame before the last line was a short one; what counts is the longest.
        let before = "(1.000000) can0 123#DEADBEEF\n(2.000000) can0 456#\n(2.000000) can0 123#DE\n";
        for (last, records, issues) in [
            ("(3.000000) can0 123#DEADBEEF", 3, 0),
            ("(3.000000) can0 123#DEAD", 2, 1),
            ("(3.000000) can0 123#DEADB", 2, 1),
            ("(3.000000) can0 456#DE", 3, 0),
            ("(3.000000) can0 789#DE", 2, 1),
            ("(3.000000) can0 789#1122334455667788", 3, 0),
            ("(3.000000) can0 123##1DEADBEEF", 3, 0),
            ("(3.000000) can0 123##1DEADBE", 2, 1),
            ("(3.000000) can0 123#R", 3, 0),
            ("(3.000000) can0 123#DEADBEEF ", 2, 1),
            ("(3.000000) can0 20000004#0001", 2, 1),
            ("(3.000000) ca", 2, 1),
        ] {
            let (got, told) = tests::read(Format::Candump, format!("{before}{last}"));
            assert_eq!((got.len(), told.len()), (records + 1, issues), "{last}: {told:?}");
            assert!(
                told.iter().all(|issue| issue.contains("line 4: the file ends inside a line")),
                "{told:?}"
            );
        }
    }

    #[test]
    fn a_change_of_state_and_a_channel_0_stay_what_they_are() {
        let log =
            "(1.000000) can0 20000040#0000000000000000\n(2.000000) channel0 123#11\n(3.000000) can0 123#11\n";
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(records.iter().map(|record| record.channel).collect::<Vec<_>>(), [1, 0, 1]);
        assert_eq!(tests::write(Format::Candump, &records), log);
        assert_eq!(tests::round_trip(Format::Pcapng, &records), records);
        assert_eq!(tests::round_trip(Format::Asc, &records), records);
        assert_eq!(tests::round_trip(Format::Blf, &records), records);
    }

    #[test]
    fn an_over_long_line_is_one_issue_and_the_next_has_its_number() {
        let log = format!("(1.0) can0 123#11\n{}\nrubbish\n(2.0) can0 123#11\n", "x".repeat(9 << 20));
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!(records.len(), 2);
        assert_eq!(issues.len(), 2);
        assert!(
            issues[0].starts_with("test, line 2: ") && issues[1].starts_with("test, line 3: "),
            "{issues:?}"
        );
    }

    #[test]
    fn lines_are_what_candump_writes() {
        let log = "(1410714882.622188) can0 09F80102#36729A16021AB80D\n\
                   (0.000000) can1 123#R3\n\
                   (1.000001) can0 123# T\n\
                   (1.000001) can0 7FF#1122334455667788_F\n\
                   (1.000002) can0 7FF##3112233445566778899AABBCC T\n\
                   (1.000003) can0 18DAF110##0\n\
                   (-0.500000) can0 000#00\n";
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Candump, &records), log);
    }

    /// As CAN-MIRGU has them, and others that people made of logs to find attacks.
    #[test]
    fn labels_behind_frames_are_noted_once_and_no_fault() {
        let log = "(1.0) can0 123#11 0\n(2.0) can0 00000123#22 1\n(3.0) can0 124# Attack\n(4.0) can0 125#R normal\n";
        let source = std::io::Cursor::new(log);
        let mut reader =
            TraceReader::from_source("test", source, Format::Candump, &ReadOptions::default()).unwrap();
        let records: Vec<_> = reader.by_ref().map(Result::unwrap).collect();
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1.000000) can0 123#11\n(2.000000) can0 00000123#22\n(3.000000) can0 124#\n(4.000000) can0 125#R\n"
        );
        assert_eq!(reader.notes().iter().map(|(_, count)| count).collect::<Vec<_>>(), [1]);
    }

    #[test]
    fn broken_lines_are_named_and_the_rest_is_read() {
        let log = "# a comment\n\n(1.0) can0 123#11\n(x) can0 123#11\nnonsense\n(2.0) can0 123##111111111111111111\n\
                   (2.0) can0 800#\n(2.0) can0 123#1\n(2.0) can0 123#11 Q\r\n(3.0) can0 123#5.6\n(4) can3 123#r";
        let (records, issues) = tests::read(Format::Candump, log);
        assert_eq!(records.len(), 2);
        assert_eq!(
            issues,
            [
                "test, line 4: expected a time in seconds between the parentheses, found 'x'",
                "test, line 5: expected a log line such as '(1410714882.622188) can0 123#DEADBEEF', found 'nonsense'",
                "test, line 6: expected a CAN FD frame such as 123##1DEADBEEF, with a length that FD has, found '123##111111111111111111'",
                "test, line 7: expected an identifier of 3 digits up to 7FF or 8 up to 1FFFFFFF, found '800#'",
                "test, line 8: expected a frame such as 123#DEADBEEF (the data must be pairs of hexadecimal digits, with '.' between pairs if you like), found '123#1'",
                "test, line 9: expected 'R', 'T' or nothing after the frame, found 'Q'",
                "test, line 10: expected a frame such as 123#DEADBEEF (the data must be pairs of hexadecimal digits, with '.' between pairs if you like), found '123#5.6'",
            ]
        );
    }
}
