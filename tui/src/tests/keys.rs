//! What the keys do.

use cantap::TraceRecord;
use cantap::wire::message::Mode;
use cantap_analysis::stats::Options;
use cantap_signals::Decoder;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers, MouseButton, MouseEvent, MouseEventKind};

use super::super::app::{Flow, TimeMode, View};
use super::super::model::{Model, Playing, SourceState};
use super::super::order::Order;
use super::{app, model, press, screen_text};

#[test]
fn pausing_stops_the_display_but_not_the_model() {
    let mut model = model();
    for view in [View::Trace, View::Fixed] {
        let (mut app, _orders) = app(view);
        press(&mut app, &mut model, " ");
        let rows = |text: String| text.lines().skip(2).map(str::to_owned).collect::<Vec<_>>();
        let before = rows(screen_text(&mut app, &model, (110, 30)).unwrap());
        let last = model.history.get(model.history.end() - 1).unwrap();
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
    assert_eq!(app.message, "'7FF#1234' was not found");
    press(&mut app, &mut model, "y");
    assert!(app.clipboard.unwrap().contains("can0 09F80102#"));
}

/// A long trace is searched a piece at a time, and keys are handled meanwhile.
#[test]
fn a_long_search_goes_on_between_drawings_and_can_be_stopped() {
    let mut model = Model::new(Decoder::new(Vec::new()).into(), Options::default(), 16_000_000).unwrap();
    let record = |n: i64| {
        let event = super::frame(if n == 1000 { "7AB#" } else { "123#11" });
        TraceRecord { time_ns: n, device_ns: None, channel: 1, event }
    };
    model.take(&(0..350_000).map(record).collect::<Vec<_>>());
    let (mut app, _orders) = app(View::Trace);
    press(&mut app, &mut model, "/7ab\n");
    let mut drawings = 0;
    while app.cursor.is_none() {
        assert_eq!(app.message, "looking for '7AB'; any key stops");
        app.catch_up(&mut model);
        drawings += 1;
    }
    assert_eq!((app.cursor, drawings, app.message.as_str()), (Some(1000), 3, ""));
    press(&mut app, &mut model, "N");
    assert!(app.message.starts_with("looking for"));
    press(&mut app, &mut model, "j");
    for _ in 0..5 {
        app.catch_up(&mut model);
    }
    // It stopped, and did nothing else.
    assert_eq!((app.cursor, app.message.as_str()), (Some(1000), ""));
    press(&mut app, &mut model, "N");
    for _ in 0..5 {
        app.catch_up(&mut model);
    }
    assert_eq!((app.cursor, app.message.as_str()), (Some(1000), "'7AB' was not found"));
}

#[test]
fn nothing_is_sent_while_listening_only_and_the_way_out_is_shown() {
    let mut model = model();
    let (mut app, orders) = app(View::Send);
    press(&mut app, &mut model, "a123#11 100ms\n\n ");
    assert_eq!(app.message, "listen-only: nothing is sent; press m to take part in the bus");
    assert!(orders.try_recv().is_err());
    press(&mut app, &mut model, "my");
    assert!(matches!(orders.try_recv().unwrap(), Order::Open(plan) if plan.mode() == Mode::Normal));
    press(&mut app, &mut model, "\n");
    assert!(matches!(orders.try_recv().unwrap(), Order::Send(1, _)));
    press(&mut app, &mut model, " ");
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(1, 0, Some(_))));
    press(&mut app, &mut model, "d");
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(1, 0, None)));
    assert!(app.send.is_empty());
}

#[test]
fn a_recording_that_is_refused_stays_to_be_mended() {
    let mut model = model();
    let (mut app, orders) = app(View::Record);
    let folder = tempfile::tempdir().unwrap();
    let text = |name: &str, rest: &str| format!("{}{rest}", folder.path().join(name).display());
    for refused in [text("a.blf", " if Nothing >"), text("no/a.blf", ""), text("a.nothing", "")] {
        press(&mut app, &mut model, &format!("r{refused}\n"));
        assert!(!app.message.is_empty(), "{refused}");
        assert_eq!(app.prompt.as_ref().map(|prompt| prompt.line.text()), Some(refused));
        app.prompt = None;
    }
    assert!(orders.try_recv().is_err());
    press(&mut app, &mut model, &format!("r{}\n", text("a.blf", " if id == 0x123")));
    assert!(
        app.prompt.is_none() && matches!(orders.try_recv().unwrap(), Order::Record(_)),
        "{}",
        app.message
    );
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

#[test]
fn a_filter_hides_what_was_seen_before_too_and_gives_it_back() {
    let mut model = model();
    let (mut app, _orders) = app(View::Trace);
    let all = model.history.end();
    let show = |view: View, app: &mut super::App, model: &super::Model| {
        app.view = view;
        screen_text(app, model, (110, 40)).unwrap()
    };
    press(&mut app, &mut model, "f09F80202:1FFFFFFF\n");
    for view in [View::Trace, View::Fixed, View::Signals] {
        let text = show(view, &mut app, &model);
        assert!(text.contains("FILTER") && text.contains("CogSogRapid"), "{text}");
        assert!(!text.contains("PositionRapid") && !text.contains("09F80102"), "{text}");
    }
    // Losses are shown regardless of filters.
    assert!(show(View::Trace, &mut app, &model).contains("17 frames lost"));
    let listed = model.history.end() - model.history.first();
    assert!((300..1000).contains(&listed), "{listed}");
    // New records are filtered in the same way, and statistics and recording take everything.
    let last = model.history.get(model.history.end() - 1).unwrap();
    let other = TraceRecord { event: super::frame("123#11"), ..last };
    model.take(&[last, other]);
    assert_eq!(model.history.end() - model.history.first(), listed + 1);
    press(&mut app, &mut model, "f");
    app.key(KeyEvent::new(KeyCode::Char('u'), KeyModifiers::CONTROL), &mut model);
    press(&mut app, &mut model, "\n");
    assert_eq!(model.history.end(), all + 2);
    assert!(show(View::Trace, &mut app, &model).contains("123 D 1 11"));
    assert!(show(View::Fixed, &mut app, &model).contains("PositionRapid"));
}

#[test]
fn the_selected_record_stays_selected_when_the_filter_changes() {
    let mut model = model();
    let (mut app, _orders) = app(View::Trace);
    press(&mut app, &mut model, "/09F80202\n");
    let selected = model.history.get(app.cursor.unwrap()).unwrap();
    press(&mut app, &mut model, "f09F80202:1FFFFFFF\n");
    assert_eq!(model.history.get(app.cursor.unwrap()).unwrap(), selected);
    // Nothing passes: nothing is selected, and all keys work.
    press(&mut app, &mut model, "f,7FF:7FF\n");
    screen_text(&mut app, &model, (80, 24)).unwrap();
    press(&mut app, &mut model, "njky ");
    app.key(KeyEvent::from(KeyCode::Home), &mut model);
    screen_text(&mut app, &model, (80, 24)).unwrap();
}

#[test]
fn while_the_display_stands_still_rows_can_be_hidden_and_values_do_not_move() {
    let mut model = model();
    for view in [View::Signals, View::Graph, View::Statistics] {
        let (mut app, _orders) = app(view);
        press(&mut app, &mut model, " ");
        let page = |text: String| text.lines().skip(2).map(str::to_owned).collect::<Vec<_>>();
        let before = page(screen_text(&mut app, &model, (110, 30)).unwrap());
        let last = model.history.get(model.history.end() - 1).unwrap();
        let moved = TraceRecord { event: super::frame("09F80202#01FC6C000001FFFF"), ..last };
        model.take(&[TraceRecord { time_ns: last.time_ns + 1_000_000_000, ..moved }; 30]);
        let after = page(screen_text(&mut app, &model, (110, 30)).unwrap());
        // The memory in use is displayed correctly.
        let told =
            |lines: &[String]| lines.iter().filter(|line| !line.starts_with("Memory")).cloned().collect();
        let (before, after): (Vec<String>, Vec<String>) = (told(&before), told(&after));
        assert_eq!(before, after, "{view:?}");
    }
    let (mut app, _orders) = app(View::Fixed);
    press(&mut app, &mut model, " ");
    screen_text(&mut app, &model, (110, 30)).unwrap();
    let rows = app.fixed_order.len();
    press(&mut app, &mut model, "x");
    screen_text(&mut app, &model, (110, 30)).unwrap();
    assert_eq!(app.fixed_order.len(), rows - 1);
    press(&mut app, &mut model, " ");
    screen_text(&mut app, &model, (110, 30)).unwrap();
    assert_eq!(app.fixed_order.len(), rows - 1);
}

#[test]
fn an_entry_says_what_changes_and_a_group_goes_on_and_off_together() {
    let mut model = model();
    let (mut app, orders) = app(View::Send);
    press(&mut app, &mut model, "my");
    assert!(matches!(orders.try_recv().unwrap(), Order::Open(_)));
    press(&mut app, &mut model, "a123#0F22F000 5ms counter=0.0:4 checksum=3:xor group=engine\n");
    press(
        &mut app,
        &mut model,
        "aPositionRapid:Latitude=sine(-10,10,4s) 100ms group=engine\na124#11 group=engine\n",
    );
    assert_eq!(app.send.len(), 3, "{}", app.message);
    press(&mut app, &mut model, "g");
    let Ok(Order::SetPeriodic(1, 0, Some(first))) = orders.try_recv() else { panic!() };
    assert!(first.modifiers.len() == 2 && first.changing.is_none());
    // The last slot, since the device has only so many.
    let Ok(Order::SetPeriodic(1, 255, Some(second))) = orders.try_recv() else { panic!() };
    assert!(second.changing.is_some());
    // Without a period there is nothing to go on.
    assert!(orders.try_recv().is_err());
    press(&mut app, &mut model, "g");
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(1, 0, None)));
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(1, 255, None)));
    for (wrong, part) in [
        ("123#11 counter=0", "need a period"),
        ("123#11 5ms counter=1", "byte 1"),
        ("123#11 5ms count=1", "no option 'count'"),
        ("123#11 5ms 6ms", "one period too many"),
        ("PositionRapid:Latitude=sine(-10,10,4s)", "needs a period"),
        ("PositionRapid:Latitude=sine(-10,1000,4s) 100ms", "Latitude"),
        ("PositionRapid:Latitude=sin(-10,1000,4s) 100ms", "sine(LOW,HIGH,PERIOD)"),
    ] {
        press(&mut app, &mut model, &format!("a{wrong}\n"));
        assert!(app.message.contains(part), "{wrong}: {}", app.message);
        app.key(KeyEvent::from(KeyCode::Esc), &mut model);
    }
    app.key(KeyEvent::from(KeyCode::End), &mut model);
    press(&mut app, &mut model, "a125#\n");
    app.key(KeyEvent::from(KeyCode::End), &mut model);
    app.selected = 3;
    press(&mut app, &mut model, "g");
    assert!(app.message.contains("in no group"), "{}", app.message);
}

#[test]
fn an_entry_that_is_edited_while_it_is_sent_changes_on_the_bus() {
    let mut model = model();
    let (mut app, orders) = app(View::Send);
    press(&mut app, &mut model, "mya123#11 100ms\n ");
    assert!(matches!(orders.try_recv().unwrap(), Order::Open(_)));
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(1, 0, Some(_))));
    // To the other channel: it must end on the first one.
    press(&mut app, &mut model, "e");
    app.key(KeyEvent::from(KeyCode::Home), &mut model);
    press(&mut app, &mut model, "2:\n");
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(1, 0, None)));
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(2, 0, Some(_))));
    assert_eq!(app.send[0].text, "2:123#11 100ms");
    // Each has its own slot, and keeps it when others end.
    press(&mut app, &mut model, "a2:124#22 50ms\n");
    app.key(KeyEvent::from(KeyCode::Down), &mut model);
    press(&mut app, &mut model, " ");
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(2, 1, Some(_))));
    app.key(KeyEvent::from(KeyCode::Up), &mut model);
    press(&mut app, &mut model, "d");
    assert!(matches!(orders.try_recv().unwrap(), Order::SetPeriodic(2, 0, None)));
    assert_eq!((app.send.len(), app.send[0].slot), (1, Some(1)));
    // The device does not have this slot.
    model.refused.push((2, 1));
    app.catch_up(&mut model);
    assert_eq!(app.send[0].slot, None);
    assert!(orders.try_recv().is_err());
}

#[test]
fn a_letter_with_control_is_not_that_letter() {
    let mut model = model();
    let (mut app, orders) = app(View::Trace);
    for letter in ['q', 'c', 'm', 'r', 'A'] {
        let control = KeyEvent::new(KeyCode::Char(letter), KeyModifiers::CONTROL);
        let flow = app.key(control, &mut model);
        assert_eq!(flow == Flow::Quit, letter == 'c');
    }
    assert!(app.prompt.is_none() && orders.try_recv().is_err());
    // On a slow line, Escape and a letter arrive like this.
    let taken = model.seen.taken;
    for letter in ['q', 'c', 'm', 'r', 'A', 'd', 'z'] {
        assert_eq!(app.key(KeyEvent::new(KeyCode::Char(letter), KeyModifiers::ALT), &mut model), Flow::GoOn);
    }
    assert!(app.prompt.is_none() && orders.try_recv().is_err() && model.seen.taken == taken);
    let z = KeyEvent::new(KeyCode::Char('z'), KeyModifiers::CONTROL);
    assert_eq!(app.key(z, &mut model), Flow::Suspend);
}

#[test]
fn nothing_takes_part_in_a_bus_that_was_not_asked_for_just_now() {
    let mut model = model();
    let (mut app, orders) = app(View::Fixed);
    let modes = || -> Vec<Mode> {
        let plan = |order| match order {
            Order::Open(plan) => plan.mode(),
            other => panic!("{other:?}"),
        };
        orders.try_iter().map(plan).collect()
    };
    // It asks, and anything but a yes is a no.
    for no in ["mn", "m\n", "mm\n", "mxn"] {
        press(&mut app, &mut model, no);
        assert_eq!((modes(), app.message.as_str()), (Vec::new(), "it stays listen-only"), "{no}");
    }
    press(&mut app, &mut model, "my");
    assert_eq!(modes(), [Mode::Normal]);
    // With other bit rates or another device, it only listens, and says so.
    for other in ["b", "D"] {
        press(&mut app, &mut model, &format!("{other}\n"));
        assert_eq!(modes(), [Mode::ListenOnly], "{other}");
        assert!(app.message.starts_with("listen-only now"), "{}", app.message);
        press(&mut app, &mut model, "my");
        assert_eq!(modes(), [Mode::Normal]);
    }
    // Leaving the bus needs no confirmation.
    press(&mut app, &mut model, "m");
    assert_eq!(modes(), [Mode::ListenOnly]);
}

/// A vehicle at 500 kbit/s is mute at the bit rate of the board before.
#[test]
fn another_device_is_not_opened_at_the_bit_rates_of_the_one_before() {
    let mut model = model();
    let (mut app, orders) = app(View::Fixed);
    let opened = || match orders.try_recv() {
        Ok(Order::Open(plan)) => plan,
        other => panic!("{other:?}"),
    };
    press(&mut app, &mut model, "b");
    app.key(KeyEvent::new(KeyCode::Char('u'), KeyModifiers::CONTROL), &mut model);
    press(&mut app, &mut model, "1:250k\n");
    assert_eq!(opened().channels, [1]);
    // The same device keeps them.
    press(&mut app, &mut model, "D\n");
    assert!(opened().open.timing.is_given());
    press(&mut app, &mut model, "D");
    app.key(KeyEvent::new(KeyCode::Char('u'), KeyModifiers::CONTROL), &mut model);
    press(&mut app, &mut model, "virtual:car\n");
    let plan = opened();
    assert!(!plan.open.timing.is_given() && plan.mode() == Mode::ListenOnly, "{plan:?}");
    assert_eq!(plan.channels, [1, 2]);
}

/// The device knows its clock: what it would refuse is refused before it is left.
#[test]
fn an_impossible_bit_rate_does_not_give_up_a_device_that_runs() {
    let mut model = model();
    model.seen.devices = vec![super::DeviceFigures { can_clock_hz: Some(36_000_000), ..Default::default() }];
    let (mut app, orders) = app(View::Fixed);
    press(&mut app, &mut model, "b1:999999\n");
    assert!(app.message.contains("947368 and 1000000"), "{}", app.message);
    assert_eq!(app.prompt.as_ref().unwrap().line.text(), "1:999999");
    assert!(orders.try_recv().is_err());
    app.key(KeyEvent::new(KeyCode::Char('u'), KeyModifiers::CONTROL), &mut model);
    press(&mut app, &mut model, "1:125k\n");
    assert!(matches!(orders.try_recv().unwrap(), Order::Open(_)));
}

#[test]
fn a_key_that_was_pressed_to_continue_does_nothing_else() {
    let mut model = model();
    let (mut app, orders) = app(View::Trace);
    app.message = "a message that is far too long for one line of this screen ".repeat(2);
    let text = screen_text(&mut app, &model, (60, 20)).unwrap();
    assert!(text.contains("any key continues"), "{text}");
    assert_eq!(app.key(KeyEvent::from(KeyCode::Char('q')), &mut model), Flow::GoOn);
    assert!(!screen_text(&mut app, &model, (60, 20)).unwrap().contains("any key continues"));
    // A short one has made no promise.
    app.message = "short".to_owned();
    screen_text(&mut app, &model, (60, 20)).unwrap();
    press(&mut app, &mut model, "3");
    assert_eq!(app.view, View::Signals);
    press(&mut app, &mut model, "hq");
    assert!(!app.help && orders.try_recv().is_err());
    // What stays as long as it is true takes no key.
    model.source = super::SourceState::Gone(
        "the device is gone for a reason that needs more room than there is".to_owned(),
    );
    let text = screen_text(&mut app, &model, (60, 20)).unwrap();
    assert!(!text.contains("any key continues"), "{text}");
    press(&mut app, &mut model, "1");
    assert_eq!(app.view, View::Trace);
}

/// Found as a newcomer: at 40 columns the key that the sentence names was cut off.
#[test]
fn the_way_out_of_listening_only_is_in_sight_however_narrow_the_screen() {
    let mut model = model();
    for view in [View::Send, View::Scripts, View::Obd] {
        let (mut app, _orders) = app(view);
        let text = screen_text(&mut app, &model, (40, 12)).unwrap();
        let words = text.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(words.contains("m takes part in the bus"), "{text}");
    }
    // A click still finds its row.
    let (mut app, _orders) = app(View::Send);
    press(&mut app, &mut model, "a123#11\na124#11\n");
    let text = screen_text(&mut app, &model, (40, 12)).unwrap();
    let row = text.lines().position(|line| line.contains("124#11")).unwrap();
    app.selected = 0;
    let kind = MouseEventKind::Down(MouseButton::Left);
    let click = MouseEvent { kind, column: 5, row: row as u16, modifiers: KeyModifiers::NONE };
    app.mouse(click, &mut model);
    assert_eq!(app.selected, 1, "{text}");
}

/// Found as a newcomer: the last line said that Space stops the file, and on some pages it did not.
#[test]
fn the_space_bar_stops_a_file_on_every_page() {
    let mut model = model();
    for view in View::ALL {
        model.source = SourceState::Playing(Playing::default());
        let (mut app, orders) = app(view);
        app.plan = None;
        assert!(screen_text(&mut app, &model, (80, 24)).unwrap().contains("Space stop"), "{view:?}");
        press(&mut app, &mut model, " ");
        assert!(matches!(orders.try_recv(), Ok(Order::TogglePause)), "{view:?}");
    }
}
