//! What a listener waits for.

use cantap_wire::Channel;

use crate::device::UtcNs;

/// How far a session is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// The device has not said who it is.
    Greeting,
    /// Its clock is being read, and its channels opened.
    Opening,
    /// Its channels are open.
    Listening,
    /// Its channels are being closed, and the last records come.
    Stopping,
    /// The session has ended: as asked, or with an [error](super::Listener::error). What [`output`](super::Listener::output) still has should
    /// be written before the port is closed.
    Over,
}

/// What is waited for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    Hello { tries: u32 },
    Clock { rounds: u32 },
    Open(Channel),
    Listen,
    Close { left: u32 },
    ClosedAt,
    Drain { closed_at: u64 },
    LastStatus,
    Over,
}

/// Why something was asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// The step waits for it.
    Step,
    /// The clock, now and then.
    Time,
    /// What the user sees, now and then.
    Status,
}

/// A request that was not answered yet.
#[derive(Clone, Copy, Debug)]
pub struct Asked {
    pub id: u16,
    pub purpose: Purpose,
    pub at: UtcNs,
    /// Device time of the latest record that had been received by then.
    pub latest_ticks: u64,
}

impl Step {
    /// How far the session is then.
    pub const fn stage(self) -> Stage {
        match self {
            Self::Hello { .. } => Stage::Greeting,
            Self::Clock { .. } | Self::Open(_) => Stage::Opening,
            Self::Listen => Stage::Listening,
            Self::Close { .. } | Self::ClosedAt | Self::Drain { .. } | Self::LastStatus => Stage::Stopping,
            Self::Over => Stage::Over,
        }
    }
}
