//! A controller whose bus is stuck in the middle of a frame is reset to leave it. The manual leaves open what such a reset clears,
//! so everything must be right afterwards in either case.

use crate::common;

use cantap_emu::bus::{BitTime, Node};
use cantap_emu::can::MasterReset;
use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound;
use cantap_emu::traffic::{Kind, Script, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig, timing};
use cantap_wire::message::{ChannelConfig, Filter, FrameKind, Mode, TxFrame};
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Command, Event, Frame};

const MEGABIT: u32 = 1_000_000;
use Channel::{Can1, Can2};

fn config(mode: Mode) -> ChannelConfig {
    ChannelConfig { mode, ..ChannelConfig::listen_only(timing(MEGABIT).unwrap()) }
}

/// Only what a filter lets pass, so that open banks would show.
fn filter(id: u32) -> Filter {
    Filter { extended: false, kind: FrameKind::Any, id, mask: 0x7FF }
}

fn send(rig: &mut Rig, tag: u32, text: &str) {
    let frame = TxFrame { tag, frame: text.parse().unwrap(), at_ticks: None };
    rig.ask(Command::Send { channel: Can1, frames: [frame].into_iter().collect() }).unwrap();
}

fn hold(rig: &mut Rig, hold: bool) {
    let board = &mut *rig.machine.board();
    board.wires[0].hold_dominant(hold, &mut board.can);
}

fn stuck_and_closed(master_reset: MasterReset) -> Rig {
    let mut rig =
        Rig::new(common::firmware(), Setup { master_reset, ..board::setup() }, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    for (channel, id) in [(Can1, 0x123), (Can2, 0x200)] {
        rig.ask(Command::SetFilters { channel, filters: [filter(id)].into_iter().collect() }).unwrap();
    }
    for channel in Channel::ALL {
        // Not through the books, which expect every frame on the bus.
        let mode = if channel == Can1 { Mode::Normal } else { Mode::ListenOnly };
        rig.ask(Command::Open { channel, config: Some(config(mode)) }).unwrap();
    }
    // Nobody acknowledges: one frame is on the bus when it gets stuck, two wait in mailboxes, one in the queue.
    for tag in 0..4 {
        send(&mut rig, tag, "7AA#1122334455667788");
    }
    rig.run_for(3 * MS).unwrap();
    hold(&mut rig, true);
    rig.run_for(2 * MS).unwrap();
    // This is answered; it was not when each poll reset the controller again.
    rig.ask(Command::Close { channel: Can1 }).unwrap();
    rig.run_for(5 * MS).unwrap();
    let ended =
        rig.events().iter().filter(|(_, event)| matches!(event, Event::TransmitFailed { .. })).count();
    assert_eq!(ended, 4, "each is reported");
    assert_eq!(rig.events().last().map(|(_, event)| *event), Some(Event::Stopped { channel: Can1 }));
    hold(&mut rig, false);
    rig.run_for(2 * MS).unwrap();
    assert_eq!(rig.machine.resets(), 0);
    rig
}

/// Frames from the bus, some of which the filter lets pass.
fn some_frames(rig: &Rig, ids: [u32; 3]) -> Vec<(u64, Frame)> {
    let from = rig.now() + 3 * MS;
    ids.iter().zip(0..).map(|(id, n)| (from + n * MS / 4, format!("{id:03X}#").parse().unwrap())).collect()
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn nothing_of_before_is_sent_and_the_filters_stand_after_a_reset() {
    for master_reset in [MasterReset::Least, MasterReset::Most] {
        let mut rig = stuck_and_closed(master_reset);
        // The other channel was open all the time, and its banks are in the registers of the one that was reset.
        let before = rig.status().unwrap().channels[1].frames;
        let script = Script::new(some_frames(&rig, [0x200, 0x201, 0x200]));
        rig.add_traffic(Can2, MEGABIT, script);
        rig.run_for(6 * MS).unwrap();
        let channel = rig.status().unwrap().channels[1];
        assert_eq!(
            (channel.frames - before, channel.lost_controller),
            (2, 0),
            "{master_reset:?}: of CAN2's bus"
        );
        // A node that acknowledges.
        rig.watch();
        let from = some_frames(&rig, [0x123, 0x124, 0x123]);
        let mut board = rig.machine.board();
        board.wires[0].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
        board.wires[0].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)).with_source(Script::new(from)));
        drop(board);
        let before = rig.status().unwrap().channels[0].frames;
        rig.ask(Command::Open { channel: Can1, config: Some(config(Mode::Normal)) }).unwrap();
        rig.run_for(6 * MS).unwrap();
        send(&mut rig, 9, "055#");
        rig.run_for(2 * MS).unwrap();
        let crossed = rig.take_watched()[0].clone();
        let ids: Vec<u32> = crossed.iter().map(|frame| frame.frame.id().raw()).collect();
        assert_eq!(ids, [0x123, 0x124, 0x123, 0x055], "{master_reset:?}: on CAN1's bus");
        let channel = rig.status().unwrap().channels[0];
        assert_eq!((channel.frames - before, channel.transmitted), (2, 1), "{master_reset:?}: of CAN1's bus");
        assert_eq!(rig.machine.board().odd_accesses(), []);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_reset_beside_a_full_channel_costs_it_no_frame_where_the_banks_survive() {
    let image = common::firmware();
    let setup = Setup { master_reset: MasterReset::Least, ..board::setup() };
    let mut rig = Rig::new(image, setup, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    rig.ask(Command::Open { channel: Can1, config: Some(config(Mode::Normal)) }).unwrap();
    rig.listen(Can2, MEGABIT).unwrap();
    let from = rig.now();
    rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Std0, 1, 100.0, from, from + 130 * MS));
    hold(&mut rig, true);
    rig.run_for(MS).unwrap();
    rig.ask(Command::Close { channel: Can1 }).unwrap();
    rig.run_for(30 * MS).unwrap();
    rig.close(Can2).unwrap();
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.ledger.losses(Can2).total(), 0);
}

/// If the reset clears the banks, the other channel hears nothing until they are written again: for at most one frame, and that
/// something may be missing is reported.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_reset_that_clears_the_banks_costs_a_full_channel_a_frame_at_most_and_is_told_of() {
    for (round, bound) in [(0, Bound::Best), (1, Bound::Best), (2, Bound::Worst), (3, Bound::Worst)] {
        let setup = Setup { master_reset: MasterReset::Most, bound, ..board::setup() };
        let mut rig = Rig::new(common::firmware(), setup, Timing::hasty(CLOCK));
        rig.connect().unwrap();
        rig.ask(Command::Open { channel: Can1, config: Some(config(Mode::Normal)) }).unwrap();
        rig.listen(Can2, MEGABIT).unwrap();
        // Each time the reset comes at a different point of the frames.
        let from = rig.now() + round * MS / 71;
        rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Std0, 1, 100.0, from, from + 130 * MS));
        hold(&mut rig, true);
        rig.run_for(MS).unwrap();
        rig.ask(Command::Close { channel: Can1 }).unwrap();
        rig.run_for(30 * MS).unwrap();
        rig.close(Can2).unwrap();
        assert!(rig.ledger.holds(), "round {round}: {:?}", rig.ledger.faults());
        let losses = rig.ledger.losses(Can2);
        assert!(losses.controller <= 1 && losses.total() == losses.controller, "round {round}: {losses:?}");
        let told = rig.events().iter().filter(|(_, event)| {
            matches!(
                event,
                Event::Lost { channel: Can2, stage: LossStage::Controller, count: 0, at_least: true }
            )
        });
        assert_eq!(told.count(), 1, "round {round}");
        assert!(rig.ledger.delivered_count(Can2) > 2_500, "round {round}");
    }
}
