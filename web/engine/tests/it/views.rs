//! What the views ask of a trace that is open.

use serde_json::{Value, json};

use crate::page::{DBC, Page, log};

#[test]
fn a_trace_is_opened_and_its_rows_are_named_by_a_database() {
    let mut page = Page::default();
    let summary = page.open("drive.log", log().as_bytes()).unwrap();
    assert_eq!(
        (&summary["format"], &summary["frames"], &summary["records"]),
        (&json!("candump"), &json!(20), &json!(20))
    );
    assert_eq!((&summary["startUtcNs"], &summary["growing"]), (&json!("1700000000000000000"), &json!(false)));
    assert!((summary["duration"].as_f64().unwrap() - 0.091).abs() < 1e-9);
    assert_eq!(summary["channels"].as_array().unwrap().len(), 2);
    let loaded = page.database("car.dbc", DBC);
    assert_eq!(
        (&loaded["messages"], &loaded["signals"], &loaded["warnings"]),
        (&json!(1), &json!(2), &json!([]))
    );
    let rows = page.ask("rows", json!({ "view": 0, "from": 2, "count": 2 }));
    let row = &rows[0];
    assert_eq!(
        (&row["index"], &row["id"], &row["data"]),
        (&json!(2), &json!(0x123), &json!("0A00030000000000"))
    );
    assert_eq!(
        (&row["message"], &row["kind"], &row["channel"]),
        (&json!("Engine"), &json!("data"), &json!(1))
    );
    let signals = page.ask("decode", json!({ "index": 2 }));
    assert_eq!(signals[0], json!({ "name": "Speed", "value": 1.0, "text": "1", "unit": "km/h" }));
    assert_eq!((&signals[1]["text"], &signals[1]["value"]), (&json!("Drive"), &json!(3.0)));
}

#[test]
fn filters_and_searches_have_cantaps_grammar() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    page.database("car.dbc", DBC);
    for (filter, rows) in [
        ("123", 10),
        ("can1", 10),
        ("can1,7E8 can0,124", 10),
        ("Speed > 4", 5),
        ("dlc == 2 and ch == 2", 10),
        ("", 20),
    ] {
        let view = page.ask("filter", json!({ "filter": filter }));
        assert_eq!(view["rows"], rows, "{filter}");
        let rows = page.ask("rows", json!({ "view": view["view"], "from": 0, "count": 100 }));
        assert_eq!(rows.as_array().unwrap().len() as u64, view["rows"].as_u64().unwrap());
    }
    assert!(page.error("filter", json!({ "filter": "Sped > 4" })).contains("Speed"));
    assert!(page.error("filter", json!({ "filter": "12g" })).contains("'12g'"));
    let view = page.ask("filter", json!({ "filter": "123" }))["view"].clone();
    let mut find = |text: &str, from: i64, backwards: bool| {
        page.ask("find", json!({ "view": view, "text": text, "from": from, "backwards": backwards }))["row"]
            .clone()
    };
    assert_eq!(find("?? 00 03", -1, false), 0);
    assert_eq!(find("14 00", 0, false), 2);
    assert_eq!(find("14 00", 2, false), Value::Null);
    assert_eq!(find("14 00", 9, true), 2);
    assert_eq!(find("7E8", 0, false), Value::Null, "it is not in the view");
    assert_eq!(find("Speed > 8.5", 0, false), 9);
    assert_eq!(page.ask("rowAt", json!({ "view": view, "time": 0.0205 }))["row"], 3);
    assert!(page.error("rows", json!({ "view": 99, "from": 0, "count": 1 })).contains("filter again"));
}

#[test]
fn a_signal_over_time_and_one_that_no_database_has() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    page.database("car.dbc", DBC);
    let messages = page.ask("messages", json!({}));
    assert_eq!((&messages[0]["name"], &messages[0]["count"]), (&json!("Engine"), &json!(10)));
    assert_eq!(messages[0]["comment"], "</script><script>alert(1)</script>");
    let key = messages[0]["signals"][0]["key"].clone();
    let all = json!({ "signal": key, "from": null, "to": null, "columns": 100 });
    let speeds = page.floats("series", all.clone(), "first");
    assert_eq!(speeds, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
    assert_eq!(page.ask("series", all)["exact"], true);
    let some = json!({ "signal": key, "from": 0.025, "to": 0.045, "columns": 100 });
    assert_eq!(page.floats("series", some, "first"), [2.0, 3.0, 4.0, 5.0], "with the neighbours");
    let raw = json!({
        "channel": 2, "id": 0x7E8, "extended": false, "messageName": "Raw", "name": "raw", "startBit": 7, "bitLength": 16,
        "littleEndian": false, "signed": false, "factor": 2, "offset": 1, "unit": "", "texts": [], "from": null, "to": null, "columns": 3,
    });
    assert_eq!(page.floats("rawSeries", raw.clone(), "max"), [517.0, 517.0, 517.0]);
    let dbc = page.ask("editSignal", raw)["dbc"].as_str().unwrap().to_owned();
    assert!(dbc.contains("BO_ 2024 Raw: 8") && dbc.contains("SG_ raw : 7|16@0+ (2,1)"), "{dbc}");
    let rows = page.ask("rows", json!({ "view": 0, "from": 1, "count": 1 }));
    assert_eq!(rows[0]["message"], "Raw");
    page.ask("setOwnDatabase", json!({ "dbc": "" }));
    let rows = page.ask("rows", json!({ "view": 0, "from": 1, "count": 1 }));
    assert_eq!(rows[0]["message"], Value::Null);
}

/// A message of the user's own replaces that of a database, with all its signals.
#[test]
fn a_signal_drawn_into_a_known_message_leaves_the_others_there() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    page.database("car.dbc", DBC);
    let edit = json!({
        "channel": 1, "id": 0x123, "extended": false, "messageName": "Ignored", "name": "New", "startBit": 24, "bitLength": 8,
        "littleEndian": true, "signed": false, "factor": 1, "offset": 0, "unit": "", "texts": [],
    });
    page.ask("editSignal", edit);
    let names: Vec<_> = page
        .ask("decode", json!({ "index": 0 }))
        .as_array()
        .unwrap()
        .iter()
        .map(|one| one["name"].clone())
        .collect();
    assert_eq!(names, ["Speed", "Gear", "New"]);
}

#[test]
fn identifiers_bits_periods_and_load() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    let ids = page.ask("ids", json!({ "at": 0.0305 }));
    assert_eq!((&ids[0]["count"], &ids[0]["lastData"]), (&json!(4), &json!("1E00030000000000")));
    assert!((ids[0]["period"]["median"].as_f64().unwrap() - 0.01).abs() < 1e-6);
    let grid =
        page.ask("bits", json!({ "channel": 1, "id": 0x123, "extended": false, "from": null, "to": null }));
    assert_eq!((&grid["length"], &grid["frames"]), (&json!(8), &json!(10)));
    let periods = page.ask("periods", json!({ "channel": 1, "id": 0x123, "extended": false }));
    assert!((periods["mean"].as_f64().unwrap() - 0.01).abs() < 1e-6);
    let load = json!({ "channel": 1, "from": 0.0, "to": 0.09, "columns": 9 });
    assert!(
        page.floats("load", load.clone(), "load").iter().all(|load| load.is_nan()),
        "without a bit rate it is not known"
    );
    let summary = page.ask("bitrate", json!({ "channel": 1, "bitrate": 500_000 }));
    assert_eq!(summary["channels"][0]["bitrate"], 500_000);
    // About 130 bits of 5,000.
    assert!(page.floats("load", load, "load").iter().all(|load| (0.01..0.05).contains(load)));
    assert!(page.error("bitrate", json!({ "channel": 1, "bitrate": 0 })).contains("impossible"));
}

#[test]
fn what_was_exported_reads_back() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    let formats = page.ask("formats", json!({}));
    for format in formats.as_array().unwrap() {
        let name = format["name"].as_str().unwrap();
        let view = page.ask("filter", json!({ "filter": "123" }))["view"].clone();
        let (answer, sections) = page
            .try_ask("export", json!({ "view": view, "format": name, "from": 0.015, "to": null }), None)
            .unwrap();
        let place = &answer["bytes"]["$u8"];
        let offset = place[0].as_u64().unwrap() as usize;
        let bytes = &sections[offset..offset + place[1].as_u64().unwrap() as usize];
        let summary = Page::default().open(answer["name"].as_str().unwrap(), bytes).unwrap();
        assert_eq!(summary["frames"], 8, "{name}");
    }
    assert!(
        page.error("export", json!({ "view": 0, "format": "doc", "from": null, "to": null })).contains("doc")
    );
}

/// Whatever the pieces, the trace is the same; also for formats that are read at many places, and compressed ones.
#[test]
fn a_trace_in_pieces_is_the_same_as_a_whole_one() {
    let text = log().repeat(2000);
    let mut whole = Page::default();
    whole.open("a.log", text.as_bytes()).unwrap();
    let parameters = json!({ "view": 0, "format": "blf", "from": null, "to": null });
    let (answer, blf) = whole.try_ask("export", parameters, None).unwrap();
    let blf = &blf[..answer["bytes"]["$u8"][1].as_u64().unwrap() as usize];
    for (name, bytes) in [("a.log", text.as_bytes()), ("a.blf", blf)] {
        for size in [1000, 70_000, 1 << 20] {
            let mut page = Page::default();
            let mut pieces = bytes.chunks(size).peekable();
            let mut request = "open";
            let mut summary = Value::Null;
            while let Some(piece) = pieces.next() {
                let parameters =
                    json!({ "name": name, "more": pieces.peek().is_some(), "size": bytes.len() });
                summary = page.try_ask(request, parameters, Some(piece)).unwrap().0;
                request = "append";
            }
            assert_eq!(
                (&summary["records"], &summary["growing"]),
                (&json!(40_000), &json!(false)),
                "{name} {size}"
            );
            assert_eq!(
                (&summary["issues"], &summary["progress"]),
                (&json!([]), &json!(1.0)),
                "{name} {size}"
            );
        }
    }
}

#[test]
fn losses_are_gaps_findings_and_rows() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    let (answer, csv) = page
        .try_ask("export", json!({ "view": 0, "format": "csv", "from": null, "to": null }), None)
        .unwrap();
    let csv =
        String::from_utf8(csv[..answer["bytes"]["$u8"][1].as_u64().unwrap() as usize].to_vec()).unwrap();
    assert!(csv.lines().count() > 20, "{csv}");
    assert_eq!(page.ask("gaps", json!({ "from": null, "to": null })), json!([]));
    let texts: Vec<String> = page
        .ask("findings", json!({}))
        .as_array()
        .unwrap()
        .iter()
        .map(|finding| finding["text"].as_str().unwrap().to_owned())
        .collect();
    assert!(texts.iter().any(|text| text.contains("bit rate is not known")), "{texts:?}");
}

#[test]
fn values_beyond_an_alarm_are_found_with_their_place() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    let file = "version = 1\n\n[[message]]\nname = \"Engine\"\nid = 0x123\nlength = 8\n\n[[message.signal]]\nname = \"Speed\"\nunit = \"km/h\"\nat = \"D1\"\n\
                alarm = { min = 15, max = 65 }\n";
    page.database("car.toml", file);
    let signal = page.ask("messages", json!({}))[0]["signals"][0].clone();
    assert_eq!(signal["alarms"], json!({ "min": 15.0, "max": 65.0 }));
    let findings = page.ask("findings", json!({}));
    let alarms: Vec<_> = findings
        .as_array()
        .unwrap()
        .iter()
        .filter(|one| one["text"].as_str().unwrap().starts_with("Engine."))
        .collect();
    assert_eq!(alarms[0]["text"], "Engine.Speed: 3 values above 65 km/h, the largest 90 km/h");
    assert_eq!(alarms[1]["text"], "Engine.Speed: 2 values below 15 km/h, the smallest 0 km/h");
    assert_eq!(
        (&alarms[0]["severity"], &alarms[0]["id"], alarms.len()),
        (&json!("warning"), &json!(0x123), 2)
    );
    assert!((alarms[0]["time"].as_f64().unwrap() - 0.07).abs() < 1e-6);
}
