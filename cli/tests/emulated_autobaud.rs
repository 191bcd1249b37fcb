//! The search for a bit rate on the firmware's ELF: right, silent, and told apart from silence and noise.
#![cfg(feature = "emu")]

#[path = "../../sim/tests/common/mod.rs"]
mod common;

use std::sync::PoisonError;
use std::time::Duration;

use cantap::autobaud::{COMMON_BPS, Limits, Outcome, search};
use cantap::device::Link;
use cantap::{Channel, Device};
use cantap_sim::address::Address;

const TICK_HZ: f64 = 12e6;

/// What a search said, and how many seconds of the device's time it took.
struct Found {
    outcome: Outcome,
    seconds: f64,
}

impl Found {
    /// The bit rate, or nothing where no rate fits.
    fn bitrate_bps(&self) -> Option<u32> {
        match self.outcome {
            Outcome::Found { bitrate_bps, .. } => Some(bitrate_bps),
            _ => None,
        }
    }
}

/// Searches on a bus; nothing may be driven on it meanwhile, neither an acknowledgement nor an error flag.
fn search_on(channel: Channel, options: &str) -> Found {
    let address: Address = format!("{},{options}", common::elf().display()).parse().unwrap();
    let port = address.open().unwrap();
    let witness = port.device.witness();
    let link = Link::new(port.reader, port.writer).keeping(port.device);
    let device = Device::over(link, options).unwrap();
    let limits = Limits { silence: Duration::from_millis(500), ..Limits::default() };
    let begin = device.time().unwrap();
    let outcome = search(&device, channel, &limits, &mut |_| true).unwrap();
    let ticks = device.time().unwrap() - begin;
    assert!(device.status().unwrap().channels.iter().all(|channel| channel.open.is_none()));
    drop(device);
    let witness = witness.lock().unwrap_or_else(PoisonError::into_inner);
    assert_eq!(witness.dominant_bits, [0, 0], "{options}: not one dominant bit");
    Found { outcome, seconds: ticks as f64 / TICK_HZ }
}

/// Every rate of CiA's and the others in common use, each frame twenty milliseconds after the one before. The emulation is
/// slowed down so that a busy machine is no busy host.
#[test]
#[cfg_attr(not(cantap_elf), ignore = "no ELF in CANTAP_FIRMWARE_ELF")]
fn fifty_frames_a_second_are_enough_to_find_any_common_rate_within_a_second() {
    let mut longest: f64 = 0.0;
    for bitrate in COMMON_BPS {
        let found = search_on(Channel::Can1, &format!("bitrate={bitrate},burst=1/20ms,speed=0.25"));
        assert_eq!(found.bitrate_bps(), Some(bitrate), "{bitrate}: {:?}", found.outcome);
        longest = longest.max(found.seconds);
    }
    eprintln!("found after {longest:.3} s at most");
    assert!(longest < 1.0, "{longest} s");
}

#[test]
#[cfg_attr(not(cantap_elf), ignore = "no ELF in CANTAP_FIRMWARE_ELF")]
fn a_busy_bus_is_found_whatever_its_frames() {
    for (at, bitrate) in COMMON_BPS.into_iter().enumerate() {
        let (kind, load) = (["mix", "std0", "ext8", "rtr", "std8"][at % 5], [50, 100, 90][at % 3]);
        let channel = Channel::ALL[at % 2];
        let found = search_on(channel, &format!("bitrate={bitrate},load={load},frames={kind}"));
        assert_eq!(found.bitrate_bps(), Some(bitrate), "{bitrate}, {kind}: {:?}", found.outcome);
    }
}

/// The nearest rate that the clock of 36 MHz reaches is said, where it is near enough to receive every frame.
#[test]
#[cfg_attr(not(cantap_elf), ignore = "no ELF in CANTAP_FIRMWARE_ELF")]
fn an_odd_rate_is_found_by_its_nearest_reachable_one() {
    for (bitrate, expected) in [
        (47_619, 47_619),
        (200_000, 200_000),
        (307_692, 307_692),
        (333_333, 333_333),
        (400_000, 400_000),
        (480_000, 480_000),
        (666_667, 666_667),
        // 16 MHz / 63, which 250 kbit/s is 1.6 % from; 36 MHz / 141.
        (253_968, 255_319),
        // 16 MHz / 65; 36 MHz / 145.
        (246_154, 248_276),
    ] {
        let found = search_on(Channel::Can1, &format!("bitrate={bitrate},load=60"));
        let near = found.bitrate_bps().map(|bps| (f64::from(bps) / f64::from(expected) - 1.0).abs());
        // The clock has rates a quarter per cent apart down there, and the same frames are heard at each.
        let tolerance = if bitrate < 100_000 { 0.004 } else { 0.0 };
        assert!(near.is_some_and(|near| near <= tolerance), "{bitrate}: {:?}", found.outcome);
    }
}

#[test]
#[cfg_attr(not(cantap_elf), ignore = "no ELF in CANTAP_FIRMWARE_ELF")]
fn a_rate_between_reachable_ones_is_estimated_and_not_rounded() {
    // 36 MHz / 58.5; the clock reaches 600 and 631.6 kbit/s.
    let found = search_on(Channel::Can1, "bitrate=615384,load=60");
    let Outcome::NoMatch { about_bps: Some(about), errors: 1.. } = found.outcome else {
        panic!("{:?}", found.outcome)
    };
    assert!((600_000.0..640_000.0).contains(&about), "{about}");
}

#[test]
#[cfg_attr(not(cantap_elf), ignore = "no ELF in CANTAP_FIRMWARE_ELF")]
fn silence_and_traffic_that_fits_no_rate_are_told_apart() {
    let found = search_on(Channel::Can2, "load=0");
    assert_eq!(found.outcome, Outcome::NoTraffic);
    let found = search_on(Channel::Can2, "bitrate=500k,load=80,errors=100,speed=100");
    assert!(
        matches!(found.outcome, Outcome::NoMatch { errors: 1.., about_bps: None }),
        "{:?}",
        found.outcome
    );
}
