//! `cargo xtask test`: everything that must hold before a change lands, from a fresh clone on.

use std::time::{Duration, Instant};

use anyhow::Result;
use xshell::{Shell, cmd};

use crate::board::Board;
use crate::outcome::Outcome;
use crate::peers::Peers;
use crate::toolchain::Toolchain;
use crate::{
    check, compiler, cross, dependencies, features, firmware, kernel, package, python, reproducible, size,
    tests, typos, workspace,
};

/// The arguments of `cargo xtask test`.
#[derive(clap::Args)]
pub struct Args {
    /// Only this step; may be given again. Later steps use the firmware that earlier ones built.
    #[arg(long, value_name = "STEP")]
    only: Vec<Step>,
}

/// One thing that is checked. The order is the order of the run: what fails quickly comes first, what takes long
/// comes last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Step {
    /// Formatting.
    Fmt,
    /// Spelling.
    Typos,
    /// Files of one crate that import each other in a circle, and public types of one crate that share a name.
    Circles,
    /// Links in the pages, and files named there.
    Links,
    /// Other people's crates: licences, duplicates, sources.
    Dependencies,
    /// The oldest compiler that the packages promise to build with.
    OldestCompiler,
    /// Lints of everything for the host.
    Clippy,
    /// Each crate without features, and with each one alone.
    Features,
    /// The fuzz targets compile.
    Fuzz,
    /// The documentation of public items, with every link checked.
    Doc,
    /// The libraries without ports and threads compile for WebAssembly.
    Wasm,
    /// Windows and macOS, as far as they can be checked here.
    Systems,
    /// The firmware of every board.
    Firmware,
    /// The firmware's memory against its budget.
    Size,
    /// Lints of the firmware for each board.
    ClippyFirmware,
    /// A second build in another place gives the same bytes.
    Reproducible,
    /// Every test, including those that run the firmware's ELF on the emulated board.
    Tests,
    /// A stock Linux kernel under QEMU drives the firmware on the emulated board.
    Kernel,
    /// The package for Python: wheel, types, tests, python-can's own tests, notebooks.
    Python,
    /// The command that a newcomer runs first: both channels at full load, nothing lost.
    Demo,
    /// The crates as they would be published: each packs.
    Package,
}

/// Runs the steps one after the other and stops at the first that fails.
pub fn run(args: &Args) -> Result<()> {
    use clap::ValueEnum;

    let steps = if args.only.is_empty() { Step::value_variants() } else { &args.only };
    let shell = workspace::shell()?;
    if std::env::var_os("CI").is_some() {
        // In CI nothing is compiled twice, and nobody uses a debugger.
        for name in ["CARGO_INCREMENTAL", "CARGO_PROFILE_DEV_DEBUG"] {
            if std::env::var_os(name).is_none() {
                shell.set_var(name, "0");
            }
        }
    }
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
            Step::Typos => return typos::check(shell),
            Step::Circles => check::circles()?,
            Step::Links => check::links()?,
            Step::Dependencies => dependencies::check(shell)?,
            Step::OldestCompiler => return compiler::check(shell),
            Step::Clippy => {
                cmd!(shell, "cargo clippy --locked --workspace --all-targets --all-features -- -D warnings")
                    .run()?;
            }
            Step::Features => features::check(shell)?,
            Step::Fuzz => {
                let target = workspace::target().join("fuzz");
                // A separate workspace, but with the same versions.
                shell.copy_file("Cargo.lock", "fuzz/Cargo.lock")?;
                cmd!(shell, "cargo check --manifest-path fuzz/Cargo.toml --target-dir {target}").run()?;
            }
            Step::Doc => {
                cmd!(shell, "cargo doc --locked --workspace --lib --no-deps --all-features")
                    .env("RUSTDOCFLAGS", "-D warnings")
                    .run()?;
            }
            Step::Wasm => return cross::check(shell, toolchain, cross::WASM),
            Step::Systems => return cross::check(shell, toolchain, cross::SYSTEMS),
            Step::Firmware => firmware::build_all(shell, toolchain, &Board::ALL)?,
            Step::Size => size::run()?,
            Step::ClippyFirmware => firmware::clippy(shell, toolchain)?,
            Step::Reproducible => reproducible::check(shell, toolchain)?,
            Step::Tests => tests::run(shell, peers)?,
            Step::Kernel => return kernel::run(shell),
            Step::Python => return python::check(shell, peers),
            Step::Demo => cmd!(shell, "cargo demo --time 3s").run()?,
            Step::Package => package::check(shell)?,
        }
        Ok(Outcome::Passed)
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
