//! The measurement of a receive pin, as a host sees it: what is reported, with which times, and what ends
//! it.

use crate::fakes;

use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::ports::PinEdge;
use cantap_wire::message::{Edge, Edges, MAX_EDGES, Mode};
use cantap_wire::{Channel, Command, PROTOCOL_VERSION, Refusal, Reply};
use fakes::{Bench, SMALL_QUEUE, config};

const CAN1: Channel = Channel::Can1;
const CAN2: Channel = Channel::Can2;

fn edges<const N: usize>(bench: &mut Bench<'_, N>) -> Edges {
    match bench.ask(Command::Edges) {
        Ok(Reply::Edges(edges)) => edges,
        other => panic!("{other:?}"),
    }
}

fn measure<const N: usize>(bench: &mut Bench<'_, N>, channel: Option<Channel>) -> Result<Reply, Refusal> {
    bench.ask(Command::MeasureEdges { channel })
}

#[test]
fn edges_are_told_once_with_the_time_between_them_over_the_timer_s_wrap() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    assert_eq!(bench.ask(Command::Edges), Err(Refusal::NotMeasuring));
    // Never more than half of the timer's range at once, which the millisecond tick ensures on the board.
    for now in [1 << 30, 2 << 30, 3 << 30, u32::MAX - 100] {
        bench.board.clock.now.set(now);
        bench.ask(Command::Time).unwrap();
    }
    assert_eq!(measure(&mut bench, Some(CAN2)), Ok(Reply::Done));
    assert_eq!(bench.board.meter.watched, [Some(CAN2)]);
    for (at, dominant, unsure) in [(u32::MAX - 50, true, false), (9, false, false), (21, true, true)] {
        bench.board.meter.edges.push_back(PinEdge { at, dominant, unsure });
    }
    bench.board.meter.dominant = true;
    bench.board.clock.now.set(100);
    let told = edges(&mut bench);
    let edge = |ticks, dominant, unsure| Edge { ticks, dominant, unsure };
    assert_eq!(told.edges[..], [edge(50, true, false), edge(60, false, false), edge(12, true, true)]);
    assert!(told.dominant && told.ticks & 0xFFFF_FFFF == 100 && told.ticks > u64::from(u32::MAX));
    // One that came after the time was read.
    bench.board.meter.edges.push_back(PinEdge { at: 111, dominant: false, unsure: false });
    assert_eq!(edges(&mut bench).edges[..], [edge(90, false, false)]);
    assert_eq!(edges(&mut bench).edges[..], []);
}

#[test]
fn more_edges_than_an_answer_holds_come_with_the_next() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    assert_eq!(measure(&mut bench, Some(CAN1)), Ok(Reply::Done));
    let from = bench.board.clock.now.get();
    for n in 1..=MAX_EDGES as u32 + 3 {
        bench.board.meter.edges.push_back(PinEdge { at: from + 12 * n, dominant: n % 2 == 1, unsure: false });
    }
    assert_eq!(edges(&mut bench).edges.len(), MAX_EDGES);
    let rest = edges(&mut bench).edges;
    assert_eq!(rest.len(), 3);
    assert!(rest.iter().all(|edge| edge.ticks == 12));
}

/// A 32-bit time that waited too long could belong to another turn of the timer.
#[test]
fn a_measurement_that_nobody_asks_about_begins_anew_and_says_so() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    assert_eq!(measure(&mut bench, Some(CAN1)), Ok(Reply::Done));
    bench.board.meter.edges.push_back(PinEdge { at: 5, dominant: true, unsure: false });
    bench.board.clock.now.set((1 << 28) + 1000);
    assert_eq!(edges(&mut bench).edges[..], []);
    assert_eq!(bench.board.meter.watched, [Some(CAN1), Some(CAN1)]);
    bench.board.meter.edges.push_back(PinEdge { at: (1 << 28) + 1010, dominant: true, unsure: false });
    assert_eq!(edges(&mut bench).edges[..], [Edge { ticks: 10, dominant: true, unsure: true }]);
}

#[test]
fn the_channel_must_be_closed_and_its_opening_ends_the_measurement() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let open = |channel| Command::Open { channel, config: Some(config(Mode::ListenOnly)) };
    bench.ask(open(CAN1)).unwrap();
    assert_eq!(measure(&mut bench, Some(CAN1)), Err(Refusal::ChannelOpen));
    assert_eq!(measure(&mut bench, Some(CAN2)), Ok(Reply::Done));
    // The other channel can be opened and closed meanwhile.
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    bench.ask(open(CAN1)).unwrap();
    assert_eq!(edges(&mut bench).edges[..], []);
    bench.ask(open(CAN2)).unwrap();
    assert_eq!(bench.board.meter.watched, [Some(CAN2), None]);
    assert_eq!(bench.ask(Command::Edges), Err(Refusal::NotMeasuring));
}

#[test]
fn it_ends_when_it_is_told_to_and_with_the_session() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    measure(&mut bench, Some(CAN1)).unwrap();
    measure(&mut bench, None).unwrap();
    assert_eq!(bench.ask(Command::Edges), Err(Refusal::NotMeasuring));
    measure(&mut bench, Some(CAN1)).unwrap();
    bench.ask(Command::Hello { protocol: PROTOCOL_VERSION }).unwrap();
    assert_eq!(bench.ask(Command::Edges), Err(Refusal::NotMeasuring));
    assert_eq!(bench.board.meter.watched, [Some(CAN1), None, Some(CAN1), None]);
    measure(&mut bench, Some(CAN1)).unwrap();
    bench.port.open = false;
    bench.poll();
    assert_eq!(bench.board.meter.watched.last(), Some(&None));
}
