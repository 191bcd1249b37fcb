//! Commands for the device itself: `cantap identify` and `cantap reset`.

use std::io::Write;
use std::process::ExitCode;

use crate::args;
use crate::one_board::OneBoard;

/// The command line of `cantap identify`.
#[derive(clap::Args)]
pub struct Identify {
    #[command(flatten)]
    device: OneBoard,
    /// How long to show the pattern: whole seconds, up to 255.
    #[arg(short, long, alias = "seconds", value_name = "TIME", default_value = "5s", value_parser = whole_seconds)]
    time: u8,
}

fn whole_seconds(text: &str) -> Result<u8, String> {
    let time = args::positive_duration(text)?;
    let seconds = u8::try_from(time.as_secs()).ok().filter(|_| time.subsec_nanos() == 0);
    seconds.ok_or_else(|| "give whole seconds, up to 255s".to_owned())
}

/// The command line of `cantap reset`.
#[derive(clap::Args)]
pub struct Reset {
    #[command(flatten)]
    device: OneBoard,
}

/// Runs `cantap identify`.
pub fn identify(args: &Identify) -> anyhow::Result<ExitCode> {
    args.device.open()?.identify(args.time)?;
    writeln!(std::io::stdout(), "its LEDs blink for {} s", args.time)?;
    Ok(ExitCode::SUCCESS)
}

/// Runs `cantap reset`.
pub fn reset(args: &Reset) -> anyhow::Result<ExitCode> {
    args.device.open()?.reset()?;
    writeln!(std::io::stdout(), "restarting")?;
    Ok(ExitCode::SUCCESS)
}
