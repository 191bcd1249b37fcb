//! Pauses longer than the stamp timer's range (358 s) and than half of it, at any point: they must not show in any stamp.

use crate::fakes;

use std::ops::Range;

use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::recorder::Recorder;
use cantap_firmware::port::sender::Sender;
use cantap_firmware::{TICK_HZ, TICKS_PER_MS};
use cantap_wire::framing::MAX_ENCODED;
use cantap_wire::message::Mode;
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{Channel, Command, Decoded, Decoder, Event, Received, Record, Reply, Stamp};
use fakes::{Bench, SMALL_QUEUE, config, numbered};
use proptest::prelude::*;

const CAN1: Channel = Channel::Can1;
/// Fourteen and a half minutes: the timer wraps twice in it.
const PAUSE_S: Range<u32> = 0..870;

/// A bench, and the true time since the device started.
struct Watched<'q> {
    bench: Bench<'q, SMALL_QUEUE>,
    ticks: u64,
    seen: u32,
}

impl<'q> Watched<'q> {
    fn new(bench: Bench<'q, SMALL_QUEUE>) -> Self {
        let seen = bench.board.clock.now.get();
        Self { bench, ticks: seen.into(), seen }
    }

    /// The true time. Must be called again before the clock has wrapped.
    fn now(&mut self) -> u64 {
        let seen = self.bench.board.clock.now.get();
        self.ticks += u64::from(seen.wrapping_sub(self.seen));
        self.seen = seen;
        self.ticks
    }

    /// A pause in which nothing happens but the tick.
    fn pause(&mut self, seconds: Range<u32>) {
        for _ in seconds {
            self.bench.pass(TICK_HZ - TICKS_PER_MS);
            self.bench.millisecond();
            self.now();
        }
    }

    fn open(&mut self) {
        self.bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::ListenOnly)) }).unwrap();
    }

    /// A frame is received, and must arrive with its true time.
    fn receive_in_time(&mut self) {
        self.bench.pass(1000);
        let at = self.now();
        self.bench.receive(CAN1, numbered(1));
        self.bench.millisecond();
        self.bench.millisecond();
        let mut records = self.bench.records.iter().rev();
        let told = records.find(|(_, record)| matches!(record, Record::Received(_))).expect("a frame").0;
        let early_s = (at as i64 - told as i64) as f64 / f64::from(TICK_HZ);
        assert_eq!(told, at, "the stamp is {early_s} s early");
    }
}

#[test]
fn a_pause_between_the_greeting_and_the_opening_shows_in_no_stamp() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut watched = Watched::new(Bench::new(&queue));
    watched.bench.greet();
    watched.pause(PAUSE_S);
    watched.open();
    watched.receive_in_time();
}

#[test]
fn a_pause_between_closing_and_opening_shows_in_no_stamp() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut watched = Watched::new(Bench::opened(&queue, Mode::ListenOnly));
    for channel in Channel::ALL {
        watched.bench.ask(Command::Close { channel }).unwrap();
    }
    watched.pause(PAUSE_S);
    watched.open();
    watched.receive_in_time();
}

/// The queue is full, and events have filled the reserve: there is no room for anything that would carry the time.
#[test]
fn a_host_that_reads_nothing_for_long_gets_true_stamps_afterwards() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut watched = Watched::new(Bench::opened(&queue, Mode::ListenOnly));
    watched.bench.port.takes = 0;
    for number in 0..5000 {
        watched.bench.pass(1000);
        watched.bench.receive(CAN1, numbered(number));
    }
    watched.now();
    for _ in PAUSE_S {
        watched.bench.board.traffic[0].error = Some(BusErrorKind::Stuff);
        watched.pause(0..1);
    }
    watched.bench.port.takes = usize::MAX;
    for _ in 0..50 {
        watched.bench.millisecond();
    }
    watched.receive_in_time();
}

/// Nobody has greeted the device, and no channel is open: the tick alone keeps the time.
#[test]
fn the_time_goes_on_while_nobody_talks_to_the_device() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut watched = Watched::new(Bench::new(&queue));
    watched.pause(PAUSE_S);
    watched.bench.greet();
    let asked = watched.now();
    let Ok(Reply::Time(told)) = watched.bench.ask(Command::Time) else { panic!() };
    assert!((asked..=watched.now()).contains(&told), "{told} was requested from {asked} on");
    watched.open();
    watched.receive_in_time();
}

/// What is written, and how long after the previous record.
#[derive(Clone, Debug)]
enum Write {
    Frame {
        stamp: Stamp,
    },
    Event,
    /// The host takes everything available.
    Read,
}

fn write() -> impl Strategy<Value = (Write, i64)> {
    let stamps = prop::sample::select(vec![Stamp::Exact, Stamp::UpperBound, Stamp::Omitted]);
    let write = prop_oneof![
        6 => stamps.prop_map(|stamp| Write::Frame { stamp }),
        2 => Just(Write::Event),
        1 => Just(Write::Read),
    ];
    // Shortly before the last one, as when two interrupts are pending; the usual case; around the limits of 32 bits; five
    // wraps; years.
    let after = prop_oneof![
        8 => -2000..20_000i64,
        2 => (1i64 << 31) - 3..(1 << 31) + 3,
        2 => (1i64 << 32) - 3..(1 << 32) + 3,
        4 => 0..5i64 << 32,
        1 => 0..1i64 << 55,
    ];
    (write, after)
}

proptest! {
    /// From the recorder through queue, sender and wire to the host's decoder.
    #[test]
    fn every_record_keeps_its_time_whatever_lies_between(
        writes in prop::collection::vec(write(), 1..1500),
        start in 0..1u64 << 60,
    ) {
        let queue = RecordQueue::<SMALL_QUEUE>::new();
        let (producer, mut consumer) = queue.split();
        let mut recorder = Recorder::new(producer);
        let mut sender = Sender::new();
        recorder.restart(start);
        sender.restart(start);
        let (mut at, mut told, mut written, mut lost) = (start, start, Vec::new(), [0; 2]);
        let mut decoder = Decoder::new();
        let mut heard = Vec::new();
        let mut read = |out: &mut Vec<(u64, Record)>| {
            let mut bytes = [0; MAX_ENCODED];
            // Repeatedly, because a batch is flushed only when it is old enough.
            for now in (0..40).map(|n| n * TICKS_PER_MS) {
                let len = sender.next_batch(&mut consumer, now, &mut bytes, cantap_wire::framing::crc32);
                decoder.push(&bytes[..len], |decoded| match decoded {
                    Decoded::Record { ticks, record } => out.push((ticks, record)),
                    other => panic!("{other:?}"),
                });
            }
        };
        for (number, (write, after)) in (0..).zip(writes) {
            at = at.saturating_add_signed(after);
            match write {
                Write::Frame { stamp } => {
                    let received = Received { channel: CAN1, frame: numbered(number), stamp, data_omitted: false };
                    recorder.frame(&received, at);
                    let now_lost = Channel::ALL.map(|channel| recorder.lost(channel));
                    if now_lost == lost {
                        told = if stamp == Stamp::Omitted { told } else { at };
                        written.push((told, Record::Received(received)));
                    }
                    lost = now_lost;
                }
                Write::Event => {
                    let event = Event::State { channel: CAN1, state: ErrorState::Active, tec: 0, rec: 0 };
                    if recorder.event(&event, at) {
                        told = at;
                        written.push((at, Record::Event(event)));
                    }
                }
                Write::Read => read(&mut heard),
            }
        }
        for _ in 0..4 {
            read(&mut heard);
        }
        // Losses are reported in between, at the time of the record that follows.
        heard.retain(|(_, record)| !matches!(record, Record::Event(Event::Lost { .. })));
        if lost == [0; 2] {
            prop_assert_eq!(heard, written);
        } else {
            let times = |records: &[(u64, Record)]| {
                let exact = records.iter().filter(|(_, record)| {
                    !matches!(record, Record::Received(Received { stamp: Stamp::Omitted, .. }))
                });
                exact.copied().collect::<Vec<_>>()
            };
            prop_assert_eq!(times(&heard), times(&written));
        }
    }
}
