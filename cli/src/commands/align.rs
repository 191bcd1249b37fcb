//! `cantap align`: puts traces of several recorders on the same bus into one trace with one clock.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use cantap_analysis::align::{Agreement, AlignError, Alignment, RUN_LENGTHS, Sketch, Verifier, align};
use cantap_formats::{Format, LeftOut, ReadOptions, open_reader};
use cantap_trace::TraceRecord;
use cantap_trace::counted;
use serde_json::{Value, json};

use super::convert::{WriteArgs, refuse_same_file};
use crate::args::duration;
use crate::completion;
use crate::exit;
use crate::input::{ReadArgs, Records};
use crate::trace_output::{TraceOutput, named};
use crate::usage_error::usage;
use cantap_work::missing::Missing;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
    cantap align engine.blf cabin.blf -o both.blf\n  \
    cantap align first.log second.asc third.pcapng\n  \
    cantap align engine.blf body.asc --shift=-3.2s -o both.blf\n\n\
    The clock is found from the frames that the traces share, whatever their dates. All times are then the first \
    trace's; its channels keep their numbers, and those of the others follow. Without -o, only what was found is \
    told. Traces of different buses share no frames: --shift says how their clocks differ, --shift 0 that they do not.\n\n\
    Exit code 1: the traces have no bus in common, or their frames repeat themselves so that nobody could tell. \
    With --check, 3 if the stamps of a frame are further apart than that.")]
pub struct Args {
    /// The traces; the first one's clock is kept.
    #[arg(value_name = "TRACE", required = true, num_args = 2..)]
    traces: Vec<PathBuf>,
    /// The trace to write, with all channels.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// The format of the traces, if neither their names nor their beginnings show it.
    #[arg(long, value_name = "FORMAT", add = completion::formats())]
    from: Option<Format>,
    /// Stop at the first fault in a trace instead of leaving it out.
    #[arg(long)]
    strict: bool,
    /// End with 3 if the stamps of any frame are farther apart than this, such as 10us.
    #[arg(long, value_name = "TIME", value_parser = duration)]
    check: Option<Duration>,
    /// Add this to the times of the other traces, such as 3.2s or -1:30, instead of looking for frames that they share. If repeated,
    /// each is for one of them.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true, value_parser = shift, conflicts_with = "check")]
    shift: Vec<i64>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    write: WriteArgs,
}

/// A time with a sign, in nanoseconds.
fn shift(text: &str) -> Result<i64, String> {
    // A longer one would take any time out of range.
    const MOST: Duration = Duration::from_hours(100 * 365 * 24);
    let (sign, digits) = match text.strip_prefix('-') {
        Some(digits) => (-1, digits),
        None => (1, text.strip_prefix('+').unwrap_or(text)),
    };
    let time = duration(digits)?;
    let ns = i64::try_from(time.as_nanos()).ok().filter(|_| time <= MOST);
    ns.map(|ns| sign * ns).ok_or_else(|| "clocks differ by 100 years at most".to_owned())
}

/// How a trace's clock relates to the first one's.
enum Clock {
    /// Found from the frames that both have.
    Found(Box<(Alignment, Verifier)>),
    /// As the user says: so many nanoseconds behind.
    Given(i64),
}

impl Clock {
    fn to_first(&self, time_ns: i64) -> i64 {
        match self {
            Self::Found(found) => found.0.map.to_first(time_ns),
            Self::Given(shift_ns) => time_ns.saturating_add(*shift_ns),
        }
    }
}

/// The result for a trace.
struct Found {
    by: Result<(Alignment, Agreement), i64>,
    /// Offset for its channels.
    channel_offset: u8,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    for path in &args.traces {
        if path.as_os_str() == "-" {
            bail!("a trace is read more than once, which standard input cannot be; write it to a file first");
        }
        if let Some(output) = &args.output {
            refuse_same_file(path, output)?;
        }
    }
    let options = match (&args.output, args.write.given()) {
        (None, Some(option)) => {
            return Err(usage(format!("{option} is about the trace to write; give its name with -o")));
        }
        (None, None) => None,
        (Some(path), _) => {
            let options = named(args.write.options(None)?, path)?;
            args.write.check_style(options.format)?;
            Some((path, options))
        }
    };
    let (clocks, offsets) = if args.shift.is_empty() { find(args)? } else { given(args)? };
    let mut merged = Merged::open(args, clocks, &offsets)?;
    let mut output = options.map(|(path, options)| TraceOutput::create(path, &options, false)).transpose()?;
    while let Some(record) = merged.next()? {
        if let Some(output) = &mut output {
            output.write(&record)?;
        }
    }
    let not_carried = output.map(TraceOutput::finish).transpose()?.unwrap_or_default();
    let missing: Vec<Missing> = merged.sources.iter().map(Records::missing).collect();
    let found: Vec<Found> = merged
        .others
        .into_iter()
        .zip(&offsets[1..])
        .map(|(clock, &channel_offset)| {
            let by = match clock {
                Clock::Found(found) => {
                    let (alignment, verifier) = *found;
                    Ok((alignment, verifier.finish()))
                }
                Clock::Given(shift_ns) => Err(shift_ns),
            };
            Found { by, channel_offset }
        })
        .collect();
    let mut out = io::stdout().lock();
    if args.json {
        writeln!(out, "{}", to_json(args, &found, &missing, &not_carried))?;
    } else {
        for (path, found) in args.traces[1..].iter().zip(&found) {
            print(&mut out, &args.traces[0], path, found)?;
        }
    }
    let within = |found: &Found| match (&found.by, args.check) {
        (Ok((_, agreement)), Some(most)) => u128::from(agreement.worst_ns) <= most.as_nanos(),
        _ => true,
    };
    Ok(if found.iter().all(within) { ExitCode::SUCCESS } else { ExitCode::from(exit::CHECK_FAILED) })
}

/// How each of the others relates to the first, and the offset of each trace's channels.
fn find(args: &Args) -> anyhow::Result<(Vec<Clock>, Vec<u8>)> {
    let mut unclear = None;
    'longer: for length in RUN_LENGTHS {
        let sketches =
            args.traces.iter().map(|path| sketch(args, path, length)).collect::<anyhow::Result<Vec<_>>>()?;
        let mut alignments = Vec::new();
        for (sketch, path) in sketches.iter().zip(&args.traces).skip(1) {
            match align(&sketches[0], sketch) {
                Ok(alignment) => alignments.push(alignment),
                Err(error) => {
                    unclear = Some((error, path));
                    continue 'longer;
                }
            }
        }
        let clocks = alignments.into_iter().map(|alignment| {
            let verifier = Verifier::new(&alignment);
            Clock::Found(Box::new((alignment, verifier)))
        });
        return Ok((clocks.collect(), channel_offsets(&sketches)?));
    }
    let (error, path) = unclear.unwrap_or((AlignError::NothingInCommon, &args.traces[1]));
    Err(anyhow::Error::new(error))
        .with_context(|| format!("{} and {} cannot be aligned", args.traces[0].display(), path.display()))
}

/// The same, as the user says it.
fn given(args: &Args) -> anyhow::Result<(Vec<Clock>, Vec<u8>)> {
    let others = args.traces.len() - 1;
    if args.shift.len() != 1 && args.shift.len() != others {
        let count = args.shift.len();
        return Err(usage(format!(
            "--shift is given {count} for {others} traces: once for all, or once for each",
            count = counted(count, "time")
        )));
    }
    let sketches = args.traces.iter().map(|path| sketch(args, path, RUN_LENGTHS[0]));
    let offsets = channel_offsets(&sketches.collect::<anyhow::Result<Vec<_>>>()?)?;
    let shifts = args.shift.iter().cycle().take(others);
    Ok((shifts.map(|shift_ns| Clock::Given(*shift_ns)).collect(), offsets))
}

fn sketch(args: &Args, path: &Path, length: usize) -> anyhow::Result<Sketch> {
    let zone = args.write.zone.clone();
    let options = ReadOptions { format: args.from, strict: args.strict, zone, ..ReadOptions::default() };
    let mut reader = open_reader(path, &options)?;
    let mut sketch = Sketch::new(length);
    let mut batch = Vec::new();
    while let Some(read) = reader.next_batch(&mut batch) {
        match read {
            Ok(()) => batch.iter().for_each(|record| sketch.add(record)),
            Err(issue) if args.strict => bail!(issue),
            // It is reported when the trace is read again.
            Err(_) => {}
        }
    }
    if sketch.frames() == 0 {
        bail!("{}: no frame could be read; check its format (--from)", path.display());
    }
    Ok(sketch)
}

/// Each trace's channels follow those of the previous traces.
fn channel_offsets(sketches: &[Sketch]) -> anyhow::Result<Vec<u8>> {
    let mut next = 0_u8;
    sketches
        .iter()
        .map(|sketch| {
            let offset = next;
            next = next.checked_add(sketch.highest_channel()).context(
                "the traces have more than 255 channels together; cut some with cantap convert --channel",
            )?;
            Ok(offset)
        })
        .collect()
}

/// All traces as one, ordered by the first one's time.
struct Merged<'a> {
    sources: Vec<Records>,
    /// Each source's next record, on the first one's clock.
    heads: Vec<Option<TraceRecord>>,
    offsets: &'a [u8],
    others: Vec<Clock>,
}

impl<'a> Merged<'a> {
    fn open(args: &Args, others: Vec<Clock>, offsets: &'a [u8]) -> anyhow::Result<Self> {
        let zone = args.write.zone.clone();
        let read = ReadArgs {
            format: args.from,
            columns: None,
            strict: args.strict,
            filter: Vec::new(),
            zone,
            format_option: "--from",
        };
        let sources =
            args.traces.iter().map(|path| read.open(path, Vec::new())).collect::<anyhow::Result<Vec<_>>>()?;
        let mut merged = Self { heads: vec![None; sources.len()], sources, offsets, others };
        for source in 0..merged.sources.len() {
            merged.refill(source)?;
        }
        Ok(merged)
    }

    fn refill(&mut self, source: usize) -> anyhow::Result<()> {
        self.heads[source] = self.sources[source].next()?;
        if let Some(head) = &mut self.heads[source]
            && let Some(other) = source.checked_sub(1)
        {
            head.time_ns = self.others[other].to_first(head.time_ns);
        }
        Ok(())
    }

    fn next(&mut self) -> anyhow::Result<Option<TraceRecord>> {
        let heads = self.heads.iter().enumerate();
        let earliest = heads.filter_map(|(source, head)| head.map(|head| (head.time_ns, source))).min();
        let Some((_, source)) = earliest else { return Ok(None) };
        let Some(mut record) = self.heads[source] else { return Ok(None) };
        match source.checked_sub(1) {
            None => {
                for other in &mut self.others {
                    if let Clock::Found(found) = other {
                        found.1.first(&record);
                    }
                }
            }
            Some(other) => {
                if let Clock::Found(found) = &mut self.others[other] {
                    found.1.second(&record);
                }
            }
        }
        self.refill(source)?;
        record.channel = record.channel.saturating_add(self.offsets[source]);
        Ok(Some(record))
    }
}

fn print(out: &mut impl Write, first: &Path, path: &Path, found: &Found) -> io::Result<()> {
    let (first, path) = (first.display(), path.display());
    let Found { by, channel_offset } = found;
    let (alignment, agreement) = match by {
        Ok(found) => found,
        Err(shift_ns) => {
            let shift_s = *shift_ns as f64 / 1e9;
            return writeln!(
                out,
                "{shift_s:+.6} s added to the times of {path}; its channel 1 is now {}",
                u16::from(*channel_offset) + 1
            );
        }
    };
    for (a, b) in &alignment.channels {
        let now = if *channel_offset == 0 { String::new() } else { format!(" (now {})", b + channel_offset) };
        writeln!(out, "channel {b} of {path}{now} is on the bus of channel {a} of {first}")?;
    }
    let steps = match alignment.map.steps() {
        0 => String::new(),
        1 => ", and was set once meanwhile".to_owned(),
        steps => format!(", and was set {steps} meanwhile", steps = counted(steps, "time")),
    };
    writeln!(
        out,
        "its clock was {:+.6} s from the first one's and gains {:+.3} ppm on it{steps}",
        -(alignment.map.ahead_ns() as f64) / 1e9,
        // Avoid a minus sign before zero.
        (-alignment.map.drift_ppm() * 1e3).round() / 1e3 + 0.0,
    )?;
    writeln!(
        out,
        "{} in both; of the common time, {} only in {first}, {} only in {path}",
        counted(agreement.both, "frame"),
        agreement.only_first,
        agreement.only_second
    )?;
    writeln!(
        out,
        "stamps of the same frame apart: {:.1} us half of them, {:.1} us 99 %, {:.1} us at most",
        us(agreement.median_ns),
        us(agreement.most_ns),
        us(agreement.worst_ns)
    )
}

fn us(ns: u64) -> f64 {
    ns as f64 / 1e3
}

fn to_json(args: &Args, found: &[Found], missing: &[Missing], not_carried: &LeftOut) -> Value {
    let traces = args.traces[1..].iter().zip(found).map(|(path, found)| {
        let Found { by, channel_offset } = found;
        let (alignment, agreement) = match by {
            Ok(found) => found,
            Err(shift_ns) => {
                return json!({
                    "trace": path.display().to_string(),
                    "channels": [],
                    "offset_s": -(*shift_ns as f64) / 1e9 + 0.0,
                    "drift_ppm": 0.0,
                });
            }
        };
        json!({
            "trace": path.display().to_string(),
            "channels": alignment.channels.iter().map(|&(first, own)| json!({
                "first": first, "own": own, "written": u16::from(own) + u16::from(*channel_offset),
            })).collect::<Vec<_>>(),
            "offset_s": -(alignment.map.ahead_ns() as f64) / 1e9,
            "drift_ppm": -alignment.map.drift_ppm(),
            "clock_set": alignment.map.steps(),
            "moments": alignment.moments,
            "frames_in_both": agreement.both,
            "only_in_first": agreement.only_first,
            "only_in_this": agreement.only_second,
            "apart_us": {
                "median": us(agreement.median_ns),
                "p99": us(agreement.most_ns),
                "max": us(agreement.worst_ns),
            },
        })
    });
    let mut object =
        json!({ "first": args.traces[0].display().to_string(), "traces": traces.collect::<Vec<_>>() });
    let mut all = Missing::default();
    for missing in missing {
        all.merge(missing);
    }
    all.left_out.merge(not_carried);
    all.put_into(&mut object);
    object["missing_pct"] = missing.iter().map(Missing::share_pct).collect();
    object
}
