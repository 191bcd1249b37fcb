//! `cantap decode`: a trace as signals.

#[cfg(feature = "parquet")]
mod columns;
mod command_line;
mod csv;
mod decoded;
mod events;
mod json;
mod output;
mod text;
mod wide;

pub use command_line::Args;
pub use text::write_values;

use std::process::ExitCode;

use std::sync::Arc;

use cantap::{TraceEvent, TraceRecord};
use cantap_protocols::ReadItem;
use cantap_signals::{Decoder, NotDecoded, SignalValue};
use cantap_trace::counted;

use self::decoded::Decoded;
use self::output::{Form, Output};
use crate::database_args::load_selected;
use crate::input::Records;
use crate::protocols::reading;
use crate::usage_error::usage;

/// The figures in the summary.
#[derive(Default, serde::Serialize)]
struct Count {
    frames: u64,
    decoded: u64,
    values: u64,
    lost: u64,
    /// Whether there may be more, as while the device was off the bus.
    lost_at_least: bool,
    /// What frames with containers have besides these values.
    #[serde(skip)]
    not_decoded: NotDecoded,
    /// Number of events, with `--protocols`.
    #[serde(skip_serializing_if = "is_zero")]
    events: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands out references")]
const fn is_zero(count: &u64) -> bool {
    *count == 0
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let databases = args.databases.or_of(args.live.devices());
    if databases.is_empty() && !args.protocols {
        return Err(usage(
            "no database to decode by; give one with --db FILE (.dbc, .kcd, .sym, .arxml, .dbf, .xlsx, .csv or .toml), or --protocols",
        ));
    }
    let decoder = load_selected(&databases, args.read.strict, args.quiet, &args.signals)?;
    let form = Form::of(args)?;
    let (filters, range) = (args.read.filters(&decoder)?, args.range.of(args.input.as_ref())?);
    let records = args.read.open_either(args.input.as_ref(), &args.live, filters)?;
    let mut records = records.within(range)?;
    let mut output = Output::open(args, form, &decoder)?;
    let count = decode(args, &decoder, &mut records, &mut output)?;
    let mut summary = serde_json::to_value(&count)?;
    records.missing().put_into(&mut summary);
    let not_decoded: serde_json::Map<_, _> =
        count.not_decoded.iter().map(|(what, count)| (what.to_owned(), count.into())).collect();
    if !not_decoded.is_empty() {
        summary["not_decoded"] = not_decoded.into();
    }
    let left_out = output.left_out();
    output.finish(&summary)?;
    let Count { frames, decoded, values, lost, lost_at_least, not_decoded, events } = count;
    let said = if args.protocols {
        format!(", {events} of protocols", events = counted(events, "event"))
    } else {
        String::new()
    };
    eprintln!(
        "cantap: decoded {decoded} of {frames}, {values}{said}",
        frames = counted(frames, "frame"),
        values = counted(values, "value")
    );
    if left_out > 0 {
        eprintln!(
            "cantap: {left_out} of protocols are texts or bytes, which a table of numbers has no columns for; --csv without --wide has them",
            left_out = counted(left_out, "value")
        );
    }
    for (what, count) in not_decoded.iter() {
        eprintln!("cantap: not decoded: {what} ({count})");
    }
    match (lost, lost_at_least) {
        (0, false) => {}
        (0, true) => eprintln!("cantap: an unknown number of frames is missing in the trace"),
        _ => eprintln!("cantap: {lost} or more are missing in the trace", lost = counted(lost, "frame")),
    }
    records.judge()?;
    Ok(ExitCode::SUCCESS)
}

fn decode(
    args: &Args,
    decoder: &Decoder,
    records: &mut Records,
    output: &mut Output,
) -> anyhow::Result<Count> {
    let mut count = Count::default();
    let mut values = Vec::new();
    let mut batch = Vec::new();
    let mut reading = if args.protocols {
        let decoder = (!args.databases.is_empty()).then(|| Arc::new(decoder.clone()));
        Some(reading(args.protocol.options(args.quiet)?, decoder, args.quiet))
    } else {
        None
    };
    loop {
        let more = records.next_batch(&mut batch)?;
        match &mut reading {
            None => {
                for record in &batch {
                    one(args, decoder, record, &mut values, &mut count, output)?;
                }
            }
            Some(reading) => reading.take_both(&batch, more, |read| match read {
                ReadItem::Record(record) => one(args, decoder, record, &mut values, &mut count, output),
                ReadItem::Event(event) => {
                    count.events += 1;
                    output.push_protocol_event(&event)
                }
                ReadItem::Announcement(_) => Ok(()),
            })?,
        }
        if !more {
            return Ok(count);
        }
        if records.may_wait() {
            output.flush()?;
        }
    }
}

fn one(
    args: &Args,
    decoder: &Decoder,
    record: &TraceRecord,
    values: &mut Vec<SignalValue>,
    count: &mut Count,
    output: &mut Output,
) -> anyhow::Result<()> {
    if let TraceEvent::Lost { count: lost, at_least, .. } = record.event {
        count.lost += u64::from(lost);
        count.lost_at_least |= at_least;
    }
    let Some(frame) = record.frame() else { return output.push_event(record) };
    count.frames += 1;
    let Some(reference) = decoder.decode(record.channel, frame, values) else { return Ok(()) };
    // With chosen signals only, a message without any of them is not worth a line.
    if values.is_empty() && !args.signals.is_empty() {
        return Ok(());
    }
    decoder.count_not_decoded(reference, frame.data(), &mut count.not_decoded);
    count.decoded += 1;
    count.values += values.len() as u64;
    output.push(&Decoded { record, frame, reference, message: decoder.message(reference), values })
}
