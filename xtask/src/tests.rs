//! Every test of the workspace, in one build.
//!
//! All use one selection of packages and features: cargo unifies features across what it builds at once, so another selection would
//! compile the same crates again with other features.

use anyhow::Result;
use xshell::{Cmd, Shell, cmd};

use crate::board::Board;
use crate::peers::Peers;

/// Compiles the tests, and with them the programs that they run (`cantap`, `cantap-sim`).
pub fn build(shell: &Shell) -> Result<()> {
    Ok(cargo_test(shell).arg("--no-run").run()?)
}

/// Runs them all, even if one fails. Those on the emulated board are marked as ignored; they use the default board's firmware, and are left
/// out without it. Those that concern every board use `boards`, the ones that were built. If there are peers, none may be skipped but
/// those left out on purpose.
pub fn run(shell: &Shell, peers: Option<&Peers>, boards: &[Board]) -> Result<()> {
    let names: Vec<&str> = boards.iter().map(|board| board.name()).collect();
    let mut test = cargo_test(shell).arg("--no-fail-fast").env("CANTAP_BOARDS", names.join(" "));
    if let Some(peers) = peers {
        test = test
            .env("CANTAP_PYTHON", &peers.python)
            .env("CANTAP_REQUIRE_PEERS", "1")
            .env("CANTAP_WITHOUT_PEERS", peers.left_out.join(" "));
    }
    if std::env::var_os("RUST_TEST_THREADS").is_none() {
        test = test.env("RUST_TEST_THREADS", threads().to_string());
    }
    if Board::ALL[0].elf().exists() {
        test = test
            .args(["--", "--include-ignored"])
            .args(OTHERWISE_IGNORED.iter().flat_map(|name| ["--skip", name]));
    }
    Ok(test.run()?)
}

/// How many tests run side by side: most wait for devices and programs, and those that fill a processor take turns.
pub fn threads() -> usize {
    2 * std::thread::available_parallelism().map_or(1, usize::from)
}

/// Tests that are ignored for a reason other than that they run the firmware.
const OTHERWISE_IGNORED: [&str; 2] = [
    // Run by another test, in a terminal of its own.
    "a_display_that_panics",
    // A measurement: `cargo xtask bench graph`.
    "redraws_of_five_million_values",
];

fn cargo_test(shell: &Shell) -> Cmd<'_> {
    let elf = Board::ALL[0].elf();
    let test = cmd!(shell, "cargo test --locked --workspace --all-features");
    if elf.exists() { test.env("CANTAP_FIRMWARE_ELF", elf) } else { test }
}
