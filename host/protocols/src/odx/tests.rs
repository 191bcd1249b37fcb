//! Files as they are, and as they must not be.

use std::fmt::Write as _;
use std::io::Write as _;
use std::sync::Arc;

use super::*;
use crate::diagnostics::Diagnostics;
use crate::testing::at;
use crate::{Assembler, Options, Protocol, Reader};

const SOMERSAULT: &[u8] = include_bytes!("../../tests/data/somersault.pdx");
const KINDS: &str = include_str!("../../tests/data/kinds.odx-d");

/// A document with one ECU, of these types, services and messages.
fn document(dictionary: &str, rest: &str) -> String {
    format!(
        "<ODX MODEL-VERSION=\"2.2.0\" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\">\n<DIAG-LAYER-CONTAINER ID=\"c\"><SHORT-NAME>c</SHORT-NAME>\n\
         <BASE-VARIANTS><BASE-VARIANT ID=\"b\"><SHORT-NAME>ECU</SHORT-NAME>\n<DIAG-DATA-DICTIONARY-SPEC>{dictionary}</DIAG-DATA-DICTIONARY-SPEC>{rest}\
         </BASE-VARIANT></BASE-VARIANTS></DIAG-LAYER-CONTAINER></ODX>"
    )
}

const U8: &str = "<DIAG-CODED-TYPE BASE-DATA-TYPE=\"A_UINT32\" xsi:type=\"STANDARD-LENGTH-TYPE\"><BIT-LENGTH>8</BIT-LENGTH></DIAG-CODED-TYPE>";

/// A service 22 01 whose response has a value of the type `d`.
fn service() -> String {
    let constant = |value: u8, at: u8| {
        format!(
            "<PARAM xsi:type=\"CODED-CONST\"><SHORT-NAME>c{at}</SHORT-NAME><BYTE-POSITION>{at}</BYTE-POSITION><CODED-VALUE>{value}</CODED-VALUE>{U8}</PARAM>"
        )
    };
    format!(
        "<DIAG-COMMS><DIAG-SERVICE ID=\"s\"><SHORT-NAME>Read</SHORT-NAME><REQUEST-REF ID-REF=\"q\"/><POS-RESPONSE-REFS><POS-RESPONSE-REF ID-REF=\"p\"/>\
         </POS-RESPONSE-REFS></DIAG-SERVICE></DIAG-COMMS>\n<REQUESTS><REQUEST ID=\"q\"><PARAMS>{}{}</PARAMS></REQUEST></REQUESTS>\
         <POS-RESPONSES><POS-RESPONSE ID=\"p\"><PARAMS>{}{}<PARAM xsi:type=\"VALUE\"><SHORT-NAME>v</SHORT-NAME><DOP-REF ID-REF=\"d\"/></PARAM></PARAMS>\
         </POS-RESPONSE></POS-RESPONSES>",
        constant(0x22, 0),
        constant(1, 1),
        constant(0x62, 0),
        constant(1, 1)
    )
}

fn data_object(coded: &str, compu: &str) -> String {
    format!(
        "<DATA-OBJECT-PROPS><DATA-OBJECT-PROP ID=\"d\"><SHORT-NAME>d</SHORT-NAME>{compu}{coded}</DATA-OBJECT-PROP></DATA-OBJECT-PROPS>"
    )
}

fn read_text(text: &str) -> Result<Odx, OdxError> {
    Odx::read("a.odx-d", text.as_bytes())
}

fn reading(text: &str, response: &[u8]) -> Reading {
    let ecu = read_text(text).unwrap().ecu("ECU").unwrap();
    ecu.describe(Some(&[0x22, 1]), Some(response)).unwrap().response.unwrap()
}

fn archive(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut archive = rawzip::ZipArchiveWriter::new(&mut bytes);
    for (name, content) in files {
        let (mut entry, config) =
            archive.new_file(name).compression_method(rawzip::CompressionMethod::DEFLATE).start().unwrap();
        let encoder = flate2::write::DeflateEncoder::new(&mut entry, flate2::Compression::default());
        let mut writer = config.wrap(encoder);
        writer.write_all(content).unwrap();
        let (encoder, descriptor) = writer.finish().unwrap();
        encoder.finish().unwrap();
        entry.finish(descriptor).unwrap();
    }
    archive.finish().unwrap();
    bytes
}

#[test]
fn a_package_has_layers_with_their_identifiers() {
    let odx = Odx::read("somersault.pdx", SOMERSAULT).unwrap();
    let layers: Vec<_> = odx.layers().map(|(kind, name)| (kind.name(), name)).collect();
    assert_eq!(
        layers,
        [
            ("protocol", "somersault_protocol"),
            ("base-variant", "somersault_base_variant"),
            ("ecu-variant", "somersault_lazy"),
            ("ecu-variant", "somersault_assiduous"),
        ]
    );
    assert_eq!(odx.issues, []);
    let lazy = odx.ecu("somersault_lazy").unwrap();
    // 123 and 456, in decimal.
    assert_eq!(lazy.pairs().iter().map(ToString::to_string).collect::<Vec<_>>(), ["07B:1C8"]);
    // Two services are not inherited.
    let names = |ecu: &Ecu| ecu.requests().into_iter().map(|request| request.name).collect::<Vec<_>>();
    let base = odx.ecu("somersault_base_variant").unwrap();
    let missing: Vec<_> = names(&base).into_iter().filter(|name| !names(&lazy).contains(name)).collect();
    assert_eq!(missing, ["do_backward_flips", "set_operation_params"]);
    assert_eq!(
        odx.ecu("nobody").unwrap_err().to_string(),
        "there is no layer nobody in it; there are: somersault_protocol, somersault_base_variant, somersault_lazy, somersault_assiduous"
    );
}

#[test]
fn exchanges_have_names_and_values() {
    let odx = Odx::read("kinds.odx-d", KINDS.as_bytes()).unwrap();
    assert_eq!(odx.issues, []);
    let descriptions = Descriptions::new([Source { odx: &odx, layer: None }]).unwrap();
    let descriptions = Some(Arc::new(descriptions));
    let mut diagnostics = Diagnostics::new(&[], true).with_descriptions(descriptions.clone());
    let mut events = Vec::new();
    for (ms, frame) in [
        (0.0, "7E0#03220111"),
        (1.0, "7E8#0462011178"),
        (10.0, "7E0#0322011C"),
        (11.0, "7E8#0662011CFFFE50"),
        // Shorter than its description.
        (20.0, "7E0#0322011C"),
        (21.0, "7E8#0562011C0102"),
        (30.0, "7E0#031902FF"),
        (31.0, "7E8#075902FF01231108"),
        (40.0, "7E0#0322F190"),
        (41.0, "7E8#0462F19041"),
        (50.0, "7E0#0322011C"),
        (51.0, "7E8#037F2231"),
        // Several at once.
        (60.0, "7E0#052201010111"),
        (61.0, "7E8#07620101010111AA"),
    ] {
        diagnostics.take(&at(ms, frame), &mut events);
    }
    let lines: Vec<_> = events.iter().map(ToString::to_string).collect();
    assert_eq!(
        lines,
        [
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, ecu \"Kinds\", service \"read_temperature\", did 0x0111, temperature 20 °C, after 1 ms",
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, ecu \"Kinds\", service \"read_point\", did 0x011C, point.x -2, point.y 0 °C, after 1 ms",
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, ecu \"Kinds\", service \"read_point\", did 0x011C, value 01 02, point.x 258, \
             not_described \"the message is shorter than its description at point.y\", after 1 ms",
            "uds 7E0 > 7E8 ReadDTCInformation: sid 0x19, ecu \"Kinds\", service \"Read_Codes\", sub_function 0x02 (DTCs by status mask), mask 255, \
             available_mask 0xFF, trouble_codes 1, codes \"P0123-11 (confirmed)\", dtc \"P0123-11\" (P012311: Air flow sensor: short to ground), after 1 ms",
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, ecu \"Kinds\", did 0xF190 (VIN), value 41, after 1 ms",
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, ecu \"Kinds\", service \"read_point\", did 0x011C, nrc 0x31 (requestOutOfRange), after 1 ms",
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, ecu \"Kinds\", service \"read_u8, read_temperature\", did 0x0101, did 0x0111, \
             value_0101 01, value_0111 AA, after 1 ms",
        ]
    );
    // The reader, which looks at the first records before it decides, says the same.
    let options = Options { protocols: vec![Protocol::Uds], descriptions, ..Options::default() };
    let (mut reader, mut read) = (Reader::new(options), Vec::new());
    reader.push(&at(0.0, "7E0#03220111"), &mut read);
    reader.push(&at(1.0, "7E8#0462011178"), &mut read);
    assert_eq!(read[0].to_string(), lines[0]);
}

#[test]
fn requests_are_found_by_name() {
    let odx = Odx::read("kinds.odx-d", KINDS.as_bytes()).unwrap();
    let ecu = odx.ecu("Kinds").unwrap();
    assert_eq!(ecu.request("read_point", &[0x22]).unwrap().bytes, [0x22, 0x01, 0x1C]);
    // By the name of what the response has, in any case.
    assert_eq!(ecu.request("POINT", &[0x22]).unwrap().bytes, [0x22, 0x01, 0x1C]);
    let start = ecu.request("Move to a place", &[0x31, 1]).unwrap();
    assert_eq!(
        (&start.bytes[..], &start.open[..]),
        (&[0x31, 1, 2, 3][..], &["to".to_owned(), "gear".to_owned()][..])
    );
    let unknown = ecu.request("read_points", &[0x22]).unwrap_err().to_string();
    assert_eq!(unknown, "read_points is not the name of a request 22 of Kinds; there are: read_point");
    let several = ecu.request("behind", &[0x22]).unwrap_err();
    assert!(matches!(several, NameError::Several { .. }), "{several}");
    assert_eq!(ecu.trouble_code(0xC1_2200).unwrap(), "U012200: Lost communication");
}

/// A variant has its own types by the same name, and without a choice the base variant counts.
#[test]
fn the_variant_that_is_chosen_counts() {
    let odx = Odx::read("kinds.odx-d", KINDS.as_bytes()).unwrap();
    let gear = |layer| {
        let descriptions = Descriptions::new([Source { odx: &odx, layer }]).unwrap();
        let ecu = descriptions
            .of(None, None)
            .cloned()
            .or_else(|| descriptions.ecus().first().map(|ecu| (*ecu).clone()));
        ecu.unwrap().name().to_owned()
    };
    assert_eq!((gear(None), gear(Some("Kinds_Other"))), ("Kinds".to_owned(), "Kinds_Other".to_owned()));
}

#[test]
fn what_is_missing_is_said_with_its_place() {
    let odx = read_text(&document("", &service())).unwrap();
    let issues: Vec<_> = odx.issues.iter().map(ToString::to_string).collect();
    assert_eq!(issues, ["a.odx-d:5: d is not in this file"]);
    let read = reading(&document("", &service()), &[0x62, 1, 2]);
    assert_eq!(
        read.stop,
        Some(("v".to_owned(), Stop::NotEvaluated("a type that is not in the file".to_owned())))
    );
    let program = "<COMPU-METHOD><CATEGORY>COMPUCODE</CATEGORY></COMPU-METHOD>";
    let text = document(&data_object(U8, program), &service());
    assert_eq!(
        read_text(&text).unwrap().issues[0].to_string(),
        "a.odx-d:4: d: the conversion COMPUCODE is not evaluated"
    );
    let read = reading(&text, &[0x62, 1, 2]);
    assert_eq!(
        (&read.values[2].value, read.values[2].note.as_deref()),
        (&Physical::Int(2), Some("its conversion COMPUCODE is not evaluated"))
    );
    // A root of another kind, and one without any layer.
    assert_eq!(read_text("<CATALOG/>").unwrap_err(), OdxError::NoLayer);
}

#[test]
fn decimal_digits_are_numbers() {
    let coded = |encoding: &str| {
        let coded = U8
            .replace("xsi:type", &format!("BASE-TYPE-ENCODING=\"{encoding}\" xsi:type"))
            .replace(">8<", ">16<");
        document(&data_object(&coded, ""), &service())
    };
    for (encoding, bytes, expected) in
        [("BCD-P", [0x12, 0x34], Some(1234)), ("BCD-UP", [0x01, 0x09], Some(19)), ("BCD-P", [0x1A, 0], None)]
    {
        let read = reading(&coded(encoding), &[0x62, 1, bytes[0], bytes[1]]);
        assert_eq!(
            read.values.get(2).map(|value| value.value.clone()),
            expected.map(Physical::Int),
            "{encoding}"
        );
    }
}

/// Circles of structures and of layers end.
#[test]
fn circles_end() {
    let structure = "<STRUCTURES><STRUCTURE ID=\"d\"><SHORT-NAME>d</SHORT-NAME><PARAMS><PARAM xsi:type=\"VALUE\"><SHORT-NAME>x</SHORT-NAME><DOP-REF ID-REF=\"d\"/>\
                     </PARAM></PARAMS></STRUCTURE></STRUCTURES>";
    let read = reading(&document(structure, &service()), &[0x62, 1, 2]);
    assert!(matches!(&read.stop, Some((_, Stop::NotEvaluated(_)))), "{read:?}");
    let field = "<END-OF-PDU-FIELDS><END-OF-PDU-FIELD ID=\"d\"><SHORT-NAME>d</SHORT-NAME><BASIC-STRUCTURE-REF ID-REF=\"d\"/></END-OF-PDU-FIELD></END-OF-PDU-FIELDS>";
    assert!(reading(&document(field, &service()), &[0x62, 1, 2]).stop.is_some());
    let empty = "<STRUCTURES><STRUCTURE ID=\"e\"><SHORT-NAME>e</SHORT-NAME></STRUCTURE></STRUCTURES><END-OF-PDU-FIELDS><END-OF-PDU-FIELD ID=\"d\"><SHORT-NAME>d</SHORT-NAME>\
                 <BASIC-STRUCTURE-REF ID-REF=\"e\"/></END-OF-PDU-FIELD></END-OF-PDU-FIELDS>";
    assert!(reading(&document(empty, &service()), &[0x62, 1, 2]).stop.is_some());
    let parent = "<PARENT-REFS><PARENT-REF ID-REF=\"b\" xsi:type=\"BASE-VARIANT-REF\"/></PARENT-REFS>";
    let odx = read_text(&document(&data_object(U8, ""), &(service() + parent))).unwrap();
    assert_eq!(odx.ecu("ECU").unwrap().service_count(), 1);
}

/// Each layer has ten parents among the next ones: as many ways as no computer can go, but few layers.
#[test]
fn many_ways_of_inheritance_are_gone_once() {
    let layer = |number: u32| {
        let parents = (number + 1..(number + 11).min(15))
            .map(|parent| format!("<PARENT-REF ID-REF=\"l{parent}\" xsi:type=\"BASE-VARIANT-REF\"/>"))
            .collect::<Vec<_>>()
            .concat();
        format!(
            "<BASE-VARIANT ID=\"l{number}\"><SHORT-NAME>L{number}</SHORT-NAME><PARENT-REFS>{parents}</PARENT-REFS></BASE-VARIANT>"
        )
    };
    let layers: String = (0..15).map(layer).collect();
    let text = format!(
        "<ODX MODEL-VERSION=\"2.2.0\" xmlns:xsi=\"x\"><DIAG-LAYER-CONTAINER><SHORT-NAME>c</SHORT-NAME><BASE-VARIANTS>{layers}</BASE-VARIANTS></DIAG-LAYER-CONTAINER></ODX>"
    );
    assert!(read_text(&text).unwrap().ecu("L0").is_ok());
    let chain: String =
        (0..40).map(|number| layer(number).replace(&format!("l{}\"", number + 2), "none\"")).collect();
    let _ = read_text(&text.replace(&layers, &chain)).unwrap().ecu("L0");
}

#[test]
fn damaged_packages_are_errors() {
    for length in (0..SOMERSAULT.len()).step_by(211) {
        let error = Odx::read("cut.pdx", &SOMERSAULT[..length]).unwrap_err();
        assert!(!error.to_string().is_empty());
    }
    let package = archive(&[("index.xml", b"<CATALOG/>")]);
    assert!(Odx::read("a.pdx", &package).unwrap_err().to_string().contains("no .odx document"));
    let whole = archive(&[("a.odx-d", document(&data_object(U8, ""), &service()).as_bytes())]);
    assert!(Odx::read("a.pdx", &whole).is_ok());
    // What unpacks to more than is read.
    let bomb = archive(&[("a.odx-d", &vec![b' '; 4 << 20]), ("b.odx-d", &vec![b' '; 4 << 20])]);
    assert!(bomb.len() < 20_000);
    assert_eq!(package::each("bomb.pdx", &bomb, 6 << 20, |_, _| Ok(())), Err(OdxError::TooLarge));
}

#[test]
fn entities_do_not_explode() {
    let mut entities = "<!ENTITY a0 \"aaaaaaaaaa\">".to_owned();
    for at in 1..12 {
        let before = format!("&a{};", at - 1).repeat(10);
        write!(entities, "<!ENTITY a{at} \"{before}\">").unwrap();
    }
    let text = format!("<!DOCTYPE ODX [{entities}]>{}", document("", "&a11;"));
    assert!(matches!(read_text(&text), Err(OdxError::Xml { .. })));
    // Elements in elements, deeper than any stack.
    let deep = document("", &("<A>".repeat(200_000) + &"</A>".repeat(200_000)));
    let _ = read_text(&deep);
}

/// Documents of some kilobytes that come to more than any computer does: each of them took hours.
#[test]
fn documents_of_strangers_are_read_in_a_time_that_grows_with_them() {
    // One entity, often.
    let entity = format!("<!DOCTYPE ODX [<!ENTITY a \"{}\">]>", "a".repeat(100_000));
    let text = format!("{entity}{}", document("", &format!("<DESC>{}</DESC>", "&a;".repeat(100_000))));
    assert!(matches!(read_text(&text), Err(OdxError::Xml { .. })));
    // Structures in structures, of which the innermost has nothing in it.
    let param = |of: u32, at: u32| {
        format!("<PARAM xsi:type=\"VALUE\"><SHORT-NAME>p{at}</SHORT-NAME><DOP-REF ID-REF=\"s{of}\"/></PARAM>")
    };
    let structure = |id: &str, params: String| {
        format!("<STRUCTURE ID=\"{id}\"><SHORT-NAME>{id}</SHORT-NAME><PARAMS>{params}</PARAMS></STRUCTURE>")
    };
    let params = |of: u32| (0..30).map(|at| param(of, at)).collect::<String>();
    let inner: String = (1..12).map(|at| structure(&format!("s{at}"), params(at + 1))).collect();
    let all = structure("d", params(1)) + &inner + &structure("s12", String::new());
    let read = reading(&document(&format!("<STRUCTURES>{all}</STRUCTURES>"), &service()), &[0x62, 1, 2]);
    assert!(matches!(&read.stop, Some((_, Stop::NotEvaluated(_)))), "{:?}", read.stop);
    // Types of trouble codes that include each other, thirty times each.
    let linked =
        |to: u32| format!("<LINKED-DTC-DOP><DTC-DOP-REF ID-REF=\"d{to}\"/></LINKED-DTC-DOP>").repeat(30);
    let codes = |at: u32| {
        format!(
            "<DTC-DOP ID=\"d{at}\"><SHORT-NAME>d{at}</SHORT-NAME>{U8}<DTCS><DTC><SHORT-NAME>c{at}</SHORT-NAME><TROUBLE-CODE>{at}</TROUBLE-CODE></DTC></DTCS>\
             <LINKED-DTC-DOPS>{}</LINKED-DTC-DOPS></DTC-DOP>",
            linked((at + 1) % 16)
        )
    };
    let all: String = (0..16).map(codes).collect();
    let odx =
        read_text(&document(&format!("<DTC-DOPS>{all}</DTC-DOPS>"), &service().replace("\"d\"", "\"d3\"")))
            .unwrap();
    let ecu = odx.ecu("ECU").unwrap();
    assert_eq!((ecu.trouble_codes().len(), ecu.trouble_code(9).as_deref()), (16, Some("c9")));
    let response = ecu.describe(Some(&[0x22, 1]), Some(&[0x62, 1, 1])).unwrap().response.unwrap();
    let shown = &response.values.last().unwrap().value;
    assert!(
        matches!(shown, Physical::Meaning(_, text) if text == "c1"),
        "a code of a type that is included: {shown:?}"
    );
}

#[test]
fn encodings_are_those_that_are_declared() {
    let text = |declaration: &str| {
        format!("{declaration}{}", document(&data_object(U8, ""), &service()).replace("Read", "Rüad"))
    };
    let latin: Vec<u8> =
        text("<?xml version=\"1.0\" encoding=\"ISO-8859-1\"?>").chars().map(|letter| letter as u8).collect();
    let name = |bytes: &[u8]| {
        Odx::read("a.odx-d", bytes).map(|odx| odx.ecu("ECU").unwrap().requests()[0].name.clone())
    };
    assert_eq!(name(&latin), Ok("Rüad".to_owned()));
    let utf16: Vec<u8> =
        std::iter::once(0xFEFF).chain(text("").encode_utf16()).flat_map(u16::to_le_bytes).collect();
    assert_eq!(name(&utf16), Ok("Rüad".to_owned()));
    let wrong: Vec<u8> =
        text("<?xml version=\"1.0\" encoding=\"UTF-8\"?>").chars().map(|letter| letter as u8).collect();
    assert_eq!(
        name(&wrong).unwrap_err().to_string(),
        "a.odx-d is not in its encoding, UTF-8; save it in UTF-8"
    );
    let unknown = text("<?xml version=\"1.0\" encoding=\"EBCDIC-9\"?>");
    assert!(matches!(name(unknown.as_bytes()), Err(OdxError::Encoding { .. })));
}

/// What a terminal would obey does not come out of a file.
#[test]
fn names_are_cleaned() {
    let text = document(&data_object(U8, ""), &service()).replace(">Read<", ">Re\u{9b}2Jad<");
    assert!(!read_text(&text).unwrap().ecu("ECU").unwrap().requests()[0].name.contains('\u{9b}'));
}

/// Vector's own kind of description, in a form made for this.
#[test]
fn a_cdd_is_read_like_a_document_of_odx() {
    let odx = Odx::read("small.cdd", include_bytes!("../../tests/data/small.cdd")).unwrap();
    let layers: Vec<_> = odx.layers().map(|(kind, name)| (kind.name(), name)).collect();
    assert_eq!(layers, [("base-variant", "Base"), ("ecu-variant", "Sport")]);
    let issues: Vec<_> = odx.issues.iter().map(|issue| issue.what.as_str()).collect();
    assert_eq!(
        issues,
        ["a type of the kind MUXDT is not evaluated", "a service whose template is not in the file"]
    );
    // A variant has what its base has.
    let ecu = odx.ecu("Sport").unwrap();
    assert_eq!(ecu.pairs().iter().map(ToString::to_string).collect::<Vec<_>>(), ["700:708"]);
    assert_eq!(ecu.trouble_code(0x12_3456).as_deref(), Some("Voltage too low"));
    let names: Vec<_> = ecu.requests().into_iter().map(|request| (request.name, request.bytes)).collect();
    let wanted = [
        ("Codes_Read", vec![0x19]),
        ("Supply_Read", vec![0x22, 0xF1, 0x90]),
        ("Voltage_Read", vec![0x22, 0, 1]),
    ];
    assert_eq!(names, wanted.map(|(name, bytes)| (name.to_owned(), bytes)));
    let values = |request: &[u8], response: &[u8]| {
        let reading = ecu.describe(Some(request), Some(response)).unwrap().response.unwrap();
        let values = reading.values.iter().filter(|decoded| !decoded.is_constant);
        let values: Vec<_> = values.map(|one| format!("{} {:?}{}", one.path, one.value, one.unit)).collect();
        (values, reading.undescribed, reading.stop.map(|(place, _)| place))
    };
    let response = [0x62, 0xF1, 0x90, 0xA0, b'a', b'b', b'c', 0xFE, 0xFF, 2, 0x11, 0x22, 0x33];
    let (all, rest, stop) = values(&[0x22, 0xF1, 0x90], &response);
    assert_eq!(
        all,
        [
            "State Meaning(Int(0), \"off\")",
            "Name Text(\"abc\")",
            "Shared Int(-2)",
            "Bytes Bytes([17, 34])",
            "Rest Bytes([51])",
        ]
    );
    assert_eq!((rest, stop), (Vec::new(), None));
    // Twelve bits, and what a description of them leaves open.
    let (all, ..) = values(&[0x22, 0, 1], &[0x62, 0, 1, 0x00, 0x18, 7]);
    assert_eq!(all, ["U Real(1.0)V", "S Meaning(Int(1), \"on\")"]);
    let (_, _, stop) = values(&[0x19], &[0x59, 1, 2, 3]);
    assert!(stop.is_some());
}
