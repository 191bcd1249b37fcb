//! Decoding signals, side by side with cantools: the same frames with the same database, in one
//! run.

use std::fmt::Write;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cantap::{Frame, TraceFrame};
use cantap_signals::{Decoder, Source, dbc};
use xshell::cmd;

use crate::peers::Peers;
use crate::workspace;

/// A car's database: 217 messages.
const DATABASE: &str = "host/signals/tests/data/dbc/vehicle.dbc";
/// Random payloads per message.
const PAYLOADS: u64 = 50;
/// How often cantools decodes all frames; about a second.
const PEER_ROUNDS: u32 = 20;
/// How long ours decodes, at least.
const DURATION: Duration = Duration::from_secs(2);
/// What the project promises.
const LEAST_RATIO: f64 = 30.0;

/// Decodes with both and compares.
pub fn run() -> Result<()> {
    let shell = workspace::shell()?;
    let bytes = shell.read_binary_file(DATABASE)?;
    let database = dbc::parse(DATABASE, &bytes)?;
    let frames: Vec<TraceFrame> = database.messages.iter().flat_map(frames_of).collect();
    let decoder = Decoder::new(vec![Source { channel: None, database }]);

    let (signals, seconds) = ours(&decoder, &frames);
    let per_round = signals.1;
    let rate = signals.0 as f64 / seconds;
    println!("signals: {} frames of {DATABASE}, decoded repeatedly", frames.len());
    println!("{:<10} {:>12} {:>12}", "", "signals/s", "frames/s");
    let frames_per_signal = frames.len() as f64 / per_round as f64;
    println!("{:<10} {:>12.0} {:>12.0}", "cantap", rate, rate * frames_per_signal);

    let Some(peers) = Peers::find_or_install(&shell)? else { return Ok(()) };
    let list = workspace::target().join("bench-signals.txt");
    let mut text = String::new();
    for frame in &frames {
        write!(text, "{:08X} ", frame.id().raw())?;
        frame.data().iter().try_for_each(|byte| write!(text, "{byte:02X}"))?;
        text.push('\n');
    }
    shell.write_file(&list, text)?;
    let (python, script) = (&peers.python, "xtask/src/bench/signals.py");
    let rounds = PEER_ROUNDS.to_string();
    let output = cmd!(shell, "{python} {script} {DATABASE} {list} {rounds}").quiet().read()?;
    let (peer_signals, peer_seconds) = output.split_once(' ').context("the script prints two numbers")?;
    let (peer_signals, peer_seconds): (u64, f64) = (peer_signals.parse()?, peer_seconds.parse()?);
    let same = per_round * u64::from(PEER_ROUNDS) == peer_signals;
    ensure!(
        same,
        "cantools decodes {peer_signals} signals in {PEER_ROUNDS} rounds, cantap {per_round} in one"
    );
    let peer_rate = peer_signals as f64 / peer_seconds;
    println!("{:<10} {:>12.0} {:>12.0}", "cantools", peer_rate, peer_rate * frames_per_signal);
    println!("{:<10} {:>11.1}x (at least {LEAST_RATIO}x)", "ratio", rate / peer_rate);
    ensure!(rate >= LEAST_RATIO * peer_rate, "decoding is not fast enough");
    Ok(())
}

/// Random payloads, generated in the same way for every program.
fn frames_of(message: &cantap_signals::Message) -> Vec<TraceFrame> {
    let payload = |number: u64| {
        let mut random = (u64::from(message.id.raw()) << 32 | number).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        random ^= random >> 29;
        random = random.wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let bytes = (random ^ random >> 32).to_le_bytes();
        Frame::from_bus(message.id, false, message.length.min(8) as u8, bytes).into()
    };
    (0..PAYLOADS).map(payload).collect()
}

/// Decodes all frames until [`DURATION`] is over: signals in all and per round, and seconds.
fn ours(decoder: &Decoder, frames: &[TraceFrame]) -> ((u64, u64), f64) {
    let mut values = Vec::new();
    let (mut signals, mut rounds) = (0, 0);
    let begin = Instant::now();
    while begin.elapsed() < DURATION {
        for frame in frames {
            let found = decoder.decode(1, frame, &mut values);
            std::hint::black_box(found);
            std::hint::black_box(&values);
            signals += values.len() as u64;
        }
        rounds += 1;
    }
    ((signals, signals / rounds), begin.elapsed().as_secs_f64())
}
