//! Traces that grow: records of a live source as they come.

use cantap_trace::{DeviceNs, Direction, TraceEvent, TraceRecord, packed};
use serde_json::{Value, json};

use crate::page::{DBC, Page, log};

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
