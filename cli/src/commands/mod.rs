//! The subcommands. Each file has an `Args` for its command line and a `run`.

pub mod bits;
pub mod decode;
pub mod diff;
pub mod plot;
pub mod search;
pub mod stats;
pub mod timing;

use std::process::ExitCode;

/// One subcommand.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Show a frame's exact length on the bus, stuff bits and CRC.
    Bits(bits::Args),
    /// Draw signals, bus load or periods of a trace: SVG, PNG, HTML, or in the terminal.
    Plot(plot::Args),
    /// Measure a trace or a bus: load, rates, periods, losses, errors.
    Stats(stats::Args),
    /// Show a trace as signals, by DBC or signal file.
    Decode(decode::Args),
    /// Show what two traces say differently: IDs, periods, lengths, bits.
    Diff(diff::Args),
    /// Find frames in a trace by ID, data or a condition on signals.
    Search(search::Args),
    /// List every bit timing of a bit rate, what each is worth, and the one to choose.
    Timing(timing::Args),
}

impl Command {
    /// Runs it.
    pub fn run(self) -> anyhow::Result<ExitCode> {
        match self {
            Self::Bits(args) => bits::run(&args),
            Self::Plot(args) => plot::run(&args),
            Self::Stats(args) => stats::run(&args),
            Self::Decode(args) => decode::run(&args),
            Self::Diff(args) => diff::run(&args),
            Self::Search(args) => search::run(&args),
            Self::Timing(args) => timing::run(&args),
        }
    }
}
