//! The product's claim: both channels saturated at 1 Mbit/s, and every frame arrives, in order and bit for
//! bit; and if the host stops reading for longer than the queue lasts, every lost frame is counted.

use crate::common;

use std::time::Duration;

use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::rig::{MS, Rig, timing};
use cantap_sim::run::{Load, Options, Report, run};
use cantap_wire::Channel;
use cantap_wire::message::ChannelConfig;

/// Runs the firmware; the law of counting must hold.
fn capture(options: &Options) -> Report {
    let (report, _) = run(common::firmware(), options).unwrap();
    println!("{}", report.to_json());
    assert!(report.ok, "{:?}", report.faults);
    report
}

fn at_full_load(kind: Kind, seconds: f64) -> Options {
    let load = Load::Frames { kind, percent: 100.0 };
    Options { seconds, load, bound: common::bound(), ..Options::default() }
}

/// Both channels at full load lose nothing, and stamps are at most 0.6 us late; with a core that waits as long as possible, 1.
fn nothing_is_lost(options: &Options, least_frames_per_s: f64) -> Report {
    let report = capture(options);
    assert_eq!(report.channels.len(), 2);
    for channel in &report.channels {
        assert_eq!((channel.delivered, channel.lost.total()), (channel.sent, 0));
        assert!(channel.frames_per_s >= least_frames_per_s, "{channel:?}");
        assert!(channel.bus_load_pct > 99.5, "{channel:?}");
    }
    let latest_ns = if report.bound == Bound::Best { 600 } else { 1000 };
    assert!(report.stamps.max <= latest_ns, "{:?}", report.stamps);
    report
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn two_seconds_of_the_shortest_data_frames_on_both_channels_lose_nothing() {
    let report = nothing_is_lost(&at_full_load(Kind::Std0, 2.0), 20_800.0);
    assert!(report.bound == Bound::Worst || report.cpu_load_pct <= 25.0, "{} %", report.cpu_load_pct);
}

/// During the capture of a full channel, with everything as slow as the manuals allow.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_queue_that_has_filled_drains_at_a_megabyte_a_second() {
    let setup = Setup { bound: Bound::Worst, ..board::setup() };
    let mut rig = Rig::new(common::firmware(), setup, Timing::hasty(CLOCK));
    rig.connect().unwrap();
    rig.listen(Channel::Can1, 1_000_000).unwrap();
    let from = rig.now();
    rig.add_traffic(Channel::Can1, 1_000_000, Traffic::new(Kind::Std0, 1, 100.0, from, from + 700 * MS));
    rig.with_host(|host, _| host.read(false));
    rig.run_for(600 * MS).unwrap();
    rig.with_host(|host, _| host.read(true));
    let bytes = |rig: &mut Rig| rig.with_host(|host, _| host.counters().in_bytes);
    let before = bytes(&mut rig);
    rig.run_for(50 * MS).unwrap();
    let drained = bytes(&mut rig) - before;
    eprintln!("{drained} bytes in 50 ms");
    assert!(drained >= 50_000, "{drained} bytes in 50 ms");
    rig.close(Channel::Can1).unwrap();
    assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
    assert_eq!(rig.ledger.losses(Channel::Can1).total(), 0);
}

/// The same with everything as slow as the manuals allow.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_shortest_frames_lose_nothing_at_worst() {
    for (kind, least_frames_per_s) in [(Kind::Std0, 20_800.0), (Kind::Rtr, 21_250.0)] {
        nothing_is_lost(&Options { bound: Bound::Worst, ..at_full_load(kind, 0.2) }, least_frames_per_s);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn remote_frames_of_47_bits_lose_nothing() {
    nothing_is_lost(&at_full_load(Kind::Rtr, 0.3), 21_250.0);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn extended_frames_with_eight_bytes_lose_nothing() {
    nothing_is_lost(&at_full_load(Kind::Ext8, 0.5), 6_200.0);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn standard_frames_with_eight_bytes_lose_nothing() {
    nothing_is_lost(&at_full_load(Kind::Std8, 0.3), 7_400.0);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_mix_of_everything_loses_nothing() {
    nothing_is_lost(&at_full_load(Kind::Mix, 0.5), 8_000.0);
}

/// The earlier analyser's table of the load it could carry without loss, 7.7 to 12.8 % over RS-232. Ours: all of it, on
/// two channels. "No stamp" is what its users could leave out to save bandwidth.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn each_row_of_the_earlier_analysers_table_is_carried_at_full_load() {
    const MEGABIT: u32 = 1_000_000;
    for (kind, omit_stamps) in [
        (Kind::Std0, true),
        (Kind::Std0, false),
        (Kind::Std8, false),
        (Kind::Ext0, true),
        (Kind::Ext0, false),
        (Kind::Ext8, false),
    ] {
        let image = common::firmware();
        let mut rig = Rig::new(image, common::setup(), Timing::hasty(CLOCK));
        rig.connect().unwrap();
        let listen = ChannelConfig::listen_only(timing(MEGABIT).unwrap());
        let from = rig.now() + 2 * MS;
        for channel in Channel::ALL {
            rig.open(channel, ChannelConfig { omit_stamps, ..listen }).unwrap();
            let traffic = Traffic::new(kind, channel.index() as u64, 100.0, from, from + 100 * MS);
            rig.add_traffic(channel, MEGABIT, traffic);
        }
        rig.run_for(105 * MS).unwrap();
        for channel in Channel::ALL {
            rig.close(channel).unwrap();
            // 100 ms of back-to-back bits, except for the frame cut off by the end of the traffic.
            assert!(
                (99_800..=100_200).contains(&rig.bus_bits(channel)),
                "{kind:?}: {}",
                rig.bus_bits(channel)
            );
            assert_eq!(rig.ledger.delivered_count(channel), rig.ledger.on_bus_count(channel));
        }
        assert!(rig.ledger.holds(), "{kind:?}: {:?}", rig.ledger.faults());
    }
}

/// The queue holds 96 KiB: at 5 bytes and 48 us for each frame of the worst kind on one channel, 0.9 s.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_host_that_stalls_for_100_300_or_600_ms_costs_nothing_on_one_channel() {
    for millis in [100, 300, 600] {
        let options = Options {
            stall: Some(Duration::from_millis(millis)),
            channels: vec![Channel::Can1],
            ..at_full_load(Kind::Std0, millis as f64 / 1000.0 + 0.15)
        };
        let report = capture(&options);
        assert_eq!(report.channels[0].lost.total(), 0);
        assert!(report.queue_high_water_bytes <= report.queue_bytes);
        // What the stall left in the queue, minus what was flushed just before it.
        let least = 20_833.0 * 4.5 * millis as f64 / 1000.0;
        assert!(f64::from(report.queue_high_water_bytes) > least, "{report:?}");
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_stall_beyond_the_queue_loses_frames_and_counts_every_one() {
    let options = Options { stall: Some(Duration::from_millis(700)), ..at_full_load(Kind::Std0, 0.9) };
    let report = capture(&options);
    for channel in &report.channels {
        assert!(channel.lost.queue > 1000, "{channel:?}");
        assert_eq!((channel.lost.controller, channel.lost.link), (0, 0));
        assert_eq!(channel.sent, channel.delivered + channel.lost.queue);
    }
}

/// One channel fills the queue in 0.94 s.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_stall_of_more_than_a_second_on_one_channel_loses_what_does_not_fit_and_counts_it() {
    let options = Options {
        stall: Some(Duration::from_millis(1200)),
        channels: vec![Channel::Can1],
        ..at_full_load(Kind::Std0, 1.4)
    };
    let report = capture(&options);
    let channel = &report.channels[0];
    // A quarter of a second of frames, 48 us each.
    assert!((4_500..7_500).contains(&channel.lost.queue), "{channel:?}");
    assert_eq!((channel.lost.controller, channel.lost.link), (0, 0));
    assert_eq!(channel.sent, channel.delivered + channel.lost.queue);
    assert!(report.queue_high_water_bytes <= report.queue_bytes);
}

/// 2 packets of 64 bytes in a frame are 128 kB/s; two channels of this kind make 230 kB/s.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_host_that_is_too_slow_fills_the_queue_and_then_catches_up() {
    let mut options = at_full_load(Kind::Ext8, 0.6);
    options.timing.packets_per_frame = 2;
    let report = capture(&options);
    assert!(report.queue_high_water_bytes > 40_000, "{report:?}");
    assert!(report.channels.iter().all(|channel| channel.lost.total() == 0), "{report:?}");
}

/// Behind a high-speed hub a packet in every second microframe is 256 kB/s: both channels full of the shortest frames make 215.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_host_behind_a_high_speed_hub_carries_both_channels() {
    let mut options = at_full_load(Kind::Std0, 0.3);
    options.timing = options.timing.behind_hub(2);
    let report = capture(&options);
    assert!(report.channels.iter().all(|channel| channel.lost.total() == 0), "{report:?}");
    // A host without a hub leaves no more than a batch in the queue; at 130 kB/s, a queue that only filled would hold 25 kB.
    assert!(report.queue_high_water_bytes < 10_000, "{report:?}");
}

/// The same seed gives the same run, a different seed a different one.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_run_depends_on_its_seed_only() {
    let figures = |seed| {
        let options = Options { seed, ..at_full_load(Kind::Mix, 0.05) };
        let report = capture(&options);
        let mut json = report.to_json();
        json["host_s_per_emulated_s"] = 0.into();
        json
    };
    let first = figures(7);
    assert_eq!(first, figures(7));
    assert_ne!(first, figures(8));
}

/// Wherever in a frame its channel is asked to leave its bus, the frame is delivered with the stamp of its interrupt.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_last_frame_before_a_channel_leaves_its_bus_has_an_exact_stamp() {
    for kind in [Kind::Std0, Kind::Std8] {
        let mut rig = Rig::new(common::firmware(), common::setup(), Timing::hasty(CLOCK));
        for channel in Channel::ALL {
            rig.add_traffic(
                channel,
                1_000_000,
                Traffic::new(kind, channel.index() as u64, 100.0, 0, u64::MAX),
            );
        }
        rig.connect().unwrap();
        for round in 0..40 {
            for channel in Channel::ALL {
                rig.listen(channel, 1_000_000).unwrap();
            }
            rig.run_for(2 * MS + round * (MS / 300)).unwrap();
            for channel in Channel::ALL {
                rig.close(channel).unwrap();
            }
        }
        assert!(rig.ledger.holds(), "{:?}", rig.ledger.faults());
        let stamps = rig.ledger.stamps();
        println!("{stamps:?}");
        assert_eq!(stamps.bounds, 0, "{kind:?}: {stamps:?}");
        assert!(stamps.max <= 1000, "{kind:?}: {stamps:?}");
    }
}
