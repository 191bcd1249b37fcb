//! `cantap db`: the content of databases, and how they match a trace.

mod coverage;
mod describe;
mod odx;

use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use cantap_signals::{Database, Decoder, Source};
use cantap_trace::counted;
use serde_json::json;

use crate::completion;
use crate::input::ReadArgs;
use crate::usage_error::usage;
use clap::Arg;

/// The command line.
#[derive(clap::Args)]
#[command(
    mut_args(of_coverage),
    after_help = "Examples:\n  \
                cantap db car.dbc\n  \
                cantap db car.dbc --message EngineData --message 'Body*'\n  \
                cantap db car.dbc --coverage trace.log\n  \
                cantap db car.pdx\n\n\
                In a layout the highest bit is on the left; < is a signal's most significant bit, x its least \
                significant one, X a bit that several signals have."
)]
pub struct Args {
    /// The databases, or descriptions of ECUs (PDX, ODX).
    #[arg(required = true, value_name = "FILE", add = completion::databases())]
    files: Vec<PathBuf>,
    /// Show these messages in full: layout, signals, texts, comments. A name with *, ? and [a-z], or an identifier in hexadecimal
    /// (3 or 8 digits). Can be repeated.
    #[arg(long = "message", value_name = "PATTERN", add = completion::messages())]
    messages: Vec<String>,
    /// Compare with this trace: identifiers missing from the databases, messages that never came, actual and nominal cycles.
    #[arg(long, value_name = "TRACE", conflicts_with = "messages")]
    coverage: Option<PathBuf>,
    /// List everything that is wrong with the files.
    #[arg(long, conflicts_with_all = ["messages", "coverage"])]
    warnings: bool,
    /// Treat all 29-bit messages as J1939 parameter groups, even if the database does not say so.
    #[arg(long)]
    j1939: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    read: ReadArgs,
}

/// What says how to read a trace means nothing without one.
fn of_coverage(arg: Arg) -> Arg {
    match arg.get_id().as_str() {
        "format" | "columns" | "strict" | "filter" | "zone" => {
            arg.requires("coverage").conflicts_with_all(["messages", "warnings"])
        }
        _ => arg,
    }
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let is_odx = |path: &PathBuf| path.to_str().is_some_and(cantap_work::odx::is_odx);
    if args.files.iter().any(is_odx) {
        anyhow::ensure!(
            args.files.iter().all(is_odx) && args.messages.is_empty() && args.coverage.is_none(),
            usage(
                "descriptions of ECUs (PDX, ODX) are listed by themselves; --message and --coverage are for databases"
            )
        );
        let mut out = BufWriter::new(std::io::stdout().lock());
        odx::run(&args.files, args.warnings, args.json, &mut out)?;
        out.flush()?;
        return Ok(ExitCode::SUCCESS);
    }
    let databases: Vec<Database> =
        args.files.iter().map(|path| cantap_signals::load(path)).collect::<Result<_, _>>()?;
    let mut out = BufWriter::new(std::io::stdout().lock());
    if let Some(trace) = &args.coverage {
        let sources = databases.into_iter().map(|database| Source { channel: None, database });
        let mut decoder = Decoder::new(sources.collect());
        if args.j1939 {
            decoder.assume_j1939();
        }
        let records = args.read.open(trace, args.read.filters(&decoder)?)?;
        coverage::run(&decoder, records, args.json, &mut out)?;
    } else if args.warnings {
        warnings(args, &databases, &mut out)?;
    } else if args.messages.is_empty() {
        list(args, &databases, &mut out)?;
    } else {
        describe::run(&args.messages, args.json, &databases, &mut out)?;
    }
    out.flush()?;
    Ok(ExitCode::SUCCESS)
}

fn warnings(args: &Args, databases: &[Database], out: &mut impl Write) -> anyhow::Result<()> {
    let all = databases
        .iter()
        .flat_map(|database| database.warnings.iter().map(move |warning| (database, warning)));
    if args.json {
        let warnings: Vec<_> = all
            .map(|(database, warning)| {
                json!({ "file": database.file, "line": warning.line, "symbol": warning.symbol, "warning": warning.kind.to_string() })
            })
            .collect();
        return Ok(writeln!(out, "{}", json!({ "warnings": warnings }))?);
    }
    for (database, warning) in all {
        writeln!(out, "{}: {warning}", database.file)?;
    }
    Ok(())
}

fn list(args: &Args, databases: &[Database], out: &mut impl Write) -> anyhow::Result<()> {
    if args.json {
        let files: Vec<_> = databases.iter().map(describe::database).collect();
        return Ok(writeln!(out, "{}", json!({ "databases": files }))?);
    }
    for (at, database) in databases.iter().enumerate() {
        if at > 0 {
            writeln!(out)?;
        }
        let signals: usize = database.messages.iter().map(|message| message.signals.len()).sum();
        let warnings = match database.warnings.len() {
            0 => String::new(),
            count => format!(", {} (--warnings lists them)", counted(count, "warning")),
        };
        let buses = match &database.buses[..] {
            [] => String::new(),
            [bus] => format!(", bus {bus}"),
            buses => format!(", buses {} (FILE#BUS is one)", buses.join(", ")),
        };
        writeln!(
            out,
            "{}: {}, {}{buses}{warnings}",
            database.file,
            counted(database.messages.len(), "message"),
            counted(signals, "signal")
        )?;
        let names = database.messages.iter().map(|message| message.name.chars().count());
        let width = names.max().unwrap_or(0).clamp(7, 40);
        writeln!(
            out,
            "  {:<8} {:<width$} {:>5} {:>9} {:>7}  Comment",
            "ID", "Message", "Bytes", "Cycle", "Signals"
        )?;
        for message in &database.messages {
            let cycle = message.cycle_ms.map_or("–".to_owned(), |cycle| format!("{cycle} ms"));
            let comment = message.description.lines().next().unwrap_or_default();
            let line = format!(
                "  {:<8} {:<width$} {:>5} {cycle:>9} {:>7}  {comment}",
                message.id.to_string(),
                message.name,
                message.length,
                message.signals.len()
            );
            writeln!(out, "{}", line.trim_end())?;
        }
    }
    Ok(())
}
