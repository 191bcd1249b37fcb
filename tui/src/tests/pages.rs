//! Rows that open, lists that are searched, sorted and filtered, and the content of the second line.

use cantap::wire::record::ErrorState;
use cantap::{TraceEvent, TraceRecord};
use cantap_analysis::stats::Options;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers, MouseButton, MouseEvent, MouseEventKind};
use ratatui::style::Modifier;

use super::super::app::{App, Request, SignalColumn, View};
use super::super::model::{Model, Playing, SourceState};
use super::super::order::Order;
use super::super::screen;
use super::{SIGNALS, app, database, frame, model, press, screen_text};

fn car() -> Model {
    let mut model = Model::new(database(SIGNALS), Options::default(), 1_000_000).unwrap();
    let at = |s: i64, text: &str| TraceRecord {
        time_ns: s * 1_000_000_000,
        device_ns: None,
        channel: 1,
        event: frame(text),
    };
    model.take(&[at(43_200, "100#0A64"), at(43_201, "200#01"), at(43_202, "100#14C8")]);
    model.source = SourceState::Running;
    model
}

fn click(app: &mut App, model: &mut Model, column: u16, row: u16) {
    let kind = MouseEventKind::Down(MouseButton::Left);
    app.mouse(MouseEvent { kind, column, row, modifiers: KeyModifiers::NONE }, model);
}

#[test]
fn a_row_opens_to_its_signals_and_on_wide_screens_they_stand_beside_it() {
    let mut model = car();
    let (mut app, _orders) = app(View::Fixed);
    let narrow = screen_text(&mut app, &model, (80, 24)).unwrap();
    assert!(!narrow.contains("OilTemp"), "{narrow}");
    press(&mut app, &mut model, "\n");
    let opened = screen_text(&mut app, &model, (80, 24)).unwrap();
    let line = |text: &str, part: &str| text.lines().position(|line| line.contains(part)).unwrap();
    assert_eq!(line(&opened, "Speed"), line(&opened, "14 C8") + 1, "{opened}");
    assert!(opened.contains("20 rpm") && opened.contains("200 ▲"), "{opened}");
    assert!(line(&opened, "200 ") > line(&opened, "OilTemp") || opened.contains("Body"));
    // A signal's line belongs to its row.
    app.key(KeyEvent::from(KeyCode::Down), &mut model);
    press(&mut app, &mut model, "\n");
    assert!(!screen_text(&mut app, &model, (80, 24)).unwrap().contains("OilTemp"));
    let wide = screen_text(&mut app, &model, (160, 24)).unwrap();
    assert!(wide.lines().any(|line| line.contains("Engine  Speed 20 rpm  OilTemp 200▲")), "{wide}");
    // In the trace: those of the selected record.
    press(&mut app, &mut model, "1\n");
    let trace = screen_text(&mut app, &model, (80, 24)).unwrap();
    assert!(trace.contains("1 100  Engine") && trace.contains("20 rpm"), "{trace}");
    app.key(KeyEvent::from(KeyCode::Home), &mut model);
    assert!(screen_text(&mut app, &model, (80, 24)).unwrap().contains("10 rpm"));
}

#[test]
fn signals_are_searched_grouped_sorted_and_narrowed() {
    let mut model = car();
    let (mut app, _orders) = app(View::Signals);
    let names = |app: &mut App, model: &Model| -> Vec<String> {
        let text = screen_text(app, model, (110, 24)).unwrap();
        let lines = text.lines().skip(3).take_while(|line| !line.is_empty());
        lines.map(|line| line.split_whitespace().find(|word| word.len() > 1).unwrap().to_owned()).collect()
    };
    assert_eq!(names(&mut app, &model), ["Engine.Speed", "Engine.OilTemp", "Body.Door"]);
    press(&mut app, &mut model, "/door\n");
    assert_eq!((app.view, app.selected), (View::Signals, 2));
    press(&mut app, &mut model, "/e\nn");
    assert_eq!(app.selected, 1);
    press(&mut app, &mut model, "N");
    assert_eq!(app.selected, 0);
    press(&mut app, &mut model, "/nothing\n");
    assert_eq!((app.selected, app.message.as_str()), (0, "'NOTHING' was not found"));
    press(&mut app, &mut model, "s");
    assert_eq!(names(&mut app, &model), ["Body.Door", "Engine.OilTemp", "Engine.Speed"]);
    // Clicks on headings sort; a second click reverses the order.
    let heading = screen_text(&mut app, &model, (110, 24)).unwrap().lines().nth(2).unwrap().to_owned();
    let column = heading.chars().collect::<String>().find("Value").unwrap() as u16;
    click(&mut app, &mut model, column, 2);
    assert_eq!(app.signals.sort, SignalColumn::Value);
    assert_eq!(names(&mut app, &model), ["Engine.OilTemp", "Engine.Speed", "Body.Door"]);
    click(&mut app, &mut model, column, 2);
    assert_eq!(names(&mut app, &model)[0], "Body.Door");
    press(&mut app, &mut model, "g");
    assert_eq!(names(&mut app, &model), ["Body", "Door", "Engine", "Speed", "OilTemp"]);
    // A message's name is not a signal.
    app.selected = 0;
    press(&mut app, &mut model, "\n");
    assert_eq!(model.seen.signals.graph_memory().0, 0);
    press(&mut app, &mut model, "gFengine and > 50\n");
    assert_eq!(names(&mut app, &model), ["Engine.OilTemp"]);
    press(&mut app, &mut model, "F");
    app.key(KeyEvent::from(KeyCode::End), &mut model);
    press(&mut app, &mut model, " and\n");
    let text = screen_text(&mut app, &model, (110, 24)).unwrap();
    assert!(text.contains("engine and > 50"), "{text}");
}

#[test]
fn the_fixed_page_is_narrowed_by_signals_with_a_condition_of_its_own() {
    let mut model = car();
    let (mut app, _orders) = app(View::Fixed);
    let ids = |app: &mut App, model: &Model| -> Vec<String> {
        screen_text(app, model, (110, 24)).unwrap();
        app.fixed_order.iter().map(|(_, id)| id.to_string()).collect()
    };
    assert_eq!(ids(&mut app, &model), ["100", "200"]);
    press(&mut app, &mut model, "Foiltemp > 100\n");
    assert_eq!(ids(&mut app, &model), ["100"]);
    let text = screen_text(&mut app, &model, (110, 24)).unwrap();
    assert!(text.contains("(F oiltemp > 100: 1 hidden)"), "{text}");
    // The signals page shows all; what is typed there is a separate condition.
    press(&mut app, &mut model, "3");
    assert!(screen_text(&mut app, &model, (110, 24)).unwrap().contains("Body.Door"));
    press(&mut app, &mut model, "2F");
    for _ in 0..20 {
        app.key(KeyEvent::from(KeyCode::Backspace), &mut model);
    }
    press(&mut app, &mut model, "alarm\n");
    assert_eq!(ids(&mut app, &model), ["100"]);
    model.take(&[TraceRecord {
        time_ns: 43_203_000_000_000,
        device_ns: None,
        channel: 1,
        event: frame("100#1464"),
    }]);
    assert_eq!(ids(&mut app, &model), [""; 0]);
}

#[test]
fn search_stays_on_its_page_and_headings_of_the_fixed_page_sort() {
    let mut model = model();
    let (mut app, _orders) = app(View::Fixed);
    screen_text(&mut app, &model, (80, 24)).unwrap();
    press(&mut app, &mut model, "/positionrapid\n");
    assert_eq!(app.view, View::Fixed);
    assert_eq!(app.fixed_order[app.selected].1.to_string(), "09F80102");
    press(&mut app, &mut model, "/19FB1101\nn");
    assert_eq!(app.fixed_order[app.selected], (2, "19FB1101#".parse::<cantap::Frame>().unwrap().id()));
    let text = screen_text(&mut app, &model, (80, 24)).unwrap();
    let count = text.lines().nth(2).unwrap().find("Count").unwrap() as u16;
    click(&mut app, &mut model, count, 2);
    screen_text(&mut app, &model, (80, 24)).unwrap();
    assert_eq!(app.fixed_order[0].1.to_string(), "19FA0402");
    click(&mut app, &mut model, count, 2);
    screen_text(&mut app, &model, (80, 24)).unwrap();
    assert_eq!(app.fixed_order.last().unwrap().1.to_string(), "19FA0402");
    press(&mut app, &mut model, "5/");
    assert!(app.prompt.is_none() && app.message.contains("nothing to search"), "{}", app.message);
}

#[test]
fn absolute_times_are_times_of_day() {
    let mut model = car();
    let (mut app, _orders) = app(View::Trace);
    press(&mut app, &mut model, "tt");
    let text = screen_text(&mut app, &model, (80, 24)).unwrap();
    assert!(text.contains("Time (UTC)") && text.contains(" 12:00:02.000000 1 R"), "{text}");
    assert!(!text.contains("NOT FOLLOWING"), "{text}");
    app.key(KeyEvent::from(KeyCode::Up), &mut model);
    assert!(screen_text(&mut app, &model, (80, 24)).unwrap().contains("NOT FOLLOWING"));
    app.key(KeyEvent::from(KeyCode::End), &mut model);
    assert!(!screen_text(&mut app, &model, (80, 24)).unwrap().contains("NOT FOLLOWING"));
}

#[test]
fn the_second_line_tells_mode_rates_errors_and_bus_off_as_far_as_there_is_room() {
    let mut model = model();
    let (mut app, _orders) = app(View::Fixed);
    press(&mut app, &mut model, "my");
    let state = TraceEvent::State { state: ErrorState::BusOff, counters: None };
    model.take(&[TraceRecord { time_ns: model.seen.now_ns, device_ns: None, channel: 1, event: state }]);
    let wide = screen(&mut app, &model, (160, 24)).unwrap();
    let line: String = (0..160).map(|column| wide[(column, 1)].symbol()).collect();
    for part in ["virtual NORMAL: running", "1: BUS-OFF, R recovers", "1 250k ", "/s", "errors 1", "lost 17"]
    {
        assert!(line.contains(part), "{part}: {line}");
    }
    let at = line.find("NORMAL").unwrap() as u16;
    assert!(wide[(at, 1)].modifier.contains(Modifier::BOLD));
    // What must be seen is visible on the smallest usual screen, too.
    let narrow = screen_text(&mut app, &model, (80, 24)).unwrap();
    let line = narrow.lines().nth(1).unwrap();
    for part in ["NORMAL", "BUS-OFF", "errors 1", "lost 17"] {
        assert!(line.contains(part), "{part}: {line}");
    }
}

#[test]
fn a_file_tells_where_it_is_and_goes_where_it_is_told() {
    let mut model = car();
    let (mut app, orders) = app(View::Fixed);
    (app.plan, app.file) = (None, Some("drive.log".to_owned()));
    let s = 1_000_000_000;
    let playing = Playing {
        factor: 0.2,
        first_ns: 100 * s,
        position_ns: 130 * s,
        end_ns: Some(220 * s),
        ..Playing::default()
    };
    model.source = SourceState::Playing(playing);
    let text = screen_text(&mut app, &model, (100, 24)).unwrap();
    assert!(text.contains(" drive.log: playing ×5 0:30 / 2:00  ") && text.contains("━●─"), "{text}");
    let sought = || match orders.try_recv() {
        Ok(Order::Seek(time_ns)) => time_ns / s,
        other => panic!("{other:?}"),
    };
    press(&mut app, &mut model, "]");
    assert_eq!(sought(), 140);
    press(&mut app, &mut model, "T50%\n");
    assert_eq!(sought(), 160);
    press(&mut app, &mut model, "T1:45\n");
    assert_eq!(sought(), 205);
    press(&mut app, &mut model, "T9:00\n");
    assert_eq!(sought(), 220);
    press(&mut app, &mut model, "B");
    model.source = SourceState::Playing(Playing { position_ns: 150 * s, ..playing });
    press(&mut app, &mut model, "{");
    assert_eq!(sought(), 130);
    press(&mut app, &mut model, "}");
    assert!(app.message.contains("no bookmark that way"), "{}", app.message);
    assert!(screen_text(&mut app, &model, (100, 24)).unwrap().contains('◆'));
    // A click on the bar's end, then on its beginning.
    let bar = app.bar.unwrap();
    click(&mut app, &mut model, bar.x + bar.width - 1, 1);
    assert_eq!(sought(), 220);
    click(&mut app, &mut model, bar.x, 1);
    assert_eq!(sought(), 100);
    // One key pauses and resumes it; at the end it restarts.
    press(&mut app, &mut model, " ");
    assert!(matches!(orders.try_recv(), Ok(Order::TogglePause)));
    model.source = SourceState::Playing(Playing { ended: true, ..playing });
    press(&mut app, &mut model, " ");
    assert_eq!(sought(), 100);
    assert!(orders.try_recv().is_err());
}

#[test]
fn bookmarks_of_what_a_device_sent_select_it() {
    let mut model = model();
    let (mut app, _orders) = app(View::Trace);
    press(&mut app, &mut model, "/09f802\nB");
    let marked = app.cursor;
    app.key(KeyEvent::from(KeyCode::End), &mut model);
    press(&mut app, &mut model, "{");
    let time = |place: Option<u64>| model.history.get(place.unwrap()).unwrap().time_ns;
    assert_eq!(time(app.cursor), time(marked));
}

#[test]
fn a_trace_opens_beside_and_a_database_decodes_what_was_seen_before() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.display().to_string()
    };
    let trace = write("drive.log", "(1.0) can0 123#11\n");
    let database = write("car.toml", SIGNALS);
    let mut model = Model::new(super::database("version = 1\n"), Options::default(), 1_000_000).unwrap();
    model.take(&[TraceRecord { time_ns: 0, device_ns: None, channel: 1, event: frame("100#0A64") }]);
    let (mut app, orders) = app(View::Signals);
    press(&mut app, &mut model, "D");
    app.key(KeyEvent::new(KeyCode::Char('u'), KeyModifiers::CONTROL), &mut model);
    press(&mut app, &mut model, &format!("{trace}\n"));
    assert_eq!(app.request.take(), Some(Request::Open(trace.clone().into())));
    press(&mut app, &mut model, &format!("O{trace}\n"));
    assert_eq!(app.request.take(), Some(Request::Open(trace.into())));
    // A typing error is not a device.
    press(&mut app, &mut model, "D");
    app.key(KeyEvent::new(KeyCode::Char('u'), KeyModifiers::CONTROL), &mut model);
    press(&mut app, &mut model, "/nothing/drive.blf\n");
    assert_eq!(app.message, "there is no file /nothing/drive.blf");
    app.key(KeyEvent::from(KeyCode::Esc), &mut model);
    // What was running is untouched.
    assert!(orders.try_recv().is_err() && app.plan.is_some());
    press(&mut app, &mut model, "O/nothing.dbc\n");
    assert!(app.prompt.is_some() && app.message.contains("/nothing.dbc"), "{}", app.message);
    app.key(KeyEvent::from(KeyCode::Esc), &mut model);
    press(&mut app, &mut model, &format!("O{database}\n"));
    let text = screen_text(&mut app, &model, (100, 24)).unwrap();
    assert!(text.contains("Engine.OilTemp"), "{text}");
    press(&mut app, &mut model, "w");
    assert_eq!(app.request, Some(Request::Next));
}

#[test]
fn what_is_sent_is_completed_from_the_database() {
    let mut model = car();
    let (mut app, _orders) = app(View::Send);
    press(&mut app, &mut model, "aeng");
    app.key(KeyEvent::from(KeyCode::Tab), &mut model);
    assert_eq!(app.prompt.as_ref().unwrap().line.text(), "Engine:");
    app.key(KeyEvent::from(KeyCode::Tab), &mut model);
    assert_eq!(app.message, "Brake  OilTemp  Speed");
    press(&mut app, &mut model, "s");
    app.key(KeyEvent::from(KeyCode::Tab), &mut model);
    press(&mut app, &mut model, "30,o");
    app.key(KeyEvent::from(KeyCode::Tab), &mut model);
    press(&mut app, &mut model, "5 100ms\n");
    assert_eq!(app.send[0].text, "Engine:Speed=30,OilTemp=5 100ms");
    assert_eq!(app.send[0].frame.to_string(), "100#1E0500");
}
