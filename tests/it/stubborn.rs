//! Hardware that answers late, wrongly or never: no call goes on for ever, nothing old is taken for new, and what is lost is counted.

use crate::fakes;

use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::{TICKS_PER_MS, TICKS_PER_US};
use cantap_wire::message::{Mode, TxFrame};
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Command, Event, Received, Record, Refusal, Reply, Stamp};
use fakes::{Bench, SMALL_QUEUE, Stubborn, config, numbered};

const CAN1: Channel = Channel::Can1;
const CAN2: Channel = Channel::Can2;

type Queue = RecordQueue<SMALL_QUEUE>;

/// Three frames in the FIFO would be more than the bus can bring while they are drained; a FIFO that has more repeats itself.
#[test]
fn a_fifo_that_releases_nothing_or_repeats_itself_does_not_hold_the_interrupt() {
    for stubborn in [Stubborn::Keeps, Stubborn::Repeats] {
        let queue = Queue::new();
        let mut bench = Bench::opened(&queue, Mode::ListenOnly);
        bench.board.traffic[0].stubborn = Some(stubborn);
        bench.receive(CAN1, numbered(1));
        // The other channel, USB and the tick go on.
        bench.receive(CAN2, numbered(2));
        bench.millisecond();
        bench.millisecond();
        assert_eq!(bench.frames(CAN2), [numbered(2)], "{stubborn:?}");
        assert!(bench.ask(Command::Status).is_ok(), "{stubborn:?}");
        assert!(bench.board.capture.oddities()[0].drains_given_up > 0, "{stubborn:?}");
        assert_eq!(bench.board.capture.oddities()[1].drains_given_up, 0, "{stubborn:?}");
    }
}

/// The receive interrupt is silent after a drain that was given up. The frames are fetched by the tick, which does not know when they
/// ended.
#[test]
fn a_fifo_that_is_late_is_drained_by_the_tick_with_stamps_that_say_so() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.board.traffic[0].stubborn = Some(Stubborn::Keeps);
    bench.receive(CAN1, numbered(1));
    bench.board.traffic[0].stubborn = None;
    bench.millisecond();
    bench.millisecond();
    let received =
        |frame, stamp| Record::Received(Received { channel: CAN1, frame, stamp, data_omitted: false });
    let records: Vec<Record> = bench.records.iter().map(|(_, record)| *record).collect();
    assert_eq!(records, [received(numbered(1), Stamp::UpperBound)]);
    // From here on all is as before.
    bench.receive(CAN1, numbered(2));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.records.last().unwrap().1, received(numbered(2), Stamp::Exact));
}

/// The overrun is noticed while frames that came before it are still in the FIFO, and recorded behind them; also if the channel is closed
/// meanwhile.
#[test]
fn a_loss_stands_behind_the_frames_that_were_there_before_it() {
    for closes in [false, true] {
        let queue = Queue::new();
        let mut bench = Bench::opened(&queue, Mode::ListenOnly);
        bench.board.traffic[0].stubborn = Some(Stubborn::Slow);
        bench.board.traffic[0].arrive(numbered(0));
        bench.board.traffic[0].arrive(numbered(1));
        bench.receive(CAN1, numbered(2));
        bench.board.traffic[0].arrive(numbered(3));
        bench.millisecond();
        if closes {
            bench.board.traffic[0].stubborn = None;
            bench.board.traffic[0].release();
            assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Ok(Reply::Done));
        } else {
            bench.board.traffic[0].release();
            bench.board.traffic[0].arrive(numbered(4));
            for _ in 0..4 {
                bench.millisecond();
                bench.board.traffic[0].release();
            }
        }
        bench.millisecond();
        bench.millisecond();
        let frames: &[u32] = if closes { &[0, 1, 2] } else { &[0, 1, 2, 4] };
        assert_eq!(bench.frames(CAN1), frames.iter().map(|n| numbered(*n)).collect::<Vec<_>>());
        let lost = Event::Lost { channel: CAN1, stage: LossStage::Controller, count: 1, at_least: true };
        assert_eq!(bench.records[3].1, Record::Event(lost), "{closes}: {:?}", bench.records);
    }
}

/// What an unreleased FIFO cannot take in is an overrun like any other.
#[test]
fn frames_that_a_stubborn_fifo_drops_are_counted() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.board.traffic[0].stubborn = Some(Stubborn::Keeps);
    for number in 0..5 {
        bench.receive(CAN1, numbered(number));
    }
    bench.board.traffic[0].stubborn = None;
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.frames(CAN1), [0, 1, 2].map(numbered));
    let lost = |event: &Event| {
        matches!(event, Event::Lost { channel: CAN1, stage: LossStage::Controller, count: 1, at_least: true })
    };
    assert!(bench.events().iter().any(lost), "{:?}", bench.events());
}

/// No manual promises that a FIFO can be released in initialisation mode. What it keeps is counted, and the controller's own reset empties
/// it: a frame of this session must not turn up in the next.
#[test]
fn frames_that_cannot_be_taken_after_the_end_are_counted_and_do_not_turn_up_later() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.board.traffic[0].arrive(numbered(1));
    bench.board.traffic[0].arrive(numbered(2));
    bench.board.traffic[0].stubborn = Some(Stubborn::Keeps);
    bench.board.reset_empties = true;
    assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Ok(Reply::Done));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.board.control[0].halts, 1);
    let lost = Event::Lost { channel: CAN1, stage: LossStage::Controller, count: 2, at_least: true };
    // The other channel may have been deaf for a moment, which its own record says.
    let mut events = bench.events();
    events.retain(|event| !matches!(event, Event::Lost { channel: CAN2, count: 0, .. }));
    assert_eq!(events, [lost, Event::Stopped { channel: CAN1 }]);
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!(status.channels[0].lost_controller, 2);
    bench.records.clear();
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::ListenOnly)) }).unwrap();
    bench.receive(CAN1, numbered(3));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.frames(CAN1), [numbered(3)]);
}

/// A release that does nothing leaves the frame in front, which must not be taken for another one.
#[test]
fn a_frame_that_stays_after_the_end_is_delivered_once() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    bench.board.last_frame = Some(numbered(1));
    bench.board.reset_empties = true;
    assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Ok(Reply::Done));
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.frames(CAN1), [numbered(1)]);
    assert!(!bench.events().iter().any(|event| matches!(event, Event::Lost { channel: CAN1, .. })));
    assert_eq!(bench.board.control[0].halts, 1);
}

/// Even a controller whose reset does not empty its FIFO is answered for in bounded time.
#[test]
fn a_fifo_that_nothing_empties_is_a_refusal_and_not_a_hang() {
    for stubborn in [Stubborn::Keeps, Stubborn::Repeats] {
        let queue = Queue::new();
        let mut bench = Bench::opened(&queue, Mode::ListenOnly);
        bench.board.traffic[0].arrive(numbered(1));
        bench.board.traffic[0].stubborn = Some(stubborn);
        assert_eq!(bench.ask(Command::Close { channel: CAN1 }), Err(Refusal::Hardware), "{stubborn:?}");
        assert_eq!(bench.ask(Command::Close { channel: CAN2 }), Ok(Reply::Done), "{stubborn:?}");
        bench.greet();
    }
}

/// A mailbox that goes on saying that it has finished: the transmit interrupt would come at once and for ever.
#[test]
fn a_mailbox_that_stays_finished_does_not_hold_the_interrupt() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let frame = TxFrame { tag: 1, frame: numbered(1), at_ticks: None };
    bench.ask(Command::Send { channel: CAN1, frames: [frame].into_iter().collect() }).unwrap();
    bench.board.traffic[0].never_emptied = Some(0);
    let before = bench.board.traffic[0].awaited;
    bench.send_one(CAN1);
    assert_eq!(bench.board.traffic[0].awaited, before, "the interrupt stays silent");
    bench.millisecond();
    bench.millisecond();
    assert_eq!(bench.events().len(), 1, "the frame is confirmed once: {:?}", bench.events());
    assert!(bench.board.capture.oddities()[0].mailboxes_stuck > 0);
    assert!(bench.board.traffic[0].awaited > before, "it is tried again");
    bench.board.traffic[0].never_emptied = None;
    let frame = TxFrame { tag: 2, frame: numbered(2), at_ticks: None };
    bench.board.traffic[0].finished.clear();
    bench.ask(Command::Send { channel: CAN1, frames: [frame].into_iter().collect() }).unwrap();
    assert_eq!(bench.send_one(CAN1), Some(numbered(2)));
}

/// ERRI that is not cleared by clearing it: the error interrupt would come at once and for ever, and USB and the tick would never run.
#[test]
fn an_error_flag_that_stays_set_does_not_hold_the_interrupt() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    for round in 1..=3 {
        let storm = (0..100_000).take_while(|_| {
            bench.pass(2 * TICKS_PER_US);
            let entered = bench.board.clock.now.get();
            bench.board.capture.on_error(CAN1, &mut bench.board.traffic[0], entered)
        });
        assert!(storm.count() <= 100, "it goes on");
        assert_eq!(bench.board.capture.oddities().map(|channel| channel.error_storms), [round, 0]);
        bench.pass(TICKS_PER_MS);
        assert!(bench.board.capture.take_errors_held(CAN1), "the next tick lets it come again");
        assert!(!bench.board.capture.take_errors_held(CAN1));
    }
}

/// An error flag and its delimiter are 14 bits: no bus has more errors, however late the tick is.
#[test]
fn the_errors_of_a_broken_bus_never_silence_their_interrupt() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    for _ in 0..5_000 {
        bench.pass(14 * TICKS_PER_US);
        let entered = bench.board.clock.now.get();
        assert!(bench.board.capture.on_error(CAN1, &mut bench.board.traffic[0], entered));
    }
    assert_eq!(bench.board.capture.oddities()[0].error_storms, 0);
}

/// A controller that shows no free mailbox although none is in use. An alarm for what is due would fire again and again.
#[test]
fn a_controller_that_takes_no_frame_raises_no_storm_of_alarms() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    bench.board.traffic[0].blocked = true;
    let due = bench.board.clock.now.get() + 5 * TICKS_PER_MS;
    let frame = TxFrame { tag: 7, frame: numbered(7), at_ticks: Some(due.into()) };
    bench.ask(Command::Send { channel: CAN1, frames: [frame].into_iter().collect() }).unwrap();
    let mut alarms = 0;
    for _ in 0..20 {
        bench.millisecond();
        for _ in 0..TICKS_PER_MS / TICKS_PER_US {
            bench.pass(TICKS_PER_US);
            let now = bench.board.clock.now.get();
            let at = bench.board.clock.alarm.get();
            alarms += u32::from(at.is_some_and(|at| now.wrapping_sub(at) < u32::MAX / 2));
            bench.alarm();
        }
    }
    assert!(alarms < 100, "{alarms} alarms in 40 ms");
    bench.board.traffic[0].blocked = false;
    bench.millisecond();
    assert_eq!(bench.send_one(CAN1), Some(numbered(7)));
}

/// A restart in the middle of a frame would destroy it for everyone on the bus.
#[test]
fn both_channels_have_left_their_buses_before_the_chip_restarts() {
    for command in [Command::Reset, Command::Bootloader] {
        let queue = Queue::new();
        let mut bench = Bench::opened(&queue, Mode::Normal);
        let frame = TxFrame { tag: 1, frame: numbered(1), at_ticks: None };
        bench.ask(Command::Send { channel: CAN1, frames: [frame].into_iter().collect() }).unwrap();
        bench.ask(command).unwrap();
        assert!(bench.board.control.iter().all(|control| !control.running), "asked to leave at once");
        assert!(bench.board.traffic[0].aborts > 0);
        for _ in 0..100 {
            bench.millisecond();
        }
        assert_eq!(bench.board.chip.resets, 1);
    }
}

/// A stuck bus delays the restart; it does not prevent it.
#[test]
fn a_controller_that_cannot_leave_is_made_to_before_the_restart() {
    for halts_needed in [3, usize::MAX] {
        let queue = Queue::new();
        let mut bench = Bench::opened(&queue, Mode::Normal);
        bench.board.control[1].stuck = true;
        bench.board.control[1].halts_needed = halts_needed;
        bench.ask(Command::Reset).unwrap();
        for _ in 0..90 {
            bench.millisecond();
        }
        assert_eq!(bench.board.chip.resets, 0, "a frame may still be on the bus");
        for _ in 0..300 {
            bench.millisecond();
        }
        assert!(bench.board.chip.resets >= 1, "{halts_needed}");
    }
}
