//! What a gateway must never do to a bus: send what nobody asks for any more, or end when it need not.

use crate::fakes;
use crate::gateway;

use cantap_firmware::TICKS_PER_US;
use cantap_firmware::bus::gateway::READY;
use cantap_wire::message::{GATEWAY_TAG, GatewayEnd, GatewayState, Mode, Periodic, Trigger, TxFrame};
use cantap_wire::record::{ErrorState, LossStage, TransmitFailure};
use cantap_wire::{Channel, Command, Event, Frame, Reply};
use fakes::{Bench, SMALL_QUEUE, numbered};
use gateway::{CAN1, CAN2, alone, everything, flush, frame, queue_of, started, status};

fn running(bench: &Bench<'_, SMALL_QUEUE>) -> [bool; 2] {
    bench.board.control.each_ref().map(|control| control.running)
}

/// Whatever a host has asked a saved gateway's channels for ends with that host.
#[test]
fn a_host_that_vanishes_beside_a_saved_gateway_leaves_nothing_that_sends() {
    let mut bench = alone(queue_of());
    bench.port.open = true;
    bench.greet();
    let periodic = Periodic {
        frame: frame("701#"),
        period_ticks: 500 * TICKS_PER_US,
        count: 0,
        modifiers: [].into_iter().collect(),
    };
    let trigger = Trigger { filter: everything().filter, reply: frame("702#"), count: 0 };
    let soon = u64::from(bench.board.clock.now.get()) + u64::from(5000 * TICKS_PER_US);
    let timed = TxFrame { tag: 1, frame: frame("703#"), at_ticks: Some(soon) };
    for channel in Channel::ALL {
        bench.ask(Command::SetTrigger { channel, slot: 0, entry: Some(trigger) }).unwrap();
        bench.ask(Command::Send { channel, frames: [timed].into_iter().collect() }).unwrap();
        bench.ask(Command::SetPeriodic { channel, slot: 0, entry: Some(periodic.clone()) }).unwrap();
    }
    // Nobody acknowledges at the moment.
    assert!(bench.board.traffic.iter().all(|traffic| traffic.mailboxes.contains(&Some(frame("701#")))));
    bench.port.open = false;
    flush(&mut bench);
    for number in 1..50 {
        bench.receive(CAN1, numbered(number));
        bench.pass(200 * TICKS_PER_US);
        bench.alarm();
        assert_eq!(bench.send_one(CAN2), Some(numbered(number)));
        assert_eq!((bench.send_one(CAN2), bench.send_one(CAN1)), (None, None), "{number}");
        bench.millisecond();
    }
    bench.port.open = true;
    bench.greet();
    let counts = status(&mut bench, CAN1).counts[1];
    assert_eq!((counts.matched, counts.sent), (49, 49));
}

/// Many slcan programs begin with `C`.
#[test]
fn an_slcan_program_does_not_end_a_saved_gateway() {
    let mut bench = alone(queue_of());
    bench.port.open = true;
    bench.say(b"\rC\rS6\rO\r");
    flush(&mut bench);
    assert_eq!(running(&bench), [true; 2]);
    bench.receive(CAN1, numbered(1));
    bench.pass(130 * TICKS_PER_US);
    assert_eq!(bench.send_one(CAN2), Some(numbered(1)));
    assert!(bench.port.from_device.ends_with(b"\r\x07\x07\x07"), "{:?}", bench.port.from_device);
}

/// A controller that is broken must not make the whole device deaf.
#[test]
fn a_saved_gateway_whose_channel_cannot_be_opened_leaves_the_device_to_its_host() {
    let before = alone(queue_of());
    let mut bench = Bench::new(queue_of());
    bench.board.chip.saved.clone_from(&before.board.chip.saved);
    bench.board.control[1].running = true;
    bench.board.control[1].stuck = true;
    bench.board.control[1].halts_needed = usize::MAX;
    for _ in 0..1000 {
        bench.millisecond();
    }
    assert!(!bench.board.control[0].running);
    bench.say(&[0]);
    let _ = bench.ask(Command::Hello { protocol: cantap_wire::PROTOCOL_VERSION });
}

/// One frame again and again, as a generator sends it: on the other bus each ends just when the next ends here.
#[test]
fn equal_frames_back_to_back_are_no_loop() {
    const FRAME_US: u32 = 100;
    for late_us in 0..8 {
        let mut bench = started(queue_of(), &[everything()]);
        let repeated = numbered(1);
        let (mut ends, mut sent) = (None, 0);
        for us in 1..400 * FRAME_US {
            bench.pass(TICKS_PER_US);
            bench.alarm();
            if us % FRAME_US == 0 {
                bench.receive(CAN1, repeated);
            }
            if ends == Some(us) {
                assert_eq!(bench.send_one(CAN2), Some(repeated));
                (ends, sent) = (None, sent + 1);
            }
            if ends.is_none() && !bench.board.traffic[1].order.is_empty() {
                ends = Some(us + FRAME_US + if us % FRAME_US == 0 { late_us } else { 0 });
            }
        }
        assert_eq!(status(&mut bench, CAN1).state, GatewayState::Running, "{late_us} us");
        assert!(sent > 350, "{sent}");
    }
}

fn advance(bench: &mut Bench<'_, SMALL_QUEUE>, at_us: &mut u32, to_us: u32) {
    while *at_us < to_us {
        bench.pass(TICKS_PER_US);
        *at_us += 1;
        bench.alarm();
    }
}

/// A receiver takes a frame a bit before its sender knows that it was sent (RM0090 Rev 21 §32.7.3): 8 us at 125 kbit/s.
#[test]
fn a_loop_at_a_low_bit_rate_is_noticed() {
    let mut bench = started_at(33_333);
    bench.receive(CAN1, numbered(1));
    for round in 0.. {
        assert!(round < 200, "the loop goes on");
        let mut at_us = 0;
        advance(&mut bench, &mut at_us, 4000);
        let Some(sent) = bench.board.traffic[1].send_one() else { break };
        bench.receive(CAN1, sent);
        advance(&mut bench, &mut at_us, 4030);
        bench.send_one(CAN2);
    }
    assert_eq!(status(&mut bench, CAN1).state, GatewayState::Ended(GatewayEnd::Loop));
}

fn started_at(bitrate_bps: u32) -> Bench<'static, SMALL_QUEUE> {
    let mut bench = Bench::new(queue_of());
    bench.greet();
    let timing = cantap_wire::BitTiming::choose(cantap_firmware::CAN_CLOCK_HZ, bitrate_bps, None).unwrap();
    for channel in Channel::ALL {
        let config = cantap_wire::message::ChannelConfig {
            timing,
            ..fakes::config(cantap_wire::message::Mode::Normal)
        };
        bench.ask(Command::Open { channel, config: Some(config) }).unwrap();
    }
    gateway::set(&mut bench, CAN1, &[everything()]);
    bench.ask(Command::StartGateway).unwrap();
    bench
}

/// Both channels on one bus, until nothing more is sent.
fn round_and_round(bench: &mut Bench<'_, SMALL_QUEUE>) -> u32 {
    bench.receive(CAN1, numbered(1));
    for round in 0..100 {
        let mut at_us = 0;
        advance(bench, &mut at_us, 130);
        let Some(sent) = bench.board.traffic[1].send_one() else { return round };
        bench.receive(CAN1, sent);
        bench.send_one(CAN2);
    }
    panic!("the loop goes on");
}

fn passing_both_ways() -> Bench<'static, SMALL_QUEUE> {
    let mut bench = Bench::opened(queue_of(), Mode::Normal);
    for from in Channel::ALL {
        gateway::set(&mut bench, from, &[everything()]);
    }
    bench.ask(Command::StartGateway).unwrap();
    bench
}

/// A node's frame on both channels, and what each then has to send on the other's behalf.
fn received_by_both(bench: &mut Bench<'_, SMALL_QUEUE>, at_us: &mut u32, frame: Frame) {
    for channel in Channel::ALL {
        bench.receive(channel, frame);
    }
    let to_us = *at_us + 10;
    advance(bench, at_us, to_us);
}

/// With long bits, both channels of one bus begin in the same bit: they send as one, and neither receives what the other sends.
#[test]
fn one_bus_is_noticed_where_both_channels_send_as_one() {
    let mut bench = passing_both_ways();
    let (mut at_us, mut doubled) = (0, 0);
    for number in 0..200 {
        received_by_both(&mut bench, &mut at_us, numbered(number));
        // Which of them has begun by now sends the frame.
        while let [first, second] = [0, 1].map(|index| !bench.board.traffic[index].order.is_empty())
            && (first || second)
        {
            let to_us = at_us + 100;
            advance(&mut bench, &mut at_us, to_us);
            if first && second {
                let frames = Channel::ALL.map(|channel| bench.send_one(channel));
                assert_eq!(frames[0], frames[1]);
                doubled += 1;
            } else {
                let (from, to) = if first { (CAN1, CAN2) } else { (CAN2, CAN1) };
                let sent = bench.board.traffic[from.index()].send_one().unwrap();
                bench.receive(to, sent);
                bench.transmit_interrupt(from);
            }
            let to_us = at_us + 10;
            advance(&mut bench, &mut at_us, to_us);
        }
    }
    assert_eq!(status(&mut bench, CAN1).state, GatewayState::Ended(GatewayEnd::Loop));
    assert!(doubled < 64, "{doubled}");
}

/// Two buses that carry the same at the same time, for redundancy.
#[test]
fn two_buses_with_the_same_traffic_are_no_loop() {
    let mut bench = passing_both_ways();
    let mut at_us = 0;
    for number in 0..500 {
        received_by_both(&mut bench, &mut at_us, numbered(number));
        // The one that pauses begins later.
        for _ in 0..2 {
            let begun = Channel::ALL.map(|channel| !bench.board.traffic[channel.index()].order.is_empty());
            let to_us = at_us + 100;
            advance(&mut bench, &mut at_us, to_us);
            for (channel, _) in Channel::ALL.into_iter().zip(begun).filter(|&(_, begun)| begun) {
                bench.send_one(channel);
            }
        }
    }
    assert_eq!(status(&mut bench, CAN1).state, GatewayState::Running);
    assert_eq!(status(&mut bench, CAN1).counts[0].sent, 500);
}

#[test]
fn a_loop_is_an_event_in_the_stream_and_each_frame_is_counted_once() {
    let mut bench = started(queue_of(), &[everything()]);
    bench.port.takes = 0;
    round_and_round(&mut bench);
    bench.port.takes = usize::MAX;
    flush(&mut bench);
    let reason = TransmitFailure::Loop;
    let events = bench.events();
    let found = events
        .iter()
        .filter(|event| matches!(event, Event::TransmitFailed { reason: TransmitFailure::Loop, .. }));
    assert_eq!(
        found.copied().collect::<Vec<_>>(),
        [Event::TransmitFailed { channel: CAN2, tag: GATEWAY_TAG, reason }]
    );
    let found = status(&mut bench, CAN1);
    let counts = found.counts[0];
    assert_eq!(counts.matched, counts.sent + counts.lost + counts.failed, "{counts:?}");
    assert_eq!((counts.lost, counts.failed), (1, 0));
    let Ok(Reply::Status(of)) = bench.ask(Command::Status) else { panic!() };
    assert_eq!(of.channels[1].transmit_failures, 1);
}

/// Nobody is there to close its channels, nor to read its records.
#[test]
fn a_saved_gateway_that_finds_a_loop_leaves_both_buses_and_tells_the_next_host() {
    let mut bench = alone(queue_of());
    round_and_round(&mut bench);
    for _ in 0..5 {
        bench.millisecond();
    }
    assert_eq!(running(&bench), [false; 2]);
    for _ in 0..2 {
        bench.port.open = true;
        bench.greet();
        let found = status(&mut bench, CAN1);
        assert_eq!((found.state, found.standalone), (GatewayState::Ended(GatewayEnd::Loop), false));
        bench.port.open = false;
        flush(&mut bench);
    }
}

/// Frames that are minutes old must not be sent all at once when a bus is back.
#[test]
fn what_waits_for_a_bus_that_is_off_is_lost_and_not_sent_later() {
    let mut bench = started(queue_of(), &[everything()]);
    bench.board.traffic[1].state = Some(ErrorState::BusOff);
    bench.millisecond();
    let frames = READY as u32;
    for number in 0..frames {
        bench.receive(CAN1, numbered(number));
    }
    flush(&mut bench);
    bench.board.traffic[1].state = Some(ErrorState::Active);
    flush(&mut bench);
    bench.receive(CAN1, frame("7FF#01"));
    let mut sent: Vec<Frame> = Vec::new();
    while let Some(frame) = bench.send_one(CAN2) {
        sent.push(frame);
    }
    // Those that were in mailboxes are the controller's.
    assert_eq!((sent.len(), sent.last()), (3, Some(&frame("7FF#01"))));
    let counts = status(&mut bench, CAN1).counts[0];
    assert_eq!((counts.matched, counts.sent, counts.lost), (frames + 1, 3, frames - 2));
    flush(&mut bench);
    let lost = bench.events().into_iter().map(|event| match event {
        Event::Lost { channel: CAN2, stage: LossStage::Gateway, count, .. } => count,
        _ => 0,
    });
    assert_eq!(lost.sum::<u32>(), frames - 2);
}

/// Its frames in mailboxes are not those of the next one.
#[test]
fn a_gateway_that_is_started_again_counts_only_its_own_frames() {
    let mut bench = started(queue_of(), &[everything()]);
    bench.receive(CAN1, numbered(1));
    bench.receive(CAN1, numbered(2));
    bench.ask(Command::StopGateway).unwrap();
    bench.ask(Command::StartGateway).unwrap();
    bench.receive(CAN1, numbered(3));
    while bench.send_one(CAN2).is_some() {}
    let counts = status(&mut bench, CAN1).counts[0];
    assert_eq!((counts.matched, counts.sent), (1, 1));
}
