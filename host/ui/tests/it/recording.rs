//! Recordings of pages.

use cantap_formats::{ReadOptions, open_reader};
use cantap_trace::TraceRecord;
use serde_json::json;

use crate::client::{Running, device};

fn records(path: &std::path::Path) -> Vec<TraceRecord> {
    open_reader(path, &ReadOptions::default()).unwrap().map(Result::unwrap).collect()
}

#[test]
fn a_recording_has_what_the_page_got_and_an_older_file_stays() {
    let folder = tempfile::tempdir().unwrap();
    let older = folder.path().join("older.log");
    std::fs::write(&older, "somebody's").unwrap();
    let server = Running::of(device("virtual:load=30", folder.path(), false));
    let mut page = server.page();
    for name in ["older.log", "../out.log", "/tmp/out.log", "x.unknown", ""] {
        assert!(page.ask("record", &json!({ "name": name })).is_err(), "{name}");
    }
    page.ask("record", &json!({ "name": "new.log" })).unwrap();
    assert!(
        page.ask("record", &json!({ "name": "second.log" }))
            .unwrap_err()
            .contains("new.log is being recorded")
    );
    page.until(|page| page.state["recording"]["records"].as_u64() > Some(500));
    assert!(page.state["recording"]["bytes"].as_u64() > Some(10_000));
    page.ask("stopRecording", &json!({})).unwrap();
    page.until(|page| {
        page.state["recording"].is_null() && page.notices.iter().any(|text| text.contains("records are in"))
    });
    let recorded = records(&folder.path().join("new.log"));
    page.until(|page| page.records.len() > recorded.len());
    let first =
        page.records.iter().position(|record| record.time_ns / 1000 == recorded[0].time_ns / 1000).unwrap();
    page.until(|page| page.records.len() >= first + recorded.len());
    // A candump log has microseconds.
    let rounded = |records: &[TraceRecord]| {
        records.iter().map(|record| (record.time_ns / 1000, record.channel, record.event)).collect::<Vec<_>>()
    };
    assert_eq!(rounded(&recorded), rounded(&page.records[first..first + recorded.len()]));
    assert_eq!(std::fs::read_to_string(&older).unwrap(), "somebody's");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn a_recording_from_the_start_is_whole_when_the_server_ends() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("all.blf");
    let mut options = device("virtual:load=30", folder.path(), false);
    options.record = Some(path.clone());
    let server = Running::of(options);
    let mut page = server.page();
    page.until(|page| page.frames() > 1000);
    drop(server);
    let recorded = records(&path);
    assert!(recorded.len() >= page.records.len());
    let frames = |records: &[TraceRecord]| {
        records.iter().filter_map(|record| record.frame().copied()).take(1000).collect::<Vec<_>>()
    };
    assert_eq!(frames(&recorded), frames(&page.records));
}

#[test]
fn with_a_condition_only_what_is_around_its_events_is_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:car", folder.path(), false));
    let mut page = server.page();
    let only = |around: &str| json!({ "around": around, "beforeS": 0.05, "afterS": 0.0 });
    for wrong in ["speed >", "Unknown > 1"] {
        assert!(page.ask("record", &json!({ "name": "a.log", "only": only(wrong) })).is_err(), "{wrong}");
    }
    page.ask("record", &json!({ "name": "never.log", "only": only("dlc == 15 or id == 0x1FFFFFFF") }))
        .unwrap();
    page.until(|page| page.state["recording"]["condition"] == "dlc == 15 or id == 0x1FFFFFFF");
    assert_eq!(page.state["recording"]["events"], 0);
    page.ask("stopRecording", &json!({})).unwrap();
    page.until(|page| page.notices.iter().any(|text| text.contains("never came true")));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);

    page.ask("record", &json!({ "name": "some.log", "only": only("channel == 2") })).unwrap();
    page.until(|page| page.state["recording"]["events"].as_u64() > Some(20));
    page.ask("stopRecording", &json!({})).unwrap();
    page.until(|page| page.notices.iter().any(|text| text.contains("records are in")));
    let recorded = records(&folder.path().join("some.log"));
    // Nothing but the 50 ms before each frame of channel 2, and that frame.
    let times: Vec<_> =
        recorded.iter().filter(|record| record.channel == 2).map(|record| record.time_ns).collect();
    assert!(times.len() > 20);
    for record in &recorded {
        let next = times.iter().find(|time| **time >= record.time_ns);
        assert!(next.is_some_and(|time| time - record.time_ns <= 50_001_000), "{record:?}");
    }
}
