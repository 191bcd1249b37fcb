//! The display's orders to the source.

use std::path::PathBuf;
use std::time::Duration;

use std::sync::Arc;

use cantap::Frame;
use cantap::wire::message::{MAX_MODIFIERS, Modifier};
use cantap_scripts::Script;
use cantap_signals::Decoder;
use cantap_work::changing::Changing;

use super::plan::Plan;

/// What changes in a frame each time it is sent.
pub type Modifiers = heapless::Vec<Modifier, MAX_MODIFIERS>;

/// A frame that is sent periodically.
#[derive(Clone, Debug)]
pub struct Repeated {
    /// The frame, before modifiers.
    pub frame: Frame,
    /// From one time to the next.
    pub period: Duration,
    /// Applied in this order each time.
    pub modifiers: Modifiers,
    /// In place of the frame, a message whose values change, and what encodes it.
    pub changing: Option<(Arc<Changing>, Arc<Decoder>)>,
}

/// An order from the display to the source.
#[derive(Clone, Debug)]
pub enum Order {
    /// Record to this file.
    Record(PathBuf),
    /// End the recording.
    StopRecording,
    /// Send a frame once, on the channel with this number.
    Send(u8, Frame),
    /// Have the device send a frame periodically, in a slot of the channel with this number; `None` ends it.
    SetPeriodic(u8, u8, Option<Repeated>),
    /// Run a script on the first device.
    StartScript(Script),
    /// End the script with this name.
    StopScript(String),
    /// A key for the scripts.
    ScriptKey(char),
    /// Ask a vehicle on the first device, or no more.
    Ask(bool),
    /// Write the send list to a new file.
    WriteList(PathBuf, String),
    /// Playback: faster.
    Faster,
    /// Playback: slower.
    Slower,
    /// Playback: pause or resume.
    TogglePause,
    /// Playback: one record.
    Step,
    /// Playback: loop or not.
    ToggleLoop,
    /// Playback: to the first record that is not older than this, in nanoseconds as in a record.
    Seek(i64),
    /// Bring the channels that are bus-off back on the bus.
    Recover,
    /// Find the bit rates of the device's channels by listening, or stop searching.
    Autobaud,
    /// Another device, other bit rates, another mode.
    Open(Plan),
    /// End.
    Quit,
}
