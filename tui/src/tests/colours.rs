//! What is coloured, and how it can be distinguished without colours.

use std::sync::Arc;

use cantap::{TraceEvent, TraceRecord};
use cantap_analysis::stats::Options;
use cantap_signals::Decoder;
use ratatui::buffer::Buffer;
use ratatui::style::{Color, Modifier};

use super::super::app::{App, View};
use super::super::model::Model;
use super::super::screen;
use super::{app, database, frame, model, press, screen_text};

fn buffer(app: &mut App, model: &Model) -> Buffer {
    screen(app, model, (160, 50)).unwrap()
}

/// The colour and the modifiers of a text's first character.
fn style_of(buffer: &Buffer, text: &str) -> (Color, Modifier) {
    for row in 0..buffer.area.height {
        let line: String = (0..buffer.area.width).map(|column| buffer[(column, row)].symbol()).collect();
        if let Some(at) = line.find(text) {
            let column = line[..at].chars().count() as u16;
            let cell = &buffer[(column, row)];
            return (cell.fg, cell.modifier);
        }
    }
    panic!("there is no {text:?}");
}

#[test]
fn errors_are_red_and_what_follows_a_loss_is_yellow_with_the_number() {
    let model = model();
    let (mut app, _orders) = app(View::Trace);
    let dark = buffer(&mut app, &model);
    assert_eq!(style_of(&dark, "E bus error: crc").0, Color::LightRed);
    assert_eq!(style_of(&dark, "L 17 frames lost (queue)").0, Color::Yellow);
    assert_eq!(style_of(&dark, "17 lost before").0, Color::Yellow);
    app.theme.light = true;
    assert_eq!(style_of(&buffer(&mut app, &model), "E bus error: crc").0, Color::Red);
    app.theme.colour = false;
    let plain = buffer(&mut app, &model);
    assert_eq!(style_of(&plain, "E bus error: crc"), (Color::Reset, Modifier::BOLD));
    assert_eq!(style_of(&plain, "17 lost before"), (Color::Reset, Modifier::REVERSED));
    let coloured = plain.content.iter().filter(|cell| (cell.fg, cell.bg) != (Color::Reset, Color::Reset));
    assert_eq!(coloured.count(), 0);
}

#[test]
fn digits_that_changed_are_marked_fade_and_can_be_notched() {
    let mut model = Model::new(Decoder::new(Vec::new()).into(), Options::default(), 0).unwrap();
    let at = |ms: i64, text: &str| TraceRecord {
        time_ns: ms * 1_000_000,
        device_ns: None,
        channel: 1,
        event: frame(text),
    };
    model.take(&[at(0, "123#1020"), at(10, "123#1320")]);
    let (mut app, _orders) = app(View::Fixed);
    // Only the low half of the first byte.
    let fresh = buffer(&mut app, &model);
    assert_eq!((style_of(&fresh, "13 20").0, style_of(&fresh, "20 ").0), (Color::Reset, Color::Reset));
    assert_eq!(style_of(&fresh, "3 20").0, Color::LightYellow);
    model.take(&[at(700, "124#")]);
    assert_eq!(style_of(&buffer(&mut app, &model), "3 20").0, Color::Yellow);
    model.take(&[at(9000, "124#")]);
    assert_eq!(style_of(&buffer(&mut app, &model), "3 20").0, Color::Reset);
    // What changes anyway is suppressed, another bit of the same digit is not.
    press(&mut app, &mut model, "#");
    model.take(&[at(9001, "123#1020")]);
    assert_eq!(style_of(&buffer(&mut app, &model), "0 20").0, Color::Reset);
    model.take(&[at(9002, "123#1820")]);
    assert_eq!(style_of(&buffer(&mut app, &model), "8 20").0, Color::LightYellow);
}

/// Press `z`, do something, and see what that changed.
#[test]
fn only_what_changed_since_a_key_was_pressed_is_shown_and_marked() {
    let mut model = Model::new(Decoder::new(Vec::new()).into(), Options::default(), 0).unwrap();
    let at = |ms: i64, text: &str| TraceRecord {
        time_ns: ms * 1_000_000,
        device_ns: None,
        channel: 1,
        event: frame(text),
    };
    model.take(&[at(0, "123#1020"), at(0, "124#55"), at(10, "123#1120")]);
    let (mut app, _orders) = app(View::Fixed);
    let text = |app: &mut App, model: &Model| screen_text(app, model, (40, 12)).unwrap();
    press(&mut app, &mut model, "z");
    let nothing = text(&mut app, &model);
    assert!(!nothing.contains("123") && nothing.contains(" changed in 0 s: 0 of 2, z: all"), "{nothing}");
    // It stays marked after it has faded elsewhere, also if it is as before again.
    model.take(&[at(20, "123#1920"), at(30, "123#1120"), at(9_000, "125#77")]);
    let changed = text(&mut app, &model);
    assert!(changed.contains("11 20") && changed.contains("77") && !changed.contains("55"), "{changed}");
    assert!(changed.contains(" changed in 8 s: 2 of 3, z: all"), "{changed}");
    let screen = buffer(&mut app, &model);
    assert_eq!(
        (style_of(&screen, "1 20").0, style_of(&screen, "11 20").0),
        (Color::LightYellow, Color::DarkGray)
    );
    assert_eq!(style_of(&screen, "77").0, Color::LightYellow, "all of a new row");
    press(&mut app, &mut model, "#");
    let muted = screen_text(&mut app, &model, (110, 12)).unwrap();
    assert!(!muted.contains("11 20") && muted.contains("(2 hidden, 2 bits muted)"), "{muted}");
    // What continues behind a stopped display is compared with the same moment.
    press(&mut app, &mut model, " ");
    model.take(&[at(9_100, "124#56")]);
    assert!(!text(&mut app, &model).contains("56"));
    press(&mut app, &mut model, " ");
    assert!(text(&mut app, &model).contains("56"));
    press(&mut app, &mut model, "z");
    let all = text(&mut app, &model);
    assert!(all.contains("11 20") && all.contains("56") && !all.contains("changed in"), "{all}");
}

#[test]
fn alarms_are_red_above_and_blue_below_each_with_its_arrow() {
    let text = r#"
        version = 1
        [[message]]
        name = "M"
        id = 0x123
        length = 1
        [[message.signal]]
        name = "Level"
        at = "D1"
        alarm = { min = 10, max = 200 }
    "#;
    let decoder = database(text);
    for (data, arrow, colour) in [("FF", "▲", Color::LightRed), ("01", "▼", Color::LightBlue)] {
        let mut model = Model::new(Arc::clone(&decoder), Options::default(), 0).unwrap();
        let event: TraceEvent = frame(&format!("123#{data}"));
        model.take(&[TraceRecord { time_ns: 0, device_ns: None, channel: 1, event }]);
        let (mut app, _orders) = app(View::Signals);
        press(&mut app, &mut model, "j");
        assert_eq!(style_of(&buffer(&mut app, &model), arrow).0, colour);
    }
}
