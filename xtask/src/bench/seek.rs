//! A second out of a large trace: with an index and without, in turns, from the command's start to its end. Both must write the same.

use std::fs;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use cantap_formats::{ReadOptions, open_reader};
use xshell::{Shell, cmd};

use super::extent::Extent;
use super::formats::{RECORDING, make_trace};
use super::mf4_blocks::in_blocks;
use crate::workspace;

/// Frames of the trace: a gigabyte as a candump log, and a fifth of it to try the benchmark.
const FRAMES: [u64; 2] = [21_000_000, 4_200_000];
/// Where to look, in thousandths of the trace's length.
const PLACES: [u64; 7] = [500, 985, 20, 730, 250, 870, 120];
/// Of the blocks of an MF4 file as some loggers write it.
const SMALL_BLOCK_BYTES: u64 = 64 << 10;
/// A second is to be there within this time, in seconds.
const WITHIN: f64 = 0.3;
/// After this time the system's time of a file's last change shows any other.
const SETTLED: Duration = Duration::from_secs(3);

/// A trace, and where its index goes.
struct Trace {
    program: PathBuf,
    path: PathBuf,
    part: PathBuf,
    cache: PathBuf,
}

/// Measures, and deletes the traces.
pub fn run(extent: &Extent<'_>) -> Result<()> {
    let shell = workspace::shell()?;
    cmd!(shell, "cargo build --release --quiet -p cantap-cli").quiet().run()?;
    let folder = workspace::target().join("bench-seek");
    fs::create_dir_all(&folder)?;
    let result = measure(&shell, &folder, extent);
    fs::remove_dir_all(&folder)?;
    result
}

fn measure(shell: &Shell, folder: &Path, extent: &Extent<'_>) -> Result<()> {
    let frames = FRAMES[usize::from(extent.quick)] * extent.times;
    let program = workspace::target().join("release/cantap");
    let log = folder.join("trace.log");
    make_trace(&workspace::root().join(RECORDING), &log, frames)?;
    println!("seek: {frames} frames of {RECORDING} repeated; a second of it, at {} places", PLACES.len());
    println!(
        "{:<8} {:>6} {:>17} {:>15} {:>23} {:>19} {:>9}",
        "",
        "MB",
        "first reading, s",
        "with index, s",
        "a second, median/most",
        "without, median, s",
        "index, MB"
    );
    let mut slow = Vec::new();
    for name in ["log", "blf", "mf4", "mf4-blocks", "asc", "trc", "pcapng", "csv"] {
        if !extent.wants(name) {
            continue;
        }
        let (suffix, blocks) = name.split_once('-').unwrap_or((name, ""));
        let path = log.with_extension(suffix);
        if path != log {
            cmd!(shell, "{program} convert {log} {path}").quiet().run()?;
        }
        if !blocks.is_empty() {
            let single = folder.join("single.mf4");
            fs::rename(&path, &single)?;
            let count = in_blocks(&single, &path, SMALL_BLOCK_BYTES)?;
            println!("{name}: {count} blocks of {SMALL_BLOCK_BYTES} bytes");
            fs::remove_file(&single)?;
        }
        let trace = Trace {
            program: program.clone(),
            part: folder.join("part.log"),
            cache: folder.join(format!("cache-{name}")),
            path,
        };
        if trace.measure(shell, name)? > WITHIN {
            slow.push(name);
        }
        if trace.path != log {
            fs::remove_file(&trace.path)?;
        }
    }
    ensure!(slow.is_empty(), "longer than {WITHIN} s: {}", slow.join(", "));
    Ok(())
}

impl Trace {
    /// Prints a line; the longest that a second took by the index.
    fn measure(&self, shell: &Shell, name: &str) -> Result<f64> {
        let none = Path::new("/dev/null");
        let length_ns = self.length_ns()?;
        let (whole, _) = self.second(shell, none, length_ns / 2)?;
        // An index of MF4 needs a file that was not written just now.
        thread::sleep(SETTLED);
        let (first, _) = self.second(shell, &self.cache, length_ns / 2)?;
        // A file that was made just now is compared once more.
        self.second(shell, &self.cache, length_ns / 2)?;
        let (mut with, mut without) = (Vec::new(), Vec::new());
        for place in PLACES {
            let start_ns = length_ns / 1000 * place;
            let (seconds, part) = self.second(shell, &self.cache, start_ns)?;
            let (all_seconds, same) = self.second(shell, none, start_ns)?;
            ensure!(part == same && !part.is_empty(), "{name}: another second at {place} thousandths");
            with.push(seconds);
            without.push(all_seconds);
        }
        with.sort_by(f64::total_cmp);
        without.sort_by(f64::total_cmp);
        let (median, most) = (with[with.len() / 2], with[with.len() - 1]);
        let bytes = fs::metadata(&self.path)?.len();
        println!(
            "{name:<8} {:>6} {whole:>17.2} {first:>15.2} {:>23} {:>19.2} {:>9.2}",
            bytes / 1_000_000,
            format!("{median:.3} / {most:.3}"),
            without[without.len() / 2],
            self.index_bytes()? as f64 / 1e6,
        );
        Ok(most)
    }

    /// From the first record's time to the last one's.
    fn length_ns(&self) -> Result<u64> {
        let (mut first_ns, mut last_ns) = (None, 0);
        for record in open_reader(&self.path, &ReadOptions::default())? {
            last_ns = record?.time_ns;
            first_ns.get_or_insert(last_ns);
        }
        Ok(u64::try_from(last_ns - first_ns.unwrap_or(last_ns))?)
    }

    /// Writes the second from a time on: how long that took, and what it was.
    fn second(&self, shell: &Shell, cache: &Path, start_ns: u64) -> Result<(f64, Vec<u8>)> {
        let Self { program, path, part, .. } = self;
        let time = |ns: u64| format!("{}.{:09}", ns / 1_000_000_000, ns % 1_000_000_000);
        let (start, end) = (time(start_ns), time(start_ns + 1_000_000_000));
        let begin = Instant::now();
        cmd!(shell, "{program} convert {path} {part} --start {start} --end {end}")
            .env("XDG_CACHE_HOME", cache)
            .quiet()
            .run()?;
        Ok((begin.elapsed().as_secs_f64(), fs::read(part)?))
    }

    fn index_bytes(&self) -> Result<u64> {
        let mut bytes = 0;
        for file in fs::read_dir(self.cache.join("cantap/indexes"))? {
            bytes += file?.metadata()?.len();
        }
        Ok(bytes)
    }
}
