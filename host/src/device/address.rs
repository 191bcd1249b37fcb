//! Where a device is: `/dev/ttyACM0`, `COM5`, `virtual:load=50`, `emu:firmware.elf`.

use std::fmt;
use std::str::FromStr;

use super::DeviceError;

/// The address of a device. It parses from what users type after `-d`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A serial port by path or name.
    Serial(String),
    /// The virtual device, with its options as typed.
    Virtual(String),
    /// A firmware ELF on the emulated board, with its options as typed.
    Emulated(String),
}

impl FromStr for Address {
    type Err = DeviceError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let bad =
            |reason: &str| DeviceError::BadAddress { address: text.to_owned(), reason: reason.to_owned() };
        match text.split_once(':') {
            _ if text.is_empty() => {
                Err(bad("it is empty; `cantap list` shows devices, `virtual` needs none"))
            }
            Some(("virtual", options)) => Ok(Self::Virtual(options.to_owned())),
            None if text == "virtual" => Ok(Self::Virtual(String::new())),
            Some(("emu", "")) => Err(bad("name the firmware, as in emu:firmware.elf")),
            Some(("emu", file)) => Ok(Self::Emulated(file.to_owned())),
            None if text == "emu" => Err(bad("name the firmware, as in emu:firmware.elf")),
            Some(("tcp", _)) => Err(bad("devices over TCP are not supported; use a serial port")),
            _ => Ok(Self::Serial(text.to_owned())),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Serial(port) => f.write_str(port),
            Self::Virtual(options) if options.is_empty() => f.write_str("virtual"),
            Self::Virtual(options) => write!(f, "virtual:{options}"),
            Self::Emulated(file) => write!(f, "emu:{file}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_round_trip_and_bad_ones_say_what_would_be_right() {
        for text in ["/dev/ttyACM0", "COM5", "virtual", "virtual:load=50", "emu:a.elf"] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        for text in ["", "emu", "emu:", "tcp:1.2.3.4"] {
            assert!(text.parse::<Address>().is_err(), "{text}");
        }
    }
}
