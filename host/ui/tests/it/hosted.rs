//! Boards that a server shares, as its pages see them.

use std::sync::Arc;
use std::time::Duration;

use cantap::wire::message::Role;
use cantap_serve::{Board, Settings};
use cantap_testing::process::wait_until;
use cantap_trace::TraceEvent;
use cantap_ui::{Device, Hosted, Visit};
use cantap_work::channel_options::ChannelOptions;
use serde_json::json;

use crate::client::{Running, device};

const BITRATE_BPS: u32 = 500_000;

fn board(options: &str) -> Arc<Board> {
    let options: cantap_virtual::Options = options.parse().unwrap();
    let connect = Box::new(move |_: Option<&str>| Ok(cantap_virtual::start(options.clone())?.into_link()));
    Arc::new(Board::start("board", connect, Settings::at(BITRATE_BPS), |_| {}).unwrap())
}

/// The page for a shared board, whose pages may do this.
fn hosted(board: &Arc<Board>, role: Role, linger: Duration) -> Device {
    let shared = Arc::clone(board);
    let link = Arc::new(move |_: usize| Ok(shared.link("the page", role)?));
    Device {
        hosted: Some(Hosted { link, may_use: Arc::new(|_| true), linger }),
        open: ChannelOptions::default(),
        role,
        folder: None,
        ..device("virtual", std::path::Path::new("nowhere"), false)
    }
}

#[test]
fn a_board_is_listened_to_while_pages_are_there_and_what_lies_between_is_a_gap() {
    let board = board("load=20");
    let server = Running::of(hosted(&board, Role::Listen, Duration::ZERO));
    assert_eq!(board.clients(), 0);
    let mut page = server.page();
    page.until(|page| page.frames() > 100);
    assert_eq!((board.clients(), &page.state["channels"][0]["bitrate"]), (1, &json!(BITRATE_BPS)));
    let (run, next) = (page.run.clone(), page.next);
    drop(page);
    wait_until("nobody listens", || board.clients() == 0);
    let mut back = server.page_after(&format!("&run={run}&after={next}"));
    let is_gap = |event: &TraceEvent| *event == TraceEvent::GAP;
    let gap = |page: &crate::client::Page| page.records.iter().position(|record| is_gap(&record.event));
    back.until(|page| gap(page).is_some_and(|at| page.records.len() > at + 100));
    assert_eq!(back.records.iter().filter(|record| is_gap(&record.event)).count(), 2, "one for each channel");
    let visits: Vec<Visit> = server.visits.try_iter().collect();
    assert_eq!(visits, [Visit::Came(Role::Listen), Visit::Left, Visit::Came(Role::Listen)]);
}

#[test]
fn a_page_that_may_listen_does_nothing_else() {
    let board = board("load=10");
    let server = Running::of(hosted(&board, Role::Listen, Duration::from_mins(1)));
    let mut page = server.page();
    page.until(|page| page.frames() > 50);
    assert_eq!([&page.state["maySend"], &page.state["mayConfigure"], &page.state["mayRecord"]], [false; 3]);
    for (request, parameters, advice) in [
        ("send", json!({ "channel": 1, "frame": "123#00" }), "--allow web:send"),
        ("periodic", json!({ "channel": 1, "frame": "123#00", "periodMs": 10 }), "--allow web:send"),
        ("stopPeriodic", json!({ "channel": 1, "slot": 0 }), "--allow web:send"),
        ("mode", json!({ "normal": true, "confirmed": true }), "--allow web:send"),
        ("mode", json!({ "normal": false }), "--allow web:configure"),
        ("recover", json!({}), "--allow web:send"),
        ("bitrate", json!({ "channel": 1, "bitrate": 250_000 }), "--allow web:configure"),
        ("filters", json!({ "filters": ["123:7FF"] }), "--allow web:configure"),
        ("record", json!({ "name": "drive.log" }), "records nothing for pages"),
        ("record", json!({ "name": "/tmp/drive.log" }), "records nothing for pages"),
    ] {
        let error = page.ask(request, &parameters).unwrap_err();
        assert!(error.contains(advice), "{request}: {error}");
    }
    page.ask("stopRecording", &json!({})).unwrap();
    // Whatever else it claims about itself is not understood.
    page.say(&json!({ "number": 99, "request": "send", "role": "send", "parameters": { "channel": 1, "frame": "123#", "role": "send" } }));
    page.until(|page| page.notices.iter().any(|notice| notice.contains("did not understand")));
    let so_far = page.frames();
    page.until(|page| page.frames() > so_far + 50);
    assert!(page.records.iter().all(|record| !matches!(record.event, TraceEvent::Lost { .. })));
    assert_eq!(board.bitrates_bps(), [Some(BITRATE_BPS); 2]);
    let refused = server.visits.try_iter().filter(|visit| matches!(visit, Visit::NotDone(_))).count();
    assert_eq!(refused, 10);
}

#[test]
fn a_page_that_may_send_sends_through_the_board_and_its_mode_ends_with_it() {
    let board = board("load=0");
    let server = Running::of(hosted(&board, Role::Send, Duration::ZERO));
    let mut page = server.page();
    page.until(|page| !page.state["channels"].as_array().unwrap().is_empty());
    page.ask("mode", &json!({ "normal": true, "confirmed": true })).unwrap();
    page.ask("send", &json!({ "channel": 1, "frame": "123#C0FFEE" })).unwrap();
    page.until(|page| page.frames() == 1);
    let asked = |visit: &Visit| match visit {
        Visit::Asked(what) => Some(what.clone()),
        _ => None,
    };
    let asked: Vec<String> = server.visits.try_iter().filter_map(|visit| asked(&visit)).collect();
    assert_eq!(asked, ["take part in the buses", "send 123#C0FFEE on channel 1"]);
    drop(page);
    wait_until("nobody listens", || board.clients() == 0);
    let mut page = server.page();
    page.until(|page| page.state["isNormal"] == false);
    assert!(page.ask("send", &json!({ "channel": 1, "frame": "123#" })).unwrap_err().contains("only listen"));
}

/// Somebody else's bit rate stays as it is.
#[test]
fn a_page_does_not_change_what_others_use() {
    let board = board("load=10");
    let other = cantap::Device::over(board.link("other", Role::Listen).unwrap(), "other").unwrap();
    other.listen(cantap::Channel::Can1, BITRATE_BPS).unwrap();
    let server = Running::of(hosted(&board, Role::Configure, Duration::from_mins(1)));
    let mut page = server.page();
    page.until(|page| page.frames() > 50);
    let error = page.ask("bitrate", &json!({ "channel": 1, "bitrate": 250_000 })).unwrap_err();
    assert!(error.contains("bit rate"), "{error}");
    let so_far = page.frames();
    page.until(|page| page.frames() > so_far + 50);
    assert_eq!(page.state["channels"][0]["bitrate"], BITRATE_BPS);
    assert!(other.records().take(50).all(|record| record.is_ok()));
}
