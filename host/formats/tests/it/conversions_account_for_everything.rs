//! From every format that is read to every format that is written, and back: each record is there again as it was, or what became of it
//! is counted. `formats_page.rs` says what each format keeps; here the numbers are held against it.

use crate::traces;

use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;

use cantap_can::{BusErrorKind, ErrorState, LossStage};
use cantap_formats::{Format, LeftOut, ReadOptions, open_reader};
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};
use traces::{directory, file_name, read, split, write};

/// Apart by more than any format's resolution, so that each is found again by its time.
const STEP_NS: i64 = 4_000_000;

const START_NS: i64 = 1_410_714_882_000_000_000;

/// Frames of each kind on channels of every sort, sent and received, and what is no frame.
fn every_kind() -> Vec<TraceRecord> {
    let mut records = Vec::new();
    let frame =
        |text: &str, direction| TraceEvent::Frame { frame: text.parse().unwrap(), direction, late: false };
    let mut push = |channel, event| {
        let time_ns = START_NS + STEP_NS * records.len() as i64;
        records.push(TraceRecord { time_ns, device_ns: None, channel, event });
    };
    for channel in [1, 2, 0, 9, 255] {
        for text in [
            "123#",
            "7FF#0102030405060708",
            "00000123#AA",
            "1FFFFFFF#1122",
            "124#R",
            "125#R8",
            "12345678#R4",
            "126#1122334455667788_9",
            "127#1122334455667788_F",
            "128##0",
            "129##1AA",
            "12A##2112233",
            "12B##3000102030405060708090A0B",
            "18DAF110##0000102030405060708090A0B0C0D0E0F",
        ] {
            push(channel, frame(text, Direction::Rx));
            push(channel, frame(text, Direction::Tx));
        }
        for kind in BusErrorKind::ALL.into_iter().map(Some).chain([None]) {
            for counters in [None, Some((8, 0)), Some((255, 127))] {
                push(channel, TraceEvent::BusError { kind, counters });
            }
        }
        for state in [ErrorState::Warning, ErrorState::Passive, ErrorState::BusOff, ErrorState::Active] {
            push(channel, TraceEvent::State { state, counters: None });
            push(channel, TraceEvent::State { state, counters: Some((130, 4)) });
        }
        for stage in [Some(LossStage::Queue), Some(LossStage::Controller), Some(LossStage::Host), None] {
            for (count, at_least) in [(1, false), (1, true), (70_000, false)] {
                push(channel, TraceEvent::Lost { stage, count, at_least });
            }
        }
        push(channel, frame("123#55", Direction::Rx));
    }
    records
}

/// In how many respects a record differs from what it was, if it can be the same one.
fn changes(was: &TraceRecord, is: &TraceRecord) -> Option<u64> {
    // A mark at the frame before it stands for a loss in some formats.
    let back_ns = if matches!(was.event, TraceEvent::Lost { .. }) { 20 * STEP_NS } else { 0 };
    if !(-back_ns - STEP_NS / 2..STEP_NS / 2).contains(&(is.time_ns - was.time_ns)) {
        return None;
    }
    let event = match (&was.event, &is.event) {
        // A loss that is told of at another frame is none that was there.
        (TraceEvent::Lost { .. }, b) if *b == was.event && (is.time_ns - was.time_ns).abs() < STEP_NS / 2 => {
            0
        }
        (TraceEvent::Lost { .. }, TraceEvent::Lost { .. }) => return Some(1),
        (a, b) if a == b => 0,
        (
            TraceEvent::Frame { frame, direction, .. },
            TraceEvent::Frame { frame: back, direction: direction_back, .. },
        ) => {
            if frame.id() != back.id() || frame.data() != back.data() || frame.is_remote() != back.is_remote()
            {
                return None;
            }
            let form = match (frame, back) {
                (TraceFrame::Classic(a), TraceFrame::Classic(b)) => u64::from(a.dlc() != b.dlc()),
                (TraceFrame::Fd(a), TraceFrame::Fd(b)) => u64::from(a != b),
                // Its form, and its flags.
                (TraceFrame::Fd(a), _) => 1 + u64::from(a.flags() != 0),
                (TraceFrame::Classic(_), TraceFrame::Fd(_)) => return None,
            };
            form + u64::from(direction != direction_back)
        }
        (
            TraceEvent::BusError { kind, counters },
            TraceEvent::BusError { kind: kind_back, counters: counters_back },
        ) => u64::from(kind != kind_back) + u64::from(counters != counters_back),
        _ => return None,
    };
    Some(event + u64::from(was.channel != is.channel))
}

/// What is missing or differs of the records that were written, and the first such one.
fn missing(written: &[TraceRecord], back: &[TraceRecord]) -> (u64, String) {
    let (mut count, mut text, mut rest) = (0, String::new(), back);
    for record in written {
        if let Some((next, changes)) = rest.first().and_then(|next| Some((next, changes(record, next)?))) {
            count += changes;
            if changes > 0 {
                let _ = writeln!(text, "  {changes}: {record:?}\n     {next:?}");
            }
            rest = &rest[1..];
        } else {
            count += 1;
            let _ = writeln!(text, "  -: {record:?}");
        }
    }
    if let Some(next) = rest.first() {
        let _ = writeln!(text, "  behind all: {} records, {next:?}", rest.len());
        count += 1_000_000;
    }
    (count, text)
}

/// What was counted, but for what is about the file or about times.
fn counted(left_out: &LeftOut) -> u64 {
    let about_records = |what: &str| {
        !["the number", "times ", "the digits of times", "the mark of times"]
            .iter()
            .any(|begin| what.starts_with(begin))
    };
    left_out.iter().filter(|(what, _)| about_records(what)).map(|(_, count)| count).sum()
}

fn assert_accounted(name: &str, records: &[TraceRecord], directory: &std::path::Path, found: &mut String) {
    for format in Format::written() {
        let path = directory.join(file_name(format, ""));
        let left_out = write(&path, format, records);
        let options = ReadOptions { format: Some(format), ..ReadOptions::default() };
        let (back, issues) = split(open_reader(&path, &options).unwrap());
        let (missing, text) = missing(records, &back);
        if !issues.is_empty() || missing != counted(&left_out) {
            let _ = writeln!(
                found,
                "{name} to {format}: {missing} differ, {} counted: {left_out:?}, issues {issues:?}\n{text}",
                counted(&left_out)
            );
        }
    }
}

#[test]
fn every_kind_of_record_comes_through_every_format_or_is_counted() {
    let directory = directory("conversions");
    let mut found = String::new();
    assert_accounted("all", &every_kind(), &directory, &mut found);
    assert!(found.is_empty(), "{found}");
}

/// What programs write whose formats are only read, with a line of each kind.
fn samples() -> Vec<(Format, Vec<u8>)> {
    let text = |format, text: &str| (format, text.as_bytes().to_vec());
    // SocketCAN packets of a classical frame, of a remote one, of CAN FD and of an error, big-endian identifiers.
    let mut pcap =
        [&0xA1B2_C3D4_u32.to_le_bytes()[..], &[2, 0, 4, 0], &[0; 8], &[0xFF, 0xFF, 0, 0], &[227, 0, 0, 0]]
            .concat();
    let mut packet = |id: u32, len: u8, flags: u8, data: &[u8]| {
        let packet = [&id.to_be_bytes()[..], &[len, flags, 0, 0], data].concat();
        let size = (packet.len() as u32).to_le_bytes();
        pcap.extend([&1_410_714_882_u32.to_le_bytes()[..], &[0; 4], &size, &size, &packet].concat());
    };
    packet(0x123, 2, 0, &[0x11, 0x22, 0, 0, 0, 0, 0, 0]);
    packet(0x4000_0123, 3, 0, &[0; 8]);
    packet(0x98DA_F110, 12, 5, &[7; 64]);
    packet(0x2000_0088, 8, 0, &[0, 0, 4, 0, 0, 0, 0, 0]);
    vec![
        (Format::Pcap, pcap),
        // As the library of MCAP's makers writes it.
        (Format::Mcap, include_bytes!("../data/can_msgs_zstd.mcap").to_vec()),
        // As the package `rosbags` for Python writes it.
        (Format::RosBag, include_bytes!("../data/can_msgs_lz4.bag").to_vec()),
        // As pycapnp writes it with openpilot's schema: events in one segment and in several.
        (Format::Rlog, include_bytes!("../data/openpilot.rlog.gz").to_vec()),
        text(
            Format::CandumpScreen,
            " (1436509052.249713)  can0  RX - -  044   [8]  2A 36 6E 4C 11 22 33 44\n (1436509052.249714)  can1  TX - -  18DAF110   [0] \n \
             (1436509052.249715)  can0  RX - -  123   [2]  remote request\n (1436509052.249716)  can0  RX B -  321  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B\n \
             (1436509052.249717)  can1  RX - -  20000088   [8]  00 00 04 00 00 00 00 00   ERRORFRAME\n",
        ),
        text(
            Format::Busmaster,
            "***BUSMASTER Ver 2.4.0***\n***PROTOCOL CAN***\n***START DATE AND TIME 8:8:2014 23:59:58:965***\n***HEX***\n***SYSTEM MODE***\n\
             ***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***\n23:59:59:9420 Rx 1 0x023 s 1 40 \n\
             00:00:00:0001 Tx 2 0x18DAF110 x 2 03 E0 \n00:00:01:5000 Rx 1 0x460 sr 4 \n",
        ),
        text(
            Format::Crtd,
            "1320745424.002 R11 402 FA 01\n1320745424.106 2R29 18DAF110 00\n1320745424.107 3T11 7DF 02\n",
        ),
        text(
            Format::Kvaser,
            "                              Kvaser Memorator Log\n                              ====================\n\n\
             Settings:\n   Format of data field: HEX\n   Format of id field:   HEX\n   CAN channel:          1 2\n\n        \
             Time Chan   Identifier Flags        DLC  Data                           Counter\n\
             ==================================================================================\n    \
             0.000100  1         123    Rx            2  11 22                            1\n    \
             0.000200  2    18DAF110x   Tx            0                                   2\n    \
             0.000300  1         123    Rx      R     4  RTR                              3\n    \
             0.000400  1  ErrorFrame    Rx                 ERROR FRAME                     4\n",
        ),
        text(
            Format::Microchip,
            "//---------------------------------\nMicrochip Technology Inc.\nCAN BUS Analyzer\nSavvyCAN Exporter\n\
             Logging Started: 3/5/2016 12:0:0\n//---------------------------------\n1247;RX;0xC2;2;0x5C;0x87\n1248;TX;0x18DAF110;1;0x05;\n",
        ),
        text(
            Format::CanHacker,
            "Time   ID     DLC Data                    Comment\n00.500 18EA0003 8 BE FE 00 00 FF FF FF FF \n59.900 301      2 A6 07 \n",
        ),
        text(
            Format::CanKing,
            "Chn Identifier Flg   DLC  D0...1...2...3...4...5...6..D7       Time     Dir\n \
             0    0CFBFFDB X       2  1B  31                                100.000139 R\n \
             1    000007E8 R       3                                       1675.570500 R\n \
             0    00000123 FB      9  00  01  02  03  04  05  06  07  08  09  0A  0B  1676.000000 T\n \
             0    00000000            ErrorFrame                           1677.095270 R\n",
        ),
        text(
            Format::Printer,
            "Timestamp: 1436509052.249713    ID:      044    S Rx                DL:  2    2a 36                      Channel: can0\n\
             Timestamp: 1436509052.249714    ID: 18daf110    X Tx                DL:  0                               Channel: can1\n\
             Timestamp: 1436509052.249715    ID:      123    S Rx   R            DL:  3                               Channel: can0\n",
        ),
        text(
            Format::CanEdgeCsv,
            "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;ESI;RTR;DataBytes\n\
             1670926807.419500;1;044;0;8;8;0;0;0;0;0;2A366E4C11223344\n1670926807.419700;2;18DAF110;1;0;0;1;0;0;0;0;\n\
             1670926807.419900;1;321;0;9;12;0;1;1;0;0;000102030405060708090A0B\n\
             1670926807.420000;9;7FF;0;1;1;0;1;0;1;0;AA\n1670926807.420100;1;126;0;12;8;0;0;0;0;0;0102030405060708\n\
             1670926807.420200;1;123;0;4;0;0;0;0;0;1;\n",
        ),
        text(
            Format::BatteryEmulator,
            "(0.05) RX0 17FC007B [8] 11 22 33 44 55 66 77 88\r\n(0.05) TX1 3C0 [2] 00 FF\r\n(0.06) RX2 7 [0]\r\n\
             [12 CAN frames not printed]\r\n(51.261) TX3 1FFFFFFF [12] 00 01 02 03 04 05 06 07 08 09 0A 0B\r\n",
        ),
        text(
            Format::Nmea2000,
            "00:29:58.617 R 0DFF180D A2 8C 50 C0 FF FF FF FF\n00:29:58.700 T 18EAFF44 14 F0 01\n\
             2011-11-24-22:42:04.388,2,127250,36,255,8,ff,10,3b,ff,7f,ce,f5,fc\nA000159.990 CCFF7 0FF63 3B9F0000000002FF\n",
        ),
        text(
            Format::Carbus,
            "@ TEXT @ 3 @ 64 @ 0 @ 2 @ 20672 @ 00:00:20.672 @\r15,316000\t1\t00000004\t30B\t8\t10 2E 02 00 08 00 00 14\t00000000\t .      \t\r\
             15,320000\t2\t00000005\t1B000067\t2\t67 00\t00000000\tg \t\r",
        ),
        text(
            Format::TraceWindow,
            "0.010640\tCAN 1\t123\tEngine\tCAN Frame\tRx\t2\t2\t11 22\n0.020000\tCAN 2\t18FEF100x\t\tCAN Frame\tTx\t8\t8\t01 02 03 04 05 06 07 08\n\
             0.030000\tCAN 1\t7DF\t\tRemote Frame\tRx\t0\t0\t\n0.040000\tCAN 1\tError Frame\n  EngSpeed\t1200\n",
        ),
        text(
            Format::EspHome,
            "[12:00:01][D][canbus:070]: received can message (#1) std can_id=0x305 size=1\n[12:00:01][V][canbus:077]:   can_message.data[0]=0a\n\
             [12:00:02][D][canbus:067]: received can message (#2) extended can_id=0x18fef100 size=0\n",
        ),
        text(
            Format::Sigrok,
            "can-1: Start of frame\ncan-1: Identifier: 291 (0x123)\ncan-1: Data length code: 1\ncan-1: Data byte 0: 0x11\ncan-1: End of frame\n\
             can-2: Start of frame\ncan-2: Full Identifier: 418644160 (0x18f400c0)\ncan-2: Remote transmission request: remote frame\n\
             can-2: Data length code: 4\ncan-2: End of frame\n",
        ),
        text(
            Format::Saleae,
            "name,type,start_time,duration,identifier,num_data_bytes,data,crc,ack,remote_frame,extended\n\
             CAN,identifier_field,-0.5,1e-05,0x123,,,,,,\nCAN,control_field,0,1e-05,,1,,,,,\nCAN,data_field,0,1e-05,,,0x11,,,,\n\
             CAN,crc_field,0,1e-05,,,,0x1,,,\nCAN,ack_field,0,1e-05,,,,,true,,\n\
             CAN [2],identifier_field,0.5,1e-05,0x18FEF100,,,,,,true\nCAN [2],control_field,0,1e-05,,0,,,,,\n\
             CAN [2],crc_field,0,1e-05,,,,0x1,,,\nCAN [2],ack_field,0,1e-05,,,,,true,,\n",
        ),
        (
            Format::CanServer,
            b"CANSERVER_v2_CANSERVER\xCE\x00\x80\x2D\x0A\x24\x0A\x06\x00\xCF\x01\x00\x23\x01\x11\xAA\xCF\x02\x00\x24\x01\x00".to_vec(),
        ),
        (
            Format::Actisense,
            b"\x1B\x01\x03\x00\x10\xE7\xA7\x84\x83\xD9\x01\x1B\x0A\x1B\x01\x07\x95\x07\x01\x00\x00\x01\xF8\x09\xAA\x1B\x0A\x1B\x01\x07\x95\x06\x02\x00\x0A\xFF\xEF\x9D\x1B\x0A"
                .to_vec(),
        ),
        text(
            Format::UsbCan,
            "序号,系统时间,时间标识,CAN通道,传输方向,ID号,帧类型,帧格式,CAN类型,长度,数据\r\n\
             0,=\"12:04:59.533\",0x592897,ch1,接收,0x0009001C,数据帧,扩展帧,CAN,0x08,x| 05 C3 8A 43 00 02 EE 00 \r\n\
             1,=\"12:04:59.534\",0x59289C,ch2,接收,0x0406,数据帧,标准帧,CANFD,0x0C,x| 00 01 02 03 04 05 06 07 08 09 0A 0B \r\n\
             2,=\"12:04:59.600\",无,ch1,发送,0x0600,远程帧,标准帧,CAN,0x04,x| \r\n",
        ),
        text(
            Format::Labelled,
            "12:00:00.100 -> Standard ID: 0x123       DLC: 2  Data: 0x01 0x02\r\n\
             12:00:00.200 -> Extended ID: 0x18FEF100  DLC: 0  Data:\r\n12:00:00.300 -> ready\r\n\
             12:00:00.400 -> TX: Standard ID: 0x123       DLC: 3  Data: REMOTE REQUEST FRAME\r\n",
        ),
        text(
            Format::Slcan,
            "O\rt12320102001E\rT18FEF10000020\rr1233EA5F\r\x07e3ooo\re1a\rsp128000\rz\rb1239000102030405060708090A0B0010\r",
        ),
        text(
            Format::RosEcho,
            "header:\n  stamp:\n    sec: 7\n    nanosec: 5\n  frame_id: can\nid: 291\nis_rtr: true\nis_extended: false\nis_error: false\ndlc: 3\n\
             data: [0, 0, 0, 0, 0, 0, 0, 0]\n---\nheader:\n  stamp:\n    sec: 7\n    nanosec: 6\n  frame_id: can\nid: 64\nis_extended: false\n\
             is_error: true\nlen: 8\ndata: [0, 8, 0, 0, 0, 0, 130, 0]\n---\ndata: hello\n---\n",
        ),
        text(
            Format::Table,
            "Timestamp,CAN ID,IDE,Bus,Dir,RTR,DLC,Data,Label\n1478198376.389427,0A5,0,0,Rx,0,2,05 21,R\n\
             1478198376.389428,18DAF110,1,1,Tx,0,0,,R\n1478198376.389429,123,0,0,Rx,1,3,,R\n\
             1478198376.389430,124,0,0,Rx,0,12,00 01 02 03 04 05 06 07 08 09 0A 0B,T\n",
        ),
        text(
            Format::Json,
            "{\"timestamp\": 1.5, \"id\": 291, \"channel\": 2, \"is_rx\": true, \"dlc\": 2, \"data\": [17, 34]}\n\
             {\"timestamp\": 1.6, \"id\": 419361278, \"channel\": 2, \"is_rx\": false, \"dlc\": 0, \"data\": []}\n\
             {\"timestamp\": 1.7, \"id\": 291, \"channel\": 2, \"is_rx\": true, \"dlc\": 3, \"rtr\": true, \"data\": []}\n\
             {\"timestamp\": 1.8, \"id\": 291, \"channel\": 2, \"is_rx\": true, \"dlc\": 9, \"data\": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]}\n",
        ),
    ]
}

/// A format that is written: what it keeps of every kind. Others: a file of the program it belongs to.
#[test]
fn what_any_format_gives_comes_through_every_format_or_is_counted() {
    let directory = directory("conversions_of_all");
    let mut found = String::new();
    let mut sources: Vec<(Format, PathBuf)> = Vec::new();
    for format in Format::written() {
        let path = directory.join(format!("from-{}", file_name(format, "")));
        write(&path, format, &every_kind());
        sources.push((format, path));
    }
    for (format, bytes) in samples() {
        let path = directory.join(format!("from-{}", file_name(format, "")));
        fs::write(&path, bytes).unwrap();
        sources.push((format, path));
    }
    for (format, path) in &sources {
        // Also that each is known by its content.
        let (mut records, issues) = read(path);
        assert_eq!(issues, Vec::<String>::new(), "{format}");
        assert!(records.len() > 1, "{format}");
        for (at, record) in records.iter_mut().enumerate() {
            record.time_ns = START_NS + STEP_NS * at as i64;
        }
        assert_accounted(&format.to_string(), &records, &directory, &mut found);
    }
    // python-can's databases are compared in trace_files_agree_with_peers.rs, and Parquet has every kind back in parquet.rs.
    let missing: Vec<_> = Format::all()
        .filter(|format| !matches!(format, Format::Parquet | Format::Sqlite))
        .filter(|format| !sources.iter().any(|(source, _)| source == format))
        .collect();
    assert_eq!(missing, Vec::<Format>::new());
    assert!(found.is_empty(), "{found}");
}
