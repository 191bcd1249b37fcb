//! The channels that makers' libraries know, none of which is opened for it.

use std::collections::BTreeSet;
use std::path::Path;

use cantap_trace::clean;
use cantap_vendor::LoadError;
use cantap_vendor::canlib::{CanLib, capability};
use cantap_vendor::pcan_basic::{self, PcanBasic};

/// Who makes adapters that are reached through a library of theirs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Maker {
    /// PEAK: PCAN-Basic.
    Peak,
    /// Kvaser: CANlib.
    Kvaser,
}

impl Maker {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Peak, Self::Kvaser];

    /// The library's name.
    pub const fn library(self) -> &'static str {
        match self {
            Self::Peak => "PCAN-Basic",
            Self::Kvaser => "CANlib",
        }
    }

    /// What its addresses begin with, without the colon.
    pub const fn scheme(self) -> &'static str {
        match self {
            Self::Peak => "pcan",
            Self::Kvaser => "kvaser",
        }
    }
}

/// A channel that a maker's library knows. Texts are the library's, cleaned for a terminal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MakerChannel {
    /// Its address, as in `pcan:PCAN_USBBUS1`.
    pub device: String,
    /// What it is.
    pub product: String,
    /// The serial number; PCAN-Basic does not have it.
    pub serial_number: Option<String>,
    /// Whether it has CAN FD, if that is known.
    pub can_fd: Option<bool>,
    /// Whether a program has it open; CANlib does not tell.
    pub in_use: Option<bool>,
    /// Whether there is no hardware behind it.
    pub is_virtual: bool,
}

/// What a library has told.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MakerChannels {
    /// The channels, at most 256.
    pub channels: Vec<MakerChannel>,
    /// Channels of kinds that have no address here, such as those on a parallel port.
    pub without_address: usize,
}

/// Why a library's channels are not known.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MakerError {
    /// It cannot be used.
    #[error(transparent)]
    Library(#[from] LoadError),
    /// It has answered with an error.
    #[error("{library} says: {reason}")]
    Refused {
        /// Its name.
        library: &'static str,
        /// Its words.
        reason: String,
    },
}

impl MakerError {
    /// Whether nobody has installed the library.
    pub fn is_absent(&self) -> bool {
        matches!(self, Self::Library(error) if error.is_absent())
    }
}

/// Asks a maker's library, the system's or the one at a path that begins with the root. A library may do in this process whatever it likes, such as
/// not return: who cannot afford that asks in a process of its own.
pub fn maker_channels(maker: Maker, library: Option<&Path>) -> Result<MakerChannels, MakerError> {
    let option = library.map_or_else(String::new, |path| format!("?library={}", path.display()));
    match maker {
        Maker::Peak => peak(&PcanBasic::load(library)?, &option),
        Maker::Kvaser => kvaser(&CanLib::load(library)?, &option),
    }
}

fn peak(library: &PcanBasic, option: &str) -> Result<MakerChannels, MakerError> {
    let attached = library.attached().map_err(|status| MakerError::Refused {
        library: Maker::Peak.library(),
        reason: clean::line(&library.describe(status)).into_owned(),
    })?;
    let known: Vec<pcan_basic::Channel> = pcan_basic::Channel::all().collect();
    let mut told = BTreeSet::new();
    let mut found = MakerChannels::default();
    for one in attached {
        if !known.contains(&one.channel) {
            found.without_address += 1;
            continue;
        }
        let device = format!("{}:{}{option}", Maker::Peak.scheme(), one.channel);
        // One that is told twice is one.
        if told.insert(device.clone()) {
            found.channels.push(MakerChannel {
                device,
                product: clean::line(&format!("{} (device ID {:X}h)", one.name, one.device_id)).into_owned(),
                serial_number: None,
                can_fd: Some(one.has_fd),
                in_use: Some(one.is_in_use),
                is_virtual: false,
            });
        }
    }
    Ok(found)
}

fn kvaser(library: &CanLib, option: &str) -> Result<MakerChannels, MakerError> {
    let count = library.channels().map_err(|error| MakerError::Refused {
        library: Maker::Kvaser.library(),
        reason: clean::line(&library.describe(error)).into_owned(),
    })?;
    // A library that counts more channels than any computer has is not believed.
    let channels = (0..count.min(256)).filter_map(|number| {
        let (name, serial) = (library.name(number).ok(), library.serial(number).ok());
        // One of which it knows nothing is none.
        if name.is_none() && serial.is_none() {
            return None;
        }
        let capabilities = library.capabilities(number).ok();
        Some(MakerChannel {
            device: format!("{}:{number}{option}", Maker::Kvaser.scheme()),
            product: clean::line(&name.unwrap_or_default()).into_owned(),
            serial_number: serial.filter(|serial| *serial != 0).map(|serial| serial.to_string()),
            can_fd: capabilities.map(|bits| bits & capability::CAN_FD != 0),
            in_use: None,
            is_virtual: capabilities.map_or(serial == Some(0), |bits| bits & capability::VIRTUAL != 0),
        })
    });
    Ok(MakerChannels { channels: channels.collect(), without_address: 0 })
}
