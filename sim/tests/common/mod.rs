//! The firmware that the tests run: what `cargo xtask firmware` built.
#![allow(dead_code, reason = "each test file uses its part")]

use std::path::{Path, PathBuf};

use cantap_sim::elf::Image;

/// The default board's ELF: `CANTAP_FIRMWARE_ELF`, or where `cargo xtask firmware` puts it. Without either, says
/// so loudly and returns nothing, and the test has shown nothing.
pub fn firmware() -> Option<Image> {
    let path = elf()?;
    Some(Image::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
}

/// The ELF's path.
pub fn elf() -> Option<PathBuf> {
    if let Some(path) = std::env::var_os("CANTAP_FIRMWARE_ELF") {
        return Some(PathBuf::from(path));
    }
    let built = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/firmware/cantap-olimex-p405.elf");
    if built.exists() {
        return Some(built);
    }
    eprintln!("SKIPPED: there is no {}; run `cargo xtask firmware` first", built.display());
    None
}
