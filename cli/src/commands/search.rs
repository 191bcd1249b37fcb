//! `cantap search`: finds frames in a trace.

use std::collections::VecDeque;
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use cantap::{TraceEvent, TraceRecord};
use cantap_formats::{Format, WriteOptions};
use cantap_signals::condition::Condition;
use cantap_signals::named::NamedId;
use cantap_signals::search::{DataPattern, Search};
use cantap_signals::{Decoder, SignalValue};

use super::decode;
use crate::completion;
use crate::database_args::{DatabaseArgs, load};
use crate::exit;
use crate::input::{FollowArgs, Records, not_a_message, of_a_trace};
use crate::live_args::LiveArgs;
use crate::protocols::{self, ProtocolArgs};
use crate::range_args::RangeArgs;
use crate::trace_output::TraceOutput;
use crate::usage_error::usage;
use cantap_trace::Seconds;
use cantap_trace::counted;
use cantap_work::missing::Missing;
use cantap_work::terms::failure_text;

/// The command line.
#[derive(clap::Args)]
#[command(
    mut_args(of_a_trace),
    after_help = "Examples:\n  \
                cantap search trace.log --id 123 --data '11 ?? 3?'\n  \
                cantap search trace.log --db car.dbc 'Speed > 80 and Gear == Drive' -C 5\n  \
                cantap search trace.blf --data '* DE AD' -o found.asc\n  \
                cantap search trace.log 'id == 0x123 and byte[0] & 0x80 != 0' --count\n  \
                cantap search -d /dev/ttyACM0 -b 500k -e 'error or id == 0x7DF' -m 1\n  \
                cantap search workshop.log 'uds.sid == 0x22 and uds.nrc'\n\n\
                A condition knows: signals (Speed, Engine.Speed; the last value received), texts of value tables, id, \
                messages (EngineData; true for its frames), dlc, len, ch (from 1), ext, rtr, byte[N], error, lost, lin, numbers (12, 0x1F), + - * / % & |, == != < <= > \
                >=, not, and, or, parentheses; and what frames say together: uds.nrc, j1939.spn == 110, canopen.node == \
                5 and canopen.fault (docs/protocols.md). Of such, the frame is shown that completes it, and behind it \
                what it says.\n\n\
                Exit codes: 0 something was found, 1 nothing was found or a failure, 2 wrong command line."
)]
pub struct Args {
    /// The trace; - for standard input.
    #[arg(value_name = "FILE")]
    input: Option<PathBuf>,
    /// The condition, such as "Speed > 80 and Gear == 3".
    #[arg(value_name = "CONDITION", conflicts_with = "condition", add = completion::conditions())]
    positional: Option<String>,
    /// The condition, as an option.
    #[arg(short = 'e', long = "condition", visible_alias = "where", value_name = "CONDITION", add = completion::conditions())]
    condition: Option<String>,
    /// This identifier: 123, 18FEF1?? with ? for any digit, or 100-1FF; with a database also EngineData. Of several
    /// (123,456, or repeated) any may match.
    #[arg(short, long = "id", value_name = "ID", value_delimiter = ',', add = completion::identifiers())]
    ids: Vec<NamedId>,
    /// These data bytes from the first on: "11 ?? 3?"; * for any number. If repeated, any may match.
    #[arg(long, value_name = "BYTES")]
    data: Vec<DataPattern>,
    #[command(flatten)]
    live: LiveArgs,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    protocol: ProtocolArgs,
    /// Show this many records after each one found.
    #[arg(short = 'A', long, value_name = "N")]
    after_context: Option<usize>,
    /// Show this many records before each one found.
    #[arg(short = 'B', long, value_name = "N")]
    before_context: Option<usize>,
    /// Show this many records before and after each one found.
    #[arg(short = 'C', long, value_name = "N", default_value_t = 0)]
    context: usize,
    /// Stop after finding this many.
    #[arg(short, long, value_name = "N")]
    max_count: Option<u64>,
    /// Print only the number found.
    #[arg(long, conflicts_with_all = ["output", "json", "written_format"])]
    count: bool,
    /// Write what was found, with its context, as a trace.
    #[arg(short, long, value_name = "FILE", conflicts_with = "json")]
    output: Option<PathBuf>,
    /// The format to write, if the output's name does not show it.
    #[arg(long = "format", visible_alias = "to", value_name = "FORMAT", requires = "output", conflicts_with = "json", add = completion::written_formats())]
    written_format: Option<Format>,
    /// Print one JSON object per record, followed by one with the summary.
    #[arg(long)]
    json: bool,
    /// Do not report what is wrong with usable databases, and which of them replaces another.
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    range: RangeArgs,
    #[command(flatten)]
    read: FollowArgs,
}

/// More context than anyone would look at only takes memory.
const MAX_CONTEXT: usize = 1_000_000;

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let databases = args.databases.or_of(args.live.devices());
    let decoder = load(&databases, args.read.strict, args.quiet)?;
    let text = args.condition.as_ref().or(args.positional.as_ref());
    let helps = args.protocol.options(args.quiet)?;
    let condition = text.map(|text| cantap_protocols::condition(text, &decoder, &helps)).transpose();
    let condition = condition.context("condition")?;
    if condition.is_none() && args.ids.is_empty() && args.data.is_empty() {
        return Err(usage(
            "nothing to look for; give --id, --data or a condition (see cantap search --help)",
        ));
    }
    let mut ids = Vec::new();
    for id in &args.ids {
        ids.extend(id.resolve(&decoder).map_err(|error| not_a_message("--id", &error))?);
    }
    let search = Search { ids, data: args.data.clone(), condition };
    let (filters, range) = (args.read.filters(&decoder)?, args.range.of(args.input.as_ref())?);
    let records = args.read.open_either(args.input.as_ref(), &args.live, filters)?;
    let mut records = records.within(range)?;
    let mut sink = Sink::new(args, decoder, records.grows())?;
    let mut search = search;
    let found = find(args, &mut records, &mut search, &mut sink)?;
    if let Some(condition) = search.condition.as_ref().filter(|_| !args.quiet) {
        protocols::report_unmatched(condition);
    }
    sink.finish(found, &records.missing())?;
    if args.count {
        writeln!(std::io::stdout(), "{found}")?;
    }
    if found > 0 {
        return Ok(ExitCode::SUCCESS);
    }
    records.judge()?;
    Ok(ExitCode::from(exit::FAILURE))
}

/// Searches the trace and passes on what was found, with its context; returns the number found.
fn find(args: &Args, records: &mut Records, search: &mut Search, sink: &mut Sink) -> anyhow::Result<u64> {
    let before = args.before_context.unwrap_or(args.context).min(MAX_CONTEXT);
    let after = args.after_context.unwrap_or(args.context);
    let mut earlier: VecDeque<TraceRecord> = VecDeque::new();
    let (mut found, mut still_after) = (0, 0);
    // Whether there are records between the last one shown and the next.
    let mut gap = false;
    while let Some(record) = records.next()? {
        let is_last = args.max_count.is_some_and(|max| found >= max);
        if !is_last && search.finds(&record) {
            if gap && found > 0 && before + after > 0 {
                sink.separate()?;
            }
            for record in earlier.drain(..) {
                sink.show(&record, None)?;
            }
            sink.show(&record, Some(search.condition.as_ref().map_or(&[], Condition::matched_events)))?;
            (found, still_after, gap) = (found + 1, after, false);
        } else if still_after > 0 {
            sink.show(&record, None)?;
            still_after -= 1;
        } else if is_last {
            break;
        } else {
            earlier.push_back(record);
            if earlier.len() > before {
                earlier.pop_front();
                gap = true;
            }
        }
        if records.may_wait() {
            sink.flush()?;
        }
    }
    Ok(found)
}

/// The destination of what was found.
struct Sink {
    kind: Kind,
    decoder: Decoder,
    values: Vec<SignalValue>,
}

enum Kind {
    Nowhere,
    Text(BufWriter<std::io::Stdout>),
    Json(BufWriter<std::io::Stdout>),
    Trace(TraceOutput),
}

impl Sink {
    /// If the trace `grows`, output is written as it comes.
    fn new(args: &Args, decoder: Decoder, grows: bool) -> anyhow::Result<Self> {
        let stdout = || BufWriter::with_capacity(1 << 16, std::io::stdout());
        let kind = match (&args.output, args.count, args.json) {
            (Some(path), ..) => {
                let options = WriteOptions { format: args.written_format, ..WriteOptions::default() };
                Kind::Trace(TraceOutput::create(path, &options, grows)?)
            }
            (_, true, _) => Kind::Nowhere,
            (_, _, true) => Kind::Json(stdout()),
            _ => Kind::Text(stdout()),
        };
        Ok(Self { kind, decoder, values: Vec::new() })
    }

    /// As grep separates groups of lines.
    fn separate(&mut self) -> std::io::Result<()> {
        match &mut self.kind {
            Kind::Text(out) => writeln!(out, "--"),
            _ => Ok(()),
        }
    }

    /// `found` contains the events for a record that was found; it is `None` for records around it.
    fn show(&mut self, record: &TraceRecord, found: Option<&[String]>) -> anyhow::Result<()> {
        let message =
            record.frame().and_then(|frame| self.decoder.decode(record.channel, frame, &mut self.values));
        let message = message.map(|message| self.decoder.message(message));
        let time = Seconds(record.time_ns);
        match &mut self.kind {
            Kind::Nowhere => Ok(()),
            Kind::Trace(writer) => writer.write(record),
            Kind::Text(out) => {
                write!(out, "({time}) {} ", record.interface())?;
                match record.frame() {
                    Some(frame) => write!(out, "{frame}")?,
                    None => write!(out, "{}", describe(&record.event))?,
                }
                if let Some(message) = message {
                    write!(out, "  {}:", message.name)?;
                    decode::write_values(out, message, &self.values)?;
                }
                for said in found.unwrap_or_default() {
                    write!(out, "  {said}")?;
                }
                Ok(writeln!(out)?)
            }
            Kind::Json(out) => {
                let mut object = serde_json::json!({
                    "time_s": record.time_ns as f64 / 1e9, "channel": record.channel, "match": found.is_some(),
                });
                if let Some(device_ns) = record.device_ns {
                    object["device_ns"] = device_ns.get().into();
                }
                match record.frame() {
                    Some(frame) => {
                        object["id"] = frame.id().to_string().into();
                        object["frame"] = frame.to_string().into();
                    }
                    None => object["event"] = describe(&record.event).into(),
                }
                if let Some(message) = message {
                    object["message"] = message.name.as_str().into();
                }
                if let Some(said) = found.filter(|said| !said.is_empty()) {
                    object["said"] = said.into();
                }
                Ok(writeln!(out, "{object}")?)
            }
        }
    }

    fn flush(&mut self) -> anyhow::Result<()> {
        match &mut self.kind {
            Kind::Nowhere => Ok(()),
            Kind::Text(out) | Kind::Json(out) => Ok(out.flush()?),
            Kind::Trace(writer) => writer.flush(),
        }
    }

    /// The last line, if scripts read it, and what a file could not carry.
    fn finish(mut self, found: u64, missing: &Missing) -> anyhow::Result<()> {
        if let Kind::Json(out) = &mut self.kind {
            let mut summary = serde_json::json!({ "found": found });
            missing.put_into(&mut summary);
            writeln!(out, "{}", serde_json::json!({ "summary": summary }))?;
        }
        self.flush()?;
        if let Kind::Trace(output) = self.kind {
            output.finish()?;
        }
        Ok(())
    }
}

/// A description of an event other than a frame.
fn describe(event: &TraceEvent) -> String {
    match event {
        TraceEvent::Frame { frame, .. } => frame.to_string(),
        TraceEvent::BusError { kind: Some(kind), .. } => format!("bus error: {}", kind.name()),
        TraceEvent::BusError { kind: None, .. } => "bus error".to_owned(),
        TraceEvent::ErrorsSuppressed { count } => counted(count, "more bus error"),
        TraceEvent::State { state, .. } => format!("controller: {}", state.name()),
        TraceEvent::Lost { count: 0, at_least: true, .. } => "an unknown number of frames lost".to_owned(),
        TraceEvent::Lost { count, at_least: true, .. } => {
            format!("at least {count} lost", count = counted(count, "frame"))
        }
        TraceEvent::Lost { count, .. } => format!("{count} lost", count = counted(count, "frame")),
        TraceEvent::TransmitFailed { reason, .. } => format!("not sent: {}", failure_text(*reason)),
        TraceEvent::Disturbed { .. } | TraceEvent::Lin { .. } => event.to_string(),
    }
}
