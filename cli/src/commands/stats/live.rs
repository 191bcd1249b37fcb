//! Statistics of a device's bus while it runs: a line per channel and window, like canbusload.

use std::collections::BTreeSet;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use cantap_address::Address;
use cantap_analysis::stats::{Statistics, Window};
use cantap_trace::filter::Filter;

use super::table::remarks;
use super::windows::Windows;
use crate::live_args::{self, for_listening};
use crate::protocols::Known;
use crate::stderr;
use cantap_work::boards::Boards;
use cantap_work::channels::Channels;
use cantap_work::live::LiveRecords;
use cantap_work::requested_rate::RequestedRate;

/// How long after its end a window is closed, so that it includes what is still on the way.
const LATENESS_NS: i64 = 1_000_000_000;
/// Number of columns for 100 % in the bar.
const BAR_COLUMNS: usize = 20;

/// Opens the devices named on the command line, otherwise the one that is connected.
pub(super) fn open(
    devices: &[Address],
    channels: &Channels,
    bitrates: &[RequestedRate],
    time: Option<Duration>,
    device_intervals: bool,
) -> anyhow::Result<LiveRecords> {
    let boards = Boards::new(devices, channels)
        .map_err(|error| for_listening(error.into(), devices, "without a trace to measure"))?;
    live_args::listen(&boards, bitrates, time, device_intervals)
}

/// Listens until Ctrl-C or the end of the time, and prints a line per window if `shown`. What was received counts, even if this
/// fails.
pub(super) fn run(
    shown: bool,
    filters: &[Filter],
    live: &mut LiveRecords,
    statistics: &mut Statistics,
    windows: &mut Option<Windows>,
    known: &mut Option<Known>,
) -> anyhow::Result<()> {
    let mut show = Lines::new(shown);
    let mut keep = |window: &Window| {
        show.window(window);
        if let Some(windows) = windows {
            windows.push(window);
        }
    };
    let ended = listen(filters, live, statistics, known, &mut keep);
    statistics.finish_with(&mut keep);
    ended
}

fn listen(
    filters: &[Filter],
    live: &mut LiveRecords,
    statistics: &mut Statistics,
    known: &mut Option<Known>,
    keep: &mut impl FnMut(&Window),
) -> anyhow::Result<()> {
    let mut batch = Vec::new();
    while live.next_batch(&mut batch)? {
        if !filters.is_empty() {
            batch.retain(|record| filters.iter().any(|filter| filter.accepts(record)));
        }
        for record in &batch {
            statistics.push_with(record, &mut *keep);
        }
        if let Some(known) = known {
            known.take(&batch, true);
        }
        statistics.advance_with(now_ns().saturating_sub(LATENESS_NS), &mut *keep);
    }
    Ok(())
}

/// The machine's UTC time, to which the device's is mapped.
fn now_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

/// Prints a line per window, in colour on a terminal.
struct Lines {
    shown: bool,
    colour: bool,
    /// Channels that have had their line.
    channels: BTreeSet<u8>,
}

impl Lines {
    fn new(shown: bool) -> Self {
        Self { shown, colour: stderr::is_coloured(), channels: BTreeSet::new() }
    }

    fn window(&mut self, window: &Window) {
        if self.shown && self.is_worth_a_line(window) {
            eprintln!("{}", line(window, self.colour));
        }
    }

    /// The window in which listening ended is truncated: channels end a little apart, and earlier errors are counted in it, so its rates
    /// would make a steady bus look unsteady. It is shown only if there is no other.
    fn is_worth_a_line(&mut self, window: &Window) -> bool {
        let is_first = self.channels.insert(window.channel);
        is_first || !window.is_cut
    }
}

fn line(window: &Window, colour: bool) -> String {
    let figures = format!(
        "channel {} {:>7.0} frames/s {:>8.0} bit/s",
        window.channel,
        window.frames_per_s(),
        window.bits_per_s(),
    );
    let remarks = remarks(window.errors, window.lost, window.incomplete);
    let Some(load) = window.load_pct else {
        return format!("{figures} {:>5} %{remarks}", '–');
    };
    let filled = (load * BAR_COLUMNS as f64 / 100.0).round() as usize;
    let bar: String = "X".repeat(filled.min(BAR_COLUMNS));
    let (on, off) = match load {
        _ if !colour => ("", ""),
        80.0.. => ("\x1b[31m", "\x1b[0m"),
        50.0.. => ("\x1b[33m", "\x1b[0m"),
        _ => ("\x1b[32m", "\x1b[0m"),
    };
    format!("{figures} {load:>5.1} % |{on}{bar:.<BAR_COLUMNS$}{off}|{remarks}")
}
