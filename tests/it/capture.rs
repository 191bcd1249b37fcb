//! The capture path from FIFO to port, on fakes.

use crate::fakes;

use cantap_firmware::bus::queue::RecordQueue;
use cantap_wire::message::{ChannelConfig, Mode};
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Command, Event, Received, Record, Reply, Stamp};
use fakes::{Bench, SMALL_QUEUE, config, numbered};

const CAN1: Channel = Channel::Can1;
const CAN2: Channel = Channel::Can2;

#[test]
fn frames_of_both_channels_arrive_in_order_with_their_times() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    let start = u64::from(bench.board.clock.now.get());
    for number in 0..1000 {
        bench.pass(576);
        bench.receive(if number % 3 == 0 { CAN2 } else { CAN1 }, numbered(number));
        if number % 20 == 0 {
            bench.poll();
        }
    }
    bench.millisecond();
    bench.millisecond();
    let expected: Vec<_> = (0..1000u32)
        .map(|number| {
            let channel = if number % 3 == 0 { CAN2 } else { CAN1 };
            let received =
                Received { channel, frame: numbered(number), stamp: Stamp::Exact, data_omitted: false };
            (start + 576 * u64::from(number + 1), Record::Received(received))
        })
        .collect();
    assert_eq!(bench.records, expected);
    assert!(bench.complaints.is_empty(), "{:?}", bench.complaints);
}

/// A frame that waited behind another ended at an unknown time: its stamp must say so.
#[test]
fn frames_found_queued_are_stamped_as_upper_bounds() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    for number in 0..3 {
        bench.board.traffic[0].arrive(numbered(number));
    }
    bench.interrupt(CAN1);
    bench.pass(600);
    bench.receive(CAN1, numbered(3));
    bench.millisecond();
    bench.millisecond();
    let stamps: Vec<_> = bench
        .records
        .iter()
        .map(|(_, record)| match record {
            Record::Received(received) => received.stamp,
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(stamps, [Stamp::UpperBound, Stamp::UpperBound, Stamp::UpperBound, Stamp::Exact]);
}

#[test]
fn an_overrun_of_the_fifo_stands_behind_the_frames_that_it_kept() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    for number in 0..5 {
        bench.board.traffic[1].arrive(numbered(number));
    }
    bench.interrupt(CAN2);
    bench.receive(CAN2, numbered(5));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.frames(CAN2), [0, 1, 2, 5].map(numbered));
    let lost = Event::Lost { channel: CAN2, stage: LossStage::Controller, count: 1, at_least: true };
    assert_eq!(bench.records[3].1, Record::Event(lost));
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!(status.channels[1].lost_controller, 1);
}

/// A slow host must cost counted frames, never a FIFO overrun, and the count must stand where the frames are missing.
#[test]
fn a_full_queue_drops_and_counts_but_still_empties_the_fifo() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.port.takes = 0;
    let total = 10_000;
    for number in 0..total {
        bench.pass(576);
        bench.receive(CAN1, numbered(number));
        assert_eq!(bench.board.traffic[0].fifo.len(), 0);
        if number % 100 == 0 {
            bench.poll();
        }
    }
    bench.port.takes = usize::MAX;
    for _ in 0..20 {
        bench.millisecond();
    }
    for number in total..total + 100 {
        bench.pass(576);
        bench.receive(CAN1, numbered(number));
    }
    bench.millisecond();
    bench.millisecond();
    // Each loss record stands exactly in the gap: counted as that many frames, it gives every later frame its right
    // number.
    let mut next = 0;
    let mut lost = 0;
    for (_, record) in &bench.records {
        match record {
            Record::Received(received) => {
                assert_eq!(received.frame, numbered(next));
                next += 1;
            }
            Record::Event(Event::Lost { channel: CAN1, stage: LossStage::Queue, count, at_least: false }) => {
                next += count;
                lost += count;
            }
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(next, total + 100);
    assert!(lost > 0, "the queue was meant to overflow");
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!(status.channels[0].lost_queue, lost);
    assert_eq!(status.channels[0].frames, total + 100);
    assert!(status.queue_high_water_bytes > SMALL_QUEUE as u32 * 9 / 10);
    assert!(bench.complaints.is_empty(), "{:?}", bench.complaints);
}

/// A loss is reported even if no later frame reveals it.
#[test]
fn a_loss_at_the_very_end_is_reported_without_another_frame() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.port.takes = 0;
    for number in 0..5000 {
        bench.receive(CAN1, numbered(number));
    }
    bench.port.takes = usize::MAX;
    for _ in 0..20 {
        bench.millisecond();
    }
    let delivered = bench.frames(CAN1).len() as u32;
    assert_eq!(
        bench.events(),
        [Event::Lost { channel: CAN1, stage: LossStage::Queue, count: 5000 - delivered, at_least: false }]
    );
}

#[test]
fn closing_a_channel_ends_its_records_with_a_stop() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.receive(CAN1, numbered(1));
    // Arrives while the controller leaves the bus.
    bench.board.traffic[0].arrive(numbered(2));
    assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Ok(Reply::Done));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.frames(CAN1), [1, 2].map(numbered));
    assert_eq!(bench.events(), [Event::Stopped { channel: CAN1 }]);
    assert!(!bench.board.control[0].running && bench.board.control[1].running);
}

#[test]
fn data_and_stamps_are_left_out_on_request() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let config = ChannelConfig { omit_data: true, omit_stamps: true, ..config(Mode::ListenOnly) };
    bench.ask(Command::Open { channel: CAN1, config: Some(config) }).unwrap();
    bench.millisecond();
    bench.millisecond();
    bench.records.clear();
    bench.receive(CAN1, numbered(0x123));
    bench.millisecond();
    bench.millisecond();
    let Record::Received(received) = bench.records[0].1 else { panic!() };
    assert_eq!((received.stamp, received.data_omitted), (Stamp::Omitted, true));
    assert_eq!((received.frame.id(), received.frame.dlc()), (numbered(0x123).id(), 4));
}

/// The timer wraps after 358 s: that must not show.
#[test]
fn hours_of_silence_keep_the_time_right() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    let hour_s = 3600;
    let start = u64::from(bench.board.clock.now.get());
    for _ in 0..hour_s * 10 {
        bench.pass(cantap_firmware::TICK_HZ / 10 - cantap_firmware::TICKS_PER_MS);
        bench.millisecond();
    }
    bench.receive(CAN1, numbered(1));
    bench.millisecond();
    bench.millisecond();
    let (ticks, last) = *bench.records.last().unwrap();
    assert!(matches!(last, Record::Received(_)));
    assert_eq!(ticks - start, u64::from(cantap_firmware::TICK_HZ) * hour_s);
    assert_eq!(bench.events(), []);
}
