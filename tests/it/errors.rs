//! Errors and fault confinement: reported, rate-limited, none uncounted.

use crate::fakes;

use cantap_firmware::TICK_HZ;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_wire::message::Mode;
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{Channel, Command, Event, Reply};
use fakes::{Bench, SMALL_QUEUE};

const CAN1: Channel = Channel::Can1;

fn error<const N: usize>(bench: &mut Bench<'_, N>, kind: BusErrorKind) {
    let entered = bench.board.clock.now.get();
    bench.board.traffic[0].error = Some(kind);
    bench.board.capture.on_error(CAN1, &mut bench.board.traffic[0], entered);
}

fn counted<const N: usize>(bench: &mut Bench<'_, N>) -> u32 {
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    status.channels[0].bus_errors
}

#[test]
fn each_kind_is_reported_with_the_counters() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    bench.board.traffic[0].counters = (8, 3);
    for kind in BusErrorKind::ALL {
        error(&mut bench, kind);
    }
    bench.millisecond();
    let expected = BusErrorKind::ALL.map(|kind| Event::BusError { channel: CAN1, kind, tec: 8, rec: 3 });
    bench.millisecond();
    assert_eq!(bench.events(), expected);
}

const PER_MS: u32 = 50;
const MS: u32 = 1000;

/// A stuck bus causes an error every 20 µs or so: 50 000 a second.
#[test]
fn a_broken_bus_cannot_flood_the_link_and_every_error_is_counted() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for _ in 0..MS {
        for _ in 0..PER_MS {
            bench.pass(TICK_HZ / 1000 / PER_MS);
            error(&mut bench, BusErrorKind::BitRecessive);
        }
        bench.board.capture.on_tick(&mut bench.board.traffic, &bench.board.clock);
        bench.poll();
    }
    // The last window closes.
    for _ in 0..110 {
        bench.millisecond();
    }
    let events = bench.events();
    let reported = events.iter().filter(|event| matches!(event, Event::BusError { .. })).count() as u32;
    let suppressed: u32 = events
        .iter()
        .filter_map(|event| match event {
            Event::ErrorsSuppressed { count, .. } => Some(*count),
            _ => None,
        })
        .sum();
    assert_eq!(reported + suppressed, PER_MS * MS);
    assert!((100..=240).contains(&reported), "{reported} errors reported in a second");
    assert_eq!(counted(&mut bench), PER_MS * MS);
}

#[test]
fn every_change_of_state_is_recorded_once() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let states = [
        ErrorState::Warning,
        ErrorState::Passive,
        ErrorState::BusOff,
        ErrorState::Active,
        ErrorState::Warning,
    ];
    for state in states {
        bench.board.traffic[0].state = Some(state);
        for _ in 0..5 {
            bench.millisecond();
        }
    }
    let expected = states.map(|state| Event::State { channel: CAN1, state, tec: 0, rec: 0 });
    assert_eq!(bench.events(), expected);
}

#[test]
fn errors_while_the_queue_is_full_are_counted_as_suppressed() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    bench.port.takes = 0;
    for number in 0..5000 {
        bench.receive(CAN1, fakes::numbered(number));
    }
    for _ in 0..200 {
        error(&mut bench, BusErrorKind::Form);
    }
    bench.port.takes = usize::MAX;
    for _ in 0..300 {
        bench.millisecond();
    }
    let reported =
        bench.events().iter().filter(|event| matches!(event, Event::BusError { .. })).count() as u32;
    let suppressed: u32 = bench
        .events()
        .iter()
        .map(|event| if let Event::ErrorsSuppressed { count, .. } = event { *count } else { 0 })
        .sum();
    assert_eq!((reported + suppressed, counted(&mut bench)), (200, 200));
}
