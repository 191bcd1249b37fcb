//! What protocols say of a trace, with descriptions and without.

use serde_json::{Value, json};

use crate::page::{DBC, Page};

/// A node of DroneCAN says something of its maker's, and a master measures by XCP: bytes, until somebody describes them.
#[test]
fn conversations_are_read_by_descriptions() {
    let lines = (1..=9).map(|second| {
        format!(
            "({second}.000000) can0 1001550A#0{second}0000008C0000C{second}\n({second}.100000) can0 1051FF0A#2AC{second}\n\
             ({second}.200000) can1 7F0#FF00\n({second}.200500) can1 7F1#FF05C00808000101\n\
             ({second}.300000) can1 7F0#F402000000000020\n({second}.300500) can1 7F1#FF800C\n"
        )
    });
    let mut page = Page::default();
    page.open("bench.log", lines.collect::<String>().as_bytes()).unwrap();
    let texts = |page: &mut Page| {
        let found = page.ask("conversations", json!({ "from": null, "to": null, "limit": 1000 }));
        let texts: Vec<_> =
            found["events"].as_array().unwrap().iter().map(|event| event["text"].to_string()).collect();
        texts.join("\n")
    };
    let before = texts(&mut page);
    assert!(before.contains("data type 20991") && !before.contains("EngineSpeed"), "{before}");
    let loaded = page.database("own/20991.Gear.uavcan", "uint8 gear_pct\n");
    assert_eq!((&loaded["messages"], &loaded["warnings"]), (&json!(1), &json!([])));
    let loaded = page.database("ecu.a2l", cantap_virtual::ecu::DESCRIPTION);
    assert!(loaded["messages"].as_u64().unwrap() > 3, "{loaded}");
    let after = texts(&mut page);
    assert!(after.contains("own.Gear") && after.contains("gear_pct 42"), "{after}");
    assert!(after.contains("EngineSpeed 800 rpm"), "{after}");
    // The databases are as they were.
    assert_eq!(page.ask("messages", json!({})), json!([]));
    for (name, text) in [("x.a2l", "no A2L"), ("x.eds", "nothing"), ("x.cdd", "<x/>")] {
        let refused =
            page.try_ask("database", json!({ "name": name, "channel": null }), Some(text.as_bytes()));
        assert!(refused.unwrap_err().contains(name));
    }
}

/// A truck without a database, and a CANopen drive that is switched on.
fn field_bus() -> String {
    let mut frames = Vec::new();
    for n in 0..200 {
        let speed = (600 + n * 5) * 8;
        frames.push((n * 20, 0, format!("0CF00400#017DA0{:02X}{:02X}FFF0FF", speed & 0xFF, speed >> 8)));
    }
    for n in 0..43 {
        frames.push((n * 100 + 1, 1, if n < 20 { "705#7F" } else { "705#05" }.to_owned()));
    }
    // The statusword becomes the first TPDO.
    let mapped =
        ["605#23001A0110004160", "585#60001A0100000000", "605#2F001A0001000000", "585#60001A0000000000"];
    frames.extend((4100..).zip(mapped).map(|(ms, frame)| (ms, 1, frame.to_owned())));
    for (n, status) in (0..).zip(["4002", "3106", "3306", "3706", "3706", "0806"]) {
        frames.push((4200 + n * 10, 1, format!("185#{status}")));
    }
    frames.sort_by_key(|(ms, ..)| *ms);
    let line = |(ms, channel, frame): (i32, u8, String)| {
        format!("({:.6}) can{channel} {frame}\n", 1_700_000_000.0 + f64::from(ms) / 1000.0)
    };
    frames.into_iter().map(line).collect()
}

#[test]
fn what_protocols_name_is_drawn_without_a_database() {
    let mut page = Page::default();
    page.open("field.log", field_bus().as_bytes()).unwrap();
    let mut fields = Value::Null;
    // Some records at a time, as the page does it, so that other requests come between.
    for read in [100, 200, 253, 253] {
        fields = page.ask("fields", json!({ "records": 100 }));
        assert_eq!(fields["read"], read);
    }
    assert_eq!(fields["leftOut"], 0);
    let find = |name: &str| {
        let all = fields["fields"].as_array().unwrap();
        all.iter()
            .find(|field| field["name"] == name)
            .unwrap_or_else(|| panic!("no {name} in {fields}"))
            .clone()
    };
    let speed = find("j1939.engine_speed");
    assert_eq!((&speed["unit"], &speed["count"], &speed["texts"]), (&json!("rpm"), &json!(200), &json!([])));
    assert_eq!(
        (&speed["channel"], &speed["message"], &speed["between"]),
        (&json!(1), &json!("EEC1 engine"), &json!("0 > all"))
    );
    let picture = |from: Value, to: Value, columns: u32| json!({ "field": speed["key"], "from": from, "to": to, "columns": columns });
    assert_eq!(
        page.floats("fieldSeries", picture(json!(1.0), json!(1.039), 50), "min"),
        [845.0, 850.0, 855.0, 860.0]
    );
    let few = page.floats("fieldSeries", picture(Value::Null, Value::Null, 4), "max");
    assert_eq!((few.len(), few[3]), (4, 1595.0));
    let state = find("canopen.nmt_state");
    assert_eq!(
        state["texts"],
        json!([{ "value": 5.0, "text": "operational" }, { "value": 127.0, "text": "pre-operational" }])
    );
    let drive = find("canopen.drive_state");
    let all = json!({ "field": drive["key"], "from": null, "to": null, "columns": 50 });
    assert_eq!(page.floats("fieldSeries", all, "last"), [1.0, 2.0, 3.0, 4.0, 4.0, 7.0]);
    assert!(
        page.error("fieldSeries", json!({ "field": 9999, "from": null, "to": null, "columns": 5 }))
            .contains("signal")
    );
    // Another database may name them differently.
    page.database("car.dbc", DBC);
    assert_eq!(page.ask("fields", json!({ "records": 0 }))["fields"], json!([]));
}

#[test]
fn nodes_have_the_state_that_they_have_at_the_end_of_the_stretch() {
    let mut page = Page::default();
    page.open("field.log", field_bus().as_bytes()).unwrap();
    let mut node = |to: Value| {
        let nodes = page.ask("conversations", json!({ "from": null, "to": to, "limit": 10 }))["nodes"].take();
        nodes.as_array().unwrap().iter().find(|node| node["protocol"] == "canopen").unwrap().clone()
    };
    let early = node(json!(1.0));
    assert_eq!(
        (&early["node"], &early["state"], &early["drive"]),
        (&json!("5"), &json!("pre-operational"), &Value::Null)
    );
    let late = node(Value::Null);
    assert_eq!((&late["state"], &late["drive"]), (&json!("operational"), &json!("fault")));
    assert!((late["stateSince"].as_f64().unwrap() - 2.001).abs() < 1e-6, "{late}");
    assert!((late["driveSince"].as_f64().unwrap() - 4.25).abs() < 1e-6, "{late}");
}

/// Identifiers that nothing shows to be a pair: the master was connected before the trace begins.
#[test]
fn who_talks_to_whom_is_known_where_it_is_given() {
    let mut page = Page::default();
    let log = "(1.000000) can0 5A1#F40001000030402010\n(1.001000) can0 5A2#FF00\n(2.000000) can0 6A0#0322F190\n(2.100000) can0 6A1#037F2231\n";
    page.open("xcp.log", log.as_bytes()).unwrap();
    let protocols = |page: &mut Page| {
        let found = page.ask("conversations", json!({ "from": null, "to": null, "limit": 10 }));
        let all = found["events"].as_array().unwrap().iter();
        all.map(|event| event["protocol"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(protocols(&mut page), [""; 0]);
    let given = json!({ "pairs": ["6A0:6A1"], "xcp": ["5A1:5A2"], "ccp": [], "subjects": ["1620=uavcan.si.sample.voltage.Scalar.1.0"] });
    page.ask("connections", given.clone());
    assert_eq!(protocols(&mut page), ["xcp", "uds"]);
    let mut wrong = |key: &str, text: &str| {
        let mut given = given.clone();
        given[key] = json!([text]);
        page.error("connections", given)
    };
    assert!(wrong("pairs", "6A0").contains("7E0:7E8"));
    assert!(wrong("xcp", "x").starts_with("x: "));
    assert!(wrong("subjects", "1620=uavcan.Nothing.1.0").contains("uavcan.Nothing.1.0"));
}
