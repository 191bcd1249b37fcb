//! The pages with real traffic, as whole screens, and what the keys do.
//!
//! The screens are files in `snapshots/`. After an intended change, rewrite them with
//! `CANTAP_OVERWRITE=1 cargo test -p cantap-tui` and check the difference.

mod colours;
mod graph;
mod help;
mod keys;
mod pages;
mod random;
mod vehicle;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::Receiver;

use cantap::device::ClockReport;
use cantap::wire::BitTiming;
use cantap::wire::message::{ChannelConfig, ChannelStatus, Mode, Status};
use cantap::wire::record::{BusErrorKind, ErrorState, LossStage};
use cantap::{Channel, Direction, TraceEvent, TraceRecord};
use cantap_analysis::stats::Options;
use cantap_formats::{ReadOptions, open_reader};
use cantap_protocols::Assembler as _;
use cantap_protocols::diagnostics::Diagnostics;
use cantap_scripts::{Outcome, ScriptCounts, TestResult};
use cantap_signals::{Decoder, Source};
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

use super::app::{App, Flow, View};
use super::model::{DeviceFigures, LineKind, Model, ScriptState, Scripts, SourceState, VehicleSeen};
use super::order::Order;
use super::plan::Plan;
use super::theme::Theme;
use super::{orders, screen, text};
use cantap_work::obd::{Asked, AskingState};
use cantap_work::recording::RecordingState;

use cantap_address::Address;

/// A small screen and a wide one.
const SIZES: [(u16, u16); 2] = [(80, 24), (160, 50)];

/// An engine whose frames may leave out the brake, and a door.
const SIGNALS: &str = r#"
    version = 1
    [[message]]
    name = "Engine"
    id = 0x100
    length = 3
    [[message.signal]]
    name = "Speed"
    at = "D1"
    unit = "rpm"
    [[message.signal]]
    name = "OilTemp"
    at = "D2"
    alarm = { max = 120 }
    [[message.signal]]
    name = "Brake"
    at = "D3"
    digital = { low = 0, high = 1 }
    [[message]]
    name = "Body"
    id = 0x200
    length = 1
    [[message.signal]]
    name = "Door"
    at = "D1"
"#;

fn here() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src/snapshots")
}

/// Two minutes of a boat's bus, with an error, a loss, and frames on a second channel in between.
fn model() -> Model {
    let database = cantap_signals::load(&here().join("nmea2000.toml")).unwrap();
    assert_eq!(database.warnings, []);
    let decoder = Decoder::new(vec![Source { channel: None, database }]);
    let options = Options { bitrate_bps: Some(250_000), ..Options::default() };
    let mut model = Model::new(decoder.into(), options, 1_000_000).unwrap();
    model.seen.signals.choose("Speed").unwrap();
    model.seen.signals.choose("Course").unwrap();
    model.seen.signals.choose("Moving").unwrap();
    let log = Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/formats/tests/data/nmea2000.log.gz");
    let records = open_reader(log, &ReadOptions::default()).unwrap();
    let mut records: Vec<_> = records.take(6000).map(Result::unwrap).collect();
    let before = records[5993].time_ns;
    let insert = |time_ns, channel, event| TraceRecord { time_ns, device_ns: None, channel, event };
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

/// A board's figures about itself in the middle of its work.
fn device() -> DeviceFigures {
    let mut figures = DeviceFigures {
        queue_bytes: 98_304,
        name: "olimex-p405 3A0042001951".to_owned(),
        reconnects: 1,
        clock: Some(ClockReport {
            drift_ppm: Some(-12.34),
            round_trip_ns: 412_000,
            ..ClockReport::default()
        }),
        ..DeviceFigures::default()
    };
    let closed = ChannelStatus {
        open: None,
        state: ErrorState::Active,
        tec: 0,
        rec: 0,
        last_error: None,
        frames: 5999,
        lost_controller: 0,
        lost_queue: 17,
        bus_errors: 1,
        transmitted: 3,
        transmit_failures: 1,
        tx_pending: 2,
    };
    let timing = BitTiming::choose(36_000_000, 250_000, None).unwrap();
    let listening = ChannelConfig::listen_only(timing);
    figures.status = Some(Status {
        ticks: 0,
        queue_bytes: 4_915,
        queue_high_water_bytes: 49_152,
        bad_requests: 0,
        temperature_decicelsius: None,
        supply_millivolts: None,
        channels: [
            ChannelStatus { open: Some(listening), state: ErrorState::Warning, rec: 97, ..closed },
            closed,
        ],
    });
    figures.counters.channels[0].received = 5999;
    figures.counters.bytes = 91_784;
    figures
}

fn app(view: View) -> (App, Receiver<Order>) {
    let (sender, receiver) = orders();
    let theme = Theme { colour: true, light: false, unicode: true };
    let options = Options { channel_bitrate_bps: vec![(1, 250_000)], ..Options::default() };
    let plan = Plan::listening(vec![Address::of_virtual_device()], &options);
    (App::new(view, theme, Some(plan), sender), receiver)
}

/// Scripts as they are in the middle of their work.
fn scripts(scripts: &mut Scripts) {
    for name in ["node:obd?speed=72", "tester.rhai", "broken.rhai"] {
        scripts.add(name);
        scripts.begin(name);
    }
    let test = |name: &str, outcome: Outcome, trace: &[&str]| TestResult {
        script: "tester.rhai".to_owned(),
        name: name.to_owned(),
        outcome,
        began_ns: 0,
        ended_ns: 10_316_000,
        trace: trace.iter().map(ToString::to_string).collect(),
        trace_after: Vec::new(),
    };
    scripts.take_test(&test("test_speed", Outcome::Passed, &[]));
    let frames = ["(1.000104) can0 7DF#02010D", "(1.000389) can0 7E8#03410D48"];
    scripts.take_test(&test("test_rpm", Outcome::Failed("not so: idle\u{1b}[2J".to_owned()), &frames));
    scripts.set_state("tester.rhai", ScriptState::Running(Some("test_trouble_codes".to_owned())));
    scripts.say(LineKind::Log, "1.250000 tester.rhai: two\nlines");
    scripts.fail("broken.rhai", "there is no signal Sped; line 3");
    scripts.counts = ScriptCounts { sent: 120, received: 4711, waiting: 2, not_sent: 1, lost: 0 };
    let gateway = [
        "Gateway running. 1>2: 4711 received, 4700 sent, 11 dropped; 2>1: 0 received, 0 sent",
        "from rule                  matched     sent  dropped replaced     lost   failed",
        "1    100:7FF                    11        0       11        0        0        0",
        "1    000:000                  4700     4700        0        0        0        0",
    ];
    scripts.gateway = gateway.map(str::to_owned).to_vec();
}

/// A vehicle in the second round: the gearbox's ECU does not answer for the speed any more.
fn answers_of(vehicle: &mut VehicleSeen) {
    let round = |answers: &[&str]| {
        let (mut reader, mut events) = (Diagnostics::new(&[], false), Vec::new());
        for (at, text) in answers.iter().enumerate() {
            let time_ns = at as i64 * 1_000_000;
            let record = TraceRecord { time_ns, device_ns: None, channel: 1, event: frame(text) };
            reader.take(&record, &mut events);
        }
        let events = events.into_iter().filter(cantap_work::obd::is_answer).map(Asked::Answer);
        std::iter::once(Asked::Round).chain(events).collect::<Vec<_>>()
    };
    vehicle.take(round(&[
        "7DF#02010C5555555555",
        "7E8#04410C0FA0000000",
        "7DF#02010D5555555555",
        "7E8#03410D3200000000",
        "7E9#03410D3200000000",
    ]));
    vehicle.take(round(&[
        "7DF#02010C5555555555",
        "7E8#04410C1388000000",
        "7DF#02010D5555555555",
        "7E8#03410D3300000000",
    ]));
    vehicle.take(vec![Asked::State(AskingState::Asking {
        channel: Channel::Can1,
        ecus: "7E8, 7E9".to_owned(),
        parameters: 2,
        silent: String::new(),
        is_shared: false,
    })]);
}

/// A decoder from the text of a signal file.
fn database(text: &str) -> Arc<Decoder> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.toml");
    std::fs::write(&path, text).unwrap();
    let database = cantap_signals::load(&path).unwrap();
    assert_eq!(database.warnings, []);
    Arc::new(Decoder::new(vec![Source { channel: None, database }]))
}

fn frame(text: &str) -> TraceEvent {
    TraceEvent::Frame { frame: text.parse().unwrap(), direction: Direction::Rx, late: false }
}

fn screen_text(app: &mut App, model: &Model, size: (u16, u16)) -> anyhow::Result<String> {
    Ok(text(&screen(app, model, size)?))
}

fn press(app: &mut App, model: &mut Model, keys: &str) {
    for key in keys.chars() {
        let code = if key == '\n' { KeyCode::Enter } else { KeyCode::Char(key) };
        assert_eq!(app.key(KeyEvent::new(code, KeyModifiers::NONE), model), Flow::GoOn, "{key:?}");
    }
}

/// Compares a screen with the file with that name.
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
    if view == View::Statistics {
        model.seen.devices = vec![device()];
    }
    if view == View::Record {
        model.recording = Some(RecordingState {
            path: "boat.blf".into(),
            records: 6002,
            bytes: 48_213,
            since_ns: model.first_ns.unwrap(),
            ..RecordingState::default()
        });
    }
    if view == View::Scripts {
        scripts(&mut model.scripts);
    }
    if view == View::Obd {
        answers_of(&mut model.vehicle);
        app.plan.as_mut().unwrap().open.mode = Some(Mode::Normal);
    }
    for size in SIZES {
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

/// The boat's nodes, and their events.
#[test]
fn the_nodes_page_is_as_agreed() {
    check_page(View::Nodes);
}

/// A test that failed, a script that ended with an error, a ready node, and a gateway.
#[test]
fn the_scripts_page_is_as_agreed() {
    check_page(View::Scripts);
}

/// Two ECUs, one of which has stopped to answer one parameter.
#[test]
fn the_page_of_a_vehicle_is_as_agreed() {
    check_page(View::Obd);
}

/// A transfer is shown until it is done, and a fault is visible.
#[test]
fn transfers_under_way_are_shown_until_they_end() {
    let mut model = Model::new(database("version = 1"), Options::default(), 1_000_000).unwrap();
    let at = |ms: i64, text: &str| TraceRecord {
        time_ns: ms * 1_000_000,
        device_ns: None,
        channel: 1,
        event: frame(text),
    };
    let talk = |from: i64| {
        [
            at(from, "7E0#0322F190"),
            at(from + 1, "7E8#101462F190575657"),
            at(from + 2, "7E0#300000"),
            at(from + 3, "7E8#215A5A5A314B5A41"),
        ]
    };
    let rest = |from: i64| [at(from + 4, "7E8#2257303030303031")];
    model.take(&[&talk(0)[..], &rest(0), &talk(4000)].concat());
    let (mut app, _orders) = app(View::Nodes);
    let open = screen_text(&mut app, &model, (160, 24)).unwrap();
    assert!(open.contains("Transfers under way 1") && open.contains("7E8 > 7E0  13 of 20 bytes"), "{open}");
    model.take(&rest(4000));
    let done = screen_text(&mut app, &model, (160, 24)).unwrap();
    assert!(
        done.contains("Transfers under way 0") && done.contains("7E8             2, WVWZZZ1KZAW000001"),
        "{done}"
    );
    press(&mut app, &mut model, "c");
    assert!(screen_text(&mut app, &model, (160, 24)).unwrap().contains("Nobody was understood so far"));
}

#[test]
fn the_help_lies_over_the_page() {
    let mut model = model();
    let (mut app, _orders) = app(View::Fixed);
    press(&mut app, &mut model, "h");
    for (width, height) in SIZES {
        let text = screen_text(&mut app, &model, (width, height)).unwrap();
        check(&format!("help-{width}x{height}"), &text);
    }
    press(&mut app, &mut model, "h");
    assert!(!app.help);
}

/// The question, the input and any error are visible on the smallest usual screen.
#[test]
fn a_line_of_input_is_in_sight_whatever_is_asked() {
    let mut model = model();
    let (mut app, _orders) = app(View::Record);
    press(
        &mut app,
        &mut model,
        "r/home/somebody/measurements/2026-11-21/a-long-way-from-here-to-there.blf if ",
    );
    press(&mut app, &mut model, "Speed > 80");
    check("prompt-80x24", &screen_text(&mut app, &model, (80, 24)).unwrap());
    model.notice =
        "profile /home/somebody/measurements/car.toml, line 3: unknown field `speed`, expected one of \
                    `device`, `bitrates`, `normal`, `databases`"
            .to_owned();
    app.prompt = None;
    check("notice-80x24", &screen_text(&mut app, &model, (80, 24)).unwrap());
}

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
