//! What gateways print, as they print it.

use super::super::tests;
use crate::{Format, ReadOptions, TraceReader};

fn as_log(file: &str) -> (String, Vec<String>) {
    tests::as_log(Format::Nmea2000, file)
}

#[test]
fn frames_of_yacht_devices_are_read_over_midnight() {
    let (log, issues) = as_log(
        "23:59:59.617 R 0DFF180D A2 8C 50 C0 FF FF FF FF\r\n00:00:00.100 T 18EAFF44 14 F0 01\r\n\
         00:00:00.050 R 09FD020D\r\n",
    );
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(
        log,
        "(86399.617000) can0 0DFF180D#A28C50C0FFFFFFFF\n(86400.100000) can0 18EAFF44#14F001 T\n\
         (86400.050000) can0 09FD020D#\n"
    );
}

#[test]
fn the_plain_form_has_dates_of_several_kinds() {
    let (log, issues) = as_log(
        "# a drive\n2011-11-24-22:42:04.388,2,127250,36,255,8,ff,10,3b,ff,7f,ce,f5,fc\n\
         2022-09-28T11:36:59.668Z,6,59904,36,23,3,14,f0,01\n2022-09-28T04:36:59.668-07:00,6,59904,36,255,3,14,f0,01,\n",
    );
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(
        log,
        "(1322174524.388000) can0 09F11224#FF103BFF7FCEF5FC\n(1664365019.668000) can0 18EA1724#14F001\n\
         (1664365019.668000) can0 18EAFF24#14F001\n"
    );
}

#[test]
fn a_log_of_signal_k_has_dates_and_lines_of_other_sources() {
    let file = "1555009219000;gps;$GPGLL,4916.45,N,12311.12,W,225444,A\n\
                1555009219100;ydgw;17:33:39.050 R 0DFF180D A2 8C 50 C0 FF FF FF FF\n\
                1555009219200;A;2019-04-11-17:33:39.150,6,59904,36,255,3,14,f0,01\n1555009219300;ydgw;17:3\n";
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Nmea2000));
    let (log, issues) = as_log(file);
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(
        log,
        "(1555009219.100000) can0 0DFF180D#A28C50C0FFFFFFFF\n(1555004019.150000) can0 18EAFF24#14F001\n"
    );
}

/// Of the frames that a message was made of, such a file has nothing.
#[test]
fn what_was_put_together_is_counted_and_what_is_one_frame_is_read() {
    let file = "A000159.990 CCFF7 0FF63 3B9F0000000002FF\nA000200.004 24FF2 1F112 FFFFCA300100FFFF\n\
         A000200.005 24FF3 1F805 20945F1F44ED03030102\nA000200.006 24FF3 1F805 2094\n\
         2011-11-24-22:42:04.388,2,393216,36,255,1,ff\n";
    let (log, issues) = as_log(file);
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(
        log,
        "(119.990000) can0 1CFF63CC#3B9F0000000002FF\n(120.004000) can0 09F11224#FFFFCA300100FFFF\n"
    );
    let source = std::io::Cursor::new(file);
    let mut reader =
        TraceReader::from_source("test", source, Format::Nmea2000, &ReadOptions::default()).unwrap();
    assert_eq!(reader.by_ref().count(), 2);
    let left_out: Vec<_> = reader.left_out().iter().collect();
    assert_eq!(left_out, [(super::PUT_TOGETHER, 2), (super::OF_THE_GATEWAY, 1)]);
    // Without a message of more than a frame, every line is a frame.
    let (log, _) = as_log("2011-11-24-22:42:04.388,2,129029,36,255,3,a0,2b,01\n");
    assert_eq!(log, "(1322174524.388000) can0 09F80524#A02B01\n");
}

#[test]
fn broken_lines_are_named() {
    let (log, issues) = as_log(
        "00:29:58.617 R 2DFF180D A2\n00:29:58.617 X 0DFF180D A2\n25:29:58.617 R 0DFF180D A2\n00:29:58.617 R 0DFF180D A\n\
         2011-11-24-22:42:04.388,2,127250,36,255,8,ff\n2011-11-24-22:42:04.388,8,127250,36,255,1,ff\n\
         2011-13-24-22:42:04.388,2,127250,36,255,1,ff\n2011-11-24-22:42:04.388,2,127250,36,255,1,ff,ff\n\
         A000159.990 CCFF7 0FF63 3B9\nA00\u{e9}159.990 CCFF7 0FF63 3B9F\n00:29:58.617 R 0DFF180D A2",
    );
    assert_eq!((log.as_str(), issues.len()), ("", 11), "{issues:#?}");
    assert!(issues[10].contains("the file ends inside a line"), "{issues:#?}");
    let (log, issues) = as_log("00:29:58.617 R 0DFF180D A2 8C 50 C0 FF FF FF FF");
    assert_eq!((log.lines().count(), issues.len()), (1, 0), "{issues:?}");
}

/// As candump, issues, what was noted, what was left out.
type Found = (String, Vec<String>, Vec<(String, u64)>, Vec<&'static str>);

fn read(file: &str) -> Found {
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Nmea2000), "{file}");
    let (log, issues) = as_log(file);
    let source = std::io::Cursor::new(file.to_owned());
    let mut reader =
        TraceReader::from_source("test", source, Format::Nmea2000, &ReadOptions::default()).unwrap();
    reader.by_ref().count();
    let left_out = reader.left_out().iter().map(|(what, count)| (what.to_owned(), count)).collect();
    let notes = reader.notes().iter().map(|(what, _)| what).collect();
    (log, issues, left_out, notes)
}

/// As MiniPlex gateways and Signal K's users log them: the last byte is first, and a position is the only clock.
#[test]
fn sentences_with_frames_are_read_in_the_order_that_their_fast_packets_show() {
    let file = "$IIHDG,097,,,00,E*1C\r\n$GPRMC,225446.50,A,4916.45,N,12311.12,W,000.5,054.7,191119,020.3,E*46\r\n\
                $MXPGN,01F905,6816,656D6F48010600CB*19\r\n$MXPGN,01F905,6816,8765C023C65340CC*1B\r\n\
                $MXPGN,01F905,6816,FFFFFFFFFFFF0CCD*66\r\n$MXPGN,01F10D,2816,FFFF0369FC97F901*16\r\n";
    let (log, issues, left_out, notes) = read(file);
    assert_eq!(issues, Vec::<String>::new());
    let frames = [
        "19F90516#CB000601486F6D65",
        "19F90516#CC4053C623C06587",
        "19F90516#CD0CFFFFFFFFFFFF",
        "09F10D16#01F997FC6903FFFF",
    ];
    let lines = frames.map(|frame| format!("(1574204086.500000) can0 {frame}\n"));
    assert_eq!(log, lines.concat());
    assert_eq!(left_out, [(super::OTHER_SENTENCES.to_owned(), 2)]);
    assert_eq!(notes, [super::TIMES_OF_FIXES]);
}

/// Yacht Devices and others write the first byte first; nothing says when a frame was there.
#[test]
fn sentences_with_the_first_byte_first_are_told_by_what_fills_a_frame() {
    let file = "$MXPGN,01F211,6872,034E46FFFFFFFFFF*6E\n$MXPGN,01F211,6872,034E46FFFFFFFFFF*6E\n";
    let (log, issues, _, notes) = read(file);
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(0.000000) can0 19F21172#034E46FFFFFFFFFF\n".repeat(2));
    assert_eq!(notes, [super::NO_TIMES]);
    // Nothing shows it here.
    let (log, _, left_out, notes) =
        read("$MXPGN,01F801,2801,C1308AC40C5DE343*19\n$MXPGN,01F801,A8FF,C1308AC40C5DE343*6B\n");
    assert_eq!(log, "(0.000000) can0 09F80101#43E35D0CC48A30C1\n");
    assert!(notes.contains(&super::ORDER_UNKNOWN), "{notes:?}");
    assert_eq!(left_out, [(super::TO_GATEWAY.to_owned(), 1)]);
}

/// Their stamps are milliseconds, seconds, or SeaSmart's own.
#[test]
fn sentences_of_seasmart_are_read_with_stamps_of_each_kind() {
    let file = "$PCDIN,01F112,000C72EA,09,28C36A0000B40AFD*56\n$PCDIN,01F211,00065D6A,72,034E46FFFFFFFFFF*50\n\
                $PCDIN,01F201,000C7E1B,02,000000FFFF407F0005000000000000FFFF000000000000007F7F*24\n\
                $PCDIN,01F112,000C72EA,09,28C36A0000B40AFE*56\n$PCDIN,01F112,000C72EA,09,28C36A*\n";
    let (log, issues, left_out, notes) = read(file);
    assert_eq!(
        log,
        "(815.850000) can0 19F11209#28C36A0000B40AFD\n(417.130000) can0 19F21172#034E46FFFFFFFFFF\n"
    );
    assert_eq!((issues.len(), left_out), (2, vec![(super::PUT_TOGETHER.to_owned(), 1)]), "{issues:?}");
    assert_eq!(notes, [super::NO_PRIORITY]);
    let seconds = "$PCDIN,01F801,5B26371E,01,FFFFFF7FFFFFFF7F*2C\n".repeat(2);
    assert_eq!(read(&seconds).0, "(1529231134.000000) can0 19F80101#FFFFFF7FFFFFFF7F\n".repeat(2));
    let own =
        read("$PCDIN,01F205,6DOB845V,A7,007F803CD0150000\n$PCDIN,01F112,6DOB845V,A7,FF03C0FFFFFFFFFD\n").0;
    assert_eq!(
        own,
        "(1478060036.186523) can0 19F205A7#007F803CD0150000\n(1478060036.186523) can0 19F112A7#FF03C0FFFFFFFFFD\n"
    );
    // A counter of 32 bits began again, after 49 days.
    let log =
        read("$PCDIN,01F112,FFFFFFFF,09,28C36A0000B40AFD\n$PCDIN,01F112,00000001,09,28C36A0000B40AFD\n").0;
    assert_eq!(
        log.lines().map(|line| line.split(' ').next().unwrap()).collect::<Vec<_>>(),
        ["(4294967.295000)", "(4294967.297000)"]
    );
}

/// As SeaSmart's and other boards' programs send them on.
#[test]
fn several_sentences_on_a_line_are_read_each() {
    let file = "$PCDIN,01F119,00000400,0F,2AAF00D1067414FF*5D$PCDIN,01F119,00000404,0F,2AAF00D1067414FE*5A $GPDPT,2.4,-0.0*7C\r\n\
                1700000000.5 $PCDIN,01F119,00000408,0F,2AAF00D1067414FF*55$PCDIN,01F119,000\
                $PCDIN,01F119,00000408,0F,2AAF00D1067414FE*56$PCDIN,01F119,00000408,0F,2AAF00D1067414FD*57\r\n\
                $GPDPT,2.4,-0.0*7C$PCDIN,01F119,00000410,0F,2AAF00D1067414FF*5C$PCDIN,01F119,00000410,0F,2AAF";
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Nmea2000));
    let (log, issues) = as_log(file);
    assert_eq!(
        log,
        "(1.024000) can0 19F1190F#2AAF00D1067414FF\n(1.028000) can0 19F1190F#2AAF00D1067414FE\n\
         (1700000000.500000) can0 19F1190F#2AAF00D1067414FF\n(1700000000.500000) can0 19F1190F#2AAF00D1067414FE\n\
         (1700000000.500000) can0 19F1190F#2AAF00D1067414FD\n(1.040000) can0 19F1190F#2AAF00D1067414FF\n"
    );
    assert_eq!(issues.len(), 2, "{issues:?}");
    assert!(issues[0].contains("line 2") && issues[1].contains("line 3"), "{issues:?}");
}

#[test]
fn times_before_a_sentence_count_and_digital_yachts_are_read() {
    for before in [
        "\\s:gw,c:1577836800*5B\\",
        "2020-01-01T00:00:00Z\t",
        "1577836800.000,",
        "1577836800000;gw;",
        "[2020-01-01 00:00:00] ",
    ] {
        let (log, issues, ..) = read(&format!("{before}$MXPGN,01F211,6872,034E46FFFFFFFFFF*6E\n"));
        assert_eq!(
            (log.as_str(), issues.len()),
            ("(1577836800.000000) can0 19F21172#034E46FFFFFFFFFF\n", 0),
            "{before}"
        );
    }
    let (log, issues, left_out, _) =
        read("$PDGY,000000,0,0,2,28820,0,0\n!PDGY,127257,3,17,255,0.563,AP9/UgAh/v8=\n");
    assert_eq!((log.as_str(), issues.len()), ("(0.563000) can0 0DF11911#00FF7F520021FEFF\n", 0));
    assert_eq!(left_out, [(super::OTHER_SENTENCES.to_owned(), 1)]);
    for other in
        ["$GPRMC,225446,A,4916.45,N,12311.12,W,000.5,054.7,191194,020.3,E*68\n", "price: $PCDIN,01\n"]
    {
        assert_eq!(Format::of_content(other.as_bytes()), None, "{other}");
    }
}

/// What a board with the NMEA2000 library prints: bytes without leading zeros.
#[test]
fn messages_of_the_library_for_boards_are_read() {
    let (log, issues, left_out, _) = read(
        "228425 : Pri:7 PGN:126720 Source:204 Dest:170 Len:11 Data:3B,9F,F0,88,9F,0,17,C6,0,A4,0\n\
         228437 : Pri:2 PGN:130306 Source:105 Dest:255 Len:8 Data:0,F6,0,FB,96,FA,FF,FF\n\
         228444 : Pri:6 PGN:59904 Source:3 Dest:44 Len:3 Data:14,F0,1\n228445 : Pri:6 PGN:59904 Source:3 Dest:44 Len:3 Data:14,F0\n",
    );
    assert_eq!(log, "(228.437000) can0 09FD0269#00F600FB96FAFFFF\n(228.444000) can0 18EA2C03#14F001\n");
    assert_eq!((issues.len(), left_out), (1, vec![(super::PUT_TOGETHER.to_owned(), 1)]), "{issues:?}");
}
