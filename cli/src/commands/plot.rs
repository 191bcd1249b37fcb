//! `cantap plot`: a picture of a trace, in a file or in the terminal.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use cantap::{Id, TraceRecord};
use cantap_analysis::plot::{
    Axis, Content, DEFAULT_WIDTH, LoadCollector, MOST_CURVES, NamedValue, PictureFormat, Plot,
    SignalCollector, TextStyle, TimingCollector,
};
use cantap_analysis::stats;
use cantap_formats::time_range::date_text;
use cantap_protocols::{FieldSelection, FieldValue, Options, ReadItem};
use cantap_signals::Decoder;
use cantap_trace::filter::Filter;
use cantap_trace::grammar;

use crate::args;
use crate::completion;
use crate::database_args::{DatabaseArgs, load, load_selected};
use crate::input::{ReadArgs, filtered};
use crate::protocols::{ProtocolArgs, reading};
use crate::range_args::RangeArgs;
use crate::trace_output::failed;
use crate::usage_error::usage;
use cantap_work::atomic_file;
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::missing::Missing;
use serde_json::json;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap plot trace.log --db car.dbc --signal Speed --signal 'Engine.*' \\\n      \
                -o drive.svg\n  \
                cantap plot trace.log --bus-load -b 500k --window 100ms -o load.png\n  \
                cantap plot trace.log --timing 123\n  \
                cantap plot boat.log --signal nmea2000.speed --signal 'j1939.engine_*'\n\n\
                Without -o the picture is drawn in the terminal. Where frames were lost, curves are interrupted and the \
                place is shaded.")]
pub struct Args {
    /// The trace; - for standard input.
    #[arg(value_name = "IN")]
    input: PathBuf,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    protocol: ProtocolArgs,
    /// Signals to draw, by name or Message.Signal, and values of protocols, by the names that conditions have (j1939.engine_speed, obd.*); with *, ?
    /// and [a-z]. Can be repeated. Default: all signals.
    #[arg(short, long = "signal", value_name = "PATTERN", add = completion::signals())]
    signals: Vec<String>,
    /// Draw the bus load over time, or frames/s if no bit rate is given and the trace says none.
    #[arg(long, conflicts_with_all = ["signals", "timing"])]
    bus_load: bool,
    /// Draw a histogram of this identifier's periods.
    #[arg(long, value_name = "ID", conflicts_with = "signals", value_parser = grammar::identifier, add = completion::identifiers())]
    timing: Option<Id>,
    /// The bit rate for the load, such as 500k, or 2:250k for one channel.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE", requires = "bus_load", conflicts_with_all = ["signals", "timing"], add = completion::bit_rates())]
    bitrates: Vec<ChannelBitrate>,
    /// The bit rate of the data phase of CAN FD frames that switch, such as 2M, or 2:5M for one channel. Without it, the load of windows with
    /// such frames is not known.
    #[arg(long = "data-bitrate", value_name = "[CHANNEL:]RATE", requires = "bitrates", add = completion::bit_rates())]
    data_bitrates: Vec<ChannelBitrate>,
    /// Length of the load's windows.
    #[arg(short, long, value_name = "TIME", default_value = "1s", requires = "bus_load", conflicts_with_all = ["signals", "timing"], value_parser = args::positive_duration)]
    window: Duration,
    /// The file to write: .svg, .png or .html.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Width: pixels in a file, columns in the terminal.
    #[arg(long)]
    width: Option<u32>,
    #[command(flatten)]
    range: RangeArgs,
    /// The vertical range, LOW:HIGH.
    #[arg(long = "y", value_name = "LOW:HIGH", value_parser = vertical, allow_hyphen_values = true)]
    vertical: Option<(f64, f64)>,
    /// Draw at most this many signals.
    #[arg(long, value_name = "N", default_value_t = MOST_CURVES, conflicts_with_all = ["bus_load", "timing"])]
    curves: usize,
    /// Title; default: the trace's name.
    #[arg(long)]
    title: Option<String>,
    /// Do not report what is wrong with usable databases, and which of them replaces another.
    #[arg(short, long)]
    quiet: bool,
    /// Print one JSON object about the picture.
    #[arg(long, requires = "output")]
    json: bool,
    #[command(flatten)]
    read: ReadArgs,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    // A wrong name should not be discovered after an hour of reading.
    if let Some(path) = &args.output {
        PictureFormat::of_path(path).map_err(|error| usage(error.to_string()))?;
    }
    let (mut plot, read) = collect(args)?;
    for pane in &mut plot.panes {
        if matches!(pane.content, Content::Analogue(_)) {
            pane.range = args.vertical.or(pane.range);
        }
    }
    match &args.output {
        Some(path) => {
            let picture = plot.render(PictureFormat::of_path(path)?, args.width.unwrap_or(DEFAULT_WIDTH))?;
            atomic_file::write(path, &picture).with_context(|| failed(path))?;
        }
        None => std::io::stdout().lock().write_all(plot.to_text(&terminal_style(args)).as_bytes())?,
    }
    if let (Some(path), true) = (&args.output, args.json) {
        let curves = plot.panes.iter().flat_map(|pane| pane.content.curves());
        let mut object = json!({
            "output": path.display().to_string(),
            "curves": curves.map(|curve| curve.name.as_str()).collect::<Vec<_>>(),
            "not_drawn": read.not_drawn,
        });
        read.missing.put_into(&mut object);
        writeln!(std::io::stdout(), "{object}")?;
    }
    Ok(ExitCode::SUCCESS)
}

/// What is known of the trace besides its picture.
#[derive(Default)]
struct Read {
    /// The beginning of the part that is drawn.
    first_ns: Option<i64>,
    missing: Missing,
    /// Number of signals beyond the limit.
    not_drawn: u64,
}

fn collect(args: &Args) -> anyhow::Result<(Plot, Read)> {
    let name = args.input.file_name().map_or("-".into(), |name| name.to_string_lossy());
    let title = |what: &str| args.title.clone().unwrap_or_else(|| format!("{name}: {what}"));
    // What is wrong with a database matters only where its signals are drawn.
    let filters = || args.read.filters(&load(&args.databases.options(), false, true)?);
    if args.bus_load {
        let filters = filters()?;
        if !filtered(&filters).is_empty() {
            return Err(usage(
                "a filter hides part of the bus's load; leave -f out, or give only a channel, as -f can0",
            ));
        }
        let data = ChannelBitrate::options(&args.data_bitrates);
        let options = stats::Options {
            window: args.window,
            data_bitrate_bps: data.bitrate_bps,
            channel_data_bitrate_bps: data.channel_bitrate_bps,
            ..ChannelBitrate::options(&args.bitrates)
        };
        let mut collector = LoadCollector::new(options)?;
        let mut learned = 0;
        let read = for_each(args, filters, |bit_rates, record| {
            for (channel, bps) in bit_rates.get(learned..).unwrap_or_default() {
                collector.learn_bitrate(*channel, *bps);
            }
            learned = bit_rates.len();
            collector.push(record);
        })?;
        let (plot, unknown) = collector.finish_counting(title("bus load"));
        if plot.is_empty() && unknown > 0 {
            bail!(
                "the load of none of the {unknown} windows is known: there are CAN FD frames that switch their bit rate; give it with \
                 --data-bitrate, such as --data-bitrate 2M"
            );
        }
        if plot.is_empty() {
            bail!("there is nothing to draw in {name}{}", within(args));
        }
        if unknown > 0 {
            eprintln!(
                "cantap: {unknown} windows are not drawn: they have CAN FD frames that switch their bit rate, or the channel has no bit rate; \
                 give them with --data-bitrate and -b"
            );
        }
        return Ok((dated(plot, read.first_ns), read));
    }
    if let Some(id) = args.timing {
        let mut collector = TimingCollector::new(id);
        let read = for_each(args, filters()?, |_, record| collector.push(record))?;
        let plot = collector.finish(title(&format!("periods of {id}")));
        if plot.panes.is_empty() {
            bail!("there are no two frames of {id} without a loss between them in {name}");
        }
        return Ok((plot, read));
    }
    let mut fields = FieldSelection::default();
    let mut signals = Vec::new();
    for pattern in &args.signals {
        if !fields.add(pattern).context("--signal")? {
            signals.push(pattern.clone());
        }
    }
    if args.databases.is_empty() && fields.is_empty() {
        return Err(usage(
            "no database to find signals in; give one with --db FILE, name a protocol's value (--signal obd.engine_speed), or ask for \
             --bus-load or --timing ID",
        ));
    }
    // With values of protocols alone, the database serves their names.
    let decoder = if signals.is_empty() && !fields.is_empty() {
        load(&args.databases.options(), args.read.strict, args.quiet)?
    } else {
        load_selected(&args.databases.options(), args.read.strict, args.quiet, &signals)?
    };
    let none = Decoder::new(Vec::new());
    let drawn = if signals.is_empty() && !fields.is_empty() { &none } else { &decoder };
    let mut collector = SignalCollector::new(drawn).with_most_curves(args.curves);
    let filters = args.read.filters(&decoder)?;
    let mut read = if fields.is_empty() {
        for_each(args, filters, |_, record| collector.push(record))?
    } else {
        let decoder = if args.databases.is_empty() { None } else { Some(Arc::new(decoder.clone())) };
        with_fields(args, filters, decoder, &mut fields, &mut collector)?
    };
    for pattern in fields.unmatched() {
        eprintln!(
            "cantap: nothing had a number {pattern}; `cantap conversations` shows what there is, with its names"
        );
    }
    if collector.is_empty() {
        let shows = if fields.is_empty() { "decode" } else { "conversations" };
        bail!("none of the signals is in {name}{}; `cantap {shows}` shows what is", within(args));
    }
    read.not_drawn = collector.left_out();
    if read.not_drawn > 0 {
        let curves = args.curves;
        eprintln!(
            "cantap: only the first {curves} signals are drawn; choose with --signal PATTERN, or draw more with --curves"
        );
    }
    Ok((dated(collector.finish(title("signals")), read.first_ns), read))
}

/// Reads the part of the trace to be drawn also by the protocols of the selected fields.
fn with_fields(
    args: &Args,
    filters: Vec<Filter>,
    decoder: Option<Arc<Decoder>>,
    fields: &mut FieldSelection,
    collector: &mut SignalCollector<'_>,
) -> anyhow::Result<Read> {
    let options = Options { protocols: fields.protocols(), ..args.protocol.options(args.quiet)? };
    let mut reading = reading(options, decoder, args.quiet);
    let mut take = |records: &[TraceRecord], more| {
        let Ok(()) = reading.take_both(records, more, |item| {
            match item {
                ReadItem::Record(record) => collector.push(record),
                ReadItem::Event(event) => {
                    for FieldValue { name, parts, unit, value, text } in fields.take(&event) {
                        let (time_ns, channel) = (event.time_ns, event.channel);
                        let (name, parts) = (name.as_str(), &parts[..]);
                        collector.push_named(&NamedValue {
                            time_ns,
                            channel,
                            name,
                            parts,
                            unit,
                            value,
                            text,
                        });
                    }
                }
                ReadItem::Announcement(_) => {}
            }
            Ok::<_, std::convert::Infallible>(())
        });
    };
    let read = for_each(args, filters, |_, record| take(std::slice::from_ref(record), true))?;
    take(&[], false);
    Ok(read)
}

/// Where nothing was found, if that is only a part of the trace.
fn within(args: &Args) -> &'static str {
    if args.range.is_given() { " between --start and --end" } else { "" }
}

/// Reads the part of the trace to be drawn. `take` also gets the bit rates that the trace has said so far.
fn for_each(
    args: &Args,
    filters: Vec<Filter>,
    mut take: impl FnMut(&[(u8, u32)], &TraceRecord),
) -> anyhow::Result<Read> {
    let mut records = args.read.open(&args.input, filters)?.within(args.range.of(Some(&args.input))?)?;
    let mut batch = Vec::new();
    let mut first_ns = None;
    while records.next_batch(&mut batch)? {
        for record in &batch {
            first_ns = first_ns.or(Some(record.time_ns));
            take(records.bit_rates(), record);
        }
    }
    Ok(Read { first_ns, missing: records.missing(), not_drawn: 0 })
}

/// The plot with the date of its beginning on the axis.
fn dated(plot: Plot, first_ns: Option<i64>) -> Plot {
    let Some(date) = first_ns.and_then(date_text) else { return plot };
    let axis = match plot.axis {
        Axis::Time { zero } => Axis::Time { zero: format!("{date} ({zero})") },
        axis @ Axis::Value { .. } => axis,
    };
    Plot { axis, ..plot }
}

/// `0:100`, `-40:85`.
fn vertical(text: &str) -> Result<(f64, f64), String> {
    let parse = |text: &str| text.trim().parse::<f64>().ok().filter(|value| value.is_finite());
    let range = text.split_once(':').and_then(|(low, high)| parse(low).zip(parse(high)));
    range
        .filter(|(low, high)| low < high)
        .ok_or_else(|| "write the range as LOW:HIGH, such as 0:100".to_owned())
}

/// What the terminal supports; a file or pipe gets no colours.
fn terminal_style(args: &Args) -> TextStyle {
    let is_terminal = std::io::stdout().is_terminal();
    let columns = || terminal_size::terminal_size().map(|(columns, _)| usize::from(columns.0));
    let width = args.width.map(|width| width as usize).or_else(columns);
    TextStyle {
        width: width.unwrap_or(TextStyle::default().width),
        colour: is_terminal && std::env::var_os("NO_COLOR").is_none(),
        unicode: cantap_work::locale::is_utf8_locale(),
        ..TextStyle::default()
    }
}
