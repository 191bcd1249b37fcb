//! Where decoded frames go, and in what form.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use anyhow::Context;
use cantap::{TraceEvent, TraceRecord};
#[cfg(feature = "mcap")]
use cantap_columns::McapFile;
use cantap_protocols::Event;
use cantap_signals::Decoder;

#[cfg(feature = "parquet")]
use super::columns::{Long, PerMessage, WideFile};
use super::command_line::Args;
use super::csv::Cells;
use super::decoded::Decoded;
use super::wide::{Csv, Wide};
use super::{csv, events, json, text};
use crate::trace_output::failed;
use crate::usage_error::usage;
use cantap_work::atomic_file::AtomicFile;

/// The requested form, by an option or by the file's name.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Form {
    Text,
    Json,
    Csv,
    #[cfg(feature = "mcap")]
    Mcap,
    #[cfg(feature = "parquet")]
    Parquet,
}

/// The forms that a file's name may select, for messages.
const NAMES: &str = match (cfg!(feature = "mcap"), cfg!(feature = "parquet")) {
    (true, true) => ".txt, .csv, .json, .mcap or .parquet",
    (true, false) => ".txt, .csv, .json or .mcap",
    (false, true) => ".txt, .csv, .json or .parquet",
    (false, false) => ".txt, .csv or .json",
};

impl Form {
    pub fn of(args: &Args) -> anyhow::Result<Self> {
        let suffix = args.output.as_deref().and_then(Path::extension).and_then(|suffix| suffix.to_str());
        let form = match suffix.map(str::to_ascii_lowercase).as_deref() {
            _ if args.json => Self::Json,
            _ if args.csv => Self::Csv,
            #[cfg(feature = "parquet")]
            _ if args.per_message || !args.partition.is_empty() => {
                crate::columns::refuse_file(args.output.as_deref().unwrap_or(Path::new("-")))?;
                Self::Parquet
            }
            #[cfg(feature = "parquet")]
            Some("parquet") => Self::Parquet,
            #[cfg(feature = "mcap")]
            Some("mcap") => Self::Mcap,
            Some("csv") => Self::Csv,
            Some("json" | "jsonl" | "ndjson") => Self::Json,
            None | Some("txt" | "log") => Self::Text,
            // Lines of text in a file named like a spreadsheet or a trace would be mistaken for one.
            Some(_) => {
                let name = args.output.as_deref().unwrap_or(Path::new("-"));
                #[cfg(not(feature = "parquet"))]
                crate::trace_output::refuse_parquet(name)?;
                #[cfg(not(feature = "mcap"))]
                if name.extension().is_some_and(|suffix| suffix.eq_ignore_ascii_case("mcap")) {
                    anyhow::bail!("this build has no MCAP; add `--features mcap` to its command line");
                }
                return Err(usage(format!(
                    "the name '{}' does not say which form to write; end it in {NAMES}, or add --csv or --json",
                    name.display(),
                )));
            }
        };
        #[cfg(feature = "mcap")]
        if form == Self::Mcap && args.protocols {
            return Err(usage(
                "MCAP has a place for the signals of a database only; leave --protocols out, or write to a file that ends in .csv or .json",
            ));
        }
        let is_table = !matches!(form, Self::Text | Self::Json);
        #[cfg(feature = "mcap")]
        let is_table = is_table && form != Self::Mcap;
        if !is_table && (args.wide || args.resample.is_some()) {
            return Err(usage(
                "--wide and --resample make tables; add --csv, or -o with a name that ends in .csv or .parquet",
            ));
        }
        if args.text_cells && form != Self::Csv {
            return Err(usage("--text-cells is about CSV; add --csv, or -o with a name that ends in .csv"));
        }
        #[cfg(feature = "parquet")]
        if form == Self::Parquet && args.protocols && !args.wide && args.resample.is_none() {
            return Err(usage(
                "this table has no place for what protocols say; add --wide or --resample TIME, which make columns of its numbers, or write it to \
                 a file that ends in .csv or .json",
            ));
        }
        Ok(form)
    }
}

/// Takes decoded frames.
pub struct Output<'a> {
    #[cfg_attr(
        not(any(feature = "mcap", feature = "parquet")),
        expect(dead_code, reason = "only tables ask it")
    )]
    decoder: &'a Decoder,
    to: To,
}

enum To {
    Lines {
        lines: Lines,
        json: bool,
        details: bool,
    },
    Csv(Lines, Cells),
    Wide(Box<Wide>, WideTo),
    #[cfg(feature = "mcap")]
    Mcap(Box<McapFile<Lines>>, String),
    #[cfg(feature = "parquet")]
    Long(Box<Long>),
    #[cfg(feature = "parquet")]
    PerMessage(Box<PerMessage>),
}

enum WideTo {
    Csv(Lines, Cells),
    #[cfg(feature = "parquet")]
    Parquet(WideFile),
}

/// Lines for standard output, or for a file that takes its name once it is complete.
struct Lines {
    out: BufWriter<Box<dyn Write>>,
    replacement: Option<AtomicFile>,
    name: String,
}

impl Lines {
    fn open(path: Option<&Path>) -> anyhow::Result<Self> {
        let path = path.unwrap_or(Path::new("-"));
        let name = failed(path);
        let replacement = AtomicFile::of(path);
        let out: Box<dyn Write> = if path.as_os_str() == "-" {
            Box::new(std::io::stdout().lock())
        } else {
            let file = replacement.as_ref().map_or(path, |file| &file.temporary);
            Box::new(File::create(file).with_context(|| name.clone())?)
        };
        Ok(Self { out: BufWriter::with_capacity(1 << 16, out), replacement, name })
    }

    fn finish(mut self) -> anyhow::Result<()> {
        self.out.flush().with_context(|| self.name.clone())?;
        drop(self.out);
        self.replacement.map_or(Ok(()), AtomicFile::put_in_place).context(self.name)
    }
}

#[cfg(feature = "mcap")]
impl Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.out.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.out.flush()
    }
}

impl<'a> Output<'a> {
    pub fn open(args: &Args, form: Form, decoder: &'a Decoder) -> anyhow::Result<Self> {
        let path = args.output.as_deref();
        let step_ns = args.resample.map(|step| i64::try_from(step.as_nanos()).unwrap_or(i64::MAX));
        let is_wide = args.wide || step_ns.is_some();
        let cells = Cells { are_texts: args.text_cells };
        let to = match form {
            Form::Csv if is_wide => {
                To::Wide(Box::new(Wide::new(step_ns)?), WideTo::Csv(Lines::open(path)?, cells))
            }
            Form::Csv => {
                let mut lines = Lines::open(path)?;
                csv::write_header(&mut lines.out)?;
                To::Csv(lines, cells)
            }
            Form::Text | Form::Json => {
                To::Lines { lines: Lines::open(path)?, json: form == Form::Json, details: args.details }
            }
            #[cfg(feature = "mcap")]
            Form::Mcap => {
                let lines = Lines::open(path)?;
                let name = lines.name.clone();
                To::Mcap(Box::new(McapFile::new(lines).with_context(|| name.clone())?), name)
            }
            #[cfg(feature = "parquet")]
            Form::Parquet => {
                let path = path.context("a Parquet file needs a name; give one with -o")?;
                let failed = || failed(path);
                if is_wide {
                    To::Wide(Box::new(Wide::new(step_ns)?), WideTo::Parquet(WideFile::new(path)))
                } else if args.per_message {
                    To::PerMessage(Box::new(PerMessage::new(path).with_context(failed)?))
                } else if args.partition.is_empty() {
                    To::Long(Box::new(Long::file(path, decoder).with_context(failed)?))
                } else {
                    let name = crate::columns::name_of(args.input.as_deref().unwrap_or(Path::new("-")));
                    To::Long(Box::new(Long::dataset(path, args.partition.clone(), name, decoder)))
                }
            }
        };
        Ok(Self { decoder, to })
    }

    /// Takes a frame.
    pub fn push(&mut self, decoded: &Decoded) -> anyhow::Result<()> {
        match &mut self.to {
            To::Lines { lines, json: true, details } => json::write(&mut lines.out, decoded, *details)?,
            To::Lines { lines, .. } => text::write(&mut lines.out, decoded)?,
            To::Csv(lines, cells) => csv::write(&mut lines.out, decoded, *cells)?,
            To::Wide(wide, _) => wide.push(decoded)?,
            #[cfg(feature = "mcap")]
            To::Mcap(file, name) => file
                .push_values(self.decoder, decoded.record, decoded.reference, decoded.values)
                .with_context(|| name.clone())?,
            #[cfg(feature = "parquet")]
            To::Long(long) => long.push(self.decoder, decoded)?,
            #[cfg(feature = "parquet")]
            To::PerMessage(files) => files.push(self.decoder, decoded)?,
        }
        Ok(())
    }

    /// Takes an event from several frames.
    pub fn push_protocol_event(&mut self, event: &Event) -> anyhow::Result<()> {
        match &mut self.to {
            To::Lines { lines, json: true, details } => events::json(&mut lines.out, event, *details)?,
            To::Lines { lines, .. } => events::text(&mut lines.out, event)?,
            To::Csv(lines, cells) => events::csv(&mut lines.out, event, *cells)?,
            To::Wide(wide, _) => wide.push_protocol_event(event)?,
            #[cfg(any(feature = "mcap", feature = "parquet"))]
            // Refused on the command line.
            _ => {}
        }
        Ok(())
    }

    /// Takes an event other than a frame. Lines leave these out; the summary counts losses.
    pub fn push_event(&mut self, record: &TraceRecord) -> anyhow::Result<()> {
        match &mut self.to {
            To::Wide(wide, _) if matches!(record.event, TraceEvent::Lost { .. }) => {
                wide.interrupt(record.channel);
            }
            #[cfg(feature = "mcap")]
            To::Mcap(file, name) => file.push_event(record).with_context(|| name.clone())?,
            #[cfg(feature = "parquet")]
            To::Long(long) => long.push_event(record)?,
            #[cfg(feature = "parquet")]
            To::PerMessage(files) => files.push_event(record)?,
            _ => {}
        }
        Ok(())
    }

    /// The number of texts and bytes in events for which the table has no columns.
    pub fn left_out(&self) -> u64 {
        if let To::Wide(wide, _) = &self.to { wide.left_out() } else { 0 }
    }

    /// Writes out what is waiting, if somebody may be reading along.
    pub fn flush(&mut self) -> anyhow::Result<()> {
        match &mut self.to {
            To::Lines { lines, .. } | To::Csv(lines, _) => Ok(lines.out.flush()?),
            _ => Ok(()),
        }
    }

    /// Ends the output and puts it in its place; JSON lines are followed by the summary.
    pub fn finish(self, summary: &serde_json::Value) -> anyhow::Result<()> {
        match self.to {
            To::Lines { mut lines, json, .. } => {
                if json {
                    writeln!(lines.out, "{}", serde_json::json!({ "summary": summary }))?;
                }
                lines.finish()
            }
            To::Csv(lines, _) => lines.finish(),
            #[cfg(feature = "mcap")]
            To::Mcap(file, name) => {
                let before_1970 = file.before_1970();
                file.finish().context(name)?.finish()?;
                if before_1970 > 0 {
                    eprintln!(
                        "cantap: MCAP has no times before 1970: {before_1970} messages are not in the file"
                    );
                }
                Ok(())
            }
            To::Wide(wide, WideTo::Csv(mut lines, cells)) => {
                wide.finish(&mut Csv(&mut lines.out, cells))?;
                lines.finish()
            }
            #[cfg(feature = "parquet")]
            To::Wide(wide, WideTo::Parquet(mut file)) => {
                wide.finish(&mut file)?;
                Ok(file.finish()?)
            }
            #[cfg(feature = "parquet")]
            To::Long(long) => Ok(long.finish()?),
            #[cfg(feature = "parquet")]
            To::PerMessage(files) => Ok(files.finish()?),
        }
    }
}
