use super::{FORMATS, FormatSpec, Head};
use crate::{CsvDialect, Format, TrcVersion};

#[test]
fn files_are_known_by_their_beginning() {
    let utf8 = |text: &str| text.as_bytes().to_vec();
    for (head, format) in [
        (utf8("(1410714882.622188) can0 123#11\n"), Format::Candump),
        (utf8("date Sam Sep 30 15:06:13.191 2017\n"), Format::Asc),
        (utf8("// a comment\n\ndate Sam Sep 30 15:06:13.191 2017\n"), Format::Asc),
        (utf8("base hex  timestamps absolute\n"), Format::Asc),
        (utf8("begin asc log\nDate Thu\nbase hex timestamps absolute\n"), Format::Asc),
        (utf8(";   Start time: 18.12.2021 14:28:07.062\n;\n"), Format::Trc(TrcVersion::V2_1)),
        (utf8(";$FILEVERSION=1.1\n"), Format::Trc(TrcVersion::V2_1)),
        (utf8("LOGG\0\0\0\0"), Format::Blf),
        (utf8("MDF     4.10    "), Format::Mf4),
        (utf8("UnFinMF 4.11    "), Format::Mf4),
        (vec![0x0A, 0x0D, 0x0D, 0x0A], Format::Pcapng),
        (vec![0xD4, 0xC3, 0xB2, 0xA1], Format::Pcap),
        (vec![0xA1, 0xB2, 0x3C, 0x4D], Format::Pcap),
        (utf8("Time Stamp,ID,Extended,Dir,Bus,LEN,D1\n"), Format::Csv(CsvDialect::Gvret)),
        (utf8("timestamp,arbitration_id,extended\n"), Format::Csv(CsvDialect::PythonCan)),
        (utf8("  can0  123   [8]  11 22 33 44 55 66 77 88\n"), Format::CandumpScreen),
        (utf8(" (000.000000)  can0  RX - -  12345678   [0]\n"), Format::CandumpScreen),
        (utf8("# drive 3\n\n can0  123   [2]  11 22\n"), Format::CandumpScreen),
        (utf8("# drive 3\n(1410714882.622188) can0 123#11\n"), Format::Candump),
        (utf8("123#DEADBEEF\n18DAF110#\n"), Format::Candump),
        (utf8("cansend vcan0 1D0#000000000000000A\n"), Format::Candump),
        (utf8("candump can0\n  can0  080   [0] \n"), Format::CandumpScreen),
        (utf8("pi@car:~$ candump any\n  can0  080   [0] \n"), Format::CandumpScreen),
        (
            utf8("interface = can0, family = 29, type = 3, proto = 1\n<0x18eeff01> [1] 05\n"),
            Format::CandumpScreen,
        ),
        (utf8("0128 [2] 0b 61\n"), Format::CandumpScreen),
        (utf8("***BUSMASTER Ver 2.4.0***\n"), Format::Busmaster),
        (utf8("\r\n***HEX***\n***RELATIVE MODE***\n"), Format::Busmaster),
        (utf8("22:20:14:992 Rx 0 0000021A s 2 FE 36\n"), Format::Busmaster),
        (utf8("00:29:58.617 R 0DFF180D A2 8C\n"), Format::Nmea2000),
        (utf8("2011-11-24-22:42:04.388,2,127250,36,255,2,ff,10\n"), Format::Nmea2000),
        (utf8("A000159.990 CCFF7 0FF63 3B9F\n"), Format::Nmea2000),
        (utf8("@ TEXT @ 3 @ 64 @ 0 @ 10094 @ 20672 @ 00:00:20.672 @\r"), Format::Carbus),
        (utf8("# a fixture\n1320745424.002 1R11 402 FA 01\n"), Format::Crtd),
        (utf8("1320745424.000 CXX OVMS converted log\n"), Format::Crtd),
        (utf8("123.431 2R11 27E 00\n"), Format::Crtd),
        (utf8("   0.010640 CAN 1  123  Rx  8  00 01 02 03 04 05 06 07\n"), Format::TraceWindow),
        (utf8("Time  Chn  ID  Name  Dir  DLC  Data\n0,01  CAN 1  123  A  Rx  1  11\n"), Format::TraceWindow),
        (utf8("Time\tChn\tID\tName\tDir\tDLC\tData\n0,01\tCAN 1\t123\tA\tRx\t1\t11\n"), Format::Table),
        (
            utf8("[12:00:01][D][canbus:070]: received can message (#1) std can_id=0x305 size=0\n"),
            Format::EspHome,
        ),
        (utf8("can-1: Start of frame\ncan-1: Identifier: 291 (0x123)\n"), Format::Sigrok),
        (utf8("                              Kvaser Memorator Log\n"), Format::Kvaser),
        (utf8("Chn Identifier Flg   DLC  D0...1...2...3\n"), Format::CanKing),
        (utf8("SQLite format 3\0"), Format::Sqlite),
        (utf8("PAR1"), Format::Parquet),
        (utf8("$IIHDG,097,,,00,E*1C\r\n$MXPGN,01F211,6872,034E46FFFFFFFFFF*6E\r\n"), Format::Nmea2000),
        (utf8("{\"timestamp\": 1.5, \"id\": 291, \"dlc\": 2, \"data\": [1, 2]}\n"), Format::Json),
        (
            utf8("[\n  {\n    \"time\": 1.5,\n    \"can_id\": \"0x123\",\n    \"data\": \"0102\"\n  },\n"),
            Format::Json,
        ),
        (
            utf8("{\"device\": \"a\", \"frames\": [{\"ts\": 1, \"id\": \"123\", \"data\": \"\"}]}"),
            Format::Json,
        ),
        (
            utf8("{\"time_s\":1.5,\"channel\":1,\"match\":true,\"id\":\"123\",\"frame\":\"123#11\"}\n"),
            Format::Json,
        ),
        (b"\x89MCAP0\r\n".to_vec(), Format::Mcap),
        (utf8("#ROSBAG V2.0\n"), Format::RosBag),
        (b"\0\0\0\0\x04\0\0\0\0\0\0\0\x02\0\x01\0".to_vec(), Format::Rlog),
        (utf8("(51.26) RX0 17FC007B [8] 01 02 03 04 05 06 07 08\n"), Format::BatteryEmulator),
        (utf8("TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes\n"), Format::CanEdgeCsv),
        (utf8("//-----\nMicrochip Technology Inc.\n"), Format::Microchip),
        (utf8("Time   ID     DLC Data                    Comment\n"), Format::CanHacker),
        (utf8("Timestamp: 1410714882.000000    ID:      123    S Rx"), Format::Printer),
        (utf8("Timestamp: 1479121434.850202        ID: 0350    000    DLC: 8    05 28"), Format::Printer),
        (utf8("序号,系统时间,时间标识,CAN通道,传输方向,ID号,帧类型,帧格式,长度,数据\n"), Format::UsbCan),
        (utf8("Index,Direction,Timesteamp,ID,Format,Type,Length,Data,\n"), Format::UsbCan),
        (utf8("MCP2515 ready\r\nStandard ID: 0x036       DLC: 1  Data: 0x13\r\n"), Format::Labelled),
        (utf8("------- CAN Read ----------\nID  DLC   DATA\n123 1 4 \n"), Format::Labelled),
        (utf8("t12380102030405060708\rT18FEF100201021A2B\rz\r"), Format::Slcan),
        (utf8("12:34:56.789 -> t1232AABB\r\n"), Format::Slcan),
        (utf8("V1013\nN0042\n\x07t1230\nd123B000102030405060708090A0B0C0D0E0F10111213\n"), Format::Slcan),
        (
            utf8("header: \n  seq: 1\n  frame_id: ''\nid: 304\nis_rtr: False\nis_extended: False\n"),
            Format::RosEcho,
        ),
        (utf8("timestamp,arbitration_id,data_field,attack\n1.0,0C1,00,0\n"), Format::Table),
        (utf8("time,addr,bus,data\n"), Format::Table),
        (utf8("Index;ID;Data\n"), Format::Table),
        (utf8("VIN: 1\nMAKE: X\nTime,Type,ID,Data Length,Byte 0,Byte 1\n"), Format::Table),
        (utf8("1478198376.389427,0316,2,05,21,R\n"), Format::Table),
        (utf8("1478198376.389427,0x316,0,0,0,2,BSE=\n"), Format::Csv(CsvDialect::PythonCan)),
        (utf8("   335)      4486.6  Rx     05150000  2  00 01 \n"), Format::Trc(TrcVersion::V2_1)),
        (utf8("    307      3868.800 DT 05150000 Rx 2  00 01 \n"), Format::Trc(TrcVersion::V2_1)),
        (utf8("1483093132.049669        0380    000    2    30 bb\n"), Format::Table),
        (utf8("0.001 0x100 204E00000000\n"), Format::Table),
        (utf8("0.001 1 0x100 2 20 4E\n"), Format::Table),
        (utf8("370458000,00000394,false,0,3,00,E0,98\r\n"), Format::Csv(CsvDialect::Gvret)),
        (utf8("11T082554602;1;cf00203;cd402800043828ff\n"), Format::Table),
    ] {
        assert_eq!(Format::of_content(&head), Some(format), "{}", String::from_utf8_lossy(&head));
        let begins = FORMATS.iter().filter(|spec| (spec.begins)(&Head::of(&head)));
        assert_eq!(begins.count(), 1, "{}", String::from_utf8_lossy(&head));
    }
    for head in [
        "",
        "rubbish",
        "   0.015991 1 123 Rx d 1 0A",
        "[8]",
        "{}",
        "{\"id\": 1, \"name\": \"x\"}",
        "[{\"a\": 1}]",
        "[[1, 2], [3]]",
        "{\"id\":",
        "VIN: 1\nID,Data\n",
        "t1232 0102\n",
        "dead0\nbeef\n",
        "S6\rO\r",
    ] {
        assert_eq!(Format::of_content(head.as_bytes()), None, "{head}");
    }
}

#[test]
fn each_format_has_a_row_and_names_of_its_own() {
    for (at, spec) in FORMATS.iter().enumerate() {
        assert_eq!(spec.format.to_string().parse(), Ok(spec.format));
        for other in &FORMATS[at + 1..] {
            assert_ne!(spec.format, other.format);
            assert!(spec.names.iter().all(|name| !other.names.contains(name)), "{}", spec.format);
        }
    }
    let dialects =
        [CsvDialect::PythonCan, CsvDialect::Full, CsvDialect::Analyser, CsvDialect::Gvret].map(Format::Csv);
    let versions = [
        TrcVersion::V2_1,
        TrcVersion::V2_0,
        TrcVersion::V1_3,
        TrcVersion::V1_2,
        TrcVersion::V1_1,
        TrcVersion::V1_0,
    ]
    .map(Format::Trc);
    for format in dialects.into_iter().chain(versions) {
        assert_eq!(FormatSpec::of(format).format, format);
    }
}
