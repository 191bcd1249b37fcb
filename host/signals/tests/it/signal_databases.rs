//! Databases from both kinds of file, what they decode to, and how their faults are reported.

use cantap_signals::{
    Colour, Database, DatabaseError, Decoder, Digital, Selection, Source, dbc, encode, file,
};
use cantap_trace::TraceFrame;

fn decoder(database: Database) -> Decoder {
    Decoder::new(vec![Source { channel: None, database }])
}

/// `Name=value` for each decoded signal, `None` if the frame is unknown.
fn decode(decoder: &Decoder, channel: u8, frame: &str) -> Option<String> {
    let frame: TraceFrame = frame.parse().unwrap();
    let mut values = Vec::new();
    let message = decoder.message(decoder.decode(channel, &frame, &mut values)?);
    let texts = values.iter().map(|value| {
        let signal = &message.signals[value.signal as usize];
        let text = signal.text(value.raw).map(|text| format!("({text})")).unwrap_or_default();
        format!("{}={}{text}", signal.name, signal.number(value.raw))
    });
    Some(texts.collect::<Vec<_>>().join(" "))
}

fn toml_faults(text: &str) -> String {
    match file::parse("x.toml", text.as_bytes()) {
        Err(error @ DatabaseError::Faulty { .. }) => error.to_string(),
        other => panic!("{other:?}"),
    }
}

fn dbc_faults(text: &str) -> String {
    match dbc::parse("x.dbc", text.as_bytes()) {
        Err(error @ DatabaseError::Faulty { .. }) => error.to_string(),
        other => panic!("{other:?}"),
    }
}

/// The documentation's example comes from the earlier analyser's documentation.
#[test]
fn the_documented_example_decodes_as_documented() {
    let docs = include_str!("../../../../docs/signal-file.md");
    let example = docs.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    let database = file::parse("dashboard.toml", example.as_bytes()).unwrap();
    assert_eq!(database.warnings, []);
    let message = &database.messages[0];
    assert_eq!((message.cycle_ms, message.length), (Some(100), 4));
    assert_eq!(message.signals[0].alarms.max, Some(130.0));
    assert_eq!(message.signals[0].colour, Some(Colour { red: 0, green: 0x72, blue: 0xB2 }));
    assert_eq!(message.signals[2].digital, Some(Digital { low: 0.0, high: 1.0 }));
    let decoder = decoder(database);
    let all = "Speed=88 EngineSpeed=5119.5 Ignition=0(off)";
    assert_eq!(decode(&decoder, 1, "618#004023FF").as_deref(), Some(all));
    assert_eq!(decode(&decoder, 1, "618#80.00").as_deref(), Some("Speed=-40 Ignition=1(on)"));
    assert_eq!(decode(&decoder, 1, "618#R4"), None);
    assert_eq!(decode(&decoder, 1, "00000618#004023FF"), None);
}

#[test]
fn a_signal_file_can_say_every_kind_and_place() {
    let database = file::parse(
        "x.toml",
        br#"
[[message]]
name = "M"
id = 0x18FF0102
j1939 = true
signal = [
  { name = "Page", at = "D1.3-0" },
  { name = "SM", at = "D2:D3", order = "motorola", type = "sign-magnitude", when = { signal = "Page", is = [1, "3-5"] } },
  { name = "F", at = "D2:D3", order = "big", type = "float", when = { signal = "Page", is = 2 } },
  { name = "H", at = "D2:D3", order = "little", type = "half", when = { signal = "Page", is = "6-6" } },
  { name = "S", start = 4, length = 4, type = "signed" },
  { name = "Deep", at = "D4", when = { signal = "SM", is = 7 } },
]
"#,
    );
    let decoder = decoder(database.unwrap());
    assert_eq!(decode(&decoder, 1, "18FF0102#F4C040").as_deref(), Some("Page=4 S=-1 SM=-16448"));
    assert_eq!(decode(&decoder, 1, "18FF0102#12BFC0").as_deref(), Some("Page=2 S=1 F=-1.5"));
    assert_eq!(decode(&decoder, 1, "18FF0102#06003C").as_deref(), Some("Page=6 S=0 H=1"));
    assert_eq!(decode(&decoder, 1, "18FF0102#01000709").as_deref(), Some("Page=1 S=0 SM=7 Deep=9"));
    // Another priority and source address.
    assert_eq!(decode(&decoder, 1, "0CFF0155#00").as_deref(), Some("Page=0 S=0"));
}

#[test]
fn a_fault_in_a_signal_file_names_line_and_symbol() {
    let head = "[[message]]\nname = \"M\"\nid = 1\n\n[[message.signal]]\n";
    for (rest, expected) in [
        (
            "name = \"S\"\nat = \"D0\"",
            "x.toml: line 5: M.S: at = \"D0\" is not a place; write \"D2\", \"D2:D3\", \"D1.5\" or \"D1.7-4\"",
        ),
        ("name = \"S\"\nfaktor = 2\nat = \"D1\"", "line 7: M.S: unknown field `faktor`"),
        ("at = \"D1\"\nname = \"S\"\nfactor = \"x\"", "line 8: M.S: invalid type: string \"x\""),
        ("name = \"S\"\nat = \"D1:D2\"", "line 5: M.S: it spans several bytes: say order"),
        ("name = \"S\"\nstart = 1", "line 5: M.S: say where it is"),
        ("name = \"S\"\nstart = 1\nlength = 0", "line 5: M.S: a signal needs at least 1 bit"),
        ("name = \"S\"\nat = \"D1\"\nfactor = inf", "line 5: M.S: factor inf and offset 0 make no value"),
        ("name = \"S\"\nat = \"D1\"\ntype = \"half\"", "line 5: M.S: a float of 8 bits does not exist"),
        (
            "name = \"S\"\nat = \"D1\"\nwhen = { signal = \"T\", is = 1 }",
            "line 5: M.S: there is no signal \"T\"",
        ),
        (
            "name = \"S\"\nat = \"D1\"\nwhen = { signal = \"S\", is = 1 }",
            "line 5: M.S: the signal is multiplexed by itself",
        ),
        ("name = \"S\"\nat = \"D1\"\nvalues = { a = \"b\" }", "line 5: M.S: the text \"b\" stands for \"a\""),
        ("name = \"S\"\nat = \"D1\"\ncolour = \"red\"", "line 5: M.S: \"red\" is not a colour"),
        ("name = \"S\"\nat = D1", "line 7: M.S: "),
    ] {
        let found = toml_faults(&format!("{head}{rest}\n"));
        assert!(found.contains(expected), "{rest}: {found}");
    }
    assert!(toml_faults("version = 2").contains("line 1: version: this program reads version 1"));
    assert!(
        toml_faults("[[message]]\nname = \"M\"\nid = 0x20000000")
            .contains("line 1: M: identifier 0x20000000")
    );
    assert!(
        file::parse("x.toml", b"\n\xFF")
            .unwrap_err()
            .to_string()
            .contains("line 2: a signal file is in UTF-8")
    );
}

#[test]
fn a_fault_in_a_dbc_file_names_line_and_symbol() {
    let signal = |text: &str| {
        format!("VERSION \"\"\n\nBO_ 5 Engine: 8 A\n SG_ Ok : 0|8@1+ (1,-1) [0|0] \"\" A\n{text}\n")
    };
    for (text, expected) in [
        (
            " SG_ Speed : 8|8@1+ (1,0 [0|0] \"\" A",
            "x.dbc: line 5: Engine.Speed: not of the form SG_ NAME : START|LENGTH@ORDER",
        ),
        (" SG_ Speed : 8|0@1+ (1,0) [0|0] \"\" A", "line 5: Engine.Speed: a signal needs at least 1 bit"),
        (
            " SG_ Speed : 8|8@1+ (1e999,0) [0|0] \"\" A",
            "line 5: Engine.Speed: factor inf and offset 0 make no value",
        ),
        (" SG_ Speed : 8|-1@1+ (1,0) [0|0] \"\" A", "line 5: Engine.Speed: "),
        ("SIG_VALTYPE_ 5 Ok : 7;", "line 3: Engine: a statement that its values depend on is not understood"),
    ] {
        let found = dbc_faults(&signal(text));
        assert!(found.contains(expected), "{text}: {found}");
    }
}

#[test]
fn what_decoding_does_not_need_is_left_out_with_a_warning() {
    let text = "BO_ 5 Engine: 1 A\n SG_ Ok : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ Far : 8|8@1+ (1,0) [0|0] \"\" A\n\
                BA_ \"Broken\" BO_ five;\nSIG_TYPE_REF_ 5 x : y;\nVAL_ 6 Nobody 1 \"one\" ;\nBO_ 5 Again: 8 A";
    let database = dbc::parse("x.dbc", text.as_bytes()).unwrap();
    let warnings: Vec<_> = database.warnings.iter().map(ToString::to_string).collect();
    let expected = [
        "line 3: Engine.Far: the signal needs 2 bytes, the message has 1",
        "line 4: BA_ \"Broken\" BO_: this statement is not understood and left out",
        "line 5: SIG_TYPE_REF_ 5 x: this statement is not understood and left out",
        "line 6: VAL_ 6 Nobody: there is no such message or signal",
        "line 7: Again: identifier 005 is already that of Engine",
    ];
    assert_eq!(warnings.len(), expected.len(), "{warnings:#?}");
    for (warning, expected) in warnings.iter().zip(expected) {
        assert!(warning.starts_with(expected), "{warning}");
    }
}

#[test]
fn windows_and_unicode_texts_are_both_read() {
    let text = "BO_ 5 M: 1 A\n SG_ T : 0|8@1+ (1,0) [0|0] \"°C\" A\nCM_ SG_ 5 T \"say \\\"hot\\\"\";\n";
    let utf8 = dbc::parse("x.dbc", text.as_bytes()).unwrap();
    let bytes: Vec<u8> = text.chars().map(|c| u8::try_from(c).unwrap()).collect();
    let cp1252 = dbc::parse("x.dbc", &bytes).unwrap();
    let with_mark = dbc::parse("x.dbc", format!("\u{FEFF}{text}").as_bytes()).unwrap();
    for database in [utf8, cp1252, with_mark] {
        let signal = &database.messages[0].signals[0];
        assert_eq!((signal.unit.as_str(), signal.description.as_str()), ("°C", "say \"hot\""));
    }
}

const J1939: &str = "BA_DEF_ \"ProtocolType\" STRING ;\nBA_DEF_DEF_ \"ProtocolType\" \"J1939\";\n";

#[test]
fn parameter_groups_match_without_priority_and_addresses() {
    // 0x18EA0001: PDU 1, destination 00; 0x18FEF100 and …F121: PDU 2, two sources.
    let text = "BO_ 2565472257 Request: 3 A\n SG_ R : 0|8@1+ (1,0) [0|0] \"\" A\n\
         BO_ 2566844672 Cruise: 8 A\n SG_ C : 0|8@1+ (1,0) [0|0] \"\" A\n\
         BO_ 2566844705 Cruise21: 8 A\n SG_ C21 : 0|8@1+ (1,0) [0|0] \"\" A\n";
    let plain = decoder(dbc::parse("x.dbc", text.as_bytes()).unwrap());
    let j1939 = decoder(dbc::parse("x.dbc", format!("{text}{J1939}").as_bytes()).unwrap());
    let mut assumed = plain.clone();
    assumed.assume_j1939();
    for (frame, expected) in [
        ("18EA0001#05", Some("R=5")),
        ("0CEA5577#05", Some("R=5")),
        ("18FEF100#05", Some("C=5")),
        ("00FEF121#05", Some("C21=5")),
        ("0CFEF199#05", Some("C=5")),
        ("18FEF200#05", None),
        // The data page is part of the group's number.
        ("19FEF100#05", None),
    ] {
        assert_eq!(decode(&j1939, 1, frame).as_deref(), expected, "{frame}");
        assert_eq!(decode(&assumed, 1, frame).as_deref(), expected, "{frame}");
    }
    assert_eq!(decode(&plain, 1, "18EA0001#05").as_deref(), Some("R=5"));
    assert_eq!(decode(&plain, 1, "0CEA5577#05"), None);
}

/// A frame of the boat in `nmea2000.log`: near Corinth, sent by address 2 and not by 254.
#[test]
fn a_real_nmea_2000_position_decodes() {
    let text = format!(
        "BO_ 2583167486 Position: 8 A\n SG_ Latitude : 0|32@1- (1e-07,0) [0|0] \"deg\" A\n \
         SG_ Longitude : 32|32@1- (1e-07,0) [0|0] \"deg\" A\n{J1939}"
    );
    let decoder = decoder(dbc::parse("x.dbc", text.as_bytes()).unwrap());
    let position = decode(&decoder, 1, "09F80102#36729A16021AB80D");
    assert_eq!(position.as_deref(), Some("Latitude=37.9220534 Longitude=23.016909"));
}

#[test]
fn a_channel_with_a_database_uses_that_one_only() {
    let database = |name: &str| {
        let text = format!("BO_ 5 M: 1 A\n SG_ {name} : 0|8@1+ (1,0) [0|0] \"\" A\n");
        dbc::parse("x.dbc", text.as_bytes()).unwrap()
    };
    let decoder = Decoder::new(vec![
        Source { channel: None, database: database("All") },
        Source { channel: Some(2), database: database("Two") },
    ]);
    assert_eq!(decode(&decoder, 1, "005#01").as_deref(), Some("All=1"));
    assert_eq!(decode(&decoder, 2, "005#01").as_deref(), Some("Two=1"));
    assert_eq!(decode(&decoder, 3, "005#01").as_deref(), Some("All=1"));
}

#[test]
fn signals_are_chosen_by_patterns() {
    let text = "BO_ 5 Engine: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ OilTemp : 8|8@1+ (1,0) [0|0] \"\" A\n";
    let mut decoder = decoder(dbc::parse("x.dbc", text.as_bytes()).unwrap());
    for (patterns, expected) in [
        (&["*Temp"][..], "OilTemp=2"),
        (&["Engine.S*"], "Speed=1"),
        (&["Speed", "Oil????"], "Speed=1 OilTemp=2"),
        (&[], "Speed=1 OilTemp=2"),
    ] {
        decoder.select(&Selection::new(patterns).unwrap()).unwrap();
        assert_eq!(decode(&decoder, 1, "005#0102").as_deref(), Some(expected), "{patterns:?}");
    }
    let error = decoder.select(&Selection::new(&["Sped"]).unwrap()).unwrap_err();
    assert_eq!(error.to_string(), "no signal of the databases matches \"Sped\"; did you mean Speed?");
    assert!(Selection::new(&["[a"]).is_err());
}

#[test]
fn values_become_frames() {
    let text = "BO_ 5 EngineData: 4 A\n SG_ Speed : 7|16@0+ (0.5,0) [0|8000] \"rpm\" A\n SG_ Temp : 16|8@1- (1,10) [0|0] \"\" A\n \
                SG_ Gear : 24|4@1+ (1,0) [0|0] \"\" A\nVAL_ 5 Gear 0 \"Park\" 3 \"Drive\" ;\n\
                BA_DEF_ SG_ \"GenSigStartValue\" INT 0 15;\nBA_ \"GenSigStartValue\" SG_ 5 Gear 3;\n\
                BO_ 6 Muxed: 3 A\n SG_ Page M : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ X m1 : 8|8@1+ (1,0) [0|0] \"\" A\n \
                SG_ Y m2 : 8|8@1+ (1,0) [0|0] \"\" A\n SG_ Z : 16|8@1+ (1,0) [0|0] \"\" A\nSG_MUL_VAL_ 6 X Page 1-1, 3-4;\n";
    let decoder = decoder(dbc::parse("x.dbc", text.as_bytes()).unwrap());
    for (text, expected) in [
        ("EngineData:Speed=1200,Temp=90", Ok("005#09605003")),
        ("EngineData: Speed = 1200.4 , Gear = Park", Ok("005#09610000")),
        ("EngineData:Gear=\"drive\",Temp=raw:0xFF", Ok("005#0000FF03")),
        ("EngineData", Ok("005#00000003")),
        ("EngineData:Temp=-118", Ok("005#00008003")),
        ("Muxed:X=7", Ok("006#010700")),
        ("Muxed:Page=3,X=7", Ok("006#030700")),
        ("Muxed:Y=7,Z=9", Ok("006#020709")),
        (
            "EngineData:Speed=9000",
            Err("the database allows Speed from 0 to 8000, not 9000; write raw:18000 to send it anyway"),
        ),
        ("EngineData:Temp=-119", Err("-119 does not fit Temp, which goes from -118 to 137")),
        ("EngineData:Gear=raw:16", Err("raw:16 does not fit Gear, which goes from 0 to 15")),
        (
            "EngineData:Gear=Reverse",
            Err("\"Reverse\" is not a value for Gear; it takes a number or one of: Park, Drive"),
        ),
        ("EngineData:Sped=1", Err("message EngineData has no signal \"Sped\"; did you mean Speed?")),
        ("EngineDate:Speed=1", Err("no database has a message \"EngineDate\"; did you mean EngineData?")),
        (
            "EngineData:Speed",
            Err(
                "\"EngineData:Speed\" is not a message with values; write it as Message:Signal=value,Signal=value",
            ),
        ),
        ("EngineData:Temp=1,Temp=2", Err("signal Temp is given twice")),
        ("Muxed:X=1,Y=1", Err("X and Y are never in the same frame (Page chooses between them)")),
        ("Muxed:Page=2,X=1", Err("X is only there when Page is 1 or 3 to 4, and it is 2")),
    ] {
        let found = encode::encode(&decoder, None, text);
        let found = found.as_ref().map(|encoded| encoded.frame.to_string()).map_err(ToString::to_string);
        let expected = expected.map(str::to_owned).map_err(str::to_owned);
        assert_eq!(found, expected, "{text}");
    }
}

/// Found with a file of an old computer: it was a database without messages, which looked like success.
#[test]
fn lines_may_end_with_a_carriage_return_alone_and_a_file_that_is_not_understood_is_an_error() {
    let text = "VERSION \"\"\nBU_: A\nBO_ 256 M: 1 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\nCM_ BO_ 256 \"two\nlines\";\n";
    let database = dbc::parse("a.dbc", text.replace('\n', "\r").as_bytes()).unwrap();
    assert_eq!((database.warnings.len(), database.messages.len()), (0, 1));
    assert_eq!((database.messages[0].description.as_str(), database.messages[0].line), ("two\nlines", 3));
    let error = dbc::parse("a.dbc", b"VERSION \"\"\nBU_: A\nEV_ X: 0 [0|1] \"\" 2,5 2 D A;\n")
        .unwrap_err()
        .to_string();
    assert!(error.contains("line 3: EV_ X") && error.contains("not understood"), "{error}");
    // Without anything wrong it may be empty.
    assert!(dbc::parse("a.dbc", b"VERSION \"\"\nBU_: A\n").unwrap().messages.is_empty());
}
