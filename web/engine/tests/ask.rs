//! Requests and answers as the page has them, over real bytes.

use cantap_trace::{DeviceNs, Direction, TraceEvent, TraceRecord, packed};
use cantap_web_engine::{Engine, message};
use serde_json::{Value, json};

/// An engine and what the worker does with its answers.
#[derive(Default)]
struct Page(Engine);

impl Page {
    fn try_ask(
        &mut self,
        request: &str,
        parameters: Value,
        bytes: Option<&[u8]>,
    ) -> Result<(Value, Vec<u8>), String> {
        let answer = self.0.ask(&message::request(request, parameters, bytes));
        let length = u32::from_le_bytes(answer[..4].try_into().unwrap()) as usize;
        let head: Value = serde_json::from_slice(&answer[4..4 + length]).unwrap();
        let sections = answer.get((4 + length).next_multiple_of(8)..).unwrap_or_default().to_vec();
        match head.get("error") {
            Some(error) => Err(error.as_str().unwrap().to_owned()),
            None => Ok((head["ok"].clone(), sections)),
        }
    }

    fn ask(&mut self, request: &str, parameters: Value) -> Value {
        self.try_ask(request, parameters, None).unwrap().0
    }

    fn error(&mut self, request: &str, parameters: Value) -> String {
        self.try_ask(request, parameters, None).unwrap_err()
    }

    fn open(&mut self, name: &str, bytes: &[u8]) -> Result<Value, String> {
        let parameters = json!({ "name": name, "more": false, "size": bytes.len() });
        self.try_ask("open", parameters, Some(bytes)).map(|(summary, _)| summary)
    }

    fn database(&mut self, name: &str, text: &str) -> Value {
        self.try_ask("database", json!({ "name": name, "channel": null }), Some(text.as_bytes())).unwrap().0
    }

    /// The numbers of a `Float64Array` in an answer.
    fn floats(&mut self, request: &str, parameters: Value, member: &str) -> Vec<f64> {
        let (answer, sections) = self.try_ask(request, parameters, None).unwrap();
        let place = &answer[member]["$f64"];
        let (offset, length) = (place[0].as_u64().unwrap() as usize, place[1].as_u64().unwrap() as usize);
        sections[offset..offset + length * 8]
            .chunks(8)
            .map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap()))
            .collect()
    }
}

const DBC: &str = "BO_ 291 Engine: 8 X\n SG_ Speed : 0|16@1+ (0.1,0) [0|250] \"km/h\" X\n SG_ Gear : 16|3@1+ (1,0) [0|0] \"\" X\n\n\
                   CM_ BO_ 291 \"</script><script>alert(1)</script>\";\nVAL_ 291 Gear 3 \"Drive\" ;\n";

/// Ten frames of 123 every 10 ms, each followed by one of 7E8 on the other channel.
fn log() -> String {
    (0..10)
        .map(|n| {
            let time = 1_700_000_000.0 + f64::from(n) * 0.01;
            format!(
                "({time:.6}) can0 123#{:02X}00030000000000\n({:.6}) can1 7E8#0102\n",
                n * 10,
                time + 0.001
            )
        })
        .collect::<Vec<_>>()
        .concat()
}

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
fn a_live_trace_grows_and_its_views_with_it() {
    let mut page = Page::default();
    let open = json!({ "name": "virtual", "more": true, "size": null });
    let summary = page.try_ask("open", open, Some(&live(0, 2))).unwrap().0;
    assert_eq!(
        (&summary["records"], &summary["progress"], &summary["growing"]),
        (&json!(2), &Value::Null, &json!(true))
    );
    let view = page.ask("filter", json!({ "filter": "123" }));
    assert_eq!(view["rows"], 1);
    let summary = page.try_ask("append", json!({ "more": false }), Some(&live(2, 18))).unwrap().0;
    assert_eq!(
        (&summary["records"], &summary["growing"], &summary["issues"]),
        (&json!(20), &json!(false), &json!([]))
    );
    let again = page.ask("filter", json!({ "filter": "123" }));
    assert_eq!((&again["view"], &again["rows"]), (&view["view"], &json!(5)));
    assert!(page.try_ask("append", json!({ "more": false }), Some(b"x")).unwrap_err().contains("complete"));
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
fn bad_requests_and_bad_files_are_refused_with_what_to_do() {
    let mut page = Page::default();
    assert!(page.error("summary", json!({})).contains("open one"));
    assert!(page.error("rows", json!({ "view": 0, "from": 0, "count": 1 })).contains("open one"));
    assert!(page.error("fly", json!({})).contains("one build"));
    assert!(page.open("a.xyz", b"nonsense\n").unwrap_err().contains("format"));
    assert!(page.open("a.log", b"nonsense\n").unwrap_err().contains("nothing in a.log could be read"));
    assert!(page.open("a.blf", b"LOGG").is_err());
    let bad = page
        .try_ask("database", json!({ "name": "a.dbc", "channel": null }), Some(b"BO_ nonsense"))
        .unwrap_err();
    assert!(bad.contains("a.dbc"), "{bad}");
    let bad = page.try_ask("database", json!({ "name": "a.txt", "channel": null }), Some(b"")).unwrap_err();
    assert!(bad.contains(".dbc"), "{bad}");
    // What is open stays open when a database is refused.
    page.open("drive.log", log().as_bytes()).unwrap();
    assert!(page.error("decode", json!({ "index": 20 })).contains("no record"));
    assert!(
        page.error("series", json!({ "signal": 7, "from": null, "to": null, "columns": 5 }))
            .contains("messages again")
    );
    assert!(
        page.error("bits", json!({ "channel": 1, "id": 0x800, "extended": false, "from": null, "to": null }))
            .contains("identifier")
    );
    let cut = &log().into_bytes()[..150];
    let summary = page.open("cut.log", cut).unwrap();
    assert!(
        summary["records"].as_u64().unwrap() > 0 && !summary["issues"].as_array().unwrap().is_empty(),
        "{summary}"
    );
}

/// No bytes make the engine panic: in the page that would be its end.
#[test]
fn random_damage_never_panics() {
    let mut random = fastrand::Rng::with_seed(7);
    let mut source = Page::default();
    source.open("drive.log", log().as_bytes()).unwrap();
    for format in ["candump", "asc", "blf", "trc", "csv", "pcapng", "mf4", "dif"] {
        let (answer, sections) = source
            .try_ask("export", json!({ "view": 0, "format": format, "from": null, "to": null }), None)
            .unwrap();
        let whole = &sections[..answer["bytes"]["$u8"][1].as_u64().unwrap() as usize];
        let name = answer["name"].as_str().unwrap();
        for _ in 0..100 {
            let mut bytes = whole.to_vec();
            for _ in 0..random.usize(1..8) {
                let at = random.usize(..bytes.len());
                bytes[at] = random.u8(..);
            }
            bytes.truncate(random.usize(..=bytes.len()));
            let mut page = Page::default();
            if page.open(name, &bytes).is_err() {
                continue;
            }
            page.database("car.dbc", DBC);
            for (request, parameters) in [
                ("rows", json!({ "view": 0, "from": 0, "count": 100 })),
                ("ids", json!({ "at": null })),
                ("findings", json!({})),
                ("conversations", json!({ "from": null, "to": null, "limit": 100 })),
                ("load", json!({ "channel": 1, "from": null, "to": null, "columns": 100 })),
                ("periods", json!({ "channel": 1, "id": 0x123, "extended": false })),
                ("gaps", json!({ "from": null, "to": null })),
                ("export", json!({ "view": 0, "format": "asc", "from": null, "to": null })),
            ] {
                page.ask(request, parameters);
            }
        }
    }
}

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

/// Chunks as a live source sends them: frames of two identifiers, 1 ms apart, from this number on.
fn live(from: i64, count: i64) -> Vec<u8> {
    let record = |n: i64| {
        let frame = if n % 4 == 0 { format!("123#{:04X}", n % 65_536) } else { "456#00".to_owned() };
        let event =
            TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
        TraceRecord { time_ns: 1_700_000_000_000_000_000 + n * 1_000_000, device_ns: None, channel: 1, event }
    };
    let records: Vec<_> = (from..from + count).map(record).collect();
    let mut bytes = Vec::new();
    for piece in records.chunks(1000) {
        let mut packed = Vec::new();
        packed::write(piece, &mut packed);
        bytes.extend((packed.len() as u32).to_le_bytes());
        bytes.extend(packed);
    }
    bytes
}

/// A request and its answer every 10 ms, by a device that is 400 ppm fast and whose UTC is corrected at every second record.
#[test]
fn intervals_are_the_devices_where_it_stamped_both_ends() {
    let record = |n: i64| {
        let text = if n % 2 == 0 { "7E0#0322F19000000000" } else { "7E8#0462F19041000000" };
        let event = TraceEvent::Frame { frame: text.parse().unwrap(), direction: Direction::Rx, late: false };
        TraceRecord {
            time_ns: 1_700_000_000_000_000_000 + n * 10_000_000 + n / 2 % 2 * 900,
            device_ns: DeviceNs::new(5_000_000_000 + n as u64 * 10_004_000),
            channel: 1,
            event,
        }
    };
    let records: Vec<_> = (0..100).map(record).collect();
    let mut packed = Vec::new();
    packed::write(&records, &mut packed);
    let bytes = [&(packed.len() as u32).to_le_bytes()[..], &packed].concat();
    let mut page = Page::default();
    let open = json!({ "name": "board", "more": true, "size": null });
    page.try_ask("open", open, Some(&[])).unwrap();
    let summary = page.try_ask("append", json!({ "more": true }), Some(&bytes)).unwrap().0;
    assert_eq!(summary["deviceTimes"], true);
    let is = |interval: &Value, seconds: f64| {
        let found = interval["seconds"].as_f64().unwrap();
        assert!((found - seconds).abs() < 1e-12 && interval["byDevice"] == true, "{interval} {seconds}");
    };
    let rows = page.ask("rows", json!({ "view": 0, "from": 0, "count": 3 }));
    assert_eq!(rows[0]["above"], Value::Null);
    is(&rows[2]["above"], 0.010_004);
    let view = page.ask("filter", json!({ "filter": "7E8" }));
    let rows = page.ask("rows", json!({ "view": view["view"], "from": 1, "count": 1 }));
    is(&rows[0]["above"], 0.020_008);
    let ids = page.ask("ids", json!({ "at": null }));
    let period = &ids[0]["period"];
    assert_eq!(
        (&period["byDevice"], &period["min"], &period["max"]),
        (&json!(true), &period["median"], &period["median"])
    );
    assert!((period["min"].as_f64().unwrap() - 0.020_008).abs() < 1e-12);
    let periods = page.ask("periods", json!({ "channel": 1, "id": 0x7E0, "extended": false }));
    assert_eq!(periods["byDevice"], true);
    assert!(periods["deviation"].as_f64().unwrap() < 1e-12, "{periods}");
    // The cursors are not at records.
    let between = page.ask("interval", json!({ "from": 0.105, "to": 0.905 }));
    assert!((between["seconds"].as_f64().unwrap() - 0.8 * 1.0004).abs() < 1e-6, "{between}");
    let found = page.ask("conversations", json!({ "from": null, "to": null, "limit": 5 }));
    is(&found["events"][0]["took"], 0.010_004);
    // Another trace has only UTC.
    let summary = page.open("drive.log", log().as_bytes()).unwrap();
    assert_eq!(summary["deviceTimes"], false);
    let between = page.ask("interval", json!({ "from": 0.01, "to": 0.03 }));
    assert_eq!(between, json!({ "seconds": 0.02, "byDevice": false }));
}

#[test]
fn a_live_trace_keeps_its_newest_records_and_says_how_many_are_gone() {
    const KEEP: usize = 131_072;
    const ALL: usize = 300_000;
    let mut page = Page::default();
    page.database("car.dbc", DBC);
    let open = json!({ "name": "virtual", "more": true, "size": null, "keep": KEEP });
    let summary = page.try_ask("open", open, Some(&[])).unwrap().0;
    assert_eq!(
        (&summary["growing"], &summary["records"], &summary["startUtcNs"]),
        (&json!(true), &json!(0), &Value::Null)
    );
    let mut summary = Value::Null;
    let mut view = Value::Null;
    for from in (0..ALL as i64).step_by(10_000) {
        summary = page.try_ask("append", json!({ "more": true }), Some(&live(from, 10_000))).unwrap().0;
        let records = summary["records"].as_u64().unwrap() as usize;
        assert!(records <= KEEP, "{records}");
        view = page.ask("filter", json!({ "filter": "123" }));
    }
    let (records, forgotten) =
        (summary["records"].as_u64().unwrap() as usize, summary["forgotten"].as_u64().unwrap() as usize);
    assert_eq!((records + forgotten, summary["frames"].as_u64()), (ALL, Some(ALL as u64)));
    let issue = summary["issues"]
        .as_array()
        .unwrap()
        .iter()
        .find(|issue| issue["text"].as_str().unwrap().contains("newest"))
        .unwrap();
    assert_eq!(issue["count"], forgotten);
    // Numbers and times are those of the whole.
    assert_eq!(summary["startUtcNs"], "1700000000000000000");
    let near = |a: &Value, b: f64| (a.as_f64().unwrap() - b).abs() < 1e-6;
    assert!(
        near(&summary["begin"], forgotten as f64 / 1e3) && near(&summary["duration"], (ALL - 1) as f64 / 1e3),
        "{summary}"
    );
    let row = &page.ask("rows", json!({ "view": 0, "from": 0, "count": 1 }))[0];
    assert_eq!(
        (row["index"].as_u64(), near(&row["time"], forgotten as f64 / 1e3)),
        (Some(forgotten as u64), true)
    );
    assert!(page.error("decode", json!({ "index": forgotten - 1 })).contains("no record"));
    let first = forgotten.next_multiple_of(4);
    let value = page.ask("decode", json!({ "index": first }))[0]["value"].as_f64().unwrap();
    let bytes = ((first % 65_536) as u16).swap_bytes();
    assert!((value - f64::from(bytes) * 0.1).abs() < 1e-6, "{value}");
    // A view that was there before goes on.
    assert_eq!(view["rows"].as_u64().unwrap() as usize, (first..ALL).step_by(4).count());
    let number = &view["view"];
    let row = &page.ask("rows", json!({ "view": number, "from": 0, "count": 1 }))[0];
    assert_eq!((row["index"].as_u64(), row["id"].as_u64()), (Some(first as u64), Some(0x123)));
    let ids = page.ask("ids", json!({ "at": null }));
    assert_eq!(ids[0]["count"], ALL / 4);
    let messages = page.ask("messages", json!({}));
    assert_eq!(messages[0]["count"], ALL / 4);
    let signal = messages[0]["signals"][0]["key"].clone();
    let times =
        page.floats("series", json!({ "signal": signal, "from": null, "to": null, "columns": 10 }), "time");
    assert!((times[0] - first as f64 / 1e3).abs() < 1e-6, "{}", times[0]);
    let end = page.try_ask("append", json!({ "more": false }), Some(&[])).unwrap().0;
    assert_eq!(end["growing"], false);
}

#[test]
fn damaged_records_of_a_live_source_are_refused_and_those_before_stay() {
    let mut page = Page::default();
    let open = json!({ "name": "virtual", "more": true, "size": null });
    page.try_ask("open", open, Some(&live(0, 10))).unwrap();
    let mut bytes = live(10, 10);
    bytes.truncate(bytes.len() - 1);
    assert!(
        page.try_ask("append", json!({ "more": true }), Some(&bytes))
            .unwrap_err()
            .contains("load the page anew")
    );
    let mut bytes = live(10, 10);
    bytes.extend([9, 0, 0, 0, 0xFF]);
    assert!(page.try_ask("append", json!({ "more": true }), Some(&bytes)).is_err());
    assert_eq!(page.ask("summary", json!({}))["records"], 20);
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

/// A file of 20 GB whose format must be there as a whole is refused while little of it has come, in words, and the engine goes on.
#[test]
fn a_file_that_cannot_be_read_in_pieces_and_is_too_large_is_refused_early() {
    let mut page = Page::default();
    page.open("drive.log", log().as_bytes()).unwrap();
    let export = json!({ "view": 0, "format": "mf4", "from": null, "to": null });
    let (saved, sections) = page.try_ask("export", export, None).unwrap();
    let length = saved["bytes"]["$u8"][1].as_u64().unwrap() as usize;
    let piece = [&sections[..length], &vec![0; (8 << 20) - length]].concat();
    let whole = json!({ "name": "long.mf4", "more": true, "size": 20_u64 << 30 });
    let mut answer = page.try_ask("open", whole, Some(&piece));
    let mut pieces = 1;
    while answer.is_ok() {
        answer = page.try_ask("append", json!({ "more": true }), Some(&piece));
        pieces += 1;
    }
    let error = answer.unwrap_err();
    assert!(error.contains("as a whole") && error.contains("cantap convert"), "{error}");
    assert!(pieces <= 16, "{pieces} pieces of 8 MiB");
    assert_eq!(page.open("drive.log", log().as_bytes()).unwrap()["frames"], 20);
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
