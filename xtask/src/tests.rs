//! Every test of the workspace, in one build.
//!
//! All use one selection of packages and features: cargo unifies features across what it builds at once, so another selection would
//! compile the same crates again with other features.

use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail, ensure};
use xshell::{Cmd, Shell, cmd};

use crate::board::Board;
use crate::failures::Failures;
use crate::outcome::Outcome;
use crate::peers::Peers;

/// Compiles the tests, and with them the programs that they run (`cantap`, `cantap-sim`).
pub fn build(shell: &Shell) -> Result<()> {
    Ok(cargo_test(shell).arg("--no-run").run()?)
}

/// Runs them all, even if one fails. Those on the emulated board are marked as ignored; they use the default board's firmware, and are left
/// out without it. Those that concern every board use `boards`, the ones that were built. If there are peers, none may be skipped but
/// those left out on purpose.
///
/// A few that fail run once more, alone: what passes then is reported as flaky.
pub fn run(shell: &Shell, peers: Option<&Peers>, boards: &[Board]) -> Result<Outcome> {
    build(shell)?;
    let test = |arguments: &[String], threads: String| {
        let names: Vec<&str> = boards.iter().map(|board| board.name()).collect();
        let mut test = cargo_test(shell).arg("--no-fail-fast").env("CANTAP_BOARDS", names.join(" "));
        if let Some(peers) = peers {
            test = test
                .env("CANTAP_PYTHON", &peers.python)
                .env("CANTAP_REQUIRE_PEERS", "1")
                .env("CANTAP_WITHOUT_PEERS", peers.left_out.join(" "));
        }
        // Its messages are read.
        test = test.env("CARGO_TERM_COLOR", "never").env("RUST_TEST_THREADS", threads).arg("--");
        if Board::ALL[0].elf().exists() {
            test = test
                .arg("--include-ignored")
                .args(OTHERWISE_IGNORED.iter().flat_map(|name| ["--skip", name]));
        }
        watched(test.args(arguments))
    };
    let threads = std::env::var("RUST_TEST_THREADS").unwrap_or_else(|_| threads().to_string());
    let Err(failures) = test(&[], threads)? else { return Ok(Outcome::Passed) };
    let names = failures.names().filter(|names| names.len() <= MOST_FLAKY);
    let Some(names) = names else { bail!("tests failed, see above") };
    println!("\nonce more, alone: {}", names.join(", "));
    let alone: Vec<String> = std::iter::once("--exact".to_owned()).chain(names.iter().cloned()).collect();
    let again = test(&alone, "1".to_owned())?;
    ensure!(again.is_ok_and(|again| again.passed() >= names.len()), "tests failed, alone too; see above");
    Ok(Outcome::Flaky(names.to_vec()))
}

/// Where more tests than this fail, they are not run once more.
const MOST_FLAKY: usize = 3;

/// Runs it, shows what it prints, and reads there what failed; all that it printed if it ends with success.
fn watched(test: Cmd<'_>) -> Result<Result<Failures, Failures>> {
    println!("$ {test}");
    let (reader, writer) = std::io::pipe()?;
    let mut child = {
        // The command holds the ends for writing, and goes with this block.
        let mut command = Command::from(test);
        command.stdout(writer.try_clone()?).stderr(writer).stdin(Stdio::null());
        command.spawn().context("cargo")?
    };
    let mut failures = Failures::default();
    let mut out = std::io::stdout().lock();
    for line in BufReader::new(reader).split(b'\n') {
        let line = line?;
        out.write_all(&line)?;
        out.write_all(b"\n")?;
        failures.line(&String::from_utf8_lossy(&line));
    }
    Ok(if child.wait()?.success() { Ok(failures) } else { Err(failures) })
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
