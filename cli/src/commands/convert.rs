//! `cantap convert`: from any trace format to any other.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::bail;
#[cfg(feature = "parquet")]
use cantap_columns::parquet::Key;
use cantap_formats::{
    ChannelInfo, Columns, CsvDialect, DifConvention, Format, LineEnd, RotateAt, Rotation, TableStyle,
    WriteOptions, Zone,
};
use cantap_signals::named::NamedFilter;

use crate::args;
#[cfg(feature = "parquet")]
use crate::columns;
use crate::completion;
use crate::database_args::DatabaseArgs;
use crate::input::{FollowArgs, ReadArgs};
use crate::range_args::RangeArgs;
use crate::trace_output::{TraceOutput, named};
use crate::usage_error::usage;
use cantap_work::channels::Channels;
use cantap_work::interrupt;
use cantap_work::missing::by_kind;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = after_help())]
pub struct Args {
    /// The trace to read; - for standard input.
    #[arg(value_name = "IN")]
    input: PathBuf,
    /// The trace to write; - for standard output.
    #[arg(value_name = "OUT")]
    output: PathBuf,
    /// Only these frames, in candump's syntax: can0,123:7FF,400~7F0,#FF,j; with a database also EngineData.
    /// If several are given, any may match.
    #[arg(value_name = "FILTER")]
    filters: Vec<NamedFilter>,
    /// The format of IN, if neither its content nor its name show it, or show the wrong one. All are listed below.
    #[arg(long, value_name = "FORMAT", add = completion::formats())]
    from: Option<Format>,
    /// IN is a table with these columns: time=Timestamp:ms,id=ID:hex,data=Data. By name or number from 1; also dlc, bytes, channel.
    #[arg(long, value_name = "COLUMNS", conflicts_with = "from")]
    columns: Option<Columns>,
    /// Wait for more at the end of IN, until Ctrl-C.
    #[arg(long)]
    follow: bool,
    /// Stop at the first fault in IN instead of leaving it out.
    #[arg(long)]
    strict: bool,
    /// Only these frames, as FILTER.
    #[arg(short, long = "filter", value_name = "FILTER")]
    filter_options: Vec<NamedFilter>,
    #[command(flatten)]
    databases: DatabaseArgs,
    /// Only these channels: 1, 2, several as 1,3, or both, which means all. Can be repeated. Default: all.
    #[arg(short, long, value_parser = args::channels_of_trace, add = completion::channels())]
    channel: Vec<Channels>,
    #[command(flatten)]
    range: RangeArgs,
    #[command(flatten)]
    write: WriteArgs,
    /// Make OUT a folder of Parquet files, in folders named after these, in this order: day, channel, or NAME=VALUE. Engines read
    /// it as one table. The files are named after IN: converting it again replaces them.
    #[cfg(feature = "parquet")]
    #[arg(long, value_name = "KEY", value_delimiter = ',', conflicts_with_all = ["format", "rotate"])]
    partition: Vec<Key>,
    /// Print the numbers as a JSON object, to standard error if the trace goes to standard output.
    #[arg(long)]
    json: bool,
}

/// Output options; other commands flatten them too.
#[derive(clap::Args)]
pub struct WriteArgs {
    /// The format to write, if the file's name does not show it: candump, asc, blf, trc (2.1), trc2.0, trc1.3, trc1.2,
    /// trc1.1, trc1.0, csv (python-can's), csv-full, csv-analyser, csv-gvret, pcapng, mf4, dif, parquet.
    #[arg(long, visible_alias = "to", value_name = "FORMAT", add = completion::written_formats())]
    format: Option<Format>,
    /// Begin a new file (trace-000001.log and so on) at this size (100M) or time (1h). Repeat for both.
    #[arg(long, value_name = "SIZE|TIME")]
    pub rotate: Vec<RotateAt>,
    /// Keep only this many of these files: the oldest are deleted.
    #[arg(long, value_name = "N", requires = "rotate", value_parser = clap::value_parser!(u32).range(1..))]
    keep: Option<u32>,
    /// The column separator of the earlier analyser's CSV (csv-analyser), otherwise ;.
    #[arg(long, value_name = "CHARACTER", value_parser = character)]
    separator: Option<u8>,
    /// The decimal mark of the earlier analyser's tables (csv-analyser, dif), otherwise a comma.
    #[arg(long, value_name = "CHARACTER", value_parser = character)]
    decimal_mark: Option<u8>,
    /// The line ends of the earlier analyser's tables (csv-analyser, dif), otherwise crlf.
    #[arg(long, value_name = "END", value_parser = ["crlf", "lf"])]
    line_end: Option<String>,
    /// What VECTORS counts in DIF, and whether V or an empty line follows a number: columns and V, otherwise so, or rows.
    #[arg(long, value_name = "CONVENTION", value_parser = ["columns", "rows"])]
    dif: Option<String>,
    /// The time zone of dates in files that do not name one, when reading or writing: Europe/Berlin, +02:00.
    #[arg(long, value_name = "ZONE", default_value_t)]
    pub zone: Zone,
}

fn character(text: &str) -> Result<u8, String> {
    match text {
        "tab" | "\\t" => Ok(b'\t'),
        _ => match text.as_bytes() {
            [character] if character.is_ascii_punctuation() || *character == b' ' => Ok(*character),
            _ => Err("write one character such as ; or , or tab".to_owned()),
        },
    }
}

impl WriteArgs {
    /// The library's options, with the format for a file whose name does not show it.
    pub fn options(&self, implied: Option<Format>) -> anyhow::Result<WriteOptions> {
        let own = TableStyle::default();
        let separator = self.separator.unwrap_or(own.separator);
        let decimal_mark = self.decimal_mark.unwrap_or(own.decimal_mark);
        if separator == decimal_mark {
            return Err(usage(
                "the separator and the decimal mark are the same character; choose different ones",
            ));
        }
        let rotation = Rotation { at: self.rotate.clone(), keep: self.keep.map(|keep| keep as usize) };
        let line_end = if self.line_end.as_deref() == Some("lf") { LineEnd::Lf } else { LineEnd::CrLf };
        let rows = self.dif.as_deref() == Some("rows");
        let dif = if rows { DifConvention::Rows } else { DifConvention::Columns };
        let table = TableStyle { separator, decimal_mark, line_end, dif };
        let format = self.format.or(implied);
        Ok(WriteOptions { format, rotation, table, zone: self.zone.clone(), ..WriteOptions::default() })
    }
}

impl WriteArgs {
    /// The first option that was given and means nothing unless a file is written.
    pub fn given(&self) -> Option<&'static str> {
        let given = [
            (self.format.is_some(), "--format"),
            (!self.rotate.is_empty(), "--rotate"),
            (self.separator.is_some(), "--separator"),
            (self.decimal_mark.is_some(), "--decimal-mark"),
            (self.line_end.is_some(), "--line-end"),
            (self.dif.is_some(), "--dif"),
        ];
        given.into_iter().find_map(|(given, option)| given.then_some(option))
    }

    /// Refuses options of tables for what is none: nothing of them would be in the file.
    pub fn check_style(&self, format: Option<Format>) -> anyhow::Result<()> {
        let (csv, dif) = (Format::Csv(CsvDialect::Analyser), Format::Dif);
        let format = format.unwrap_or(Format::Candump);
        for (given, option, of) in [
            (self.separator.is_some(), "--separator", &[csv][..]),
            (self.decimal_mark.is_some(), "--decimal-mark", &[csv, dif]),
            (self.line_end.is_some(), "--line-end", &[csv, dif]),
            (self.dif.is_some(), "--dif", &[dif]),
        ] {
            if given && !of.contains(&format) {
                let of: Vec<_> = of.iter().map(|format| format!("--format {format}")).collect();
                return Err(usage(format!(
                    "{option} is of {}, and this is {format}; leave it out, or write that",
                    of.join(" or ")
                )));
            }
        }
        Ok(())
    }
}

impl Args {
    /// Whether OUT contains columns rather than a trace.
    fn is_columns(&self) -> anyhow::Result<bool> {
        #[cfg(feature = "parquet")]
        {
            let is_folder = !self.partition.is_empty();
            if is_folder {
                columns::refuse_file(&self.output)?;
            }
            Ok(is_folder || columns::is_parquet(&self.output))
        }
        #[cfg(not(feature = "parquet"))]
        Ok(false)
    }

    fn create(&self, options: &WriteOptions, grows: bool) -> anyhow::Result<TraceOutput> {
        #[cfg(feature = "parquet")]
        if !self.partition.is_empty() {
            let name = columns::name_of(&self.input);
            return Ok(TraceOutput::dataset(&self.output, self.partition.clone(), name));
        }
        TraceOutput::create(&self.output, options, grows)
    }
}

/// Examples, and what the table of formats says.
fn after_help() -> String {
    let read: Vec<_> = Format::all()
        .filter(|format| !format.is_written() && *format != Format::Parquet)
        .map(|format| format.to_string())
        .collect();
    let (read, written) = (read.join(", "), format!("{}, {}", Format::written_names(), Format::Parquet));
    format!(
        "Examples:\n  \
    cantap convert trace.log trace.blf\n  \
    cantap convert trace.asc.gz - --filter can0,123:7FF | canplayer\n  \
    cantap convert day.blf part.csv --start 10m --end 20m --channel 1\n  \
    cantap convert trace.pcapng old.trc --format trc1.1\n  \
    cantap convert - days.log.zst --rotate 100M --keep 10\n  \
    cantap convert drive.blf drive.parquet\n  \
    cantap convert drive.blf fleet/ --partition vehicle=7,day,channel\n\n\
    Names end in .log, .asc, .blf, .trc, .csv, .pcapng, .mf4 or .dif; .gz, .zst, .xz and .lz4 behind that compress. \
    .parquet is a table for DuckDB, Polars, pandas and Spark, with a row for each record. \
    Files of any other program are known by their beginning.\n\n\
    Dates in ASC, TRC, BLF and some logs are the clock of the computer that wrote them: name its zone with --zone.\n\n\
    Read and written: {written}. Only read: {read}. trc is version 2.1, csv and sqlite are python-can's, csv-gvret SavvyCAN's.\n\n\
    What OUT cannot carry is counted on standard error. Exit code 1: IN or OUT failed, nothing in IN could be read, or \
    with --strict something in IN was wrong. An older OUT then stays as it is; what had come from a pipe is kept. \
    Otherwise the new OUT takes its place: a conversion can be made again. A recording cannot, so capture asks for --force."
    )
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    // Neither a filter nor a message's name has a point or a slash in it; a shell's `*.log` has made the second name the one to be written.
    if args.filters.iter().any(|filter| filter.to_string().contains(['.', '/'])) {
        return Err(usage(
            "it takes one trace at a time, as in: for trace in *.log; do cantap convert \"$trace\" \"${trace%.log}.asc\"; done",
        ));
    }
    refuse_same_file(&args.input, &args.output)?;
    let mut options = args.write.options(None)?;
    if args.is_columns()? {
        args.write.check_style(options.format.or(Some(Format::Parquet)))?;
    } else {
        options = named(options, &args.output)?;
        args.write.check_style(options.format)?;
    }
    let filter = args.filters.iter().chain(&args.filter_options).cloned().collect();
    let zone = args.write.zone.clone();
    let read = ReadArgs {
        format: args.from,
        columns: args.columns.clone(),
        strict: args.strict,
        filter,
        zone,
        format_option: "--from",
    };
    let read = FollowArgs { read, follow: args.follow };
    let filters = read.filters(&args.databases.load(false, true)?)?;
    let mut records = read.open(&args.input, filters)?.within(args.range.of(Some(&args.input))?)?;
    let grows = records.end_when(interrupt::requested);
    if grows {
        interrupt::watch()?;
    }
    let mut output: Option<TraceOutput> = None;
    // Only once there is something to write: if nothing can be read, an older OUT stays unchanged.
    let create = |bit_rates: &[(u8, u32)]| {
        let chosen = |channel: u8| {
            args.channel.is_empty() || args.channel.iter().any(|channels| channels.has(channel))
        };
        let known = bit_rates.iter().filter(|(channel, _)| chosen(*channel));
        let channels = known.map(|(channel, bps)| ChannelInfo {
            channel: *channel,
            bitrate_bps: Some(*bps),
            description: String::new(),
        });
        args.create(&WriteOptions { channels: channels.collect(), ..options.clone() }, grows)
    };
    let mut written = 0_u64;
    let mut batch = Vec::new();
    let read = loop {
        match records.next_batch(&mut batch) {
            Ok(true) => {}
            Ok(false) => break Ok(()),
            Err(error) => break Err(error),
        }
        let output = match &mut output {
            Some(output) => output,
            none => none.insert(create(records.bit_rates())?),
        };
        for record in &batch {
            if args.channel.is_empty() || args.channel.iter().any(|channels| channels.has(record.channel)) {
                output.write(record)?;
                written += 1;
            }
        }
        if records.may_wait() {
            output.flush()?;
        }
    };
    if let Err(error) = read {
        output.map_or(Ok(()), TraceOutput::give_up)?;
        return Err(error);
    }
    // An empty trace is still a trace.
    let output = output.map_or_else(|| create(records.bit_rates()), Ok)?;
    let mut left_out = output.finish()?;
    if args.json {
        let missing = records.missing();
        left_out.merge(&missing.left_out);
        let summary = serde_json::json!({
            "records": written,
            "issues": missing.issues,
            "notes": by_kind(&records.notes()),
            "left_out": by_kind(&left_out),
            "missing_pct": missing.share_pct(),
        });
        if args.output.as_os_str() == "-" {
            eprintln!("{summary}");
        } else {
            writeln!(std::io::stdout(), "{summary}")?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Creating OUT empties it: if it were IN, the trace would be lost.
pub fn refuse_same_file(input: &Path, output: &Path) -> anyhow::Result<()> {
    if input.as_os_str() == "-" || output.as_os_str() == "-" {
        return Ok(());
    }
    if let (Ok(input), Ok(same)) = (input.canonicalize(), output.canonicalize())
        && input == same
    {
        bail!("{} is both input and output; choose another name for the output", output.display());
    }
    Ok(())
}
