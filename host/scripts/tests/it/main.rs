//! Scripts on simulated buses and on the virtual device.

mod bench;
mod explain;
mod faults;
mod hostile;
mod library;
mod live;
mod tables;
mod thread;
mod twin;

use std::alloc::System;
use std::sync::Arc;

use cantap_scripts::{Bench, BenchBus, Counting, Outcome, Report, Script};
use cantap_signals::{Decoder, Source};
use cantap_trace::TraceRecord;

/// As in every program that runs scripts.
#[global_allocator]
static ALLOCATOR: Counting<System> = Counting(System);

const SECOND_NS: u64 = 1_000_000_000;

/// A database with one message.
const DATABASE: &[u8] =
    b"VERSION \"\"\nBU_: A\nBO_ 256 Engine: 8 A\n SG_ Speed : 0|16@1+ (0.25,0) [0|8000] \"rpm\" A\n \
SG_ Gear : 16|3@1+ (1,0) [0|7] \"\" A\nVAL_ 256 Gear 0 \"Neutral\" 1 \"Drive\" ;\n";

fn decoder() -> Arc<Decoder> {
    let database = cantap_signals::dbc::parse("engine.dbc", DATABASE).unwrap();
    Arc::new(Decoder::new(vec![Source { channel: None, database }]))
}

fn script(name: &str, source: &str) -> Script {
    Script::new(name.to_owned(), source.to_owned())
}

fn bench(options: &str, seconds: u64) -> Bench {
    let BenchBus { options, faults } = options.parse().unwrap();
    Bench {
        options,
        faults,
        bitrates_bps: [500_000; 2],
        decoder: decoder(),
        seed: 1,
        keys: Vec::new(),
        readable: None,
        duration_ns: seconds * SECOND_NS,
    }
}

/// Runs scripts on otherwise silent buses.
fn run(seconds: u64, scripts: &[Script]) -> (Report, Vec<TraceRecord>, Vec<String>) {
    run_on(&bench("load=0", seconds), scripts)
}

fn run_on(bench: &Bench, scripts: &[Script]) -> (Report, Vec<TraceRecord>, Vec<String>) {
    let (mut records, mut lines) = (Vec::new(), Vec::new());
    let report = bench
        .run(
            scripts,
            &mut |record| records.push(record),
            &mut |message| lines.push(format!("{} {}: {}", message.at_ns, message.script, message.text)),
            &mut || true,
        )
        .unwrap();
    (report, records, lines)
}

/// The single failure's reason.
fn failure(report: &Report) -> String {
    let reasons: Vec<&str> = report
        .tests
        .iter()
        .filter_map(|test| match &test.outcome {
            Outcome::Failed(reason) => Some(reason.as_str()),
            Outcome::Passed => None,
        })
        .chain(report.errors.iter().map(|(_, error)| error.as_str()))
        .collect();
    assert_eq!(reasons.len(), 1, "{report:?}");
    reasons[0].to_owned()
}
