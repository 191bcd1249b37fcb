//! What a page may ask for, as JSON: `{"number": 1, "request": "send", "parameters": {…}}`. The answer has the same number and either `ok` or
//! `error`, a sentence.

use std::fmt;

use cantap::Frame;
use cantap::periodic;
use cantap::wire::message::{Checksum, MAX_MODIFIERS, Modifier, Role};
use serde::Deserialize;

/// A message of a page.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub enum Message {
    /// The number of the next record that it needs: everything before has been taken in.
    Received {
        /// The number.
        received: u64,
    },
    /// A request.
    Request {
        /// Chosen by the page, for the answer.
        number: u64,
        /// What it asks for.
        #[serde(flatten)]
        request: Request,
    },
}

/// A request with its parameters.
#[derive(Debug, Deserialize)]
#[serde(
    tag = "request",
    content = "parameters",
    rename_all = "camelCase",
    rename_all_fields = "camelCase",
    deny_unknown_fields
)]
pub enum Request {
    /// Records to a new file in the working folder, in the format of its suffix.
    Record {
        /// The file's name, without a folder.
        name: String,
        /// What of it, if not everything.
        #[serde(default)]
        only: Option<Only>,
    },
    /// Ends the recording.
    StopRecording {},
    /// Another bit rate for a channel, in bit/s. All channels only listen afterwards.
    Bitrate {
        /// From 1.
        channel: u8,
        /// Bit/s; without one, it is found by listening.
        #[serde(default)]
        bitrate: Option<u32>,
    },
    /// Receives only these frames, in candump's syntax; without any, all.
    Filters {
        /// Any may match.
        filters: Vec<String>,
    },
    /// Takes part in the buses: acknowledges, and may send; or only listens.
    Mode {
        /// Whether to take part.
        normal: bool,
        /// The user has confirmed it.
        #[serde(default)]
        confirmed: bool,
    },
    /// Sends a frame once.
    Send {
        /// From 1.
        channel: u8,
        /// As `cantap send` takes it.
        frame: String,
    },
    /// Has the device send a frame periodically. The answer has the entry's `slot`.
    Periodic {
        /// From 1.
        channel: u8,
        /// As `cantap send` takes it.
        frame: String,
        /// Milliseconds.
        period_ms: f64,
        /// What changes each time.
        #[serde(default)]
        modifiers: Vec<Change>,
    },
    /// Ends it.
    StopPeriodic {
        /// From 1.
        channel: u8,
        /// As in the answer to `periodic`.
        slot: u8,
    },
    /// Brings channels that are bus-off back onto their buses.
    Recover {},
    /// Asks a vehicle by OBD-II for its VIN, trouble codes and values, again and again; or ends that.
    AskVehicle {
        /// Whether to ask.
        on: bool,
    },
}

impl Request {
    /// The role that it takes.
    pub const fn needs(&self) -> Role {
        match self {
            Self::Record { .. } | Self::StopRecording {} => Role::Listen,
            Self::Bitrate { .. } | Self::Filters { .. } | Self::Mode { normal: false, .. } => Role::Configure,
            Self::Mode { .. }
            | Self::Send { .. }
            | Self::Periodic { .. }
            | Self::StopPeriodic { .. }
            | Self::Recover {}
            | Self::AskVehicle { .. } => Role::Send,
        }
    }
}

/// For whoever runs the server: what was asked for, with no more than the beginning of a text.
impl fmt::Display for Request {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const MOST: usize = 100;
        match self {
            Self::Record { name, .. } => write!(f, "record to {name:.MOST$}"),
            Self::StopRecording {} => f.write_str("end the recording"),
            Self::Bitrate { channel, bitrate: Some(bitrate) } => {
                write!(f, "channel {channel} at {bitrate} bit/s")
            }
            Self::Bitrate { channel, bitrate: None } => {
                write!(f, "find the bit rate of channel {channel} by listening")
            }
            Self::Filters { filters } if filters.is_empty() => f.write_str("no filters"),
            Self::Filters { filters } => {
                write!(
                    f,
                    "filters {:.MOST$}",
                    filters.iter().take(MOST).map(String::as_str).collect::<Vec<_>>().join(" ")
                )
            }
            Self::Mode { normal: true, .. } => f.write_str("take part in the buses"),
            Self::Mode { .. } => f.write_str("only listen"),
            Self::Send { channel, frame } => write!(f, "send {frame:.MOST$} on channel {channel}"),
            Self::Periodic { channel, frame, period_ms, .. } => {
                write!(f, "send {frame:.MOST$} on channel {channel} every {period_ms} ms")
            }
            Self::StopPeriodic { channel, slot } => {
                write!(f, "stop periodic entry {slot} of channel {channel}")
            }
            Self::Recover {} => f.write_str("join the bus again after bus-off"),
            Self::AskVehicle { on: true } => f.write_str("ask the vehicle by OBD-II"),
            Self::AskVehicle { .. } => f.write_str("ask the vehicle nothing any more"),
        }
    }
}

/// The part of what arrives that is recorded.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub struct Only {
    /// A condition, such as `Speed > 80`: what happened around its events.
    pub around: String,
    /// From how long before each, in seconds.
    pub before_s: f64,
    /// Until how long after each, in seconds.
    pub after_s: f64,
}

/// What changes in a periodic frame each time; bytes are counted from 0.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "camelCase", rename_all_fields = "camelCase", deny_unknown_fields)]
pub enum Change {
    /// Counts up.
    Counter {
        /// Where.
        byte: u8,
        /// The lowest of its bits.
        low_bit: u8,
        /// How many bits.
        bits: u8,
    },
    /// A random value.
    Random {
        /// Where.
        byte: u8,
    },
    /// A checksum over the other bytes.
    Checksum {
        /// Where.
        byte: u8,
        /// How.
        algorithm: Algorithm,
    },
}

/// A checksum's, by the names that `cantap send` has.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
pub enum Algorithm {
    /// Exclusive or.
    Xor,
    /// Sum modulo 256.
    Sum,
    /// CRC-8 SAE-J1850.
    Crc8,
}

impl From<Change> for Modifier {
    fn from(change: Change) -> Self {
        match change {
            Change::Counter { byte, low_bit, bits } => Self::Counter { byte, low_bit, bits },
            Change::Random { byte } => Self::Random { byte },
            Change::Checksum { byte, algorithm } => Self::Checksum {
                byte,
                algorithm: match algorithm {
                    Algorithm::Xor => Checksum::Xor,
                    Algorithm::Sum => Checksum::Sum,
                    Algorithm::Crc8 => Checksum::Crc8J1850,
                },
            },
        }
    }
}

/// The modifiers of a frame, checked.
pub fn modifiers(
    frame: &Frame,
    changes: &[Change],
) -> anyhow::Result<heapless::Vec<Modifier, MAX_MODIFIERS>> {
    let mut list = heapless::Vec::new();
    for change in changes {
        if list.push((*change).into()).is_err() {
            anyhow::bail!("a frame takes {MAX_MODIFIERS} changes; give fewer");
        }
    }
    periodic::check_modifiers(frame, &list)?;
    Ok(list)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Option<Message> {
        serde_json::from_str(text).ok()
    }

    #[test]
    fn requests_are_read_and_unknown_ones_refused() {
        assert!(matches!(parse(r#"{"received": 7}"#), Some(Message::Received { received: 7 })));
        let send = r#"{"number": 1, "request": "send", "parameters": {"channel": 1, "frame": "123#00"}}"#;
        assert!(matches!(
            parse(send),
            Some(Message::Request { number: 1, request: Request::Send { channel: 1, .. } })
        ));
        let periodic = r#"{"number": 2, "request": "periodic", "parameters": {"channel": 1, "frame": "123#0000", "periodMs": 10,
            "modifiers": [{"counter": {"byte": 0, "lowBit": 0, "bits": 4}}, {"checksum": {"byte": 1, "algorithm": "crc8"}}]}}"#;
        let Some(Message::Request { request: Request::Periodic { modifiers: changes, .. }, .. }) =
            parse(periodic)
        else {
            panic!("{periodic}")
        };
        let frame = "123#0000".parse().unwrap();
        assert_eq!(modifiers(&frame, &changes).unwrap().len(), 2);
        assert!(modifiers(&"123#00".parse().unwrap(), &changes).is_err());
        for unknown in [
            "",
            "{}",
            "[]",
            "null",
            r#"{"number": 1}"#,
            r#"{"number": 1, "request": "reboot", "parameters": {}}"#,
            r#"{"number": 1, "request": "send", "parameters": {"channel": 300, "frame": "123#"}}"#,
            r#"{"number": -1, "request": "recover", "parameters": {}}"#,
        ] {
            assert!(parse(unknown).is_none(), "{unknown}");
        }
        // Nesting without end is refused instead of followed.
        assert!(parse(&"[".repeat(60_000)).is_none());
    }
}
