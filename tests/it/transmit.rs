//! Transmission: order, times, periods, replies, confirmations, on fakes.

use crate::fakes;

use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::transmit::TX_QUEUE;
use cantap_firmware::ports::Clock;
use cantap_firmware::{TICKS_PER_MS, TICKS_PER_US};
use cantap_wire::message::{
    ChannelConfig, Checksum, DEVICE_TAG, Filter, FrameKind, Mode, Modifier, Periodic, TRIGGER_TAG, Trigger,
    TxFdFrame, TxFrame,
};
use cantap_wire::record::{ErrorState, TransmitFailure};
use cantap_wire::{Channel, Command, Event, FdFrame, Frame, Id, Record, Refusal, Reply};
use fakes::{Bench, FakeClock, SMALL_QUEUE, config, numbered};

const CAN1: Channel = Channel::Can1;
const CAN2: Channel = Channel::Can2;

const EARLY: u32 = FakeClock::ALARM_EARLY_TICKS;

type Queue = RecordQueue<SMALL_QUEUE>;

fn send<const N: usize>(bench: &mut Bench<'_, N>, numbers: std::ops::Range<u32>) -> Result<Reply, Refusal> {
    let frames =
        numbers.map(|number| TxFrame { tag: number, frame: numbered(number), at_ticks: None }).collect();
    bench.ask(Command::Send { channel: CAN1, frames })
}

/// Tags of confirmations and failures, in order.
fn outcomes<const N: usize>(bench: &Bench<'_, N>) -> Vec<(u32, Option<TransmitFailure>)> {
    let outcome = |event| match event {
        Event::Transmitted { tag, .. } => Some((tag, None)),
        Event::TransmitFailed { tag, reason, .. } => Some((tag, Some(reason))),
        _ => None,
    };
    bench.events().into_iter().filter_map(outcome).collect()
}

fn flush<const N: usize>(bench: &mut Bench<'_, N>) {
    bench.millisecond();
    bench.millisecond();
}

#[test]
fn a_board_refuses_can_fd_frames_and_sends_nothing_in_their_place() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let frame = FdFrame::new(Id::standard(0x123).unwrap(), true, false, &[7; 12]).unwrap();
    let frames = [TxFdFrame { tag: 1, frame, at_ticks: None }].into_iter().collect();
    assert_eq!(bench.ask(Command::SendFd { channel: CAN1, frames }), Err(Refusal::Unsupported));
    flush(&mut bench);
    assert_eq!((bench.send_one(CAN1), outcomes(&bench)), (None, Vec::new()));
}

#[test]
fn frames_leave_in_order_and_each_is_confirmed_with_its_time() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for first in (0..40).step_by(8) {
        send(&mut bench, first..first + 8).unwrap();
    }
    let mut expected = Vec::new();
    for number in 0..40 {
        bench.pass(111 * TICKS_PER_US);
        expected.push((
            u64::from(bench.board.clock.now.get()),
            Record::Event(Event::Transmitted { channel: CAN1, tag: number, frame: numbered(number) }),
        ));
        assert_eq!(bench.send_one(CAN1), Some(numbered(number)));
    }
    flush(&mut bench);
    assert_eq!(bench.records, expected);
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!((status.channels[0].transmitted, status.channels[0].tx_pending), (40, 0));
}

/// The interrupt that stamps is silenced until its task has run. Two transmissions that end meanwhile have only one stamp, which is the
/// first one's; the second must not be reported as ending earlier than it did.
#[test]
fn what_ended_while_the_task_was_kept_waiting_is_not_stamped_early() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    send(&mut bench, 0..2).unwrap();
    let stamp = bench.board.clock.now.get();
    bench.board.traffic[0].send_one().unwrap();
    bench.pass(50 * TICKS_PER_US);
    bench.board.traffic[0].send_one().unwrap();
    let second = bench.board.clock.now.get();
    bench.board.capture.on_transmit(CAN1, &mut bench.board.traffic, &bench.board.clock, Some(stamp));
    flush(&mut bench);
    let sent = |(_, record): &&(u64, Record)| matches!(record, Record::Event(Event::Transmitted { .. }));
    let times: Vec<u64> = bench.records.iter().filter(sent).map(|(at, _)| *at).collect();
    assert_eq!(times, [u64::from(stamp), u64::from(second)]);
}

#[test]
fn a_full_queue_pushes_back_and_takes_all_or_nothing() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let mut accepted = 0;
    let free = loop {
        match send(&mut bench, accepted..accepted + 7) {
            Ok(Reply::Queued { .. }) => accepted += 7,
            Err(Refusal::QueueFull { free }) => break free,
            other => panic!("{other:?}"),
        }
    };
    // Three are waiting in mailboxes.
    assert_eq!(accepted as usize + free as usize, TX_QUEUE + 3);
    for number in 0..accepted {
        assert_eq!(bench.send_one(CAN1), Some(numbered(number)));
    }
    assert_eq!(bench.send_one(CAN1), None);
}

#[test]
fn a_frame_waits_for_its_time_and_later_ones_wait_for_it() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let due = bench.board.clock.now.get() + 5 * TICKS_PER_MS;
    let frames = [Some(u64::from(due)), None, Some(u64::from(due + 1000))]
        .into_iter()
        .enumerate()
        .map(|(tag, at_ticks)| TxFrame { tag: tag as u32, frame: numbered(tag as u32), at_ticks })
        .collect();
    bench.ask(Command::Send { channel: CAN1, frames }).unwrap();
    assert_eq!(bench.send_one(CAN1), None);
    assert_eq!(bench.board.clock.alarm.get(), Some(due - EARLY));
    bench.board.clock.now.set(due - EARLY - 1);
    bench.alarm();
    assert_eq!(bench.send_one(CAN1), None);
    bench.board.clock.now.set(due - EARLY);
    bench.alarm();
    assert_eq!(bench.board.clock.now.get(), due);
    assert_eq!(bench.board.traffic[0].order.len(), 2);
    assert_eq!(bench.send_one(CAN1), Some(numbered(0)));
    assert_eq!(bench.send_one(CAN1), Some(numbered(1)));
    assert_eq!(bench.send_one(CAN1), None);
    assert_eq!(bench.board.clock.alarm.get(), Some(due + 1000 - EARLY));
}

#[test]
fn frames_that_are_due_together_leave_together_on_both_channels() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let due = bench.board.clock.now.get() + 5 * TICKS_PER_MS;
    for (channel, at) in [(CAN1, due + 40), (CAN2, due), (CAN1, due + 90), (CAN2, due + 2000)] {
        let frame = TxFrame { tag: at, frame: numbered(at), at_ticks: Some(at.into()) };
        bench.ask(Command::Send { channel, frames: [frame].into_iter().collect() }).unwrap();
    }
    bench.board.clock.now.set(due - EARLY);
    bench.alarm();
    assert_eq!(bench.board.clock.now.get(), due + 90);
    assert_eq!(bench.board.traffic.each_ref().map(|traffic| traffic.order.len()), [2, 1]);
    assert_eq!(bench.send_one(CAN1), Some(numbered(due + 40)));
    assert_eq!(bench.send_one(CAN1), Some(numbered(due + 90)));
    assert_eq!(bench.send_one(CAN2), Some(numbered(due)));
    assert_eq!(bench.board.clock.alarm.get(), Some(due + 2000 - EARLY));
}

#[test]
fn a_periodic_frame_goes_before_a_queued_one_that_is_due_a_moment_later() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let entry = Some(periodic("100#", 1, 0, &[]));
    bench.ask(Command::SetPeriodic { channel: CAN1, slot: 0, entry }).unwrap();
    let first = bench.board.clock.now.get();
    assert!(bench.send_one(CAN1).is_some());
    let due = first + TICKS_PER_MS;
    for channel in [CAN1, CAN2] {
        let frame = TxFrame { tag: 1, frame: numbered(1), at_ticks: Some((due + 60).into()) };
        bench.ask(Command::Send { channel, frames: [frame].into_iter().collect() }).unwrap();
    }
    bench.board.clock.now.set(due - 30);
    bench.alarm();
    assert_eq!(bench.send_one(CAN1), Some("100#".parse().unwrap()));
    assert_eq!(bench.send_one(CAN1), Some(numbered(1)));
    assert_eq!(bench.send_one(CAN2), Some(numbered(1)));
}

/// If nobody acknowledges, frames stay in their mailboxes, and the host may leave meanwhile.
#[test]
fn nothing_of_a_session_is_sent_in_the_next() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    send(&mut bench, 0..5).unwrap();
    assert_eq!(bench.board.traffic[0].order.len(), 3);
    bench.port.open = false;
    flush(&mut bench);
    bench.port.open = true;
    bench.greet();
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::Normal)) }).unwrap();
    assert_eq!(bench.send_one(CAN1), None);
    let due = bench.board.clock.now.get() + TICKS_PER_MS;
    let frame = TxFrame { tag: 77, frame: numbered(77), at_ticks: Some(due.into()) };
    bench.ask(Command::Send { channel: CAN1, frames: [frame].into_iter().collect() }).unwrap();
    bench.board.clock.now.set(due - EARLY);
    bench.alarm();
    assert_eq!(bench.send_one(CAN1), Some(numbered(77)));
    assert_eq!(bench.board.clock.alarm.get(), None);
}

#[test]
fn a_target_time_of_more_than_a_day_is_refused() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let frames = [TxFrame { tag: 1, frame: numbered(1), at_ticks: Some(u64::MAX) }].into_iter().collect();
    assert_eq!(bench.ask(Command::Send { channel: CAN1, frames }), Err(Refusal::TooFarAhead));
}

fn periodic(text: &str, period_ms: u32, count: u32, modifiers: &[Modifier]) -> Periodic {
    Periodic {
        frame: text.parse().unwrap(),
        period_ticks: period_ms * TICKS_PER_MS,
        count,
        modifiers: modifiers.iter().copied().collect(),
    }
}

#[test]
fn a_periodic_frame_keeps_its_period_without_drift() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let entry = Some(periodic("100#", 10, 5, &[]));
    bench.ask(Command::SetPeriodic { channel: CAN1, slot: 31, entry }).unwrap();
    let mut sent = Vec::new();
    let start = bench.board.clock.now.get();
    for _ in 0..100_000 {
        bench.pass(TICKS_PER_US);
        bench.alarm();
        if bench.send_one(CAN1).is_some() {
            sent.push((bench.board.clock.now.get() - start) / TICKS_PER_US);
        }
    }
    // The first is sent while the response is on its way, before the first check.
    assert_eq!(sent, [1, 10_000, 20_000, 30_000, 40_000]);
    flush(&mut bench);
    assert_eq!(outcomes(&bench), vec![(DEVICE_TAG + 31, None); 5]);
}

#[test]
fn modifiers_count_check_and_randomise() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let entry = periodic(
        "100#F0000000",
        1,
        0,
        &[
            Modifier::Counter { byte: 0, low_bit: 2, bits: 2 },
            Modifier::Random { byte: 1 },
            Modifier::Checksum { byte: 3, algorithm: Checksum::Xor },
        ],
    );
    bench.ask(Command::SetPeriodic { channel: CAN1, slot: 0, entry: Some(entry) }).unwrap();
    let mut frames = Vec::new();
    for _ in 0..40 {
        bench.millisecond();
        bench.alarm();
        frames.extend(bench.send_one(CAN1));
    }
    let firsts: Vec<u8> = frames[..6].iter().map(|frame| frame.data()[0]).collect();
    assert_eq!(firsts, [0xF0, 0xF4, 0xF8, 0xFC, 0xF0, 0xF4]);
    assert!(frames.iter().all(|frame| frame.data().iter().fold(0, |sum, byte| sum ^ byte) == 0));
    let random: std::collections::HashSet<u8> = frames.iter().map(|frame| frame.data()[1]).collect();
    assert!(random.len() > 20, "{random:?}");
}

/// Failed transmissions of channel 1, according to the status.
fn failures<const N: usize>(bench: &mut Bench<'_, N>) -> u32 {
    match bench.ask(Command::Status).unwrap() {
        Reply::Status(status) => status.channels[0].transmit_failures,
        other => panic!("{other:?}"),
    }
}

/// A bus that takes nothing must neither stop the count nor pile frames up.
#[test]
fn a_period_that_passes_unsent_is_told() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    send(&mut bench, 0..3).unwrap();
    let entry = Some(periodic("100#", 10, 0, &[]));
    bench.ask(Command::SetPeriodic { channel: CAN1, slot: 1, entry }).unwrap();
    for _ in 0..35 {
        bench.millisecond();
        bench.alarm();
    }
    assert_eq!(failures(&mut bench), 3);
    let sent: Vec<Frame> = std::iter::from_fn(|| bench.send_one(CAN1)).collect();
    assert_eq!(sent.len(), 4);
    // Their number is reported ten times a second.
    for _ in 0..200 {
        bench.millisecond();
        bench.alarm();
        while bench.send_one(CAN1).is_some() {}
    }
    let overtaken = |outcomes: Vec<(u32, Option<TransmitFailure>)>| {
        let periods = outcomes.into_iter().filter_map(|(tag, failure)| match failure {
            Some(TransmitFailure::Overtaken { periods }) if tag == DEVICE_TAG + 1 => Some(periods),
            _ => None,
        });
        periods.sum::<u32>()
    };
    assert_eq!(overtaken(outcomes(&bench)), 3);
    // A second in which nobody checks: of its 100 periods one is loaded at once and one waits after it.
    let before = failures(&mut bench);
    bench.pass(1000 * cantap_firmware::TICKS_PER_MS);
    bench.millisecond();
    bench.alarm();
    let failed = failures(&mut bench) - before;
    assert!((98..=100).contains(&failed), "{failed} of 100");
}

#[test]
fn entries_outside_frame_or_table_are_refused() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for (slot, entry, refusal) in [
        (32, periodic("100#", 10, 0, &[]), Refusal::BadSlot),
        (0, periodic("100#", 0, 0, &[]), Refusal::BadEntry),
        (0, periodic("100#11", 1, 0, &[Modifier::Random { byte: 1 }]), Refusal::BadEntry),
        (
            0,
            periodic("100#11", 1, 0, &[Modifier::Counter { byte: 0, low_bit: 7, bits: 2 }]),
            Refusal::BadEntry,
        ),
    ] {
        assert_eq!(bench.ask(Command::SetPeriodic { channel: CAN1, slot, entry: Some(entry) }), Err(refusal));
    }
}

#[test]
fn a_matching_frame_is_answered_at_once_and_so_often() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let filter = Filter { extended: false, kind: FrameKind::Remote, id: 0x123, mask: 0x7FF };
    let entry = Some(Trigger { filter, reply: numbered(9), count: 2 });
    bench.ask(Command::SetTrigger { channel: CAN2, slot: 7, entry }).unwrap();
    bench.receive(CAN2, "123#11".parse().unwrap());
    assert_eq!(bench.send_one(CAN2), None);
    for _ in 0..2 {
        bench.receive(CAN2, "123#R".parse().unwrap());
        assert_eq!(bench.send_one(CAN2), Some(numbered(9)));
    }
    bench.receive(CAN2, "123#R".parse().unwrap());
    assert_eq!(bench.send_one(CAN2), None);
    flush(&mut bench);
    assert_eq!(outcomes(&bench), [(TRIGGER_TAG + 7, None); 2]);
}

#[test]
fn an_abort_reports_every_frame_that_it_takes_back() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    send(&mut bench, 0..8).unwrap();
    assert!(bench.send_one(CAN1).is_some());
    bench.ask(Command::Abort { channel: CAN1 }).unwrap();
    flush(&mut bench);
    let mut outcomes = outcomes(&bench);
    assert_eq!(outcomes.remove(0), (0, None));
    outcomes.sort_by_key(|(tag, _)| *tag);
    assert_eq!(outcomes, (1..8).map(|tag| (tag, Some(TransmitFailure::Aborted))).collect::<Vec<_>>());
    send(&mut bench, 20..21).unwrap();
    assert_eq!(bench.send_one(CAN1), Some(numbered(20)));
}

#[test]
fn closing_reports_what_was_not_sent_before_the_stop() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    send(&mut bench, 0..8).unwrap();
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    flush(&mut bench);
    let mut outcomes = outcomes(&bench);
    outcomes.sort_by_key(|(tag, _)| *tag);
    assert_eq!(outcomes, (0..8).map(|tag| (tag, Some(TransmitFailure::Closed))).collect::<Vec<_>>());
    assert_eq!(bench.events().last(), Some(&Event::Stopped { channel: CAN1 }));
}

#[test]
fn manual_recovery_gives_the_queue_up_and_waits_for_the_command() {
    let queue = Queue::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let config = ChannelConfig { manual_recovery: true, ..config(Mode::Normal) };
    bench.ask(Command::Open { channel: CAN1, config: Some(config) }).unwrap();
    send(&mut bench, 0..5).unwrap();
    bench.board.traffic[0].state = Some(ErrorState::BusOff);
    flush(&mut bench);
    flush(&mut bench);
    let mut outcomes = outcomes(&bench);
    outcomes.sort_by_key(|(tag, _)| *tag);
    assert_eq!(outcomes, (0..5).map(|tag| (tag, Some(TransmitFailure::BusOff))).collect::<Vec<_>>());
    bench.ask(Command::Recover { channel: CAN1 }).unwrap();
    assert_eq!(bench.board.control[0].resumed, 1);
    bench.board.traffic[0].state = None;
    flush(&mut bench);
    assert!(bench.events().contains(&Event::State {
        channel: CAN1,
        state: ErrorState::Active,
        tec: 0,
        rec: 0
    }));
}

/// One channel's periodic frames cannot be confirmed for lack of room, and wait; meanwhile the other channel's frame becomes due. An
/// alarm that fired again and again would keep USB from making room.
#[test]
fn what_waits_for_room_on_one_channel_raises_no_storm_of_alarms_for_the_other() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let entry = Some(periodic("100#", 1, 0, &[]));
    bench.ask(Command::SetPeriodic { channel: CAN2, slot: 0, entry }).unwrap();
    let due = bench.board.clock.now.get() + 310 * TICKS_PER_MS;
    let frame = TxFrame { tag: 7, frame: numbered(7), at_ticks: Some(due.into()) };
    bench.ask(Command::Send { channel: CAN1, frames: [frame].into_iter().collect() }).unwrap();
    bench.port.takes = 0;
    for number in 0..5000 {
        bench.receive(CAN1, numbered(number));
    }
    // The queue's reserve fills up with events.
    for _ in 0..300 {
        bench.millisecond();
        bench.alarm();
        bench.send_one(CAN2);
    }
    let mut alarms = 0;
    for _ in 0..20 * TICKS_PER_MS / TICKS_PER_US {
        bench.pass(TICKS_PER_US);
        let now = bench.board.clock.now.get();
        alarms +=
            u32::from(bench.board.clock.alarm.get().is_some_and(|at| now.wrapping_sub(at) < u32::MAX / 2));
        bench.alarm();
    }
    assert!(alarms < 100, "{alarms} alarms in 20 ms");
    assert_eq!(bench.send_one(CAN1), Some(numbered(7)));
}

/// A confirmation is never lost: while the host reads nothing, transmission stops before one could be.
#[test]
fn confirmations_survive_a_host_that_does_not_read() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    for first in (0..200).step_by(8) {
        send(&mut bench, first..first + 8).unwrap();
    }
    bench.port.takes = 0;
    for number in 0..5000 {
        bench.receive(CAN2, numbered(number));
    }
    for _ in 0..200 {
        bench.send_one(CAN1);
        bench.millisecond();
    }
    bench.port.takes = usize::MAX;
    for _ in 0..300 {
        bench.millisecond();
        bench.send_one(CAN1);
    }
    flush(&mut bench);
    assert_eq!(outcomes(&bench), (0..200).map(|tag| (tag, None)).collect::<Vec<_>>());
}
