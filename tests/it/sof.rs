//! Marks of USB's start of frame in the stream, on fakes.

use crate::fakes;

use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::sof::SofReading;
use cantap_firmware::{TICKS_PER_MS, TICKS_PER_US};
use cantap_wire::message::Mode;
use cantap_wire::{Channel, Event, Record};
use fakes::{Bench, SMALL_QUEUE, numbered};

/// The host's frames start this long before the device's milliseconds.
const PHASE_TICKS: u32 = 300 * TICKS_PER_US;

/// Lets `count` milliseconds pass, each with a SOF, the frames numbered from `frame` on.
fn milliseconds<const N: usize>(bench: &mut Bench<'_, N>, frame: u16, count: u16) {
    for n in 0..count {
        let next = bench.board.clock.now.get().wrapping_add(TICKS_PER_MS);
        bench.board.sof = Some(SofReading {
            latched: [next.wrapping_sub(PHASE_TICKS); 2],
            frame: (frame + n) % 2048,
            now: next,
            several: false,
        });
        bench.millisecond();
    }
}

/// The marks that arrived: frame number and device time.
fn marks<const N: usize>(bench: &Bench<'_, N>) -> Vec<(u16, u64)> {
    bench
        .records
        .iter()
        .filter_map(|(ticks, record)| match record {
            Record::Event(Event::SofMark { frame, .. }) => Some((*frame, *ticks)),
            _ => None,
        })
        .collect()
}

#[test]
fn an_idle_session_has_a_mark_each_second_with_the_latched_time() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    milliseconds(&mut bench, 0, 1500);
    assert!(bench.port.packets.is_empty(), "nothing before the host speaks");
    bench.greet();
    let start = u64::from(bench.board.clock.now.get());
    milliseconds(&mut bench, 1500, 2502);
    let ms = u64::from(TICKS_PER_MS);
    let first = start + ms - u64::from(PHASE_TICKS);
    let expected = [(1500, first), (452, first + 1000 * ms), (1452, first + 2000 * ms)];
    assert_eq!(marks(&bench), expected);
    assert!(bench.complaints.is_empty(), "{:?}", bench.complaints);
}

#[test]
fn the_next_session_begins_with_a_mark_of_its_own() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    milliseconds(&mut bench, 0, 10);
    bench.greet();
    bench.records.clear();
    milliseconds(&mut bench, 100, 10);
    assert_eq!(marks(&bench).iter().map(|(frame, _)| *frame).collect::<Vec<_>>(), [100]);
}

#[test]
fn slcan_has_no_marks() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.say(b"V\r");
    milliseconds(&mut bench, 0, 10);
    let answered = bench.port.from_device.len();
    milliseconds(&mut bench, 10, 2000);
    assert_eq!(bench.port.from_device.len(), answered);
}

/// A mark's time is earlier than that of records written since, so the running time of the records goes
/// back with it.
#[test]
fn frames_around_a_mark_keep_their_times() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.records.clear();
    let mut sent = Vec::new();
    for n in 0..3 {
        bench.pass(TICKS_PER_MS / 10);
        sent.push(u64::from(bench.board.clock.now.get()));
        bench.receive(Channel::Can1, numbered(n));
        milliseconds(&mut bench, 1000 * n as u16, 1000);
    }
    milliseconds(&mut bench, 0, 3);
    let stamps: Vec<u64> = bench
        .records
        .iter()
        .filter_map(|(ticks, record)| matches!(record, Record::Received(_)).then_some(*ticks))
        .collect();
    assert_eq!(stamps, sent);
    assert!(marks(&bench).len() >= 3);
}

/// The reserve is for what explains missing frames.
#[test]
fn a_full_queue_has_no_room_for_marks_and_loses_none_of_its_accounts() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.port.takes = 0;
    for n in 0..4000 {
        bench.receive(Channel::Can1, numbered(n));
    }
    // One batch moves to the port and waits there.
    bench.millisecond();
    let (before, _) = bench.board.capture.fill();
    milliseconds(&mut bench, 0, 5000);
    assert_eq!(bench.board.capture.fill().0, before, "marks took the reserve");
    bench.port.takes = usize::MAX;
    milliseconds(&mut bench, 904, 1100);
    let lost: u32 = bench
        .records
        .iter()
        .map(|(_, record)| if let Record::Event(Event::Lost { count, .. }) = record { *count } else { 0 })
        .sum();
    assert_eq!(bench.frames(Channel::Can1).len() as u32 + lost, 4000);
    assert!(marks(&bench).iter().any(|(frame, _)| (904..2004).contains(frame)));
}
