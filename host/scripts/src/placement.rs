//! Where what a script sends is sent from. The one table that decides it when a script runs, and that `cantap run --explain` shows.

use cantap::wire::Hello;
use cantap::wire::message::capability;
use cantap_can::Channel;

use crate::device_replies::DeviceReplies;

/// A function with which a script sends, or that calls one that does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Statement {
    /// `send` of a frame or a message.
    Send,
    /// `periodic` and `change`.
    Periodic,
    /// `every` and `after`.
    Timer,
    /// `on_frame` and `on_message`.
    Reaction,
    /// `on_frame`, if its function only sends a frame that never changes.
    Reply,
    /// `on_key`.
    Key,
    /// `on_request`, `on_explicit`, `j1939` and `canopen`: they answer by themselves.
    Server,
    /// A message of such a node: its `send`, `send_to` and `send_fast`.
    Message,
    /// `request`.
    Client,
}

/// The functions, and whether they are called as a method: `ecu.send(…)`.
const FUNCTIONS: [(&str, bool, Statement); 17] = [
    ("send", false, Statement::Send),
    ("periodic", false, Statement::Periodic),
    ("change", false, Statement::Periodic),
    ("every", false, Statement::Timer),
    ("after", false, Statement::Timer),
    ("on_frame", false, Statement::Reaction),
    ("on_message", false, Statement::Reaction),
    ("on_key", false, Statement::Key),
    ("on_request", false, Statement::Server),
    ("on_explicit", false, Statement::Server),
    ("j1939", false, Statement::Server),
    ("canopen", false, Statement::Server),
    ("on_write", false, Statement::Server),
    ("request", false, Statement::Client),
    ("send", true, Statement::Message),
    ("send_to", true, Statement::Message),
    ("send_fast", true, Statement::Message),
];

impl Statement {
    /// The one of a function, by its name and whether it is called as a method.
    pub fn of(function: &str, is_method: bool) -> Option<Self> {
        let found = FUNCTIONS.iter().find(|(name, method, _)| (*name, *method) == (function, is_method));
        found.map(|(_, _, statement)| *statement)
    }
}

/// What the board's name of virtual devices begins with.
const VIRTUAL: &str = "virtual";

/// What scripts run on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// Simulated buses.
    Simulation,
    /// A device.
    Device {
        /// What keeps its clock.
        clock: TimedBy,
        /// Frames that it repeats by itself, at once, on each channel.
        periodic_slots: u8,
        /// Whether it sends at all.
        transmits: bool,
        /// Replies that it sends by itself, for a script that is alone on it.
        replies: Option<DeviceReplies>,
    },
}

/// What a device's clock is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimedBy {
    /// A board's own timer.
    Board,
    /// This computer's: the virtual device, and another maker's adapter.
    Computer,
}

impl Target {
    /// By a device's description of itself.
    pub fn of(hello: &Hello) -> Self {
        let is_computer = hello.capabilities & capability::ADAPTER != 0 || hello.board.starts_with(VIRTUAL);
        Self::Device {
            clock: if is_computer { TimedBy::Computer } else { TimedBy::Board },
            periodic_slots: hello.periodic_slots,
            transmits: hello.capabilities & capability::TRANSMIT != 0,
            replies: None,
        }
    }

    /// The same for one script that is alone on the device's only open channel.
    pub fn alone_on(hello: &Hello, channel: Channel) -> Self {
        let own = (hello.trigger_slots > 0).then_some(DeviceReplies { channel, slots: hello.trigger_slots });
        match Self::of(hello) {
            Self::Device { clock, periodic_slots, transmits, .. } => {
                Self::Device { clock, periodic_slots, transmits, replies: own }
            }
            Self::Simulation => Self::Simulation,
        }
    }
}

/// What runs a statement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Runner {
    /// The device, by itself.
    Device,
    /// This computer.
    Host,
    /// The simulated bus.
    Simulation,
    /// Nothing: the device sends nothing.
    Nothing,
}

impl Runner {
    /// Its name in text and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Device => "device",
            Self::Host => "host",
            Self::Simulation => "simulation",
            Self::Nothing => "nothing",
        }
    }
}

/// Where a statement runs, and how exactly.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Placement {
    /// What runs it.
    pub runner: Runner,
    /// How exactly in time.
    pub accuracy: String,
}

impl Statement {
    /// Where it runs on a target of which `repeated` frames are repeated already on the channel.
    pub fn place(self, target: Target, repeated: usize) -> Placement {
        let placement = |runner, accuracy: &str| Placement { runner, accuracy: accuracy.to_owned() };
        let Target::Device { clock, periodic_slots, transmits, replies } = target else {
            return placement(Runner::Simulation, "exactly, in simulated time");
        };
        if !transmits {
            return placement(Runner::Nothing, "the device sends nothing");
        }
        if let (Self::Reply, Some(DeviceReplies { slots, .. })) = (self, replies) {
            let when = match clock {
                TimedBy::Board => "within 14 us while the bus is free",
                TimedBy::Computer => "at once",
            };
            return Placement {
                runner: Runner::Device,
                accuracy: format!(
                    "replies by itself, {when}; {slots} filters at once, more from the host, and only one reply of each waits"
                ),
            };
        }
        match self {
            Self::Periodic if repeated < usize::from(periodic_slots) => Placement {
                runner: Runner::Device,
                accuracy: format!(
                    "{}; {periodic_slots} at once on each channel, more from the host",
                    match clock {
                        TimedBy::Board => "its timer, to 2 us while the bus is free",
                        TimedBy::Computer => "its timer, which follows this computer's clock",
                    }
                ),
            },
            Self::Periodic => placement(Runner::Host, "when the script has its turn"),
            Self::Timer => Placement {
                runner: Runner::Host,
                accuracy: format!(
                    "by {}, late by as long as this computer takes to come to it",
                    match clock {
                        TimedBy::Board => "the device's clock",
                        TimedBy::Computer => "this computer's clock",
                    }
                ),
            },
            Self::Reaction | Self::Reply => {
                placement(Runner::Host, "when the frame has arrived here and the script has its turn")
            }
            Self::Key => placement(Runner::Host, "when the key has arrived and the script has its turn"),
            Self::Server => placement(Runner::Host, "answers when the frame has arrived here"),
            Self::Send | Self::Message => placement(Runner::Host, "at once, through the device's queue"),
            Self::Client => placement(Runner::Host, "at once; times out by this computer's clock"),
        }
    }
}
