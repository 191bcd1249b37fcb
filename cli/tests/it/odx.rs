//! `--odx`: names and values by the description of an ECU.

use std::fs;
use std::path::{Path, PathBuf};

use crate::in_folder::cantap;

/// An ECU at 7E0:7E8 with one identifier.
const CAR: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<ODX MODEL-VERSION="2.2.0" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
<DIAG-LAYER-CONTAINER ID="car"><SHORT-NAME>car</SHORT-NAME><BASE-VARIANTS><BASE-VARIANT ID="engine"><SHORT-NAME>Engine</SHORT-NAME>
<DIAG-DATA-DICTIONARY-SPEC><DATA-OBJECT-PROPS><DATA-OBJECT-PROP ID="text"><SHORT-NAME>text</SHORT-NAME>
<DIAG-CODED-TYPE BASE-DATA-TYPE="A_ASCIISTRING" xsi:type="STANDARD-LENGTH-TYPE"><BIT-LENGTH>136</BIT-LENGTH></DIAG-CODED-TYPE>
<PHYSICAL-TYPE BASE-DATA-TYPE="A_UNICODE2STRING"/></DATA-OBJECT-PROP></DATA-OBJECT-PROPS></DIAG-DATA-DICTIONARY-SPEC>
<DIAG-COMMS><DIAG-SERVICE ID="read"><SHORT-NAME>Vehicle_Identification_Read</SHORT-NAME><LONG-NAME>Vehicle identification</LONG-NAME>
<REQUEST-REF ID-REF="rq"/><POS-RESPONSE-REFS><POS-RESPONSE-REF ID-REF="pr"/></POS-RESPONSE-REFS></DIAG-SERVICE></DIAG-COMMS>
<REQUESTS><REQUEST ID="rq"><PARAMS>
<PARAM xsi:type="CODED-CONST"><SHORT-NAME>SID</SHORT-NAME><BYTE-POSITION>0</BYTE-POSITION><CODED-VALUE>34</CODED-VALUE>
<DIAG-CODED-TYPE BASE-DATA-TYPE="A_UINT32" xsi:type="STANDARD-LENGTH-TYPE"><BIT-LENGTH>8</BIT-LENGTH></DIAG-CODED-TYPE></PARAM>
<PARAM xsi:type="CODED-CONST"><SHORT-NAME>DID</SHORT-NAME><BYTE-POSITION>1</BYTE-POSITION><CODED-VALUE>61840</CODED-VALUE>
<DIAG-CODED-TYPE BASE-DATA-TYPE="A_UINT32" xsi:type="STANDARD-LENGTH-TYPE"><BIT-LENGTH>16</BIT-LENGTH></DIAG-CODED-TYPE></PARAM>
</PARAMS></REQUEST></REQUESTS>
<POS-RESPONSES><POS-RESPONSE ID="pr"><PARAMS>
<PARAM xsi:type="CODED-CONST"><SHORT-NAME>SID</SHORT-NAME><BYTE-POSITION>0</BYTE-POSITION><CODED-VALUE>98</CODED-VALUE>
<DIAG-CODED-TYPE BASE-DATA-TYPE="A_UINT32" xsi:type="STANDARD-LENGTH-TYPE"><BIT-LENGTH>8</BIT-LENGTH></DIAG-CODED-TYPE></PARAM>
<PARAM xsi:type="MATCHING-REQUEST-PARAM"><SHORT-NAME>DID</SHORT-NAME><BYTE-POSITION>1</BYTE-POSITION><REQUEST-BYTE-POS>1</REQUEST-BYTE-POS>
<BYTE-LENGTH>2</BYTE-LENGTH></PARAM>
<PARAM xsi:type="VALUE"><SHORT-NAME>Vehicle_Identification</SHORT-NAME><BYTE-POSITION>3</BYTE-POSITION><DOP-REF ID-REF="text"/></PARAM>
</PARAMS></POS-RESPONSE></POS-RESPONSES>
<COMPARAM-REFS><COMPARAM-REF ID-REF="ISO_15765_2.CP_CanPhysReqId" DOCREF="ISO_15765_2"><SIMPLE-VALUE>2016</SIMPLE-VALUE></COMPARAM-REF>
<COMPARAM-REF ID-REF="ISO_15765_2.CP_CanRespUSDTId" DOCREF="ISO_15765_2"><SIMPLE-VALUE>2024</SIMPLE-VALUE></COMPARAM-REF></COMPARAM-REFS>
</BASE-VARIANT></BASE-VARIANTS></DIAG-LAYER-CONTAINER></ODX>
"#;

fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("odx").join(test);
    fs::create_dir_all(&directory).unwrap();
    fs::write(directory.join("car.odx-d"), CAR).unwrap();
    let talk = "(1.000000) can0 7E0#0322F190\n(1.002500) can0 7E8#101462F190575657\n(1.003000) can0 7E0#300000\n\
                (1.004000) can0 7E8#215A5A5A314B5A41\n(1.005000) can0 7E8#2257303030303031\n";
    fs::write(directory.join("talk.log"), talk).unwrap();
    directory
}

#[test]
fn a_trace_has_the_names_and_values_of_the_description() {
    let directory = directory("trace");
    let (code, out, err) = cantap(&directory, "conversations talk.log --odx car.odx-d --quiet");
    assert_eq!((code, &*err), (Some(0), ""));
    assert_eq!(
        out,
        "(1.005000) can0 uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, ecu \"Engine\", service \"Vehicle_Identification_Read\" (Vehicle identification), \
         did 0xF190 (VIN), Vehicle_Identification \"WVWZZZ1KZAW000001\", after 2.5 ms\n"
    );
    let (_, out, _) = cantap(
        &directory,
        "search talk.log uds.vehicle_identification==WVWZZZ1KZAW000001 --odx car.odx-d --count",
    );
    assert_eq!(out.trim(), "1");
    let (code, _, err) = cantap(&directory, "conversations talk.log --odx car.odx-d:Gearbox");
    assert_eq!(code, Some(1));
    assert!(err.contains("there is no layer Gearbox in it; there are: Engine"), "{err}");
    fs::write(directory.join("cut.odx-d"), &CAR[..900]).unwrap();
    let (code, _, err) = cantap(&directory, "conversations talk.log --odx cut.odx-d");
    assert_eq!(code, Some(1));
    assert!(err.contains("cut.odx-d is not XML"), "{err}");
}

#[test]
fn an_ecu_is_asked_by_name() {
    let directory = directory("asked");
    let (code, out, err) =
        cantap(&directory, "uds -d virtual:car --odx car.odx-d read Vehicle_Identification");
    assert_eq!(code, Some(0), "{err}");
    assert!(
        out.contains("ecu \"Engine\"") && out.contains("Vehicle_Identification \"WCTCANTA4P0000001\""),
        "{out}"
    );
    let (code, _, err) = cantap(&directory, "uds -d virtual:car --odx car.odx-d read Vehicle");
    assert_eq!(code, Some(2));
    assert!(
        err.contains(
            "Vehicle is not the name of a request 22 of Engine; there are: Vehicle_Identification_Read"
        ),
        "{err}"
    );
    let (code, _, err) = cantap(&directory, "uds -d virtual:car read Vehicle_Identification");
    assert_eq!(code, Some(2));
    assert!(err.contains("--odx"), "{err}");
    let (code, _, err) = cantap(&directory, "uds -d virtual:car --pair 7E1:7E9 --odx car.odx-d read F190");
    assert_eq!(code, Some(2));
    assert!(err.contains("no ECU of --odx has 7E1:7E9"), "{err}");
}

#[test]
fn a_description_is_listed() {
    let directory = directory("listed");
    let (code, out, err) = cantap(&directory, "db car.odx-d");
    assert_eq!((code, &*err), (Some(0), ""));
    assert_eq!(
        out,
        "car.odx-d: 1 layer\n\nbase-variant Engine, 7E0:7E8: 1 service\n  22 F1 90     Vehicle_Identification_Read Vehicle identification\n"
    );
    fs::write(directory.join("odd.odx-d"), CAR.replace("ID-REF=\"text\"", "ID-REF=\"gone\"")).unwrap();
    let (_, out, _) = cantap(&directory, "db odd.odx-d --warnings");
    assert_eq!(out, "odd.odx-d:20: gone is not in this file\n");
    let (code, _, err) = cantap(&directory, "db car.odx-d --message *");
    assert_eq!(code, Some(2), "{err}");
}
