//! The search for a bit rate with the firmware's ELF: correct, fast, silent, harmless to the other channel, and able to distinguish
//! silence and noise.
#![cfg(feature = "emu")]

use crate::common;

use std::path::Path;
use std::sync::PoisonError;
use std::time::Duration;

use cantap::autobaud::{COMMON_BPS, Limits, Outcome, search};
use cantap::device::Link;
use cantap::wire::message::ChannelConfig;
use cantap::{Channel, Device};
use cantap_sim::address::Address;

const TICK_HZ: f64 = 12e6;

/// The result of a search, and how many seconds of the device's time it took.
struct Found {
    outcome: Outcome,
    seconds: f64,
}

impl Found {
    /// The bit rate, or `None` if there is none.
    fn bitrate_bps(&self) -> Option<u32> {
        match self.outcome {
            Outcome::Found { bitrate_bps, .. } => Some(bitrate_bps),
            _ => None,
        }
    }
}

/// Searches on a bus; nothing may be driven on it meanwhile, neither an acknowledgement nor an error flag. With `beside`, the other channel
/// captures at that bit rate, and must not miss a frame.
fn search_beside(channel: Channel, options: &str, silence: Duration, beside: Option<u32>) -> Found {
    search_of(&common::elf(), channel, options, silence, beside)
}

/// The same with a board's firmware.
fn search_of(elf: &Path, channel: Channel, options: &str, silence: Duration, beside: Option<u32>) -> Found {
    let address: Address = format!("{},{options}", elf.display()).parse().unwrap();
    let port = address.open().unwrap();
    let witness = port.device.witness();
    let link = Link::new(port.reader, port.writer).keeping(port.device);
    let device = Device::over(link, options).unwrap();
    let other = Channel::ALL[1 - channel.index()];
    if let Some(bitrate_bps) = beside {
        let config = ChannelConfig::listen_only(device.timing(bitrate_bps).unwrap());
        device.open_channel(other, Some(config)).unwrap();
    }
    let begin = device.time().unwrap();
    let outcome = search(&device, channel, &Limits { silence }, &mut |_| true).unwrap();
    let ticks = device.time().unwrap() - begin;
    let status = device.status().unwrap();
    assert!(status.channels[channel.index()].open.is_none());
    if beside.is_some() {
        let other = status.channels[other.index()];
        assert!(other.frames > 500, "{options}: {other:?}");
        assert_eq!((other.lost_controller, other.lost_queue, other.bus_errors), (0, 0, 0), "{options}");
    }
    drop(device);
    let witness = witness.lock().unwrap_or_else(PoisonError::into_inner);
    assert_eq!(witness.dominant_bits, [0, 0], "{options}: not one dominant bit");
    Found { outcome, seconds: ticks as f64 / TICK_HZ }
}

fn search_on(channel: Channel, options: &str) -> Found {
    search_beside(channel, options, Duration::from_millis(1200), None)
}

/// Each board has its receive pins in different places, which its firmware knows.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn every_board_hears_both_of_its_buses() {
    for (name, ..) in common::boards() {
        let elf = common::elf().with_file_name(format!("cantap-{name}.elf"));
        for channel in Channel::ALL {
            let options = "bitrate=125k,burst=1/20ms,speed=0.25";
            let found = search_of(&elf, channel, options, Duration::from_millis(1200), None);
            assert_eq!(found.bitrate_bps(), Some(125_000), "{name}, {channel:?}: {:?}", found.outcome);
        }
    }
}

/// Every CiA rate and the others in common use, with frames twenty milliseconds apart. The emulation is slowed down so
/// that a busy machine does not act as a slow host.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn fifty_frames_a_second_are_enough_to_find_any_common_rate_within_a_second() {
    let mut longest: f64 = 0.0;
    for (at, bitrate) in COMMON_BPS.into_iter().enumerate() {
        let channel = Channel::ALL[at % 2];
        let found = search_on(channel, &format!("bitrate={bitrate},burst=1/20ms,speed=0.25"));
        assert_eq!(found.bitrate_bps(), Some(bitrate), "{bitrate}: {:?}", found.outcome);
        longest = longest.max(found.seconds);
    }
    eprintln!("found after {longest:.3} s at most");
    assert!(longest < 1.0, "{longest} s");
}

/// One second, or two frames. It once found none of these while it guessed. The emulation is slowed down so that a busy machine does
/// not act as a slow host.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_bus_that_is_nearly_silent_is_found_in_little_more_than_a_second() {
    for (at, bitrate) in [500_000, 125_000, 1_000_000, 10_000].into_iter().enumerate() {
        for burst in ["3/1s", "1/500ms"] {
            let options = format!("bitrate={bitrate},burst={burst},speed=0.5");
            let found = search_on(Channel::ALL[at % 2], &options);
            assert_eq!(found.bitrate_bps(), Some(bitrate), "{bitrate}, {burst}: {:?}", found.outcome);
            // In addition to the second, what a host adds that is busy with other tests.
            assert!(found.seconds < 1.5, "{bitrate}, {burst}: {} s", found.seconds);
        }
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_busy_bus_is_found_whatever_its_frames_and_however_slow_the_memories() {
    for (at, bitrate) in COMMON_BPS.into_iter().enumerate() {
        let (kind, load) = (["mix", "std0", "ext8", "rtr", "std8"][at % 5], [50, 100, 90][at % 3]);
        let (channel, timing) = (Channel::ALL[at % 2], ["worst", "best"][at / 2 % 2]);
        let options = format!("bitrate={bitrate},load={load},frames={kind},timing={timing}");
        let found = search_on(channel, &options);
        assert_eq!(found.bitrate_bps(), Some(bitrate), "{options}: {:?}", found.outcome);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_third_of_the_frames_destroyed_hinders_nothing() {
    for seed in 1..=6 {
        let bitrate = [500_000, 1_000_000, 250_000][seed % 3];
        let options = format!("bitrate={bitrate},load=40,errors=30,seed={seed}");
        let found = search_on(Channel::ALL[seed % 2], &options);
        assert_eq!(found.bitrate_bps(), Some(bitrate), "{options}: {:?}", found.outcome);
    }
}

/// The measurement runs below capture, which interrupts it: at 1 Mbit/s some frames are lost to it, and none to capture.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_full_channel_beside_it_loses_nothing_and_hinders_nothing() {
    for timing in ["best", "worst"] {
        for channel in Channel::ALL {
            let options = format!("bitrate=1M,load=100,frames=std0,timing={timing}");
            let found = search_beside(channel, &options, Duration::from_secs(1), Some(1_000_000));
            assert_eq!(found.bitrate_bps(), Some(1_000_000), "{options}: {:?}", found.outcome);
        }
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn odd_rates_are_named_right() {
    for (at, bitrate) in
        [33_333, 47_619, 83_333, 200_000, 307_692, 333_333, 400_000, 480_000, 666_667].into_iter().enumerate()
    {
        let found = search_on(Channel::ALL[at % 2], &format!("bitrate={bitrate},load=60"));
        assert_eq!(found.bitrate_bps(), Some(bitrate), "{:?}", found.outcome);
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_rate_that_the_clock_does_not_reach_is_named_and_is_no_success() {
    // 36 MHz / 58.5, 16 MHz / 63 and / 65.
    for (at, bitrate) in [615_384, 253_968, 246_154].into_iter().enumerate() {
        let found = search_on(Channel::ALL[at % 2], &format!("bitrate={bitrate},load=60"));
        let Outcome::Unreachable { measured_bps, .. } = found.outcome else {
            panic!("{bitrate}: {:?}", found.outcome)
        };
        let off = (measured_bps / f64::from(bitrate) - 1.0).abs();
        assert!(off < 0.001, "{bitrate}: {measured_bps}");
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn silence_destroyed_frames_and_a_sender_without_an_audience_are_told_apart() {
    let within = |options| search_beside(Channel::Can2, options, Duration::from_millis(400), None).outcome;
    assert_eq!(within("load=0"), Outcome::NoTraffic);
    let outcome = within("bitrate=500k,load=80,errors=100");
    // What remains of such frames may be enough for a guess, which the controller then does not confirm.
    assert!(
        matches!(
            outcome,
            Outcome::Unreadable { edges: 100.. }
                | Outcome::Unconfirmed { bitrate_bps: 500_000, errors: 1.., .. }
        ),
        "{outcome:?}"
    );
    let outcome = within("bitrate=250k,load=20,ack=no");
    assert!(
        matches!(
            outcome,
            Outcome::Unconfirmed { bitrate_bps: 250_000, acknowledged: false, .. }
                | Outcome::Found { bitrate_bps: 250_000, .. }
        ),
        "{outcome:?}"
    );
}
