//! What the firmware reports is what was on the bus: stamps, losses, errors, and it leaves no trace on a bus
//! that it only listens to.

use crate::common;

use cantap_emu::bus::{BitTime, Disturbance, Node};
use cantap_emu::machine::Setup;
use cantap_emu::soc::CAN_IRQS;
use cantap_emu::timing::Bound;
use cantap_emu::traffic::{Kind, Script, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::capture::{Session, SessionEvent};
use cantap_sim::rig::{MS, Rig};
use cantap_sim::{CYCLES_PER_SECOND, CYCLES_PER_US};
use cantap_wire::record::BusErrorKind;
use cantap_wire::{Channel, Event, Frame, Record};

const MEGABIT: u32 = 1_000_000;
const BOTH: [Channel; 2] = Channel::ALL;
/// Device ticks in a microsecond.
const TICKS_PER_US: f64 = 12.0;

/// A board that listens on both channels, whose session keeps every byte.
fn listening() -> Rig {
    listening_under(common::bound())
}

/// The same under a bound of time.
fn listening_under(bound: Bound) -> Rig {
    let setup = Setup { bound, ..board::setup() };
    let mut rig = Rig::new(common::firmware(), setup, Timing::new(CLOCK));
    rig.connect().unwrap();
    rig.record_bytes();
    for channel in BOTH {
        rig.listen(channel, MEGABIT).unwrap();
    }
    rig
}

/// Closes the channels, settles the books, and checks that the firmware made no bad accesses to the chip.
fn settle(rig: &mut Rig) {
    for channel in BOTH {
        rig.close(channel).unwrap();
    }
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.session.corruptions(), []);
    assert_eq!(rig.machine.board().odd_accesses(), [], "accesses that no model knows or no hardware accepts");
}

/// Received frames with their stamps in ticks.
fn received(rig: &Rig) -> Vec<(u64, Channel, Frame)> {
    let mut frames = Vec::new();
    Session::new().take(rig.recorded_bytes(), |heard| {
        if let SessionEvent::Record(ticks, Record::Received(received)) = heard {
            frames.push((ticks, received.channel, received.frame));
        }
    });
    frames
}

fn micros_between(from: u64, to: u64) -> f64 {
    (to - from) as f64 / TICKS_PER_US
}

fn frame(text: &str) -> Frame {
    text.parse().unwrap()
}

/// At 1 Mbit/s receivers accept a frame 1 us before its end, which is then still to come when it is stamped.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn stamps_are_at_most_a_microsecond_late_under_full_load() {
    for (bound, latest_ns) in [(Bound::Best, 600), (Bound::Worst, 1000)] {
        let mut rig = listening_under(bound);
        let from = rig.now();
        for (channel, kind) in [(Channel::Can1, Kind::Std0), (Channel::Can2, Kind::Mix)] {
            rig.add_traffic(channel, MEGABIT, Traffic::new(kind, 11, 100.0, from, from + 200 * MS));
        }
        rig.run_for(210 * MS).unwrap();
        settle(&mut rig);
        let stamps = rig.ledger.stamps();
        println!("{bound}: {stamps:?}");
        assert!(stamps.exact > 5000, "{stamps:?}");
        assert!(stamps.min >= 0 && stamps.max <= latest_ns, "{bound}: {stamps:?}");
        for channel in BOTH {
            assert_eq!(rig.ledger.losses(channel).total(), 0);
        }
    }
}

/// The earlier analyser's calibration: ID 0, one byte 0x55, 58 us; bursts of ten, frame 11 − frame 1 =
/// 0.960375 ms.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn bursts_of_ten_are_stamped_58_us_apart() {
    let mut rig = listening();
    let period = 960_375 * CYCLES_PER_US / 1000;
    let from = rig.now() + MS;
    let script = (0..20).flat_map(|burst| (0..10).map(move |_| (from + burst * period, frame("000#55"))));
    rig.add_traffic(Channel::Can1, MEGABIT, Script::new(script.collect()));
    rig.run_for(30 * MS).unwrap();
    settle(&mut rig);
    let stamps: Vec<u64> = received(&rig).into_iter().map(|(ticks, ..)| ticks).collect();
    assert_eq!(stamps.len(), 200);
    for (n, pair) in stamps.windows(2).enumerate() {
        let expected = if n % 10 == 9 { 960.375 - 9.0 * 58.0 } else { 58.0 };
        let seen = micros_between(pair[0], pair[1]);
        assert!((seen - expected).abs() < 0.5, "frame {n}: {seen} us instead of {expected}");
    }
    let eleven = micros_between(stamps[0], stamps[10]);
    assert!((eleven - 960.375).abs() < 0.5, "{eleven} us");
}

/// The traffic that the earlier analyser lost after 26 frames, with a gap of 23 ms: bursts of five every
/// 1919.6 us, 15.1 % load.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn bursts_of_five_are_never_lost() {
    let mut rig = listening();
    let period = 1_919_600 * CYCLES_PER_US / 1000;
    let from = rig.now() + MS;
    let bursts = CYCLES_PER_SECOND / period;
    let script = (0..bursts).flat_map(|burst| (0..5).map(move |_| (from + burst * period, frame("000#55"))));
    rig.add_traffic(Channel::Can1, MEGABIT, Script::new(script.collect()));
    rig.run_for(CYCLES_PER_SECOND + 2 * MS).unwrap();
    settle(&mut rig);
    assert_eq!(rig.ledger.delivered_count(Channel::Can1), 5 * bursts);
    assert_eq!(rig.ledger.losses(Channel::Can1).total(), 0);
}

/// Two nodes with identifiers 1 and 2: the intervals between frames are the lengths of the frames, bit for
/// bit.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn two_node_traffic_has_its_golden_lengths() {
    let golden = [
        ("8001880189018C02", 119),
        ("88098A0088008101", 119),
        ("88008C810C800980", 120),
        ("0880018001890181", 121),
        ("0C820C881888018B", 119),
        ("8080008001800288", 121),
    ];
    let mut rig = listening();
    let from = rig.now() + MS;
    // In each millisecond both want to send at once: the one with identifier 1 wins, 2 follows; then 1 again,
    // so that a frame of 1 has its whole length between two stamps.
    let rounds =
        || (0..4 * golden.len() as u64).map(move |n| (from + n * MS, golden[n as usize % golden.len()].0));
    let first = rounds().map(|(at, data)| (at, frame(&format!("002#{data}"))));
    let second = rounds().map(|(at, data)| (at + 50 * CYCLES_PER_US, frame(&format!("001#{data}"))));
    rig.add_traffic(Channel::Can1, MEGABIT, Script::new(first.collect()));
    rig.add_traffic(Channel::Can1, MEGABIT, Script::new(second.collect()));
    rig.run_for(30 * MS).unwrap();
    settle(&mut rig);
    let frames = received(&rig);
    assert_eq!(frames.len(), 8 * golden.len());
    for (n, pair) in frames.chunks(2).enumerate() {
        let [(before, _, two), (after, _, one)] = pair else { unreachable!("chunks of an even number") };
        let (data, bits) = golden[n % golden.len()];
        assert_eq!((two.to_string(), one.to_string()), (format!("002#{data}"), format!("001#{data}")));
        let seen = micros_between(*before, *after);
        assert_eq!(seen.round() as u32, bits, "{data}: {seen} us");
    }
}

/// Two full buses with errors, a sender that nobody acknowledges, a bus stuck dominant, another bit rate: the
/// device's pins stay recessive, even in the ACK slot.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn listen_only_never_drives_the_bus() {
    let mut rig = listening();
    let from = rig.now();
    rig.add_traffic(Channel::Can1, MEGABIT, Traffic::new(Kind::Mix, 3, 90.0, from, from + 60 * MS));
    {
        let mut board = rig.machine.board();
        for n in 0..20 {
            let disturbance = [Disturbance::Stuff, Disturbance::Crc, Disturbance::Form, Disturbance::Ack];
            board.wires[0].disturb(13 * n, disturbance[n as usize % 4]);
        }
        // Nobody else is on the second bus.
        let lonely = Traffic::new(Kind::Std8, 4, 20.0, from, from + 20 * MS);
        let other = Traffic::new(Kind::Std8, 5, 20.0, from + 30 * MS, from + 60 * MS);
        board.wires[1].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)).with_source(lonely));
        board.wires[1].add(Node::new(BitTime::of_rate(500_000, CLOCK)).with_source(other));
    }
    rig.run_for(40 * MS).unwrap();
    for hold in [true, false] {
        rig.machine.board().hold_buses_dominant(hold);
        rig.run_for(10 * MS).unwrap();
    }
    rig.run_for(30 * MS).unwrap();
    assert!(rig.ledger.delivered_count(Channel::Can1) > 200);
    settle(&mut rig);
    for channel in BOTH {
        assert_eq!(rig.dominant_bits(channel), 0, "{channel:?}");
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn every_error_on_the_bus_is_reported_by_its_name() {
    let mut rig = listening();
    let from = rig.now() + MS;
    let script = (0..4).map(|n| (from + n * 10 * MS, frame("555#00"))).collect();
    rig.add_traffic(Channel::Can2, MEGABIT, Script::new(script));
    // A disturbed frame is repeated at once, so the next in order is two further on.
    for (n, disturbance) in [Disturbance::Stuff, Disturbance::Form, Disturbance::Crc].into_iter().enumerate()
    {
        rig.machine.board().wires[1].disturb(2 * n as u64, disturbance);
    }
    rig.run_for(50 * MS).unwrap();
    settle(&mut rig);
    let kinds: Vec<BusErrorKind> = rig
        .events()
        .iter()
        .filter_map(|(_, event)| match event {
            Event::BusError { channel: Channel::Can2, kind, .. } => Some(*kind),
            _ => None,
        })
        .collect();
    assert_eq!(kinds, [BusErrorKind::Stuff, BusErrorKind::Form, BusErrorKind::Crc]);
    assert_eq!(rig.ledger.delivered_count(Channel::Can2), 4);
}

/// What autobaud builds on: the wrong rate gives errors and no frame, and disturbs nobody.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_wrong_bit_rate_shows_as_errors_and_disturbs_nobody() {
    let image = common::firmware();
    let mut rig = Rig::new(image, common::setup(), Timing::new(CLOCK));
    rig.connect().unwrap();
    for (channel, wrong) in [(Channel::Can1, 500_000), (Channel::Can2, 800_000)] {
        rig.listen(channel, wrong).unwrap();
    }
    let from = rig.now();
    for channel in BOTH {
        rig.add_traffic(channel, MEGABIT, Traffic::new(Kind::Mix, 8, 40.0, from, from + 40 * MS));
    }
    rig.run_for(50 * MS).unwrap();
    settle(&mut rig);
    for channel in BOTH {
        let of = |event: &Event| {
            matches!(event, Event::BusError { channel: seen, .. } if *seen == channel)
                || matches!(event, Event::ErrorsSuppressed { channel: seen, .. } if *seen == channel)
        };
        assert!(rig.events().iter().any(|(_, event)| of(event)), "{channel:?}: {:?}", rig.events());
        assert_eq!((rig.ledger.delivered_count(channel), rig.dominant_bits(channel)), (0, 0), "{channel:?}");
        let sender = rig.machine.board().wires[channel.index()].node(0).sent();
        assert!(sender > 100, "{channel:?}: {sender} frames crossed the bus undisturbed");
    }
}

/// Everything else here relies on these: the time of the bus, of the stamps and of USB.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_clock_tree_is_set_up_as_designed() {
    let rig = listening();
    let clocks = rig.machine.board().rcc.clocks();
    assert_eq!(clocks.sysclk_hz, CYCLES_PER_SECOND);
    assert_eq!((clocks.pclk1_hz, clocks.usb_hz), (36_000_000, 48_000_000));
    assert_eq!(clocks.cycles_per_timer_clock, 2, "72 MHz");
}

/// Firmware that cannot reach its FIFOs in time loses frames, and says so.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_forced_overrun_is_counted() {
    let mut rig = listening();
    let from = rig.now();
    rig.add_traffic(Channel::Can1, MEGABIT, Traffic::new(Kind::Std0, 21, 100.0, from, from + 60 * MS));
    let receive: u128 = CAN_IRQS.iter().map(|irqs| 1 << irqs[1] | 1 << irqs[2]).sum();
    for held_us in [200, 500, 3000] {
        rig.run_for(10 * MS).unwrap();
        rig.machine.hold_lines(receive);
        rig.run_for(held_us * CYCLES_PER_US).unwrap();
        rig.machine.hold_lines(0);
    }
    rig.run_for(40 * MS).unwrap();
    settle(&mut rig);
    let losses = rig.ledger.losses(Channel::Can1);
    // 3.7 ms hold 77 frames of 48 us; three of each window stay in the FIFO.
    assert!((60..=80).contains(&losses.controller), "{losses:?}");
    assert_eq!((losses.queue, losses.link), (0, 0));
    let told: Vec<&Event> =
        rig.events().iter().map(|(_, event)| event).filter(|e| matches!(e, Event::Lost { .. })).collect();
    assert!(told.len() >= 3, "{told:?}");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_same_seed_gives_the_same_run_byte_for_byte() {
    let run = |seed| {
        let mut rig = listening();
        let from = rig.now();
        for channel in BOTH {
            let seed = seed + channel.index() as u64;
            rig.add_traffic(channel, MEGABIT, Traffic::new(Kind::Mix, seed, 95.0, from, from + 40 * MS));
        }
        rig.machine.start_trace();
        rig.run_for(50 * MS).unwrap();
        let trace = rig.machine.take_trace().unwrap();
        let mut file = Vec::new();
        trace.write(&mut file, |number| rig.machine.exception_name(number)).unwrap();
        (rig.recorded_bytes().to_vec(), file)
    };
    let first = run(1);
    assert!(first.0.len() > 1000);
    assert_eq!(first, run(1));
    assert_ne!(first.0, run(2).0);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_trace_file_shows_interrupts_frames_masking_and_sleep() {
    let mut rig = listening();
    let from = rig.now();
    rig.add_traffic(Channel::Can1, MEGABIT, Traffic::new(Kind::Std8, 1, 50.0, from, from + 10 * MS));
    rig.machine.start_trace();
    rig.run_for(15 * MS).unwrap();
    let trace = rig.machine.take_trace().unwrap();
    let mut file = Vec::new();
    trace.write(&mut file, |number| rig.machine.exception_name(number)).unwrap();
    let json: serde_json::Value = serde_json::from_slice(&file).unwrap();
    let events = json["traceEvents"].as_array().unwrap();
    let count =
        |name: &str| events.iter().filter(|event| event["name"] == name && event["ph"] == "X").count();
    let on_bus = rig.ledger.on_bus_count(Channel::Can1) as usize;
    assert!(on_bus > 20);
    assert_eq!(count("CAN1_RX0"), on_bus, "one interrupt for each frame");
    assert!(count("asleep") > 0 && count("OTG_FS") > 0);
    assert_eq!(count("interrupts masked"), 0, "nothing keeps the capture interrupt waiting");
    let frames = events.iter().filter(|event| event["args"]["sender"] == "node 0").count();
    assert_eq!(frames, on_bus);
    assert!(events.iter().any(|event| event["ph"] == "C" && event["args"]["frames"] == 1));
    settle(&mut rig);
}
