//! Container PDUs of ARXML files: which PDUs a frame has is in the frame. Random ones are for `signals_agree_with_cantools.rs`.

use cantap_signals::condition::Condition;
use cantap_signals::{Database, Decoder, NotDecoded, Selection, Source, arxml, encode};
use cantap_trace::{Direction, Id, TraceEvent, TraceRecord};

const FILE: &str = include_str!("../data/container.arxml");

fn database(text: &str) -> Database {
    arxml::parse("container.arxml", text.as_bytes()).unwrap()
}

fn decoder(text: &str) -> Decoder {
    Decoder::new(vec![Source { channel: None, database: database(text) }])
}

/// What these data bytes of the frame 123 say.
fn decode(decoder: &Decoder, bytes: &str) -> String {
    let bytes: Vec<u8> =
        (0..bytes.len() / 2).map(|at| u8::from_str_radix(&bytes[2 * at..2 * at + 2], 16).unwrap()).collect();
    let mut values = Vec::new();
    let reference = decoder.find(1, Id::standard(0x123).unwrap()).unwrap();
    decoder.decode_data(reference, &bytes, &mut values);
    let message = decoder.message(reference);
    let texts = values.iter().map(|value| {
        let signal = &message.signals[value.signal as usize];
        format!("{}={}", signal.label(), signal.number(value.raw))
    });
    texts.collect::<Vec<_>>().join(" ")
}

#[test]
fn a_frame_has_the_signals_of_the_pdus_that_it_says() {
    let decoder = decoder(FILE);
    for (frame, values) in [
        ("07", "Counter=7"),
        ("07010203030801F4", "Counter=7 Engine.Counter=8 Engine.Speed=500"),
        ("070405060163010203030801F400", "Counter=7 Brake.Pressure=99 Engine.Counter=8 Engine.Speed=500"),
        // Unknown, then known; the end is padding.
        ("070A0B0C02FFFF0405060163555555", "Counter=7 Brake.Pressure=99"),
        // Twice: the last counts.
        ("07040506010104050601020000", "Counter=7 Brake.Pressure=2"),
        // Shorter than described, and cut.
        ("07010203010804050601", "Counter=7 Engine.Counter=8"),
        ("070102030308", "Counter=7 Engine.Counter=8"),
    ] {
        assert_eq!(decode(&decoder, frame), values, "{frame}");
    }
    let mut counts = NotDecoded::default();
    let (reference, ..) = decoder.messages().next().unwrap();
    let data = [7, 0xA, 0xB, 0xC, 0, 4, 5, 6, 1, 1, 4, 5, 6, 1, 2, 1, 2, 3, 3, 8];
    decoder.count_not_decoded(reference, &data, &mut counts);
    assert_eq!(counts, NotDecoded { unknown: 1, repeated: 1, cut: 1 });
    // Frames that are decoded together keep theirs apart.
    let mut rows = decoder.rows(reference);
    assert!(!rows.push(&[7]) && rows.is_empty());
}

#[test]
fn long_headers_headers_from_the_last_byte_and_places_without_headers_are_read() {
    let long = FILE.replace("<HEADER-TYPE>SHORT-HEADER", "<HEADER-TYPE>LONG-HEADER");
    assert_eq!(decode(&decoder(&long), "07556677880000000163"), "Counter=7 Brake.Pressure=99");
    let last =
        long.replace("BYTE-ORDER>MOST-SIGNIFICANT-BYTE-FIRST", "BYTE-ORDER>MOST-SIGNIFICANT-BYTE-LAST");
    assert_eq!(decode(&decoder(&last), "07887766550100000063"), "Counter=7 Brake.Pressure=99");
    let fixed = FILE.replace("<HEADER-TYPE>SHORT-HEADER", "<HEADER-TYPE>NO-HEADER");
    let fixed = decoder(&fixed);
    assert_eq!(
        decode(&fixed, "07010801F463000000"),
        "Counter=7 Engine_update=1 Pressure=99 Counter#2=8 Speed=500"
    );
    // The bit says that nothing new came.
    assert_eq!(decode(&fixed, "07000801F463000000"), "Counter=7 Engine_update=0 Pressure=99");
}

#[test]
fn its_signals_are_named_with_their_pdu_where_that_is_wanted() {
    let mut decoder = decoder(FILE);
    let record = |frame: &str| TraceRecord {
        time_ns: 0,
        device_ns: None,
        channel: 1,
        event: TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false },
    };
    let both = record("123##107010203030801F40405060163000000");
    for (text, holds) in [
        ("Engine.Counter == 8", true),
        ("Box.Engine.Counter == 8", true),
        ("Box.Counter == 7", true),
        ("Brake.Counter == 8", false),
        ("Box.Speed == 500", false),
        ("Pressure > 98 and Speed == 500", true),
        ("Brake.Pressure > 99", false),
    ] {
        match Condition::new(text, &decoder) {
            Ok(mut condition) => assert_eq!(condition.holds(&both), holds, "{text}"),
            Err(error) => assert!(!holds, "{text}: {error}"),
        }
    }
    for (pattern, count) in
        [("Engine.*", 2), ("Box.*", 4), ("Box.Engine.Speed", 1), ("Counter", 2), ("Brake.Pressure", 1)]
    {
        let selection = Selection::new(&[pattern]).unwrap();
        let (_, _, message) = decoder.messages().next().unwrap();
        let chosen = message.signals.iter().filter(|signal| selection.matches(message, signal)).count();
        assert_eq!(chosen, count, "{pattern}");
    }
    decoder.select(&Selection::new(&["Brake.*"]).unwrap()).unwrap();
    assert_eq!(decode(&decoder, "070405060163010203030801F4"), "Brake.Pressure=99");
}

#[test]
fn it_is_described_and_is_not_made_of_values() {
    let database = database(FILE);
    assert_eq!(database.warnings, []);
    let message = &database.messages[0];
    let container = message.container.as_ref().unwrap();
    let pdus: Vec<_> =
        container.pdus.iter().map(|pdu| (pdu.name.as_str(), pdu.header_id, pdu.cycle_ms)).collect();
    assert_eq!(pdus, [("Engine", 0x01_0203, Some(20)), ("Brake", 0x04_0506, None)]);
    assert_eq!((message.cycle_ms, container.pdus[0].description.as_str()), (None, "What the engine does"));
    assert_eq!(message.pages().len(), 3);
    let error = encode::encode(&decoder(FILE), None, "Box:Speed=3").unwrap_err().to_string();
    assert!(error.contains("message Box is a container of other PDUs"), "{error}");
}

#[test]
fn what_is_wrong_in_a_container_leaves_the_others() {
    for (from, to, warning, left) in [
        (
            "<HEADER-ID-SHORT-HEADER>0x010203</HEADER-ID-SHORT-HEADER>",
            "",
            "Engine, which Container may contain, has no HEADER-ID-SHORT-HEADER",
            1,
        ),
        ("0x040506", "0x010203", "Brake has the header of Engine, 0x10203, in Container, and is not read", 1),
        (
            "SHORT-HEADER</HEADER-TYPE>",
            "ODD</HEADER-TYPE>",
            "Container is a container PDU with an unknown header (ODD)",
            0,
        ),
        ("/P/C/BrakeTriggering<", "/P/C/Gone<", "a PDU of a container is not in the file", 1),
        (
            "<LENGTH>16</LENGTH>",
            "<LENGTH>0</LENGTH>",
            "Engine, which Container may contain: a signal needs at least 1 bit",
            1,
        ),
        (
            "<PDU-REF>/P/Head<",
            "<PDU-REF>/P/Container<",
            "Container is a second container PDU in its frame",
            2,
        ),
        ("<LENGTH>3</LENGTH>", "<LENGTH>2</LENGTH>", "the signal needs 3 bytes, the message has 2", 2),
    ] {
        let text = FILE.replace(from, to);
        assert_ne!(text, FILE, "{from}");
        let database = database(&text);
        let warnings: Vec<_> = database.warnings.iter().map(ToString::to_string).collect();
        assert!(warnings.iter().any(|text| text.contains(warning)), "{warning}: {warnings:?}");
        let container = database.messages[0].container.as_ref();
        assert_eq!(container.map_or(0, |container| container.pdus.len()), left, "{warning}");
    }
}
