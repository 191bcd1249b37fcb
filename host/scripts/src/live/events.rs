//! What scripts in a thread of their own report to the owner of their device.

use cantap::DeviceError;

use crate::report::{Message, TestResult};

/// What scripts have done since.
#[derive(Debug)]
pub enum ScriptEvent {
    /// A script has logged a line.
    Message(Message),
    /// A script is in this test now.
    TestBegan {
        /// The script's place.
        place: usize,
        /// The test's function.
        name: String,
    },
    /// A test has ended.
    Test(TestResult),
    /// A script has ended.
    Ended {
        /// Its place.
        place: usize,
        /// The error, if there was one.
        error: Option<String>,
    },
    /// The device refuses what a script wants, which has ended it.
    Refused {
        /// Its place.
        place: usize,
        /// The refusal.
        error: DeviceError,
    },
    /// What all of them have sent and received so far.
    Counts(ScriptCounts),
}

/// What scripts have sent and received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ScriptCounts {
    /// Frames of scripts that were on the bus.
    pub sent: u64,
    /// Frames of others, and of the other scripts.
    pub received: u64,
    /// Frames of scripts that wait to be sent.
    pub waiting: u64,
    /// Frames that are not sent: there was no room.
    pub not_sent: u64,
    /// Frames that scripts have not seen, at least.
    pub lost: u64,
}
