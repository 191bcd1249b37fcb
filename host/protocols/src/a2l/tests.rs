//! A2lDescriptions as tools write them.

use super::*;

/// An ECU with one value of each kind.
const ECU: &str = r#"
ASAP2_VERSION 1 61
/begin PROJECT Demo ""
/begin MODULE Ecu ""
/begin MOD_COMMON "" BYTE_ORDER MSB_LAST /end MOD_COMMON
/begin IF_DATA XCP
  /begin DAQ DYNAMIC 0 2 0 OPTIMISATION_TYPE_DEFAULT ADDRESS_EXTENSION_FREE IDENTIFICATION_FIELD_TYPE_ABSOLUTE
    GRANULARITY_ODT_ENTRY_SIZE_DAQ_BYTE 7 NO_OVERLOAD_INDICATION
    /begin EVENT "10 ms" "10ms" 1 DAQ 0xFF 10 6 0 /end EVENT
    /begin EVENT "on change" "change" 2 DAQ 0xFF 0 0 0 /end EVENT
  /end DAQ
  /begin XCP_ON_CAN 0x0100 CAN_ID_MASTER 0x7F0 CAN_ID_SLAVE 0x98FF0002 BAUDRATE 500000 /end XCP_ON_CAN
/end IF_DATA
/begin IF_DATA ASAP1B_CCP
  /begin TP_BLOB 0x201 0x202 0x700 0x701 0x39 1 BAUDRATE 500000 /end TP_BLOB
/end IF_DATA
/begin IF_DATA Maker unknown 1.5 "form" /begin Block 3 /end Block /end IF_DATA
/begin MEASUREMENT Speed "engine" UWORD Rpm 1 0 0 8000 ECU_ADDRESS 0x20000000 /end MEASUREMENT
/begin MEASUREMENT Gear "" UBYTE Gears 1 0 0 8 ECU_ADDRESS 0x20000002 /end MEASUREMENT
/begin MEASUREMENT Fan "" UBYTE NO_COMPU_METHOD 1 0 0 1 BIT_MASK 0x2 ECU_ADDRESS 0x20000003 /end MEASUREMENT
/begin MEASUREMENT Lamp "" UBYTE OnOff 1 0 0 1 BIT_MASK 0x4 ECU_ADDRESS 0x20000003 /end MEASUREMENT
/begin MEASUREMENT Power "" FLOAT32_IEEE NO_COMPU_METHOD 1 0 0 1e3 BYTE_ORDER MSB_FIRST ECU_ADDRESS 0x20000004 PHYS_UNIT "kW" /end MEASUREMENT
/begin MEASUREMENT Array "" SWORD NO_COMPU_METHOD 1 0 0 1 MATRIX_DIM 3 1 1 ECU_ADDRESS 0x20000010 /end MEASUREMENT
/begin MEASUREMENT Odd "" UBYTE Formula 1 0 0 1 ECU_ADDRESS 0x20000020 /end MEASUREMENT
/begin MEASUREMENT Pressure "" UBYTE Half 1 0 0 200 ECU_ADDRESS 0x20000030 /end MEASUREMENT
/begin MEASUREMENT Curved "" UBYTE Curve 1 0 0 1 ECU_ADDRESS 0x20000021 /end MEASUREMENT
/begin CHARACTERISTIC Idle "" VALUE 0x30000000 Word 0 Rpm 500 1500 /end CHARACTERISTIC
/begin CHARACTERISTIC Name "" ASCII 0x30000010 Byte 0 NO_COMPU_METHOD 0 255 NUMBER 8 /end CHARACTERISTIC
/begin CHARACTERISTIC Map "" MAP 0x30000020 Word 0 Rpm 0 1
  /begin AXIS_DESCR STD_AXIS NO_INPUT_QUANTITY Rpm 2 0 8000 DEPOSIT DIFFERENCE /end AXIS_DESCR /end CHARACTERISTIC
/begin RECORD_LAYOUT Word FNC_VALUES 1 UWORD ROW_DIR DIRECT /end RECORD_LAYOUT
/begin RECORD_LAYOUT Byte FNC_VALUES 1 UBYTE ROW_DIR DIRECT /end RECORD_LAYOUT
/begin COMPU_METHOD Rpm "" RAT_FUNC "%8.2" "rpm" COEFFS 0 4 0 0 0 1 /end COMPU_METHOD
/begin COMPU_METHOD Gears "" TAB_VERB "%2.0" "" COMPU_TAB_REF GearTexts /end COMPU_METHOD
/begin COMPU_METHOD OnOff "" TAB_VERB "%2.0" "" COMPU_TAB_REF OnOffTexts /end COMPU_METHOD
/begin COMPU_METHOD Formula "" FORM "%2.0" "" /begin FORMULA "X1^2" /end FORMULA /end COMPU_METHOD
/begin COMPU_METHOD Half "" FORM "%2.1" "bar" /begin FORMULA "X1 / 2 + 1" FORMULA_INV "(X1 - 1) * 2" /end FORMULA /end COMPU_METHOD
/begin COMPU_METHOD Curve "" TAB_INTP "%2.0" "V" COMPU_TAB_REF Points /end COMPU_METHOD
/begin COMPU_TAB Points "" TAB_INTP 2 0 0.0 100 5.0 /end COMPU_TAB
/begin COMPU_VTAB GearTexts "" TAB_VERB 2 0 "neutral" 1 "first" DEFAULT_VALUE "?" /end COMPU_VTAB
/begin COMPU_VTAB_RANGE OnOffTexts "" 2 0 0 "off" 1 3 "on" /end COMPU_VTAB_RANGE
/end MODULE
/end PROJECT
"#;

fn ecu() -> Description {
    Description::parse(ECU).unwrap().remove(0)
}

fn fields(address: u32, bytes: &[u8]) -> Vec<String> {
    ecu().fields(0, address, bytes, None).iter().map(ToString::to_string).collect()
}

#[test]
fn what_is_in_the_memory_has_names_units_and_texts() {
    let bytes = [0x40, 0x1F, 1, 6, 0x42, 0x28, 0, 0];
    let expected = ["Speed 2000 rpm", "Gear 1 (first)", "Fan 1", "Lamp 1 (on)", "Power 42 kW"];
    assert_eq!(fields(0x2000_0000, &bytes), expected);
    assert_eq!(fields(0x2000_0012, &[0xFE, 0xFF, 1]), ["Array[1] -2"]);
    assert_eq!(
        fields(0x2000_0020, &[7, 50]),
        ["Odd 7 (as stored; its conversion is not evaluated)", "Curved 2.5 V"]
    );
    assert_eq!(fields(0x2000_0030, &[7]), ["Pressure 4.5 bar"]);
    assert_eq!(ecu().object("Pressure").unwrap().conversion.number(4.5), Some(7.0));
    assert_eq!(fields(0x3000_0010, b"demo\0\0\0\0"), ["Name \"demo\""]);
    assert_eq!(fields(0x3000_0010, b"demo"), [""; 0], "not all of it");
    assert_eq!(fields(0xFFFF_FFFF, &[1, 2, 3]), [""; 0]);
}

#[test]
fn an_entry_of_a_list_is_the_value_of_its_size() {
    let ecu = ecu();
    let of = |bytes: &[u8]| {
        let fields = ecu.entry_fields(0, 0x2000_0000, bytes, None);
        fields.iter().map(|field| field.name.to_string()).collect::<Vec<_>>()
    };
    assert_eq!(of(&[0, 0]), ["Speed"]);
    assert_eq!(of(&[0, 0, 1, 1]), ["Speed", "Gear", "Fan", "Lamp"]);
}

#[test]
fn the_connection_stands_in_if_data() {
    let ecu = ecu();
    assert_eq!(ecu.xcp().unwrap().to_string(), "7F0:18FF0002");
    assert_eq!(ecu.ccp().unwrap().to_string(), "700:701");
    assert_eq!((ecu.station(), ecu.ccp_order()), (0x39, Some(ByteOrder::Big)));
    let events: Vec<_> = ecu.events().iter().map(|event| (event.number, event.name.as_str())).collect();
    assert_eq!(events, [(1, "10 ms"), (2, "on change")]);
    assert_eq!(ecu.events()[0].period_s.map(|period| (period * 1e6).round()), Some(10_000.0));
    assert_eq!(ecu.events()[1].period_s, None);
}

#[test]
fn what_is_left_out_is_listed() {
    let issues = ecu().issues;
    let expected = [
        "Odd: the formula of Formula is not evaluated",
        "Map: the points of an axis are stored as differences",
    ];
    assert_eq!(issues, expected);
}

/// Files as they are, are not refused for what is beside the matter.
#[test]
fn a_wrong_grammar_of_if_data_or_a_missing_file_is_no_obstacle() {
    let wrong =
        ECU.replace("/begin MOD_COMMON", "/begin A2ML this is no grammar /end A2ML /begin MOD_COMMON");
    assert_eq!(Description::parse(&wrong).unwrap()[0].objects().len(), ecu().objects().len());
    let including = ECU.replace("/begin MOD_COMMON", "/include \"none.aml\" /begin MOD_COMMON");
    let description = Description::parse(&including).unwrap().remove(0);
    assert_eq!(description.objects().len(), ecu().objects().len());
    assert_eq!(description.issues[0], "none.aml, which it includes, is left out");
    let (head, module) = ECU.split_once("/begin MEASUREMENT").unwrap();
    let (measured, tail) = module.split_once("/begin CHARACTERISTIC").unwrap();
    let measured = format!("/begin MEASUREMENT{measured}");
    let split = format!("{head} /include \"measured.a2l\" /begin CHARACTERISTIC{tail}");
    let mut include = |name: &str| (name == "measured.a2l").then(|| measured.clone().into_bytes());
    let description = Description::read(split.as_bytes(), &mut include).unwrap().remove(0);
    assert_eq!(description.objects().len(), ecu().objects().len());
    let endless = Description::read(split.as_bytes(), &mut |_| Some(b"/include again".to_vec()));
    assert!(endless.is_ok_and(|all| all[0].issues[0].contains("again")));
    let named = ECU.replace("PROJECT Demo", "PROJECT Demo-2");
    assert_eq!(Description::parse(&named).unwrap()[0].objects().len(), ecu().objects().len());
    let (_, module) = ECU.split_once("/begin MODULE Ecu \"\"").unwrap();
    let (module, _) = module.split_once("/end MODULE").unwrap();
    assert_eq!(Description::parse(module).unwrap()[0].objects().len(), ecu().objects().len());
    assert!(Description::parse("").is_err() && Description::parse("no A2L at all").is_err());
}

#[test]
fn a_description_is_that_of_its_identifiers() {
    let all = A2lDescriptions::new(vec![ecu().into()]);
    assert!(all.of("7F0:18FF0002".parse().unwrap()).is_some());
    assert!(all.of("7F0:7F1".parse().unwrap()).is_none());
    let bare =
        Description::parse(&ECU.replace("XCP_ON_CAN", "XCP_ON_TCP").replace("TP_BLOB", "BLOB")).unwrap();
    let all = A2lDescriptions::new(bare.into_iter().map(Into::into).collect());
    assert!(all.of("7F0:7F1".parse().unwrap()).is_some(), "the only one, which says nothing else");
}

/// A file of two million such lines took hours, and each looked at all that came behind it.
#[test]
fn what_includes_without_end_is_read_in_a_time_that_grows_with_it() {
    let many = format!("{ECU}{}", "/include x\n".repeat(200_000));
    assert_eq!(Description::parse(&many).unwrap()[0].objects().len(), ecu().objects().len());
    // The two parts of a word are not joined to another one, which the parser would follow by itself.
    let (begin, end) = "/include".split_at(3);
    let split = ECU
        .replace("/begin MOD_COMMON", &format!("{begin}/include \"\"{end} \"/dev/zero\" /begin MOD_COMMON"));
    assert!(Description::parse(&split).is_err());
}

#[test]
fn blocks_in_blocks_and_types_in_types_do_not_use_up_the_stack() {
    let deep = ECU.replace(
        "/begin IF_DATA Maker",
        &format!("{}/begin IF_DATA Maker", "/begin IF_DATA X ".repeat(200_000)),
    );
    assert_eq!(Description::parse(&deep).unwrap_err(), A2lError::TooDeep);
    let twice = |at| format!("struct a{at} {{ struct a{0}; struct a{0}; }};", at - 1);
    let doubled = (1..40).map(twice).collect::<Vec<_>>().concat();
    for grammar in [format!("struct a0 {{ uchar; }}; {doubled}"), "struct { ".repeat(200_000)] {
        let text =
            ECU.replace("/begin MOD_COMMON", &format!("/begin A2ML {grammar} /end A2ML /begin MOD_COMMON"));
        let description = Description::parse(&text).unwrap().remove(0);
        assert!(
            description.issues[0].contains("A2ML") && description.xcp() == ecu().xcp(),
            "{:?}",
            description.issues
        );
    }
}
