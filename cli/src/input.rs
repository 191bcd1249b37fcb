//! The trace that a command reads: which file, and how to deal with faults in it.

use std::ops::Deref;
use std::path::{Path, PathBuf};

use anyhow::bail;
use cantap::TraceRecord;
use cantap_formats::time_range::TimeRange;
use cantap_formats::{Columns, Format, LeftOut, ReadOptions, Zone, open_reader};
use cantap_signals::Decoder;
use cantap_signals::named::{NameError, NamedFilter};
use cantap_trace::filter::Filter;
use clap::Arg;

use crate::completion;
use crate::live_args::LiveArgs;
use crate::usage_error::usage;
use cantap_work::cache;
use cantap_work::channels::Channels;
use cantap_work::interrupt;
use cantap_work::live::LiveRecords;
use cantap_work::missing::Missing;
use cantap_work::read_ahead::{Progress, ReadAhead};

/// How to read a trace; commands flatten this into their arguments.
#[derive(clap::Args)]
pub struct ReadArgs {
    /// The trace's format, if neither its content nor its name show it, or show the wrong one.
    #[arg(long = "from", value_name = "FORMAT", add = completion::formats())]
    pub format: Option<Format>,
    /// The trace is a table with these columns: time=Timestamp:ms,id=ID:hex,data=Data. By name or number from 1; also dlc, bytes, channel.
    #[arg(long, value_name = "COLUMNS", conflicts_with = "format")]
    pub columns: Option<Columns>,
    /// Stop at the first fault instead of leaving it out.
    #[arg(long)]
    pub strict: bool,
    /// Only these frames, in candump's syntax: can0,123:7FF,400~7F0,#FF,j; with a database also EngineData. If repeated, any
    /// may match.
    #[arg(short, long, value_name = "FILTER")]
    pub filter: Vec<NamedFilter>,
    /// The time zone of dates in files that do not name one, such as ASC, TRC and BLF: Europe/Berlin, +02:00.
    #[arg(long, value_name = "ZONE", default_value_t)]
    pub zone: Zone,
    /// What [`Self::format`] is called on the command line.
    #[arg(skip = "--from")]
    pub format_option: &'static str,
}

/// The same for a command that shows a trace while it grows.
#[derive(clap::Args)]
pub struct FollowArgs {
    #[command(flatten)]
    pub read: ReadArgs,
    /// Wait for more at the end of the file, until Ctrl-C.
    #[arg(long)]
    pub follow: bool,
}

impl ReadArgs {
    /// The first of the options that was given, for commands that read a trace only sometimes.
    pub fn given(&self) -> Option<&'static str> {
        let given = [
            (!self.filter.is_empty(), "-f"),
            (self.format.is_some(), self.format_option),
            (self.columns.is_some(), "--columns"),
            (self.strict, "--strict"),
            (self.zone != Zone::default(), "--zone"),
        ];
        given.into_iter().find_map(|(given, option)| given.then_some(option))
    }
}

/// Those of these options that concern a file, and not what a device is listened to for. For `Command::mut_args` of a command that does either: its
/// file is `input`, and its device `device`.
pub fn of_a_trace(arg: Arg) -> Arg {
    match arg.get_id().as_str() {
        "format" | "columns" | "zone" | "follow" => needs_a_trace(arg),
        _ => arg,
    }
}

/// The option means nothing for a device.
pub fn needs_a_trace(arg: Arg) -> Arg {
    arg.requires("input").conflicts_with_all(["device", "time", "device_intervals"])
}

impl Deref for FollowArgs {
    type Target = ReadArgs;

    fn deref(&self) -> &ReadArgs {
        &self.read
    }
}

impl FollowArgs {
    /// Opens the file, or standard input for `-`.
    pub fn open(&self, path: &Path, filters: Vec<Filter>) -> anyhow::Result<Records> {
        self.read.open_as(path, self.follow, filters)
    }

    /// Opens the device if given, otherwise the file.
    pub fn open_either(
        &self,
        path: Option<&PathBuf>,
        live: &LiveArgs,
        filters: Vec<Filter>,
    ) -> anyhow::Result<Records> {
        match (live.open(path)?, path) {
            (Some(live), _) => Ok(Records::new(Source::Device(live), filters, self.strict)),
            (None, Some(path)) => Ok(self.open(path, filters)?.of_channels(live.channels())),
            (None, None) => bail!("give a trace to read, or a device with -d"),
        }
    }
}

/// The filters with the identifiers of the messages that they name.
pub fn resolved(filters: &[NamedFilter], decoder: &Decoder) -> anyhow::Result<Vec<Filter>> {
    let all = filters.iter().map(|filter| filter.resolve(decoder));
    all.collect::<Result<_, _>>().map_err(|error| not_a_message("-f", &error))
}

/// A name in an option's value that is no message's is an error of the command line.
pub fn not_a_message(option: &str, error: &NameError) -> anyhow::Error {
    let hint = if matches!(error, NameError::NoDatabase(_)) { "; load one with --db" } else { "" };
    usage(format!("{option}: {error}{hint}"))
}

/// The channels, from 1, of which filters hide some frames.
pub fn filtered(filters: &[Filter]) -> Vec<u8> {
    let accepts_all = |channel: &u8| filters.iter().any(|filter| filter.accepts_all_of(*channel));
    let accepts_some =
        |channel: &u8| filters.iter().any(|filter| filter.channel.is_none_or(|own| own == *channel));
    (0..=u8::MAX).filter(|channel| accepts_some(channel) && !accepts_all(channel)).collect()
}

/// Broken lines are reported individually until it is clear that the whole file is broken.
const ISSUES_SHOWN: u64 = 20;

/// How many are shown of a file in which there is nothing else.
const ISSUES_OF_NO_TRACE: u64 = 3;

/// The records of a trace or a device. Issues go to standard error.
pub struct Records {
    source: Source,
    filters: Vec<Filter>,
    channels: Channels,
    range: TimeRange,
    /// The latest time of those that were read, if only a range is wanted, and whether any was in that.
    latest_ns: Option<i64>,
    has_any: bool,
    strict: bool,
    /// The batch from which [`Self::next`] takes; the records before `at` are used up.
    batch: Vec<TraceRecord>,
    at: usize,
}

enum Source {
    /// A file, and whether it may grow.
    File(ReadAhead, bool),
    Device(LiveRecords),
}

impl ReadArgs {
    /// Opens the file, or standard input for `-`.
    pub fn open(&self, path: &Path, filters: Vec<Filter>) -> anyhow::Result<Records> {
        self.open_as(path, false, filters)
    }

    /// What to open it with; messages that filters name are looked up in `decoder`.
    pub fn filters(&self, decoder: &Decoder) -> anyhow::Result<Vec<Filter>> {
        resolved(&self.filter, decoder)
    }

    fn open_as(&self, path: &Path, follow: bool, filters: Vec<Filter>) -> anyhow::Result<Records> {
        let options = ReadOptions {
            format: self.format,
            follow,
            strict: self.strict,
            zone: self.zone.clone(),
            columns: self.columns.clone(),
            index: cache::indexes(),
        };
        let mut reader = open_reader(path, &options)?;
        if let Some(named) = reader.named_otherwise() {
            let (name, format) = (path.display(), reader.format());
            eprintln!(
                "cantap: note: {name} is read as {format}, which its content is, and not as {named}; {} overrides",
                self.format_option
            );
        }
        if follow {
            interrupt::watch()?;
            reader.end_when(interrupt::requested);
        }
        let grows = follow || path.as_os_str() == "-";
        Ok(Records::new(Source::File(ReadAhead::new(reader), grows), filters, self.strict))
    }
}

impl Records {
    fn new(source: Source, filters: Vec<Filter>, strict: bool) -> Self {
        let (channels, range) = (Channels::all(), TimeRange::default());
        Self {
            source,
            filters,
            channels,
            range,
            latest_ns: None,
            has_any: false,
            strict,
            batch: Vec::new(),
            at: 0,
        }
    }

    /// Only the records in a range, which may begin at a time after the first record, whether or not that passes the filters.
    pub fn within(mut self, mut range: TimeRange) -> anyhow::Result<Self> {
        if let Source::File(reader, _) = &mut self.source {
            reader.within(&mut range)?;
        }
        self.range = range;
        Ok(self)
    }

    /// Only those of these channels.
    pub fn of_channels(mut self, channels: &Channels) -> Self {
        self.channels = channels.clone();
        self
    }

    /// Whether the next record may take a while, so that results should not be buffered.
    pub fn may_wait(&mut self) -> bool {
        self.at == self.batch.len()
            && match &mut self.source {
                Source::File(reader, _) => reader.would_wait(),
                Source::Device(_) => true,
            }
    }

    /// Whether more may come after what is there now.
    pub const fn grows(&self) -> bool {
        match &self.source {
            Source::File(_, grows) => *grows,
            Source::Device(_) => true,
        }
    }

    /// Ends a growing file as soon as `stop` returns true; returns whether it is one.
    pub fn end_when(&mut self, stop: fn() -> bool) -> bool {
        match &mut self.source {
            Source::File(reader, true) => {
                reader.end_when(stop);
                true
            }
            _ => false,
        }
    }

    /// What is missing from the records that were read.
    pub fn missing(&self) -> Missing {
        match &self.source {
            Source::File(reader, _) => reader.missing(),
            Source::Device(_) => Missing::default(),
        }
    }

    /// What else is known about a file so far, and how often.
    pub fn notes(&self) -> LeftOut {
        match &self.source {
            Source::File(reader, _) => reader.notes().clone(),
            Source::Device(_) => LeftOut::default(),
        }
    }

    /// Bit rates of a file's channels, from 1, as far as it has said them.
    pub fn bit_rates(&self) -> &[(u8, u32)] {
        match &self.source {
            Source::File(reader, _) => reader.bit_rates(),
            Source::Device(_) => &[],
        }
    }

    /// At the end: an error if this was a device that received errors but no frame, as at a wrong bit rate.
    pub fn judge(&self) -> anyhow::Result<()> {
        match &self.source {
            Source::File(..) => Ok(()),
            Source::Device(live) => live.judge(),
        }
    }

    /// Replaces the content of `records` with the next records that pass the filters, which may be none; false at the
    /// end. With `--strict`, an issue is an error.
    pub fn next_batch(&mut self, records: &mut Vec<TraceRecord>) -> anyhow::Result<bool> {
        let more = match &mut self.source {
            Source::File(reader, _) => batch_of_file(reader, self.strict, records)?,
            Source::Device(live) => live.next_batch(records)?,
        };
        if !self.range.is_all() {
            self.latest_ns = self.latest_ns.max(records.iter().map(|record| record.time_ns).max());
            records.retain(|record| self.range.contains(record));
            self.has_any |= !records.is_empty();
            if !more {
                self.report_empty_range();
            }
        }
        if self.channels != Channels::all() {
            records.retain(|record| self.channels.has(record.channel));
        }
        if !self.filters.is_empty() {
            records.retain(|record| self.filters.iter().any(|filter| filter.accepts(record)));
        }
        Ok(more)
    }

    /// Says that nothing was in the range: an empty result would look as if there were no traffic.
    fn report_empty_range(&self) {
        let (Some(first_ns), Some(latest_ns), false) = (self.range.first_ns(), self.latest_ns, self.has_any)
        else {
            return;
        };
        let seconds = latest_ns.saturating_sub(first_ns) as f64 / 1e9;
        eprintln!(
            "cantap: note: no record is between --start and --end; the trace's last one is {seconds:.3} s after its first"
        );
    }

    /// The next record, like [`Self::next_batch`].
    pub fn next(&mut self) -> anyhow::Result<Option<TraceRecord>> {
        while self.at == self.batch.len() {
            let mut batch = std::mem::take(&mut self.batch);
            self.at = 0;
            if !self.next_batch(&mut batch)? {
                return Ok(None);
            }
            self.batch = batch;
        }
        self.at += 1;
        Ok(self.batch.get(self.at - 1).copied())
    }
}

/// The next records; reports faults on the way, and their number at the end.
fn batch_of_file(
    reader: &mut ReadAhead,
    strict: bool,
    records: &mut Vec<TraceRecord>,
) -> anyhow::Result<bool> {
    // Of a file that is no trace, every line is one: what it looks like says more than twenty of them.
    let mut held = Vec::new();
    let has_records = loop {
        match reader.next(records)? {
            Progress::Records => break true,
            Progress::Issue(issue, _) if strict => bail!(issue),
            Progress::Issue(issue, number) if number <= ISSUES_OF_NO_TRACE => eprintln!("cantap: {issue}"),
            Progress::Issue(issue, number) if number <= ISSUES_SHOWN => held.push(issue),
            Progress::Issue(..) => {}
            Progress::End(Some(nothing)) => bail!(nothing),
            Progress::End(None) => break false,
        }
    };
    for issue in held {
        eprintln!("cantap: {issue}");
    }
    if has_records {
        return Ok(true);
    }
    for (what, count) in reader.notes().iter() {
        eprintln!("cantap: note: {what} ({count})");
    }
    if let Some(text) = reader.missing().description() {
        eprintln!("cantap: {text}");
    }
    Ok(false)
}
