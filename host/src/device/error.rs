//! What can go wrong with a device, in sentences that say what to do next.

use std::io;

use cantap_wire::message::{MAX_FILTERS, MAX_SEND, Refusal};
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS, NoTiming};
use cantap_wire::{Channel, PROTOCOL_VERSION};

/// Why a device could not be opened or used.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// The address is not one.
    #[error("'{address}' is not a device address: {reason}")]
    BadAddress {
        /// As it was given.
        address: String,
        /// What is wrong with it and what would be right.
        reason: String,
    },
    /// The emulated board does not come up.
    #[error("the emulated board at '{address}' does not start: {reason}")]
    Emulation {
        /// As it was given.
        address: String,
        /// What the emulator says.
        reason: String,
    },
    /// There is nothing at the address.
    #[error("there is no device at '{address}'; `cantap list` shows what is connected")]
    NotFound {
        /// As it was given.
        address: String,
    },
    /// Another program has the port open.
    #[error("'{address}' is in use by another program; close it there and try again")]
    Busy {
        /// As it was given.
        address: String,
    },
    /// The operating system forbids it.
    #[error(
        "no permission to open '{address}'; on Linux add yourself to the group that owns it \
         (usually `dialout`) and log in again"
    )]
    Forbidden {
        /// As it was given.
        address: String,
    },
    /// The port cannot be opened for another reason.
    #[error("'{address}' cannot be opened as a serial port: {reason}; check the address with `cantap list`")]
    Open {
        /// As it was given.
        address: String,
        /// The system's message.
        reason: String,
    },
    /// It does not answer, or not in our language.
    #[error(
        "'{address}' does not answer as a cantap device; check that it is one (`cantap list`), \
         then unplug it and plug it in again"
    )]
    NotCantap {
        /// As it was given.
        address: String,
    },
    /// Versions differ.
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
        /// How long was waited, in seconds.
        seconds: f32,
    },
    /// The device gave an answer that does not belong to the request.
    #[error("the device's answer does not fit the question; update the firmware and this program")]
    WrongReply,
    /// The request is longer than a device takes.
    #[error("the request is too long; give at most {MAX_FILTERS} filters or {MAX_SEND} frames at once")]
    RequestTooLong,
    /// The port is gone: unplugged, reset, or its other end closed.
    #[error("the device at '{address}' vanished ({reason}); plug it in again and restart the capture")]
    Vanished {
        /// As it was given.
        address: String,
        /// The system's message.
        reason: String,
    },
    /// The bit rate cannot be set.
    #[error("{}", no_timing(*bitrate_bps, reason))]
    BitRate {
        /// What was asked for, in bit/s.
        bitrate_bps: u32,
        /// Why not, and what is near.
        reason: NoTiming,
    },
    /// The device has fewer channels.
    #[error("the device has no channel {}; choose one it has with -c", .channel.number())]
    NoChannel {
        /// What was asked for.
        channel: Channel,
    },
    /// A file that the device needs cannot be read.
    #[error("'{path}' cannot be read: {source}; check its name and permissions")]
    File {
        /// Its name.
        path: String,
        /// The system's message.
        source: io::Error,
    },
    /// This build cannot do it.
    #[error("this build of cantap has no support for '{address}'; build it with the feature `{feature}`")]
    NotBuilt {
        /// As it was given.
        address: String,
        /// What is missing.
        feature: &'static str,
    },
    /// A thread could not be started.
    #[error("the system refused a thread: {0}; close other programs and try again")]
    Thread(io::Error),
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
    }
}

/// A refusal, and what to do about it.
fn sentence(refusal: Refusal) -> String {
    let fixed = match refusal {
        Refusal::Protocol { device } => {
            return format!("it speaks protocol version {device}; update the {}", older_side(device));
        }
        Refusal::QueueFull { free } => {
            return format!(
                "its transmit queue has room for {free} more frames only; send fewer at once, or wait"
            );
        }
        Refusal::BanksExhausted { needed, available } => {
            return format!(
                "the filters need {needed} hardware banks and there are {available}; use fewer or wider filters"
            );
        }
        Refusal::Malformed => "it could not read the request; update the firmware and this program",
        Refusal::NoSession => "another program took it over; close that program and connect again",
        Refusal::Unsupported => "it cannot do that; `cantap info` shows what it can",
        Refusal::BadTiming => "the bit timing is outside the controller's range; see `cantap timing`",
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
        Refusal::BadSlot => "it has no such table entry; `cantap info` shows how many there are",
        Refusal::ChannelOpen => "the channel is open; close it first",
        Refusal::ChannelClosed => "the channel is closed; open it first",
        Refusal::ListenOnly => "the channel only listens; open it in normal mode (--mode normal) to send",
        Refusal::WouldDisturb => "that would disturb the other channel; close that one first",
        Refusal::TooFarAhead => "the target time is too far ahead; send it later",
        Refusal::Hardware => {
            "the CAN controller did not follow; check the transceiver's supply and that the bus is not stuck dominant"
        }
        Refusal::NothingSaved => "nothing is saved on it; give the bit rate, or save a configuration first",
        Refusal::NotBusOff => "the channel is not bus-off; there is nothing to recover from",
    };
    fixed.to_owned()
}
