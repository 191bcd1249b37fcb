//! Error frames on purpose, by the firmware built with the feature `disturb` (`cargo xtask firmware --disturb`): where the level lands, what it
//! destroys, what is refused, and that nothing is driven that was not asked for.

use crate::common;

use cantap_emu::bus::bits::FrameBits;
use cantap_emu::bus::{BitTime, BusFrame, Member, Node};
use cantap_emu::elf::Image;
use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound::{self, Best, Worst};
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::firmware;
use cantap_sim::rig::{MS, Rig, RigError, timing};
use cantap_wire::Channel::{Can1, Can2};
use cantap_wire::message::{
    ChannelConfig, DISTURBANCE_PAUSE_TICKS, DISTURBANCE_WORD, MAX_DISTURBANCE_BITS, Mode, TxFrame,
};
use cantap_wire::record::ErrorState;
use cantap_wire::{Command, Event, Frame, Refusal, Reply};

const MEGABIT: u32 = 1_000_000;
const CYCLES_PER_TICK: u64 = 12;
/// From the planned tick to the edge on the bus: the emulator notices an edge with the instruction that runs then, or the next.
const WITHIN_CYCLES: u64 = 20;

fn image() -> Image {
    let path = common::elf().with_file_name("cantap-olimex-p405-disturb.elf");
    firmware::open(&path).unwrap_or_else(|error| {
        panic!("{}: {error}; build it with `cargo xtask firmware --disturb`", path.display())
    })
}

fn config(mode: Mode, bitrate_bps: u32) -> ChannelConfig {
    ChannelConfig { mode, ..ChannelConfig::listen_only(timing(bitrate_bps).unwrap()) }
}

/// A board in a session, CAN1 in `mode` on a bus with a node that acknowledges; its number is 0.
fn rig(bound: Bound, mode: Mode, bitrate_bps: u32) -> Rig {
    let mut rig = Rig::new(image(), Setup { bound, ..board::setup() }, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    rig.open(Can1, config(mode, bitrate_bps)).unwrap();
    rig.machine.board().wires[0].add(Node::new(BitTime::of_rate(bitrate_bps, CLOCK)));
    rig.watch();
    rig
}

fn unlocked(bound: Bound, bitrate_bps: u32) -> Rig {
    let mut rig = rig(bound, Mode::Normal, bitrate_bps);
    rig.ask(Command::UnlockDisturbance { word: DISTURBANCE_WORD }).unwrap();
    rig
}

fn now(rig: &mut Rig) -> u64 {
    match rig.ask(Command::Time).unwrap() {
        Reply::Time(ticks) => ticks,
        other => panic!("{other:?}"),
    }
}

/// The core cycle of a device time.
fn cycle(rig: &mut Rig, ticks: u64) -> u64 {
    rig.clock_origin() + ticks * CYCLES_PER_TICK
}

fn disturb(rig: &mut Rig, at_ticks: u64, bits: u8) {
    rig.ask(Command::Disturb { channel: Can1, at_ticks, bits }).unwrap();
}

fn refusal(rig: &mut Rig, command: Command) -> Refusal {
    match rig.ask(command) {
        Err(RigError::Refused { refusal, .. }) => refusal,
        other => panic!("{other:?}"),
    }
}

/// Times and lengths of the disturbances on record.
fn disturbed(rig: &Rig) -> Vec<(u64, u16)> {
    let of = |(at, event): &(u64, Event)| match event {
        Event::Disturbed { channel: Can1, ticks } => Some((*at, *ticks)),
        _ => None,
    };
    rig.events().iter().filter_map(of).collect()
}

fn errors(rig: &Rig) -> usize {
    rig.events().iter().filter(|(_, event)| matches!(event, Event::BusError { channel: Can1, .. })).count()
}

fn driven_cycles(rig: &Rig) -> [u64; 2] {
    let board = rig.machine.board();
    [0, 1].map(|n| board.driven_cycles(n))
}

fn frame(text: &str) -> Frame {
    text.parse().unwrap()
}

/// Gives the node a frame whose start of frame is at this cycle.
fn send_at(rig: &mut Rig, cycle: u64, frame: Frame) {
    let mut board = rig.machine.board();
    let node = board.wires[0].node(0);
    node.send_at(cycle, frame);
}

/// What crossed the bus since the last call.
fn history(rig: &mut Rig) -> Vec<BusFrame> {
    let [first, _] = rig.take_watched();
    first
}

/// The law of counting, and nothing odd in the accesses.
fn settle(rig: &mut Rig) {
    rig.close(Can1).unwrap();
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.machine.board().odd_accesses(), []);
}

/// The bit that the level hits is the one that was planned, in both timing models, at every bit of the frame; and it is as long as asked.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_level_lands_on_its_bit_and_destroys_the_frame_which_then_comes_again() {
    for bound in [Best, Worst] {
        for (text, bit) in [("123#1122", 25), ("123#1122", 3), ("000#00", 33), ("7FF#FFFFFFFFFFFFFFFF", 60)] {
            let mut rig = unlocked(bound, MEGABIT);
            let bits = FrameBits::new(&frame(text));
            let start = now(&mut rig) + 12 * 5_000;
            let start_cycle = cycle(&mut rig, start);
            send_at(&mut rig, start_cycle, frame(text));
            // The level begins with the bit; a tick is a twelfth of one.
            disturb(&mut rig, start + 12 * bit as u64, 6);
            rig.run_for(10 * MS).unwrap();
            assert_eq!(disturbed(&rig), [(start + 12 * bit as u64, 72)], "{bound} {text} {bit}");
            let history = history(&mut rig);
            let [first, second] = history[..] else { panic!("{history:?}") };
            assert_eq!((first.frame, first.start, first.taken_by), (frame(text), start_cycle, 0));
            assert!(first.error.is_some(), "{bound} {text} {bit}");
            assert_eq!((second.frame, second.error, second.taken_by), (frame(text), None, 1));
            // The flags end before the next start: 6 to 12 bits behind the level's first stuff violation, 8 and 3 recessive.
            let until = second.start - start_cycle;
            let least = (bit + 1 + 6 + 11) as u64 * 144;
            assert!((least..least + 17 * 144).contains(&until), "{bound} {text} {bit}: {until}");
            assert!(bits.len() > bit);
            let [driven, other] = driven_cycles(&rig);
            assert!(
                driven.abs_diff(72 * CYCLES_PER_TICK) <= WITHIN_CYCLES && other == 0,
                "{bound}: {driven}"
            );
            assert_eq!(errors(&rig), 1, "{bound} {text} {bit}");
            settle(&mut rig);
        }
    }
}

/// One bit over a recessive bit is that bit's error, over a dominant one nothing.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_level_of_one_bit_hits_exactly_its_bit() {
    let text = "123#1122334455667788";
    let bits = FrameBits::new(&frame(text));
    for bound in [Best, Worst] {
        for bit in 20..40 {
            let mut rig = unlocked(bound, MEGABIT);
            let start = now(&mut rig) + 12 * 5_000;
            let start_cycle = cycle(&mut rig, start);
            send_at(&mut rig, start_cycle, frame(text));
            disturb(&mut rig, start + 12 * bit as u64, 1);
            rig.run_for(8 * MS).unwrap();
            let recessive = bits.levels()[bit];
            let history = history(&mut rig);
            assert_eq!(history[0].error.is_some(), recessive, "{bound}, bit {bit}: {history:?}");
            assert_eq!(history.len(), if recessive { 2 } else { 1 });
            assert_eq!((disturbed(&rig).len(), errors(&rig)), (1, usize::from(recessive)));
        }
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn on_an_idle_bus_it_is_an_error_frame_of_all_and_the_counters_rise() {
    for bitrate_bps in [MEGABIT, 500_000, 125_000] {
        let mut rig = unlocked(common::bound(), bitrate_bps);
        for _ in 0..4 {
            let at = now(&mut rig) + u64::from(DISTURBANCE_PAUSE_TICKS);
            disturb(&mut rig, at, 6);
            rig.run_for(20 * MS).unwrap();
        }
        let recorded = disturbed(&rig);
        assert_eq!(recorded.len(), 4, "{recorded:?}");
        let length = 6 * 12 * MEGABIT / bitrate_bps;
        assert!(recorded.iter().all(|(_, ticks)| u32::from(*ticks) == length), "{recorded:?}");
        assert_eq!((errors(&rig), history(&mut rig).len()), (4, 0));
        assert!(rig.machine.board().can.controllers[0].counters().receive() >= 4);
        settle(&mut rig);
    }
}

/// The controller is off its pin for some microseconds only: its own frames go on, and each is confirmed.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn under_full_load_on_both_channels_no_frame_is_lost_and_each_level_comes_or_is_given_up() {
    for bound in [Best, Worst] {
        let mut rig = unlocked(bound, MEGABIT);
        rig.listen(Can2, MEGABIT).unwrap();
        let from = rig.now();
        rig.add_traffic(Can1, MEGABIT, Traffic::new(Kind::Mix, 1, 80.0, from, from + 300 * MS));
        rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Std0, 2, 100.0, from, from + 300 * MS));
        for round in 0..10 {
            let frames = [TxFrame { frame: frame("001#11"), tag: round, at_ticks: None }];
            rig.ask(Command::Send { channel: Can1, frames: frames.into_iter().collect() }).unwrap();
            let at = now(&mut rig) + u64::from(DISTURBANCE_PAUSE_TICKS);
            disturb(&mut rig, at, 6);
            rig.run_for(25 * MS).unwrap();
        }
        rig.run_for(60 * MS).unwrap();
        let recorded = disturbed(&rig);
        let driven = recorded.iter().filter(|(_, ticks)| *ticks > 0).count();
        eprintln!("{bound}: {driven} of {} levels, {} errors seen", recorded.len(), errors(&rig));
        assert_eq!(recorded.len(), 10);
        assert!(driven >= 8, "{bound}: {recorded:?}");
        let confirmed =
            rig.events().iter().filter(|(_, event)| matches!(event, Event::Transmitted { .. })).count();
        assert_eq!(confirmed, 10);
        assert_eq!((rig.ledger.losses(Can1).total(), rig.ledger.losses(Can2).total()), (0, 0));
        rig.close(Can2).unwrap();
        settle(&mut rig);
        let states = rig
            .events()
            .iter()
            .filter(|(_, event)| matches!(event, Event::State { state: ErrorState::BusOff, .. }));
        assert_eq!(states.count(), 0);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn what_is_not_permitted_is_refused_and_drives_nothing() {
    let mut rig = rig(common::bound(), Mode::Normal, MEGABIT);
    let soon = |rig: &mut Rig| now(rig) + 12 * 5_000;
    let plan = |channel, at_ticks, bits| Command::Disturb { channel, at_ticks, bits };
    let at = soon(&mut rig);
    assert_eq!(refusal(&mut rig, plan(Can1, at, 6)), Refusal::DisturbanceLocked);
    assert_eq!(refusal(&mut rig, Command::UnlockDisturbance { word: 1 }), Refusal::DisturbanceLocked);
    assert_eq!(refusal(&mut rig, plan(Can1, at, 6)), Refusal::DisturbanceLocked);
    rig.ask(Command::UnlockDisturbance { word: DISTURBANCE_WORD }).unwrap();
    let at = soon(&mut rig);
    assert_eq!(refusal(&mut rig, plan(Can2, at, 6)), Refusal::ChannelClosed);
    for bits in [0, MAX_DISTURBANCE_BITS + 1, 255] {
        assert_eq!(refusal(&mut rig, plan(Can1, at, bits)), Refusal::BadEntry);
    }
    assert_eq!(refusal(&mut rig, plan(Can1, 0, 6)), Refusal::TooLate);
    assert_eq!(refusal(&mut rig, plan(Can1, at + 12_000_000 * 3600 * 25, 6)), Refusal::TooFarAhead);
    for (mode, refused) in [(Mode::ListenOnly, Refusal::ListenOnly), (Mode::Loopback, Refusal::NotNormal)] {
        rig.open(Can2, config(mode, MEGABIT)).unwrap();
        assert_eq!(refusal(&mut rig, plan(Can2, at, 6)), refused);
        rig.close(Can2).unwrap();
    }
    assert_eq!(driven_cycles(&rig), [0, 0]);
    let at = soon(&mut rig);
    disturb(&mut rig, at, 6);
    assert_eq!(refusal(&mut rig, plan(Can1, at + 12_000_000, 6)), Refusal::TooOften, "one at a time");
    rig.run_for(6 * MS).unwrap();
    let soonest = at + u64::from(DISTURBANCE_PAUSE_TICKS);
    assert_eq!(refusal(&mut rig, plan(Can1, soonest - 1, 6)), Refusal::TooOften);
    disturb(&mut rig, soonest, 6);
    rig.run_for(10 * MS).unwrap();
    assert_eq!(disturbed(&rig).len(), 2);
    settle(&mut rig);
}

/// What was unlocked and planned ends with its channel, and with its session.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn nothing_is_driven_after_the_channel_or_the_session_has_ended() {
    let mut rig = unlocked(common::bound(), MEGABIT);
    let at = now(&mut rig) + 12 * 50_000;
    disturb(&mut rig, at, 6);
    rig.close(Can1).unwrap();
    rig.run_for(60 * MS).unwrap();
    let given_up = disturbed(&rig);
    assert_eq!((driven_cycles(&rig), given_up.len()), ([0, 0], 1));
    assert!(given_up[0].0 < at && given_up[0].1 == 0, "{given_up:?}");
    rig.open(Can1, config(Mode::Normal, MEGABIT)).unwrap();
    let at = now(&mut rig) + 12 * 50_000;
    disturb(&mut rig, at, 6);
    rig.greet().unwrap();
    rig.run_for(60 * MS).unwrap();
    assert_eq!(driven_cycles(&rig), [0, 0]);
    rig.open(Can1, config(Mode::Normal, MEGABIT)).unwrap();
    let at = now(&mut rig) + 12 * 50_000;
    let locked = Command::Disturb { channel: Can1, at_ticks: at, bits: 6 };
    assert_eq!(refusal(&mut rig, locked), Refusal::DisturbanceLocked);
    settle(&mut rig);
}

/// A firmware built for it drives nothing by itself either: not in listen-only mode, not in any other.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn unasked_it_drives_nothing() {
    let mut rig = rig(common::bound(), Mode::ListenOnly, MEGABIT);
    let from = rig.now();
    rig.add_traffic(Can1, MEGABIT, Traffic::new(Kind::Mix, 3, 60.0, from, from + 50 * MS));
    rig.run_for(70 * MS).unwrap();
    assert_eq!((driven_cycles(&rig), rig.dominant_bits(Can1)), ([0, 0], 0));
    assert!(history(&mut rig).iter().all(|frame| matches!(frame.sender, Member::Node(_))));
    settle(&mut rig);
}

/// A core that stops at any instruction around the level: the level is as long as it should be, or there is none, and then the pin is
/// recessive.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_core_that_stops_at_any_moment_leaves_the_bus_recessive() {
    let lead = 20_000;
    for step in 0..40 {
        let mut rig = unlocked(Best, MEGABIT);
        let at = now(&mut rig) + 12 * lead;
        disturb(&mut rig, at, 12);
        let due = cycle(&mut rig, at);
        // From 16 µs before the level to 24 after its beginning, at steps that are no multiple of anything.
        let stops = due - 16 * 144 + step * 144 + step * 37 % 144;
        let ahead = stops - rig.now();
        rig.run_for(ahead).unwrap();
        let stops = rig.now();
        // The board goes on without its core.
        for later in (0..100 * 144).step_by(8) {
            rig.machine.board().advance(stops + later);
        }
        let [driven, _] = driven_cycles(&rig);
        let whole = 12 * 144;
        let is_right = driven == 0 && stops < due || driven.abs_diff(whole) <= WITHIN_CYCLES;
        assert!(is_right, "stopped {} cycles after the beginning: {driven}", stops as i64 - due as i64);
        assert!(
            !rig.machine.board().drives(0),
            "stopped {} cycles after the beginning",
            stops as i64 - due as i64
        );
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_firmware_without_the_feature_does_not_know_the_requests() {
    let mut rig = Rig::new(common::firmware(), common::setup(), Timing::hasty(CLOCK));
    rig.connect().unwrap();
    let unlock = Command::UnlockDisturbance { word: DISTURBANCE_WORD };
    assert_eq!(refusal(&mut rig, unlock), Refusal::Malformed);
    rig.open(Can1, config(Mode::Normal, MEGABIT)).unwrap();
    let at_ticks = now(&mut rig) + 12 * 5_000;
    assert_eq!(refusal(&mut rig, Command::Disturb { channel: Can1, at_ticks, bits: 6 }), Refusal::Malformed);
    rig.run_for(20 * MS).unwrap();
    assert_eq!(driven_cycles(&rig), [0, 0]);
}
