//! What an adapter's protocol must provide.

use std::io;
use std::time::{Duration, Instant};

use cantap_trace::{TraceEvent, TraceFrame};
use cantap_wire::record::{BusErrorKind, ErrorState, LossStage, Stamp};
use cantap_wire::{Channel, FdFrame, Frame, Refusal};

use crate::rows::Row;
use crate::source::Piece;

/// Why there is no adapter at an address. Each message says what to do next.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The port cannot be opened.
    #[error(transparent)]
    Device(#[from] cantap::DeviceError),
    /// The server cannot be reached.
    #[error("'{address}' cannot be reached ({source}); check host and port, and that the program there runs")]
    Unreachable {
        /// As given.
        address: String,
        /// The system's error.
        source: io::Error,
    },
    /// What is there does not speak the protocol.
    #[error(
        "'{address}' does not answer as {expected}; check the address and the line's speed (@BAUD), and that no other program uses it"
    )]
    Foreign {
        /// As given.
        address: String,
        /// What was expected.
        expected: &'static str,
    },
    /// The server refused.
    #[error("'{address}': the server refuses the interface; check its name there")]
    Refused {
        /// As given.
        address: String,
    },
    /// This computer has no such CAN interface.
    #[error("'{address}' is no CAN interface of this computer: {there}")]
    NoInterface {
        /// As given.
        address: String,
        /// Those that there are.
        there: String,
    },
    /// The interface is down.
    #[error("the interface '{address}' is down; as root: {command}")]
    InterfaceDown {
        /// As given.
        address: String,
        /// What brings it up.
        command: String,
    },
    /// The system does not let this program use the interface.
    #[error("the interface '{address}' cannot be used ({source}); {advice}")]
    Interface {
        /// As given.
        address: String,
        /// The system's error.
        source: io::Error,
        /// What to do.
        advice: &'static str,
    },
    /// There is no such adapter on USB, or more than one.
    #[error("'{address}' is no single {what}: {there}; name one by its serial number, as in {scheme}:SERIAL")]
    NoUsbAdapter {
        /// As given.
        address: String,
        /// What was expected.
        what: &'static str,
        /// Those that there are.
        there: String,
        /// What its addresses begin with.
        scheme: &'static str,
    },
    /// The adapter on USB cannot be opened.
    #[error("'{address}' cannot be opened: {reason}{advice}")]
    Usb {
        /// As given.
        address: String,
        /// The system's error.
        reason: String,
        /// What to do.
        advice: String,
    },
    /// The adapter has no resistor that could be switched.
    #[error("'{address}': this adapter cannot switch its termination; leave out ?termination")]
    NoTermination {
        /// As given.
        address: String,
    },
    /// The adapter has no CAN FD, or its clock cannot be divided to a data bit rate.
    #[error(
        "'{address}': this adapter has no CAN FD at a data bit rate of {data_bitrate_bps} bit/s; give another one, or leave out ?data-bitrate for classical CAN alone"
    )]
    NoDataBitRate {
        /// As given.
        address: String,
        /// As given.
        data_bitrate_bps: u32,
    },
    /// The maker's library is not there, or not one.
    #[error("'{address}': {source}")]
    Library {
        /// As given.
        address: String,
        /// Why, and what to do.
        source: cantap_vendor::LoadError,
    },
    /// The maker's library has no such channel, or several from which to choose.
    #[error("'{address}' is no single channel: {there}; name one, as in {example}")]
    NoChannel {
        /// As given.
        address: String,
        /// Those that there are.
        there: String,
        /// How one is written.
        example: String,
    },
    /// The channel cannot be used now.
    #[error("'{address}' cannot be used: {reason}")]
    Channel {
        /// As given.
        address: String,
        /// Why, and what to do.
        reason: String,
    },
    /// The chip lacks what is needed to listen with it.
    #[error(
        "'{address}' is a copy of an ELM327 that refuses {command}: its lines are no frames, and another adapter is needed"
    )]
    Unsuitable {
        /// As given.
        address: String,
        /// The command.
        command: &'static str,
    },
    /// The input is no trace.
    #[error("'{address}' cannot be read: {reason}")]
    NoTrace {
        /// As given.
        address: String,
        /// What is wrong with it.
        reason: String,
    },
}

impl OpenError {
    /// No channel was named where there are several, or one that is not there.
    pub(crate) fn no_channel(address: &str, there: &[impl std::fmt::Display]) -> Self {
        let scheme = address.split(':').next().unwrap_or_default();
        let example = if scheme == "pcan" { "pcan:PCAN_USBBUS1" } else { "kvaser:0" }.to_owned();
        let there = match there {
            [] => "there is none; plug the adapter in, and look whether its driver is installed".to_owned(),
            there => {
                format!("there are {}", there.iter().map(ToString::to_string).collect::<Vec<_>>().join(", "))
            }
        };
        Self::NoChannel { address: address.to_owned(), there, example }
    }
}

/// How a channel is opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Opening {
    /// Bits per second; 0 if unknown, where the adapter's row says that it sets none.
    pub bitrate_bps: u32,
    /// Where in the bit, in thousandths of it.
    pub sample_point_permille: u32,
    /// Without acknowledging.
    pub listen_only: bool,
}

/// When something happened, on this computer's clock, and what that time means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct At {
    /// When.
    pub instant: Instant,
    /// [`Stamp::UpperBound`] for arrivals.
    pub stamp: Stamp,
}

impl At {
    /// Something that arrived at this time and happened earlier.
    pub const fn arrival(instant: Instant) -> Self {
        Self { instant, stamp: Stamp::UpperBound }
    }
}

/// What an adapter reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Incoming {
    /// A frame was received.
    Received {
        /// Where.
        channel: Channel,
        /// The frame, of CAN FD too.
        frame: TraceFrame,
        /// When.
        at: At,
    },
    /// As much as the adapter knows of success: see the row's [`crate::Confirmation`].
    Sent {
        /// Where.
        channel: Channel,
        /// As given to [`Driver::send`].
        mailbox: u8,
        /// When.
        at: At,
    },
    /// The adapter cannot send such a frame.
    NotSent {
        /// Where.
        channel: Channel,
        /// As given to [`Driver::send`].
        mailbox: u8,
        /// When.
        at: At,
    },
    /// A bus error of this kind, with the counters if they are known (otherwise 0).
    BusError {
        /// Where.
        channel: Channel,
        /// What.
        kind: BusErrorKind,
        /// When.
        at: At,
    },
    /// At least this many bus errors of unknown kind.
    BusErrors {
        /// Where.
        channel: Channel,
        /// How many.
        count: u32,
        /// When.
        at: At,
    },
    /// The state of fault confinement, perhaps as before; with the error counters, 0 if they are not known.
    State {
        /// Where.
        channel: Channel,
        /// Which.
        state: ErrorState,
        /// Transmit and receive error counter.
        counters: (u8, u8),
        /// When.
        at: At,
    },
    /// Frames are missing here.
    Lost {
        /// Where.
        channel: Channel,
        /// Who lost them.
        stage: LossStage,
        /// How many.
        count: u32,
        /// Whether there may be more.
        at_least: bool,
        /// When.
        at: At,
    },
}

impl Incoming {
    /// Where and when it was.
    pub const fn place_mut(&mut self) -> (Channel, &mut At) {
        match self {
            Self::Received { channel, at, .. }
            | Self::Sent { channel, at, .. }
            | Self::NotSent { channel, at, .. }
            | Self::BusError { channel, at, .. }
            | Self::BusErrors { channel, at, .. }
            | Self::State { channel, at, .. }
            | Self::Lost { channel, at, .. } => (*channel, at),
        }
    }

    /// What a trace or an error frame reports; `None` for what has no place here.
    pub fn of(event: &TraceEvent, channel: Channel, at: At) -> Option<Self> {
        Some(match *event {
            TraceEvent::Frame { frame, .. } => Self::Received { channel, frame, at },
            TraceEvent::BusError { kind: Some(kind), .. } => Self::BusError { channel, kind, at },
            TraceEvent::BusError { kind: None, .. } => Self::BusErrors { channel, count: 1, at },
            TraceEvent::ErrorsSuppressed { count } => Self::BusErrors { channel, count, at },
            TraceEvent::State { state, counters } => {
                Self::State { channel, state, counters: counters.unwrap_or((0, 0)), at }
            }
            TraceEvent::Lost { stage, count, at_least } => {
                Self::Lost { channel, stage: stage.unwrap_or(LossStage::Link), count, at_least, at }
            }
            TraceEvent::TransmitFailed { .. } | TraceEvent::Disturbed { .. } | TraceEvent::Lin { .. } => {
                return None;
            }
        })
    }
}

/// An adapter. Nothing is sent or acknowledged before [`Driver::open`].
pub(crate) trait Driver: Send {
    /// What it can tell.
    fn row(&self) -> &'static Row;
    /// Channels.
    fn channels(&self) -> u8 {
        1
    }
    /// Its serial number or name, if it has one.
    fn serial(&self) -> String {
        String::new()
    }
    /// Its own version, if it has one.
    fn version(&self) -> [u16; 3] {
        [0; 3]
    }
    /// Takes part in a channel's bus. Waits for the adapter's answer, for a second at most.
    fn open(&mut self, channel: Channel, opening: Opening) -> Result<(), Refusal>;
    /// Leaves a channel's bus. What arrives before is still reported by the next [`Driver::poll`].
    fn close(&mut self, channel: Channel);
    /// Takes a frame to be sent. Returns false if it cannot now: it is offered again.
    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool;
    /// Whether it sends CAN FD frames, too.
    fn sends_fd(&self) -> bool {
        false
    }
    /// [`Driver::send`] of a CAN FD frame, where [`Driver::sends_fd`] says that there are any.
    fn send_fd(&mut self, _channel: Channel, _mailbox: u8, _frame: &FdFrame) -> bool {
        false
    }
    /// Waits up to `wait` for something to report, and appends it. An error is the adapter's end, with the reason for people.
    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String>;
    /// Shows for some seconds which adapter it is; 0 ends that.
    fn identify(&mut self, _seconds: u8) -> Result<(), Refusal> {
        Err(Refusal::Unsupported)
    }
    /// Text about what was left out or misunderstood, with its count: shown by `cantap info`.
    fn oddities(&self) -> (u32, String) {
        (0, String::new())
    }
}

/// An adapter that sends pieces of bytes.
pub(crate) trait Bytes {
    /// The next piece, if one comes in time.
    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String>;
    /// Reads a piece.
    fn push(&mut self, bytes: &[u8], arrival: Instant);
    /// What is to be reported.
    fn backlog(&mut self) -> &mut Vec<Incoming>;
}

/// [`Driver::poll`] of such an adapter: reads what comes, unless there is something to report already.
pub(crate) fn poll_bytes(
    adapter: &mut impl Bytes,
    wait: Duration,
    reports: &mut Vec<Incoming>,
) -> Result<(), String> {
    let wait = if adapter.backlog().is_empty() { wait } else { Duration::ZERO };
    let next = adapter.next(wait);
    if let Ok(Some(piece)) = &next {
        adapter.push(&piece.content, piece.at);
    }
    reports.append(adapter.backlog());
    next.map(|_| ())
}

/// Counts of what an adapter sent that makes no sense, by kind.
#[derive(Clone, Debug, Default)]
pub(crate) struct Oddities {
    kinds: Vec<(&'static str, u32)>,
}

impl Oddities {
    /// Counts one.
    pub fn count(&mut self, kind: &'static str) {
        match self.kinds.iter_mut().find(|(name, _)| *name == kind) {
            Some((_, count)) => *count = count.saturating_add(1),
            None => self.kinds.push((kind, 1)),
        }
    }

    /// All of them, and a list of them.
    pub fn summary(&self) -> (u32, String) {
        let text: Vec<String> = self.kinds.iter().map(|(kind, count)| format!("{count} {kind}")).collect();
        (self.kinds.iter().fold(0, |sum, (_, count)| sum.saturating_add(*count)), text.join(", "))
    }
}
