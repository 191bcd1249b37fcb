//! Records on their way to pages.

use cantap_trace::TraceEvent;
use cantap_trace::filter::Filter;
use serde_json::json;

use crate::client::{Page, Running, device};

fn lost(page: &Page) -> usize {
    page.records.iter().filter(|record| matches!(record.event, TraceEvent::Lost { .. })).count()
}

#[test]
fn a_page_gets_every_record_and_the_state() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=50", folder.path(), false));
    let mut page = server.page();
    page.until(|page| page.frames() > 2000);
    assert_eq!((page.next, lost(&page)), (page.records.len() as u64, 0));
    assert!(
        page.records
            .windows(2)
            .all(|pair| pair[0].channel != pair[1].channel || pair[0].time_ns <= pair[1].time_ns)
    );
    let state = &page.state;
    assert_eq!((&state["maySend"], &state["isNormal"]), (&json!(false), &json!(false)));
    assert_eq!(state["channels"][1]["bitrate"], 500_000);
    assert_eq!(state["devices"][0]["isThere"], true);
}

#[test]
fn a_second_page_gets_what_the_first_one_got_and_both_know_of_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=20", folder.path(), false));
    let mut first = server.page();
    first.until(|page| page.frames() > 500);
    let mut second = server.page();
    second.until(|page| page.records.len() >= first.records.len());
    assert_eq!(second.records[..first.records.len()], first.records[..]);
    first.until(|page| page.state["pages"] == 2);
    drop(second);
    first.until(|page| page.state["pages"] == 1);
}

#[test]
fn a_page_that_comes_back_goes_on_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=20", folder.path(), false));
    let mut page = server.page();
    page.until(|page| page.frames() > 300);
    let (run, next, before) = (page.run.clone(), page.next, page.records.clone());
    drop(page);
    let mut back = server.page_after(&format!("&run={run}&after={next}"));
    back.until(|page| page.frames() > 300);
    let mut whole = server.page();
    let joined = [before, back.records.clone()].concat();
    whole.until(|page| page.records.len() >= joined.len());
    assert_eq!(whole.records[..joined.len()], joined[..]);
    // A number of another run means nothing.
    let mut other = server.page_after(&format!("&run=0123&after={next}"));
    other.until(|page| page.frames() > 300);
    assert_eq!(other.records[0], whole.records[0]);
}

#[test]
fn a_page_that_takes_nothing_in_delays_neither_the_capture_nor_other_pages_and_loses_nothing_that_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=100", folder.path(), false));
    let mut slow = server.page();
    slow.acknowledges = false;
    let mut quick = server.page();
    quick.until(|page| page.frames() > 100_000);
    // More than a window is not on its way to the slow one.
    slow.until(|page| page.records.len() > 1000);
    slow.say(&json!({ "number": 1, "request": "recover", "parameters": {} }));
    slow.until(|page| !page.records.is_empty() && page.next > 20_000);
    assert!(slow.next < quick.next, "{} of {}", slow.next, quick.next);
    slow.acknowledges = true;
    let next = slow.next;
    slow.say(&json!({ "received": next }));
    let so_far = quick.records.len();
    slow.until(|page| page.records.len() >= so_far);
    assert_eq!(slow.records[..so_far], quick.records[..]);
    assert_eq!((lost(&slow), lost(&quick)), (0, 0));
}

#[test]
fn filters_and_bit_rates_are_changed_with_a_gap_and_refused_ones_leave_everything_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let server = Running::of(device("virtual:load=20", folder.path(), false));
    let mut page = server.page();
    page.until(|page| page.frames() > 100);
    let error = page.ask("filters", &json!({ "filters": ["nonsense!"] })).unwrap_err();
    assert!(!error.is_empty());
    assert_eq!(page.state["filters"], json!([]));
    let id = page.records.iter().find_map(|record| record.frame()).unwrap().id().raw();
    let text = format!("{:03X}:7FF", id & 0x7FF);
    page.ask("filters", &json!({ "filters": [text] })).unwrap();
    page.until(|page| page.state["filters"] != json!([]));
    page.until(|page| page.records.iter().any(|record| record.event == TraceEvent::GAP));
    let gap = page.records.len()
        - page.records.iter().rev().position(|record| record.event == TraceEvent::GAP).unwrap();
    page.until(|page| page.records.len() > gap + 50);
    let filter: Filter = text.parse().unwrap();
    assert!(page.records[gap..].iter().all(|record| record.frame().is_none() || filter.accepts(record)));
    assert!(!page.records[..gap].iter().all(|record| record.frame().is_none() || filter.accepts(record)));
    page.ask("filters", &json!({ "filters": [] })).unwrap();
    for (channel, bitrate) in [(1, 0), (1, 123), (1, 4_000_000_000_u32), (9, 500_000), (0, 500_000)] {
        let error = page.ask("bitrate", &json!({ "channel": channel, "bitrate": bitrate })).unwrap_err();
        assert!(!error.is_empty(), "{channel} {bitrate}");
    }
    page.ask("bitrate", &json!({ "channel": 2, "bitrate": 250_000 })).unwrap();
    page.until(|page| page.state["channels"][1]["bitrate"] == 250_000);
    assert_eq!(page.state["channels"][0]["bitrate"], 500_000);
    let so_far = page.frames();
    page.until(|page| page.frames() > so_far + 100);
}
