//! `cantap decode`: a trace as signals.

#[cfg(feature = "parquet")]
mod columns;
mod command_line;
mod csv;
mod decoded;
mod json;
mod output;
mod text;
mod wide;

pub use command_line::Args;
pub use decoded::Seconds;
pub use text::write_values;

use std::process::ExitCode;

use cantap::TraceEvent;
use cantap_signals::Decoder;

use self::decoded::Decoded;
use self::output::{Form, Output};
use crate::input::Records;
use crate::wrong::wrong;

/// What the summary says.
#[derive(Default, serde::Serialize)]
struct Count {
    frames: u64,
    decoded: u64,
    values: u64,
    lost: u64,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let databases = args.databases.or_of(args.live.devices());
    if databases.is_empty() {
        return Err(wrong(
            "no database to decode by; give one with --db FILE (.dbc, .kcd, .sym, .arxml or .toml)",
        ));
    }
    let decoder = databases.load_some(args.read.strict, args.quiet, &args.signals)?;
    let form = Form::of(args)?;
    let mut records = args.read.open_either(args.input.as_ref(), &args.live)?;
    let mut output = Output::open(args, form, &decoder)?;
    let count = decode(args, &decoder, &mut records, &mut output)?;
    let mut summary = serde_json::to_value(&count)?;
    records.missing().put_into(&mut summary);
    output.finish(&summary)?;
    let Count { frames, decoded, values, lost } = count;
    eprintln!("cantap: decoded {decoded} of {frames} frames, {values} values");
    if lost > 0 {
        eprintln!("cantap: {lost} frames or more are missing in the trace");
    }
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
    while records.next_batch(&mut batch)? {
        for record in &batch {
            if let TraceEvent::Lost { count: lost, .. } = record.event {
                count.lost += u64::from(lost);
            }
            let Some(frame) = record.frame() else {
                output.push_event(record)?;
                continue;
            };
            count.frames += 1;
            let Some(reference) = decoder.decode(record.channel, frame, &mut values) else { continue };
            // Chosen signals only: a message without any of them is not worth a line.
            if values.is_empty() && !args.signals.is_empty() {
                continue;
            }
            count.decoded += 1;
            count.values += values.len() as u64;
            let message = decoder.message(reference);
            output.push(&Decoded { record, frame, reference, message, values: &values })?;
        }
        if records.may_wait() {
            output.flush()?;
        }
    }
    Ok(count)
}
