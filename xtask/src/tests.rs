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

/// Runs them all, even if one fails; those on the emulated board use the default board's firmware, and are ignored without it. Those that
/// concern every board use `boards`, the ones that were built. If there are peers, none may be skipped but those left out on purpose.
pub fn run(shell: &Shell, peers: Option<&Peers>, boards: &[Board]) -> Result<()> {
    let names: Vec<&str> = boards.iter().map(|board| board.name()).collect();
    let mut test = cargo_test(shell).arg("--no-fail-fast").env("CANTAP_BOARDS", names.join(" "));
    if let Some(peers) = peers {
        test = test
            .env("CANTAP_PYTHON", &peers.python)
            .env("CANTAP_REQUIRE_PEERS", "1")
            .env("CANTAP_WITHOUT_PEERS", peers.left_out.join(" "));
    }
    Ok(test.run()?)
}

fn cargo_test(shell: &Shell) -> Cmd<'_> {
    let elf = Board::ALL[0].elf();
    let test = cmd!(shell, "cargo test --locked --workspace --all-features");
    if elf.exists() { test.env("CANTAP_FIRMWARE_ELF", elf) } else { test }
}
