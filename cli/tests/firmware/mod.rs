//! The ELF that tests of the emulated board run.

use std::path::{Path, PathBuf};

/// The default board's ELF: `CANTAP_FIRMWARE_ELF`, or where `cargo xtask firmware` puts it.
pub fn elf() -> Option<PathBuf> {
    if let Some(path) = std::env::var_os("CANTAP_FIRMWARE_ELF") {
        return Some(PathBuf::from(path));
    }
    let built = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/firmware/cantap-olimex-p405.elf");
    if cfg!(feature = "emu") && built.exists() {
        return Some(built);
    }
    eprintln!("SKIPPED: there is no {}; run `cargo xtask firmware` first", built.display());
    None
}
