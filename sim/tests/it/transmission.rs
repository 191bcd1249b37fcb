//! What a host streams for transmission through the firmware's ELF: in order, on time, filling the bus, confirmed one by one,
//! and at no cost to the other channel's capture.

use crate::common;

use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound::{self, Best, Worst};
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig};
use cantap_sim::stream::{Replayed, fill, join, replay};
use cantap_wire::Channel::{Can1, Can2};
use cantap_wire::message::{MAX_SEND, TxFrame};
use cantap_wire::{Channel, Command, Event};

const MEGABIT: u32 = 1_000_000;
/// The error of a replay's spacing, whatever the other channel does.
const REPLAY_WITHIN_US: f64 = 2.0;

/// A board that takes part in the buses of `channels`.
fn joined(channels: &[Channel]) -> Rig {
    joined_under(common::bound(), channels)
}

/// The same under a bound of time.
fn joined_under(bound: Bound, channels: &[Channel]) -> Rig {
    let mut rig = Rig::new(common::firmware(), Setup { bound, ..board::setup() }, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    join(&mut rig, channels).unwrap();
    rig
}

/// Full load of the shortest frames on a channel that only listens, for `ms` from now.
fn saturate(rig: &mut Rig, channel: Channel, ms: u64) {
    rig.listen(channel, MEGABIT).unwrap();
    let from = rig.now();
    rig.add_traffic(channel, MEGABIT, Traffic::new(Kind::Std0, 1, 100.0, from, from + ms * MS));
}

/// How late a stamp may be, whatever else happens: nothing masks the interrupt that stamps, only another stamp delays it.
fn latest_stamp_us(bound: Bound) -> f64 {
    if bound == Best { 0.6 } else { 1.0 }
}

/// Checks that the spacing is within `within_us` of the plan, and each confirmation's stamp soon after the frame's end.
fn hold_times(bound: Bound, what: &str, replayed: Option<&[Replayed]>, within_us: f64) {
    let replayed = replayed.unwrap_or_else(|| panic!("{bound}, {what}: not all frames in order"));
    let latest_us = latest_stamp_us(bound);
    for one in replayed {
        eprintln!("{bound}, {what}: spacing {:.2} us, stamps {:?}", one.late.width_us(), one.stamps);
        assert!(one.late.width_us() <= within_us, "{bound}, {what}: {one:?}");
        assert!(one.stamps.min_us >= -0.1 && one.stamps.max_us <= latest_us, "{bound}, {what}: {one:?}");
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_replay_keeps_its_spacing_at_any_load_below_saturation() {
    for (bound, load, seconds) in [
        (Best, 10.0, 0.3),
        (Best, 30.0, 0.15),
        (Best, 60.0, 0.15),
        (Best, 90.0, 0.2),
        (Best, 98.0, 0.2),
        (Worst, 98.0, 0.1),
    ] {
        let mut rig = joined_under(bound, &[Can1]);
        let replayed = replay(&mut rig, &[Can1], load, seconds).unwrap();
        hold_times(bound, &format!("alone at {load} %"), replayed.as_deref(), 0.5);
    }
}

/// The alarm comes early, and the rest of the time is spent waiting at the priority that drains the FIFOs: that must not cost
/// the other channel a frame.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_replay_keeps_its_spacing_beside_a_full_channel_and_costs_it_nothing() {
    for (bound, load) in
        [(Best, 30.0), (Best, 60.0), (Best, 90.0), (Best, 98.0), (Worst, 90.0), (Worst, 98.0)]
    {
        let mut rig = joined_under(bound, &[Can1]);
        saturate(&mut rig, Can2, 280);
        let replayed = replay(&mut rig, &[Can1], load, 0.15).unwrap();
        hold_times(bound, &format!("beside 100 % at {load} %"), replayed.as_deref(), REPLAY_WITHIN_US);
        rig.run_for(100 * MS).unwrap();
        rig.close(Can2).unwrap();
        assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
        assert!(rig.ledger.on_bus_count(Can2) > 5_500);
        assert_eq!(rig.ledger.losses(Can2).total(), 0);
        let stamps = rig.ledger.stamps();
        eprintln!("  the other channel's stamps {stamps:?}");
        assert!(stamps.max as f64 <= 1000.0 * latest_stamp_us(bound), "{bound}: {stamps:?}");
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn two_replays_at_once_keep_their_spacing() {
    for (bound, load, seconds) in [
        (Best, 10.0, 0.3),
        (Best, 30.0, 0.15),
        (Best, 60.0, 0.15),
        (Best, 90.0, 0.3),
        (Worst, 60.0, 0.15),
        (Worst, 98.0, 0.3),
    ] {
        let mut rig = joined_under(bound, &[Can1, Can2]);
        let replayed = replay(&mut rig, &[Can1, Can2], load, seconds).unwrap();
        hold_times(bound, &format!("both at {load} %"), replayed.as_deref(), REPLAY_WITHIN_US);
    }
}

/// Two emulated seconds, streamed: 17 500 frames, each sent once, in order, and confirmed with the time of its end.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_stream_of_eight_byte_frames_fills_the_bus() {
    let mut rig = joined(&[Can1]);
    let filled = fill(&mut rig, &[Can1], Kind::Std8, 2.0).unwrap().expect("all frames in order");
    eprintln!("{filled:?}");
    assert!(filled[0].load_percent >= 99.0 && filled[0].frames > 17_000, "{filled:?}");
    assert!(
        filled[0].stamps.min_us >= -0.1 && filled[0].stamps.max_us <= latest_stamp_us(common::bound()),
        "{filled:?}"
    );
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn two_streams_at_once_fill_both_buses() {
    for (bound, seconds) in [(Best, 0.2), (Worst, 0.1)] {
        let mut rig = joined_under(bound, &[Can1, Can2]);
        let filled =
            fill(&mut rig, &[Can1, Can2], Kind::Std8, seconds).unwrap().expect("all frames in order");
        eprintln!("{bound}: {filled:?}");
        assert!(filled.iter().all(|one| one.load_percent >= 99.0), "{bound}: {filled:?}");
    }
}

/// The most frames and confirmations possible: 20 833 a second of each on each channel.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn two_streams_of_frames_without_data_fill_both_buses() {
    for (bound, seconds) in [(Best, 0.15), (Worst, 0.3)] {
        let mut rig = joined_under(bound, &[Can1, Can2]);
        let filled =
            fill(&mut rig, &[Can1, Can2], Kind::Std0, seconds).unwrap().expect("all frames in order");
        eprintln!("{bound}: {filled:?}");
        assert!(filled.iter().all(|one| one.load_percent >= 99.0), "{bound}: {filled:?}");
        assert!(filled.iter().all(|one| one.stamps.max_us <= latest_stamp_us(bound)), "{bound}: {filled:?}");
    }
}

/// A full record queue has no room for confirmations. Frames that are due then wait for room; an alarm that fired again and
/// again would keep USB from making room.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn timed_frames_that_cannot_be_confirmed_do_not_keep_the_host_out() {
    let mut rig = joined(&[Can1]);
    saturate(&mut rig, Can2, 1_150);
    let now = rig.now() - rig.clock_origin();
    let at = |n: u64| Some((now + 1_050 * MS) / 12 + n * 12_000);
    let frames: Vec<TxFrame> = (0..64)
        .map(|n| TxFrame { tag: n, frame: "123#55".parse().unwrap(), at_ticks: at(n.into()) })
        .collect();
    for frames in frames.chunks(MAX_SEND) {
        rig.ask(Command::Send { channel: Can1, frames: frames.iter().copied().collect() }).unwrap();
    }
    rig.with_host(|host, _| host.read(false));
    rig.run_for(1_130 * MS).unwrap();
    rig.with_host(|host, _| host.read(true));
    rig.run_for(300 * MS).unwrap();
    let confirmed =
        rig.events().iter().filter(|(_, event)| matches!(event, Event::Transmitted { .. })).count();
    assert_eq!(confirmed, frames.len());
    for channel in Channel::ALL {
        rig.close(channel).unwrap();
    }
    assert!(rig.ledger.losses(Can2).queue > 1_000, "{:?}", rig.ledger.losses(Can2));
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
}
