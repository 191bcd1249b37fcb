//! Periodic entries that ask for more than a bus can carry, on fakes: they cost no time, each gets its turn, and every
//! period is accounted for.

use crate::fakes;

use cantap_firmware::bus::periodic::{MIN_PERIOD_TICKS, PERIODIC_SLOTS};
use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::ports::Clock;
use cantap_firmware::{TICKS_PER_MS, TICKS_PER_US};
use cantap_wire::message::{ChannelConfig, DEVICE_TAG, Mode, Periodic, TxFrame};
use cantap_wire::record::{ErrorState, TransmitFailure};
use cantap_wire::{Channel, Command, Event, Frame, Id, Record, Reply};
use fakes::{Bench, FakeClock, SMALL_QUEUE, config, numbered};

const CAN1: Channel = Channel::Can1;

type Queue = RecordQueue<SMALL_QUEUE>;

fn entry(slot: usize, period_ticks: u32, count: u32) -> Periodic {
    let frame = Frame::data_frame(Id::standard(slot as u32).unwrap(), &[]).unwrap();
    Periodic { frame, period_ticks, count, modifiers: [].into_iter().collect() }
}

fn set(bench: &mut Bench<'_, SMALL_QUEUE>, channel: Channel, slot: usize, entry: Option<Periodic>) {
    bench.ask(Command::SetPeriodic { channel, slot: slot as u8, entry }).unwrap();
}

fn counters(bench: &mut Bench<'_, SMALL_QUEUE>) -> (u32, u32) {
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    (status.channels[0].transmitted, status.channels[0].transmit_failures)
}

/// Overtaken periods of channel 1 by slot, according to the records, and how many records that took.
fn told(bench: &Bench<'_, SMALL_QUEUE>) -> ([u32; PERIODIC_SLOTS], usize) {
    let (mut by_slot, mut records) = ([0; PERIODIC_SLOTS], 0);
    for event in bench.events() {
        if let Event::TransmitFailed { channel: CAN1, tag, reason: TransmitFailure::Overtaken { periods } } =
            event
        {
            by_slot[(tag - DEVICE_TAG) as usize] += periods;
            records += 1;
        }
    }
    (by_slot, records)
}

/// Lets time pass in steps of a microsecond, with the tick and every alarm that becomes due.
fn live(bench: &mut Bench<'_, SMALL_QUEUE>, microseconds: u32) -> usize {
    let mut alarms = 0;
    for at in 1..=microseconds {
        bench.pass(TICKS_PER_US);
        let now = bench.board.clock.now.get();
        if bench.board.clock.alarm.get().is_some_and(|at| now.wrapping_sub(at) < u32::MAX / 2) {
            alarms += 1;
            bench.alarm();
        }
        if at % 1000 == 0 {
            bench.board.capture.on_tick(&mut bench.board.traffic, &bench.board.clock);
            bench.poll();
        }
    }
    alarms
}

/// Nobody acknowledges on either bus. The worst table that a host can set costs neither alarms nor a flood of records.
#[test]
fn full_tables_that_cannot_leave_cost_no_alarms_and_few_records() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for slot in 0..PERIODIC_SLOTS {
        for channel in Channel::ALL {
            set(&mut bench, channel, slot, Some(entry(slot, MIN_PERIOD_TICKS, 0)));
        }
    }
    live(&mut bench, 1000);
    let from = bench.board.clock.now.get();
    let before = counters(&mut bench).1;
    bench.records.clear();
    let alarms = live(&mut bench, 300_000);
    assert_eq!(alarms, 0, "alarms for frames that wait for a mailbox");
    let records = bench.records.len();
    assert!(records <= 2 * PERIODIC_SLOTS * 4, "{records} records in 300 ms");
    // Everything that passed is counted, though: each entry's periods, give or take one at either end.
    let passed = (bench.board.clock.now.get() - from) / MIN_PERIOD_TICKS;
    let counted = counters(&mut bench).1 - before;
    let all = passed * PERIODIC_SLOTS as u32;
    assert!(counted.abs_diff(all) <= 2 * PERIODIC_SLOTS as u32, "{counted} of {all}");
    // And reported, except for what has passed since each one's last record.
    let told: u32 = told(&bench).0.iter().sum();
    assert!(told <= counted && told >= counted / 2, "{told} of {counted}");
}

/// At any time, every period that has begun is either sent, overtaken or waiting, whatever the bus takes.
#[test]
fn every_period_is_sent_or_waits_or_is_counted() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let mut random = fastrand::Rng::with_seed(1);
    let mut begun_at = Vec::new();
    for slot in 0..PERIODIC_SLOTS {
        let period = MIN_PERIOD_TICKS + random.u32(..20 * TICKS_PER_MS);
        set(&mut bench, CAN1, slot, Some(entry(slot, period, 0)));
        begun_at.push((slot, period, bench.board.clock.now.get()));
    }
    let mut sent = [0u32; PERIODIC_SLOTS];
    for _ in 0..200 {
        live(&mut bench, random.u32(..3000));
        for _ in 0..random.usize(..6) {
            if let Some(frame) = bench.send_one(CAN1) {
                sent[frame.id().raw() as usize] += 1;
            }
        }
        let now = bench.board.clock.now.get();
        let (transmitted, failed) = counters(&mut bench);
        assert_eq!(transmitted, sent.iter().sum::<u32>());
        // A request takes no time here, and an entry is set within a tick of the time noted.
        let begun: u32 = begun_at.iter().map(|(_, period, at)| (now - at) / period + 1).sum();
        let waiting = begun - transmitted - failed;
        // One per entry, and one more for each of the three mailboxes.
        assert!(
            waiting <= PERIODIC_SLOTS as u32 + 3,
            "{begun} begun, {transmitted} sent, {failed} overtaken"
        );
    }
    // By entry: the bus takes everything waiting, and the records account for the rest.
    while let Some(frame) = bench.send_one(CAN1) {
        sent[frame.id().raw() as usize] += 1;
    }
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    let now = bench.board.clock.now.get();
    bench.millisecond();
    bench.millisecond();
    let (overtaken, _) = told(&bench);
    for (slot, period, at) in begun_at {
        let begun = (now - at) / period + 1;
        let ended = sent[slot] + overtaken[slot];
        assert!(
            begun - ended <= 2,
            "slot {slot}: {begun} begun, {} sent, {} overtaken",
            sent[slot],
            overtaken[slot]
        );
    }
}

/// More is asked for than the bus can carry: the entry that has waited longest goes first.
#[test]
fn every_entry_of_a_table_that_asks_for_too_much_gets_its_turn() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for slot in 0..PERIODIC_SLOTS {
        set(&mut bench, CAN1, slot, Some(entry(slot, MIN_PERIOD_TICKS, 0)));
    }
    let mut sent = [0u32; PERIODIC_SLOTS];
    for _ in 0..PERIODIC_SLOTS * 20 {
        live(&mut bench, 50);
        let frame = bench.send_one(CAN1).expect("something always waits");
        sent[frame.id().raw() as usize] += 1;
    }
    assert!(sent.iter().all(|sent| (19..=21).contains(sent)), "{sent:?}");
}

/// Nothing unreported is lost when an entry is cleared, replaced or done.
#[test]
fn what_passed_is_told_also_after_the_entry_is_gone() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for number in 0..3 {
        let frame = TxFrame { tag: number, frame: numbered(number), at_ticks: None };
        bench.ask(Command::Send { channel: CAN1, frames: [frame].into_iter().collect() }).unwrap();
    }
    for slot in 0..3 {
        set(&mut bench, CAN1, slot, Some(entry(slot, TICKS_PER_MS, 1)));
    }
    // Each waits behind the queue's frames while ten of its periods pass, less those that earlier records reported.
    live(&mut bench, 10_500);
    set(&mut bench, CAN1, 0, None);
    set(&mut bench, CAN1, 1, Some(entry(1, 1000 * TICKS_PER_MS, 0)));
    for _ in 0..6 {
        bench.send_one(CAN1);
    }
    // The third is done: its one frame was sent.
    live(&mut bench, 250_000);
    let (overtaken, _) = told(&bench);
    assert_eq!(overtaken[..3], [10, 10, 10]);
    assert_eq!(counters(&mut bench).1, 30);
}

#[test]
fn closing_tells_what_passed_before_the_stop() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for slot in 0..PERIODIC_SLOTS {
        set(&mut bench, CAN1, slot, Some(entry(slot, TICKS_PER_MS, 0)));
    }
    live(&mut bench, 20_000);
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.events().last(), Some(&Event::Stopped { channel: CAN1 }));
    let (_, failed) = counters(&mut bench);
    // Three were in mailboxes, and are reported one by one.
    assert_eq!(told(&bench).0.iter().sum::<u32>() + 3, failed);
    assert!(failed > 19 * PERIODIC_SLOTS as u32);
}

/// The host reads nothing, and the queue is full: there must still be room for what explains missing frames.
#[test]
fn overtaken_periods_leave_the_reserve_of_a_full_queue_alone() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for slot in 0..PERIODIC_SLOTS {
        set(&mut bench, CAN1, slot, Some(entry(slot, MIN_PERIOD_TICKS, 0)));
    }
    live(&mut bench, 2000);
    bench.port.takes = 0;
    for number in 0..10_000 {
        bench.receive(Channel::Can2, numbered(number));
        // One batch waits for the host outside the queue.
        bench.poll();
    }
    let (full, _) = bench.board.capture.fill();
    live(&mut bench, 2_000_000);
    assert_eq!(bench.board.capture.fill().0, full);
    bench.port.takes = usize::MAX;
    live(&mut bench, 400_000);
    let told: u32 = told(&bench).0.iter().sum();
    let (_, counted) = counters(&mut bench);
    assert!(told <= counted && told > counted / 2, "{told} of {counted}");
}

/// While a controller stays bus-off, periodic frames wait: each would only be given up again at once.
#[test]
fn periodic_frames_wait_while_a_controller_stays_off_the_bus() {
    let queue = Queue::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let config = ChannelConfig { manual_recovery: true, ..config(Mode::Normal) };
    bench.ask(Command::Open { channel: CAN1, config: Some(config) }).unwrap();
    bench.board.traffic[0].state = Some(ErrorState::BusOff);
    live(&mut bench, 2000);
    for slot in 0..PERIODIC_SLOTS {
        set(&mut bench, CAN1, slot, Some(entry(slot, TICKS_PER_MS, 0)));
    }
    bench.records.clear();
    assert_eq!(live(&mut bench, 200_000), 0);
    assert!(bench.board.traffic[0].order.is_empty());
    assert!(bench.records.len() <= 3 * PERIODIC_SLOTS, "{} records", bench.records.len());
    bench.ask(Command::Recover { channel: CAN1 }).unwrap();
    bench.board.traffic[0].state = None;
    live(&mut bench, 2000);
    assert!(bench.send_one(CAN1).is_some());
}

/// Whatever a host queues and however close together its frames are due, a call waits for them at most 50 µs, and the FIFOs are
/// drained before the next call.
#[test]
fn no_call_waits_longer_than_it_may() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let mut random = fastrand::Rng::with_seed(3);
    for round in 0..200 {
        let start = bench.board.clock.now.get() + 5 * TICKS_PER_MS;
        for channel in Channel::ALL {
            let mut due = start;
            let mut frames = Vec::new();
            for tag in 0..3 {
                due += random.u32(..15 * TICKS_PER_US);
                frames.push(TxFrame { tag, frame: numbered(tag), at_ticks: Some(due.into()) });
            }
            bench.ask(Command::Send { channel, frames: frames.into_iter().collect() }).unwrap();
        }
        let entry = entry(0, 5 * TICKS_PER_MS, 2);
        set(&mut bench, CAN1, round % PERIODIC_SLOTS, Some(entry));
        bench.send_one(CAN1);
        bench.board.clock.now.set(start - 20 * TICKS_PER_US);
        for _ in 0..100 {
            bench.pass(TICKS_PER_US);
            let before = bench.board.clock.now.get();
            bench.alarm();
            let waited = bench.board.clock.now.get() - before;
            assert!(waited <= 5 * FakeClock::ALARM_EARLY_TICKS, "{} µs", waited / TICKS_PER_US);
        }
        for channel in Channel::ALL {
            while bench.send_one(channel).is_some() {}
        }
        bench.ask(Command::Status).unwrap();
        assert!(Channel::ALL.map(|channel| bench.board.capture.transmitter(channel).pending()) == [0, 0]);
    }
}

/// Giving up a whole queue at once would keep the other channel's FIFO waiting.
#[test]
fn a_queue_is_given_up_in_pieces() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for first in (0..240).step_by(20) {
        let frames =
            (first..first + 20).map(|tag| TxFrame { tag, frame: numbered(tag), at_ticks: None }).collect();
        bench.ask(Command::Send { channel: CAN1, frames }).unwrap();
    }
    bench.records.clear();
    bench.ask(Command::Abort { channel: CAN1 }).unwrap();
    let mut tags = Vec::new();
    for _ in 0..60 {
        let told = std::mem::take(&mut bench.records);
        assert!(told.len() <= 3 * 20, "{} records in a millisecond", told.len());
        tags.extend(told.into_iter().filter_map(|(_, record)| match record {
            Record::Event(Event::TransmitFailed { tag, reason: TransmitFailure::Aborted, .. }) => Some(tag),
            _ => None,
        }));
        bench.millisecond();
    }
    tags.sort_unstable();
    assert_eq!(tags, (0..240).collect::<Vec<_>>());
}
