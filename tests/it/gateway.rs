//! The gateway between the channels, on fakes.

use crate::fakes;

use cantap_firmware::TICKS_PER_US;
use cantap_firmware::bus::gateway::READY;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_wire::message::{
    Checksum, Filter, FrameKind, GATEWAY_TAG, GatewayEnd, GatewayRule, GatewayState, GatewayStatus, Mode,
    Modifier, Pass, RuleCounts, TxFrame,
};
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Command, Event, Frame, Record, Refusal, Reply};
use fakes::{Bench, SMALL_QUEUE, config, numbered};

pub const CAN1: Channel = Channel::Can1;
pub const CAN2: Channel = Channel::Can2;

pub type Queue = RecordQueue<SMALL_QUEUE>;

pub fn frame(text: &str) -> Frame {
    text.parse().unwrap()
}

/// Lets standard frames pass whose identifier agrees with `id` in `mask`.
pub fn rule(id: u32, mask: u32, pass: Option<Pass>) -> GatewayRule {
    GatewayRule { filter: Filter { extended: false, kind: FrameKind::Any, id, mask }, pass }
}

pub fn everything() -> GatewayRule {
    rule(0, 0, Some(Pass::unchanged(false)))
}

pub fn set<const N: usize>(bench: &mut Bench<'_, N>, from: Channel, rules: &[GatewayRule]) {
    for (slot, rule) in (0..).zip(rules) {
        let rule = Some(rule.clone());
        assert_eq!(bench.ask(Command::SetGatewayRule { from, slot, rule }), Ok(Reply::Done));
    }
}

/// A device that passes on what CAN1 receives.
pub fn started<'q>(queue: &'q Queue, rules: &[GatewayRule]) -> Bench<'q, SMALL_QUEUE> {
    let mut bench = Bench::opened(queue, Mode::Normal);
    set(&mut bench, CAN1, rules);
    assert_eq!(bench.ask(Command::StartGateway), Ok(Reply::Done));
    bench
}

pub fn status<const N: usize>(bench: &mut Bench<'_, N>, from: Channel) -> GatewayStatus {
    match bench.ask(Command::GatewayStatus { from, first: 0 }) {
        Ok(Reply::Gateway(status)) => status,
        other => panic!("{other:?}"),
    }
}

pub fn flush<const N: usize>(bench: &mut Bench<'_, N>) {
    bench.millisecond();
    bench.millisecond();
}

#[test]
fn the_first_rule_that_matches_decides_and_the_rest_is_not_passed_on() {
    let queue = Queue::new();
    let rules = [rule(0x100, 0x7FF, None), rule(0x100, 0x700, Some(Pass::unchanged(false)))];
    let mut bench = started(&queue, &rules);
    for text in ["100#01", "101#02", "201#03", "00000101#04"] {
        bench.receive(CAN1, frame(text));
    }
    bench.receive(CAN2, frame("101#05"));
    bench.pass(130 * TICKS_PER_US);
    assert_eq!(bench.send_one(CAN2), Some(frame("101#02")));
    assert_eq!((bench.send_one(CAN2), bench.send_one(CAN1)), (None, None));
    let found = status(&mut bench, CAN1);
    assert_eq!((found.state, found.unmatched, found.waiting), (GatewayState::Running, 2, 0));
    let passed = RuleCounts { matched: 1, sent: 1, ..RuleCounts::default() };
    assert_eq!(found.counts[..], [RuleCounts { matched: 1, ..RuleCounts::default() }, passed]);
    assert_eq!(status(&mut bench, CAN2).unmatched, 1);
    flush(&mut bench);
    let sent = Event::Transmitted { channel: CAN2, tag: GATEWAY_TAG + 1, frame: frame("101#02") };
    assert!(bench.events().contains(&sent), "{:?}", bench.events());
}

#[test]
fn a_frame_is_changed_before_it_is_sent() {
    let queue = Queue::new();
    let pass = Pass {
        extended: true,
        id_and: 0x0F,
        id_xor: 0x1234_5670,
        dlc_and: 0,
        dlc_xor: 4,
        data_and: [0xF0, 0, 0, 0, 0, 0, 0, 0],
        data_xor: [0x01, 0, 0xEE, 0, 0, 0, 0, 0xFF],
        modifiers: [
            Modifier::Counter { byte: 1, low_bit: 4, bits: 2 },
            Modifier::Checksum { byte: 3, algorithm: Checksum::Sum },
        ]
        .into_iter()
        .collect(),
        ..Pass::unchanged(true)
    };
    let mut bench = started(&queue, &[rule(0, 0, Some(pass))]);
    for expected in [
        "1234567A#A100EE8F",
        "1234567A#A110EE9F",
        "1234567A#A120EEAF",
        "1234567A#A130EEBF",
        "1234567A#A100EE8F",
    ] {
        bench.receive(CAN1, frame("12A#AFFF"));
        assert_eq!(bench.send_one(CAN2), Some(frame(expected)));
    }
}

#[test]
fn what_cannot_be_is_refused_with_its_reason() {
    let queue = Queue::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    let mut refused = |slot, rule| bench.ask(Command::SetGatewayRule { from: CAN2, slot, rule: Some(rule) });
    let to_standard = GatewayRule {
        filter: Filter { extended: true, kind: FrameKind::Any, id: 0x1000_0000, mask: 0x1FFF_0000 },
        pass: Some(Pass { id_and: 0x7FF, ..Pass::unchanged(false) }),
    };
    assert_eq!(refused(0, to_standard.clone()), Ok(Reply::Done));
    let mut wide = to_standard;
    wide.pass.as_mut().unwrap().id_and = 0xFFF;
    let outside = Pass {
        modifiers: [Modifier::Counter { byte: 8, low_bit: 0, bits: 1 }].into_iter().collect(),
        ..Pass::unchanged(false)
    };
    for (slot, rule, refusal) in [
        (1, wide, Refusal::BadId),
        (1, rule(0x800, 0x7FF, None), Refusal::BadId),
        (1, rule(0, 0, Some(outside)), Refusal::BadEntry),
        (1, rule(0, 0, Some(Pass { dlc_xor: 16, ..Pass::unchanged(false) })), Refusal::BadEntry),
        (2, everything(), Refusal::BadSlot),
    ] {
        assert_eq!(refused(slot, rule), Err(refusal));
    }
    for slot in 1..32 {
        assert_eq!(refused(slot, everything()), Ok(Reply::Done));
    }
    assert_eq!(refused(32, everything()), Err(Refusal::BadSlot));
    assert_eq!(
        bench.ask(Command::GatewayRule { from: CAN2, slot: 31 }),
        Ok(Reply::GatewayRule(everything()))
    );
    assert_eq!(bench.ask(Command::GatewayRule { from: CAN1, slot: 0 }), Err(Refusal::BadSlot));
    assert_eq!(bench.ask(Command::StartGateway), Err(Refusal::NotNormal));
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    assert_eq!(bench.ask(Command::StartGateway), Err(Refusal::ChannelClosed));
    assert_eq!(bench.ask(Command::StopGateway), Ok(Reply::Done));
    let mut bench = started(queue_of(), &[everything()]);
    let rule = None;
    assert_eq!(
        bench.ask(Command::SetGatewayRule { from: CAN1, slot: 0, rule }),
        Err(Refusal::GatewayRunning)
    );
    assert_eq!(bench.ask(Command::StartGateway), Err(Refusal::GatewayRunning));
}

pub fn queue_of() -> &'static Queue {
    Box::leak(Box::new(Queue::new()))
}

/// More than the other bus takes costs counted frames, and each is somewhere: sent, lost, or waiting.
#[test]
fn what_the_other_bus_does_not_take_is_counted_and_told() {
    let queue = queue_of();
    let mut bench = started(queue, &[everything()]);
    let places = READY as u32 + 2;
    for number in 0..places + 10 {
        bench.pass(100 * TICKS_PER_US);
        bench.receive(CAN1, numbered(number));
    }
    flush(&mut bench);
    let found = status(&mut bench, CAN1);
    assert_eq!(found.counts[0], RuleCounts { matched: places + 10, lost: 10, ..RuleCounts::default() });
    assert_eq!(found.waiting, READY as u16);
    for number in 0..places {
        assert_eq!(bench.send_one(CAN2), Some(numbered(number)));
    }
    assert_eq!(bench.send_one(CAN2), None);
    flush(&mut bench);
    let events = bench.events();
    let count = events.iter().map(|event| match event {
        Event::Lost { channel: CAN2, stage: LossStage::Gateway, count, at_least: false } => *count,
        _ => 0,
    });
    assert_eq!(count.sum::<u32>(), 10);
    let counts = status(&mut bench, CAN1).counts[0];
    assert_eq!((counts.sent, counts.lost), (places, 10));
}

#[test]
fn within_a_period_the_newest_frame_waits_for_its_end() {
    let queue = queue_of();
    let pass = Pass { period_ticks: 1000 * TICKS_PER_US, ..Pass::unchanged(false) };
    let mut bench = started(queue, &[rule(0, 0, Some(pass))]);
    bench.receive(CAN1, numbered(1));
    assert_eq!(bench.send_one(CAN2), Some(numbered(1)));
    for number in 2..5 {
        bench.pass(200 * TICKS_PER_US);
        bench.receive(CAN1, numbered(number));
        assert_eq!(bench.send_one(CAN2), None);
    }
    bench.pass(400 * TICKS_PER_US);
    bench.alarm();
    assert_eq!(bench.send_one(CAN2), Some(numbered(4)));
    let counts = status(&mut bench, CAN1).counts[0];
    assert_eq!(counts, RuleCounts { matched: 4, sent: 2, overtaken: 2, ..RuleCounts::default() });
}

#[test]
fn a_delayed_frame_leaves_at_its_time_and_another_does_not_wait_for_it() {
    let queue = queue_of();
    let late = Pass { delay_ticks: 500 * TICKS_PER_US, ..Pass::unchanged(false) };
    let mut bench = started(queue, &[rule(1, 0x7FF, Some(late)), everything()]);
    bench.receive(CAN1, frame("001#01"));
    bench.receive(CAN1, frame("002#02"));
    assert_eq!(bench.send_one(CAN2), Some(frame("002#02")));
    bench.pass(480 * TICKS_PER_US);
    bench.alarm();
    assert_eq!(bench.send_one(CAN2), None);
    bench.pass(20 * TICKS_PER_US);
    bench.alarm();
    assert_eq!(bench.send_one(CAN2), Some(frame("001#01")));
}

/// The host's own frames: one with a time goes before the gateway's, one without after them.
#[test]
fn a_timed_frame_keeps_its_place_beside_a_full_gateway() {
    let queue = queue_of();
    let mut bench = started(queue, &[everything()]);
    for number in 0..10 {
        bench.receive(CAN1, numbered(number));
    }
    let at = u64::from(bench.board.clock.now.get()) + u64::from(200 * TICKS_PER_US);
    let timed = TxFrame { tag: 1, frame: frame("700#"), at_ticks: Some(at) };
    let untimed = TxFrame { tag: 2, frame: frame("701#"), at_ticks: None };
    let frames = [timed, untimed].into_iter().collect();
    bench.ask(Command::Send { channel: CAN2, frames }).unwrap();
    bench.pass(200 * TICKS_PER_US);
    bench.alarm();
    let mut sent = Vec::new();
    while let Some(frame) = bench.send_one(CAN2) {
        sent.push(frame);
    }
    // Two were in mailboxes already.
    assert_eq!(sent[2], timed.frame);
    assert_eq!((sent.len(), sent[11]), (12, untimed.frame));
}

#[test]
fn one_bus_on_both_channels_is_noticed_and_ends_the_gateway() {
    let queue = queue_of();
    let mut bench = started(queue, &[everything()]);
    bench.receive(CAN1, numbered(1));
    let mut rounds = 0;
    loop {
        bench.pass(130 * TICKS_PER_US);
        bench.alarm();
        // What CAN2 sends, CAN1 receives at the same moment.
        let Some(sent) = bench.board.traffic[1].send_one() else { break };
        bench.receive(CAN1, sent);
        bench.send_one(CAN2);
        rounds += 1;
        assert!(rounds < 50, "the loop goes on");
    }
    assert_eq!(status(&mut bench, CAN1).state, GatewayState::Ended(GatewayEnd::Loop));
}

/// The same frame on both buses at a constant distance is none.
#[test]
fn the_same_traffic_on_two_buses_is_no_loop() {
    let queue = queue_of();
    let mut bench = started(queue, &[everything()]);
    for _ in 0..200 {
        bench.pass(60 * TICKS_PER_US);
        bench.receive(CAN1, numbered(1));
        bench.pass(60 * TICKS_PER_US);
        assert_eq!(bench.send_one(CAN2), Some(numbered(1)));
    }
    assert_eq!(status(&mut bench, CAN1).state, GatewayState::Running);
}

#[test]
fn closing_a_channel_ends_the_gateway_and_counts_what_waited() {
    let queue = queue_of();
    let mut bench = started(queue, &[everything()]);
    for number in 0..5 {
        bench.receive(CAN1, numbered(number));
    }
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    flush(&mut bench);
    let found = status(&mut bench, CAN1);
    assert_eq!(found.state, GatewayState::Ended(GatewayEnd::ChannelClosed));
    assert_eq!((found.counts[0].lost, found.waiting), (3, 0));
    let lost = Event::Lost { channel: CAN2, stage: LossStage::Gateway, count: 3, at_least: false };
    assert!(bench.events().contains(&lost), "{:?}", bench.events());
    bench.receive(CAN1, numbered(9));
    assert_eq!(bench.send_one(CAN2), Some(numbered(0)));
}

/// A host that reads nothing must not hold up the buses, and the confirmations that have no room are counted.
#[test]
fn a_full_queue_does_not_hold_up_the_gateway_and_every_frame_is_counted() {
    let queue = queue_of();
    let mut bench = started(queue, &[everything()]);
    bench.port.takes = 0;
    let frames = 3000;
    for number in 0..frames {
        bench.pass(100 * TICKS_PER_US);
        bench.receive(CAN1, numbered(number));
        bench.pass(100 * TICKS_PER_US);
        assert_eq!(bench.send_one(CAN2), Some(numbered(number)), "{number}");
    }
    bench.port.takes = usize::MAX;
    for _ in 0..50 {
        bench.millisecond();
    }
    let of = |channel: Channel| {
        bench.records.iter().map(move |(_, record)| match record {
            Record::Received(received) => u32::from(received.channel == channel),
            Record::Event(Event::Transmitted { channel: at, .. }) => u32::from(*at == channel),
            Record::Event(Event::Lost { channel: at, stage: LossStage::Queue, count, .. })
                if *at == channel =>
            {
                *count
            }
            _ => 0,
        })
    };
    assert_eq!((of(CAN1).sum::<u32>(), of(CAN2).sum::<u32>()), (frames, frames));
    assert_eq!(status(&mut bench, CAN1).counts[0].sent, frames);
}

#[test]
fn a_session_begins_without_a_gateway_and_its_channels_must_be_opened_again() {
    let queue = queue_of();
    let mut bench = started(queue, &[everything()]);
    bench.greet();
    let found = status(&mut bench, CAN1);
    assert_eq!((found.state, found.rules), (GatewayState::Off, 0));
    assert_eq!(bench.ask(Command::StartGateway), Err(Refusal::ChannelClosed));
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::Normal)) }).unwrap();
    bench.receive(CAN1, numbered(1));
    assert_eq!(bench.send_one(CAN2), None);
}

/// A device that was saved as a gateway, with power just applied, and no host.
pub fn alone(queue: &'static Queue) -> Bench<'static, SMALL_QUEUE> {
    let mut before = Bench::new(queue_of());
    before.greet();
    for channel in Channel::ALL {
        before.ask(Command::Configure { channel, config: config(Mode::Normal) }).unwrap();
    }
    set(&mut before, CAN1, &[rule(0x100, 0x7FF, None), everything()]);
    assert_eq!(before.ask(Command::SaveGateway), Ok(Reply::Done));
    let mut bench = Bench::new(queue);
    bench.port.open = false;
    bench.board.chip.saved.clone_from(&before.board.chip.saved);
    for _ in 0..5 {
        bench.millisecond();
    }
    bench
}

#[test]
fn a_saved_gateway_runs_without_a_host_for_as_long_as_it_takes() {
    let mut bench = alone(queue_of());
    assert!(bench.board.control.iter().all(|control| control.running));
    // Far more records than the queue holds.
    for number in 0..5000 {
        bench.receive(CAN1, numbered(number));
        bench.pass(100 * TICKS_PER_US);
        let passes = number & 0x7FF != 0x100;
        assert_eq!(bench.send_one(CAN2), passes.then(|| numbered(number)), "{number}");
        if number % 5 == 0 {
            bench.millisecond();
        }
    }
    assert!(bench.board.capture.take_activity().standalone);
}

#[test]
fn a_host_finds_a_saved_gateway_at_work_and_leaves_it_so() {
    let mut bench = alone(queue_of());
    bench.receive(CAN1, numbered(7));
    for round in 0..3 {
        bench.port.open = true;
        bench.greet();
        let found = status(&mut bench, CAN1);
        assert!(found.standalone && found.state == GatewayState::Running && found.rules == 2);
        let Ok(Reply::Status(device)) = bench.ask(Command::Status) else { panic!() };
        assert!(device.channels.iter().all(|channel| channel.open == Some(config(Mode::Normal))));
        bench.records.clear();
        bench.pass(500 * TICKS_PER_US);
        bench.receive(CAN1, numbered(8));
        let at = u64::from(bench.board.clock.now.get());
        flush(&mut bench);
        assert_eq!(bench.frames(CAN1), [numbered(8)], "{round}");
        assert_eq!(bench.records[0].0, at);
        bench.pass(500 * TICKS_PER_US);
        while bench.send_one(CAN2).is_some() {}
        bench.port.open = false;
        flush(&mut bench);
        bench.receive(CAN1, numbered(9));
        bench.pass(100 * TICKS_PER_US);
        assert_eq!(bench.send_one(CAN2), Some(numbered(9)), "{round}");
        assert!(bench.board.control.iter().all(|control| control.running));
        assert_eq!(bench.complaints, Vec::<String>::new());
    }
    // A sleeping computer neither.
    bench.port.open = true;
    bench.greet();
    bench.sleep(true);
    flush(&mut bench);
    bench.receive(CAN1, numbered(10));
    bench.pass(100 * TICKS_PER_US);
    assert_eq!(bench.send_one(CAN2), Some(numbered(10)));
}

#[test]
fn a_saved_gateway_that_a_host_has_stopped_is_silent_when_the_port_closes() {
    let mut bench = alone(queue_of());
    bench.port.open = true;
    bench.greet();
    assert_eq!(bench.ask(Command::StopGateway), Ok(Reply::Done));
    bench.port.open = false;
    flush(&mut bench);
    assert!(bench.board.control.iter().all(|control| !control.running));
}

#[test]
fn what_cannot_be_saved_as_a_gateway_is_refused_and_nothing_else_starts_one() {
    let mut bench = Bench::new(queue_of());
    bench.greet();
    assert_eq!(bench.ask(Command::SaveGateway), Err(Refusal::NotNormal));
    for (channel, mode) in [(CAN1, Mode::Normal), (CAN2, Mode::ListenOnly)] {
        bench.ask(Command::Configure { channel, config: config(mode) }).unwrap();
    }
    assert_eq!(bench.ask(Command::SaveGateway), Err(Refusal::NotNormal));
    bench.ask(Command::Configure { channel: CAN2, config: config(Mode::Normal) }).unwrap();
    bench.ask(Command::Open { channel: CAN1, config: Some(config(Mode::Normal)) }).unwrap();
    assert_eq!(bench.ask(Command::SaveGateway), Err(Refusal::ChannelOpen));
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    bench.ask(Command::SaveDefaults).unwrap();
    let mut next = Bench::new(queue_of());
    next.board.chip.saved = bench.board.chip.saved.clone();
    for _ in 0..5 {
        next.millisecond();
    }
    assert!(next.board.control.iter().all(|control| !control.running));
}

/// The most that can be stored.
#[test]
fn all_rules_of_both_directions_can_be_saved() {
    let mut before = Bench::new(queue_of());
    before.greet();
    for channel in Channel::ALL {
        before.ask(Command::Configure { channel, config: config(Mode::Normal) }).unwrap();
        let filter = Filter { extended: true, kind: FrameKind::Any, id: 0x1FFF_FFFF, mask: 0x1FFF_FFFF };
        let pass = Pass {
            id_xor: 0x1000_0000,
            period_ticks: u32::MAX,
            delay_ticks: u32::MAX,
            modifiers: [Modifier::Counter { byte: 0, low_bit: 0, bits: 8 }; 2].into_iter().collect(),
            ..Pass::unchanged(true)
        };
        set(&mut before, channel, &vec![GatewayRule { filter, pass: Some(pass) }; 32]);
    }
    assert_eq!(before.ask(Command::SaveGateway), Ok(Reply::Done));
    let mut bench = Bench::new(queue_of());
    bench.board.chip.saved.clone_from(&before.board.chip.saved);
    for _ in 0..5 {
        bench.millisecond();
    }
    bench.greet();
    for from in Channel::ALL {
        assert_eq!(status(&mut bench, from).rules, 32);
        assert_eq!(
            bench.ask(Command::GatewayRule { from, slot: 31 }),
            before.ask(Command::GatewayRule { from, slot: 31 })
        );
    }
}
