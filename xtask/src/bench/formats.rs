//! Converting and reading trace files, side by side with can-utils' log2asc and python-can: the same million frames of
//! a ship's bus, from file to file, in one run. A conversion is timed from the command's start to its end.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cantap_formats::{ReadOptions, WriteOptions, create_writer, open_reader};
use xshell::{Shell, cmd};

use crate::peers::Peers;
use crate::workspace;

/// Some ten thousand frames of an NMEA 2000 bus, recorded by candump.
pub(super) const RECORDING: &str = "host/formats/tests/data/nmea2000.log.gz";
/// Frames of the trace made of it.
const FRAMES: u64 = 1_000_000;
/// How often ours and log2asc take turns; the best of each counts. python-can takes so long that the machine's moods
/// average out.
const ROUNDS: usize = 5;

/// The files, kept in `target/` for inspection.
struct Files {
    log: PathBuf,
    asc: PathBuf,
    blf: PathBuf,
    peer_asc: PathBuf,
    peer_blf: PathBuf,
}

impl Files {
    fn create() -> Result<Self> {
        let dir = workspace::target().join("bench-formats");
        fs::create_dir_all(&dir)?;
        Ok(Self {
            log: dir.join("trace.log"),
            asc: dir.join("cantap.asc"),
            blf: dir.join("cantap.blf"),
            peer_asc: dir.join("log2asc.asc"),
            peer_blf: dir.join("python-can.blf"),
        })
    }
}

/// Measures speed.
pub fn run() -> Result<()> {
    let shell = workspace::shell()?;
    let files = Files::create()?;
    cmd!(shell, "cargo build --release --quiet -p cantap-cli").quiet().run()?;
    make_trace(&workspace::root().join(RECORDING), &files.log, FRAMES)?;
    let bytes = fs::metadata(&files.log)?.len();
    println!(
        "formats: {FRAMES} frames of {RECORDING} repeated, a candump log of {bytes} bytes, one conversion at a time"
    );
    let slow = if let Some(peers) = Peers::find_or_install(&shell)? {
        compare(&shell, &peers, &files)?
    } else {
        println!("{:<16} {:>10}", "", "cantap, s");
        println!("{:<16} {:>10.3}", "candump to ASC", best(|| convert(&shell, &files.log, &files.asc))?);
        println!("{:<16} {:>10.3}", "candump to BLF", best(|| convert(&shell, &files.log, &files.blf))?);
        println!("{:<16} {:>10.3}", "read BLF", best(|| count(&files.blf))?);
        Vec::new()
    };
    ensure!(slow.is_empty(), "not fast enough: {}", slow.join(", "));
    Ok(())
}

/// Writes a recording repeatedly, with continuing times, up to this many frames.
pub(super) fn make_trace(recording: &Path, log: &Path, frames: u64) -> Result<()> {
    let records: Vec<_> = open_reader(recording, &ReadOptions::default())?.collect::<Result<_, _>>()?;
    let (first, last) = records.first().zip(records.last()).context("the recording is empty")?;
    let span_ns = last.time_ns - first.time_ns + 1_000_000;
    let mut writer = create_writer(log, &WriteOptions::default())?;
    let laps = (0..).flat_map(|lap| records.iter().map(move |record| (lap, *record)));
    for (lap, mut record) in laps.take(frames as usize) {
        record.time_ns += lap * span_ns;
        writer.write(&record)?;
    }
    let left_out = writer.finish()?;
    ensure!(left_out.is_empty(), "the recording does not fit its own format");
    Ok(())
}

/// Times all conversions with our command and a peer's program; returns those that are slower than promised.
fn compare(shell: &Shell, peers: &Peers, files: &Files) -> Result<Vec<&'static str>> {
    println!(
        "{:<16} {:>10} {:<12} {:>10} {:>7} {:>9}",
        "", "cantap, s", "  peer", "its s", "ratio", "at least"
    );
    let mut slow = Vec::new();
    let mut line = |what: &'static str, ours: f64, peer: &str, theirs: f64, least: f64| {
        println!("{what:<16} {ours:>10.3}   {peer:<10} {theirs:>10.3} {:>6.1}x {least:>8}x", theirs / ours);
        if theirs < least * ours {
            slow.push(what);
        }
    };

    let (mut ours, mut theirs) = (f64::MAX, f64::MAX);
    let (log, peer_asc) = (&files.log, &files.peer_asc);
    for _ in 0..ROUNDS {
        ours = ours.min(timed(|| convert(shell, log, &files.asc))?);
        let log2asc =
            || Ok(cmd!(shell, "log2asc -I {log} -O {peer_asc} can0").quiet().run().map(|()| FRAMES)?);
        theirs = theirs.min(timed(log2asc)?);
    }
    line("candump to ASC", ours, "log2asc", theirs, 8.0);

    let theirs = python_can(shell, peers, &[log, &files.peer_blf])?;
    line("candump to BLF", best(|| convert(shell, log, &files.blf))?, "python-can", theirs, 30.0);

    let theirs = python_can(shell, peers, &[&files.blf])?;
    line("read BLF", best(|| count(&files.blf))?, "python-can", theirs, 20.0);

    for (program, file) in [
        ("log2asc", peer_asc),
        ("python-can", &files.peer_blf),
        ("cantap", &files.asc),
        ("cantap", &files.blf),
    ] {
        let found = count(file)?;
        ensure!(found == FRAMES, "{program} wrote {found} of {FRAMES} frames into {}", file.display());
    }
    Ok(slow)
}

/// Seconds that python-can takes to read a file, or to convert one to another, without its start-up.
fn python_can(shell: &Shell, peers: &Peers, files: &[&Path]) -> Result<f64> {
    let (python, script) = (&peers.python, "xtask/src/bench/formats.py");
    let output = cmd!(shell, "{python} {script} {files...}").quiet().read()?;
    let (messages, seconds) = output.split_once(' ').context("the script prints two numbers")?;
    let messages: u64 = messages.parse()?;
    ensure!(messages == FRAMES, "python-can finds {messages} of {FRAMES} messages in {}", files[0].display());
    Ok(seconds.parse()?)
}

/// Converts one file to another with the command.
fn convert(shell: &Shell, from: &Path, to: &Path) -> Result<u64> {
    let program = workspace::target().join("release/cantap");
    cmd!(shell, "{program} convert {from} {to}").quiet().run()?;
    Ok(FRAMES)
}

/// How many frames a file has.
fn count(file: &Path) -> Result<u64> {
    let mut frames = 0;
    for record in open_reader(file, &ReadOptions::default())? {
        std::hint::black_box(record?);
        frames += 1;
    }
    Ok(frames)
}

/// The fastest of several rounds, in seconds.
fn best(mut work: impl FnMut() -> Result<u64>) -> Result<f64> {
    (0..ROUNDS).try_fold(f64::MAX, |best, _| Ok(timed(&mut work)?.min(best)))
}

/// Seconds of one round.
fn timed(mut work: impl FnMut() -> Result<u64>) -> Result<f64> {
    let begin = Instant::now();
    let frames = work()?;
    let seconds = begin.elapsed().as_secs_f64();
    ensure!(frames == FRAMES, "{frames} of {FRAMES} frames");
    Ok(seconds)
}
