//! `cargo xtask test`: everything that must hold before a change lands, from a fresh clone on.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use xshell::{Cmd, Shell, cmd};

use crate::board::Board;
use crate::peers::Peers;
use crate::toolchain::Toolchain;
use crate::{firmware, kernel, reproducible, size, workspace};

/// What `cargo xtask test` takes.
#[derive(clap::Args)]
pub struct Args {
    /// Only this step; may be given again. Later steps use the firmware that earlier ones built.
    #[arg(long, value_name = "STEP")]
    only: Vec<Step>,
}

/// One thing that is checked. The order is the order of the run: what fails fast comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Step {
    /// Formatting.
    Fmt,
    /// The firmware of every board.
    Firmware,
    /// What the firmware takes, against its budget.
    Size,
    /// A second build, elsewhere, gives the same bytes.
    Reproducible,
    /// Lints of everything for the host.
    Clippy,
    /// Lints of the firmware for each board.
    ClippyFirmware,
    /// The tests that need no firmware ELF.
    Host,
    /// The tests that run the firmware ELF on the emulated board.
    Emulated,
    /// A stock Linux kernel under QEMU drives the firmware on the emulated board.
    Kernel,
    /// The command that a newcomer runs first: both channels at full load, nothing lost.
    Demo,
    /// Public items' documentation, with every link checked.
    Doc,
    /// The library crates as they would be published: each packs.
    Package,
}

/// How a step ended that did not fail.
pub enum Outcome {
    /// All of it ran.
    Passed,
    /// It could not run here, for this reason.
    Skipped(String),
}

/// What can be published, each behind what it needs.
const PUBLISHED: [&str; 7] = [
    "cantap-can",
    "cantap-wire",
    "cantap-trace",
    "cantap-formats",
    "cantap-signals",
    "cantap-analysis",
    "cantap",
];

/// Runs the steps one after the other and stops at the first that fails.
pub fn run(args: &Args) -> Result<()> {
    use clap::ValueEnum;

    let steps = if args.only.is_empty() { Step::value_variants() } else { &args.only };
    let shell = workspace::shell()?;
    let toolchain = Toolchain::find_or_install(&shell)?;
    let peers = Peers::find_or_install(&shell)?;
    let mut done: Vec<(String, Outcome, Duration)> = Vec::new();
    for step in steps {
        let name = step.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned());
        println!("\n--- {name}");
        let begin = Instant::now();
        match step.run(&shell, toolchain, peers.as_ref()) {
            Ok(outcome) => done.push((name, outcome, begin.elapsed())),
            Err(error) => {
                report(&done);
                eprintln!("{name:<16} failed; to repeat it: cargo xtask test --only {name}");
                return Err(error);
            }
        }
    }
    println!();
    report(&done);
    Ok(())
}

impl Step {
    fn run(self, shell: &Shell, toolchain: Toolchain, peers: Option<&Peers>) -> Result<Outcome> {
        match self {
            Step::Fmt => cmd!(shell, "cargo fmt --all --check").run()?,
            Step::Firmware => firmware::build_all(shell, toolchain, &Board::ALL)?,
            Step::Size => size::run()?,
            Step::Reproducible => reproducible::check(shell, toolchain)?,
            Step::Clippy => {
                cmd!(shell, "cargo clippy --locked --workspace --all-targets --all-features -- -D warnings")
                    .run()?;
            }
            Step::ClippyFirmware => firmware::clippy(shell, toolchain)?,
            Step::Host => {
                let test = cmd!(shell, "cargo test --locked --workspace --all-features --exclude cantap-sim");
                with_peers(test, peers).run()?;
            }
            Step::Emulated => {
                let elf = Board::ALL[0].elf();
                ensure!(elf.exists(), "there is no {}; run `cargo xtask firmware`", elf.display());
                let test = cmd!(shell, "cargo test --locked -p cantap-sim --all-features");
                with_peers(test, peers).env("CANTAP_FIRMWARE_ELF", elf).run()?;
            }
            Step::Kernel => return kernel::run(shell),
            Step::Demo => cmd!(shell, "cargo demo --seconds 3").run()?,
            Step::Doc => {
                cmd!(shell, "cargo doc --locked --workspace --lib --no-deps --all-features")
                    .env("RUSTDOCFLAGS", "-D warnings")
                    .run()?;
            }
            Step::Package => {
                let packages = PUBLISHED.iter().flat_map(|name| ["-p", name]);
                cmd!(shell, "cargo package --locked --allow-dirty --no-verify {packages...}").run()?;
            }
        }
        Ok(Outcome::Passed)
    }
}

/// Tells the tests where the peers are and that they must not skip them.
fn with_peers<'a>(cmd: Cmd<'a>, peers: Option<&Peers>) -> Cmd<'a> {
    match peers {
        Some(peers) => cmd.env("CANTAP_PYTHON", &peers.python).env("CANTAP_REQUIRE_PEERS", "1"),
        None => cmd,
    }
}

fn report(done: &[(String, Outcome, Duration)]) {
    for (name, outcome, time) in done {
        match outcome {
            Outcome::Passed => println!("{name:<16} ok {:>6.1} s", time.as_secs_f64()),
            Outcome::Skipped(reason) => println!("{name:<16} NOT RUN: {reason}"),
        }
    }
}
