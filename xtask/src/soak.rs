//! `cargo xtask soak`: the real firmware on the emulated board, hour after hour, never with the same traffic
//! twice.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use xshell::cmd;

use crate::board::Board;
use crate::workspace;

/// The arguments of `cargo xtask soak`.
#[derive(clap::Args)]
pub struct Args {
    /// How long, in minutes. The run under way at that time is still finished.
    #[arg(long)]
    minutes: u64,
    /// Seed of the first run; each further run takes the next number.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Emulated seconds per run.
    #[arg(long, default_value_t = 2)]
    seconds: u64,
}

/// Runs until the time is up or a check fails.
pub fn run(args: &Args) -> Result<()> {
    let shell = workspace::shell()?;
    let elf = Board::ALL[0].elf();
    ensure!(elf.exists(), "there is no {}; run `cargo xtask firmware`", elf.display());
    cmd!(shell, "cargo build --release -p cantap-sim").run()?;
    let simulator = workspace::target().join("release/cantap-sim");
    let until = Instant::now() + Duration::from_mins(args.minutes);
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
