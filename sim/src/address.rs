//! What follows `emu:` in a device's address: the firmware's file, and options after commas.

use std::path::PathBuf;

use crate::board::CLOCK;
use crate::firmware::{self, FirmwareError};
use cantap_wire::Channel;
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};

use crate::CYCLES_PER_SECOND;
use crate::link::{EmulatedPort, Manner, Pace, ServeError};
use crate::run::{DEFAULT_BITRATE_BPS, Load, Options, replay};
use cantap_emu::traffic::{Kind, parse_log};

/// A load at which the emulation stays close to real time.
const DEFAULT_LOAD_PERCENT: f64 = 20.0;
/// No crystal is off by more than this, and a USB host's frames must not be either (USB 2.0, 7.1.12: 500 ppm).
const MOST_PPM: f64 = 500.0;

/// An emulated device: `FILE.elf`, or `FILE.elf,load=50,frames=std8,bitrate=500000,seed=7`.
///
/// Keys: `load` (per cent), `frames` (`std0` `std8` `ext0` `ext8` `rtr` `mix`), `burst` (`10/960us`: frames in a burst, and its period), `bitrate`
/// (bit/s; by default the rate at which the channel is opened), `channels` (`1`, `2` or `both`: those with traffic), `ack` (`yes`, `no`: whether the
/// simulated nodes acknowledge), `errors` (per cent of the frames destroyed), `seed`, `ppm` (how much too fast the board's crystal is), `wire`
/// (`apart`: a bus for each channel; `joined`: one bus for both), `pace` (`client`: time stands still while the client does not read; `real`: it
/// continues), `speed` (how fast time passes at most; 1 is real time), `timing` (`best`, `worst`: how long memories and buses keep the core waiting),
/// and at the end `log=FILE` (a candump log, replayed at its own times from the moment a channel is opened; its first interface is channel 1).
#[derive(Clone, Debug)]
pub struct Address {
    /// The firmware.
    pub file: PathBuf,
    /// The buses and their traffic.
    pub options: Options,
    /// How time passes, and whether there is one bus or two.
    pub manner: Manner,
}

/// Why an emulated device cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum AddressError {
    /// There is no such option.
    #[error(
        "there is no option '{0}'; there are load, frames, burst, bitrate, channels, ack, errors, seed, ppm, wire, pace, speed, timing, log"
    )]
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
    /// The file is not firmware.
    #[error("{0}")]
    Firmware(#[from] FirmwareError),
    /// The firmware does not come up.
    #[error("{0}")]
    Start(#[from] ServeError),
}

impl std::str::FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (text, log) = text.split_once(",log=").map_or((text, None), |(text, log)| (text, Some(log)));
        // A comma in the file's name is part of it, unless an option follows it.
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
        let mut address = Self { file: file.into(), options, manner: Manner::default() };
        for (key, value) in given.into_iter().rev() {
            address.set(key, value)?;
        }
        if let Some(log) = log {
            let bad =
                |reason: String| AddressError::Value { key: "log".to_owned(), value: log.to_owned(), reason };
            let text = std::fs::read_to_string(log).map_err(|error| bad(error.to_string()))?;
            let lines = parse_log(&text, 0, CLOCK).map_err(|error| bad(error.to_string()))?;
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
        let percent = || {
            let number = value.trim_end_matches('%').parse().ok();
            let number = number.filter(|number| (0.0..=100.0).contains(number));
            number.ok_or_else(|| bad("give per cent, 0 to 100"))
        };
        match key {
            "load" => {
                self.options.load = Load::Frames { kind: self.kind(), percent: percent()? };
            }
            "frames" => {
                let new = value.parse().map_err(|reason: String| bad(&reason))?;
                match &mut self.options.load {
                    Load::Frames { kind, .. } | Load::Bursts { kind, .. } => *kind = new,
                    Load::Replay(_) => {}
                }
            }
            "burst" => {
                let burst = value.split_once('/').and_then(|(frames, period)| {
                    Some((number(frames).filter(|frames| *frames > 0)?, cycles(period)?))
                });
                let (frames, period) =
                    burst.ok_or_else(|| bad("give frames and period, such as 10/960us"))?;
                self.options.load = Load::Bursts { kind: self.kind(), frames, period };
            }
            "bitrate" => {
                // The other nodes' clocks may reach rates that the board's cannot.
                let bps = number(value).filter(|bps| (MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(bps));
                self.options.bitrate_bps =
                    Some(bps.ok_or_else(|| bad("give 5k to 1M, in bit/s, such as 500000"))?);
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
                self.manner.pace = match value {
                    "client" => Pace::Client,
                    "real" => Pace::RealTime,
                    _ => return Err(bad("give client or real")),
                }
            }
            "speed" => {
                let speed = value.parse().ok().filter(|speed| (0.001..=1000.0).contains(speed));
                self.manner.speed = speed.ok_or_else(|| bad("give 0.001 to 1000; 1 is real time"))?;
            }
            "timing" => self.options.bound = value.parse().map_err(|reason: String| bad(&reason))?,
            "wire" => {
                self.manner.joined = match value {
                    "apart" => false,
                    "joined" => true,
                    _ => return Err(bad("give apart or joined")),
                }
            }
            "ppm" => {
                let ppm = value.parse().ok().filter(|ppm: &f64| ppm.abs() <= MOST_PPM);
                self.options.timing.board_ppm = ppm.ok_or_else(|| bad("give -500 to 500"))?;
            }
            "errors" => self.manner.error_percent = percent()?,
            "ack" => {
                self.manner.acknowledge = match value {
                    "yes" => true,
                    "no" => false,
                    _ => return Err(bad("give yes or no")),
                }
            }
            _ => return Err(AddressError::Unknown(key.to_owned())),
        }
        Ok(())
    }

    fn kind(&self) -> Kind {
        match self.options.load {
            Load::Frames { kind, .. } | Load::Bursts { kind, .. } => kind,
            Load::Replay(_) => Kind::Mix,
        }
    }

    /// Boots the firmware and opens the device's port.
    pub fn open(self) -> Result<EmulatedPort, AddressError> {
        let image = firmware::open(&self.file)?;
        Ok(EmulatedPort::start(image, self.options, self.manner)?)
    }
}

/// A whole number: `500000`, `500k`, `1M`.
fn number(text: &str) -> Option<u32> {
    let (digits, factor) = match text.as_bytes().last()? {
        b'k' | b'K' => (&text[..text.len() - 1], 1_000.0),
        b'M' => (&text[..text.len() - 1], 1_000_000.0),
        _ => (text, 1.0),
    };
    let number = digits.parse::<f64>().ok()? * factor;
    ((0.0..=f64::from(u32::MAX)).contains(&number) && number.fract() == 0.0).then_some(number as u32)
}

/// A time in core cycles: `960us`, `20ms`, `1s`.
fn cycles(text: &str) -> Option<u64> {
    let unit_at = text.find(|symbol: char| symbol.is_ascii_alphabetic())?;
    let factor = match &text[unit_at..] {
        "us" => 1e-6,
        "ms" => 1e-3,
        "s" => 1.0,
        _ => return None,
    };
    let seconds = text[..unit_at].parse::<f64>().ok().filter(|number| (0.0..1e6).contains(number))? * factor;
    Some((seconds * CYCLES_PER_SECOND as f64) as u64).filter(|cycles| *cycles > 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_emu::timing::Bound;

    #[test]
    fn options_follow_the_file() {
        let address: Address =
            "a,b.elf,load=50%,frames=std8,seed=7,channels=2,pace=real,timing=worst".parse().unwrap();
        assert_eq!(address.file, PathBuf::from("a,b.elf"));
        assert_eq!((address.options.seed, address.manner.pace), (7, Pace::RealTime));
        assert_eq!(
            (&address.options.channels[..], address.options.bound),
            (&[Channel::Can2][..], Bound::Worst)
        );
        let load = Load::Frames { kind: Kind::Std8, percent: 50.0 };
        assert_eq!(format!("{:?}", address.options.load), format!("{load:?}"));
    }

    #[test]
    fn options_that_do_not_fit_are_named() {
        for (text, what) in [
            ("a.elf,colour=9", "no option 'colour'"),
            ("a.elf,load=101", "0 to 100"),
            ("a.elf,frames=fd", "std0"),
            ("a.elf,bitrate=1000001", "5k to 1M"),
            ("a.elf,burst=0/20ms", "10/960us"),
            ("a.elf,burst=1/20", "10/960us"),
            ("a.elf,speed=0", "real time"),
            ("a.elf,ppm=501", "-500 to 500"),
            ("a.elf,timing=fast", "best or worst"),
            ("a.elf,wire=cut", "apart or joined"),
            ("a.elf,pace=slow", "client or real"),
            ("a.elf,log=no.log", "no.log"),
        ] {
            let error = text.parse::<Address>().unwrap_err().to_string();
            assert!(error.contains(what), "{text}: {error}");
        }
    }

    #[test]
    fn every_option_stands_in_the_documentation() {
        let docs = include_str!("../../docs/emulator.md");
        let error = "a.elf,colour=9".parse::<Address>().unwrap_err().to_string();
        let keys: Vec<&str> = error.split_once("there are ").unwrap().1.split(", ").collect();
        for key in &keys {
            assert!(docs.contains(&format!("\n| `{key}` | ")), "{key}");
            // It accepts every option that it lists.
            let error = format!("a.elf,{key}=").parse::<Address>().unwrap_err();
            assert!(matches!(error, AddressError::Value { .. }), "{key}: {error}");
        }
        assert_eq!(keys.len(), 14);
    }
}
