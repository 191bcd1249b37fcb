//! What the live view knows: a limited history, one row per identifier, signals, statistics. A source thread
//! fills it; the pages only read it.

pub mod fixed;
pub mod history;
mod kept;
pub mod scripts;
pub mod series;
pub mod signals;
mod talk;
mod vehicle;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use cantap::TraceRecord;
use cantap::device::{ClockReport, Counters};
use cantap::wire::message::Status;
use cantap_analysis::stats::{Options, Statistics, Window};
use cantap_signals::Decoder;

use super::plan::Plan;
use cantap_work::obd::Table;
use cantap_work::reception::Reception;
use cantap_work::recording::RecordingState;

pub use fixed::{FixedTable, Row};
pub use history::{History, While};
pub use scripts::{LineKind, ScriptState, Scripts};
pub use series::{Extent, Point, Series};
pub use signals::{Decoded, SignalRow, SignalTable};
pub use talk::{Talk, Talked};
pub use vehicle::VehicleSeen;

/// Length of the windows in the load's history.
pub const LOAD_WINDOW: Duration = Duration::from_millis(250);
/// How many are kept: five minutes.
const LOAD_WINDOWS: usize = 1200;

/// The state of the source of records.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum SourceState {
    /// Nothing yet.
    #[default]
    Starting,
    /// Records are arriving.
    Running,
    /// It is gone, for this reason; opening it is being retried.
    Gone(String),
    /// Searching the bit rates of a device's channels.
    Searching,
    /// A file, in playback.
    Playing(Playing),
}

/// The state of a playback. Times are in nanoseconds as in [`TraceRecord::time_ns`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Playing {
    /// Delay factor: 1 is real time, 2 takes twice as long, 0 is as fast as possible.
    pub factor: f64,
    /// Whether it is paused.
    pub paused: bool,
    /// Whether it restarts after its end.
    pub looped: bool,
    /// Whether it has ended.
    pub ended: bool,
    /// Whether it is moving to another position.
    pub seeking: bool,
    /// Time of the file's first record.
    pub first_ns: i64,
    /// Its position.
    pub position_ns: i64,
    /// The latest time in the file, once known.
    pub end_ns: Option<i64>,
}

/// A device's figures about itself.
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
    /// Its name.
    pub name: String,
    /// How often it was opened again after an absence.
    pub reconnects: u32,
    /// The clock from which its bit timing is made, in hertz; `None` before its first session.
    pub can_clock_hz: Option<u32>,
}

/// What the pages show besides the trace. While the display is paused, they show a copy of it.
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
    /// The meaning of the frames.
    pub talked: Talked,
    /// The devices, if the source consists of devices.
    pub devices: Vec<DeviceFigures>,
    /// Number of records taken.
    pub taken: u64,
    /// The current time, as far as known from the last record, in nanoseconds as in [`TraceRecord::time_ns`]. A file
    /// that restarts sets it back.
    pub now_ns: i64,
}

impl Seen {
    /// Number of frames lost so far, and whether there may have been more.
    pub fn lost(&self) -> (u64, bool) {
        let channels = self.statistics.channels();
        let count = channels.iter().map(|channel| channel.losses.total()).sum();
        (count, channels.iter().any(|channel| channel.losses.at_least))
    }
}

/// Everything that can be shown.
pub struct Model {
    /// The past, record by record, and the filters for what is shown of it.
    pub history: History,
    /// Everything else that is shown.
    pub seen: Seen,
    /// Time of the first record, since the beginning or since everything was forgotten.
    pub first_ns: Option<i64>,
    /// From when on everything was counted, if a file's earlier records were passed over.
    pub counted_from_ns: Option<i64>,
    /// The source.
    pub source: SourceState,
    /// How often each device was opened: a new session means that its periodic frames have ended.
    pub sessions: Vec<u32>,
    /// The plan with the bit rates that were found by listening, until the display takes it over.
    pub found: Option<Plan>,
    /// Periodic transmissions refused by the device, by channel and slot, until the display has noted them.
    pub refused: Vec<(u8, u8)>,
    /// There is a virtual vehicle at one of the ports, until the display has noted it.
    pub met_car: bool,
    /// What the device's channels receive.
    pub reception: Reception,
    /// The number of unreadable places in the file being played back, and what was wrong with the first one.
    pub unread: Option<(u64, String)>,
    /// The recording, if there is one.
    pub recording: Option<RecordingState>,
    /// Scripts, and the device's gateway.
    pub scripts: Scripts,
    /// What a vehicle answers, if it is asked.
    pub vehicle: VehicleSeen,
    /// The latest message for the user.
    pub notice: String,
    talk: Talk,
    conversations: cantap_protocols::Options,
    options: Options,
}

impl Model {
    /// Nothing is known yet. `options` must be valid for [`Statistics::new`].
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
            counted_from_ns: None,
            source: SourceState::default(),
            sessions: Vec::new(),
            found: None,
            refused: Vec::new(),
            met_car: false,
            reception: Reception::default(),
            unread: None,
            recording: None,
            scripts: Scripts::default(),
            vehicle: VehicleSeen::default(),
            notice: String::new(),
            talk: Talk::default(),
            conversations: cantap_protocols::Options::default(),
            options,
        })
    }

    /// The options of the statistics.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// Reads what frames say together by these pairs and descriptions. Before the first record.
    #[must_use]
    pub fn with_conversations(self, conversations: cantap_protocols::Options) -> Self {
        Self { talk: Talk::new(&conversations), conversations, ..self }
    }

    /// How what frames say together is read.
    pub fn conversations(&self) -> &cantap_protocols::Options {
        &self.conversations
    }

    /// Changes the decoding from now on, including the past.
    pub fn set_decoder(&mut self, decoder: Arc<Decoder>) {
        let Seen { signals, .. } = &mut self.seen;
        signals.set_decoder(decoder);
        self.history.all().for_each(|record| signals.take(&record));
    }

    /// Takes records in order.
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

    /// There are no more records: what they say together is complete.
    pub fn conclude(&mut self) {
        self.talk.conclude(&mut self.seen.talked);
    }

    /// The time is now `now_ns` although nothing happened.
    pub fn advance(&mut self, now_ns: i64) {
        let Seen { statistics, loads, now_ns: latest_ns, .. } = &mut self.seen;
        *latest_ns = now_ns.max(*latest_ns);
        statistics.advance_with(now_ns, |window| keep_load(loads, window));
    }

    /// Nothing is known about the time from here to the next record: intervals that span it do not count.
    pub fn interrupt(&mut self) {
        self.seen.statistics.interrupt();
        self.seen.table.interrupt();
        self.seen.signals.interrupt();
    }

    /// Forgets what was seen, but not the settings.
    pub fn clear(&mut self) {
        self.history.clear();
        self.seen.table = FixedTable::default();
        self.seen.signals.clear();
        (self.talk, self.seen.talked) = (Talk::new(&self.conversations), Talked::default());
        self.scripts.output.clear();
        self.vehicle.table = Table::default();
        self.seen.taken = 0;
        self.first_ns = None;
        self.counted_from_ns = None;
        self.begin_statistics();
    }

    /// The buses are different from now on: the statistics start over.
    pub fn begin_statistics(&mut self) {
        // The options were valid before.
        if let Ok(statistics) = Statistics::new(self.options.clone()) {
            self.seen.statistics = statistics;
        }
        self.seen.loads.clear();
    }

    /// The bit rates are different from now on; the statistics start over.
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
