//! What a page may have the device send, and what not.

use std::time::Duration;

use cantap_trace::{Direction, TraceEvent};
use serde_json::json;

use crate::client::{Page, Running, device};

fn sent(page: &Page) -> Vec<String> {
    let of = |event: &TraceEvent| match event {
        TraceEvent::Frame { frame, direction: Direction::Tx, .. } => Some(frame.to_string()),
        _ => None,
    };
    page.records.iter().filter_map(|record| of(&record.event)).collect()
}

#[test]
fn a_page_sends_only_if_the_command_allows_it_and_the_user_has_confirmed_it() {
    let folder = tempfile::tempdir().unwrap();
    let send = json!({ "channel": 1, "frame": "123#C0FFEE" });
    let periodic = json!({ "channel": 1, "frame": "123#00", "periodMs": 10 });
    {
        let server = Running::of(device("virtual:load=5", folder.path(), false));
        let mut page = server.page();
        for (request, parameters) in [
            ("send", &send),
            ("periodic", &periodic),
            ("mode", &json!({ "normal": true, "confirmed": true })),
            ("recover", &json!({})),
        ] {
            let error = page.ask(request, parameters).unwrap_err();
            assert!(error.contains("--allow send"), "{request}: {error}");
        }
        page.until(|page| page.frames() > 100);
        assert_eq!((sent(&page), &page.state["isNormal"]), (Vec::new(), &json!(false)));
    }
    let server = Running::of(device("virtual:load=5", folder.path(), true));
    let mut page = server.page();
    for parameters in [json!({ "normal": true }), json!({ "normal": true, "confirmed": false })] {
        assert!(page.ask("mode", &parameters).unwrap_err().contains("confirm"));
    }
    assert!(page.ask("send", &send).unwrap_err().contains("normal mode first"));
    page.ask("mode", &json!({ "normal": true, "confirmed": true })).unwrap();
    page.until(|page| page.state["isNormal"] == true);
    for (channel, frame) in
        [(1, "nonsense"), (1, ""), (0, "123#"), (7, "123#"), (255, "123#"), (1, "Motor:Speed=1")]
    {
        assert!(
            page.ask("send", &json!({ "channel": channel, "frame": frame })).is_err(),
            "{channel} {frame}"
        );
    }
    page.ask("send", &send).unwrap();
    page.until(|page| sent(page) == ["123#C0FFEE"]);
    // Another bit rate was not agreed to.
    page.ask("bitrate", &json!({ "channel": 1, "bitrate": 250_000 })).unwrap();
    page.until(|page| page.state["isNormal"] == false);
    assert!(page.ask("send", &send).is_err());
}

#[test]
fn periodic_frames_change_as_asked_and_stop_when_no_page_is_there() {
    let folder = tempfile::tempdir().unwrap();
    let mut options = device("virtual:load=0", folder.path(), true);
    options.dead_man = Duration::from_millis(1500);
    let server = Running::of(options);
    let mut page = server.page();
    page.ask("mode", &json!({ "normal": true, "confirmed": true })).unwrap();
    for (frame, period_ms, modifiers) in [
        ("123#00", json!(0.001), json!([])),
        ("123#00", json!(-5), json!([])),
        ("123#00", json!(1e300), json!([])),
        ("123#00", json!(10), json!([{ "counter": { "byte": 7, "lowBit": 0, "bits": 8 } }])),
        ("123#00", json!(10), json!([{ "counter": { "byte": 0, "lowBit": 7, "bits": 8 } }])),
    ] {
        let parameters =
            json!({ "channel": 1, "frame": frame, "periodMs": period_ms, "modifiers": modifiers });
        assert!(page.ask("periodic", &parameters).is_err(), "{parameters}");
    }
    let changes = json!([{ "counter": { "byte": 0, "lowBit": 0, "bits": 4 } }, { "checksum": { "byte": 1, "algorithm": "xor" } }]);
    let parameters = json!({ "channel": 1, "frame": "123#0000", "periodMs": 5, "modifiers": changes });
    let slot = page.ask("periodic", &parameters).unwrap()["slot"].clone();
    page.until(|page| sent(page).len() >= 40);
    let expected: Vec<_> = (0..40).map(|n| format!("123#{:02X}{:02X}", n % 16, n % 16)).collect();
    assert_eq!(sent(&page)[..40], expected);
    page.until(|page| page.state["periodic"][0]["slot"] == slot);
    page.ask("stopPeriodic", &json!({ "channel": 1, "slot": slot })).unwrap();
    page.until(|page| page.state["periodic"] == json!([]));
    page.ask("periodic", &parameters).unwrap();
    drop(page);
    while !server.reports.recv().unwrap().contains("no page has been there") {}
    let mut page = server.page();
    page.until(|page| page.notices.iter().any(|notice| notice.contains("no page has been there")));
    assert_eq!(page.state["periodic"], json!([]));
}
