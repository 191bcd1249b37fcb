//! Vector's ASC: lines of text with times relative to a date in the header.
//!
//! Classical frames, error frames and the controller's state are events of the format; a loss is a status line
//! with the details in a trailing comment. Everything else that is known to occur in such files (statistics,
//! other buses, markers) is counted by kind. Dates are taken as UTC.

mod content;
mod date;
mod decode;
mod encode;
mod lin;
mod others;

pub(crate) use decode::Decoder;
pub(crate) use encode::Encoder;

use cantap_can::ErrorState;

// Flags at the end of an event on a CAN FD channel.
const REMOTE: u32 = 1 << 4;
const FD_FORMAT: u32 = 1 << 12;
const SWITCHED_BIT_RATE: u32 = 1 << 13;
const PASSIVE_SENDER: u32 = 1 << 14;

/// Whether a text begins like Vector's: with its date or the base of its numbers, possibly after comments.
pub(crate) fn is_head(text: &[u8]) -> bool {
    /// How far down the line about numbers and times may stand, below lines that a person or a program put above it.
    const LINES: usize = 10;
    const BASE: [&str; 2] = ["base hex", "base dec"];
    let lines = text.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii_start);
    let mut lines = lines.skip_while(|line| line.is_empty() || line.starts_with(b"//")).take(LINES);
    let begins = |line: &[u8], words: &[&str]| {
        let begins = |word: &&str| {
            line.get(..word.len()).is_some_and(|start| start.eq_ignore_ascii_case(word.as_bytes()))
        };
        words.iter().any(begins)
    };
    let has_times = |line: &[u8]| memchr::memmem::find(&line.to_ascii_lowercase(), b" timestamps ").is_some();
    let first = lines.next().unwrap_or_default();
    begins(first, &["date "])
        || begins(first, &BASE)
        || lines.any(|line| begins(line, &BASE) && has_times(line))
}

/// The controller's states as status lines name them.
const STATES: [(ErrorState, &str); 4] = [
    (ErrorState::Passive, "chip status error passive"),
    (ErrorState::Active, "chip status error active"),
    (ErrorState::Warning, "chip status warning limit"),
    (ErrorState::BusOff, "chip status bus off"),
];

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;
    use cantap_trace::testing::record_lin_or_can;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_trace_round_trips(records in prop::collection::vec(record_lin_or_can(1000), 0..20)) {
            prop_assert_eq!(tests::round_trip(Format::Asc, &records), records);
        }
    }

    const HEAD: &str = "date Sam Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\n\
                        internal events logged\n// version 9.0.0\n\
                        Begin Triggerblock Sam Sep 30 15:06:13.191 2017\n   0.000000 Start of measurement\n";

    /// The records of some lines after an ordinary header, as a candump log, and the issues.
    fn as_log(lines: &str) -> (String, Vec<String>) {
        tests::as_log(Format::Asc, format!("{HEAD}{lines}"))
    }

    #[test]
    fn vectors_own_lines_are_read() {
        let lines = "   0.015991 CAN 1 Status:chip status error passive - TxErr: 132 RxErr: 0\n\
                     \t2.5010 2   C8             Tx   d 8 09 08 07 06 05 04 03 02\n\
                     2.520002 3 200 Tx r Length = 1704000 BitCount = 145 ID = 88888888x\n\
                     2.584921 4 300 Rx r 8 Length = 1704000 BitCount = 145 ID = 88888888x\n\
                     3.098426 1  18EBFF00x       Rx d 8 01 A0 0F A6 60 3B D1 40    Length = 273910 BitCount = 141\n\
                     4.501000 2 ErrorFrame Flags = 0xe CodeExt = 0x20a2 Code = 0x82 ID = 0 DLC = 0 Position = 5\n\
                     4.6 1 ErrorFrame ECC: 10100010\n\
                     5.0 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%\n\
                     5.1 1 J1939TP FEE3p 6 0 0 - Rx d 23 A0 0F\n\
                     5.2 CANFD   1 Rx        300                                   1 0 8  8 11 c2 03 04 05 06 07 08   102203  133   303000 e0006659 46500250 4b140250 20011736 2001040d\n\
                     5.3 CANFD   2 Rx        30a  Generic_Name_12                  0 0 2  2 11 c2   102203  133   200000 e0006659 46500250 4b140250 20011736 2001040d\n\
                     End TriggerBlock\n";
        let (log, issues) = as_log(lines);
        assert_eq!(
            log,
            "(1506783973.206991) can0 20000284#0030000000008400\n\
             (1506783975.692000) can1 0C8#0908070605040302 T\n\
             (1506783975.711002) can2 200#R T\n\
             (1506783975.775921) can3 300#R8\n\
             (1506783976.289426) can0 18EBFF00#01A00FA6603BD140\n\
             (1506783977.692000) can1 20000088#0000040000000000\n\
             (1506783977.791000) can0 20000088#0000040000000000\n\
             (1506783978.391000) can0 300##111C2030405060708\n\
             (1506783978.491000) can1 30A#11C2\n"
        );
        assert_eq!(issues, Vec::<String>::new());
    }

    /// Of a frame that has 29 bits nothing else can be meant; one without a direction was received.
    #[test]
    fn what_scripts_leave_out_is_no_reason_to_lose_a_frame() {
        let (log, issues) =
            as_log("0.1 1 18FEF100 Rx d 1 07\n0.2 2 5C1   d 2 5C C7\n0.3 1 123 r\n0.4 1 8FF Rx d 0\n");
        assert_eq!(
            log,
            "(1506783973.291000) can0 18FEF100#07\n(1506783973.391000) can1 5C1#5CC7\n(1506783973.491000) can0 123#R\n"
        );
        assert!(issues.len() == 1 && issues[0].contains("up to 7FF"), "{issues:?}");
    }

    #[test]
    fn damaged_lines_are_issues_and_other_things_are_counted_by_kind() {
        let damaged = "0.2 1 18EBGF00x Rx d 1 00\n0.3 l 100 Rx d 0\n0.3 300 100 Rx d 0\n0.3 1 100 Px d 0\n\
                       0.3 1 100 Rx d 1 00 01\n0.3 CANFD 1 Px 100 0 0 0 0 0 0 1000\n0.3 CAN 1 Stutus:bus off\n";
        let (log, issues) = as_log(damaged);
        assert_eq!((log.as_str(), issues.len()), ("", 7), "{issues:?}");
        let others = "0.1 1 OverloadFrame\n0.2 L1 SleepModeEvent entering\n0.2 Li WakeupReq\n0.3 SV: 1 0 1 ::a = 1\n0.4 a := 1\n\
                      0.5 ETH 1 Rx 60:ff\n0.6 1 Statistic: D 0\n0.7 // words\n0.8 CAN 1 Status:sleeping\n\
                      0.9 1 100 TxRq d 0\n";
        let source = std::io::Cursor::new(format!("{HEAD}{others}"));
        let options = crate::ReadOptions::default();
        let mut reader = crate::TraceReader::from_source("test", source, Format::Asc, &options).unwrap();
        assert_eq!(reader.by_ref().filter_map(Result::err).count(), 0);
        let expected = [
            ("CAN overload frames", 1),
            ("CAN statistics", 1),
            ("Ethernet frames and events", 1),
            ("LIN events other than frames", 2),
            ("comments and texts", 1),
            ("environment and system variables", 2),
            ("other states of the controller", 1),
        ];
        assert_eq!(reader.left_out().iter().collect::<Vec<_>>(), expected);
        assert_eq!(reader.notes().iter().count(), 1);
    }

    /// They were counted and not kept.
    #[test]
    fn lin_frames_are_kept_with_what_was_wrong() {
        let lines = "0.1 Li 3c Rx 8 00 11 22 33 44 55 66 77 slot = 1 state = 2 checksum = 9a header time = 40, full time = 130 SOF = 0.08 CSM = classic\n\
                     0.2 L2 0a Tx 2 01 ff checksum = f4\n0.3 L12 15 CSErr Rx 1 07 checksum = 7\n0.4 Li 3d TransmErr header time = 40, full time = 130\n\
                     0.5 Li 3e 8 RcvError: char = 5 StateReason = 1 ShortError = 0 DlcTimeout = 0 HasDatabytes = 1 01 02 SOF = 0.1\n\
                     0.6 Li 3c TxRq 1 00\n0.7 Li 3c Rx 8 00\n0.8 Li 40 Rx 1 00\n";
        let (records, issues) = tests::read(Format::Asc, format!("{HEAD}{lines}"));
        let found: Vec<_> =
            records.iter().map(|record| format!("{} {}", record.interface(), record.event)).collect();
        assert_eq!(
            found,
            [
                "lin0 LIN frame 3C: 00 11 22 33 44 55 66 77, checksum 9A",
                "lin1 LIN frame 0A: 01 FF, checksum F4",
                "lin11 LIN frame 15: 07, wrong checksum 07",
                "lin0 LIN frame 3D: no response",
                "lin0 LIN frame 3E: 01 02, wrong response",
            ]
        );
        assert_eq!(
            issues,
            [
                "test, line 13: expected 8 data bytes, found nothing",
                "test, line 14: expected an identifier of LIN up to 3F, found '40'"
            ]
        );
    }

    #[test]
    fn base_dates_and_relative_times_follow_the_head() {
        let file = "date Sat Sep 30 10:06:13 pm 2017\nbase dec  timestamps relative\n\
                    no internal events logged\n0.5 1 291 Rx d 2 16 255\n0.25 1 400x Tx d 0\n";
        let (records, issues) = tests::read(Format::Asc, file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1506809173.500000) can0 123#10FF\n(1506809173.750000) can0 00000190# T\n"
        );
    }

    /// python-can writes the time of writing as `date`, and the trace's own date in the trigger block. A
    /// trace triggered long after its start has times from the start.
    #[test]
    fn the_trigger_blocks_date_counts_unless_times_run_from_the_start() {
        let first = |block: &str, time: &str| {
            let file = format!(
                "date Sat Sep 30 15:00:00.000 2017\nbase hex  timestamps absolute\ninternal events logged\n\
                 Begin Triggerblock Sat Sep {block}\n{time} 1 123 Rx d 0\n"
            );
            tests::write(Format::Candump, &tests::read(Format::Asc, file).0)
        };
        assert_eq!(first("23 15:00:00.250 2017", "0.000001"), "(1506178800.250001) can0 123#\n");
        assert_eq!(first("30 15:10:00.000 2017", "599.5"), "(1506784199.500000) can0 123#\n");
    }

    /// As programs write on a computer whose language uses it.
    #[test]
    fn a_comma_in_front_of_fractions_is_read() {
        let file =
            "date Sam Sep 30 15:06:13,191 2017\nbase hex  timestamps absolute\n   0,015991 1 123 Rx d 1 0A\n";
        let (records, issues) = tests::read(Format::Asc, file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(tests::write(Format::Candump, &records), "(1506783973.206991) can0 123#0A\n");
    }

    #[test]
    fn broken_lines_are_named() {
        let (log, issues) = as_log(
            "1.0 1 123 Rx d 2 11\n1.0 1 123 Rx d 40 00\n1.0 1 8FF Rx d 0\nrubbish\n1.0 1 123 Rx\n\
             2.0 1 123 Rx d 1 1G\n3.0 1 123 Rx d 1 55\n4.0 1 123 Rx d 8 01 02",
        );
        assert_eq!(log, "(1506783976.191000) can0 123#55\n");
        assert_eq!(
            issues,
            [
                "test, line 7: expected 2 data bytes, found '11'",
                "test, line 8: expected a data length code of 0 to F, found '40'",
                "test, line 9: expected an identifier up to 7FF, or up to 1FFFFFFF followed by x, found '8FF'",
                "test, line 10: expected a line that begins with a time in seconds, found 'rubbish'",
                "test, line 11: expected 'd' or 'r' after the direction, found nothing",
                "test, line 12: expected 1 data bytes, found '1G'",
                "test, line 14: the file ends inside a line; everything before it was read",
            ]
        );
    }

    #[test]
    fn fd_frames_without_the_flag_or_in_the_place_of_classical_ones_are_read() {
        let (log, issues) = as_log(
            "1.0 CANFD 1 Rx 123 1 0 2 2 11 22 0 0 0\n1.0 CANFD 1 Rx 123 0 1 2 2 11 22 0 0 0\n1.0 CANFD 1 Rx 123 0 0 2 2 11 22 0 0 0\n\
             1.0 1 123 Rx d 0C 00 01 02 03 04 05 06 07 08 09 0A 0B\n1.0 1 123 Rx d 0D 00 01 02 03 04 05 06 07 08 09 0A 0B 0C\n\
             1.0 1 123 Rx d 0C 00 01 02 03 04 05 06 07 08 09 0A 0B 0C\n1.0 CANFD 1 Rx 123 1 0 0 0 8 00 01 02\n",
        );
        assert_eq!(
            log,
            "(1506783974.191000) can0 123##11122\n(1506783974.191000) can0 123##21122\n(1506783974.191000) can0 123#1122\n\
             (1506783974.191000) can0 123##0000102030405060708090A0B\n(1506783974.191000) can0 123##1\n"
        );
        assert_eq!(issues.len(), 2, "{issues:?}");
    }

    /// From real files: nothing behind the bytes, decimal codes of the length, remote frames whose sender was error passive.
    #[test]
    fn fd_lines_without_trailing_columns_and_with_decimal_codes_and_remote_frames_are_read() {
        let (log, issues) = as_log(
            "1.0 CANFD   1 Rx        124                                   0 0 2  2 33 44\n\
             1.0 CANFD   1 Tx  456x 1 0 9 12 00 01 02 03 04 05 06 07 08 09 0A 0B\n\
             1.0 CANFD 2 Rx 201 SomeMsg 0 0 2 2 AA BB\n1.0 CANFD 1 Rx 124 0 0 2 2 33 44 0 0\n\
             1.0 CANFD 1 Rx 124 0 0 10 16 00 01 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E 0F 0 0 1000\n\
             1.0 CANFD 3 Tx 50005x 0 1 5 0 140000 73 200050 7a60\n1.0 CANFD 1 Rx 124 0 0 3 2 33 44\n",
        );
        assert_eq!(
            log,
            "(1506783974.191000) can0 124##03344\n(1506783974.191000) can0 00000456##1000102030405060708090A0B T\n\
             (1506783974.191000) can1 201##0AABB\n(1506783974.191000) can0 124##03344\n\
             (1506783974.191000) can0 124##0000102030405060708090A0B0C0D0E0F\n(1506783974.191000) can2 00050005#R5 T\n"
        );
        assert_eq!(issues.len(), 1, "{issues:?}");
        let head = HEAD.replace("base hex", "base dec");
        let (records, issues) = tests::read(
            Format::Asc,
            format!("{head}1.0 CANFD 1 Rx 291 1 0 9 12 0 1 2 3 4 5 6 7 8 9 10 255 102203 133 303000\n"),
        );
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1506783974.191000) can0 123##1000102030405060708090AFF\n"
        );
    }

    /// As the converters for CANedge loggers write CAN FD frames: among the classical ones, with decimal codes of the length.
    #[test]
    fn fd_frames_with_codes_among_classical_ones_are_read() {
        let bytes = |count: usize| " 5A".repeat(count);
        let lines: String =
            [(9, 8), (9, 12), (10, 16), (11, 20), (12, 24), (13, 32), (14, 20), (14, 48), (15, 64)]
                .map(|(code, count)| format!("1.0 1 123 Rx d {code}{}\n", bytes(count)))
                .concat();
        let (log, issues) = as_log(&lines);
        assert_eq!(issues, Vec::<String>::new());
        let lengths: Vec<_> =
            log.lines().map(|line| (line.contains("##0"), line.matches("5A").count())).collect();
        let fd = [12, 16, 20, 24, 32, 20, 48, 64].map(|count| (true, count));
        assert_eq!(lengths, [&[(false, 8)], &fd[..]].concat());
        // Eight of twelve bytes look like a classical frame's.
        for line in [format!("1.0 1 123 Rx d 9{}", bytes(8)), format!("1.0 1 123 Rx d 14{}", bytes(20))] {
            let (log, issues) = as_log(&line);
            assert_eq!((log.as_str(), issues.len()), ("", 1), "{line}");
        }
        let (log, issues) = as_log(&format!("1.0 1 123 Rx d 11{}\n", bytes(19)));
        assert_eq!((log.as_str(), issues.len()), ("", 1));
    }

    #[test]
    fn identifiers_with_0x_and_directions_in_capitals_are_read() {
        let (log, issues) = as_log(
            "1.0 1 0x123 RX d 1 11\n1.0 1 0x18FEF100x TX d 1 22\n1.0 CANFD 1 RX 0x123 0 0 1 1 33\n1.0 1 0x Rx d 0\n",
        );
        assert_eq!(
            log,
            "(1506783974.191000) can0 123#11\n(1506783974.191000) can0 18FEF100#22 T\n\
             (1506783974.191000) can0 123##033\n(1506783974.191000) can0 00000000#\n"
        );
        assert_eq!(issues, Vec::<String>::new());
    }

    #[test]
    fn lines_are_what_other_programs_read() {
        let (records, _) = tests::read(
            Format::Candump,
            "(1506783973.192991) can0 123#11.22\n(1506783974.0) can1 1F334455#R3 T\n\
             (1506783974.5) can0 20000084#0200000000000000\n",
        );
        assert_eq!(
            tests::write(Format::Asc, &records),
            "date Sat Sep 30 15:06:13.192 2017\n\
             base hex  timestamps absolute\n\
             internal events logged\n\
             Begin Triggerblock Sat Sep 30 15:06:13.192 2017\n\
             \x20  0.000000 Start of measurement\n\
             \x20  0.000991 1  123             Rx   d 2 11 22\n\
             \x20  0.808000 2  1F334455x       Tx   r 3\n\
             \x20  1.308000 1  ErrorFrame  // cantap: bus-error\n\
             End TriggerBlock\n"
        );
    }
}
