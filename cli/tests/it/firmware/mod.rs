//! The ELF for tests of the emulated board.

use std::path::PathBuf;

/// The ELF's path: `CANTAP_FIRMWARE_ELF`. Every test that uses it is marked as ignored; `cargo xtask test` includes them when there
/// is an ELF.
pub fn elf() -> PathBuf {
    let path = std::env::var_os("CANTAP_FIRMWARE_ELF");
    path.expect("CANTAP_FIRMWARE_ELF is not set; build the firmware with `cargo xtask firmware`").into()
}
