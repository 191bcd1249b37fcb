//! Statistics of a device's bus while it runs: a line per channel and window, as canbusload prints them.

use std::io::IsTerminal;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail};
use cantap::device::Records;
use cantap::stats::{Statistics, Window};
use cantap::{Address, Device, TraceRecord};

use super::Args;
use super::table::remarks;
use super::windows::Windows;
use crate::interrupt;

/// How long to wait for records before looking at clock and Ctrl-C.
const WAIT: Duration = Duration::from_millis(100);
/// A window is closed so long after its end, so that what is still on the way gets into it.
const LATENESS_NS: i64 = 1_000_000_000;
/// Columns of the bar for 100 %.
const BAR_COLUMNS: usize = 20;

/// Listens until Ctrl-C or the end of the time.
pub(super) fn run(
    args: &Args,
    address: &Address,
    statistics: &mut Statistics,
    windows: &mut Option<Windows>,
) -> anyhow::Result<()> {
    interrupt::watch()?;
    let device = Device::open(address)?;
    let mut records = device.records();
    let options = args.options();
    for channel in args.channel.iter() {
        let Some(bitrate) = options.bitrate_of(channel.number()) else {
            bail!("channel {0} has no bit rate; give one with -b, such as -b {0}:500k", channel.number());
        };
        device.listen(channel, bitrate).with_context(|| format!("channel {}", channel.number()))?;
    }
    let mut show = Lines::new(!args.json);
    let mut keep = |window: &Window| {
        show.window(window);
        if let Some(windows) = windows {
            windows.push(window);
        }
    };
    let start = Instant::now();
    while !interrupt::requested() && args.time.is_none_or(|time| start.elapsed() < time) {
        let Some(batch) = records.next_batch(WAIT)? else {
            break;
        };
        push_all(batch, &records, statistics, &mut keep);
        statistics.advance_with(now_ns().saturating_sub(LATENESS_NS), &mut keep);
    }
    device.stop()?;
    while let Some(batch) = records.next_batch(WAIT)? {
        push_all(batch, &records, statistics, &mut keep);
    }
    statistics.finish_with(&mut keep);
    Ok(())
}

fn push_all(
    batch: Vec<TraceRecord>,
    records: &Records,
    statistics: &mut Statistics,
    keep: &mut impl FnMut(&Window),
) {
    for record in &batch {
        statistics.push_with(record, &mut *keep);
    }
    records.recycle(batch);
}

/// The machine's UTC time, which the device's is mapped to.
fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

/// Prints a line per window; on a terminal in colour.
struct Lines {
    shown: bool,
    colour: bool,
}

impl Lines {
    fn new(shown: bool) -> Self {
        let colour = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
        Self { shown, colour }
    }

    fn window(&mut self, window: &Window) {
        if self.shown {
            eprintln!("{}", line(window, self.colour));
        }
    }
}

fn line(window: &Window, colour: bool) -> String {
    let load = window.load_pct.unwrap_or(0.0);
    let filled = (load * BAR_COLUMNS as f64 / 100.0).round() as usize;
    let bar: String = "X".repeat(filled.min(BAR_COLUMNS));
    let (on, off) = match load {
        _ if !colour => ("", ""),
        80.0.. => ("\x1b[31m", "\x1b[0m"),
        50.0.. => ("\x1b[33m", "\x1b[0m"),
        _ => ("\x1b[32m", "\x1b[0m"),
    };
    let text = format!(
        "can{} {:>7.0} frames/s {:>8.0} bit/s {load:>5.1} % |{on}{bar:.<BAR_COLUMNS$}{off}|",
        window.channel,
        window.frames_per_s(),
        window.bits_per_s(),
    );
    text + &remarks(window.errors, window.lost, window.incomplete)
}
