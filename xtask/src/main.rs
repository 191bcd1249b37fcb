//! The project's own build steps: `cargo xtask firmware | test | size | bench | soak | dist`.
//!
//! Kept light, because `cargo fw` builds it first: what only the benchmarks need hides behind a feature.

#![forbid(unsafe_code)]

mod bench;
mod board;
mod compiler;
mod cross;
mod dependencies;
mod dist;
mod features;
mod firmware;
mod kernel;
mod metadata;
mod outcome;
mod package;
mod peers;
mod reproducible;
mod size;
mod soak;
mod test;
mod tests;
mod toolchain;
mod typos;
mod workspace;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// The project's own build steps.
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", version)]
struct Cli {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Builds the firmware into `target/firmware/cantap-BOARD.elf` (also `cargo fw`).
    Firmware(firmware::Args),
    /// Does everything that must hold before a change lands, from a fresh clone on.
    Test(test::Args),
    /// Prints each board's flash and static RAM, and fails past `size-budget.toml`.
    Size,
    /// Measures speed and size.
    Bench(bench::Args),
    /// Runs the firmware on the emulated board for a long time, with a new seed for each run.
    Soak(soak::Args),
    /// Packs what a release has: the command, Debian's package, each board's firmware.
    Dist(dist::Args),
}

fn main() -> ExitCode {
    let result = match Cli::parse().task {
        Task::Firmware(args) => firmware::run(&args),
        Task::Test(args) => test::run(&args),
        Task::Size => size::run(),
        Task::Bench(args) => bench::run(&args),
        Task::Soak(args) => soak::run(&args),
        Task::Dist(args) => dist::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("xtask: {error:#}");
            ExitCode::FAILURE
        }
    }
}
