//! Tables as people share them, in the columns of the collections named.

use super::super::tests;
use crate::{Columns, CsvDialect, Format, ReadOptions, TraceReader};
use proptest::prelude::*;

/// What is read of a table that is known by its content, as candump's lines, and what is wrong with it.
fn as_log(file: &str) -> (String, Vec<String>) {
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Table), "{file}");
    tests::as_log(Format::Table, file)
}

fn with_columns(columns: &str, file: &str) -> (String, Vec<String>) {
    let columns: Columns = columns.parse().unwrap();
    let options =
        ReadOptions { format: Some(Format::Table), columns: Some(columns), ..ReadOptions::default() };
    let (records, issues) = tests::read_with(&options, file);
    (tests::write(Format::Candump, &records), issues)
}

/// As scanners of hobbyists print them: no time, and as many cells as the frame has bytes.
#[test]
fn rows_that_begin_with_the_identifier_are_read_with_columns() {
    let (log, issues) = with_columns("id=1,bytes=2", "394,57,4,1F,0\n1AC,4\n0,1,0\n7FF\n");
    assert_eq!(issues, Vec::<String>::new());
    let lines =
        ["394#57041F00", "1AC#04", "000#0100", "7FF#"].map(|frame| format!("(0.000000) can0 {frame}\n"));
    assert_eq!(log, lines.concat());
}

/// As `rostopic echo -p` prints them, and as pandas writes messages of python-can; an error frame is no data frame.
#[test]
fn rows_marked_as_error_frames_are_counted_and_not_read_as_data() {
    let file = "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.id,field.is_rtr,field.is_extended,\
                field.is_error,field.dlc,field.data0,field.data1,field.data2\n\
                1520743044188934087,7,1520743044188934087,,304,0,0,0,3,0,10,92\n\
                1520743044198934087,8,1520743044198934087,,305,0,1,0,2,10,11,4\n\
                1520743044208934087,9,1520743044208934087,,8,0,0,1,2,0,0,0\n";
    let (log, issues) = as_log(file);
    assert_eq!(log, "(1520743044.188934) can0 130#000A5C\n(1520743044.198934) can0 00000131#0A0B\n");
    assert_eq!(issues, Vec::<String>::new());
    let file = "timestamp,arbitration_id,is_extended_id,is_remote_frame,is_error_frame,dlc,data\n\
                1.5,0x123,True,False,False,1,11\n1.6,0x124,False,True,False,3,\n1.7,0x4,False,False,True,1,00\n";
    let (log, issues) = as_log(file);
    assert_eq!(log, "(1.500000) can0 00000123#11\n(1.600000) can0 124#R3\n");
    assert_eq!(issues, Vec::<String>::new());
}

/// As programs of instruments export what they decoded: Saleae's Logic 1, PicoScope, IXXAT's MiniMon and canAnalyser, HMS's loggers, MicroPecker. What a
/// frame is stands in words, and a remote frame is no data frame.
#[test]
fn words_in_a_row_say_what_its_frame_is() {
    for (file, log) in [
        (
            "Time [s],Packet,Type,Identifier,Control,Data,CRC,ACK\n\
             0.001,0,DATA,0x123,0x02,0x11 0x22,0x1A2B,ACK\n0.002,1,REMOTE,0x456,0x04,,0x0123,ACK\n\
             0.003,2,DATA,0x18FEF100,0x01,0xAA,0x0123,NAK\n",
            "(0.001000) can0 123#1122\n(0.002000) can0 456#R4\n(0.003000) can0 18FEF100#AA\n",
        ),
        (
            "No.,ID,Frame,RTR,SRR,IDE,DLC,Data bytes,CRC Sequence,Error,Start Time,End Time\n\
             1,123,Base Data,0,,0,2,11 22,1A2B,,-0.001,0.001\n2,00000123,Extended Data,0,1,1,1,AA,1A2B,,0.002,0.003\n",
            "(-0.001000) can0 123#1122\n(0.002000) can0 00000123#AA\n",
        ),
        (
            "ASCII Trace IXXAT MiniMon V3  Version: 1.1.4.4533\nDate: 5/9/2024\nStart time: 2:37:37 PM\nStop time: 2:37:37 PM\n\
             Overruns:  \nBaudrate: 500 kbit/s\n\"Time\",\"Identifier (hex)\",\"Format\",\"Flags\",\"Data (hex)\"\n\
             \"00:30:06.866\",\"184\",\"Std\",\"\",\"00 06\"\n\"00:30:06.867\",\"00000185\",\"Ext\",\"\",\"01\"\n",
            "(1806.866000) can0 184#0006\n(1806.867000) can0 00000185#01\n",
        ),
        (
            "\"Bus\";\"No\";\"Time (abs)\";\"State\";\"ID (hex)\";\"DLC\";\"Data (hex)\";\"ASCII\"\n\
             \"USB-to-CAN V2 compact  CAN-1\";\"13\";\"00:03:03.521\";\"      \";\"67F\";\"8\";\"23 32 47 01 7B 00 00 00\";\"#2G.{...\"\n\
             \"USB-to-CAN V2 compact  CAN-1\";\"1,014\";\"00:03:03.522\";\"      \";\"5FF\";\"1\";\"60\";\"`\"\n",
            "(183.521000) can0 67F#233247017B000000\n(183.522000) can0 5FF#60\n",
        ),
        (
            "Bus;No;Time (abs);State;ID (hex);DLC;Data (hex);ASCII\nCAN-1;1;12.345.678.000;;123;2;11 22;..\n",
            "(12.345678) can0 123#1122\n",
        ),
        (
            "FileName,a.csv\nDateTime,2024/05/06_12:34:56\nCh,1-1\nOffset,0\n\
             Time,Ch,Protocol,Dir,Label,State,Type,Format,ID,DL,D1,D2\n0.001,1-1,CAN,R,,OK,Data Frm.,Std,123,2,11,22\n\
             0.002,1-1,CAN,R,,OK,Remote Frm.,Ext,123,4\n0.003,1-1,CAN,R,,NG,Ack Err.,Std,124,1,11\n",
            "(0.001000) can0 123#1122\n(0.002000) can0 00000123#R4\n",
        ),
        (
            "Time\tChn\tID\tEvent Type\tDir\tDLC\tData\n0.1\tCAN 1\t123\tCAN FD Frame BRS\tRx\t2\t11 22\n",
            "(0.100000) can0 123##11122\n",
        ),
    ] {
        let (read, issues) = as_log(file);
        assert_eq!((read.as_str(), issues), (log, Vec::<String>::new()), "{file}");
    }
}

/// As Vehicle Spy exports them: lines about the networks, then names for each kind of network.
#[test]
fn vehicle_spys_rows_are_read_with_their_networks() {
    let names = "Line,Abs Time(Sec),Rel Time (Sec),Status,Er,Tx,Description,Network,Node";
    let file = format!(
        "Vehicle Spy,Log File\nStart Date,9/3/2026\n\nNetwork Description,Hardware,Network,Protocol,Baud Rate\n\
         {names},Arb ID,Remote/EDL-BRS-ESI,Xtd,B1,B2,B3,B4,B5,B6,B7,B8,Value,Trigger,Signals\n\
         {names},PT,Trgt,Src,B1,B2,B3,B4,B5,B6,B7,B8,Value,Trigger,Signals\n\
         1,2550.368293675,0.003818,67371008,F,F,HS CAN $119,HS CAN,,119,F,F,00,00,00,00,00,00,0D,8B,,,\n\
         2,2550.368493675,0.000200,67371008,F,T,MS CAN $18FEF100,MS CAN,,18FEF100,F,T,10,11,,,,,,,,,\n\
         3,2550.368593675,0.000100,67371008,F,F,HS CAN $120,HS CAN,,120,T-T-F,F,10,11,12,13,14,15,16,17,18 19 1A 1B,,\n\
         4,2550.368693675,0.000100,67371008,T,F,HS CAN $0,HS CAN,,0,F,F,,,,,,,,,,,\n"
    );
    let (log, issues) = as_log(&file);
    assert_eq!(log, "(2550.368293) can0 119#0000000000000D8B\n(2550.368493) can1 18FEF100#1011 T\n");
    assert_eq!(issues.len(), 1, "{issues:?}");
    assert!(issues[0].contains("CAN FD is not read"), "{issues:?}");
    // Two files, one behind the other.
    let (log, issues) = as_log("time,id,data\n1.5,0x12,01\ntime,id,data\n2.5,0x12,02\n");
    assert_eq!((log.lines().count(), issues), (2, vec![]));
}

/// As makers of excavators export them: the machine above, and a mark of the identifier's kind.
#[test]
fn lines_above_the_names_are_counted_and_the_rows_below_are_read() {
    let rows = "\"ID\",\"Time\",\"Type\",\"PGN\",\"PID\",\"Data Length\",\"Byte 0\",\"Byte 1\"\n\
                \"0\",\"1678273542.919593\",\"29-bit\",\"0xFE92\",\"0x1CFE9200\",\"2\",0xFF,0x6D\n";
    let file = format!("VIN: 7\nMAKE: X, Y\nDATE(DD/MM/YYYY): 8/3/2023\n{rows}");
    let (log, issues) = with_columns("time=Time,id=PID:hex,dlc=Data Length,bytes=Byte 0", &file);
    assert_eq!(log, "(1678273542.919593) can0 1CFE9200#FF6D\n");
    assert_eq!(issues, Vec::<String>::new());
    let file = "Logger 3\nfirmware, 1.2\ntime,id,dlc,D0\n1.5,100,1,10\n1.6,200,1,255\n";
    let (log, issues) = as_log(file);
    assert_eq!(log, "(1.500000) can0 100#0A\n(1.600000) can0 200#FF\n");
    assert_eq!(issues, Vec::<String>::new());
    // What counts the rows is no identifier, whatever stands above it.
    let rows: Vec<_> = (0..30).map(|row| format!("{row},1.5,0x1CFE9200,2,FF,6D\n")).collect();
    let (log, issues) = as_log(&format!("VIN: 7\nID,Time,PID,Length,Byte 0,Byte 1\n{}", rows.concat()));
    assert_eq!(log, "");
    assert!(issues[0].contains("--columns id=NAME"), "{issues:?}");
    // A first row that is damaged is none of them.
    let (_, issues) = tests::as_log(Format::Table, "1.5,100\n1.5,0x100,0A0B\n");
    assert_eq!(issues.len(), 1, "{issues:?}");
}

#[test]
fn tables_of_public_collections_are_known_and_read_whole() {
    for (file, log) in [
        // HCRL's car hacking: no names, as many cells of bytes as the length says, then a mark.
        (
            "1478198376.389427,0316,8,05,21,68,09,21,21,00,6f,R\n1478198376.389636,0690,2,00,0a,T\n",
            "(1478198376.389427) can0 316#052168092121006F\n(1478198376.389636) can0 690#000A\n",
        ),
        // CrySyS's: blanks, and a cell that is always 000.
        (
            "1483093132.049669        0380    000    8    30 bb 82 00 9d 53 00 81\n1483093132.050104        0180    000    2    64 10\n",
            "(1483093132.049669) can0 380#30BB82009D530081\n(1483093132.050104) can0 180#6410\n",
        ),
        // A channel before the identifier.
        (
            "0.000000 1 0x100 8 11 22 33 44 55 66 77 88\n0.001000 2 0x18FEF100 2 AA BB\n",
            "(0.000000) can0 100#1122334455667788\n(0.001000) can1 18FEF100#AABB\n",
        ),
        // With `0x`, or all bytes in a cell.
        (
            "1513468793.000114,0x0153,8,00,21,10,ff,00,ff,00,00,R\n1513468793.000309,0x2,1,07,R\n",
            "(1513468793.000114) can0 153#002110FF00FF0000\n(1513468793.000309) can0 002#07\n",
        ),
        (
            "1513920303.309700,0002,8,00 00 00 00 00 08 09 17,R\n1513920303.309900,0153,2,00 21,T\n",
            "(1513920303.309700) can0 002#0000000000080917\n(1513920303.309900) can0 153#0021\n",
        ),
        // A CL2000's file without its head.
        (
            "11T082554602;1;cf00203;cd402800043828ff\n11T082554603;0;7df;02\n",
            "(894354.602000) can0 0CF00203#CD402800043828FF\n(894354.603000) can0 7DF#02\n",
        ),
        // Python's lists, whose numbers are decimal also where none has three digits: those were once read as hexadecimal.
        (
            "Timestamp,CAN_ID,Data\n1753378914.70,0x104,\"[83, 38, 131, 212, 66, 239, 132, 80]\"\n1753378915.21,0x102,\"[78, 10, 0]\"\n",
            "(1753378914.700000) can0 104#532683D442EF8450\n(1753378915.210000) can0 102#4E0A00\n",
        ),
        (
            "Timestamp,CAN_ID,Data\n1.5,104,\"[10, 0A]\"\n1.6,0FF,\"[01, 12]\"\n",
            "(1.500000) can0 104#100A\n(1.600000) can0 0FF#0112\n",
        ),
        // MATLAB's table of a log.
        (
            "Time,ID,Extended,Name,Data_1,Data_2,Length,Error,Remote\n1.8173 sec,419427898,1,,0,200,2,0,0\n",
            "(1.817300) can0 18FFF63A#00C8\n",
        ),
        // `tshark -T fields` with commas: decimal identifiers, bytes with colons between them.
        (
            "0.000000000,291,2,01:02\n0.010000000,419361024,1,03\n0.020000000,291,0,\n",
            "(0.000000) can0 123#0102\n(0.010000) can0 18FEF100#03\n(0.020000) can0 123#\n",
        ),
        // Of programs for lessons.
        (
            "0.001 0x100 204E000000000000\n0.002 0x18DAF110 507D\n",
            "(0.001000) can0 100#204E000000000000\n(0.002000) can0 18DAF110#507D\n",
        ),
        // HCRL's challenge.
        (
            "Timestamp,Arbitration_ID,DLC,Data,Class,SubClass\n1597759710.1258,153,8,20 A1 10 FF 00 FF 50 1F,Normal,Normal\n1597759710.2,2B0,2,05 00,Attack,Spoofing\n",
            "(1597759710.125800) can0 153#20A110FF00FF501F\n(1597759710.200000) can0 2B0#0500\n",
        ),
        // can-train-and-test.
        (
            "timestamp,arbitration_id,data_field,attack\n1672531360.46,0C1,0000000000000000,0\n1672531360.461,0C5,14E06E,0\n",
            "(1672531360.460000) can0 0C1#0000000000000000\n(1672531360.461000) can0 0C5#14E06E\n",
        ),
        // Cabana's.
        (
            "time,addr,bus,data\n0.01,0x1d2,0,0x40a0\n0.02,0x18DAF110,1,0x\n",
            "(0.010000) can0 1D2#40A0\n(0.020000) can1 18DAF110#\n",
        ),
        // Cabana's with what the panda sent, and what it was asked to send and rejected.
        (
            "time,addr,bus,data\n0.01,0x1d2,2,0x40\n0.02,0x2e4,130,0x41\n0.03,0x2e5,192,0x42\n",
            "(0.010000) can2 1D2#40\n(0.020000) can2 2E4#41 T\n",
        ),
        // SavvyCAN's generic table, which has no times, and identifiers of eight digits whatever they are.
        (
            "ID,Data Bytes\n0000021A,FE 36 12 \n18DAF110,00 \n",
            "(0.000000) can0 21A#FE3612\n(0.000000) can0 18DAF110#00\n",
        ),
        // CL2000's; the last day is one of the next month.
        (
            "# Logger type: CL2000\n# Time: 20231031T071031\n# Value separator: \";\"\nTimestamp;Type;ID;Data\n31T135012345;1;cf00203;cde0270004b827ff\n01T000000001;0;123;0102\n",
            "(1698760212.345000) can0 0CF00203#CDE0270004B827FF\n(1698796800.001000) can0 123#0102\n",
        ),
        // Cells of bytes with names, more of them than a frame has, tabs, times in milliseconds.
        (
            "Time (ms)\tCAN ID\tDLC\tD0\tD1\tD2\tD3\tLabel\n12.5\t7FF\t2\t01\t02\t\t\tx\n13\t100\t0\t\t\t\t\tx\n",
            "(0.012500) can0 7FF#0102\n(0.013000) can0 100#\n",
        ),
        // Blanks, no names.
        (
            "1538480862.456 0110 2 00 11\n1538480862.457 0120 1 22\n",
            "(1538480862.456000) can0 110#0011\n(1538480862.457000) can0 120#22\n",
        ),
    ] {
        assert_eq!(as_log(file), (log.to_owned(), vec![]), "{file}");
    }
}

#[test]
fn the_kind_of_numbers_is_found_in_the_rows() {
    // No identifier has a letter, and one is too large for hexadecimal digits.
    let (log, issues) =
        as_log("timestamp,id,data\n1614875400123456,419361024,01\n1614875400123457,291,0xFF\n");
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(1614875400.123456) can0 18FEF100#01\n(1614875400.123457) can0 123#FF\n");
    let (log, issues) =
        as_log("time,id,byte0,byte1\n2020-01-01 12:00:00,1A,255,7\n2020-01-01 12:00:01,1A,1,\n");
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(1577880000.000000) can0 01A#FF07\n(1577880001.000000) can0 01A#01\n");
}

#[test]
fn columns_that_a_user_gives_are_read() {
    let (log, issues) = with_columns(
        "time=when:ms,id=who:dec,data=what,channel=bus:0,direction=way,extended=long,remote=rtr",
        "\"who\";what;when;bus;way;long;rtr\n291;\"01 02\";5;0;Tx;no;0\n16;;6;1;Rx;yes;1\n",
    );
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(0.005000) can0 123#0102 T\n(0.006000) can1 00000010#R\n");
    let (log, issues) = with_columns("time=2:us,id=1,bytes=3", "1A3,7,1,2\n1A4,8,3,4\n");
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(0.000007) can0 1A3#0102\n(0.000008) can0 1A4#0304\n");
    let (log, issues) = with_columns("id=ID,data=Bytes", "id,dat\n1,22\n");
    assert_eq!(log, "");
    assert!(issues[0].contains("a column with the name 'Bytes'"), "{issues:?}");
}

#[test]
fn broken_rows_are_named_and_what_has_no_place_is_counted() {
    let file = "timestamp,id,dlc,data,label\n1.0,123,2,0102,a\nx,123,0,,a\n1.0,G,0,,a\n1.0,123,3,0102,a\n\
                1.0,123,1,0,a\n1.0,123,65,00,a\n1.0,20000000,1,00,a\n1.0,A23,2,010203,a\n1.0,123\n2.0,A,1,0";
    let (log, issues) = as_log(file);
    assert_eq!(log, "(1.000000) can0 123#0102\n(1.000000) can0 123#00\n");
    assert_eq!(issues.len(), 8, "{issues:#?}");
    let source = std::io::Cursor::new(file.to_owned());
    let mut reader = TraceReader::from_source("t", source, Format::Table, &ReadOptions::default()).unwrap();
    reader.by_ref().for_each(drop);
    assert_eq!(reader.notes().iter().collect::<Vec<_>>(), [(super::OTHERS, 1)]);
}

#[test]
fn a_table_that_is_not_known_is_answered_with_columns_to_give() {
    let file = "when,CAN ID,b\n1.0,123,00\n2.0,1,3\n";
    assert_eq!(Format::of_content(file.as_bytes()), None);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.csv");
    std::fs::write(&path, file).unwrap();
    let mut reader = crate::open_reader(&path, &ReadOptions::default()).unwrap();
    assert_eq!(reader.format(), Format::Csv(CsvDialect::PythonCan));
    reader.by_ref().for_each(drop);
    let message = reader.nothing_read().unwrap().to_string();
    assert!(message.contains("--columns 'time=?,id=CAN ID,data=?'"), "{message}");
}

proptest! {
    #[test]
    fn any_rows_are_read_or_counted(rows in "([0-9a-fxT.,;: \t\"-]{0,40}\n){0,10}", head in 0..3_usize) {
        let head = ["Timestamp,ID,DLC,Data\n", "time;id;d0;d1\n", "1.0,123,1,00\n"][head];
        let lines = rows.lines().filter(|line| !line.trim().is_empty()).count();
        let (records, issues) = tests::read(Format::Table, format!("{head}{rows}"));
        let first = usize::from(head.starts_with('1'));
        prop_assert_eq!(records.len() + issues.len(), lines + first);
    }
}

/// As sketches write them with `millis()` or `micros()`: taken for seconds, a trace of a minute would last for hours or weeks.
#[test]
fn whole_numbers_of_no_unit_are_in_the_one_that_fits_how_often_identifiers_come() {
    for (head, per_ms) in [("time,id,dlc,data", 1), ("Time,ID,DLC,Data", 1000), ("t,id,dlc,data", 1000)] {
        let rows = (0..40).map(|n| {
            format!("{},{},1,{:02X}\n", per_ms * 10 * (n + 1), if n % 10 == 9 { "1A0" } else { "0C0" }, n)
        });
        let file = format!("{head}\n{}", rows.collect::<String>());
        let (log, issues) = as_log(&file);
        assert_eq!(issues, Vec::<String>::new());
        assert!(log.starts_with("(0.010000) can0 0C0#00\n(0.020000) can0 0C0#01\n"), "{log}");
        let source = std::io::Cursor::new(file.into_bytes());
        let mut reader =
            TraceReader::from_source("test", source, Format::Table, &ReadOptions::default()).unwrap();
        assert_eq!(reader.by_ref().count(), 40);
        let notes: Vec<_> = reader.notes().iter().map(|(what, _)| what).collect();
        assert!(
            notes.iter().any(|what| what.starts_with("times without a unit were read as m")),
            "{notes:?}"
        );
    }
    // Seconds since 1970 in whole numbers, of which many frames have the same.
    let rows = (0..60).map(|n| format!("{},0C0,1,{n:02X}\n", 1_478_198_376 + n / 20));
    let (log, issues) = as_log(&format!("timestamp,id,dlc,data\n{}", rows.collect::<String>()));
    assert_eq!(issues, Vec::<String>::new());
    assert!(log.starts_with("(1478198376.000000) can0 0C0#00\n"), "{log}");
}

/// As scripts around python-can write a message's `data`, and pandas what it read with gaps.
#[test]
fn bytes_are_read_as_python_and_pandas_print_them() {
    for cell in [
        r"b'\x01 ,\\'",
        r#""b'\x01 ,\\'""#,
        r#""bytearray(b'\x01 ,\\')""#,
        r#""['0x1', '0x20', '0x2c', '0x5c']""#,
        r#""['01', '20', '2c', '5c']""#,
        r#""[1, 32, 44, 92]""#,
        r#""(1, 32, 44, 92)""#,
    ] {
        let cell = if cell.starts_with('b') { cell.replace(',', r"\x2c") } else { cell.to_owned() };
        let (log, issues) = as_log(&format!("timestamp,arbitration_id,dlc,data\n1.5,0x123,4,{cell}\n"));
        assert_eq!((log.as_str(), issues), ("(1.500000) can0 123#01202C5C\n", vec![]), "{cell}");
    }
    let quoted = r#""bytearray(b'a""\'\n\r\t')""#;
    let (log, issues) = as_log(&format!("timestamp,arbitration_id,dlc,data\n1.5,0x123,6,{quoted}\n"));
    assert_eq!((log.as_str(), issues), ("(1.500000) can0 123#6122270A0D09\n", vec![]));
    for bad in [r"b'\x1'", r"b'\q'", r"b'\'", "b'1", "bytearray(1)", r"b'\xzz'"] {
        let (log, issues) = as_log(&format!("timestamp,arbitration_id,data\n1.5,0x123,{bad}\n"));
        assert_eq!((log.as_str(), issues.len()), ("", 1), "{bad}");
    }
    let (log, issues) = as_log(
        "Timestamp,CAN_ID,DLC,DATA0,DATA1,DATA2,Label\n0.1,291,3.0,1.0,32.0,44.0,0\n0.2,292.0,1.0,9.0,,,0\n0.3,1300,0.0,,,,1\n",
    );
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(0.100000) can0 123#01202C\n(0.200000) can0 124#09\n(0.300000) can0 514#\n");
}

/// As the panda's own logger, libpanda and strym write them.
#[test]
fn the_pandas_columns_are_known() {
    let frame = "(1.500000) can0 123#0011\n";
    for file in [
        "Bus,MessageID,Message,MessageLength,Time\n0,0x123,0x0011,2,1.5\n",
        "Time,Bus,MessageID,Message,MessageLength\n1.5,0,0x123,0011,2\n",
    ] {
        assert_eq!(as_log(file), (frame.to_owned(), vec![]), "{file}");
    }
    let (log, issues) = as_log("Bus,MessageID,Message\n1,0x123,c000c00000000000\n");
    assert_eq!((log.as_str(), issues), ("(0.000000) can1 123#C000C00000000000\n", vec![]));
    // Where there are bytes elsewhere, it is a name.
    let (log, issues) = as_log("Time,MessageID,Message,Data\n1.5,0x123,Engine,0011\n");
    assert_eq!((log.as_str(), issues), (frame, vec![]));
}

/// Space at the ends of a line with tabs is cells with nothing in them.
#[test]
fn a_row_with_tabs_may_begin_or_end_with_an_empty_cell() {
    let (log, issues) = as_log("time\tid\tdlc\tdata\n1.5\t123\t0\t\n1.6\t124\t1\t11\n");
    assert_eq!((log.as_str(), issues), ("(1.500000) can0 123#\n(1.600000) can0 124#11\n", vec![]));
    let (log, issues) = as_log("\ttime\tid\tdata\n0\t1.5\t123\t11\n1\t1.6\t124\t12\n");
    assert_eq!((log.as_str(), issues), ("(1.500000) can0 123#11\n(1.600000) can0 124#12\n", vec![]));
}

/// As students write what a bus says to a tester and back.
#[test]
fn a_direction_may_stand_before_the_identifier() {
    let (log, issues) =
        as_log("0.000000  Tx  0x7DF   2  02 10\n0.002000  Rx  0x7E8   3  02 50 01\n0.003 Rx 123 0\n");
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(0.000000) can0 7DF#0210 T\n(0.002000) can0 7E8#025001\n(0.003000) can0 123#\n");
}

/// As an ELM327 prints frames, and others who leave out what everybody knows.
#[test]
fn rows_without_names_get_columns_by_their_numbers_to_try() {
    for (row, columns) in [
        ("7E8 03 41 0C 1A", Some("id=1:hex,bytes=2:hex")),
        ("ATMA\r\n18DAF110 8 03 41 0C 1A 00 00 00 00", Some("id=1:hex,dlc=2,bytes=3:hex")),
        ("1.5 can0 Rx 123 AA", Some("time=1,id=4:hex,bytes=5:hex")),
        ("415,FE,15", Some("id=1:hex,bytes=2:hex")),
        // Sketches print no leading zeros: the bytes before the last ones of two digits were once left out.
        ("1B6,20,3,29,4,29,0,20", Some("id=1:hex,bytes=2:hex")),
        ("1.5 123 2 1 F", Some("time=1,id=2:hex,dlc=3,bytes=4:hex")),
        ("820298   0x085: 7C 33 80", Some("id=2:hex,bytes=3:hex")),
        ("0x123,11 22 33", Some("id=1:hex,data=2:hex")),
        ("469533221,1714730974.56,2C EE 00", Some("time=2,id=1:dec,data=3:hex")),
        ("a text of words", None),
        ("2024-01-01 12:00:00 started", None),
    ] {
        assert_eq!(super::proposal_of_rows(row.as_bytes()).as_deref(), columns, "{row}");
    }
    let (log, issues) =
        with_columns("time=1:ms,id=2:hex,bytes=3:hex", "820298   0x085: 7C 33\n820301   0x047: 20\n");
    assert_eq!((log.as_str(), issues), ("(820.298000) can0 085#7C33\n(820.301000) can0 047#20\n", vec![]));
    let (log, issues) = with_columns("id=1:hex,bytes=2:hex", "7E8 03 41 0C 1A\n7E9 01\n");
    assert_eq!((log.as_str(), issues), ("(0.000000) can0 7E8#03410C1A\n(0.000000) can0 7E9#01\n", vec![]));
}

/// As `tshark -T fields` prints them, with names and without.
#[test]
fn what_tshark_prints_is_read_with_decimal_identifiers() {
    let log = "(1478198376.389927) can0 080#CA18\n(1478198376.390151) can0 00000260#\n(1478198376.390152) can0 123#R2\n";
    for separator in ["\t", ","] {
        let file = "frame.time_epoch,can.id,can.flags.xtd,can.flags.rtr,can.flags.err,can.len,data.data\n\
                    1478198376.389927000,128,0,False,0,2,ca18\n1478198376.390151000,608,1,False,0,0,\n\
                    1478198376.390152000,291,0,True,0,2,\n1478198376.390153000,8,0,False,1,2,ca:18\n";
        assert_eq!(as_log(&file.replace(',', separator)), (log.to_owned(), vec![]));
    }
    // Without names, identifiers of the same number of digits without a letter are decimal if there are many.
    let row = |n: u32| format!("1478198376.{:06}000\t{}\t1\t{n:02x}\n", n, 1000 + 13 * n);
    let (log, issues) = as_log(&(0..20).map(row).collect::<String>());
    assert_eq!(issues, Vec::<String>::new());
    assert!(log.starts_with("(1478198376.000000) can0 3E8#00\n(1478198376.000001) can0 3F5#01\n"), "{log}");
    // A bus may well have these in hexadecimal digits.
    let row = |n: u32| format!("1478198376.{:06}\t{}\t1\t{n:02x}\n", n, 100 + 50 * (n % 14));
    let (log, issues) = as_log(&(0..28).map(row).collect::<String>());
    assert_eq!(issues, Vec::<String>::new());
    assert!(log.starts_with("(1478198376.000000) can0 100#00\n(1478198376.000001) can0 150#01\n"), "{log}");
}

/// What Python prints of a list of one byte, and numpy of an array, is decimal as the longer ones are.
#[test]
fn lists_of_one_byte_are_decimal_as_the_others_are() {
    let (log, issues) = as_log(
        "timestamp,arbitration_id,data\n1.5,0x123,[68]\n1.6,0x123,\"[1, 2]\"\n1.7,0x123,[148]\n1.8,0x123,[]\n",
    );
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(
        log,
        "(1.500000) can0 123#44\n(1.600000) can0 123#0102\n(1.700000) can0 123#94\n(1.800000) can0 123#\n"
    );
    let (log, _) = as_log("timestamp,arbitration_id,data\n1.5,0x123,[17 34]\n1.6,0x123,[  1 255]\n");
    assert_eq!(log, "(1.500000) can0 123#1122\n(1.600000) can0 123#01FF\n");
    let (log, _) = as_log("timestamp,arbitration_id,data\n1.5,0x123,[17 34]\n1.6,0x123,[0A 10]\n");
    assert_eq!(log, "(1.500000) can0 123#1734\n(1.600000) can0 123#0A10\n");
}

/// As a spreadsheet saves python-can's table.
#[test]
fn python_can_s_table_with_semicolons_has_its_bytes_in_base64() {
    let (log, issues) = as_log(
        "timestamp;arbitration_id;extended;remote;error;dlc;data\n1.5;0x123;0;0;0;3;AAAA\n1.6;0x18fef100;1;0;0;1;RA==\n1.7;0x123;0;1;0;2;\n",
    );
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(1.500000) can0 123#000000\n(1.600000) can0 18FEF100#44\n(1.700000) can0 123#R2\n");
}

#[test]
fn a_clock_without_a_date_goes_on_behind_midnight() {
    let wanted = "(86399.500000) can0 123#1122\n(86400.250000) can0 123#3344\n";
    for file in [
        "23:59:59.500 Rx 0x123 2 11 22\n00:00:00.250 Rx 0x123 2 33 44\n",
        "Time,ID,Data\n23:59:59.500,123,11 22\n00:00:00.250,123,33 44\n",
        // A German spreadsheet's, with the line that says what separates its cells.
        "sep=;\nZeit;ID (hex);L\u{e4}nge;Daten\n23:59:59,500;123;2;11 22\n00:00:00,250;123;2;33 44\n",
    ] {
        let (log, issues) = as_log(file);
        assert_eq!((log.as_str(), issues), (wanted, vec![]), "{file}");
        assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Table), "{file}");
    }
}
