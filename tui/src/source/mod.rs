//! The source of the records: a thread that reads a device or plays a file, records, and fills the model.
//!
//! It holds the model's lock only to hand over what it has, so that the display cannot delay it; a device's
//! buffer in the library covers slow moments.

mod asking;
mod autobaud;
mod device;
mod playback;
mod scripts;
mod session_scripts;
mod timed;

use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use cantap::TraceRecord;
use cantap_formats::{ChannelInfo, IndexFolder};

use super::model::Model;
use super::order::Order;
use super::plan::Plan;
use cantap_trace::counted;
use cantap_work::cache;
use cantap_work::obd::Asking;
use cantap_work::recording::{Older, Recording};
use session_scripts::SessionScripts;
use timed::Timed;

/// The model, shared by the source thread and the display.
pub type Shared = Arc<Mutex<Model>>;

/// Locks the model. Nobody leaves it half changed.
pub fn lock(model: &Mutex<Model>) -> MutexGuard<'_, Model> {
    model.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Where records come from.
#[derive(Clone, Debug)]
pub enum Origin {
    /// A device.
    Device(Plan),
    /// A file, played back.
    File(PathBuf),
}

/// What the source does after an order.
enum Then {
    GoOn,
    Autobaud,
    Reopen(Plan),
    Quit,
}

/// How long a single wait for records lasts.
const WAIT: Duration = Duration::from_millis(20);
/// The same while scripts run or an answer is awaited: what they want of the device waits no longer.
const SCRIPTS_WAIT: Duration = Duration::from_millis(1);
/// How often to ask for the device's state, and to flush a recording.
const FIGURES_EVERY: Duration = Duration::from_millis(500);

/// Runs until [`Order::Quit`].
pub fn run(origin: Origin, model: &Shared, orders: &Receiver<Order>) {
    let mut source = Source {
        model,
        orders,
        recording: None,
        timed: Timed::default(),
        scripts: SessionScripts::default(),
        asking: None,
        indexes: cache::indexes(),
    };
    match origin {
        Origin::Device(plan) => source.run_device(plan),
        Origin::File(path) => source.run_file(&path),
    }
    source.stop_recording();
}

struct Source<'a> {
    model: &'a Shared,
    orders: &'a Receiver<Order>,
    recording: Option<Recording>,
    timed: Timed,
    scripts: SessionScripts,
    /// Questions to a vehicle.
    asking: Option<Asking>,
    /// Where those of large files are kept.
    indexes: Option<IndexFolder>,
}

impl Source<'_> {
    fn notice(&self, text: impl Into<String>) {
        lock(self.model).notice = text.into();
    }

    /// Records first, then shows.
    fn take(&mut self, records: &[TraceRecord]) {
        if let Some(recording) = &mut self.recording
            && let Err(error) = recording.write(records)
        {
            self.recording_failed(&error);
        }
        lock(self.model).take(records);
    }

    fn record(&mut self, path: &Path) {
        self.stop_recording();
        let (decoder, channels) = {
            let seen = &lock(self.model).seen;
            let info = |(channel, bps): &(u8, u32)| ChannelInfo {
                channel: *channel,
                bitrate_bps: Some(*bps),
                description: String::new(),
            };
            let known = seen.statistics.channel_bitrates_bps().iter().map(info).collect();
            (Arc::clone(seen.signals.decoder()), known)
        };
        // Whether an older file is overwritten, the user has been asked before.
        match Recording::create_by_text(path, &decoder, Older::Replace, channels) {
            Ok(recording) => {
                self.recording = Some(recording);
                self.show_recording();
                let armed = lock(self.model)
                    .recording
                    .as_ref()
                    .is_some_and(|recording| recording.condition.is_some());
                self.notice(if armed {
                    format!("armed: {}", path.display())
                } else {
                    format!("recording to {}", path.display())
                });
            }
            Err(error) => self.notice(error.to_string()),
        }
    }

    fn write_list(&self, path: &Path, text: &str) {
        let written = File::create_new(path).and_then(|mut file| file.write_all(text.as_bytes()));
        self.notice(match written {
            Ok(()) => format!("{} written to {}", counted(text.lines().count(), "entry"), path.display()),
            Err(error) => format!("{} is not written: {error}", path.display()),
        });
    }

    fn stop_recording(&mut self) {
        if let Some(recording) = self.recording.take() {
            let said = recording.finish();
            let mut model = lock(self.model);
            model.recording = None;
            model.notice = said;
        }
    }

    fn recording_failed(&mut self, error: &anyhow::Error) {
        self.stop_recording();
        self.notice(Recording::failure(error));
    }

    fn show_recording(&mut self) {
        let Some(recording) = &mut self.recording else {
            return;
        };
        match recording.state() {
            Ok(state) => lock(self.model).recording = Some(state),
            Err(error) => self.recording_failed(&error.into()),
        }
    }

    /// Follows orders that apply to every source.
    fn follow(&mut self, order: Order) -> Then {
        match order {
            Order::Record(path) => self.record(&path),
            Order::StopRecording => self.stop_recording(),
            Order::Open(plan) => return Then::Reopen(plan),
            Order::Autobaud => return Then::Autobaud,
            Order::Quit => return Then::Quit,
            Order::Send(..) => self.notice("there is no device to send with; open one with D"),
            Order::SetPeriodic(channel, slot, _) => {
                self.notice("there is no device to send with; open one with D");
                lock(self.model).refused.push((channel, slot));
            }
            Order::StartScript(script) => {
                lock(self.model)
                    .scripts
                    .fail(&script.name, "there is no device to run it on; open one with D");
            }
            Order::Ask(on) => self.ask(None, on),
            Order::StopScript(_) | Order::ScriptKey(_) => {}
            Order::WriteList(path, text) => self.write_list(&path, &text),
            Order::Recover => self.notice("there is no device to bring back onto a bus"),
            Order::Faster
            | Order::Slower
            | Order::TogglePause
            | Order::Step
            | Order::ToggleLoop
            | Order::Seek(_) => {
                self.notice("only a file can be played slower, faster or in steps");
            }
        }
        Then::GoOn
    }
}
