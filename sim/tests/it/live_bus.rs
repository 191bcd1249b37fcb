//! The firmware as a node that takes part: transmission, confirmation, fault confinement, and a bus that
//! does not cooperate.

use crate::common;

use cantap_emu::bus::{BitTime, Disturbance, Node};
use cantap_emu::machine::Setup;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::CLOCK;
use cantap_sim::rig::{MS, Rig, timing};
use cantap_sim::{CYCLES_PER_SECOND, CYCLES_PER_US};
use cantap_wire::message::{ChannelConfig, Mode, TxFrame};
use cantap_wire::record::{ErrorState, TransmitFailure};
use cantap_wire::{Channel, Command, Event, Frame, Refusal, Reply};

const MEGABIT: u32 = 1_000_000;
use Channel::{Can1, Can2};

fn connected(setup: Setup) -> Rig {
    let mut rig = Rig::new(common::firmware(), setup, Timing::new(CLOCK));
    rig.connect().unwrap();
    rig
}

fn normal() -> ChannelConfig {
    ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(MEGABIT).unwrap()) }
}

fn frame(text: &str) -> Frame {
    text.parse().unwrap()
}

fn send(rig: &mut Rig, channel: Channel, first_tag: u32, frames: &[&str]) {
    let frames =
        frames.iter().zip(first_tag..).map(|(text, tag)| TxFrame { frame: frame(text), tag, at_ticks: None });
    let reply = rig.ask(Command::Send { channel, frames: frames.collect() }).unwrap();
    assert!(matches!(reply, Reply::Queued { .. }), "{reply:?}");
}

fn states(rig: &Rig, of: Channel) -> Vec<ErrorState> {
    let state = |event: &Event| match event {
        Event::State { channel, state, .. } if *channel == of => Some(*state),
        _ => None,
    };
    rig.events().iter().filter_map(|(_, event)| state(event)).collect()
}

fn failures(rig: &Rig) -> Vec<(u32, TransmitFailure)> {
    let failure = |event: &Event| match event {
        Event::TransmitFailed { tag, reason, .. } => Some((*tag, *reason)),
        _ => None,
    };
    rig.events().iter().filter_map(|(_, event)| failure(event)).collect()
}

fn confirmed(rig: &Rig) -> Vec<u32> {
    let tag = |event: &Event| match event {
        Event::Transmitted { tag, .. } => Some(*tag),
        _ => None,
    };
    rig.events().iter().filter_map(|(_, event)| tag(event)).collect()
}

fn settle(rig: &mut Rig) {
    for channel in Channel::ALL {
        rig.close(channel).unwrap();
    }
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.machine.board().odd_accesses(), []);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn one_channel_sends_to_the_other_in_order_and_each_frame_is_confirmed() {
    let mut rig = connected(Setup { joined: true, ..common::setup() });
    for channel in Channel::ALL {
        rig.open(channel, normal()).unwrap();
    }
    // Equal, rising and falling identifiers: the order is still the queue's.
    let texts = [
        "100#01",
        "100#02",
        "0FF#03",
        "123#R4",
        "12345678#0506070809",
        "100#",
        "7FF#",
        "000#FFFFFFFFFFFFFFFF",
    ];
    send(&mut rig, Can1, 40, &texts);
    rig.run_for(20 * MS).unwrap();
    assert_eq!(confirmed(&rig), (40..48).collect::<Vec<u32>>());
    assert_eq!(rig.ledger.delivered_count(Can2), 8);
    assert!(
        rig.dominant_bits(Can1) > rig.dominant_bits(Can2) && rig.dominant_bits(Can2) == 8,
        "8 acknowledgements"
    );
    settle(&mut rig);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn sending_while_the_other_channel_is_full_costs_no_frame() {
    let mut rig = connected(common::setup());
    rig.listen(Can1, MEGABIT).unwrap();
    rig.open(Can2, normal()).unwrap();
    let from = rig.now();
    rig.add_traffic(Can1, MEGABIT, Traffic::new(Kind::Std0, 1, 100.0, from, from + 80 * MS));
    rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Mix, 2, 50.0, from, from + 80 * MS));
    for round in 0..10 {
        send(&mut rig, Can2, 10 * round, &["001#11", "002#22", "7F0#33", "1FFFFFFF#44"]);
        rig.run_for(4 * MS).unwrap();
    }
    rig.run_for(50 * MS).unwrap();
    let expected: Vec<u32> = (0..10).flat_map(|round| 10 * round..10 * round + 4).collect();
    assert_eq!(confirmed(&rig), expected);
    settle(&mut rig);
    assert_eq!((rig.ledger.losses(Can1).total(), rig.ledger.losses(Can2).total()), (0, 0));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_timed_frame_starts_at_its_tick() {
    let mut rig = connected(common::setup());
    rig.open(Can1, normal()).unwrap();
    rig.machine.board().wires[0].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
    let Reply::Time(ticks) = rig.ask(Command::Time).unwrap() else { panic!("a time") };
    let at = ticks + 12 * 20_000;
    let timed = TxFrame { frame: frame("123#AB"), tag: 7, at_ticks: Some(at) };
    rig.ask(Command::Send { channel: Can1, frames: [timed].into_iter().collect() }).unwrap();
    rig.run_for(50 * MS).unwrap();
    assert_eq!(confirmed(&rig), [7]);
    let end = rig.events().iter().find(|(_, event)| matches!(event, Event::Transmitted { .. })).unwrap().0;
    // 58 bits without intermission, minus a little; what remains is the interrupt's latency.
    let bits = u64::from(cantap_emu::bus::bits::bus_bits(&frame("123#AB"))) - 3;
    let late = end as f64 / 12.0 - at as f64 / 12.0 - bits as f64;
    assert!((0.0..6.0).contains(&late), "{late} us");
    settle(&mut rig);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn one_shot_frames_report_what_stopped_them() {
    let mut rig = connected(common::setup());
    rig.open(Can1, ChannelConfig { one_shot: true, ..normal() }).unwrap();
    rig.machine.board().wires[0].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
    rig.machine.board().wires[0].disturb(0, Disturbance::Bit { index: 25 });
    send(&mut rig, Can1, 1, &["123#"]);
    rig.run_for(5 * MS).unwrap();
    assert_eq!(failures(&rig), [(1, TransmitFailure::BusError)]);
    // Against a bus full of lower identifiers.
    let from = rig.now();
    let frames = (0..200).map(|n| (from + n, frame("001#"))).collect();
    rig.add_traffic(Can1, MEGABIT, cantap_emu::traffic::Script::new(frames));
    rig.run_for(MS).unwrap();
    send(&mut rig, Can1, 2, &["700#"]);
    rig.run_for(20 * MS).unwrap();
    assert_eq!(failures(&rig), [(1, TransmitFailure::BusError), (2, TransmitFailure::ArbitrationLost)]);
    settle(&mut rig);
}

/// Thirty-two failures in a row put the controller off the bus.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn bus_off_is_reported_and_left_as_configured() {
    for manual_recovery in [false, true] {
        let mut rig = connected(common::setup());
        rig.open(Can1, ChannelConfig { manual_recovery, ..normal() }).unwrap();
        rig.machine.board().wires[0].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
        for n in 0..32 {
            rig.machine.board().wires[0].disturb(n, Disturbance::Bit { index: 25 });
        }
        send(&mut rig, Can1, 1, &["123#"]);
        rig.run_for(50 * MS).unwrap();
        let seen = states(&rig, Can1);
        assert!(seen.contains(&ErrorState::BusOff), "{seen:?}");
        if manual_recovery {
            assert_eq!(seen.last(), Some(&ErrorState::BusOff));
            rig.ask(Command::Recover { channel: Can1 }).unwrap();
            rig.run_for(20 * MS).unwrap();
        }
        assert_eq!(states(&rig, Can1).last(), Some(&ErrorState::Active), "{manual_recovery}");
        send(&mut rig, Can1, 2, &["124#"]);
        rig.run_for(10 * MS).unwrap();
        assert!(confirmed(&rig).contains(&2), "{manual_recovery}: {:?}", rig.events());
        settle(&mut rig);
    }
}

/// Nobody acknowledges: error-passive, never bus-off, and the device still answers. As soon as somebody does, the
/// frame is sent.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_lone_node_floods_nobody() {
    let mut rig = connected(common::setup());
    rig.open(Can1, normal()).unwrap();
    let bytes = rig.session.bytes();
    send(&mut rig, Can1, 1, &["123#55"]);
    rig.run_for(300 * MS).unwrap();
    assert_eq!(states(&rig, Can1).last(), Some(&ErrorState::Passive));
    let per_second = (rig.session.bytes() - bytes) * 10 / 3;
    assert!(per_second < 50_000, "{per_second} bytes/s of error reports");
    assert!(rig.status().is_ok());
    rig.machine.board().wires[0].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
    rig.run_for(10 * MS).unwrap();
    assert_eq!(confirmed(&rig), [1]);
    settle(&mut rig);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_stuck_bus_hangs_nothing() {
    let mut rig = connected(common::setup());
    rig.machine.board().hold_buses_dominant(true);
    for channel in Channel::ALL {
        let response = rig.request(Command::Open { channel, config: Some(normal()) }).unwrap();
        assert!(matches!(response.result, Ok(_) | Err(Refusal::Hardware)), "{response:?}");
    }
    rig.run_for(100 * MS).unwrap();
    assert!(rig.status().is_ok());
    rig.machine.board().hold_buses_dominant(false);
    rig.run_for(10 * MS).unwrap();
    for channel in Channel::ALL {
        rig.request(Command::Close { channel }).unwrap();
        rig.open(channel, normal()).unwrap();
    }
    rig.machine.board().wires[0].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
    send(&mut rig, Can1, 3, &["123#55"]);
    rig.run_for(10 * MS).unwrap();
    assert_eq!(confirmed(&rig), [3]);
    // Stuck again, in the middle of everything.
    let from = rig.now();
    rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Mix, 9, 80.0, from, from + 40 * MS));
    rig.run_for(10 * MS).unwrap();
    rig.machine.board().hold_buses_dominant(true);
    rig.run_for(50 * MS).unwrap();
    assert!(rig.status().is_ok());
    rig.machine.board().hold_buses_dominant(false);
    rig.run_for(60 * MS).unwrap();
    settle(&mut rig);
}

/// Erasing a flash sector stops the core for a second, which must trigger neither the watchdog nor the host's timeout.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn defaults_are_saved_and_used_after_a_reset() {
    let mut rig = connected(common::setup());
    rig.open(Can1, normal()).unwrap();
    rig.close(Can1).unwrap();
    let began = rig.now();
    let (mut rig, response) = {
        let (id, bytes) = rig.session.request(Command::SaveDefaults);
        rig.with_host(|host, _| host.send(&bytes));
        let mut response = None;
        rig.run_while(4 * CYCLES_PER_SECOND, |rig| {
            response = rig.session.response(id);
            response.is_none()
        })
        .unwrap();
        (rig, response)
    };
    let took = (rig.now() - began) / (1000 * CYCLES_PER_US);
    assert!(response.is_some_and(|response| response.result.is_ok()), "no answer after {took} ms");
    let resets = rig.machine.resets();
    let _ = rig.request(Command::Reset);
    rig.run_for(100 * MS).unwrap();
    assert_eq!(rig.machine.resets(), resets + 1);
    rig.cut();
    rig.wait_for_port().unwrap();
    rig.greet().unwrap();
    let Reply::Opened(config) = rig.ask(Command::Open { channel: Can1, config: None }).unwrap() else {
        panic!("opened with the saved configuration")
    };
    assert_eq!(config, normal());
    assert_eq!(rig.machine.board().odd_accesses(), []);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_order_on_the_bus_is_the_order_of_confirmation() {
    let mut rig = connected(Setup { joined: true, ..common::setup() });
    for channel in Channel::ALL {
        rig.open(channel, normal()).unwrap();
    }
    // Both channels send at the same time, and the other's lower identifiers win in between.
    send(&mut rig, Can1, 0, &["300#", "301#", "302#", "303#"]);
    send(&mut rig, Can2, 100, &["200#", "201#", "402#", "203#"]);
    rig.run_for(20 * MS).unwrap();
    let tags = confirmed(&rig);
    let of = |channel: std::ops::Range<u32>| {
        tags.iter().copied().filter(move |tag| channel.contains(tag)).collect::<Vec<_>>()
    };
    assert_eq!(of(0..100), [0, 1, 2, 3]);
    assert_eq!(of(100..200), [100, 101, 102, 103]);
    assert_eq!(rig.ledger.delivered_count(Can1), 4);
    assert_eq!(rig.ledger.delivered_count(Can2), 4);
    settle(&mut rig);
}

/// RM0090 Rev 21 §32.4.1 and §32.7.6: initialisation mode changes no counter; the controller's reset and the end of bus-off do. The
/// virtual device does the same (`host/virtual/tests/it/virtual_device.rs`).
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn error_counters_outlive_closing_and_opening() {
    let mut rig = connected(common::setup());
    rig.ask(Command::Open { channel: Can1, config: Some(normal()) }).unwrap();
    // Nobody else is there to acknowledge.
    send(&mut rig, Can1, 1, &["100#01"]);
    rig.run_for(20 * MS).unwrap();
    assert_eq!(rig.status().unwrap().channels[0].tec, 128);
    rig.ask(Command::Abort { channel: Can1 }).unwrap();
    rig.ask(Command::Close { channel: Can1 }).unwrap();
    rig.run_for(2 * MS).unwrap();
    let listening = ChannelConfig { mode: Mode::ListenOnly, ..normal() };
    rig.ask(Command::Open { channel: Can1, config: Some(listening) }).unwrap();
    rig.run_for(2 * MS).unwrap();
    let state = rig.status().unwrap().channels[0];
    assert_eq!((state.tec, state.state), (128, ErrorState::Passive));
}
