//! What the live view knows: a bounded past, one row per identifier, signals, statistics. A source thread
//! fills it; the pages only read it.

pub mod fixed;
pub mod history;
mod kept;
pub mod series;
pub mod signals;
mod talk;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use cantap::TraceRecord;
use cantap::device::{ClockReport, Counters};
use cantap::wire::message::Status;
use cantap_analysis::stats::{Options, Statistics, Window};
use cantap_signals::Decoder;

use super::plan::Plan;
use crate::hearing::Hearing;

pub use fixed::{FixedTable, Row};
pub use history::History;
pub use series::{Column, Point, Series};
pub use signals::{Decoded, SignalRow, SignalTable};
pub use talk::{Talk, Talked};

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
    /// The bit rates of a device's channels are looked for.
    Searching,
    /// A file, in playback.
    Playing(Playing),
}

/// How a playback goes. Times are in nanoseconds as in [`TraceRecord::time_ns`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Playing {
    /// Delay factor: 1 is real time, 2 takes twice as long, 0 is as fast as can be.
    pub factor: f64,
    /// Whether it is paused.
    pub paused: bool,
    /// Whether it begins anew after its end.
    pub looped: bool,
    /// Whether it is over.
    pub ended: bool,
    /// Whether it is on its way to another place.
    pub seeking: bool,
    /// Time of the file's first record.
    pub first_ns: i64,
    /// Where it is.
    pub position_ns: i64,
    /// The latest time in the file, once that is known.
    pub end_ns: Option<i64>,
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

/// What the pages show beside the trace. A copy of it is what they show while the display is stopped.
#[derive(Clone)]
pub struct Seen {
    /// A row per identifier.
    pub table: FixedTable,
    /// Decoded signals.
    pub signals: SignalTable,
    /// Load, rates, periods, losses.
    pub statistics: Statistics,
    /// The load of the last windows, per channel, the newest last.
    pub loads: Vec<(u8, VecDeque<Window>)>,
    /// What the frames mean.
    pub talked: Talked,
    /// The devices, if the source is some.
    pub devices: Vec<DeviceFigures>,
    /// Records taken.
    pub taken: u64,
    /// The time, as far as it is known from the last record, in nanoseconds as in [`TraceRecord::time_ns`]. A file that
    /// begins anew sets it back.
    pub now_ns: i64,
}

impl Seen {
    /// Frames lost so far, and whether there may have been more.
    pub fn lost(&self) -> (u64, bool) {
        let channels = self.statistics.channels();
        let count = channels.iter().map(|channel| channel.losses.total()).sum();
        (count, channels.iter().any(|channel| channel.losses.at_least))
    }
}

/// Everything that there is to show.
pub struct Model {
    /// The past, record by record, and which filters choose what is shown of it.
    pub history: History,
    /// What else there is to see.
    pub seen: Seen,
    /// Time of the first record since the beginning, or since everything was forgotten.
    pub first_ns: Option<i64>,
    /// The source.
    pub source: SourceState,
    /// How often each device was opened: with another session, what it sent periodically has ended.
    pub sessions: Vec<u32>,
    /// The plan with the bit rates that were found by listening, until the display has taken it over.
    pub found: Option<Plan>,
    /// Periodic transmissions that the device refused, by channel and slot, until the display has taken note.
    pub refused: Vec<(u8, u8)>,
    /// A virtual vehicle is at one of the ports, until the display has taken note.
    pub met_car: bool,
    /// What the device's channels hear.
    pub hearing: Hearing,
    /// Places in the file played back that could not be read, and what was wrong with the first of them.
    pub unread: Option<(u64, String)>,
    /// The recording, if one runs.
    pub recording: Option<Recording>,
    /// The last thing that the user should know.
    pub notice: String,
    talk: Talk,
    options: Options,
}

impl Model {
    /// Nothing known yet. `options` must be good for [`Statistics::new`].
    pub fn new(decoder: Arc<Decoder>, options: Options, history_bytes: usize) -> anyhow::Result<Self> {
        let options = Options { window: LOAD_WINDOW, ..options };
        let seen = Seen {
            table: FixedTable::default(),
            signals: SignalTable::new(decoder, history_bytes),
            statistics: Statistics::new(options.clone())?,
            loads: Vec::new(),
            talked: Talked::default(),
            devices: Vec::new(),
            taken: 0,
            now_ns: 0,
        };
        Ok(Self {
            history: History::new(history_bytes),
            seen,
            first_ns: None,
            source: SourceState::default(),
            sessions: Vec::new(),
            found: None,
            refused: Vec::new(),
            met_car: false,
            hearing: Hearing::default(),
            unread: None,
            recording: None,
            notice: String::new(),
            talk: Talk::default(),
            options,
        })
    }

    /// The options that the statistics were made with.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// Decodes otherwise from now on, the past too.
    pub fn set_decoder(&mut self, decoder: Arc<Decoder>) {
        let Seen { signals, .. } = &mut self.seen;
        signals.set_decoder(decoder);
        self.history.all().for_each(|record| signals.take(&record));
    }

    /// Takes records in their order.
    pub fn take(&mut self, records: &[TraceRecord]) {
        if let (None, Some(first)) = (self.first_ns, records.first()) {
            self.first_ns = Some(first.time_ns);
        }
        let Seen { table, signals, statistics, loads, taken, now_ns, talked, .. } = &mut self.seen;
        self.talk.take(records, talked);
        *now_ns = records.last().map_or(*now_ns, |last| last.time_ns);
        for record in records {
            statistics.push_with(record, |window| keep_load(loads, window));
            self.history.push(*record);
            table.take(record);
            signals.take(record);
        }
        *taken += records.len() as u64;
    }

    /// Time has come to `now_ns` although nothing happened.
    pub fn advance(&mut self, now_ns: i64) {
        let Seen { statistics, loads, now_ns: latest_ns, .. } = &mut self.seen;
        *latest_ns = now_ns.max(*latest_ns);
        statistics.advance_with(now_ns, |window| keep_load(loads, window));
    }

    /// Nothing is known about the time from here to the next record: no interval that spans it counts.
    pub fn interrupt(&mut self) {
        self.seen.statistics.interrupt();
        self.seen.table.interrupt();
        self.seen.signals.interrupt();
    }

    /// Forgets what was seen, not how things are set.
    pub fn clear(&mut self) {
        self.history.clear();
        self.seen.table = FixedTable::default();
        self.seen.signals.clear();
        (self.talk, self.seen.talked) = (Talk::default(), Talked::default());
        self.seen.taken = 0;
        self.first_ns = None;
        self.begin_statistics();
    }

    /// Other buses from now on: the statistics begin anew.
    pub fn begin_statistics(&mut self) {
        // The options were good before.
        if let Ok(statistics) = Statistics::new(self.options.clone()) {
            self.seen.statistics = statistics;
        }
        self.seen.loads.clear();
    }

    /// Other bit rates from now on; the statistics begin anew.
    pub fn set_options(&mut self, options: Options) -> anyhow::Result<()> {
        let options = Options { window: LOAD_WINDOW, ..options };
        self.seen.statistics = Statistics::new(options.clone())?;
        self.options = options;
        self.seen.loads.clear();
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
