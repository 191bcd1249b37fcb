//! The frame that is on the bus when its channel is asked to leave. It ends before the channel has left, in a FIFO that is not released
//! meanwhile.

use crate::fakes;

use cantap_firmware::TICKS_PER_US;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_wire::message::Mode;
use cantap_wire::{Channel, Command, Event, Frame, Received, Record, Request, Stamp};
use fakes::{Bench, SMALL_QUEUE, Stubborn, encode, numbered};

const CAN1: Channel = Channel::Can1;
const CAN2: Channel = Channel::Can2;

type Queue = RecordQueue<SMALL_QUEUE>;

/// A bench whose CAN1 has been asked to leave and is still on its bus.
fn leaving(queue: &Queue) -> Bench<'_, SMALL_QUEUE> {
    let mut bench = Bench::opened(queue, Mode::ListenOnly);
    bench.board.control[0].stuck = true;
    bench.say(&encode(&Request { id: 9, command: Command::Close { channel: CAN1 } }));
    bench.pass(50 * TICKS_PER_US);
    bench
}

/// It leaves; returns what was recorded.
fn leave(bench: &mut Bench<'_, SMALL_QUEUE>) -> Vec<(u64, Record)> {
    bench.board.control[0].running = false;
    for _ in 0..3 {
        bench.millisecond();
    }
    bench.records.clone()
}

fn received(channel: Channel, frame: Frame, stamp: Stamp) -> Record {
    Record::Received(Received { channel, frame, stamp, data_omitted: false })
}

#[test]
fn it_has_the_stamp_of_its_interrupt_and_stands_in_order() {
    let queue = Queue::new();
    let mut bench = leaving(&queue);
    let ended = u64::from(bench.board.clock.now.get());
    bench.receive(CAN1, numbered(1));
    bench.pass(30 * TICKS_PER_US);
    bench.receive(CAN2, numbered(2));
    bench.millisecond();
    let records = leave(&mut bench);
    assert_eq!(records[0], (ended, received(CAN1, numbered(1), Stamp::Exact)), "{records:?}");
    let after = ended + u64::from(30 * TICKS_PER_US);
    assert_eq!(records[1], (after, received(CAN2, numbered(2), Stamp::Exact)));
    assert_eq!(bench.frames(CAN1).len(), 1);
    assert_eq!(records.last().unwrap().1, Record::Event(Event::Stopped { channel: CAN1 }));
}

/// A controller that takes its time receives more. Their interrupt is silent: when they ended is not known.
#[test]
fn what_follows_it_says_that_its_time_is_an_upper_bound() {
    let queue = Queue::new();
    let mut bench = leaving(&queue);
    for number in 1..=3 {
        bench.receive(CAN1, numbered(number));
        bench.pass(100 * TICKS_PER_US);
    }
    let stamps: Vec<Record> = leave(&mut bench).iter().map(|(_, record)| *record).take(3).collect();
    let expected = [(1, Stamp::Exact), (2, Stamp::UpperBound), (3, Stamp::UpperBound)];
    assert_eq!(stamps, expected.map(|(number, stamp)| received(CAN1, numbered(number), stamp)));
}

/// The controller's reset throws it out of the FIFO; it has been delivered all the same.
#[test]
fn it_is_not_counted_lost_if_its_fifo_does_not_release_it() {
    for stubborn in [Stubborn::Keeps, Stubborn::Repeats] {
        for others in 0..=2 {
            let queue = Queue::new();
            let mut bench = leaving(&queue);
            bench.receive(CAN1, numbered(1));
            for number in 0..others {
                bench.receive(CAN1, numbered(2 + number));
            }
            bench.board.traffic[0].stubborn = Some(stubborn);
            bench.board.reset_empties = true;
            bench.board.control[0].running = false;
            for _ in 0..60 {
                bench.millisecond();
            }
            let lost: u32 = bench
                .events()
                .iter()
                .filter_map(|event| match event {
                    Event::Lost { channel: CAN1, count, .. } => Some(*count),
                    _ => None,
                })
                .sum();
            assert_eq!((bench.frames(CAN1), lost), (vec![numbered(1)], others), "{stubborn:?}");
            assert!(bench.events().contains(&Event::Stopped { channel: CAN1 }), "{stubborn:?}");
        }
    }
}

/// A frame that ended just before is taken as usual.
#[test]
fn a_frame_whose_interrupt_waits_is_left_to_it() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    let ended = bench.board.clock.now.get();
    bench.board.traffic[0].arrive(numbered(1));
    bench.pass(3 * TICKS_PER_US);
    bench.board.capture.begin_close(CAN1, &mut bench.board.traffic, &bench.board.clock);
    bench.board.capture.on_receive(CAN1, &mut bench.board.traffic, &bench.board.clock, ended);
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.records[0], (ended.into(), received(CAN1, numbered(1), Stamp::Exact)));
}

#[test]
fn it_is_not_recorded_if_nobody_listens() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.board.control[0].stuck = true;
    bench.say(&encode(&Request {
        id: 9,
        command: Command::Hello { protocol: cantap_wire::PROTOCOL_VERSION },
    }));
    bench.receive(CAN1, numbered(1));
    leave(&mut bench);
    assert_eq!(bench.frames(CAN1), []);
    assert_eq!(bench.board.traffic[0].fifo.len(), 0);
}
