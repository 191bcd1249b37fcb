//! What the live view knows: a bounded past, one row per identifier, signals, statistics. A source thread
//! fills it; the views only read it.

pub mod fixed;
pub mod history;
pub mod signals;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use cantap::TraceRecord;
use cantap::device::{ClockReport, Counters};
use cantap::filter::Filter;
use cantap::signals::Decoder;
use cantap::stats::{Options, Statistics, Window};
use cantap::wire::message::Status;

pub use fixed::{FixedTable, Row};
pub use history::History;
pub use signals::{SignalRow, SignalTable};

/// Windows of the load's history.
pub const LOAD_WINDOW: Duration = Duration::from_millis(250);
/// How many are kept: five minutes.
const LOAD_WINDOWS: usize = 1200;

/// Where the records come from, and how that goes.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum SourceState {
    /// Nothing yet.
    #[default]
    Starting,
    /// Records come.
    Running,
    /// It is gone, for this reason; it is tried again.
    Gone(String),
    /// A file, in playback.
    Playing {
        /// Delay factor.
        factor: f64,
        /// Whether it stands still.
        paused: bool,
        /// Whether it begins anew after its end.
        looped: bool,
        /// Whether it is over.
        ended: bool,
    },
}

/// A recording that runs.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// The file.
    pub path: String,
    /// Records written.
    pub records: u64,
    /// Size of the file as the system tells it, in bytes.
    pub bytes: u64,
    /// When it began, in nanoseconds as in [`TraceRecord::time_ns`].
    pub since_ns: i64,
}

/// What a device says about itself.
#[derive(Clone, Debug, Default)]
pub struct DeviceFigures {
    /// Its state.
    pub status: Option<Status>,
    /// What was received and lost.
    pub counters: Counters,
    /// Its clock.
    pub clock: Option<ClockReport>,
    /// Size of its record queue, in bytes.
    pub queue_bytes: u32,
    /// What it is.
    pub name: String,
    /// How often it was opened again after it had gone.
    pub reconnects: u32,
}

/// Everything that the views show.
pub struct Model {
    /// The past, record by record.
    pub history: History,
    /// A row per identifier.
    pub table: FixedTable,
    /// Decoded signals.
    pub signals: SignalTable,
    /// Load, rates, periods, losses.
    pub statistics: Statistics,
    /// The load of the last windows, per channel, the newest last.
    pub loads: Vec<(u8, VecDeque<Window>)>,
    /// Only records that one of these accepts are shown; all without any.
    pub filters: Vec<Filter>,
    /// Time of the first record since the beginning, or since everything was forgotten.
    pub first_ns: Option<i64>,
    /// Records taken, those that the filters hid included.
    pub taken: u64,
    /// The source.
    pub source: SourceState,
    /// The device, if the source is one.
    pub device: Option<DeviceFigures>,
    /// The recording, if one runs.
    pub recording: Option<Recording>,
    /// The last thing that the user should know.
    pub notice: String,
    options: Options,
}

impl Model {
    /// Nothing known yet. `options` must be good for [`Statistics::new`].
    pub fn new(decoder: Arc<Decoder>, options: Options, history_bytes: usize) -> anyhow::Result<Self> {
        let options = Options { window: LOAD_WINDOW, ..options };
        Ok(Self {
            history: History::new(history_bytes),
            table: FixedTable::default(),
            signals: SignalTable::new(decoder),
            statistics: Statistics::new(options.clone())?,
            loads: Vec::new(),
            filters: Vec::new(),
            first_ns: None,
            taken: 0,
            source: SourceState::default(),
            device: None,
            recording: None,
            notice: String::new(),
            options,
        })
    }

    /// The options that the statistics were made with.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// Takes records in their order.
    pub fn take(&mut self, records: &[TraceRecord]) {
        if let (None, Some(first)) = (self.first_ns, records.first()) {
            self.first_ns = Some(first.time_ns);
        }
        let loads = &mut self.loads;
        for record in records {
            self.statistics.push_with(record, |window| keep_load(loads, window));
            if !self.filters.is_empty() && !self.filters.iter().any(|filter| filter.accepts(record)) {
                continue;
            }
            self.history.push(*record);
            self.table.take(record);
            self.signals.take(record);
        }
        self.taken += records.len() as u64;
    }

    /// Time has come to `now_ns` although nothing happened.
    pub fn advance(&mut self, now_ns: i64) {
        let loads = &mut self.loads;
        self.statistics.advance_with(now_ns, |window| keep_load(loads, window));
    }

    /// The latest time that is known, in nanoseconds as in [`TraceRecord::time_ns`].
    pub fn now_ns(&self) -> i64 {
        self.statistics.last_ns().unwrap_or(0)
    }

    /// Forgets what was seen, not how things are set.
    pub fn clear(&mut self) {
        self.history.clear();
        self.table = FixedTable::default();
        self.signals.clear();
        self.loads.clear();
        self.taken = 0;
        self.first_ns = None;
        // The options were good before.
        if let Ok(statistics) = Statistics::new(self.options.clone()) {
            self.statistics = statistics;
        }
    }

    /// Other bit rates from now on; the statistics begin anew.
    pub fn set_options(&mut self, options: Options) -> anyhow::Result<()> {
        let options = Options { window: LOAD_WINDOW, ..options };
        self.statistics = Statistics::new(options.clone())?;
        self.options = options;
        self.loads.clear();
        Ok(())
    }
}

fn keep_load(loads: &mut Vec<(u8, VecDeque<Window>)>, window: &Window) {
    let place = loads.iter().position(|(channel, _)| *channel == window.channel).unwrap_or_else(|| {
        loads.push((window.channel, VecDeque::new()));
        loads.sort_by_key(|(channel, _)| *channel);
        loads.iter().position(|(channel, _)| *channel == window.channel).unwrap_or_default()
    });
    let windows = &mut loads[place].1;
    windows.push_back(*window);
    if windows.len() > LOAD_WINDOWS {
        windows.pop_front();
    }
}
