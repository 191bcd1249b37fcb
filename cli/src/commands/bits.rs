//! `cantap bits`: a frame's exact length on the bus.

use std::process::ExitCode;

use cantap::Frame;

/// The command line.
#[derive(clap::Args)]
pub struct Args {
    /// The frame, as 123#DEADBEEF, 1F334455#, or 123#R4.
    frame: Frame,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    println!("{}", args.frame);
    Ok(ExitCode::SUCCESS)
}
