//! Rules tried on a trace.

use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::ExitCode;

use cantap::wire::message::RuleCounts;
use cantap_formats::WriteOptions;
use cantap_trace::TraceRecord;
use cantap_trace::counted;
use cantap_work::gateway::{DryRun, DryRunCounts, Rules, Sent};
use cantap_work::missing::Missing;
use serde_json::{Value, json};

use super::arguments::Args;
use crate::trace_output::TraceOutput;

/// Runs it.
pub(super) fn run(args: &Args, rules: &Rules, trace: &Path) -> anyhow::Result<ExitCode> {
    let filters = args.read.filters(&args.databases.load(args.read.strict, false)?)?;
    let mut records = args.read.open(trace, filters)?;
    let options = WriteOptions { format: args.written_format, ..WriteOptions::default() };
    let output = args.output.as_ref().map(|path| TraceOutput::create(path, &options, false)).transpose()?;
    let mut sink = Sink { output, all: args.all };
    let mut run = DryRun::new(rules.clone());
    let (mut batch, mut sent) = (Vec::new(), Vec::new());
    while records.next_batch(&mut batch)? {
        for record in &batch {
            run.push(record, &mut sent);
            sink.write(Some(record), &mut sent)?;
        }
    }
    let counts = run.finish(&mut sent);
    sink.write(None, &mut sent)?;
    if let Some(output) = sink.output {
        output.finish()?;
    }
    let mut out = BufWriter::new(std::io::stdout().lock());
    if args.json {
        writeln!(out, "{}", object(rules, &counts, &records.missing()))?;
    } else {
        print(rules, &counts, &mut out)?;
    }
    out.flush()?;
    Ok(ExitCode::SUCCESS)
}

struct Sink {
    output: Option<TraceOutput>,
    all: bool,
}

impl Sink {
    /// Writes what is sent in order of time; what is sent because of the record comes after it.
    fn write(&mut self, record: Option<&TraceRecord>, sent: &mut Vec<Sent>) -> anyhow::Result<()> {
        let until = record.map_or(i64::MAX, |record| record.time_ns);
        let before = sent.partition_point(|sent| sent.time_ns < until);
        if let Some(output) = &mut self.output {
            sent[..before].iter().try_for_each(|sent| output.write(&sent.record()))?;
            if let Some(record) = record.filter(|_| self.all) {
                output.write(record)?;
            }
            sent[before..].iter().try_for_each(|sent| output.write(&sent.record()))?;
        }
        sent.clear();
        Ok(())
    }
}

/// The frames that a rule kept from the other bus.
fn dropped(rules: &Rules, number: usize, counts: &RuleCounts) -> u32 {
    if rules.drops(number) { counts.matched } else { 0 }
}

fn print(rules: &Rules, counts: &DryRunCounts, out: &mut impl Write) -> std::io::Result<()> {
    writeln!(
        out,
        "{:<4} {:<4} {:<16} {:>8} {:>8} {:>8} {:>8} {:>8} {:>6}",
        "line", "from", "rule", "matched", "sent", "changed", "dropped", "replaced", "lost"
    )?;
    for (number, (rule, (sums, changed))) in rules.rules.iter().zip(&counts.rules).enumerate() {
        writeln!(
            out,
            "{:<4} {:<4} {:<16} {:>8} {:>8} {changed:>8} {:>8} {:>8} {:>6}",
            rule.line,
            rule.from.number(),
            rule.name,
            sums.matched,
            sums.sent,
            dropped(rules, number, sums),
            sums.overtaken,
            sums.lost
        )?;
    }
    for (channel, unmatched) in (1..).zip(counts.unmatched).filter(|(_, unmatched)| *unmatched > 0) {
        writeln!(
            out,
            "{unmatched} of channel {channel} matched no rule and are not passed on",
            unmatched = counted(unmatched, "frame")
        )?;
    }
    if counts.not_received > 0 {
        writeln!(
            out,
            "{} of other channels, or of CAN FD, which a device does not receive",
            counted(counts.not_received, "frame")
        )?;
    }
    Ok(())
}

fn object(rules: &Rules, counts: &DryRunCounts, missing: &Missing) -> Value {
    let all = rules.rules.iter().zip(&counts.rules).enumerate();
    let rows = all.map(|(number, (rule, (sums, changed)))| {
        json!({
            "rule": rule.name,
            "line": rule.line,
            "from": rule.from.number(),
            "matched": sums.matched,
            "sent": sums.sent,
            "changed": changed,
            "dropped": dropped(rules, number, sums),
            "replaced": sums.overtaken,
            "lost": sums.lost,
        })
    });
    let mut value = json!({
        "rules": rows.collect::<Vec<_>>(),
        "unmatched": counts.unmatched,
        "not_received": counts.not_received,
    });
    missing.put_into(&mut value);
    value
}
