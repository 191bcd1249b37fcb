//! The pages over real traffic, as whole screens, and what keys do.
//!
//! The screens are files in `snapshots/`. After a change that is meant, write them anew with
//! `CANTAP_OVERWRITE=1 cargo test -p cantap-cli monitor` and look at the difference.

use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;

use cantap::formats::{ReadOptions, open_reader};
use cantap::signals::{Decoder, Source};
use cantap::stats::Options;
use cantap::wire::message::Mode;
use cantap::wire::record::{BusErrorKind, LossStage};
use cantap::{Address, Channel, TraceEvent, TraceRecord};
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

use super::app::{App, Flow, TimeMode, View};
use super::model::{Model, Recording, SourceState};
use super::source::{Order, Plan};
use super::theme::Theme;
use super::{orders, screen_text};

fn here() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src/monitor/snapshots")
}

/// Two minutes of a boat's bus, with an error, a loss, and frames of a second channel in between.
fn model() -> Model {
    let database = cantap::signals::load(&here().join("nmea2000.toml")).unwrap();
    assert_eq!(database.warnings, []);
    let decoder = Decoder::new(vec![Source { channel: None, database }]);
    let options = Options { bitrate_bps: Some(250_000), ..Options::default() };
    let mut model = Model::new(decoder.into(), options, 1_000_000).unwrap();
    model.seen.signals.choose("Speed");
    model.seen.signals.choose("Course");
    model.seen.signals.choose("Moving");
    let log = Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/tests/data/nmea2000.log.gz");
    let records = open_reader(log, &ReadOptions::default()).unwrap();
    let mut records: Vec<_> = records.take(6000).map(Result::unwrap).collect();
    let before = records[5993].time_ns;
    let insert = |time_ns, channel, event| TraceRecord { time_ns, channel, event };
    records.insert(
        5994,
        insert(before, 1, TraceEvent::BusError { kind: Some(BusErrorKind::Crc), counters: Some((0, 1)) }),
    );
    records.insert(
        5995,
        insert(before, 1, TraceEvent::Lost { stage: Some(LossStage::Queue), count: 17, at_least: false }),
    );
    records.insert(5998, TraceRecord { channel: 2, ..records[5990] });
    records.last_mut().unwrap().channel = 2;
    model.take(&records);
    model.source = SourceState::Running;
    model
}

fn app(view: View) -> (App, Receiver<Order>) {
    let (sender, receiver) = orders();
    let theme = Theme { colour: true, light: false, unicode: true };
    let options = Options { channel_bitrate_bps: vec![(1, 250_000)], ..Options::default() };
    let plan = Plan::listening(Address::Virtual(String::new()), &options);
    (App::new(view, theme, Some(plan), sender), receiver)
}

fn press(app: &mut App, model: &mut Model, keys: &str) {
    for key in keys.chars() {
        let code = if key == '\n' { KeyCode::Enter } else { KeyCode::Char(key) };
        assert_eq!(app.key(KeyEvent::new(code, KeyModifiers::NONE), model), Flow::GoOn, "{key:?}");
    }
}

/// Compares a screen with the file of that name.
fn check(name: &str, text: &str) {
    let path = here().join(format!("{name}.txt"));
    if std::env::var_os("CANTAP_OVERWRITE").is_some() {
        std::fs::write(&path, text).unwrap();
    }
    let expected = std::fs::read_to_string(&path).unwrap_or_default().replace("\r\n", "\n");
    assert!(text == expected, "{} differs; it is now:\n{text}", path.display());
}

fn check_page(view: View) {
    let mut model = model();
    let (mut app, _orders) = app(view);
    if view == View::Send {
        press(&mut app, &mut model, "a123#DEADBEEF 100ms\na2:CogSogRapid:Speed=1.5,Course=2\n");
        assert_eq!(app.send.len(), 2, "{}", app.message);
    }
    if view == View::Record {
        model.recording = Some(Recording {
            path: "boat.blf".to_owned(),
            records: 6002,
            bytes: 48_213,
            since_ns: model.first_ns.unwrap(),
        });
    }
    for size in [(80, 24), (160, 50)] {
        let name = format!("{}-{}x{}", view.title().to_lowercase(), size.0, size.1);
        check(&name, &screen_text(&mut app, &model, size).unwrap());
    }
}

#[test]
fn the_trace_page_is_as_agreed() {
    check_page(View::Trace);
}

#[test]
fn the_fixed_page_is_as_agreed() {
    check_page(View::Fixed);
}

#[test]
fn the_signals_page_is_as_agreed() {
    check_page(View::Signals);
}

#[test]
fn the_graph_page_is_as_agreed() {
    check_page(View::Graph);
}

#[test]
fn the_statistics_page_is_as_agreed() {
    check_page(View::Statistics);
}

#[test]
fn the_send_page_is_as_agreed() {
    check_page(View::Send);
}

#[test]
fn the_record_page_is_as_agreed() {
    check_page(View::Record);
}

#[test]
fn the_help_lies_over_the_page() {
    let mut model = model();
    let (mut app, _orders) = app(View::Fixed);
    press(&mut app, &mut model, "h");
    check("help-80x24", &screen_text(&mut app, &model, (80, 24)).unwrap());
    press(&mut app, &mut model, "h");
    assert!(!app.help);
}

/// Every key has a line in the help, and the help fits the smallest usual screen.
#[test]
fn no_page_needs_more_than_ascii_where_the_terminal_has_no_more() {
    let model = model();
    for view in View::ALL {
        let (mut app, _orders) = app(view);
        app.theme.unicode = false;
        app.theme.colour = false;
        let text = screen_text(&mut app, &model, (100, 30)).unwrap();
        let strange: String = text.chars().filter(|character| !character.is_ascii()).collect();
        assert!(strange.is_empty(), "{view:?}: {strange}");
    }
}

#[test]
fn no_size_makes_any_page_panic() {
    let mut model = model();
    for view in View::ALL {
        let (mut app, _orders) = app(view);
        for size in [(1, 1), (39, 8), (40, 7), (40, 8), (41, 9), (79, 10), (300, 100)] {
            screen_text(&mut app, &model, size).unwrap();
            press(&mut app, &mut model, "h");
            screen_text(&mut app, &model, size).unwrap();
            press(&mut app, &mut model, "h");
        }
    }
}

#[test]
fn pausing_stops_the_display_but_not_the_model() {
    let mut model = model();
    for view in [View::Trace, View::Fixed] {
        let (mut app, _orders) = app(view);
        press(&mut app, &mut model, " ");
        let rows = |text: String| text.lines().skip(2).map(str::to_owned).collect::<Vec<_>>();
        let before = rows(screen_text(&mut app, &model, (110, 30)).unwrap());
        let last = *model.history.get(model.history.end() - 1).unwrap();
        let taken = model.seen.taken;
        model.take(&[TraceRecord { time_ns: last.time_ns + 1_000_000, ..last }; 3]);
        assert_eq!(model.seen.taken, taken + 3);
        let after = rows(screen_text(&mut app, &model, (110, 30)).unwrap());
        if view == View::Fixed {
            assert_eq!(before, after);
        } else {
            // There is more below now, but what was there stays.
            let shown: Vec<_> = before.iter().filter(|line| line.contains("19FA0402")).collect();
            assert!(!shown.is_empty() && shown.iter().all(|line| after.contains(line)));
        }
        press(&mut app, &mut model, " ");
        assert_ne!(rows(screen_text(&mut app, &model, (110, 30)).unwrap()), before);
    }
}

#[test]
fn a_search_finds_older_and_newer_frames_by_bytes_and_by_name() {
    let mut model = model();
    let (mut app, _orders) = app(View::Trace);
    press(&mut app, &mut model, "/09f802\n");
    let found = app.cursor.unwrap();
    press(&mut app, &mut model, "n");
    let older = app.cursor.unwrap();
    assert!(older < found);
    press(&mut app, &mut model, "N");
    assert_eq!(app.cursor, Some(found));
    press(&mut app, &mut model, "/positionrapid\n");
    let record = model.history.get(app.cursor.unwrap()).unwrap();
    assert_eq!(record.frame().unwrap().id().to_string(), "09F80102");
    press(&mut app, &mut model, "/7FF#1234\n");
    assert_eq!(app.message, "'7FF#1234' is not there");
    press(&mut app, &mut model, "y");
    assert!(app.clipboard.unwrap().contains("can0 09F80102#"));
}

#[test]
fn nothing_is_sent_while_listening_only_and_the_way_out_is_shown() {
    let mut model = model();
    let (mut app, orders) = app(View::Send);
    press(&mut app, &mut model, "a123#11 100ms\n\n ");
    assert_eq!(app.message, "listen-only: nothing is sent; press m to take part in the bus");
    assert!(orders.try_recv().is_err());
    press(&mut app, &mut model, "m");
    assert!(matches!(orders.try_recv().unwrap(), Order::Open(plan) if plan.mode() == Mode::Normal));
    press(&mut app, &mut model, "\n");
    assert!(matches!(orders.try_recv().unwrap(), Order::Send(Channel::Can1, _)));
    press(&mut app, &mut model, " ");
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(Channel::Can1, 0, Some(_))));
    press(&mut app, &mut model, "d");
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(Channel::Can1, 0, None)));
    assert!(app.send.is_empty());
}

#[test]
fn what_is_typed_wrong_is_explained_and_stays_to_be_mended() {
    let mut model = model();
    let (mut app, _orders) = app(View::Send);
    press(&mut app, &mut model, "a123#1\n");
    assert!(app.message.contains("pairs of hexadecimal digits"), "{}", app.message);
    assert_eq!(app.prompt.as_ref().unwrap().line.text(), "123#1");
    press(&mut app, &mut model, "1\n");
    assert_eq!((app.prompt.is_none(), app.send.len()), (true, 1));
    press(&mut app, &mut model, "b");
    assert_eq!(app.prompt.as_ref().unwrap().line.text(), "1:250000");
}

#[test]
fn clearing_forgets_what_was_seen_only() {
    let mut model = model();
    let (mut app, _orders) = app(View::Fixed);
    press(&mut app, &mut model, "tc");
    assert_eq!(
        (model.seen.table.rows().len(), model.seen.taken, model.seen.statistics.channels().len()),
        (0, 0, 0)
    );
    assert_eq!(app.time_mode, TimeMode::Delta);
    screen_text(&mut app, &model, (80, 24)).unwrap();
}

#[test]
fn rows_can_be_hidden_and_shown_and_sorted() {
    let mut model = model();
    let (mut app, _orders) = app(View::Fixed);
    screen_text(&mut app, &model, (80, 24)).unwrap();
    let all = app.fixed_order.len();
    press(&mut app, &mut model, "x");
    screen_text(&mut app, &model, (80, 24)).unwrap();
    assert_eq!(app.fixed_order.len(), all - 1);
    press(&mut app, &mut model, "us");
    screen_text(&mut app, &model, (80, 24)).unwrap();
    assert_eq!((app.fixed_order.len(), app.fixed_order[0].1.to_string().as_str()), (all, "19FA0402"));
    press(&mut app, &mut model, "S");
    screen_text(&mut app, &model, (80, 24)).unwrap();
    assert_eq!(app.fixed_order.last().unwrap().1.to_string(), "19FA0402");
}

#[test]
fn q_leaves_and_so_does_ctrl_c() {
    let mut model = model();
    let (mut app, _orders) = app(View::Trace);
    let key = |code, modifiers| KeyEvent::new(code, modifiers);
    assert_eq!(app.key(key(KeyCode::Char('q'), KeyModifiers::NONE), &mut model), Flow::Quit);
    assert_eq!(app.key(key(KeyCode::Char('c'), KeyModifiers::CONTROL), &mut model), Flow::Quit);
}
