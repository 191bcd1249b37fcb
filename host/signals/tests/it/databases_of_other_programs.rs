//! What databases in use contain, and how a reader must handle it: their own numberings, duplicate texts and names, damage, and
//! texts that a terminal would interpret.

use std::fmt::Write as _;

use cantap_signals::condition::Condition;
use cantap_signals::{Database, Decoder, Indicator, Source, ValueKind, dbc, encode};
use cantap_trace::{Direction, Frame, TraceEvent, TraceFrame, TraceRecord};

fn database(text: &str) -> Database {
    dbc::parse("x.dbc", text.as_bytes()).unwrap()
}

fn decoder(text: &str) -> Decoder {
    Decoder::new(vec![Source { channel: None, database: database(text) }])
}

fn warnings(text: &str) -> Vec<String> {
    database(text).warnings.iter().map(ToString::to_string).collect()
}

fn decoded(decoder: &Decoder, frame: &str) -> Option<Vec<(String, String, Option<Indicator>)>> {
    let frame: TraceFrame = frame.parse().unwrap();
    let mut values = Vec::new();
    let message = decoder.message(decoder.decode(1, &frame, &mut values)?);
    let line = |value: &cantap_signals::SignalValue| {
        let signal = &message.signals[value.signal as usize];
        let number = signal.number(value.raw).to_string();
        (signal.label().into_owned(), number, message.indicator(signal, value.raw))
    };
    Some(values.iter().map(line).collect())
}

const ENGINE: &str = "BO_ 2364539904 EEC1: 8 A\n SG_ Speed : 24|16@1+ (0.125,0) [0|8031.875] \"rpm\" A\n\
                      SG_ Torque : 16|8@1+ (1,-125) [-125|125] \"%\" A\n SG_ Mode : 0|2@1+ (1,0) [0|3] \"\" A\n";

/// Not everybody uses Vector's numbering: canmatrix's own J1939 file has `J1939PG` fourth.
#[test]
fn j1939_is_what_the_file_calls_so() {
    let fourth = "BA_DEF_ BO_  \"VFrameFormat\" ENUM  \"StandardCAN\",\"ExtendedCAN\",\"reserved\",\"reserved\",\"J1939PG\";\n";
    let other = "BA_DEF_ BO_  \"VFrameFormat\" ENUM  \"StandardCAN\",\"ExtendedCAN\",\"StandardCAN_FD\",\"ExtendedCAN_FD\",\"J1939PG\";\n";
    let value = |n: u32| format!("BA_ \"VFrameFormat\" BO_ 2364539904 {n};\n");
    let default = |name: &str| format!("BA_DEF_DEF_  \"VFrameFormat\" \"{name}\";\n");
    let protocol = "BA_DEF_  \"ProtocolType\" STRING ;\nBA_DEF_DEF_  \"ProtocolType\" \"\";\nBA_ \"ProtocolType\" \"J1939\";\n";
    for (attributes, expected) in [
        (format!("{fourth}{}", value(4)), true),
        (format!("{other}{}", value(3)), false),
        (format!("{other}{}", value(4)), true),
        (format!("{other}{}{}", default("J1939PG"), ""), true),
        (format!("{other}{}{}", default("J1939PG"), value(1)), false),
        (format!("{other}{}{protocol}", default("StandardCAN")), true),
        (format!("{other}{}{protocol}", default("ExtendedCAN")), false),
        (protocol.to_owned(), true),
        // Without a list, Vector's applies.
        (value(3), true),
        (value(4), false),
        (String::new(), false),
    ] {
        let found = database(&format!("{ENGINE}{attributes}")).messages[0].j1939;
        assert_eq!(found, expected, "{attributes}");
        // Another source address.
        let other_source = decoded(&decoder(&format!("{ENGINE}{attributes}")), "0CF00417#0000000000000000");
        assert_eq!(other_source.is_some(), expected, "{attributes}");
    }
}

#[test]
fn a_parameter_that_is_not_there_is_no_value() {
    let j1939 = decoder(&format!("{ENGINE}BA_ \"VFrameFormat\" BO_ 2364539904 3;\n"));
    let frame = "0CF00400#FDFFFE00FFFFFFFF";
    let indicators: Vec<_> = decoded(&j1939, frame).unwrap().into_iter().map(|(.., found)| found).collect();
    assert_eq!(indicators, [Some(Indicator::NotAvailable), Some(Indicator::Error), None]);
    let mut values = Vec::new();
    j1939.decode(1, &frame.parse().unwrap(), &mut values);
    assert!(values[0].value.is_nan() && values[1].value.is_nan() && !values[2].value.is_nan(), "{values:?}");
    // So no condition mistakes it for a high speed.
    let mut condition = Condition::new("Speed > 1000", &j1939).unwrap();
    assert!(!condition.holds(&record(frame)));
    assert!(condition.holds(&record("0CF00400#FDFFFE00FAFFFFFF")));
    // What decoding prints can be sent again.
    let sent = encode::encode(&j1939, None, "EEC1:Speed=not available,Torque=error,Mode=1").unwrap();
    assert_eq!(sent.frame.to_string(), "0CF00400#0100FEFFFF000000");
    // Elsewhere these are ordinary numbers.
    let plain = decoder(ENGINE);
    assert!(decoded(&plain, frame).unwrap().iter().all(|(.., found)| found.is_none()));
}

fn record(frame: &str) -> TraceRecord {
    let event = TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
    TraceRecord { time_ns: 0, device_ns: None, channel: 1, event }
}

const GEARS: &str = "BO_ 5 Box: 2 A\n SG_ Gear : 0|8@1- (1,0) [0|0] \"\" A\n SG_ Alarm : 8|8@1+ (1,0) [0|0] \"\" A\n\
                     VAL_ 5 Gear 0 \"Park\" 3 \"Drive\" 7 \"Drive\" -1 \"Drive\" ;\n";

#[test]
fn a_text_of_several_values_means_all_of_them() {
    let decoder = decoder(GEARS);
    let hits = |condition: &str| -> Vec<&str> {
        let mut condition = Condition::new(condition, &decoder).unwrap();
        let frames = ["005#0000", "005#0300", "005#0700", "005#FF00", "005#0400"];
        frames.into_iter().filter(|frame| condition.holds(&record(frame))).collect()
    };
    assert_eq!(hits("Gear == Drive"), ["005#0300", "005#0700", "005#FF00"]);
    assert_eq!(hits("Gear != Drive"), ["005#0000", "005#0400"]);
    assert_eq!(hits("Gear == \"drive\""), ["005#0300", "005#0700", "005#FF00"]);
    let error = encode::encode(&decoder, None, "Box:Gear=Drive").unwrap_err().to_string();
    assert_eq!(error, "\"Drive\" stands for several values of Gear; choose one: raw:255, raw:3, raw:7");
    assert_eq!(encode::encode(&decoder, None, "Box:Gear=raw:255").unwrap().frame.to_string(), "005#FF00");
    let error = encode::encode(&decoder, None, "Box:Gear=Reverse").unwrap_err().to_string();
    assert_eq!(error, "\"Reverse\" is not a value for Gear; it takes a number or one of: Drive, Park");
}

#[test]
fn a_table_takes_no_fraction() {
    let decoder = decoder(GEARS);
    let error = encode::encode(&decoder, None, "Box:Gear=1.5").unwrap_err().to_string();
    assert_eq!(
        error,
        "Gear has states and none between them, such as 1.5; it takes a whole number or one of: Drive, Park"
    );
    assert_eq!(encode::encode(&decoder, None, "Box:Gear=3.0").unwrap().frame.to_string(), "005#0300");
}

/// Every value in a frame that respects the limits encodes to the same frame.
#[test]
fn what_is_decoded_can_be_sent() {
    let text = "BO_ 5 M: 8 A\n SG_ Volt : 0|11@1+ (0.1,0) [0|204.7] \"V\" A\n SG_ Temp : 16|12@1- (0.05,-40) [-142.4|62.35] \"C\" A\n \
                SG_ F : 32|32@1- (1,0) [-0.1|0.1] \"\" A\nSIG_VALTYPE_ 5 F : 1;\n";
    let decoder = decoder(text);
    for (volt, temp) in [(0, 0), (2047, 2047), (7, -2048), (3, 1)] {
        for float in [0.1f32, -0.1, 0.0] {
            let [low, high] = u16::to_le_bytes(volt);
            let [t_low, t_high] = i16::to_le_bytes(temp);
            let [a, b, c, d] = float.to_le_bytes();
            let data = [low, high, t_low, t_high & 0x0F, a, b, c, d];
            let frame = Frame::data_frame(cantap_trace::Id::standard(5).unwrap(), &data).unwrap();
            let signals = decoded(&decoder, &frame.to_string()).unwrap();
            let inputs: Vec<_> = signals.iter().map(|(name, number, _)| format!("{name}={number}")).collect();
            let line = format!("M:{}", inputs.join(","));
            let sent =
                encode::encode(&decoder, None, &line).unwrap_or_else(|error| panic!("{line}: {error}"));
            assert_eq!(sent.frame, frame, "{line}");
        }
    }
    let error = encode::encode(&decoder, None, "M:Volt=204.8").unwrap_err().to_string();
    assert!(error.contains("does not fit") || error.contains("allows"), "{error}");
    let error = encode::encode(&decoder, None, "M:Temp=62.4").unwrap_err().to_string();
    assert!(error.contains("does not fit") || error.contains("allows"), "{error}");
}

#[test]
fn numbers_are_the_decimals_that_the_factor_makes() {
    let decoder = decoder(
        "BO_ 5 M: 2 A\n SG_ V : 0|8@1+ (0.1,0) [0|0] \"\" A\n SG_ W : 8|8@1- (0.01,-0.3) [0|0] \"\" A\n",
    );
    let of = |frame| {
        decoded(&decoder, frame).unwrap().into_iter().map(|(_, number, _)| number).collect::<Vec<_>>()
    };
    assert_eq!(of("005#071E"), ["0.7", "0"]);
    assert_eq!(of("005#0305"), ["0.3", "-0.25"]);
    let mut condition = Condition::new("V == 0.7", &decoder).unwrap();
    assert!(condition.holds(&record("005#0700")));
}

/// GM's and Honda's files in opendbc write 29-bit identifiers without the flag.
#[test]
fn identifiers_that_need_29_bits_are_extended_without_the_flag_too() {
    let text = "VERSION \"2048\"\nCM_ \"BO_ 2048\";\nBO_ 2047 Short: 8 A\n SG_ 2048 : 0|8@1+ (1,0) [0|0] \"\" A\n\
                BO_ 2048 First: 8 A\n SG_ S M : 0|8@1- (1,0) [0|0] \"\" A\n SG_ T m2048 : 8|8@1+ (1,0) [0|0] \"\" A\n\
                BO_ 65543 Far: 4 A\n SG_ S : 0|32@1+ (1,0) [0|0] \"\" A\nBO_ 536870911 Last: 8 A\n\
                BO_ 7 Seven: 4 A\n SG_ S : 0|32@1+ (1,0) [0|0] \"\" A\nBO_ 2566844926 Flagged: 8 A\n\
                BO_TX_BU_ 2048 : A;\nCM_ BO_ 2048 \"the first\";\nCM_ SG_ 2048 S \"a signal\";\nBA_DEF_ BO_ \"GenMsgCycleTime\" INT 0 9999;\n\
                BA_ \"GenMsgCycleTime\" BO_ 2048 100;\nVAL_ 2048 S 1 \"one\" ;\nSIG_VALTYPE_ 65543 S : 1;\n\
                SG_MUL_VAL_ 2048 T S 3-4;\nVAL_ 2048 Nobody 1 \"one\" ;\n";
    let found = database(text);
    let ids: Vec<_> = found.messages.iter().map(|message| message.id.to_string()).collect();
    assert_eq!(ids, ["7FF", "00000800", "00010007", "1FFFFFFF", "007", "18FEF1FE"]);
    let [short, first, far, _, seven, _] = &found.messages[..] else { panic!("{:?}", found.messages) };
    assert_eq!((short.signals[0].name.as_str(), first.description.as_str()), ("2048", "the first"));
    assert_eq!((first.cycle_ms, first.signals[0].description.as_str()), (Some(100), "a signal"));
    assert_eq!(first.signals[0].text(1), Some("one"));
    assert_eq!(first.signals[1].multiplexed.as_ref().unwrap().values, [3..=4]);
    assert_eq!((far.signals[0].kind, seven.signals[0].kind), (ValueKind::Single, ValueKind::Unsigned));
    // Once for the file, however many there are.
    assert_eq!(
        warnings(text),
        [
            "line 5: First: identifier 0x800 is not marked as extended and does not fit 11 bits; 3 such messages are read as extended",
            "line 22: VAL_ 2147485696 Nobody: there is no such message or signal; the statement is left out",
        ]
    );
    assert!(decoded(&decoder(text), "00000800#0500000000000000").is_some());
    assert!(decoded(&decoder("BO_ 4000 One: 1 A\n"), "00000FA0#00").is_some());
    assert_eq!(
        warnings("BO_ 4000 One: 1 A\n"),
        [
            "line 1: One: identifier 0xFA0 is not marked as extended and does not fit 11 bits; 1 such message is read as extended"
        ]
    );
    // Written both ways, it is one identifier; each statement still belongs to a message.
    let twice = "BO_ 2147487648 One: 1 A\nBO_ 4000 Other: 1 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\nVAL_ 4000 S 1 \"one\" ;\n";
    assert_eq!(database(twice).messages[1].signals[0].text(1), Some("one"));
    assert!(
        warnings(twice)[1].contains("identifier 00000FA0 is already that of One"),
        "{:?}",
        warnings(twice)
    );
}

#[test]
fn one_bad_message_leaves_the_others() {
    let good = "BO_ 6 Good: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n";
    let about = "CM_ BO_ 5 \"bad\";\nVAL_ 5 Bad 1 \"one\" ;\n";
    for (bad, warning) in [
        (
            "BO_ 536870913 Bad: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\nVAL_ 536870913 S 1 \"one\" ;\n",
            "line 3: Bad: identifier 0x20000001 does not fit 11 bits (standard) or 29 bits (extended); the message is left out",
        ),
        // Its lower 16 bits equal those of the good one.
        ("BO_ 1073741830 Bad: 8 A\nVAL_ 1073741830 S 1 \"one\" ;\n", "line 3: Bad: identifier 0x40000006"),
        (
            "BO_ 5 Bad: 8 A\n SG_ Bad : 0|0@1+ (1,0) [0|0] \"\" A\n",
            "line 4: Bad.Bad: a signal needs at least 1 bit; the",
        ),
        (
            "BO_ 5 Bad: 8 A\n SG_ Bad : 0|8@1+ (1,0 [0|0] \"\" A\n",
            "line 4: Bad.Bad: not of the form SG_ NAME",
        ),
        ("BO_ 5 Bad: eight A\n SG_ Bad : 0|8@1+ (1,0) [0|0] \"\" A\n", "line 3: Bad: not of the form BO_ ID"),
        ("BO_ 5 Bad: 8 A\n SG_ Bad : 0|8@1+ (1e999,0) [0|0] \"\" A\n", "line 4: Bad.Bad: factor inf"),
        (
            "BO_ 5 Bad: 8 A\n SG_ Bad : 0|32@1+ (1,0) [0|0] \"\" A\nSIG_VALTYPE_ 5 Bad : x;\n",
            "line 3: Bad: a statement that its values depend on is not understood; the message is left out",
        ),
        // An unterminated quote swallows what follows it.
        (
            "BO_ 5 Bad: 8 A\n SG_ Bad : 0|8@1+ (1,0) [0|0] \"km/h A\n SG_ Next : 8|8@1+ (1,0) [0|0] \"\" A\n",
            "line 4: Bad.Bad:",
        ),
    ] {
        let text = format!(
            "{good}{bad}{}BO_ 7 After: 8 A\n SG_ T : 0|8@1+ (1,0) [0|0] \"x\" A\nVAL_ 7 T 1 \"on\" ;\n",
            if bad.contains("BO_ 5 ") { about } else { "" }
        );
        let database = database(&text);
        let names: Vec<_> = database.messages.iter().map(|message| message.name.as_str()).collect();
        assert_eq!(names, ["Good", "After"], "{bad}: {:?}", database.warnings);
        assert!(database.messages[0].signals[0].values.is_empty(), "{bad}");
        assert_eq!(database.messages[1].signals[0].values.text(1), Some("on"), "{bad}");
        let warnings = warnings(&text);
        assert!(warnings.iter().any(|found| found.starts_with(warning)), "{bad}: {warnings:?}");
    }
}

/// Fifty was once the limit.
#[test]
fn warnings_are_not_counted_against_a_database() {
    let mut text = "BO_ 6 Good: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n".to_owned();
    for n in 0..300 {
        writeln!(text, "BA_ \"Broken{n}\" BO_ five;").unwrap();
    }
    let database = database(&text);
    assert_eq!((database.messages.len(), database.warnings.len()), (1, 300));
}

#[test]
fn what_is_no_database_is_an_error() {
    for (text, expected) in [
        ("", "x.dbc: the file is empty"),
        ("\r\n  \n", "x.dbc: the file is empty"),
        ("This is a letter.\n", "x.dbc: no statement of a DBC file is in it"),
        (
            "BO_ 5 Bad: 8 A\n SG_ Bad : 0|0@1+ (1,0) [0|0] \"\" A\n",
            "x.dbc: line 2: Bad.Bad: a signal needs at least 1 bit",
        ),
    ] {
        let error = dbc::parse("x.dbc", text.as_bytes()).unwrap_err().to_string();
        assert!(error.starts_with(expected), "{text:?}: {error}");
        assert!(!error.contains("left out"), "{error}");
    }
}

#[test]
fn a_float_of_unusual_length_is_told() {
    let of = |length| {
        warnings(&format!("BO_ 5 M: 8 A\n SG_ F : 0|{length}@1- (1,0) [0|0] \"\" A\nSIG_VALTYPE_ 5 F : 1;\n"))
    };
    assert_eq!(
        of(24),
        ["line 2: M.F: a float of 24 bits is unusual; it is read as the upper bits of the next longer one"]
    );
    for usual in [16, 32, 64] {
        assert!(of(usual).is_empty());
    }
    // From a database that gives the kind of every signal: 0 is a whole number.
    let whole = "BO_ 5 M: 8 A\n SG_ S : 0|8@1- (1,0) [0|0] \"\" A\nSIG_VALTYPE_ 5 S : 0;\n";
    assert_eq!(warnings(whole), Vec::<String>::new());
}

#[test]
fn no_text_of_a_database_moves_the_cursor() {
    let text = "BO_ 5 M: 2 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\x1b[2J\u{9b}m\" A\n SG_ Far\x1b : 0|8@1+ (1,0) [0|0] \"\" A\n\
                CM_ SG_ 5 S \"first\x1b]0;title\x07\r\nsecond\";\nVAL_ 5 S 1 \"on\r\noff\x1b[31m\" ;\nBA_ \"\x1b[2J\" BO_ five;\nBO_ 6 N: 1 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n";
    let database = database(text);
    let mut shown: Vec<String> = database.warnings.iter().map(ToString::to_string).collect();
    for message in &database.messages {
        for signal in &message.signals {
            shown.extend([signal.name.clone(), signal.unit.clone()]);
            shown.extend(signal.values.iter().map(|(_, text)| text.to_owned()));
            // A description may have several lines, but nothing else of this kind.
            shown.push(signal.description.replace('\n', " "));
        }
    }
    assert!(shown.iter().all(|text| !text.contains(char::is_control)), "{shown:?}");
    assert!(!database.warnings.is_empty());
}

#[test]
fn signals_of_one_name_keep_both_values() {
    let decoder = decoder(
        "BO_ 5 M: 3 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ Speed : 8|8@1+ (1,0) [0|0] \"\" A\n\
         BO_ 6 N: 3 A\n SG_ Page M : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ Temp m1 : 8|8@1+ (1,0) [0|0] \"\" A\n SG_ Temp m2 : 16|8@1+ (1,0) [0|0] \"\" A\n",
    );
    let names = |frame| -> Vec<_> {
        decoded(&decoder, frame)
            .unwrap()
            .into_iter()
            .map(|(name, number, _)| format!("{name}={number}"))
            .collect()
    };
    assert_eq!(names("005#010203"), ["Speed=1", "Speed#2=2"]);
    // Those that never occur together keep their names.
    assert_eq!(names("006#010203"), ["Page=1", "Temp=2"]);
    assert_eq!(names("006#020203"), ["Page=2", "Temp=3"]);
    let sent = |text| encode::encode(&decoder, None, text).unwrap().frame.to_string();
    assert_eq!(sent("M:Speed=1,Speed#2=2"), "005#010200");
    assert_eq!(sent("N:Page=2,Temp=3"), "006#020003");
}

/// 64 bytes, with a signal after the eighth.
#[test]
fn fd_frames_decode_as_far_as_they_reach() {
    let decoder = decoder(
        "BO_ 5 M: 64 A\n SG_ First : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ Last : 504|8@1+ (1,0) [0|0] \"\" A\n SG_ Wide : 71|16@0+ (0.1,0) [0|0] \"\" A\n",
    );
    let data = |length: usize| (0..length).fold(String::new(), |data, n| data + &format!("{n:02X}"));
    let names = |frame: &str| -> Vec<_> {
        decoded(&decoder, frame)
            .unwrap()
            .into_iter()
            .map(|(name, number, _)| format!("{name}={number}"))
            .collect()
    };
    assert_eq!(names(&format!("005##1{}", data(64))), ["First=0", "Last=63", "Wide=205.7"]);
    assert_eq!(names(&format!("005##1{}", data(12))), ["First=0", "Wide=205.7"]);
    let mut condition = Condition::new("byte[63] == 63 and Wide == 205.7", &decoder).unwrap();
    let frame: TraceFrame = format!("005##0{}", data(64)).parse().unwrap();
    let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
    assert!(condition.holds(&TraceRecord { time_ns: 0, device_ns: None, channel: 1, event }));
}
