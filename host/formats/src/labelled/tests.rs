//! What examples print, in lines as people share them.

use super::super::tests;
use crate::{Format, ReadOptions, TraceReader};
use proptest::prelude::*;

fn as_log(file: &str) -> (String, Vec<String>) {
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Labelled), "{file}");
    tests::as_log(Format::Labelled, file)
}

/// What was counted beside frames.
fn notes(file: &str) -> Vec<(&'static str, u64)> {
    let source = std::io::Cursor::new(file.to_owned());
    let mut reader =
        TraceReader::from_source("t", source, Format::Labelled, &ReadOptions::default()).unwrap();
    reader.by_ref().for_each(drop);
    reader.notes().iter().chain(reader.left_out().iter()).collect()
}

#[test]
fn what_the_examples_of_arduino_teensy_and_esp_idf_print_is_read() {
    for (name, file, log) in [
        (
            "MCP_CAN",
            "MCP2515 Initialized Successfully!\r\n\
             Standard ID: 0x036       DLC: 8  Data: 0x13 0x9C 0xB0 0x00 0x47 0x9C 0xB4 0x34\r\n\
             Extended ID: 0x00000032  DLC: 1  Data: 0x05 \r\nStandard ID: 0x701       DLC: 2  Data: REMOTE REQUEST FRAME\r\n\
             Extended ID: 0x02294500  DLC: 0  Data:\r\n",
            "(0.000000) can0 036#139CB000479CB434\n(0.000000) can0 00000032#05\n(0.000000) can0 701#R2\n\
             (0.000000) can0 02294500#\n",
        ),
        (
            "stamps of Arduino's serial monitor, which go past midnight, and values behind the bytes",
            "23:59:59.900 -> Standard ID: 0x100       DLC: 2  Data: 0x01 0x02 REC: 0\n\
             00:00:00.100 -> Standard ID: 0x100       DLC: 1  Data: 0x03  ==\t8\n",
            "(86399.900000) can0 100#0102\n(86400.100000) can0 100#03\n",
        ),
        (
            "bytes between quotation marks, as the line protocol of InfluxDB has texts",
            "can,bus=can0,id=123 data=\"0102030405060708\",dlc=8i 1704067200000000000\n\
             can,bus=can0,id=18FEF100 data=\"01020304\",dlc=4i 1704067200010000000\n",
            "(0.000000) can0 123#0102030405060708\n(0.000000) can0 18FEF100#01020304\n",
        ),
        (
            "FlexCAN_T4",
            "MB 0  OVERRUN: 0  LEN: 8 EXT: 0 TS: 42303 ID: 2C4 Buffer: 3 87 0 30 0 80 61 69 \n\
             MB 99  OVERRUN: 0  LEN: 3 EXT: 1 TS: 44802 ID: 20 Buffer: 0 0 7 \n",
            "(0.000000) can0 2C4#0387003000806169\n(0.000000) can0 00000020#000007\n",
        ),
        (
            "autowp's mcp2515, with the marks of 29 bits and of remote frames in the identifier",
            "------- CAN Read ----------\nID  DLC   DATA\n123 8 1 2 3 4 5 6 7 8 \n1A 2 FF 0 \n98FEF100 1 A \n40000012 2 0 0 \n",
            "(0.000000) can0 123#0102030405060708\n(0.000000) can0 01A#FF00\n(0.000000) can0 18FEF100#0A\n\
             (0.000000) can0 012#R2\n",
        ),
        (
            "Seeed: the bytes on the next line",
            "CAN init ok!\n-----------------------------\nGet data from ID: 0x1A3\n0\t10\tFF\t\n\
             -----------------------------\nGet data from ID: 0x7E8\n4\t41\tC\t1A\tF8\t\n",
            "(0.000000) can0 1A3#0010FF\n(0.000000) can0 7E8#04410C1AF8\n",
        ),
        (
            "the TWAI example of Arduino's core for ESP32",
            "Message is in Standard Format\nID: 7e8\nByte: 0 = 04, 1 = 41, 2 = 0c,\n\
             Message is in Extended Format\nID: f1\nByte: 0 = ff,\nMessage is in Standard Format\nID: 12\nByte:\n",
            "(0.000000) can0 7E8#04410C\n(0.000000) can0 000000F1#FF\n(0.000000) can0 012#\n",
        ),
        (
            "ESP-IDF's manual, in decimal digits; a frame ends where something else begins",
            "Message is in Extended Format\nID is 291\nData byte 0 = 18\nData byte 1 = 255\n\
             Message is in Standard Format\nID is 16\nData byte 0 = 1\nbye\n",
            "(0.000000) can0 00000123#12FF\n(0.000000) can0 010#01\n",
        ),
        (
            "arduino-CAN, whose bytes are characters",
            "CAN Receiver\r\nReceived packet with id 0x12 and length 5\r\nhello\r\n\r\n\
             Received extended packet with id 0x123 and length 1\r\n7\r\n\r\n\
             Received RTR packet with id 0x12 and requested length 3\r\n\r\nReceived packet with id 0x13 and length 0\r\n\r\n",
            "(0.000000) can0 012#68656C6C6F\n(0.000000) can0 00000123#37\n(0.000000) can0 012#R3\n(0.000000) can0 013#\n",
        ),
        (
            "arduino-CAN, with its bytes as numbers",
            "Received packet with id 0x12 and length 3\r\n1 A FF \r\n\r\nReceived packet with id 0x7FF and length 1\r\n7 \r\n",
            "(0.000000) can0 012#010AFF\n(0.000000) can0 7FF#07\n",
        ),
        (
            "ESP-IDF's log, in colour",
            "\x1b[0;32mI (1500) twai: ID=0x123, DLC=2, DATA=[0A FF]\x1b[0m\n\x1b[0;32mI (1600) twai: TX ID=0x18DAF110 len=3 data=010203\x1b[0m\n",
            "(1.500000) can0 123#0AFF\n(1.600000) can0 18DAF110#010203 T\n",
        ),
        (
            "brackets, a date, CAN FD",
            "[2026-01-02 03:04:05.678] ID: 0x7FF LEN: 12 DATA: 00:01:02:03:04:05:06:07:08:09:0A:0B\n",
            "(1767323045.678000) can0 7FF##0000102030405060708090A0B\n",
        ),
        (
            "identifiers and bytes in decimal digits",
            "CAN ID: 2024 DLC: 3 Data: 4 65 255\nCAN ID: 199999999 DLC: 1 Data: 7\nCAN ID: 1552 DLC: 0 Data:\n",
            "(0.000000) can0 7E8#0441FF\n(0.000000) can0 0BEBC1FF#07\n(0.000000) can0 610#\n",
        ),
    ] {
        let (read, issues) = as_log(file);
        assert_eq!((read.as_str(), &issues), (log, &Vec::<String>::new()), "{name}");
    }
}

/// A byte that the serial line swallowed is not another frame, and text is counted.
#[test]
fn damaged_frames_are_named_and_text_is_counted() {
    let file = "CAN started\nStandard ID: 0x100  DLC: 3  Data: 0x01 0x02\nStandard ID: 0x1G0  DLC: 1  Data: 0x01\n\
                Standard ID: 0x900  DLC: 1  Data: 0x01\nStandard ID: 0x100  DLC: 1  Data: 0x01 0x02\n\
                Standard ID: 0x100  DLC: 2  Data: 0x01 0x02\nID: 0x5 DLC: 2\nrpm=805\nChip ID: 5\nhello\nStandard ID: 0x100  DLC: 99  Data: 0x01\n\
                Standard ID: 0x100  DLC: 1  Data: 0x0";
    let (log, issues) = tests::as_log(Format::Labelled, file);
    assert_eq!(log, "(0.000000) can0 100#0102\n");
    assert_eq!(issues.len(), 7, "{issues:#?}");
    assert!(issues[6].contains("the file ends inside a line"), "{issues:#?}");
    let notes = notes(file);
    assert!(notes.contains(&(super::NO_FRAME, 2)), "{notes:?}");
    assert!(notes.contains(&(super::NO_BYTES, 1)) && notes.contains(&(super::NO_TIMES, 1)), "{notes:?}");
    let (_, issues) = tests::as_log(Format::Labelled, "(1.0) can0 123#11\n");
    assert!(issues[0].contains("a frame with labels"), "{issues:?}");
    // An identifier at the end waits for its bytes.
    let (_, issues) = tests::as_log(Format::Labelled, "ID: 0x12 DLC: 2\n");
    assert!(issues[0].contains("the last frame's data bytes"), "{issues:?}");
    // Bytes that are no characters end a line of arduino-CAN's, or are not told from what stands around it.
    let (log, issues) = tests::as_log(
        Format::Labelled,
        "Received packet with id 0x12 and length 3\n\x01\n\x02\nReceived packet with id 0x12 and length 2\nab\n",
    );
    assert_eq!((log.as_str(), issues.len()), ("(0.000000) can0 012#6162\n", 1), "{issues:?}");
    for text in ["Serial ID: 5\nData: hello\n", "id: 1\n", "Chip ID: 0x12 size: 3\nready\n", "data: 00 11\n"]
    {
        assert_eq!(Format::of_content(text.as_bytes()), None, "{text}");
    }
}

proptest! {
    #[test]
    fn any_lines_are_read_or_counted(lines in prop::collection::vec("(Standard |Ext )?(ID|id)?[:= ]{0,2}(0x)?[0-9A-Fa-f]{0,9} ?(DLC|LEN)?: ?[0-9]{0,2} ?(Data|Byte):?[0-9a-fx ,=]{0,30}", 0..8)) {
        tests::read(Format::Labelled, lines.join("\n"));
    }
}

/// `print(f"id: {hex(msg.arbitration_id)} data: {list(msg.data)}")`.
#[test]
fn lists_that_python_prints_are_decimal() {
    let (log, issues) = as_log("id: 0x123 data: [17, 34]\nid: 0x124 data: [5]\nid: 0x125 data: []\n");
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(log, "(0.000000) can0 123#1122\n(0.000000) can0 124#05\n(0.000000) can0 125#\n");
    // With leading zeros they are not.
    assert_eq!(as_log("id: 0x123 data: [17, 04]\n").0, "(0.000000) can0 123#1704\n");
}
