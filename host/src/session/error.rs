//! What can go wrong with a device.

use std::time::Duration;
use std::{fmt, io};

use cantap_trace::counted;
use cantap_wire::message::{EndReason, MAX_FILTERS, MAX_SEND, Mode, Refusal};
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS, NoTiming};
use cantap_wire::{Channel, PROTOCOL_VERSION};

/// Why a device could not be opened or used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DeviceError {
    /// There is nothing at the address.
    #[error("there is no device at '{address}'")]
    NotFound {
        /// As given.
        address: String,
    },
    /// Another program has the port open.
    #[error("'{address}' is in use by another program; close it there and try again")]
    Busy {
        /// As given.
        address: String,
    },
    /// The operating system forbids it.
    #[error(
        "no permission to open '{address}'; on Linux add yourself to the group that owns it \
         (usually `dialout`) and log in again"
    )]
    Forbidden {
        /// As given.
        address: String,
    },
    /// The port cannot be opened for another reason.
    #[error("'{address}' cannot be opened as a serial port: {source}")]
    Open {
        /// As given.
        address: String,
        /// What the system says.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// It does not answer, or not in cantap's protocol.
    #[error("'{address}' does not answer as a cantap device")]
    NotCantap {
        /// As given.
        address: String,
    },
    /// The protocol versions differ.
    #[error(
        "the device speaks protocol version {device}, this program version {PROTOCOL_VERSION}: update the {}",
        older_side(*device)
    )]
    Protocol {
        /// The device's version.
        device: u16,
    },
    /// The device refused a request. Nothing has changed.
    #[error("the device refused: {}", sentence(*refusal))]
    Refused {
        /// Its reason.
        refusal: Refusal,
    },
    /// A request got no answer.
    #[error("the device did not answer within {seconds} s; unplug it and plug it in again")]
    Timeout {
        /// How long the host waited, in seconds.
        seconds: f32,
    },
    /// The device gave an answer that does not belong to the request.
    #[error("the device's answer does not fit the question; update the firmware and this program")]
    WrongReply,
    /// The request is longer than a device takes.
    #[error("the request is too long; give at most {MAX_FILTERS} filters or {MAX_SEND} frames at once")]
    RequestTooLong,
    /// The port is gone: unplugged, reset, or its other end closed.
    #[error("the device at '{address}' vanished ({reason})")]
    Vanished {
        /// As given.
        address: String,
        /// The system's message.
        reason: String,
    },
    /// The port is there, but nothing is answered any more.
    #[error("the device at '{address}' has answered nothing for {seconds:.1} s")]
    Silent {
        /// As given.
        address: String,
        /// For how long, in seconds.
        seconds: f32,
    },
    /// The session is over; nothing captured since then was delivered.
    #[error("the session with the device at '{address}' has ended: {reason}")]
    SessionEnded {
        /// As given.
        address: String,
        /// How this was noticed.
        reason: SessionOver,
    },
    /// The device was absent when the capture ended.
    #[error("the device at '{address}' was not there at the end: {reason}")]
    StillGone {
        /// As given.
        address: String,
        /// The last error.
        reason: String,
    },
    /// The capture could not be ended properly.
    #[error(
        "the capture from '{address}' ended without the device's last word, and frames may be missing at its end: {reason}"
    )]
    BadEnd {
        /// As given.
        address: String,
        /// What was wrong.
        reason: String,
    },
    /// There is another board at the address, on which the earlier set-up cannot be repeated.
    #[error("another board is at '{address}' now ({name}), and its clock is another; start again with it")]
    OtherClock {
        /// As given.
        address: String,
        /// Its name and serial number.
        name: String,
    },
    /// The bit rate cannot be set.
    #[error("{}", no_timing(*bitrate_bps, reason))]
    BitRate {
        /// The requested rate, in bit/s.
        bitrate_bps: u32,
        /// Why not, and which rates are near.
        reason: NoTiming,
    },
    /// The device reports something about itself that is impossible.
    #[error("the device says {what}, which cannot be; update its firmware")]
    Impossible {
        /// What it reports.
        what: String,
    },
    /// The device opened a channel differently from the request. The channel was closed again.
    #[error(
        "the device opened channel {} at {bitrate_bps} bit/s in the mode {mode:?}, which is not what it was asked for; update its firmware",
        .channel.number()
    )]
    OpenedOtherwise {
        /// The channel.
        channel: Channel,
        /// The bit rate it reports, in bit/s.
        bitrate_bps: u32,
        /// The mode it reports.
        mode: Mode,
    },
    /// The device has fewer channels.
    #[error("the device has no channel {}", .channel.number())]
    NoChannel {
        /// The requested channel.
        channel: Channel,
    },
    /// The device sends no CAN FD frames.
    #[error(
        "the device sends no CAN FD frames, but classical ones of up to eight bytes; nothing was sent in their place"
    )]
    NoFd,
    /// Another maker's adapter cannot listen without acknowledging.
    #[error(
        "the adapter at '{address}' cannot only listen: it acknowledges every frame; open it in normal mode if that is wanted"
    )]
    AlwaysAcknowledges {
        /// As given.
        address: String,
    },
    /// A thread could not be started.
    #[error("the system refused a thread: {0}; close other programs and try again")]
    Thread(#[source] io::Error),
}

/// How the end of a session was noticed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum SessionOver {
    /// The device reports that the computer suspended it.
    Suspended,
    /// The device reports that the computer configured it again.
    Configured,
    /// The device refuses requests because there is no session.
    Refused,
    /// Another program greets the device on our port.
    Greeted,
    /// The stream started over.
    StreamWentBack,
    /// The device's clock was set back, or its records are later than its own time.
    TimesDisagree,
    /// The board's server has lost it.
    BoardLost,
    /// The board's server has ended.
    ServerEnded,
}

impl From<EndReason> for SessionOver {
    fn from(reason: EndReason) -> Self {
        match reason {
            EndReason::Suspended => Self::Suspended,
            EndReason::BoardLost => Self::BoardLost,
            EndReason::ServerEnded => Self::ServerEnded,
            EndReason::Configured => Self::Configured,
        }
    }
}

impl DeviceError {
    /// Whether the connection failed, rather than the request.
    pub const fn is_of_the_connection(&self) -> bool {
        matches!(
            self,
            Self::Vanished { .. } | Self::Silent { .. } | Self::SessionEnded { .. } | Self::Timeout { .. }
        ) || matches!(self, Self::Refused { refusal: Refusal::NoSession })
    }
}

impl fmt::Display for SessionOver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Suspended => "this computer put the device to sleep, as when it sleeps itself",
            Self::Configured => "this computer configured the device again, as when its driver is reloaded",
            Self::Refused => {
                "this computer slept, or the device was restarted, or another program took it over"
            }
            Self::Greeted => "another program took it over; close that program",
            Self::StreamWentBack => {
                "its stream started over, because another program took it over or it was restarted"
            }
            Self::TimesDisagree => {
                "its times contradict one another, so its last stamps may be wrong; if that stays so, update its firmware"
            }
            Self::BoardLost => "its server has lost the board",
            Self::ServerEnded => "its server has ended",
        })
    }
}

/// Why a connection is no longer usable; kept as the answer to every later request.
#[derive(Clone, Debug)]
pub(super) enum Gone {
    Vanished(String),
    Silent(Duration),
    Ended(SessionOver),
}

impl Gone {
    pub fn error(&self, address: &str) -> DeviceError {
        let address = address.to_owned();
        match self {
            Self::Vanished(reason) => DeviceError::Vanished { address, reason: reason.clone() },
            Self::Silent(time) => DeviceError::Silent { address, seconds: time.as_secs_f32() },
            Self::Ended(reason) => DeviceError::SessionEnded { address, reason: *reason },
        }
    }
}

fn older_side(device: u16) -> &'static str {
    if device < PROTOCOL_VERSION { "device's firmware" } else { "cantap program on this computer" }
}

pub(crate) fn no_timing(bitrate_bps: u32, reason: &NoTiming) -> String {
    match *reason {
        NoTiming::OutOfRange => format!(
            "a bit rate of {bitrate_bps} bit/s is impossible; choose one from {MIN_BITRATE_BPS} to {MAX_BITRATE_BPS}"
        ),
        NoTiming::Unreachable { below_bps, above_bps } => {
            let nearest: Vec<String> = [below_bps, above_bps].iter().flatten().map(u32::to_string).collect();
            if nearest.is_empty() {
                return format!(
                    "the clock cannot be divided to {bitrate_bps} bit/s, nor to any other rate from {MIN_BITRATE_BPS} to \
                     {MAX_BITRATE_BPS}; a CAN controller's clock has some MHz"
                );
            }
            format!(
                "the device's clock cannot be divided to {bitrate_bps} bit/s; the nearest it reaches: {} bit/s",
                nearest.join(" and ")
            )
        }
        other => format!("{bitrate_bps} bit/s: {other}"),
    }
}

/// A refusal in words, with what to do about it.
fn sentence(refusal: Refusal) -> String {
    let fixed = match refusal {
        Refusal::Protocol { device } => {
            return format!("it speaks protocol version {device}; update the {}", older_side(device));
        }
        Refusal::QueueFull { free } => {
            return format!(
                "its transmit queue has room for {free} only; send fewer at once, or wait",
                free = counted(free, "more frame")
            );
        }
        Refusal::BanksExhausted { needed, available } => {
            return format!(
                "the filters need {needed} hardware banks and there are {available}; use fewer or wider filters"
            );
        }
        Refusal::Malformed => "it could not read the request; update the firmware and this program",
        Refusal::NoSession => "it knows of no session; connect again",
        Refusal::Unsupported => "it cannot do that",
        Refusal::BadTiming => "the bit timing is outside the controller's range",
        Refusal::BadId => {
            "an identifier is too large; 7FF is the last standard one, 1FFFFFFF the last extended one"
        }
        Refusal::BadDlc => "a length is out of range; a frame carries 0 to 8 bytes",
        Refusal::BadTag => {
            "a transmission's tag is reserved for the device; use one below FFFF0000 hexadecimal"
        }
        Refusal::BadEntry => {
            "a period is too short or too long, or a modifier lies outside the frame's data; change it"
        }
        Refusal::BadSlot => "it has no such table entry",
        Refusal::ChannelOpen => "the channel is open; close it first",
        Refusal::ChannelClosed => "the channel is closed; open it first",
        Refusal::ListenOnly => "the channel only listens",
        Refusal::WouldDisturb => "that would disturb the other channel; close that one first",
        Refusal::TooFarAhead => "the target time is too far ahead; send it later",
        Refusal::Hardware => {
            "the CAN controller did not follow; check the transceiver's supply and that the bus is not stuck dominant"
        }
        Refusal::NothingSaved => "nothing is saved on it; give the bit rate, or save a configuration first",
        Refusal::NotBusOff => "the channel is not bus-off; there is nothing to recover from",
        Refusal::NotMeasuring => "no receive pin is watched; begin the measurement first",
        Refusal::NotGranted { needs } => {
            return format!("its server does not let this client do that, which needs the right to {needs}");
        }
        Refusal::Held => {
            "another client of its server holds the right to configure; wait until that has left"
        }
        Refusal::OtherSettings => {
            "other clients of its server have the channel open, with another bit rate or mode; open it as they have"
        }
        Refusal::NotNormal => {
            "a gateway needs both channels in normal mode, and a disturbance needs its own; open them so"
        }
        Refusal::DisturbanceLocked => "disturbances are not unlocked in this session",
        Refusal::TooOften => "a disturbance is already planned, or the last one was less than 10 ms before",
        Refusal::TooLate => "the time has passed, or is less than 1 ms ahead",
        Refusal::GatewayRunning => "its gateway is running; stop it first",
        Refusal::NoBoard => "its server has no board at the moment; connect the board to it again",
    };
    fixed.to_owned()
}
