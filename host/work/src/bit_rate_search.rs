//! Finds the bit rate of a channel's bus by listening: the one found before, if frames confirm it, otherwise by measuring.
//!
//! Nothing is sent and nothing acknowledged. What is believed has been seen: a remembered rate counts only after the controller received whole
//! frames at it.

use std::time::Duration;

use cantap::autobaud::{self, Limits, Outcome, Progress};
use cantap::wire::message::{ChannelConfig, capability};
use cantap::{Channel, Device, DeviceError};
use cantap_address::Address;
use cantap_trace::counted;

use crate::remembered_rates::RememberedRates;

/// Good frames that confirm a remembered bit rate: each has passed its CRC.
const GOOD_FRAMES: u32 = 2;
/// This many bus errors without a frame contradict it.
const MOST_ERRORS: u32 = 4;
/// How long to wait for either, by the device's clock; then the bus is measured, which takes any bit rate.
const CONFIRM_WITHIN: Duration = Duration::from_millis(500);
/// How often to ask the device.
const ASK_EVERY: Duration = Duration::from_millis(2);

/// How a search ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Search {
    /// The bus runs at the bit rate that was found on this channel before, in bit/s.
    Confirmed {
        /// In bit/s.
        bitrate_bps: u32,
    },
    /// It was measured.
    Measured(Outcome),
}

impl Search {
    /// The bit rate, in bit/s, if it was found.
    pub const fn bitrate_bps(&self) -> Option<u32> {
        match *self {
            Self::Confirmed { bitrate_bps } | Self::Measured(Outcome::Found { bitrate_bps, .. }) => {
                Some(bitrate_bps)
            }
            Self::Measured(_) => None,
        }
    }
}

/// Whether a device can find bit rates: other makers' adapters do not report the edges of their receive pin.
pub fn is_possible(device: &Device) -> bool {
    device.hello().capabilities & capability::EDGES != 0
}

/// Finds the bit rate of a closed channel's bus, and remembers it for the next time. `progress` is called repeatedly and ends the search by
/// returning false. The channel is closed afterwards, and the frames received on the way are not among the device's
/// records.
pub fn search(
    device: &Device,
    channel: Channel,
    limits: &Limits,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Search, DeviceError> {
    search_with(device, channel, limits, &remembered(device), progress)
}

fn search_with(
    device: &Device,
    channel: Channel,
    limits: &Limits,
    remembered: &RememberedRates,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Search, DeviceError> {
    let before = remembered.get(device.hello().serial.as_str(), channel);
    let check = match before {
        Some(bitrate_bps) => confirm(device, channel, bitrate_bps, progress)?,
        None => Check::Open,
    };
    let found = match (check, before) {
        (Check::Holds, Some(bitrate_bps)) => Search::Confirmed { bitrate_bps },
        (Check::Stopped, _) => Search::Measured(Outcome::Stopped),
        _ => Search::Measured(measure_with(device, channel, limits, remembered, progress)?),
    };
    discard_records(device)?;
    Ok(found)
}

/// Measures the bit rate, whatever it was before, and remembers it.
pub fn measure(
    device: &Device,
    channel: Channel,
    limits: &Limits,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Outcome, DeviceError> {
    measure_with(device, channel, limits, &remembered(device), progress)
}

fn measure_with(
    device: &Device,
    channel: Channel,
    limits: &Limits,
    remembered: &RememberedRates,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Outcome, DeviceError> {
    let outcome = autobaud::search(device, channel, limits, progress)?;
    if let Outcome::Found { bitrate_bps, .. } = outcome {
        remembered.set(device.hello().serial.as_str(), channel, bitrate_bps);
    }
    Ok(outcome)
}

/// What was found on a device's buses before. A device that is part of this program has another bus each time.
fn remembered(device: &Device) -> RememberedRates {
    if Address::is_no_port(device.name()) { RememberedRates::none() } else { RememberedRates::of_user() }
}

/// What frames say about a remembered bit rate.
enum Check {
    /// The bus runs at it.
    Holds,
    /// It does not, or nothing shows it in a short time.
    Open,
    /// The caller asked to stop.
    Stopped,
}

/// Whether the bus runs at this bit rate, as far as frames show it in a short time.
fn confirm(
    device: &Device,
    channel: Channel,
    bitrate_bps: u32,
    progress: &mut dyn FnMut(Progress) -> bool,
) -> Result<Check, DeviceError> {
    // One that another firmware could reach is as good as none.
    let Ok(timing) = device.timing(bitrate_bps) else { return Ok(Check::Open) };
    let index = channel.index();
    let before = device.status()?.channels[index];
    device.open_channel(channel, Some(ChannelConfig::listen_only(timing)))?;
    let watched = (|| {
        let within = (CONFIRM_WITHIN.as_secs_f64() * f64::from(device.hello().tick_hz)) as u64;
        let opened = device.time()?;
        loop {
            let status = device.status()?;
            let now = status.channels[index];
            let frames = now.frames.wrapping_sub(before.frames);
            let errors = now.bus_errors.wrapping_sub(before.bus_errors);
            if frames >= GOOD_FRAMES {
                return Ok(Check::Holds);
            }
            let is_late = status.ticks.saturating_sub(opened) > within;
            if is_late || frames == 0 && errors >= MOST_ERRORS {
                return Ok(Check::Open);
            }
            if !progress(Progress::Confirming { bitrate_bps, frames }) {
                return Ok(Check::Stopped);
            }
            std::thread::sleep(ASK_EVERY);
        }
    })();
    let closed = device.close_channel(channel);
    watched.and_then(|check| closed.map(|()| check))
}

/// Forgets what was received during the search: nobody asked for it, and errors at a bit rate that did not hold were not
/// on the bus. What another channel captures meanwhile is kept, and these then are kept with it.
fn discard_records(device: &Device) -> Result<(), DeviceError> {
    if !device.open_channels().is_empty() {
        return Ok(());
    }
    let mut records = device.records();
    // Closing a channel has waited for all of them.
    while records.next_batch(Duration::ZERO)?.is_some_and(|batch| !batch.is_empty()) {}
    Ok(())
}

/// Why no bit rate was found, and what to do. `number` is the channel's for the user, and `seconds` how long the search took.
pub fn failure(outcome: Outcome, number: u8, seconds: f64) -> String {
    match outcome {
        Outcome::NoTraffic => format!(
            "no traffic on channel {number} in {seconds:.1} s; check the wiring, and that the bus is awake and has two nodes"
        ),
        Outcome::Stuck => format!(
            "the bus on channel {number} is dominant all the time; look for a short circuit, swapped wires or a transceiver \
             without supply"
        ),
        Outcome::Unreadable { edges } => format!(
            "there is traffic on channel {number} ({edges} edges), but not one whole frame: is it classical CAN, are the wires \
             swapped, is the termination right?"
        ),
        Outcome::Unreachable { measured_bps, nearest_bps } => {
            let nearest = nearest_bps.map_or_else(String::new, |nearest_bps| {
                let off = (f64::from(nearest_bps) / measured_bps - 1.0) * 100.0;
                format!("; the nearest, {nearest_bps} bit/s, is {off:+.1} % off and would lose frames")
            });
            format!(
                "the bus on channel {number} runs at {measured_bps:.0} bit/s, and no rate that the device's clock reaches is near \
                 enough{nearest}"
            )
        }
        Outcome::Unconfirmed { bitrate_bps, measured_bps, acknowledged, errors } => {
            let why = if !acknowledged {
                "nobody acknowledges what is sent: is there a second node, and does it run at the same bit rate?"
            } else if errors > 0 {
                "check termination and wiring"
            } else {
                "try again when there is more traffic"
            };
            format!(
                "a bit on channel {number} is one of {bitrate_bps} bit/s (measured: {measured_bps:.0}), but no good frame followed, and \
                 {errors}; {why}",
                errors = counted(errors, "error")
            )
        }
        Outcome::Stopped | Outcome::Found { .. } => "stopped before a bit rate was found".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_failure_says_what_was_found_and_what_to_do() {
        let told = |outcome| failure(outcome, 2, 10.04);
        assert_eq!(
            told(Outcome::Unreachable { measured_bps: 615_384.3, nearest_bps: Some(600_000) }),
            "the bus on channel 2 runs at 615384 bit/s, and no rate that the device's clock reaches is near enough; the nearest, \
             600000 bit/s, is -2.5 % off and would lose frames"
        );
        assert!(told(Outcome::NoTraffic).starts_with("no traffic on channel 2 in 10.0 s; check the wiring"));
        assert!(told(Outcome::Stuck).contains("short circuit"));
        assert!(told(Outcome::Unreadable { edges: 7 }).contains("(7 edges)"));
        let unconfirmed = |acknowledged, errors| {
            told(Outcome::Unconfirmed { bitrate_bps: 500_000, measured_bps: 499_990.0, acknowledged, errors })
        };
        assert!(unconfirmed(false, 12).ends_with("does it run at the same bit rate?"));
        assert!(unconfirmed(true, 12).ends_with("check termination and wiring"));
        assert!(unconfirmed(true, 0).ends_with("when there is more traffic"));
    }

    /// A search that was stopped while it listened at the remembered bit rate began to measure.
    #[test]
    fn a_search_can_be_stopped_while_it_confirms_what_it_remembers() {
        let folder = tempfile::tempdir().unwrap();
        let rates = RememberedRates::at(folder.path().join("rates.json"));
        let device = "virtual:load=0,serial=A".parse::<Address>().unwrap().open().unwrap();
        rates.set("A", Channel::Can1, 500_000);
        let mut seen = Vec::new();
        let mut stop = |progress| {
            seen.push(progress);
            false
        };
        let found = search_with(&device, Channel::Can1, &Limits::default(), &rates, &mut stop).unwrap();
        assert_eq!(found, Search::Measured(Outcome::Stopped));
        assert_eq!(seen, [Progress::Confirming { bitrate_bps: 500_000, frames: 0 }]);
    }

    /// Nothing is believed that frames do not confirm, and the next search begins with what was found.
    #[test]
    fn a_remembered_rate_that_does_not_hold_is_measured_anew() {
        let folder = tempfile::tempdir().unwrap();
        let rates = RememberedRates::at(folder.path().join("rates.json"));
        let device = "virtual:bitrate=125k,serial=A".parse::<Address>().unwrap().open().unwrap();
        rates.set("A", Channel::Can1, 500_000);
        let search =
            || search_with(&device, Channel::Can1, &Limits::default(), &rates, &mut |_| true).unwrap();
        let found = search();
        assert!(matches!(found, Search::Measured(_)) && found.bitrate_bps() == Some(125_000), "{found:?}");
        assert_eq!(rates.get("A", Channel::Can1), Some(125_000));
        assert_eq!(search(), Search::Confirmed { bitrate_bps: 125_000 });
        // A rate that the clock does not reach is as good as none.
        rates.set("A", Channel::Can1, 499_999);
        assert_eq!(search().bitrate_bps(), Some(125_000));
    }
}
