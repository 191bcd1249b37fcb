//! How many frames per second all protocols read together: `cargo run --release -p cantap-protocols --example
//! speed`, optionally with the name of a single one.
//!
//! A second of a vehicle with a diagnostic session besides its cyclic frames, a truck, a boat and a plant, repeated; each on its own channel, as a
//! survey would find them, and once more with every protocol on every channel.

use std::hint::black_box;
use std::process::ExitCode;
use std::time::Instant;

use cantap_protocols::{Options, Protocol, Reader};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const ROUNDS: i64 = 200;
/// The required speed for each bus as a survey finds it, in frames per second of processor time.
const AT_LEAST: f64 = 2e6;

fn main() -> ExitCode {
    let mut is_good = true;
    let buses =
        [("vehicle", vehicle as fn(u32) -> String), ("truck", truck), ("boat", boat), ("plant", plant)];
    let only = std::env::args().nth(1);
    for (channel, (name, frame)) in (1_u8..).zip(buses) {
        if only.as_deref().is_some_and(|only| only != name) {
            continue;
        }
        let records: Vec<_> = (0..10_000).map(|at| record(channel, at, &frame(at))).collect();
        let per_s = measure(name, &records, Options::default());
        if per_s < AT_LEAST {
            eprintln!("{name}: {per_s:.0} frames/s are below the {AT_LEAST:.0} asked for");
            is_good = false;
        }
        let all = Options { protocols: Protocol::ALL.to_vec(), ..Options::default() };
        measure(&format!("{name}, all protocols"), &records, all);
    }
    if is_good { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn record(channel: u8, at: u32, frame: &str) -> TraceRecord {
    let frame = frame.parse().expect("frames of this file are frames");
    let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
    TraceRecord { time_ns: i64::from(at) * 100_000, device_ns: None, channel, event }
}

/// Frames per second, of processor time where the system provides it.
fn measure(name: &str, records: &[TraceRecord], options: Options) -> f64 {
    let mut reader = Reader::new(options);
    let (mut events, mut count) = (Vec::new(), 0);
    let start = Instant::now();
    let processor = processor_s();
    for round in 0..ROUNDS {
        for record in records {
            let record = TraceRecord { time_ns: record.time_ns + round * 1_000_000_000, ..*record };
            reader.push(&record, &mut events);
            // Like the command.
            count += events.len();
            black_box(&events);
            events.clear();
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    let frames = records.len() as f64 * ROUNDS as f64;
    let by_processor = processor.zip(processor_s()).map(|(before, after)| frames / (after - before));
    print!("{name:<24} {:>6.2} M frames/s", frames / seconds / 1e6);
    if let Some(by_processor) = by_processor {
        print!(", {:>6.2} by the processor's time", by_processor / 1e6);
    }
    println!(", {count} events");
    by_processor.unwrap_or(frames / seconds)
}

/// This thread's processor time, if Linux reports it: the load of a busy machine does not count.
fn processor_s() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split(' ').next()?.parse::<f64>().ok()? / 1e9)
}

/// One frame in ten is for diagnostics.
fn vehicle(at: u32) -> String {
    const TALK: [&str; 5] = [
        "7E0#0322F190",
        "7E8#101462F190575657",
        "7E0#300000",
        "7E8#215A5A5A314B5A41",
        "7E8#2257303030303031",
    ];
    match at % 10 {
        0 => TALK[(at / 10 % 5) as usize].to_owned(),
        other => {
            format!("{:03X}#{:016X}", 0x100 + other * 0x21, u64::from(at).wrapping_mul(0x9E37_79B9_7F4A_7C15))
        }
    }
}

/// Trouble codes by broadcast, among groups of one frame.
fn truck(at: u32) -> String {
    const TALK: [&str; 3] =
        ["1CECFF00#200A0002FFCAFE00", "1CEBFF00#0104FFBE0A038221", "1CEBFF00#021F037FFFFFFFFF"];
    match at % 10 {
        0 => TALK[(at / 10 % 3) as usize].to_owned(),
        other => format!("0CF00{other}00#{:016X}", u64::from(at)),
    }
}

/// A position in a fast packet of seven frames, among groups of one frame.
fn boat(at: u32) -> String {
    const TALK: [&str; 7] = [
        "0DF80502#402FD2C73F00E73A",
        "0DF80502#4124C0A424231143",
        "0DF80502#424305809E757091",
        "0DF80502#43B9310385C88F02",
        "0DF80502#440000000013FC0C",
        "0DF80502#4549008000AC0D00",
        "0DF80502#460000FFFFFFFFFF",
    ];
    if at.is_multiple_of(2) {
        TALK[(at / 2 % 7) as usize].to_owned()
    } else {
        "09F80102#36729A16021AB80D".to_owned()
    }
}

/// PDOs, heartbeats, and an SDO transfer now and then.
fn plant(at: u32) -> String {
    match at % 10 {
        0 => "605#4018100100000000".to_owned(),
        1 => "585#4318100178563412".to_owned(),
        2 => format!("7{:02X}#05", at / 10 % 5 + 1),
        3 => "080#".to_owned(),
        other => format!("{:03X}#{:016X}", 0x180 + 0x80 * (other - 4) + at / 10 % 5 + 1, u64::from(at)),
    }
}
