//! KCD, SYM and ARXML files: their content, and the messages if something is wrong. That they decode like others is tested in
//! `signals_agree_with_cantools.rs`.

use cantap_signals::{Database, DatabaseError, Decoder, Source, arxml, kcd, sym};
use cantap_trace::TraceFrame;

fn decode(database: Database, frame: &str) -> String {
    let decoder = Decoder::new(vec![Source { channel: None, database }]);
    let frame: TraceFrame = frame.parse().unwrap();
    let mut values = Vec::new();
    let message = decoder.message(decoder.decode(1, &frame, &mut values).unwrap());
    let texts = values.iter().map(|value| {
        let signal = &message.signals[value.signal as usize];
        let text = signal.text(value.raw).map(|text| format!("({text})")).unwrap_or_default();
        format!("{}={}{text}{}", signal.name, signal.number(value.raw), signal.unit)
    });
    texts.collect::<Vec<_>>().join(" ")
}

const KCD: &str = r#"<NetworkDefinition xmlns="http://kayak.2codeornot2code.org/1.0"><Document name="x"/>
 <Bus name="Motor">
  <Message id="0x0B2" name="ABS" interval="100" length="4"><Notes>Brakes</Notes>
   <Multiplex name="Mux" offset="0" length="2"><MuxGroup count="1"><Signal name="One" offset="8" length="8"/></MuxGroup>
    <MuxGroup count="2"><Signal name="Two" offset="8" length="8"><Value slope="0.1" unit="V"/></Signal></MuxGroup></Multiplex>
   <Signal name="Big" offset="16" length="12" endianess="big"><Value type="signed" intercept="-1"/>
    <LabelSet><Label name="none" value="0"/><LabelGroup name="some" from="1" to="3"/></LabelSet></Signal>
  </Message>
  <Message id="0x20000000" name="Far"/>
 </Bus></NetworkDefinition>"#;

#[test]
fn a_kcd_file_is_read() {
    let database = kcd::parse("x.kcd", KCD.as_bytes()).unwrap();
    assert_eq!((database.messages.len(), database.messages[0].cycle_ms), (1, Some(100)));
    assert_eq!(database.messages[0].description, "Brakes");
    let warnings: Vec<_> = database.warnings.iter().map(ToString::to_string).collect();
    assert!(
        warnings.len() == 1 && warnings[0].starts_with("line 9: Far: identifier 0x20000000 does not fit"),
        "{warnings:?}"
    );
    assert_eq!(decode(database.clone(), "0B2#02070020"), "Mux=2 Big=1(some) Two=0.7V");
    assert_eq!(decode(database, "0B2#0107FFF0"), "Mux=1 Big=-2 One=7");
}

/// Programs forget the mark of extended identifiers; such messages were once left out.
#[test]
fn an_identifier_above_11_bits_is_extended_whatever_the_file_says() {
    let warnings =
        |database: &Database| -> Vec<_> { database.warnings.iter().map(ToString::to_string).collect() };
    let text = KCD
        .replace("0x20000000", "0x18FEF100")
        .replace("</Bus>", r#"<Message id="0x800" name="Next" format="standard"/></Bus>"#);
    let database = kcd::parse("x.kcd", text.as_bytes()).unwrap();
    let ids: Vec<_> = database.messages.iter().map(|message| message.id.to_string()).collect();
    assert_eq!(ids, ["0B2", "18FEF100", "00000800"]);
    assert_eq!(
        warnings(&database),
        [
            "line 9: Far: identifier 0x18FEF100 is not marked as extended and does not fit 11 bits; 2 such messages are read as extended"
        ]
    );
    let text = ARXML.replace("EXTENDED", "STANDARD").replace("<IDENTIFIER>291<", "<IDENTIFIER>4660<");
    let database = arxml::parse("x.arxml", text.as_bytes()).unwrap();
    assert_eq!(database.messages[0].id.to_string(), "00001234");
    let all = warnings(&database);
    assert!(
        all.iter().any(|one| one.contains("F: identifier 0x1234 is not marked")
            && one.ends_with("1 such message is read as extended")),
        "{all:?}"
    );
    let text =
        "FormatVersion=6.0\n{SENDRECEIVE}\n[One]\nType=Standard\nID=900h\nLen=1\n[Sure]\nID=901h\nLen=1\n";
    let database = sym::parse("x.sym", text.as_bytes()).unwrap();
    let ids: Vec<_> = database.messages.iter().map(|message| message.id.to_string()).collect();
    assert_eq!(ids, ["00000900", "00000901"]);
    let expected = "line 3: One: identifier 0x900 is not marked as extended and does not fit 11 bits; 1 such message is read as extended";
    assert_eq!(warnings(&database), [expected]);
}

const TWO_BUSES: &str = r#"<NetworkDefinition><Document name="x"/>
 <Bus name="Motor"><Message id="0x10" name="Engine"><Signal name="Speed" offset="0" length="8"/></Message>
  <Message id="0x11" name="Oil"><Signal name="Temp" offset="0" length="8"/></Message></Bus>
 <Bus name="Comfort"><Message id="0x10" name="Seat"><Signal name="Heat" offset="0" length="8"/></Message>
  <Message id="0x12" name="Door"><Signal name="Open" offset="0" length="1"/></Message></Bus></NetworkDefinition>"#;

/// Both were once read as one, so that a frame on one bus was shown as one on the other.
#[test]
fn one_bus_of_several_is_read_and_all_of_them_as_one_are_warned_of() {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("buses");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("car.kcd"), TWO_BUSES).unwrap();
    std::fs::write(folder.join("a#b.kcd"), TWO_BUSES).unwrap();
    std::fs::write(folder.join("one.dbc"), "VERSION \"\"\nBO_ 1 A: 1 X\n").unwrap();
    let load = |name: &str| cantap_signals::load(&folder.join(name));
    let names = |database: &Database| -> Vec<String> {
        database.messages.iter().map(|message| message.name.clone()).collect()
    };
    for (bus, messages, frame, text) in
        [("Motor", ["Engine", "Oil"], "010#05", "Speed=5"), ("Comfort", ["Seat", "Door"], "010#05", "Heat=5")]
    {
        let database = load(&format!("car.kcd#{bus}")).unwrap();
        assert_eq!(
            (names(&database), database.buses.join(" ")),
            (messages.map(str::to_owned).to_vec(), bus.to_owned())
        );
        assert_eq!(database.warnings, []);
        assert_eq!(decode(database, frame), text);
    }
    let all = load("car.kcd").unwrap();
    assert_eq!((all.messages.len(), all.buses.join(" ")), (4, "Motor Comfort".to_owned()));
    let warning = all.warnings[0].to_string();
    assert!(
        warning.contains("the buses Motor, Comfort, of which 1 message") && warning.contains("FILE#Motor"),
        "{warning}"
    );
    assert_eq!(load("a#b.kcd").unwrap().messages.len(), 4);
    assert_eq!(load("a#b.kcd#Comfort").unwrap().messages.len(), 2);
    let error = load("car.kcd#Body").unwrap_err().to_string();
    assert!(error.contains("no bus \"Body\" in it; its buses are Motor, Comfort"), "{error}");
    assert!(load("one.dbc#A").unwrap_err().to_string().contains("is of one bus"));
    assert!(matches!(load("gone.kcd#A"), Err(DatabaseError::Read { .. })));
}

const SYM: &str = "FormatVersion=6.0 // Do not edit this line!\nTitle=\"x\"\n\n{ENUMS}\nEnum=Gear(0=\"Park\", // a comment\n  1=\"Drive\")\n\n\
                   {SIGNALS}\nSig=\"A B\" unsigned 8 -m /u:\"m s\" /f:0.5 /o:-1 // speed\n\n{SENDRECEIVE}\n\n[\"Sym\"]\nID=00000123h-00000124h // two\n\
                   Len=4\nCycleTime=20\nMux=First 0,8 1Ah -m\nSig=\"A B\" 8\n\n[\"Sym\"]\nLen=4\nMux=Second 0,8 1Bh -m\nVar=G Gear 8,4\n\n\
                   [Bad]\nID=5h\nSig=Nowhere 3\n";

#[test]
fn a_sym_file_is_read() {
    let database = sym::parse("x.sym", SYM.as_bytes()).unwrap();
    let names: Vec<_> =
        database.messages.iter().map(|message| (message.id.to_string(), message.cycle_ms)).collect();
    assert_eq!(names, [("00000123".to_owned(), Some(20)), ("00000124".to_owned(), Some(20))]);
    let warnings: Vec<_> = database.warnings.iter().map(ToString::to_string).collect();
    assert!(warnings[0].starts_with("line 27: Bad: there is no signal \"Nowhere\""), "{warnings:?}");
    assert_eq!(decode(database.clone(), "00000124#1A05"), "First=26 A B=1.5m s");
    assert_eq!(decode(database, "00000123#1B01"), "First=27 G=1(Drive)");
}

const ARXML: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<AUTOSAR xmlns="http://autosar.org/schema/r4.0"><AR-PACKAGES><AR-PACKAGE><SHORT-NAME>P</SHORT-NAME><ELEMENTS>
 <CAN-CLUSTER><SHORT-NAME>C</SHORT-NAME><X><CAN-FRAME-TRIGGERING><SHORT-NAME>T</SHORT-NAME><FRAME-REF>/P/F</FRAME-REF>
  <CAN-ADDRESSING-MODE>EXTENDED</CAN-ADDRESSING-MODE><IDENTIFIER>291</IDENTIFIER></CAN-FRAME-TRIGGERING>
  <CAN-FRAME-TRIGGERING><SHORT-NAME>U</SHORT-NAME><FRAME-REF>/P/Gone</FRAME-REF><IDENTIFIER>5</IDENTIFIER></CAN-FRAME-TRIGGERING></X></CAN-CLUSTER>
 <CAN-FRAME><SHORT-NAME>F</SHORT-NAME><FRAME-LENGTH>3</FRAME-LENGTH><M><PDU-TO-FRAME-MAPPING><SHORT-NAME>PM</SHORT-NAME><PDU-REF>/P/Pdu</PDU-REF>
  <START-POSITION>8</START-POSITION></PDU-TO-FRAME-MAPPING></M></CAN-FRAME>
 <I-SIGNAL-I-PDU><SHORT-NAME>Pdu</SHORT-NAME><T><TIME-PERIOD><VALUE>0.25</VALUE></TIME-PERIOD></T>
  <S><I-SIGNAL-TO-I-PDU-MAPPING><SHORT-NAME>SM</SHORT-NAME><I-SIGNAL-REF>/P/Sig</I-SIGNAL-REF>
  <PACKING-BYTE-ORDER>MOST-SIGNIFICANT-BYTE-FIRST</PACKING-BYTE-ORDER><START-POSITION>7</START-POSITION></I-SIGNAL-TO-I-PDU-MAPPING></S></I-SIGNAL-I-PDU>
 <I-SIGNAL><SHORT-NAME>Sig</SHORT-NAME><DESC><L-2 L="EN">Outside</L-2></DESC><LENGTH>16</LENGTH><N><C><BASE-TYPE-REF>/P/S16</BASE-TYPE-REF><COMPU-METHOD-REF>/P/CM</COMPU-METHOD-REF></C></N></I-SIGNAL>
 <SW-BASE-TYPE><SHORT-NAME>S16</SHORT-NAME><BASE-TYPE-ENCODING>2C</BASE-TYPE-ENCODING></SW-BASE-TYPE>
 <COMPU-METHOD><SHORT-NAME>CM</SHORT-NAME><UNIT-REF>/P/Celsius</UNIT-REF><I><COMPU-SCALES>
  <COMPU-SCALE><LOWER-LIMIT>-400</LOWER-LIMIT><UPPER-LIMIT>850</UPPER-LIMIT><COMPU-RATIONAL-COEFFS><COMPU-NUMERATOR><V>5</V><V>1</V></COMPU-NUMERATOR><COMPU-DENOMINATOR><V>10</V></COMPU-DENOMINATOR></COMPU-RATIONAL-COEFFS></COMPU-SCALE>
  <COMPU-SCALE><LOWER-LIMIT>32767</LOWER-LIMIT><UPPER-LIMIT>32767</UPPER-LIMIT><COMPU-CONST><VT>Broken</VT></COMPU-CONST></COMPU-SCALE></COMPU-SCALES></I></COMPU-METHOD>
 <UNIT><SHORT-NAME>Celsius</SHORT-NAME><DISPLAY-NAME>°C</DISPLAY-NAME></UNIT>
</ELEMENTS></AR-PACKAGE></AR-PACKAGES></AUTOSAR>"#;

#[test]
fn an_arxml_file_is_read() {
    let database = arxml::parse("x.arxml", ARXML.as_bytes()).unwrap();
    assert_eq!(database.buses, ["C"]);
    let other = ARXML.replace("</ELEMENTS>", r"<CAN-CLUSTER><SHORT-NAME>D</SHORT-NAME><CAN-FRAME-TRIGGERING><FRAME-REF>/P/G</FRAME-REF>
        <CAN-ADDRESSING-MODE>EXTENDED</CAN-ADDRESSING-MODE><IDENTIFIER>291</IDENTIFIER></CAN-FRAME-TRIGGERING></CAN-CLUSTER>
        <CAN-FRAME><SHORT-NAME>G</SHORT-NAME><FRAME-LENGTH>3</FRAME-LENGTH></CAN-FRAME></ELEMENTS>");
    let both = arxml::parse("x.arxml", other.as_bytes()).unwrap();
    assert_eq!((both.messages.len(), both.buses.join(" ")), (2, "C D".to_owned()));
    assert!(
        both.warnings
            .iter()
            .any(|warning| warning.to_string().contains("the buses C, D, of which 1 message"))
    );
    let one = arxml::parse_bus("x.arxml", other.as_bytes(), Some("D")).unwrap();
    assert_eq!((one.messages.len(), one.messages[0].name.as_str()), (1, "G"));
    assert!(arxml::parse_bus("x.arxml", other.as_bytes(), Some("E")).is_err());
    let message = &database.messages[0];
    assert_eq!((database.messages.len(), message.name.as_str(), message.cycle_ms), (1, "F", Some(250)));
    let signal = &message.signals[0];
    assert_eq!((signal.min, signal.max, signal.description.as_str()), (Some(-39.5), Some(85.5), "Outside"));
    let warnings: Vec<_> = database.warnings.iter().map(ToString::to_string).collect();
    assert!(warnings[0].contains("U: the frame \"/P/Gone\" is not in the file"), "{warnings:?}");
    assert_eq!(decode(database.clone(), "00000123#00FFF6"), "Sig=-0.5°C");
    assert_eq!(decode(database, "00000123#007FFF"), "Sig=3277.2(Broken)°C");
    // What tools call the unit of what has none.
    let none = ARXML.replace("<DISPLAY-NAME>°C<", "<DISPLAY-NAME>NoUnit<");
    assert_eq!(arxml::parse("x.arxml", none.as_bytes()).unwrap().messages[0].signals[0].unit, "");
    // UTF-16, as written by some tools.
    let wide: Vec<u8> =
        std::iter::once(0xFEFF).chain(ARXML.encode_utf16()).flat_map(u16::to_le_bytes).collect();
    assert_eq!(arxml::parse("x.arxml", &wide).unwrap().messages[0].signals[0].unit, "°C");
}

/// A leading zero makes a number octal in AUTOSAR: lengths and identifiers were once read as decimal.
#[test]
fn an_arxml_files_numbers_may_be_octal_or_hexadecimal_and_in_ones_complement() {
    let text = ARXML
        .replace("<IDENTIFIER>291<", "<IDENTIFIER>0443<")
        .replace("<LENGTH>16<", "<LENGTH>020<")
        .replace("-LIMIT>850<", "-LIMIT>0x352<")
        .replace("-LIMIT>-400<", "-LIMIT>-0620<");
    let same = arxml::parse("x.arxml", ARXML.as_bytes()).unwrap();
    assert_eq!(arxml::parse("x.arxml", text.as_bytes()).unwrap().messages, same.messages);
    let database = arxml::parse("x.arxml", ARXML.replace(">2C<", ">1C<").as_bytes()).unwrap();
    assert_eq!(decode(database, "00000123#00FFF6"), "Sig=-0.4°C");
}

#[test]
fn what_follows_the_payload_of_a_secured_pdu_is_read_as_far_as_it_fits_a_signal() {
    let with_proof = |freshness: u32, authenticator: u32| {
        let secured = format!(
            "<SECURED-I-PDU><SHORT-NAME>Safe</SHORT-NAME><PAYLOAD-REF>/P/C/Tr</PAYLOAD-REF>
              <FRESHNESS-PROPS-REF>/P/Fresh</FRESHNESS-PROPS-REF><AUTHENTICATION-PROPS-REF>/P/Auth</AUTHENTICATION-PROPS-REF></SECURED-I-PDU>
             <SECURE-COMMUNICATION-FRESHNESS-PROPS><SHORT-NAME>Fresh</SHORT-NAME><FRESHNESS-VALUE-TX-LENGTH>{freshness}</FRESHNESS-VALUE-TX-LENGTH>
             </SECURE-COMMUNICATION-FRESHNESS-PROPS><SECURE-COMMUNICATION-AUTHENTICATION-PROPS><SHORT-NAME>Auth</SHORT-NAME>
              <AUTH-INFO-TX-LENGTH>{authenticator}</AUTH-INFO-TX-LENGTH></SECURE-COMMUNICATION-AUTHENTICATION-PROPS>
             <I-SIGNAL-I-PDU><SHORT-NAME>Pdu</SHORT-NAME><LENGTH>2</LENGTH>"
        );
        let text = ARXML
            .replace("<FRAME-LENGTH>3<", "<FRAME-LENGTH>20<")
            .replace("<PDU-REF>/P/Pdu</PDU-REF>", "<PDU-REF>/P/Safe</PDU-REF>")
            .replace("<I-SIGNAL-I-PDU><SHORT-NAME>Pdu</SHORT-NAME>", &secured)
            .replace("<X><CAN-FRAME-TRIGGERING>", "<X><PDU-TRIGGERING><SHORT-NAME>Tr</SHORT-NAME><I-PDU-REF>/P/Pdu</I-PDU-REF></PDU-TRIGGERING><CAN-FRAME-TRIGGERING>");
        arxml::parse("x.arxml", text.as_bytes()).unwrap()
    };
    // After three bytes: 4 bits, then 12.
    let database = with_proof(4, 12);
    assert_eq!(decode(database, "00000123#00FFF6A5C3"), "Sig=-0.5°C F_Freshness=10 F_Authenticator=1475");
    let database = with_proof(0, 128);
    assert_eq!(database.messages[0].signals.len(), 1);
    let warnings: Vec<_> = database.warnings.iter().map(ToString::to_string).collect();
    assert!(
        warnings.iter().any(|warning| warning.contains("the authenticator of Safe, 128 bits, is not read")),
        "{warnings:?}"
    );
}

#[test]
fn the_payload_of_a_secured_pdu_is_read() {
    let secured = |more: &str| {
        let pdus = format!(
            "<SECURED-I-PDU><SHORT-NAME>Safe</SHORT-NAME><LENGTH>3</LENGTH><PAYLOAD-REF>/P/C/Tr</PAYLOAD-REF>{more}</SECURED-I-PDU>
             <X><SHORT-NAME>C2</SHORT-NAME></X><I-SIGNAL-I-PDU><SHORT-NAME>Pdu</SHORT-NAME>"
        );
        let text = ARXML
            .replace("<PDU-REF>/P/Pdu</PDU-REF>", "<PDU-REF>/P/Safe</PDU-REF>")
            .replace("<I-SIGNAL-I-PDU><SHORT-NAME>Pdu</SHORT-NAME>", &pdus)
            .replace("<X><CAN-FRAME-TRIGGERING>", "<X><PDU-TRIGGERING><SHORT-NAME>Tr</SHORT-NAME><I-PDU-REF>/P/Pdu</I-PDU-REF></PDU-TRIGGERING><CAN-FRAME-TRIGGERING>");
        arxml::parse("x.arxml", text.as_bytes()).unwrap()
    };
    let database = secured("");
    assert_eq!(database.messages[0].cycle_ms, Some(250));
    assert_eq!(decode(database, "00000123#00FFF6"), "Sig=-0.5°C");
    let warnings = |database: Database| {
        let mut texts =
            database.warnings.iter().map(ToString::to_string).filter(|text| !text.contains("/P/Gone"));
        texts.next().unwrap()
    };
    let elsewhere = secured("<USE-AS-CRYPTOGRAPHIC-I-PDU>true</USE-AS-CRYPTOGRAPHIC-I-PDU>");
    assert!(elsewhere.messages[0].signals.is_empty());
    assert!(warnings(elsewhere).contains("Safe only has the authenticator"));
    let gone = arxml::parse("x.arxml", ARXML.replace("I-SIGNAL-I-PDU>", "SECURED-I-PDU>").as_bytes());
    assert!(warnings(gone.unwrap()).contains("the payload of Pdu, a secured PDU, is not in the file"));
}

/// Each PDU is a part of itself, once and many times over: the first crashed the program, the second would have taken
/// years.
#[test]
fn pdus_that_are_parts_of_themselves_leave_their_frame_out() {
    for parts in [1, 40] {
        let part = "<STATIC-PART><I-PDU-REF>/P/Pdu</I-PDU-REF></STATIC-PART>".repeat(parts);
        let text = ARXML
            .replace(
                "<I-SIGNAL-I-PDU><SHORT-NAME>Pdu</SHORT-NAME>",
                &format!("<MULTIPLEXED-I-PDU><SHORT-NAME>Pdu</SHORT-NAME>{part}"),
            )
            .replace("</I-SIGNAL-I-PDU>", "</MULTIPLEXED-I-PDU>");
        let error = arxml::parse("x.arxml", text.as_bytes()).map(|database| database.warnings);
        let texts = match error {
            Ok(warnings) => warnings.iter().map(ToString::to_string).collect(),
            Err(error) => error.to_string(),
        };
        assert!(texts.contains("without an end"), "{texts}");
    }
    let text = ARXML
        .replace("<I-SIGNAL-I-PDU><SHORT-NAME>Pdu</SHORT-NAME>", "<SECURED-I-PDU><SHORT-NAME>Pdu</SHORT-NAME><PAYLOAD-REF>/P/C/Tr</PAYLOAD-REF>")
        .replace("</I-SIGNAL-I-PDU>", "</SECURED-I-PDU>")
        .replace("<X><CAN-FRAME-TRIGGERING>", "<X><PDU-TRIGGERING><SHORT-NAME>Tr</SHORT-NAME><I-PDU-REF>/P/Pdu</I-PDU-REF></PDU-TRIGGERING><CAN-FRAME-TRIGGERING>");
    let result = arxml::parse("x.arxml", text.as_bytes());
    assert!(result.is_err() || result.is_ok_and(|database| database.messages.is_empty()));
}

type Parse = fn(&str, &[u8]) -> Result<Database, DatabaseError>;

#[test]
fn what_is_no_database_is_an_error() {
    for (parse, text, expected) in [
        (kcd::parse as Parse, "", "x: the file is empty"),
        (kcd::parse, "<a>", "x: line 1: "),
        (kcd::parse, "<AUTOSAR/>", "x: its element is <AUTOSAR>; a KCD file's is <NetworkDefinition>"),
        (sym::parse, " \n", "x: the file is empty"),
        (sym::parse, "[A]\nID=1h\n", "x: there is no line FormatVersion="),
        (arxml::parse, "", "x: the file is empty"),
        (arxml::parse, "<AUTOSAR/>", "x: no CAN frame is in it"),
        (arxml::parse, "<html/>", "x: its element is <html>; an ARXML file's is <AUTOSAR>"),
    ] {
        let error = parse("x", text.as_bytes()).unwrap_err().to_string();
        assert!(error.starts_with(expected), "{text:?}: {error}");
    }
}

/// Cut anywhere, a file is an error or a smaller database, and never crashes the program.
#[test]
fn files_cut_anywhere_are_read_or_refused() {
    for (parse, text) in [(kcd::parse as Parse, KCD), (sym::parse, SYM), (arxml::parse, ARXML)] {
        for end in (0..text.len()).step_by(7) {
            let _ = parse("x", &text.as_bytes()[..end]);
            let mut damaged = text.as_bytes().to_vec();
            damaged[end] = b'9';
            let _ = parse("x", &damaged);
        }
    }
}
