//! The project's own build steps: `cargo xtask firmware | test | ci | kernel | circles | links | public-api | size | bench | soak | web | dist`.
//!
//! Kept light, because `cargo fw` builds it first: what only measurements and checks need is optional, behind
//! features.

#![forbid(unsafe_code)]

mod bench;
mod board;
mod check;
#[cfg(feature = "check")]
mod circles;
mod compiler;
mod cross;
mod dependencies;
mod dist;
mod failures;
mod features;
mod firmware;
mod fleet;
mod kernel;
#[cfg(feature = "check")]
mod links;
mod machine;
mod meanwhile;
mod metadata;
mod mutants;
mod outcome;
mod package;
mod peers;
mod processor_time;
#[cfg(feature = "check")]
mod public_api;
mod python;
mod reproducible;
mod size;
mod soak;
mod steps;
mod test;
mod tests;
mod toolchain;
mod typos;
mod web;
#[cfg(unix)]
mod wine;
mod workspace;

use std::ffi::OsString;
use std::process::{Command, ExitCode};

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
    /// Checks what a change needs before it is sent in, from a fresh clone on.
    Test(test::Args),
    /// Checks everything that must hold before a change lands, from a fresh clone on.
    Ci(test::Args),
    /// Boots stock Linux kernels that drive the firmware on the emulated board, part by part or whole.
    Kernel(kernel::Args),
    /// Finds files of one crate that import each other in a circle, and public types of one crate that share a name.
    Circles,
    /// Finds broken links in the pages, and files named there that do not exist.
    Links,
    /// Compares the public items of each published library with its `public-api.txt`.
    PublicApi,
    /// Prints each board's flash and static RAM, and fails past `size-budget.toml`.
    Size,
    /// Measures speed and size.
    Bench(bench::Args),
    /// Runs the firmware on the emulated board for a long time, with a new seed for each run.
    Soak(soak::Args),
    /// Builds the page of `cantap report` into `target/web/page.html`.
    Web,
    /// Packs a release: the command, Debian's package, each board's firmware.
    Dist(dist::Args),
}

fn main() -> ExitCode {
    if let Some(code) = as_if_run_by_hand() {
        return code;
    }
    let result = match Cli::parse().task {
        Task::Firmware(args) => firmware::run(&args),
        Task::Test(args) => test::run(&args),
        Task::Ci(args) => test::ci(&args),
        Task::Kernel(args) => kernel::main(&args),
        Task::Circles => check::circles(),
        Task::Links => check::links(),
        Task::PublicApi => check::public_api(),
        Task::Size => size::run(&board::Board::ALL),
        Task::Bench(args) => bench::run(&args),
        Task::Soak(args) => soak::run(&args),
        Task::Web => web::run(),
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

/// Runs this program once more if cargo runs it. Cargo describes a package to the program in variables, and there are build scripts that
/// watch them (ring's): run from here and by hand in turn, it would compile their crates, and all above them, each time anew.
fn as_if_run_by_hand() -> Option<ExitCode> {
    let is_of_package = |name: &OsString| name.to_str().is_some_and(|name| name.starts_with("CARGO_PKG_"));
    let names: Vec<OsString> = std::env::vars_os().map(|(name, _)| name).filter(is_of_package).collect();
    if names.is_empty() {
        return None;
    }
    let mut again = Command::new(std::env::current_exe().ok()?);
    again.args(std::env::args_os().skip(1));
    for name in names {
        again.env_remove(name);
    }
    #[cfg(unix)]
    {
        // In its place; it returns only if that is impossible.
        let _ = std::os::unix::process::CommandExt::exec(&mut again);
        None
    }
    #[cfg(not(unix))]
    again.status().ok().map(|status| if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
