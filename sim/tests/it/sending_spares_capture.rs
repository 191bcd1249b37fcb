//! Capture is never the victim of transmission: whatever a host sets, no receive FIFO overruns, USB answers and the watchdog is fed,
//! with or without a node that acknowledges.

use crate::common;

use Channel::{Can1, Can2};
use cantap_emu::bus::{BitTime, Node};
use cantap_emu::machine::Setup;
use cantap_emu::probe::Task;
use cantap_emu::timing::Bound::{self, Best, Worst};
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::locks::{self, Lock};
use cantap_sim::rig::{MS, Rig, timing};
use cantap_wire::message::{ChannelConfig, Filter, FrameKind, Mode, Periodic, Trigger, TxFrame};
use cantap_wire::record::TransmitFailure;
use cantap_wire::{Channel, Command, Event, Frame};

const MEGABIT: u32 = 1_000_000;
const TICKS_PER_US: u32 = 12;
/// The shortest period that a device takes.
const SHORTEST_US: u32 = 47;
/// How long each storm lasts, in device time.
const STORM: u64 = 100 * MS;
/// A request is answered within this time, whatever else is going on. A host gives up after ten times as long.
const ANSWERED_WITHIN: u64 = 30 * MS;

/// The tasks that drain, send and record.
const PRIORITY_4: [&str; 7] =
    ["CAN1_RX1", "DMA1_STREAM0", "USART2", "USART3", "TIM2", "CAN1_SCE", "CAN2_SCE"];
/// The longest call of these: a FIFO can wait 141 µs, minus the other channel's drain.
const LONGEST_CALL_US: f64 = 120.0;

/// The longest lock, 34 us as measured (an abort on full buses, with everything slow): a quarter of what a FIFO can wait.
const LONGEST_LOCK_US: f64 = 40.0;

fn connected(bound: Bound) -> Rig {
    let setup = Setup { bound, ..board::setup() };
    let mut rig = Rig::new(common::firmware(), setup, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    rig
}

fn open_normal(rig: &mut Rig, channel: Channel, acknowledged: bool) {
    let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing(MEGABIT).unwrap()) };
    rig.ask(Command::Open { channel, config: Some(config) }).unwrap();
    if acknowledged {
        rig.machine.board().wires[channel.index()].add(Node::new(BitTime::of_rate(MEGABIT, CLOCK)));
    }
}

fn frame(text: &str) -> Frame {
    text.parse().unwrap()
}

/// Sets all periodic entries at the shortest period, and all replies to every frame.
fn fill_tables(rig: &mut Rig, channel: Channel) {
    for slot in 0..32 {
        let entry = Periodic {
            frame: frame(&format!("{:03X}#", 0x400 + u32::from(slot))),
            period_ticks: SHORTEST_US * TICKS_PER_US,
            count: 0,
            modifiers: [].into_iter().collect(),
        };
        rig.ask(Command::SetPeriodic { channel, slot, entry: Some(entry) }).unwrap();
    }
    for slot in 0..8 {
        let filter = Filter { extended: false, kind: FrameKind::Any, id: 0, mask: 0 };
        let entry = Trigger { filter, reply: frame("7F0#"), count: 0 };
        rig.ask(Command::SetTrigger { channel, slot, entry: Some(entry) }).unwrap();
    }
}

/// Queues frames that are due at the same time.
fn send_timed(rig: &mut Rig, channel: Channel, at_ticks: u64) {
    let frames = (0..20).map(|tag| TxFrame { tag, frame: frame("155#"), at_ticks: Some(at_ticks) }).collect();
    rig.ask(Command::Send { channel, frames }).unwrap();
}

/// Lets the storm rage, and asks for the device's status in the middle of it.
fn weather(rig: &mut Rig, what: &str) {
    rig.machine.reset_probe();
    let from = rig.now();
    for _ in 0..4 {
        rig.run_for(STORM / 4).unwrap();
        let asked = rig.now();
        rig.status().unwrap_or_else(|error| panic!("{what}: {error}"));
        assert!(
            rig.now() - asked <= ANSWERED_WITHIN,
            "{what}: answered after {} ms",
            (rig.now() - asked) / MS
        );
    }
    assert_eq!(rig.machine.resets(), 0, "{what}");
    let status = rig.status().unwrap();
    for (n, channel) in status.channels.iter().enumerate() {
        let fifo = rig.machine.probe().fifo_max(n);
        assert_eq!(channel.lost_controller, 0, "{what}: CAN{}", n + 1);
        // The depth is three: a call as long as two frames, 94 µs, would show.
        assert!(fifo <= 2, "{what}: {fifo} frames waited in CAN{}'s FIFO", n + 1);
        eprintln!(
            "{what}: CAN{}: {} received, {} lost by the queue, {} sent, {} periods left out; at most {fifo} in the FIFO",
            n + 1,
            channel.frames,
            channel.lost_queue,
            channel.transmitted,
            channel.transmit_failures
        );
    }
    for Task { name, entries, percent, longest_us } in rig.machine.tasks(rig.now() - from) {
        if percent > 2.0 {
            eprintln!("    {name}: {entries}, {percent:.1} %, at most {longest_us:.1} us");
        }
        let bounded = PRIORITY_4.contains(&name.as_str());
        assert!(!bounded || longest_us <= LONGEST_CALL_US, "{what}: {name} took {longest_us:.1} us");
    }
    eprintln!("    load {:.1} %", rig.machine.probe().load_percent(rig.now()));
}

/// CAN1 sends as much as can be requested, next to a full CAN2.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_full_table_costs_the_other_channel_no_frame() {
    for (bound, acknowledged) in [(Best, false), (Best, true), (Worst, true)] {
        let mut rig = connected(bound);
        open_normal(&mut rig, Can1, acknowledged);
        rig.listen(Can2, MEGABIT).unwrap();
        fill_tables(&mut rig, Can1);
        let from = rig.now();
        rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Std0, 1, 100.0, from, from + 3 * STORM));
        let soon = rig.status().unwrap().ticks + u64::from(2000 * TICKS_PER_US);
        send_timed(&mut rig, Can1, soon);
        weather(
            &mut rig,
            if acknowledged { "one table, acknowledged" } else { "one table, not acknowledged" },
        );
        rig.close(Can1).unwrap();
        rig.close(Can2).unwrap();
        assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
        assert_eq!(rig.ledger.losses(Can2).total(), 0, "acknowledged: {acknowledged}");
    }
}

/// Both channels send as much as can be requested.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn full_tables_on_both_channels_leave_usb_alive() {
    for (bound, acknowledged) in [(Best, false), (Best, true), (Worst, false), (Worst, true)] {
        let mut rig = connected(bound);
        for channel in Channel::ALL {
            open_normal(&mut rig, channel, acknowledged);
        }
        // When each channel's table was empty, and when it was full.
        let filled = Channel::ALL.map(|channel| {
            let empty = rig.status().unwrap().ticks;
            fill_tables(&mut rig, channel);
            (empty, rig.status().unwrap().ticks)
        });
        let soon = rig.status().unwrap().ticks + u64::from(3000 * TICKS_PER_US);
        for channel in Channel::ALL {
            send_timed(&mut rig, channel, soon);
        }
        weather(
            &mut rig,
            if acknowledged { "two tables, acknowledged" } else { "two tables, not acknowledged" },
        );
        let closing = rig.status().unwrap().ticks;
        for channel in Channel::ALL {
            rig.close(channel).unwrap();
        }
        // Every period is sent or reported.
        let ended = rig.status().unwrap();
        let periods = |from, to: u64| (to - from) / u64::from(SHORTEST_US * TICKS_PER_US) * 32;
        for channel in Channel::ALL {
            let counted = ended.channels[channel.index()];
            let told: u64 = rig
                .events()
                .iter()
                .map(|(_, event)| match event {
                    Event::TransmitFailed {
                        channel: of,
                        reason: TransmitFailure::Overtaken { periods },
                        ..
                    } if *of == channel => u64::from(*periods),
                    Event::TransmitFailed { channel: of, .. } if *of == channel => 1,
                    _ => 0,
                })
                .sum();
            assert_eq!(told, u64::from(counted.transmit_failures), "{channel:?}");
            let all = u64::from(counted.transmitted) + told;
            let (empty, full) = filled[channel.index()];
            // Each entry may have one frame waiting at the end, and queued frames and replies are not periods.
            let (least, most) = (periods(full, closing) - 32, periods(empty, ended.ticks) + 32 + 20);
            assert!((least..=most).contains(&all), "{channel:?}: {all}, not {least} to {most}");
        }
    }
}

/// A queue that is given up is reported frame by frame, not all at once.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn an_aborted_queue_costs_the_other_channel_no_frame() {
    let mut rig = connected(Worst);
    open_normal(&mut rig, Can1, false);
    rig.listen(Can2, MEGABIT).unwrap();
    let from = rig.now();
    rig.add_traffic(Can2, MEGABIT, Traffic::new(Kind::Std0, 1, 100.0, from, from + 60 * MS));
    for _ in 0..12 {
        send_timed(&mut rig, Can1, 0);
    }
    rig.machine.reset_probe();
    rig.ask(Command::Abort { channel: Can1 }).unwrap();
    rig.run_for(30 * MS).unwrap();
    let status = rig.status().unwrap();
    assert_eq!((status.channels[0].transmit_failures, status.channels[0].tx_pending), (240, 0));
    assert!(rig.machine.probe().fifo_max(1) <= 2, "{} frames waited", rig.machine.probe().fifo_max(1));
    rig.close(Can2).unwrap();
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.ledger.losses(Can2).total(), 0);
}

/// Frames due so close together that each is waited for rather than left to the alarm: this is the longest that one call can last.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn frames_that_are_due_one_after_the_other_hold_up_no_drain_for_long() {
    for spacing_us in [5, 7, 9, 10, 11, 13] {
        let mut rig = connected(Worst);
        for channel in Channel::ALL {
            open_normal(&mut rig, channel, true);
        }
        let first = rig.status().unwrap().ticks + u64::from(8_000 * TICKS_PER_US);
        for channel in Channel::ALL {
            for burst in 0..4 {
                // As many as there are mailboxes, alternating with the other channel's.
                let at = |n: u64| {
                    let nth = 2 * n + channel.index() as u64;
                    first + (burst * 2_000 + nth * spacing_us) * u64::from(TICKS_PER_US)
                };
                let frames = (0..3)
                    .map(|n| TxFrame { tag: n, frame: frame("155#"), at_ticks: Some(at(n.into())) })
                    .collect();
                rig.ask(Command::Send { channel, frames }).unwrap();
            }
        }
        rig.machine.reset_probe();
        let from = rig.now();
        rig.run_for(20 * MS).unwrap();
        let status = rig.status().unwrap();
        assert_eq!(status.channels.map(|channel| channel.transmitted), [12; 2], "{spacing_us} us");
        for Task { name, longest_us, .. } in rig.machine.tasks(rig.now() - from) {
            if PRIORITY_4.contains(&name.as_str()) {
                eprintln!("{spacing_us} us: {name} at most {longest_us:.1} us");
                assert!(longest_us <= LONGEST_CALL_US, "{spacing_us} us: {name} took {longest_us:.1} us");
            }
        }
    }
}

/// What holds up the alarm and the drains is short, whatever a host asks for.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn no_lock_is_held_for_long() {
    let mut longest = 0.0f64;
    for bound in Bound::ALL {
        for Lock { during, longest_us, pc } in locks::longest(&common::firmware(), bound).unwrap() {
            eprintln!("{bound:?}: {during}: {longest_us:.2} us, until {pc:08X}");
            longest = longest.max(longest_us);
        }
    }
    assert!(longest <= LONGEST_LOCK_US, "{longest:.2} us");
}
