//! Sizes and times of Parquet compared with trace formats: each has the same frames of the virtual car and answers the same
//! question.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use xshell::{Cmd, Shell, cmd};

use super::formats::make_trace;
use crate::peers::Peers;
use crate::workspace;

/// What the car sends in this time is repeated.
const CAPTURE_S: u32 = 60;
/// Frames of the trace made of it.
const FRAMES: u64 = 1_000_000;
/// Rounds, of which the best counts.
const ROUNDS: usize = 3;
const DATABASE: &str = "host/virtual/src/car/car.dbc";
/// The signal whose mean is asked for.
const SIGNAL: &str = "EngineSpeed";
/// The kernel's unit of processor time (`sysconf(_SC_CLK_TCK)`, which is always 100 on Linux).
const TICKS_PER_S: f64 = 100.0;

/// Trace formats, by the file's name.
const TRACES: &[(&str, &str)] = &[
    ("candump", "copy.log"),
    ("candump, gzip", "copy.log.gz"),
    ("candump, zstd", "copy.log.zst"),
    ("BLF", "copy.blf"),
    ("MF4", "copy.mf4"),
];
/// What `decode` writes: name, its options, the file with the signal in question, and how DuckDB asks for it.
const DECODED: &[(&str, &str, &str, &str)] = &[
    ("Parquet, a row per value", "", "long.parquet", "value FROM 'FILE' WHERE signal = 'EngineSpeed'"),
    (
        "Parquet, a file per message",
        "--per-message",
        "messages",
        "EngineSpeed FROM 'FILE/ECM_Engine1.parquet'",
    ),
    (
        "Parquet, every 100 ms",
        "--resample 100ms",
        "wide.parquet",
        "\"1:ECM_Engine1.EngineSpeed\" FROM 'FILE'",
    ),
];

/// Measures.
pub fn run() -> Result<()> {
    let shell = workspace::shell()?;
    cmd!(shell, "cargo build --release --quiet -p cantap-cli").quiet().run()?;
    let cantap = workspace::target().join("release/cantap");
    let dir = workspace::target().join("bench-columns");
    shell.remove_path(&dir)?;
    fs::create_dir_all(&dir)?;
    let (capture, trace) = (dir.join("car.log"), dir.join("trace.log"));
    let seconds = CAPTURE_S.to_string();
    cmd!(shell, "{cantap} capture -d virtual:car -t {seconds} -o {capture}").quiet().ignore_stderr().run()?;
    make_trace(&capture, &trace, FRAMES)?;
    let python = Peers::find_or_install(&shell)?.map(|peers| peers.python);

    println!(
        "columns: {CAPTURE_S} s of virtual:car repeated, {FRAMES} frames; processor seconds, best of {ROUNDS}"
    );
    println!(
        "{:<28} {:>12} {:>14} {:>12} {:>22}",
        "", "bytes", "bytes/frame", "to write, s", "mean of a signal, s"
    );
    for (name, file) in TRACES {
        let file = dir.join(file);
        let written = best(|| Ok(cmd!(shell, "{cantap} convert {trace} {file}")))?;
        let one = dir.join("one.parquet");
        let asked =
            best(|| Ok(cmd!(shell, "{cantap} decode --db {DATABASE} --signal {SIGNAL} {file} -o {one}")))?;
        line(name, size(&file)?, written, Some(asked));
    }
    let frames = dir.join("frames.parquet");
    let written = best(|| Ok(cmd!(shell, "{cantap} convert {trace} {frames}")))?;
    line("Parquet, frames", size(&frames)?, written, None);
    for (name, options, file, question) in DECODED {
        let file = dir.join(file);
        let options = options.split_whitespace();
        let written = best(|| {
            let options = options.clone();
            Ok(cmd!(shell, "{cantap} decode --db {DATABASE} {trace} -o {file} {options...}"))
        })?;
        let asked = python.as_deref().map(|python| ask(&shell, python, question, &file)).transpose()?;
        line(name, size(&file)?, written, asked);
    }
    Ok(())
}

fn line(name: &str, bytes: u64, written: f64, asked: Option<f64>) {
    let asked = asked.map_or("–".to_owned(), |asked| format!("{asked:.2}"));
    let per_frame = bytes as f64 / FRAMES as f64;
    println!("{name:<28} {bytes:>12} {per_frame:>14.2} {written:>12.2} {asked:>22}");
}

/// Processor seconds of DuckDB, including its own start and Python's.
fn ask(shell: &Shell, python: &Path, question: &str, file: &Path) -> Result<f64> {
    let (column, rest) = question.split_once(' ').context("a column and where it is")?;
    let rest = rest.replace("FILE", &file.display().to_string());
    let script =
        format!("import duckdb; print(duckdb.sql(\"\"\"SELECT avg({column}) {rest}\"\"\").fetchall())");
    best(|| Ok(cmd!(shell, "{python} -c {script}").ignore_stdout()))
}

/// The shortest processor time of several rounds.
fn best<'a>(mut command: impl FnMut() -> Result<Cmd<'a>>) -> Result<f64> {
    let mut least = f64::MAX;
    for _ in 0..ROUNDS {
        let before = children_s()?;
        command()?.quiet().ignore_stderr().run()?;
        least = least.min(children_s()? - before);
    }
    Ok(least)
}

/// Processor time of all programs that this one has run, in seconds: unlike wall-clock time it does not depend on what else
/// the machine does. proc(5): fields 16 and 17 of `stat`, whose second field may contain spaces and ends with a bracket.
fn children_s() -> Result<f64> {
    let stat = fs::read_to_string("/proc/self/stat")?;
    let (_, fields) = stat.rsplit_once(") ").context("/proc/self/stat has no name")?;
    let ticks = fields.split(' ').skip(13).take(2).map(str::parse::<u64>).sum::<Result<u64, _>>()?;
    Ok(ticks as f64 / TICKS_PER_S)
}

/// Bytes of a file, or of all files in a folder.
fn size(path: &PathBuf) -> Result<u64> {
    if path.is_file() {
        return Ok(fs::metadata(path)?.len());
    }
    fs::read_dir(path)?.map(|entry| Ok(entry?.metadata()?.len())).sum()
}
