//! `cantap plot`: a picture of a trace, in a file or in the terminal.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::bail;
use cantap::Id;
use cantap_analysis::plot::{
    DEFAULT_WIDTH, LoadCollector, MOST_CURVES, PictureFormat, Plot, SignalCollector, TextStyle,
    TimingCollector,
};
use cantap_analysis::stats::Options;

use crate::args;
use crate::channel_bitrate::ChannelBitrate;
use crate::databases::DatabaseArgs;
use crate::input::{ReadArgs, Records};

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
    cantap plot trace.log --db car.dbc --signal Speed --signal 'Engine.*' -o drive.svg\n  \
    cantap plot trace.log --bus-load -b 500k --window 100ms -o load.png\n  \
    cantap plot trace.log --timing 123\n\n\
Without -o the picture is drawn in the terminal. Where frames were lost, curves are interrupted and the\n\
place is shaded.")]
pub struct Args {
    /// The trace; - for standard input.
    #[arg(value_name = "IN")]
    input: PathBuf,
    #[command(flatten)]
    databases: DatabaseArgs,
    /// Signals to draw, by name or Message.Signal; with *, ? and [a-z]. Can be repeated. All without it.
    #[arg(short, long = "signal", value_name = "PATTERN")]
    signals: Vec<String>,
    /// Draw the bus load over time, or frames/s where no bit rate is given.
    #[arg(long, conflicts_with_all = ["signals", "timing"])]
    bus_load: bool,
    /// Draw how long the periods of this identifier are: 3 hexadecimal digits, or 8 for 29 bits.
    #[arg(long, value_name = "ID", conflicts_with = "signals")]
    timing: Option<Id>,
    /// The bit rate for the load, such as 500k, or 2:250k for one channel.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]BITRATE", requires = "bus_load")]
    bitrates: Vec<ChannelBitrate>,
    /// Length of the load's windows.
    #[arg(short, long, value_name = "TIME", default_value = "1s", value_parser = args::duration)]
    window: Duration,
    /// The file to write: .svg, .png or .html.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Width: pixels in a file, columns in the terminal.
    #[arg(long)]
    width: Option<u32>,
    /// Heading; the trace's name without it.
    #[arg(long)]
    title: Option<String>,
    /// Leave out what is wrong with databases that can be used, and which of them replaces another.
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    read: ReadArgs,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    // A wrong name should not be found out after an hour of reading.
    if let Some(path) = &args.output {
        PictureFormat::of_path(path)?;
    }
    let plot = collect(args)?;
    match &args.output {
        Some(path) => plot.save(path, args.width.unwrap_or(DEFAULT_WIDTH))?,
        None => std::io::stdout().lock().write_all(plot.to_text(&terminal_style(args)).as_bytes())?,
    }
    Ok(ExitCode::SUCCESS)
}

fn collect(args: &Args) -> anyhow::Result<Plot> {
    let name = args.input.file_name().map_or("-".into(), |name| name.to_string_lossy());
    let title = |what: &str| args.title.clone().unwrap_or_else(|| format!("{name}: {what}"));
    if args.bus_load {
        let options = Options { window: args.window, ..ChannelBitrate::options(&args.bitrates) };
        let mut collector = LoadCollector::new(options)?;
        for_each(args.read.open(&args.input)?, |record| collector.push(record))?;
        return Ok(collector.finish(title("bus load")));
    }
    if let Some(id) = args.timing {
        let mut collector = TimingCollector::new(id);
        for_each(args.read.open(&args.input)?, |record| collector.push(record))?;
        let plot = collector.finish(title(&format!("periods of {id}")));
        if plot.panes.is_empty() {
            bail!("there are no two frames of {id} without a loss between them in {name}");
        }
        return Ok(plot);
    }
    if args.databases.is_empty() {
        bail!(
            "no database to find signals in; give one with --db FILE, or ask for --bus-load or --timing ID"
        );
    }
    let decoder = args.databases.load_some(args.read.strict, args.quiet, &args.signals)?;
    let mut collector = SignalCollector::new(&decoder);
    for_each(args.read.open(&args.input)?, |record| collector.push(record))?;
    if collector.is_empty() {
        bail!("none of the signals is in {name}; `cantap decode` shows what is");
    }
    if collector.left_out() > 0 {
        eprintln!("cantap: only the first {MOST_CURVES} signals are drawn; choose with --signal PATTERN");
    }
    Ok(collector.finish(title("signals")))
}

fn for_each(mut records: Records, mut take: impl FnMut(&cantap::TraceRecord)) -> anyhow::Result<()> {
    let mut batch = Vec::new();
    while records.next_batch(&mut batch)? {
        batch.iter().for_each(&mut take);
    }
    Ok(())
}

/// What the terminal can show; a file or pipe gets no colours.
fn terminal_style(args: &Args) -> TextStyle {
    let is_terminal = std::io::stdout().is_terminal();
    let columns = || terminal_size::terminal_size().map(|(columns, _)| usize::from(columns.0));
    let width = args.width.map(|width| width as usize).or_else(columns);
    TextStyle {
        width: width.unwrap_or(TextStyle::default().width),
        colour: is_terminal && std::env::var_os("NO_COLOR").is_none(),
        unicode: crate::args::is_utf8_locale(),
        ..TextStyle::default()
    }
}
