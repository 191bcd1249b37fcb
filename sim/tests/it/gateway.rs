//! The gateway of the firmware's ELF: how long a frame takes from one bus to the other, that two full directions lose nothing, and that
//! where the other bus is too slow, every frame is sent or counted.

use crate::common;

use Channel::{Can1, Can2};
use cantap_emu::bus::{BitTime, BusFrame, Member, Node, Source};
use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound::{self, Best, Worst};
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig, timing};
use cantap_wire::message::{
    ChannelConfig, Filter, FrameKind, GatewayEnd, GatewayRule, GatewayState, GatewayStatus, Mode, Pass,
};
use cantap_wire::record::{LossStage, TransmitFailure};
use cantap_wire::{CHANNELS, Channel, Command, Event, Frame, Reply};

/// From the end of a frame to the start of the same on an idle bus.
const LATENCY_WITHIN_US: f64 = 15.0;
/// The tasks of priority 4, and how long one call of them may take: a FIFO can wait 141 µs, minus the other channel's drain.
const PRIORITY_4: [&str; 5] = ["CAN1_RX1", "DMA1_STREAM0", "USART2", "USART3", "TIM2"];
const LONGEST_CALL_US: f64 = 120.0;

/// Identifiers of frames that rules drop.
const DROPPED: std::ops::Range<u32> = 0x780..0x79F;

/// A table whose last rule passes on what the others do not drop.
fn rules() -> Vec<GatewayRule> {
    let filter = |id, mask| Filter { extended: false, kind: FrameKind::Any, id, mask };
    let mut rules: Vec<_> = DROPPED.map(|id| GatewayRule { filter: filter(id, 0x7FF), pass: None }).collect();
    rules.push(GatewayRule { filter: filter(0, 0), pass: Some(Pass::unchanged(false)) });
    rules
}

/// A board between two buses of these bit rates, each with a node that acknowledges.
fn gateway(bound: Bound, rates: [u32; CHANNELS], rules: &[GatewayRule]) -> Rig {
    gateway_on(Setup { bound, ..board::setup() }, rates, [rules; CHANNELS])
}

/// The same with rules for what each channel receives.
fn gateway_on(setup: Setup, rates: [u32; CHANNELS], rules: [&[GatewayRule]; CHANNELS]) -> Rig {
    let mut rig = Rig::new(common::firmware(), setup, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    for (channel, rate) in Channel::ALL.into_iter().zip(rates) {
        let config =
            ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(rate).unwrap()) };
        rig.open(channel, config).unwrap();
        rig.machine.board().wires[channel.index()].add(Node::new(BitTime::of_rate(rate, CLOCK)));
        for (slot, rule) in (0..).zip(rules[channel.index()]) {
            rig.ask(Command::SetGatewayRule { from: channel, slot, rule: Some(rule.clone()) }).unwrap();
        }
    }
    rig.ask(Command::StartGateway).unwrap();
    rig.watch();
    rig
}

fn status(rig: &mut Rig, from: Channel) -> GatewayStatus {
    match rig.ask(Command::GatewayStatus { from, first: 16 }).unwrap() {
        Reply::Gateway(status) => status,
        other => panic!("{other:?}"),
    }
}

/// The frames that nodes sent on one bus and that rules let pass, and those that the device sent on the other.
fn crossed(watched: &[Vec<BusFrame>; CHANNELS], from: Channel) -> (Vec<BusFrame>, Vec<BusFrame>) {
    let to = 1 - from.index();
    let of = |channel: usize, ours: bool| {
        let is_ours = move |frame: &&BusFrame| (frame.sender == Member::Controller(channel)) == ours;
        watched[channel].iter().filter(|frame| frame.error.is_none()).filter(is_ours).copied().collect()
    };
    let mut received: Vec<BusFrame> = of(from.index(), false);
    received.retain(|frame| !DROPPED.contains(&frame.frame.id().raw()));
    (received, of(to, true))
}

fn frames(of: &[BusFrame]) -> Vec<Frame> {
    of.iter().map(|frame| frame.frame).collect()
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_frame_is_on_an_idle_bus_soon_after_its_end_on_the_other() {
    let rates = [1_000_000, 500_000, 250_000, 125_000, 33_333];
    let mut late = Vec::new();
    let pairs = rates.iter().flat_map(|&a| rates.map(|b| [a, b]));
    for (bound, rates) in pairs.flat_map(|rates| [(Best, rates), (Worst, rates)]) {
        let mut rig = gateway(bound, rates, &rules());
        let from = rig.now();
        // So few that the slowest bus is idle between two.
        let load = 5.0 * f64::from(rates[1].min(rates[0])) / f64::from(rates[0]);
        rig.add_traffic(Can1, rates[0], Traffic::new(Kind::Std8, 1, load, from, from + 100 * MS));
        rig.run_for(120 * MS).unwrap();
        let watched = rig.take_watched();
        let (received, sent) = crossed(&watched, Can1);
        assert!(sent.len() > 1 && received.len() == sent.len(), "{rates:?}: {} sent", sent.len());
        let us = |cycles: u64| cycles as f64 * 1e6 / CLOCK.hz() as f64;
        let mut longest: f64 = 0.0;
        for (received, sent) in received.iter().zip(&sent) {
            assert_eq!(received.frame, sent.frame);
            longest = longest.max(us(sent.start.saturating_sub(received.end)));
        }
        eprintln!("{bound}, {rates:?}: at most {longest:.2} us in {} frames", sent.len());
        late.extend((longest > LATENCY_WITHIN_US).then(|| format!("{bound}, {rates:?}: {longest:.2} us")));
        assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    }
    assert_eq!(late, Vec::<String>::new());
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn two_full_directions_lose_nothing() {
    for bound in [Best, Worst] {
        let mut rig = gateway(bound, [1_000_000; CHANNELS], &rules());
        rig.machine.reset_probe();
        let from = rig.now();
        for (seed, channel) in (1..).zip(Channel::ALL) {
            // Each bus carries what its own nodes send and what comes from the other.
            let traffic = Traffic::new(Kind::Std8, seed, 49.5, from, from + 300 * MS);
            rig.add_traffic(channel, 1_000_000, traffic);
        }
        rig.run_for(310 * MS).unwrap();
        let watched = rig.take_watched();
        for channel in Channel::ALL {
            let (received, sent) = crossed(&watched, channel);
            assert!(received.len() > 1100, "{}", received.len());
            assert!(frames(&received) == frames(&sent), "{bound}: {} of {}", sent.len(), received.len());
            let found = status(&mut rig, channel);
            assert_eq!((found.state, found.waiting, found.unmatched), (GatewayState::Running, 0, 0));
            let counts = found.counts[15];
            assert_eq!((counts.sent, counts.lost), (sent.len() as u32, 0), "{bound}");
            let (at, was) = (channel.index(), rig.machine.probe().fifo_max(channel.index()));
            assert!(was <= 2, "{was} frames waited in FIFO {at}");
        }
        let confirmed = rig.events().iter().filter(|(_, event)| matches!(event, Event::Transmitted { .. }));
        let total = watched.iter().flatten().filter(|frame| matches!(frame.sender, Member::Controller(_)));
        assert_eq!(confirmed.count(), total.count());
        for task in rig.machine.tasks(rig.now() - from) {
            if PRIORITY_4.contains(&task.name.as_str()) {
                eprintln!("{bound}: {} {:.1} %, at most {:.1} us", task.name, task.percent, task.longest_us);
                assert!(task.longest_us <= LONGEST_CALL_US, "{}: {} us", task.name, task.longest_us);
            }
        }
        eprintln!("{bound}: load {:.1} %", rig.machine.probe().load_percent(rig.now()));
        assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    }
}

/// The law of counting for a gateway: what was received is sent, or counted as lost, in the stream and by rule.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn what_a_slower_bus_does_not_take_is_counted() {
    for rate in [500_000, 250_000, 125_000, 33_333] {
        let mut rig = gateway(common::bound(), [1_000_000, rate], &rules());
        let from = rig.now();
        rig.add_traffic(Can1, 1_000_000, Traffic::new(Kind::Std8, 1, 100.0, from, from + 100 * MS));
        // All that waits has been sent by then.
        rig.run_for(500 * MS).unwrap();
        let watched = rig.take_watched();
        let (received, sent) = crossed(&watched, Can1);
        let counts = status(&mut rig, Can1).counts[15];
        assert_eq!((counts.matched as usize, counts.sent as usize), (received.len(), sent.len()), "{rate}");
        assert_eq!(counts.matched, counts.sent + counts.lost, "{rate}");
        assert!(counts.lost > 100, "{rate}: {counts:?}");
        let told = rig.events().iter().map(|(_, event)| match event {
            Event::Lost { channel: Can2, stage: LossStage::Gateway, count, at_least: false } => *count,
            _ => 0,
        });
        assert_eq!(told.sum::<u32>(), counts.lost, "{rate}");
        eprintln!("{rate}: {counts:?}");
        assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_closed_port_silences_a_gateway_that_a_host_has_started() {
    let mut rig = gateway(common::bound(), [1_000_000; CHANNELS], &rules());
    let from = rig.now();
    rig.add_traffic(Can1, 1_000_000, Traffic::new(Kind::Std8, 1, 30.0, from, from + 1000 * MS));
    rig.run_for(20 * MS).unwrap();
    assert!(crossed(&rig.take_watched(), Can1).1.len() > 20);
    rig.with_host(|host, _| host.close_port());
    rig.run_unbooked(20 * MS).unwrap();
    let (_, watched) = rig.run_watched(50 * MS).unwrap();
    let (received, sent) = crossed(&watched, Can1);
    assert!(received.len() > 50 && sent.is_empty(), "{} sent", sent.len());
}

/// A frame again and again, without a pause between.
struct Same {
    frame: Frame,
    left: u32,
}

impl Source for Same {
    fn next_frame(&mut self, _: BitTime) -> Option<(u64, Frame)> {
        self.left = self.left.checked_sub(1)?;
        Some((0, self.frame))
    }
}

/// On the other bus each ends about when the next ends here.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn equal_frames_back_to_back_are_no_loop() {
    for (bound, rate) in
        [Best, Worst].into_iter().flat_map(|bound| [1_000_000, 500_000, 125_000].map(|rate| (bound, rate)))
    {
        let mut rig = gateway(bound, [rate; CHANNELS], &rules());
        let frames = 400;
        rig.add_traffic(Can1, rate, Same { frame: "123#1122334455667788".parse().unwrap(), left: frames });
        rig.run_for(1200 * MS * 125_000 / u64::from(rate)).unwrap();
        let (received, sent) = crossed(&rig.take_watched(), Can1);
        let found = status(&mut rig, Can1);
        eprintln!("{bound}, {rate}: {} of {} sent", sent.len(), received.len());
        assert_eq!(found.state, GatewayState::Running, "{bound}, {rate}");
        assert_eq!((received.len(), sent.len()), (frames as usize, frames as usize), "{bound}, {rate}");
        assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn both_channels_on_one_bus_are_noticed_and_the_bus_is_left_alone() {
    // Where a bit is long and there are rules both ways, both channels begin to send a frame in the same bit, as one.
    let cases = [
        (1_000_000, true),
        (250_000, true),
        (125_000, true),
        (125_000, false),
        (33_333, true),
        (33_333, false),
    ];
    for (bound, (rate, both_ways)) in
        [Best, Worst].into_iter().flat_map(|bound| cases.map(|case| (bound, case)))
    {
        let setup = Setup { bound, joined: true, ..board::setup() };
        let rules = rules();
        let back: &[GatewayRule] = if both_ways { &rules } else { &[] };
        let mut rig = gateway_on(setup, [rate; CHANNELS], [&rules, back]);
        let from = rig.now();
        let frame_ms = 130_000.0 / f64::from(rate);
        let (load, frames) = if both_ways { (0.3, 64.0) } else { (0.05, 1.0) };
        let length = (frames * frame_ms / load * MS as f64) as u64;
        rig.add_traffic(Can1, rate, Traffic::new(Kind::Std8, 1, 100.0 * load, from, from + length));
        rig.run_for(length + 300 * MS).unwrap();
        let events = rig.events();
        let told = events.iter().filter(|(_, event)| {
            matches!(event, Event::TransmitFailed { reason: TransmitFailure::Loop, .. })
        });
        let told = told.count();
        let found = status(&mut rig, Can1);
        let ours = rig.take_watched()[0]
            .iter()
            .filter(|frame| matches!(frame.sender, Member::Controller(_)))
            .count();
        eprintln!("{bound}, {rate}, both ways {both_ways}: {ours} frames until the loop was noticed");
        assert_eq!(found.state, GatewayState::Ended(GatewayEnd::Loop), "{bound}, {rate}, {both_ways}");
        assert_eq!(told, 1, "{bound}, {rate}, {both_ways}");
        assert!(ours < 200, "{ours}");
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_saved_gateway_works_from_power_on_without_a_host_and_beside_one() {
    let mut rig = Rig::new(common::firmware(), common::setup(), Timing::hasty(CLOCK));
    rig.be_patient_for(3000 * MS);
    rig.connect().unwrap();
    for channel in Channel::ALL {
        let config =
            ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(1_000_000).unwrap()) };
        rig.ask(Command::Configure { channel, config }).unwrap();
        for (slot, rule) in (0..).zip(rules()) {
            rig.ask(Command::SetGatewayRule { from: channel, slot, rule: Some(rule) }).unwrap();
        }
        rig.machine.board().wires[channel.index()].add(Node::new(BitTime::of_rate(1_000_000, CLOCK)));
    }
    rig.ask(Command::SaveGateway).unwrap();
    rig.ask(Command::Reset).unwrap();
    rig.with_host(|host, _| host.unplug());
    rig.run_unbooked(100 * MS).unwrap();
    let from = rig.now();
    for (seed, channel) in (1..).zip(Channel::ALL) {
        rig.add_traffic(channel, 1_000_000, Traffic::new(Kind::Std8, seed, 45.0, from, from + 2000 * MS));
    }
    let passes = |rig: &mut Rig, what: &str| {
        rig.run_unbooked(5 * MS).unwrap();
        let (_, watched) = rig.run_watched(300 * MS).unwrap();
        for channel in Channel::ALL {
            let (received, sent) = crossed(&watched, channel);
            // Some are on their way at the beginning and at the end.
            assert!(sent.len() > 900 && sent.len().abs_diff(received.len()) < 20, "{what}: {}", sent.len());
        }
    };
    // Long enough to fill the record queue, which no host empties.
    passes(&mut rig, "without a host");
    rig.plug_in().unwrap();
    rig.greet().unwrap();
    let found = status(&mut rig, Can1);
    assert!(found.standalone && found.state == GatewayState::Running, "{found:?}");
    passes(&mut rig, "beside a host");
    rig.with_host(|host, _| host.close_port());
    passes(&mut rig, "after the host");
    assert_eq!(rig.machine.resets(), 1);
}
