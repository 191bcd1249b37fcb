//! The options after `virtual:`.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};
use cantap_wire::{CHANNELS, Frame};

use crate::nodes;
use crate::simbus::{FrameSource, Frames, Schedule, SimBus, Traffic};

/// The largest error of a crystal; a USB host's frames have the same limit (USB 2.0, 7.1.12: 500 ppm).
const MOST_PPM: f64 = 500.0;
/// The maximum length of a serial number.
const MAX_SERIAL_BYTES: usize = 24;

/// Options that a car on the bus excludes.
const MADE_UP: [&str; 5] = ["load", "frames", "bitrate", "burst", "wire"];
/// Options that CANopen nodes and the ECU exclude; they work at any bit rate.
const MADE_UP_FRAMES: [&str; 3] = ["load", "frames", "burst"];

/// How model time passes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pace {
    /// With the wall clock.
    #[default]
    RealTime,
    /// As fast as the host reads.
    Fast,
}

/// The simulated buses, their traffic, and the pace.
///
/// As text: `load=50,frames=std8,bitrate=500k,seed=7`. Keys: `car` (a vehicle in place of made-up frames: see [`crate::car`]), `canopen` (CANopen
/// nodes on the first bus: see [`crate::canopen`]), `ecu` (an ECU with XCP and CCP on the first bus: see [`crate::ecu`]), `load` (per cent), `frames` (`std0` `std8` `ext0` `ext8` `rtr` `mix`), `bitrate` (by default that
/// with which the channel is opened), `burst` (`10/960us`: frames in a burst, and its period), `errors` (per cent of the frames destroyed), `disturb`
/// (the number of frames destroyed on each bus, the first ones that the device sends), `ack` (`yes`, `no`), `seed`, `settings` (a file that keeps
/// what the device saves), `serial` (its serial number), `ppm` (how much too fast its crystal is, in parts per million), `pace` (`real`, `fast`),
/// `wire` (`apart`: a bus for each channel; `joined`: one bus for both), `channels` (`1`, `2` or `both`: those with traffic), and at the end
/// `log=FILE` (a trace file, replayed with its own timing).
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Bus load in per cent, 0 to 100.
    pub load_percent: f64,
    /// Kind of frames.
    pub frames: Frames,
    /// The buses' bit rate in bit/s; `None` for that of the channel's configuration.
    pub bitrate_bps: Option<u32>,
    /// Number of frames in a burst and the bursts' period, instead of an even load.
    pub burst: Option<(u32, Duration)>,
    /// Percentage of the frames that are destroyed and sent again.
    pub error_percent: f64,
    /// How many of the device's frames are destroyed on each bus, starting with the first. 32 in a row make a
    /// channel bus-off.
    pub disturb: u32,
    /// Whether the simulated nodes acknowledge.
    pub acknowledge: bool,
    /// A file that keeps what the device saves, as flash does across a power cycle.
    pub settings: Option<PathBuf>,
    /// Selects the sequence of frames.
    pub seed: u64,
    /// How time passes.
    pub pace: Pace,
    /// Both channels on one bus.
    pub joined: bool,
    /// Which channels' buses have traffic.
    pub traffic_on: [bool; CHANNELS],
    /// How much faster the device's crystal runs than the computer's clock, in parts per million.
    pub crystal_ppm: f64,
    /// The device's serial number, at most 24 bytes.
    pub serial: String,
    /// A vehicle on the buses, at its own bit rates: see [`crate::car`].
    pub car: bool,
    /// CANopen nodes on the first bus: see [`crate::canopen`].
    pub canopen: bool,
    /// An ECU that is measured and calibrated, on the first bus: see [`crate::ecu`].
    pub ecu: bool,
    /// Frames to replay at their own times (nanoseconds since the start) instead of made-up ones, per channel.
    pub log: Option<[Vec<(u64, Frame)>; CHANNELS]>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            load_percent: 50.0,
            frames: Frames::Mix,
            bitrate_bps: None,
            burst: None,
            error_percent: 0.0,
            disturb: 0,
            acknowledge: true,
            settings: None,
            seed: 1,
            pace: Pace::RealTime,
            joined: false,
            traffic_on: [true; CHANNELS],
            crystal_ppm: 0.0,
            serial: "VIRTUAL".to_owned(),
            car: false,
            canopen: false,
            ecu: false,
            log: None,
        }
    }
}

/// Why options cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BadOption {
    /// There is no such key.
    #[error(
        "there is no option '{0}'; there are car, canopen, ecu, load, frames, bitrate, burst, errors, disturb, ack, seed, settings, serial, ppm, pace, wire, channels, log"
    )]
    Unknown(String),
    /// The value is invalid.
    #[error("'{value}' does not fit the option '{key}': {reason}")]
    Value {
        /// The option.
        key: String,
        /// Its value.
        value: String,
        /// What would be valid.
        reason: String,
    },
}

impl FromStr for Options {
    type Err = BadOption;

    /// An empty text means the defaults.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let mut options = Self::default();
        let mut given = Vec::new();
        // A file's name may contain commas: it extends to the end.
        let (text, log) = match text.strip_prefix("log=") {
            Some(file) => ("", Some(file)),
            None => text.split_once(",log=").map_or((text, None), |(text, file)| (text, Some(file))),
        };
        if let Some(file) = log {
            options.read_log(Path::new(file))?;
        }
        for option in text.split(',').filter(|option| !option.is_empty()) {
            let (key, value) = option.split_once('=').unwrap_or((option, ""));
            options.set(key, value)?;
            given.push((key, option));
        }
        let (key, excluded, reason) = match (options.car, options.canopen, options.ecu) {
            (false, false, false) => return Ok(options),
            (true, ..) => {
                ("car", &MADE_UP[..], "the car has its own traffic and bit rates; leave out one of the two")
            }
            (false, true, _) => {
                ("canopen", &MADE_UP_FRAMES[..], "the nodes have their own traffic; leave out one of the two")
            }
            (false, false, true) => {
                ("ecu", &MADE_UP_FRAMES[..], "the ECU has its own traffic; leave out one of the two")
            }
        };
        // Of these, only one.
        let nodes = ["car", "canopen", "ecu"];
        let wrong = given
            .iter()
            .rfind(|(other, _)| excluded.contains(other) || *other != key && nodes.contains(other));
        let wrong = wrong.map(|(_, option)| *option).or(options.log.is_some().then_some("log"));
        match wrong {
            None => Ok(options),
            Some(option) => Err(BadOption::Value {
                key: key.to_owned(),
                value: option.to_owned(),
                reason: reason.to_owned(),
            }),
        }
    }
}

impl Options {
    fn set(&mut self, key: &str, value: &str) -> Result<(), BadOption> {
        let bad = |reason: &dyn Display| BadOption::Value {
            key: key.to_owned(),
            value: value.to_owned(),
            reason: reason.to_string(),
        };
        let percent = || {
            let number = value.trim_end_matches('%').parse::<f64>().ok();
            number
                .filter(|number| (0.0..=100.0).contains(number))
                .ok_or_else(|| bad(&"give per cent, 0 to 100"))
        };
        match key {
            "car" | "canopen" | "ecu" if !value.is_empty() => return Err(bad(&"it stands alone")),
            "car" | "canopen" | "ecu" => {
                if let Some(reason) = nodes::MISSING {
                    return Err(bad(&reason));
                }
                match key {
                    "car" => self.car = true,
                    "canopen" => self.canopen = true,
                    _ => self.ecu = true,
                }
            }
            "load" => self.load_percent = percent()?,
            "errors" => self.error_percent = percent()?,
            "frames" => self.frames = value.parse().map_err(|error| bad(&error))?,
            "bitrate" => {
                let bps =
                    parse_bitrate(value).filter(|bps| (MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(bps));
                self.bitrate_bps = Some(bps.ok_or_else(|| bad(&"give 5k to 1M"))?);
            }
            "burst" => {
                let burst = value.split_once('/').and_then(|(length, period)| {
                    Some((length.parse().ok().filter(|length| *length > 0)?, parse_time(period)?))
                });
                self.burst = Some(burst.ok_or_else(|| bad(&"give frames and period, as in 10/960us"))?);
            }
            "ack" => self.acknowledge = choose(value, "yes", "no").ok_or_else(|| bad(&"give yes or no"))?,
            "disturb" => self.disturb = value.parse().map_err(|_| bad(&"give a number of frames"))?,
            "settings" if value.is_empty() => return Err(bad(&"give a file's name")),
            "settings" => self.settings = Some(PathBuf::from(value)),
            "seed" => self.seed = value.parse().map_err(|_| bad(&"give a whole number"))?,
            "pace" => {
                let real = choose(value, "real", "fast").ok_or_else(|| bad(&"give real or fast"))?;
                self.pace = if real { Pace::RealTime } else { Pace::Fast };
            }
            "wire" => {
                self.joined = choose(value, "joined", "apart").ok_or_else(|| bad(&"give joined or apart"))?;
            }
            "channels" => {
                self.traffic_on = match value {
                    "1" => [true, false],
                    "2" => [false, true],
                    "both" => [true, true],
                    _ => return Err(bad(&"give 1, 2 or both")),
                };
            }
            "ppm" => {
                let ppm = value.parse().ok().filter(|ppm: &f64| ppm.abs() <= MOST_PPM);
                self.crystal_ppm = ppm.ok_or_else(|| bad(&"give -500 to 500"))?;
            }
            "serial" if (1..=MAX_SERIAL_BYTES).contains(&value.len()) => value.clone_into(&mut self.serial),
            "serial" => return Err(bad(&"give 1 to 24 characters")),
            _ => return Err(BadOption::Unknown(key.to_owned())),
        }
        Ok(())
    }

    /// The sequence of frames on a channel's bus.
    pub fn source(&self, channel: usize) -> FrameSource {
        FrameSource::new(self.frames, self.seed.wrapping_mul(2).wrapping_add(channel as u64))
    }

    /// The bit rate of a channel's bus in bit/s, if it is fixed.
    pub fn bitrate_of_bus(&self, channel: usize) -> Option<u32> {
        if self.car { nodes::bitrate_in_car(channel) } else { self.bitrate_bps }
    }

    /// A channel's bus, with what these options put on it. A log is handed to the first bus that is made.
    pub fn bus(&mut self, channel: usize) -> SimBus {
        let log = self.log.as_mut().map(|log| std::mem::take(&mut log[channel]));
        let schedule = match (log, self.burst) {
            _ if !self.traffic_on[channel] => Schedule::Silent,
            _ if self.car => nodes::car(channel, self.seed),
            _ if self.canopen => nodes::canopen(channel),
            _ if self.ecu => nodes::ecu(channel),
            (Some(entries), _) => Schedule::Log { entries: entries.into_iter() },
            (None, Some((length, period))) => {
                Schedule::Bursts { source: self.source(channel), length, period_ns: period.as_nanos() as u64 }
            }
            (None, None) if self.load_percent <= 0.0 => Schedule::Silent,
            (None, None) => Schedule::Load { source: self.source(channel), percent: self.load_percent },
        };
        SimBus::new(self.bitrate_of_bus(channel), Traffic::new(schedule), self.seed)
            .acknowledging(self.acknowledge)
            .with_errors(self.error_percent)
            .disturbing(self.disturb)
    }
}

fn choose(value: &str, yes: &str, no: &str) -> Option<bool> {
    if value == yes {
        Some(true)
    } else if value == no {
        Some(false)
    } else {
        None
    }
}

fn parse_bitrate(text: &str) -> Option<u32> {
    let (number, factor) = match text.strip_suffix(['k', 'K']) {
        Some(number) => (number, 1e3),
        None => text.strip_suffix(['m', 'M']).map_or((text, 1.0), |number| (number, 1e6)),
    };
    Some((number.parse::<f64>().ok()? * factor).round() as u32)
}

fn parse_time(text: &str) -> Option<Duration> {
    let (number, seconds) = match text.strip_suffix("us") {
        Some(number) => (number, 1e-6),
        None => match text.strip_suffix("ms") {
            Some(number) => (number, 1e-3),
            None => (text.strip_suffix('s')?, 1.0),
        },
    };
    Duration::try_from_secs_f64(number.parse::<f64>().ok()? * seconds).ok().filter(|time| !time.is_zero())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_read_and_bad_ones_say_what_would_fit() {
        let options: Options =
            "load=100,frames=std0,bitrate=500k,burst=10/960us,ack=no,pace=fast,serial=A1".parse().unwrap();
        assert_eq!(
            options,
            Options {
                load_percent: 100.0,
                frames: Frames::Std0,
                bitrate_bps: Some(500_000),
                burst: Some((10, Duration::from_micros(960))),
                acknowledge: false,
                pace: Pace::Fast,
                serial: "A1".to_owned(),
                ..Options::default()
            }
        );
        for (text, message) in [
            ("speed=1", "there is no option 'speed'"),
            ("car=red", "'red' does not fit the option 'car': it stands alone"),
            (
                "car,load=5",
                "'load=5' does not fit the option 'car': the car has its own traffic and bit rates",
            ),
            (
                "canopen,load=5",
                "'load=5' does not fit the option 'canopen': the nodes have their own traffic",
            ),
            ("car,canopen", "'canopen' does not fit the option 'car': the car has its own traffic"),
            ("load=101", "'101' does not fit the option 'load': give per cent, 0 to 100"),
            ("frames=x", "'x' does not fit the option 'frames': choose one of std0"),
            ("serial=", "'' does not fit the option 'serial': give 1 to 24 characters"),
            ("ppm=501", "'501' does not fit the option 'ppm': give -500 to 500"),
            ("bitrate=2M", "'2M' does not fit the option 'bitrate': give 5k to 1M"),
        ] {
            let error = text.parse::<Options>().unwrap_err().to_string();
            assert!(error.starts_with(message), "{error}");
        }
    }
}
