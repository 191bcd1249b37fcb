//! What a script's thread and the bus that it is on pass to each other, in turns.

use cantap::wire::message::Filter;
use cantap_can::{BusErrorKind, CHANNELS, Channel, ErrorState, Frame};

use crate::faults::Fault;
use crate::report::Outcome;

/// What happened on a bus.
#[derive(Clone, Copy, Debug)]
pub enum Input {
    /// Another node's frame ended well, at that time by its stamp.
    Frame { channel: Channel, frame: Frame, at_ns: u64 },
    /// This script's oldest unconfirmed frame on the channel was on the bus.
    Sent { channel: Channel },
    /// It never will be.
    NotSent { channel: Channel },
    /// The bus had an error.
    Error { channel: Channel, kind: Option<BusErrorKind> },
    /// The controller's state changed.
    State { channel: Channel, state: ErrorState },
    /// Frames are missing here.
    Gap,
    /// The user has typed a key.
    Key(char),
}

/// The script's turn begins.
#[derive(Clone, Copy, Debug)]
pub struct Resume {
    /// Nanoseconds since the run began.
    pub now_ns: u64,
    /// What happened; nothing if only time has passed.
    pub input: Option<Input>,
    /// How many of its frames were on each bus since its last turn, besides those of inputs.
    pub confirmed: [usize; CHANNELS],
}

/// What a script wants of its bus.
#[derive(Clone, Debug)]
pub enum Output {
    /// Send a frame once.
    Send { channel: Channel, frame: Frame },
    /// Send a frame now and then again after each period, until it is replaced or ended; `handle` names it.
    Repeat { handle: u32, channel: Channel, frame: Frame, period_ns: u64 },
    /// End a repetition.
    EndRepeat { handle: u32 },
    /// The device sends a frame by itself for each that a filter selects, until that ends.
    Reply { channel: Channel, slot: u8, entry: Option<(Filter, Frame)> },
    /// A line for the user.
    Log(String),
    /// Something goes wrong on the simulated bus, or with the node at this place, or with all of them.
    Fault { node: Option<usize>, fault: Fault },
    /// The names of the tests that the script's own lines have made, all of them.
    Tests(Vec<String>),
    /// A test has begun.
    TestBegan(String),
    /// A test has ended.
    Test { name: String, outcome: Outcome, began_ns: u64 },
}

impl Output {
    /// Bytes of its texts.
    pub fn text_bytes(&self) -> usize {
        match self {
            Self::Log(text) | Self::TestBegan(text) => text.capacity(),
            Self::Test { name, outcome: Outcome::Failed(reason), .. } => name.capacity() + reason.capacity(),
            Self::Test { name, .. } => name.capacity(),
            Self::Tests(names) => names.iter().map(String::capacity).sum(),
            Self::Send { .. }
            | Self::Repeat { .. }
            | Self::EndRepeat { .. }
            | Self::Reply { .. }
            | Self::Fault { .. } => 0,
        }
    }
}

/// The script's turn ends.
#[derive(Debug)]
pub struct Turn {
    /// What it wants, in this order.
    pub outputs: Vec<Output>,
    /// What comes next.
    pub next: Next,
}

/// What comes after a script's turn.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Next {
    /// It waits, and is to be woken at this time at the latest, if there is one.
    Wait { until_ns: Option<u64>, inputs: Wanted },
    /// It has ended, with an error if there was one.
    End { error: Option<String> },
}

/// Which inputs a waiting script needs to have its turn for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Frames of others, and gaps among them.
    pub frames: bool,
    /// Each of its own frames when it was on the bus, or cannot be.
    pub confirmations: bool,
    /// Errors and states.
    pub events: bool,
    /// Keys.
    pub keys: bool,
}

impl Wanted {
    /// Whether an input is one of these.
    pub const fn has(self, input: &Input) -> bool {
        match input {
            Input::Frame { .. } | Input::Gap => self.frames,
            Input::Sent { .. } | Input::NotSent { .. } => self.confirmations,
            Input::Error { .. } | Input::State { .. } => self.events,
            Input::Key(_) => self.keys,
        }
    }
}
