//! Tables of signals, as people and canmatrix make them.

use super::*;

fn read(text: &str) -> (Vec<Message>, Vec<String>) {
    let database = parse("table.csv", text.as_bytes()).unwrap();
    (database.messages, database.warnings.iter().map(ToString::to_string).collect())
}

fn shown(message: &Message) -> Vec<String> {
    let line = |signal: &Signal| {
        let order = if signal.order == ByteOrder::Little { "i" } else { "m" };
        let sign = if signal.kind == ValueKind::Signed { "-" } else { "+" };
        let mux = signal.multiplexed.as_ref().map_or(String::new(), |mux| format!(" for {:?}", mux.values));
        format!(
            "{} {}|{}{order}{sign} {} {} {}{mux}",
            signal.name, signal.start, signal.length, signal.factor, signal.offset, signal.unit
        )
    };
    message.signals.iter().map(line).collect()
}

#[test]
fn a_plain_table_is_read_with_everything_that_it_says() {
    let (messages, warnings) = read(
        "CAN ID,Message,DLC,Cycle (ms),Signal,Start bit,Length,Byte order,Signed,Factor,Offset,Min,Max,Unit,Values,Description\n\
         0x123,Engine,8,10,Speed,0,16,Intel,No,0.1,0,0,6553.5,km/h,,how fast\n\
         ,,,,Temp,16,8,Intel,Yes,1,-40,-168,87,C,,\n\
         ,,,,Gear,24,3,Intel,No,1,0,0,7,,\"0=Park; 1=Drive\",\n\
         0x18FEF1FE,Wide,,,Flow,7,16,Motorola MSB,unsigned,\"0,5\",0,,,l/h,,\n",
    );
    assert_eq!(warnings, Vec::<String>::new());
    assert_eq!(shown(&messages[0]), ["Speed 0|16i+ 0.1 0 km/h", "Temp 16|8i- 1 -40 C", "Gear 24|3i+ 1 0 "]);
    assert_eq!((messages[0].length, messages[0].cycle_ms), (8, Some(10)));
    assert_eq!(messages[0].signals[0].description, "how fast");
    assert_eq!(messages[0].signals[2].values.text(1), Some("Drive"));
    assert_eq!(shown(&messages[1]), ["Flow 7|16m+ 0.5 0 l/h"]);
    assert!(messages[1].id.is_extended() && !messages[0].id.is_extended());
}

/// canmatrix's, with its multiplexing, its bits counted from the top, and a row for each value.
#[test]
fn a_table_of_canmatrix_is_read_as_it_is_written() {
    let (messages, warnings) = read(
        "ID,Frame Name,Cycle Time [ms],Launch Type,Launch Parameter,Signal Byte No.,Signal Bit No.,Signal Name,Signal Function,Signal Length [Bit],\
         Signal Default, Signal Not Available,Byteorder,is signed,ECU,Name / Phys. Range,Function / Increment Unit,Value,frame.,signal.\n\
         123h,Engine,0,,,1,0,Speed,,16,0.0, ,m,u,r/s,0..6553.5,0.1  km/h,,,\n\
         123h,Engine,0,,,4,4,Nib,,12,0, ,m,u,r/s,0..4095,,,,\n\
         123h,Engine,0,,,7,0,Gear,,3,0, ,i,u,r/s,0..7,,\"0: Park, 1: Drive, 7: Error\",,\n\
         123h,Engine,0,,,7,0,Gear,,3,0, ,i,u,r/s,0..7,,\"0: Park, 1: Drive, 7: Error\",,\n\
         18FEF1FExh,Mux,0,,,1,0,Mode,Mode Signal: ,8,0, ,i,u,r/s,0..255,,,,\n\
         18FEF1FExh,Mux,0,,,2,0,A,Mode 0:,16,0.0, ,i,s,r/s,-16383..16384,0.5  V,,,\n\
         18FEF1FExh,Mux,0,,,2,0,B,Mode 1:,16,0, ,i,u,r/s,0..65535,A,,,\n",
    );
    assert_eq!(warnings, [NO_OFFSET]);
    assert_eq!(shown(&messages[0]), ["Speed 7|16m+ 0.1 0 km/h", "Nib 27|12m+ 1 0 ", "Gear 48|3i+ 1 0 "]);
    assert_eq!(messages[0].signals[2].values.text(7), Some("Error"));
    assert_eq!(
        shown(&messages[1]),
        ["Mode 0|8i+ 1 0 ", "A 8|16i- 0.5 0 V for [0..=0]", "B 8|16i+ 1 0 A for [1..=1]"]
    );
    assert!(messages[1].signals[0].is_switch);
}

/// As carmakers in China write them: two languages above the columns, the message in a row of its own, the lowest bit of Motorola.
#[test]
fn the_lowest_bit_of_motorola_shows_where_signals_would_overlap_otherwise() {
    let table = |order: &str| {
        format!(
            "Car matrix V2;;;;;;;;;;\n\"Msg Name\n报文名称\";\"Msg ID(Hex)\n报文标识符\";\"Msg Length(Byte)\n报文长度\";\"Signal Name\n信号名称\";\
             \"Byte Order\n排列格式(Intel/Motorola)\";\"Start Byte\n起始字节\";\"Start Bit\n起始位\";\"Bit Length(Bit)\n信号长度\";\"Date Type\n数据类型\";\
             \"Resolution\n精度\";\"Offset\n偏移量\"\n\
             ESC_1;0x100;8;;;;;;;;\n;;;A;{order};0;8;16;Unsigned;0.01;0\n;;;B;{order};2;20;4;Unsigned;1;0\n;;;C;{order};3;24;12;Signed;1;0\n"
        )
    };
    for order in ["Motorola LSB", "Motorola"] {
        let (messages, warnings) = read(&table(order));
        assert_eq!(warnings, Vec::<String>::new());
        assert_eq!(shown(&messages[0]), ["A 7|16m+ 0.01 0 ", "B 23|4m+ 1 0 ", "C 19|12m- 1 0 "], "{order}");
    }
}

#[test]
fn what_a_table_does_not_say_is_reported() {
    let (messages, warnings) = read("ID\tSignal\tStart\tLength\n100\tA\t0\t8\n200\tB\t0\t8\n");
    assert_eq!(messages.iter().map(|message| message.id.to_string()).collect::<Vec<_>>(), ["100", "200"]);
    for what in [IDS_AS_HEX, NO_ORDER, NO_FACTOR, NO_OFFSET, NO_KIND] {
        assert!(warnings.iter().any(|warning| warning == what), "{what}: {warnings:#?}");
    }
    let (messages, warnings) = read(
        "ID,Signal,Start,Length,Byte order,Factor,Offset,Type,Min\n1280,A,0,8,i,x,0,u,\n1281,B,8,8,i,1,0,,-5\n1281,C,99,65,i,1,0,u,\nTotal,D,1,1,i,1,0,u,\n",
    );
    assert_eq!(messages.len(), 1);
    assert_eq!(
        (messages[0].id.to_string(), shown(&messages[0])),
        ("501".to_owned(), vec!["B 8|8i- 1 0 ".to_owned()])
    );
    assert!(warnings.iter().any(|warning| warning.contains("factor \"x\" is not a number")), "{warnings:#?}");
    assert!(warnings.iter().any(|warning| warning.contains("65 bits")), "{warnings:#?}");
    assert!(
        warnings.iter().any(|warning| warning.contains("\"Total\" is not the identifier")),
        "{warnings:#?}"
    );
    let error = parse("a.csv", b"Time,ID,Data\n1,2,3\n").unwrap_err().to_string();
    assert!(error.contains("no table of signals"), "{error}");
    let error = parse("a.xls", &[0xD0, 0xCF, 0x11, 0xE0, 0, 0]).unwrap_err().to_string();
    assert!(error.contains("save it as .xlsx"), "{error}");
}

/// Written by canmatrix 1.2, and by openpyxl with merged cells, a cover and a formula that was not calculated.
#[test]
fn workbooks_are_read() {
    let workbook = |bytes: &[u8]| {
        let database = parse("table.xlsx", bytes).unwrap();
        let warnings: Vec<_> = database.warnings.iter().map(ToString::to_string).collect();
        (database.messages, warnings)
    };
    let (messages, warnings) = workbook(include_bytes!("../../tests/data/tables/canmatrix.xlsx"));
    assert_eq!(warnings, [NO_OFFSET, NO_KIND]);
    assert_eq!(
        shown(&messages[0]),
        ["Speed 7|16m+ 0.1 0 km/h", "Temp 23|8m- 1 0 C", "Nib 27|12m+ 1 0 ", "Gear 48|3i+ 1 0 "]
    );
    let texts: Vec<_> = messages[0].signals[3].values.iter().collect();
    assert_eq!(texts, [(0, "Park"), (1, "Drive"), (7, "Error")]);
    assert_eq!(messages[1].id.to_string(), "18FEF1FE");
    assert_eq!(
        shown(&messages[1]),
        ["Mode 0|8i+ 1 0 ", "A 8|16i- 0.5 0 V for [0..=0]", "B 8|16i+ 1 0 A for [1..=1]"]
    );
    let bytes = include_bytes!("../../tests/data/tables/carmaker.xlsx");
    let (messages, warnings) = workbook(bytes);
    assert_eq!(warnings, Vec::<String>::new());
    assert_eq!(
        shown(&messages[0]),
        ["WheelSpeed 7|16m+ 0.05625 0 km/h", "State 23|4m+ 1 0 ", "Yaw 19|12m- 0.1 -10 deg/s"]
    );
    assert_eq!((messages[0].cycle_ms, messages[0].length), (Some(20), 8));
    assert_eq!(messages[0].signals[1].values.text(3), Some("Reserved"));
    assert_eq!(
        (messages[1].id.to_string(), shown(&messages[1])),
        ("7F1".to_owned(), vec!["Doors 7|8m+ 0.5 0 %".to_owned()])
    );
    let error = parse("table.xlsx", &bytes[..3000]).unwrap_err().to_string();
    assert!(error.contains("workbook that is whole"), "{error}");
    assert_eq!(crate::parse("table.xlsx", bytes).unwrap().messages.len(), 2);
}

/// Workbooks of some kilobytes that come to more than any computer has.
#[test]
fn workbooks_that_come_to_too_much_are_refused() {
    let workbook = |sheets: usize, sheet: &str, shared: &str| {
        let sheets = "<sheet name=\"s\" r:id=\"r1\"/>".repeat(sheets);
        let links =
            "<Relationships><Relationship Id=\"r1\" Target=\"worksheets/sheet1.xml\"/></Relationships>";
        let files = [
            ("xl/workbook.xml", format!("<workbook xmlns:r=\"r\"><sheets>{sheets}</sheets></workbook>")),
            ("xl/_rels/workbook.xml.rels", links.to_owned()),
            ("xl/worksheets/sheet1.xml", format!("<worksheet><sheetData>{sheet}</sheetData></worksheet>")),
            ("xl/sharedStrings.xml", format!("<sst><si><t>{shared}</t></si></sst>")),
        ];
        let mut bytes = Vec::new();
        let mut archive = rawzip::ZipArchiveWriter::new(&mut bytes);
        for (name, content) in files {
            let (mut entry, config) = archive
                .new_file(name)
                .compression_method(rawzip::CompressionMethod::DEFLATE)
                .start()
                .unwrap();
            let encoder = flate2::write::DeflateEncoder::new(&mut entry, flate2::Compression::fast());
            let mut writer = config.wrap(encoder);
            std::io::Write::write_all(&mut writer, content.as_bytes()).unwrap();
            let (encoder, descriptor) = writer.finish().unwrap();
            encoder.finish().unwrap();
            entry.finish(descriptor).unwrap();
        }
        archive.finish().unwrap();
        bytes
    };
    let wide = "<row><c r=\"XFD1\"><v>1</v></c></row>".repeat(100_000);
    let texts = "<row><c t=\"s\"><v>0</v></c></row>".repeat(100_000);
    let empty = format!("<row/>{}", " ".repeat(32 << 20));
    for (bytes, words) in [
        (workbook(1, &wide, ""), "cells come to more than"),
        (workbook(1, &texts, &"x".repeat(100_000)), "cells come to more than"),
        (workbook(1000, &empty, ""), "sheet1.xml is too long"),
    ] {
        let error = parse("table.xlsx", &bytes).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    }
}

proptest::proptest! {
    #[test]
    fn any_text_is_read_or_refused(text in "(ID,Message,Signal,Start bit,Length,Byte order\n)?([0-9x;,\"A-Fm\n.-]{0,120})") {
        let _ = parse("table.csv", text.as_bytes());
    }
}

/// What canmatrix made of `vehicle.dbc` says the same of each signal, but for what such a workbook has no place for.
#[test]
fn a_workbook_of_canmatrix_agrees_with_the_dbc_file_that_it_was_made_of() {
    let dbc = crate::dbc::parse("vehicle.dbc", include_bytes!("../../tests/data/dbc/vehicle.dbc")).unwrap();
    let table =
        parse("table.xlsx", include_bytes!("../../tests/data/tables/canmatrix_vehicle.xlsx")).unwrap();
    assert_eq!(table.messages.len(), dbc.messages.len());
    let mut compared = 0;
    for message in &dbc.messages {
        let same = table.messages.iter().find(|other| other.id == message.id).unwrap();
        assert_eq!((&same.name, same.signals.len()), (&message.name, message.signals.len()));
        for signal in &message.signals {
            let other = same.signal(&signal.name).unwrap();
            let place = |signal: &Signal| (signal.start, signal.length, signal.order);
            assert_eq!(place(other), place(signal), "{}.{}", message.name, signal.name);
            // It writes six digits.
            assert!((other.factor / signal.factor - 1.0).abs() < 1e-5, "{}", signal.name);
            assert_eq!(other.values, signal.values, "{}", signal.name);
            compared += 1;
        }
    }
    assert_eq!(compared, dbc.messages.iter().map(|message| message.signals.len()).sum::<usize>());
}
