//! The most memory that the command occupies with long traces, in every format: it must not grow with the file.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use xshell::cmd;

use super::formats::{RECORDING, make_trace};
use crate::workspace;

/// Frames of the traces: ten times as many must not take more memory.
const FRAMES: [u64; 2] = [1_000_000, 10_000_000];
/// What the project promises for a trace of any length.
const MOST_MIB: f64 = 64.0;
/// How often the kernel's figure is read while the command runs. The figure never falls, so only what happens after
/// the last reading is missed.
const LOOK_EVERY: Duration = Duration::from_millis(2);

/// Each format: its file suffix, and its name where the suffix is not enough.
const FORMATS: &[(&str, &str)] = &[
    ("asc", "asc"),
    ("blf", "blf"),
    ("trc", "trc"),
    ("csv", "csv"),
    ("csv", "csv-full"),
    ("csv", "csv-analyser"),
    ("pcapng", "pcapng"),
    ("dif", "dif"),
    ("log.gz", "candump"),
    ("log.zst", "candump"),
    ("blf.gz", "blf"),
    ("blf.zst", "blf"),
];

/// Commands that read a trace and write none, `LOG` being the trace.
const READERS: &[(&str, &str)] = &[
    ("stats", "stats LOG -b 250k"),
    ("stats, each window", "stats LOG -b 250k --windows --json"),
    ("decode", "decode --db DB LOG --json"),
    ("search", "search LOG --data *FFFF -B2 -A2"),
    ("diff", "diff LOG LOG"),
    ("plot, signals", "plot LOG --db DB -o OUT.png"),
    ("plot, load", "plot LOG --bus-load -b 250k -o OUT.svg"),
    ("plot, periods", "plot LOG --timing 09F80102 -o OUT.html"),
    ("rotate", "convert LOG OUT.blf --rotate 1M --keep 3"),
];

/// Two of the recording's messages.
const DATABASE: &str = "BO_ 2314731778 Position: 8 A\n SG_ Latitude : 0|32@1- (1e-7,0) [0|0] \"deg\" A\n \
                        SG_ Longitude : 32|32@1- (1e-7,0) [0|0] \"deg\" A\n\
                        BO_ 2314732034 Course: 8 A\n SG_ Course : 16|16@1+ (0.0001,0) [0|0] \"rad\" A\n";

/// Measures each, and fails if one exceeds the promise.
pub fn run() -> Result<()> {
    let shell = workspace::shell()?;
    if !Path::new("/proc/self/status").exists() {
        println!("memory is not measured: this system has no /proc");
        return Ok(());
    }
    cmd!(shell, "cargo build --release --quiet -p cantap-cli").quiet().run()?;
    let dir = workspace::target().join("bench-memory");
    fs::create_dir_all(&dir)?;
    fs::write(dir.join("boat.dbc"), DATABASE)?;
    let mut rows: Vec<(String, Vec<f64>)> = Vec::new();
    for frames in FRAMES {
        let log = dir.join("trace.log");
        make_trace(&workspace::root().join(RECORDING), &log, frames)?;
        let mut row = 0;
        let mut note = |name: String, mib: f64| {
            if row == rows.len() {
                rows.push((name, Vec::new()));
            }
            rows[row].1.push(mib);
            row += 1;
        };
        for (suffix, format) in FORMATS {
            let file = dir.join(format!("trace.{suffix}"));
            let [to, back] = [file.as_path(), Path::new("/dev/null")];
            let write =
                peak_mib(&dir, &["convert".as_ref(), &log, to, "--format".as_ref(), format.as_ref()])?;
            note(format!("to {format} in .{suffix}"), write);
            let read =
                peak_mib(&dir, &["convert".as_ref(), to, back, "--format".as_ref(), "candump".as_ref()])?;
            note(format!("from {format} in .{suffix}"), read);
            fs::remove_file(&file)?;
        }
        for (name, line) in READERS {
            let word = |word: &str| match word {
                "LOG" => log.clone(),
                "DB" => dir.join("boat.dbc"),
                _ => {
                    word.strip_prefix("OUT").map_or_else(|| word.into(), |end| dir.join(format!("out{end}")))
                }
            };
            let words: Vec<PathBuf> = line.split(' ').map(word).collect();
            let words: Vec<&Path> = words.iter().map(PathBuf::as_path).collect();
            note((*name).to_owned(), peak_mib(&dir, &words)?);
        }
    }
    fs::remove_dir_all(&dir)?;
    println!("memory: the most that `cantap` occupies, MiB");
    println!("{:<32} {:>10} {:>10}", "frames", FRAMES[0], FRAMES[1]);
    for (name, mib) in &rows {
        println!("{name:<32} {:>10.1} {:>10.1}", mib[0], mib[1]);
    }
    let most = rows.iter().flat_map(|(_, mib)| mib).copied().fold(0.0, f64::max);
    ensure!(most < MOST_MIB, "{most:.1} MiB is too much; {MOST_MIB} MiB is allowed");
    Ok(())
}

/// Runs the command; returns the most memory it had resident.
fn peak_mib(dir: &Path, arguments: &[&Path]) -> Result<f64> {
    let program = workspace::target().join("release/cantap");
    let mut command = Command::new(program);
    command.args(arguments).current_dir(dir).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let mut child = command.spawn().context("the command does not start")?;
    let status = format!("/proc/{}/status", child.id());
    let mut kib = 0;
    loop {
        // While the process ends, the line is missing.
        let text = fs::read_to_string(&status).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        kib = line
            .and_then(|line| line.trim().strip_suffix(" kB")?.parse::<u64>().ok())
            .unwrap_or(kib)
            .max(kib);
        if let Some(status) = child.try_wait()? {
            ensure!(status.success(), "`cantap {}` failed", arguments[0].display());
            return Ok(kib as f64 / 1024.0);
        }
        std::thread::sleep(LOOK_EVERY);
    }
}
