//! `cargo xtask soak`: the real firmware on the emulated board, for long: one session for an emulated hour, or run after run, never with the
//! same traffic twice.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use xshell::{Shell, cmd};

use crate::board::Board;
use crate::workspace;

/// The arguments of `cargo xtask soak`.
#[derive(clap::Args)]
pub struct Args {
    /// Runs for so many minutes, one after the other, each with traffic of its own. The run under way at that time is still finished.
    #[arg(long, conflicts_with = "emulated_seconds")]
    minutes: Option<u64>,
    /// Without --minutes: emulated seconds of one session at full load on both channels, undisturbed and with stalls, requests and
    /// replays in turn. An emulated hour takes several.
    #[arg(long, default_value_t = 3_600)]
    emulated_seconds: u64,
    /// Seed of the first run; each further run takes the next number.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// With --minutes: emulated seconds per run.
    #[arg(long, default_value_t = 2)]
    seconds: u64,
}

/// Runs until the time is up or a check fails.
pub fn run(args: &Args) -> Result<()> {
    let shell = workspace::shell()?;
    let elf = Board::ALL[0].elf();
    ensure!(elf.exists(), "there is no {}; run `cargo xtask firmware`", elf.display());
    cmd!(shell, "cargo build --release -p cantap-sim").run()?;
    match args.minutes {
        Some(minutes) => runs(&shell, args, minutes),
        None => session(&shell, args),
    }
}

/// One session.
fn session(shell: &Shell, args: &Args) -> Result<()> {
    let (simulator, elf) = (workspace::target().join("release/cantap-sim"), Board::ALL[0].elf());
    let (seconds, seed) = (args.emulated_seconds.to_string(), args.seed.to_string());
    cmd!(shell, "{simulator} soak {elf} --seconds {seconds} --seed {seed}").run()?;
    Ok(())
}

/// Run after run.
fn runs(shell: &Shell, args: &Args, minutes: u64) -> Result<()> {
    let (simulator, elf) = (workspace::target().join("release/cantap-sim"), Board::ALL[0].elf());
    let until = Instant::now() + Duration::from_mins(minutes);
    let seconds = args.seconds.to_string();
    let mut runs = 0;
    while Instant::now() < until {
        let seed = (args.seed + runs).to_string();
        cmd!(shell, "{simulator} run {elf} --seconds {seconds} --frames mix --seed {seed}").run()?;
        runs += 1;
    }
    println!("{runs} runs of {seconds} s, seeds from {}: every check held", args.seed);
    Ok(())
}
