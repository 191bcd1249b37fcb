//! Our firmware among the programs that the emulator runs: it states the version of the protocol that it
//! speaks.

use std::path::Path;

use cantap_emu::{ElfError, Image};
use cantap_wire::{PROTOCOL_SYMBOL, PROTOCOL_VERSION};

/// Why a file is not firmware that can be used here.
#[derive(Debug, thiserror::Error)]
pub enum FirmwareError {
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Unreadable {
        /// The file.
        path: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// The emulator cannot run it.
    #[error("{source}{}", advice(source))]
    Elf {
        /// Why.
        #[from]
        source: ElfError,
    },
    /// There is no protocol version symbol.
    #[error("not cantap's firmware: it has no symbol {PROTOCOL_SYMBOL}")]
    NoProtocolVersion,
    /// The firmware speaks another version of the protocol.
    #[error(
        "the firmware speaks protocol version {firmware}, this emulator {PROTOCOL_VERSION}; {}",
        if *firmware < PROTOCOL_VERSION { "build a newer firmware" } else { "update the emulator" }
    )]
    ProtocolMismatch {
        /// The firmware's version.
        firmware: u16,
    },
}

fn advice(error: &ElfError) -> &'static str {
    match error {
        ElfError::NotElf => "; give the firmware's ELF, as `cargo xtask firmware` makes it",
        _ => "",
    }
}

/// Reads the firmware from a file, with every check.
pub fn open(path: &Path) -> Result<Image, FirmwareError> {
    let bytes = std::fs::read(path)
        .map_err(|source| FirmwareError::Unreadable { path: path.display().to_string(), source })?;
    read(&bytes)
}

/// Takes the firmware from an ELF's bytes, with every check.
pub fn read(elf: &[u8]) -> Result<Image, FirmwareError> {
    let image = Image::program(elf)?;
    let address = image.datum(PROTOCOL_SYMBOL).ok_or(FirmwareError::NoProtocolVersion)?;
    match image.bytes_at(address) {
        Some([low, high, ..]) => match u16::from_le_bytes([*low, *high]) {
            PROTOCOL_VERSION => Ok(image),
            firmware => Err(FirmwareError::ProtocolMismatch { firmware }),
        },
        _ => Err(FirmwareError::NoProtocolVersion),
    }
}
