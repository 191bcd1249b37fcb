//! Any keys, clicks, sizes and events, in any order: nothing makes the display panic.

use cantap::TraceEvent;
use cantap::TraceRecord;
use cantap::wire::record::{BusErrorKind, ErrorState, LossStage, TransmitFailure};
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers, MouseButton, MouseEvent, MouseEventKind};

use super::super::app::{App, View};
use super::super::model::{Model, Playing, SourceState};
use super::super::order::Order;
use super::super::views;
use super::{app, device, frame, model};
use cantap_work::recording::RecordingState;

const STEPS: u32 = 10_000;

fn key(random: &mut fastrand::Rng) -> KeyEvent {
    const NAMED: [KeyCode; 18] = [
        KeyCode::Enter,
        KeyCode::Enter,
        KeyCode::Esc,
        KeyCode::Esc,
        KeyCode::Backspace,
        KeyCode::Delete,
        KeyCode::Up,
        KeyCode::Down,
        KeyCode::Left,
        KeyCode::Right,
        KeyCode::Home,
        KeyCode::End,
        KeyCode::PageUp,
        KeyCode::PageDown,
        KeyCode::Tab,
        KeyCode::BackTab,
        KeyCode::F(1),
        KeyCode::Insert,
    ];
    let code = match random.u32(..10) {
        0..3 => NAMED[random.usize(..NAMED.len())],
        3 => KeyCode::Char(random.char(..)),
        _ => KeyCode::Char(random.char(' '..='~')),
    };
    let modifiers = if random.u32(..20) == 0 { KeyModifiers::CONTROL } else { KeyModifiers::NONE };
    KeyEvent::new(code, modifiers)
}

fn mouse(random: &mut fastrand::Rng) -> MouseEvent {
    let kinds = [
        MouseEventKind::ScrollUp,
        MouseEventKind::ScrollDown,
        MouseEventKind::Down(MouseButton::Left),
        MouseEventKind::Drag(MouseButton::Left),
    ];
    let kind = kinds[random.usize(..kinds.len())];
    MouseEvent { kind, column: random.u16(..400), row: random.u16(..120), modifiers: KeyModifiers::NONE }
}

/// A line that a user might type, right or wrong.
fn line(random: &mut fastrand::Rng) -> &'static str {
    const LINES: [&str; 18] = [
        "f09F80202:1FFFFFFF\n",
        "f#FFFFFFFF,j\n",
        "fnonsense,\n\x1b",
        "/09f8\n",
        "/lost\n",
        "/ä\n",
        "6a123#11 10ms\n",
        "6a2:CogSogRapid:Speed=1.5\n",
        "6a7ff#R 0\n\x1b",
        "b1:125k 2:83.333k\n",
        "b0\n\x1b",
        "Demu:\n\x1b",
        "3FSpeed > 0.01\n",
        "3F> x\n\x1b",
        "T50%\n\x1b",
        "T1:30\n\x1b",
        "Onothing.log\n\x1b",
        "2/cog\n",
    ];
    LINES[random.usize(..LINES.len())]
}

fn record(random: &mut fastrand::Rng, now_ns: &mut i64) -> TraceRecord {
    let wild = random.u32(..2000) == 0;
    *now_ns = if wild { random.i64(..) } else { now_ns.saturating_add(random.i64(-1000..2_000_000_000)) };
    let counters = random.bool().then(|| (random.u8(..), random.u8(..)));
    let event = match random.u32(..12) {
        0 => TraceEvent::BusError { kind: random.bool().then_some(BusErrorKind::Stuff), counters },
        1 => TraceEvent::ErrorsSuppressed { count: random.u32(..) },
        2 => TraceEvent::State { state: ErrorState::BusOff, counters },
        3 => TraceEvent::Lost {
            stage: random.bool().then_some(LossStage::Host),
            count: random.u32(..),
            at_least: random.bool(),
        },
        4 => TraceEvent::TransmitFailed { tag: random.u32(..), reason: TransmitFailure::Aborted },
        5 => frame("09F80202#01FC6C000001FFFF"),
        6 => frame("7FF#R4"),
        _ => frame(&format!("{:03X}#{:016X}", random.u16(..0x800), random.u64(..))),
    };
    TraceRecord { time_ns: *now_ns, device_ns: None, channel: random.u8(1..4), event }
}

/// Something happens besides the user's keys.
fn happen(random: &mut fastrand::Rng, model: &mut Model, now_ns: &mut i64) {
    match random.u32(..10) {
        0 => model.source = SourceState::Gone("the device vanished; plug it in again".to_owned()),
        1 => model.source = SourceState::Running,
        2 => {
            let (paused, looped, ended) = (random.bool(), random.bool(), random.bool());
            model.source = SourceState::Playing(Playing {
                factor: 0.5,
                paused,
                looped,
                ended,
                seeking: random.bool(),
                first_ns: random.i64(..),
                position_ns: random.i64(..),
                end_ns: random.bool().then(|| random.i64(..)),
            });
        }
        3 => model.interrupt(),
        4 => model.sessions = vec![u32::from(random.u8(..))],
        5 => model.refused.push((1, random.u8(..))),
        6 => model.seen.devices = random.bool().then(device).into_iter().collect(),
        7 => model.notice = "word ".repeat(random.usize(..200)),
        8 => {
            let path = "x".repeat(random.usize(..300)).into();
            let since_ns = random.i64(..);
            model.recording = random.bool().then(|| RecordingState {
                path,
                records: 1,
                bytes: random.u64(..),
                since_ns,
                ..RecordingState::default()
            });
        }
        _ => model.advance(now_ns.saturating_sub(random.i64(..2_000_000_000))),
    }
}

fn step(random: &mut fastrand::Rng, app: &mut App, model: &mut Model, now_ns: &mut i64) -> String {
    match random.u32(..20) {
        0 => {
            let text = line(random);
            for character in text.chars() {
                let code = match character {
                    '\n' => KeyCode::Enter,
                    '\x1b' => KeyCode::Esc,
                    other => KeyCode::Char(other),
                };
                app.key(KeyEvent::from(code), model);
            }
            format!("{text:?}")
        }
        1..3 => {
            let event = mouse(random);
            app.mouse(event, model);
            format!("{event:?}")
        }
        3..6 => {
            let records: Vec<_> = (0..random.usize(..40)).map(|_| record(random, now_ns)).collect();
            model.take(&records);
            format!("{} records", records.len())
        }
        6 => {
            happen(random, model, now_ns);
            "an event".to_owned()
        }
        7 => {
            app.theme.unicode = random.bool();
            app.theme.colour = random.bool();
            app.theme.light = random.bool();
            "a theme".to_owned()
        }
        _ => {
            let key = key(random);
            app.key(key, model);
            format!("{:?}", key.code)
        }
    }
}

#[test]
fn nothing_that_anybody_does_makes_the_display_panic() {
    let seed = fastrand::u64(..);
    eprintln!("seed {seed}");
    let mut random = fastrand::Rng::with_seed(seed);
    let mut model = model();
    let mut now_ns = model.seen.now_ns;
    let (mut app, orders) = app(View::Trace);
    let mut terminal = Terminal::new(TestBackend::new(80, 24)).unwrap();
    let mut shown = [0; View::ALL.len()];
    for count in 0..STEPS {
        let done = step(&mut random, &mut app, &mut model, &mut now_ns);
        eprintln!("step {count}: {done}");
        if random.u32(..25) == 0 {
            let (width, height) = (random.u16(1..200), random.u16(1..60));
            eprintln!("step {count}: {width}x{height}");
            terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
        }
        app.catch_up(&mut model);
        terminal.draw(|frame| views::draw(frame, &mut app, &model)).unwrap();
        shown[app.view as usize] += 1;
        // The source follows some of the orders.
        for order in orders.try_iter() {
            match order {
                Order::Open(plan) => {
                    let options = plan.options(model.options());
                    model.set_options(options).unwrap();
                    model.sessions = vec![u32::from(random.u8(..))];
                }
                Order::SetPeriodic(channel, slot, Some(_)) if slot > 3 => model.refused.push((channel, slot)),
                _ => {}
            }
        }
    }
    assert!(shown.iter().all(|count| *count > 100), "{shown:?}");
}
