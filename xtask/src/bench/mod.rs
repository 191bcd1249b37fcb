//! `cargo xtask bench`: measures, and names the standard of comparison.
//!
//! Figures only mean something in a release build, so this program rebuilds itself as one, with what the
//! measurements need. One file per subject; each has `run()`, which prints its own table.

#[cfg(feature = "bench")]
mod autobaud;
#[cfg(feature = "bench")]
mod bus;
#[cfg(feature = "bench")]
mod clock;
#[cfg(feature = "bench")]
mod columns;
#[cfg(feature = "bench")]
mod emulated;
#[cfg(feature = "bench")]
mod extent;
#[cfg(feature = "bench")]
mod formats;
#[cfg(feature = "bench")]
mod graph;
#[cfg(feature = "bench")]
mod host;
#[cfg(feature = "bench")]
mod memory;
#[cfg(feature = "bench")]
mod mf4_blocks;
#[cfg(feature = "bench")]
mod monitor;
#[cfg(feature = "bench")]
mod protocols;
#[cfg(feature = "bench")]
mod seek;
#[cfg(all(feature = "bench", unix))]
mod serve;
#[cfg(feature = "bench")]
mod signals;
#[cfg(feature = "bench")]
mod stats;
#[cfg(feature = "bench")]
mod tasks;
#[cfg(feature = "bench")]
mod wire;

use anyhow::Result;
#[cfg(not(feature = "bench"))]
use xshell::cmd;

/// What is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Subject {
    /// Bytes per frame on the wire, and the encoder's cost in time.
    Wire,
    /// Converting and reading trace files, against log2asc and python-can.
    Formats,
    /// A second out of a large trace, with an index and without.
    Seek,
    /// Sizes and times of Parquet, compared with trace formats.
    Columns,
    /// How much memory the command occupies with long traces, in every format.
    Memory,
    /// Decoding signals, against cantools.
    Signals,
    /// What the firmware's ELF costs and can bear on the emulated board.
    Emulated,
    /// Replies, periods, replay and load on the emulated bus.
    Bus,
    /// The search for a bit rate, by rates, densities and damage.
    Autobaud,
    /// Mapping device time to UTC, and two boards' times to each other.
    Clock,
    /// Frames per second that the host decodes, with stamps tightened and converted to UTC.
    Host,
    /// Frames per second for which load, periods and losses are computed.
    Stats,
    /// Frames per second that all protocols read together.
    Protocols,
    /// Redraws of the live view's graph with five million values in the window.
    Graph,
    /// The package for Python, compared with python-can, cantools and asammdf.
    Python,
    /// The live view in tmux at full load: redraws, answers to keys, processor, memory, recording.
    Monitor,
    /// A shared board: eight clients on two saturated channels, two of them slow.
    Serve,
}

/// The arguments of `cargo xtask bench`.
#[derive(clap::Args)]
pub struct Args {
    /// What to measure; everything if not given.
    subject: Vec<Subject>,
    /// How long the live view is watched, and how long the board is shared.
    #[arg(long, value_name = "N", default_value_t = 60)]
    seconds: u32,
    /// Of the measurements on the emulated board and of a large trace, only the rows whose names contain this.
    #[arg(long, value_name = "TEXT", default_value = "")]
    rows: String,
    /// Measure on the emulated board for a tenth of the time, and a trace of a fifth of the size: the figures are good enough to work with.
    #[arg(long)]
    quick: bool,
    /// How many times as long the large trace is: 10 makes 10 GB of candump log.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=20))]
    times: u64,
}

/// Builds this program in release mode and measures with it.
#[cfg(not(feature = "bench"))]
pub fn run(args: &Args) -> Result<()> {
    use clap::ValueEnum;

    let shell = crate::workspace::shell()?;
    let subjects = args.subject.iter().filter_map(Subject::to_possible_value);
    let seconds = args.seconds.to_string();
    let subjects: Vec<String> = subjects.map(|subject| subject.get_name().to_owned()).collect();
    let rows = &args.rows;
    let quick = args.quick.then_some("--quick");
    let times = args.times.to_string();
    cmd!(
        shell,
        "cargo run --release --quiet -p xtask --features bench -- bench {subjects...} --seconds {seconds} --rows {rows} --times {times} {quick...}"
    )
    .quiet()
    .run()?;
    Ok(())
}

/// Runs the measurements.
#[cfg(feature = "bench")]
pub fn run(args: &Args) -> Result<()> {
    use clap::ValueEnum;

    let extent = extent::Extent { rows: &args.rows, quick: args.quick, times: args.times };
    let subjects = if args.subject.is_empty() { Subject::value_variants() } else { &args.subject };
    for subject in subjects {
        match subject {
            Subject::Wire => wire::run()?,
            Subject::Formats => formats::run()?,
            Subject::Seek => seek::run(&extent)?,
            Subject::Columns => columns::run()?,
            Subject::Memory => memory::run()?,
            Subject::Signals => signals::run()?,
            Subject::Emulated => emulated::run(&extent)?,
            Subject::Bus => bus::run(&extent)?,
            Subject::Autobaud => autobaud::run(&extent)?,
            Subject::Clock => clock::run()?,
            Subject::Host => host::run(),
            Subject::Stats => stats::run()?,
            Subject::Protocols => protocols::run()?,
            Subject::Graph => graph::run()?,
            Subject::Python => crate::python::measure()?,
            Subject::Monitor => monitor::run(args.seconds)?,
            #[cfg(unix)]
            Subject::Serve => serve::run(args.seconds)?,
            #[cfg(not(unix))]
            Subject::Serve => {
                anyhow::bail!("this shares a board over UNIX sockets, which this system does not have")
            }
        }
    }
    Ok(())
}
