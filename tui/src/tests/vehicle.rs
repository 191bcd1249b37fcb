//! The page on which a vehicle is asked.

use cantap::Channel;
use cantap::wire::message::Mode;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

use super::super::app::View;
use super::super::model::Model;
use super::super::order::Order;
use super::{app, model, press, screen_text};
use cantap_work::obd::AskingState;

/// Asking is sending: only the page's own key begins it, a view that only listens asks first, and leaving the page ends it.
#[test]
fn a_vehicle_is_asked_by_the_pages_key_alone_and_until_it_is_left() {
    let mut model = model();
    let (mut app, orders) = app(View::Scripts);
    let asks = |order: Order| matches!(order, Order::Ask(true));
    let ends = |order: Order| matches!(order, Order::Ask(false));
    press(&mut app, &mut model, "0n");
    assert!(app.view == View::Obd && app.message == "it stays listen-only" && orders.try_recv().is_err());
    press(&mut app, &mut model, " y");
    assert!(matches!(orders.try_recv().unwrap(), Order::Open(plan) if plan.mode() == Mode::Normal));
    assert!(asks(orders.try_recv().unwrap()));
    model.vehicle.state = AskingState::Searching { channel: Channel::Can1 };
    // The same key again changes nothing; the space bar does.
    press(&mut app, &mut model, "0");
    assert!(orders.try_recv().is_err());
    press(&mut app, &mut model, " ");
    assert!(ends(orders.try_recv().unwrap()));
    model.vehicle.state = AskingState::Off;
    press(&mut app, &mut model, " ");
    assert!(asks(orders.try_recv().unwrap()));
    for key in ["1", "0", "9"] {
        press(&mut app, &mut model, key);
    }
    assert!(ends(orders.try_recv().unwrap()) && asks(orders.try_recv().unwrap()));
    assert!(ends(orders.try_recv().unwrap()) && orders.try_recv().is_err());
    // Whoever goes through the pages does not come by.
    for code in [KeyCode::Tab, KeyCode::BackTab] {
        for _ in 0..20 {
            app.key(KeyEvent::new(code, KeyModifiers::NONE), &mut model);
            assert_ne!(app.view, View::Obd);
        }
    }
    assert!(orders.try_recv().is_err());
}

#[test]
fn a_file_answers_nothing() {
    let mut model = model();
    let (mut app, orders) = app(View::Trace);
    app.plan = None;
    press(&mut app, &mut model, "0");
    let text = screen_text(&mut app, &model, (80, 24)).unwrap();
    assert!(text.contains("a file answers nothing; open a device with D"), "{text}");
    assert!(orders.try_recv().is_err());
}

/// The page's key is on the screen where a vehicle is, however narrow it is; elsewhere only if no other title has to go for it.
#[test]
fn the_tab_of_a_vehicle_has_room_where_there_is_one() {
    let mut model = model();
    let (mut app, _orders) = app(View::Fixed);
    let mut tabs = |model: &Model, width| {
        let text = screen_text(&mut app, model, (width, 24)).unwrap();
        text.lines().next().unwrap_or_default().to_owned()
    };
    let narrow = tabs(&model, 80);
    assert!(narrow.contains("5 Statistics") && narrow.ends_with("9 Scripts"), "{narrow}");
    assert!(tabs(&model, 100).ends_with("9 Scripts 0 OBD"));
    model.vehicle.is_there = true;
    for width in [40, 80, 100] {
        let text = tabs(&model, width);
        assert!(text.contains(" 0 "), "{width}: {text}");
    }
    assert!(tabs(&model, 80).ends_with("9 Scripts 0 OBD"));
}
