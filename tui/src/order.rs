//! The display's orders to the source.

use std::path::PathBuf;
use std::time::Duration;

use cantap::Frame;

use super::plan::Plan;

/// An order from the display to the source.
#[derive(Clone, Debug)]
pub enum Order {
    /// Record to this file.
    Record(PathBuf),
    /// End the recording.
    StopRecording,
    /// Send a frame once, on the channel with this number.
    Send(u8, Frame),
    /// Have the device send a frame periodically; `None` ends it.
    SetPeriodic(u8, u8, Option<(Frame, Duration)>),
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
