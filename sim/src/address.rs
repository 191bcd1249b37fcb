//! What follows `emu:` in a device's address: the firmware's file, and options behind commas.

use std::path::PathBuf;

use cantap_wire::Channel;

use crate::elf::{ElfError, Image};
use crate::link::{EmulatedPort, Pace, ServeError};
use crate::rig::{RigError, timing};
use crate::run::{DEFAULT_BITRATE_BPS, Load, Options, replay};
use crate::traffic::{Kind, parse_log};

/// Traffic that leaves the emulation close to real time.
const DEFAULT_LOAD_PERCENT: f64 = 20.0;

/// An emulated device: `FILE.elf`, or `FILE.elf,load=50,frames=std8,bitrate=500000,seed=7`.
///
/// Keys: `load` (per cent), `frames` (`std0` `std8` `ext0` `ext8` `rtr` `mix`), `bitrate` (bit/s; by default that of whoever
/// opens the channel), `channels` (`1`, `2` or `both`: those with traffic), `seed`, `pace` (`client`: time stands still
/// while the client does not read; `real`: it goes on), and at the end `log=FILE` (a candump log, replayed at its own
/// times from the moment a channel is opened; its first interface is channel 1).
#[derive(Clone, Debug)]
pub struct Address {
    /// The firmware.
    pub file: PathBuf,
    /// The buses and their traffic.
    pub options: Options,
    /// How time passes.
    pub pace: Pace,
}

/// Why an emulated device cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum AddressError {
    /// There is no such option.
    #[error("there is no option '{0}'; there are load, frames, bitrate, channels, seed, pace, log")]
    Unknown(String),
    /// The value does not fit.
    #[error("'{value}' does not fit the option '{key}': {reason}")]
    Value {
        /// The option.
        key: String,
        /// Its value.
        value: String,
        /// What would fit.
        reason: String,
    },
    /// The file is not a firmware.
    #[error("{0}")]
    Firmware(#[from] ElfError),
    /// The firmware does not come up.
    #[error("{0}")]
    Start(#[from] ServeError),
}

impl std::str::FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (text, log) = text.split_once(",log=").map_or((text, None), |(text, log)| (text, Some(log)));
        // A comma in the file's name is part of it, unless what follows is an option.
        let mut file = text;
        let mut given = Vec::new();
        while let Some((front, option)) = file.rsplit_once(',')
            && let Some((key, value)) = option.split_once('=')
        {
            file = front;
            given.push((key, value));
        }
        let load = Load::Frames { kind: Kind::Mix, percent: DEFAULT_LOAD_PERCENT };
        let options = Options { load, ..Options::default() };
        let mut address = Self { file: file.into(), options, pace: Pace::Client };
        for (key, value) in given.into_iter().rev() {
            address.set(key, value)?;
        }
        if let Some(log) = log {
            let bad =
                |reason: String| AddressError::Value { key: "log".to_owned(), value: log.to_owned(), reason };
            let text = std::fs::read_to_string(log).map_err(|error| bad(error.to_string()))?;
            let lines = parse_log(&text, 0).map_err(|error| bad(error.to_string()))?;
            let bitrate_bps = address.options.bitrate_bps.unwrap_or(DEFAULT_BITRATE_BPS);
            address.options.load = replay(lines, bitrate_bps).0;
        }
        Ok(address)
    }
}

impl Address {
    fn set(&mut self, key: &str, value: &str) -> Result<(), AddressError> {
        let bad = |reason: &str| AddressError::Value {
            key: key.to_owned(),
            value: value.to_owned(),
            reason: reason.to_owned(),
        };
        let (kind, percent) = match &mut self.options.load {
            Load::Frames { kind, percent } => (kind, percent),
            Load::Replay(_) => return Err(AddressError::Unknown(key.to_owned())),
        };
        match key {
            "load" => {
                let number = value.trim_end_matches('%').parse().ok();
                let number = number.filter(|number| (0.0..=100.0).contains(number));
                *percent = number.ok_or_else(|| bad("give per cent, 0 to 100"))?;
            }
            "frames" => *kind = value.parse().map_err(|reason: String| bad(&reason))?,
            "bitrate" => {
                let bps = value.parse().map_err(|_| bad("give a rate in bit/s, such as 500000"))?;
                timing(bps).map_err(|error: RigError| bad(&error.to_string()))?;
                self.options.bitrate_bps = Some(bps);
            }
            "channels" => {
                self.options.channels = match value {
                    "1" => vec![Channel::Can1],
                    "2" => vec![Channel::Can2],
                    "both" => Channel::ALL.to_vec(),
                    _ => return Err(bad("give 1, 2 or both")),
                }
            }
            "seed" => self.options.seed = value.parse().map_err(|_| bad("give a whole number"))?,
            "pace" => {
                self.pace = match value {
                    "client" => Pace::Client,
                    "real" => Pace::RealTime,
                    _ => return Err(bad("give client or real")),
                }
            }
            _ => return Err(AddressError::Unknown(key.to_owned())),
        }
        Ok(())
    }

    /// Boots the firmware and opens the device's port.
    pub fn open(self) -> Result<EmulatedPort, AddressError> {
        let image = Image::open(&self.file)?;
        Ok(EmulatedPort::start(image, self.options, self.pace)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_follow_the_file() {
        let address: Address = "a,b.elf,load=50%,frames=std8,seed=7,channels=2,pace=real".parse().unwrap();
        assert_eq!(address.file, PathBuf::from("a,b.elf"));
        assert_eq!((address.options.seed, address.pace), (7, Pace::RealTime));
        assert_eq!(address.options.channels, [Channel::Can2]);
        let load = Load::Frames { kind: Kind::Std8, percent: 50.0 };
        assert_eq!(format!("{:?}", address.options.load), format!("{load:?}"));
    }

    #[test]
    fn options_that_do_not_fit_are_named() {
        for (text, what) in [
            ("a.elf,speed=9", "no option 'speed'"),
            ("a.elf,load=101", "0 to 100"),
            ("a.elf,frames=fd", "std0"),
            ("a.elf,bitrate=1000001", "1000001 bit/s"),
            ("a.elf,pace=slow", "client or real"),
            ("a.elf,log=no.log", "no.log"),
        ] {
            let error = text.parse::<Address>().unwrap_err().to_string();
            assert!(error.contains(what), "{text}: {error}");
        }
    }
}
