//! The boards for which there is firmware. Each is a feature of the firmware package and a file in
//! `src/board/`.

use std::path::PathBuf;

use crate::workspace;

/// A board, by the name that its feature and the device's `Hello` use, too.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Board {
    /// Olimex STM32-P405.
    OlimexP405,
    /// Adafruit Feather STM32F405 Express.
    FeatherF405,
    /// ST STM32F4DISCOVERY.
    Stm32f4Discovery,
}

impl Board {
    /// All boards; the first is the default.
    pub const ALL: [Board; 3] = [Board::OlimexP405, Board::FeatherF405, Board::Stm32f4Discovery];

    /// The board's feature.
    pub const fn name(self) -> &'static str {
        match self {
            Board::OlimexP405 => "olimex-p405",
            Board::FeatherF405 => "feather-f405",
            Board::Stm32f4Discovery => "stm32f4-discovery",
        }
    }

    /// The firmware with the feature `disturb`, which is never released.
    pub fn disturbing_elf(self) -> PathBuf {
        workspace::firmware_dir().join(format!("cantap-{}-disturb.elf", self.name()))
    }

    /// The finished firmware.
    pub fn elf(self) -> PathBuf {
        workspace::firmware_dir().join(format!("cantap-{}.elf", self.name()))
    }
}
