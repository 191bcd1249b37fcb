//! What is done to the device itself: `cantap identify` and `cantap reset`.

use std::io::Write;
use std::process::ExitCode;

use crate::boards::OneBoard;

/// The command line of `cantap identify`.
#[derive(clap::Args)]
pub struct Identify {
    #[command(flatten)]
    device: OneBoard,
    /// How long to show the pattern, in seconds.
    #[arg(short, long, default_value_t = 5, value_parser = clap::value_parser!(u8).range(1..))]
    seconds: u8,
}

/// The command line of `cantap reset`.
#[derive(clap::Args)]
pub struct Reset {
    #[command(flatten)]
    device: OneBoard,
}

/// Runs `cantap identify`.
pub fn identify(args: &Identify) -> anyhow::Result<ExitCode> {
    args.device.open()?.identify(args.seconds)?;
    writeln!(std::io::stdout(), "its LEDs blink for {} s", args.seconds)?;
    Ok(ExitCode::SUCCESS)
}

/// Runs `cantap reset`.
pub fn reset(args: &Reset) -> anyhow::Result<ExitCode> {
    args.device.open()?.reset()?;
    writeln!(std::io::stdout(), "restarting")?;
    Ok(ExitCode::SUCCESS)
}
