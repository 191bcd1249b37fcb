//! The ELF for tests of the emulated board.

use std::path::PathBuf;

/// The ELF's path: `CANTAP_FIRMWARE_ELF`. Without it, the build script makes every test that uses this
/// ignored.
pub fn elf() -> PathBuf {
    let path = std::env::var_os("CANTAP_FIRMWARE_ELF");
    path.expect("CANTAP_FIRMWARE_ELF is not set; build the firmware with `cargo xtask firmware`").into()
}
