//! What is examined, and what was found.

use std::time::Duration;

use cantap::Channel;
use cantap::wire::message::Hello;
use cantap_address::Address;

use crate::channels::Channels;
use crate::interrupt;
use crate::requested_rate::RequestedRate;

/// What to examine, and how.
#[derive(Clone, Debug)]
pub struct Examination {
    /// The device; without one, the board that is connected.
    pub address: Option<Address>,
    /// Its channels.
    pub channels: Channels,
    /// Bit rates; a channel without one uses what is known of its bus, what is saved on the device, or what is found by listening.
    pub bitrates: Vec<RequestedRate>,
    /// How long to listen to each channel.
    pub time: Duration,
}

/// How a check ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// As it should be.
    Ok,
    /// Worth knowing, and often as it should be.
    Note,
    /// Something is the matter.
    Problem,
    /// It could not be examined.
    Skipped,
}

/// What was examined, and what was found.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Check {
    /// `port`, `rights`, `in-use`, `modem-manager`, `device`, `firmware`, `supply` or `bus`.
    pub check: &'static str,
    /// Of a `bus`: the channel's number, from 1.
    pub channel: Option<u8>,
    /// How it ended.
    pub outcome: Verdict,
    /// What was found, without a full stop.
    pub found: String,
    /// What to do next; every problem has it.
    pub next: Option<String>,
    /// Of a bus that was listened to.
    pub bus: Option<BusFigures>,
}

/// What was received while listening to a bus.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct BusFigures {
    /// At this bit rate, in bit/s; `None` if none was found.
    pub bitrate_bps: Option<u32>,
    /// Frames, including lost ones.
    pub frames: u64,
    /// Bus errors.
    pub bus_errors: u64,
    /// The name of a [`crate::bus_hints::BusHint`].
    pub hint: Option<&'static str>,
}

impl Check {
    pub(super) fn new(check: &'static str, outcome: Verdict, found: impl Into<String>) -> Self {
        Self { check, channel: None, outcome, found: found.into(), next: None, bus: None }
    }

    pub(super) fn ok(check: &'static str, found: impl Into<String>) -> Self {
        Self::new(check, Verdict::Ok, found)
    }

    pub(super) fn problem(check: &'static str, found: impl Into<String>, next: impl Into<String>) -> Self {
        Self { next: Some(next.into()), ..Self::new(check, Verdict::Problem, found) }
    }

    pub(super) fn note(check: &'static str, found: impl Into<String>, next: impl Into<String>) -> Self {
        Self { outcome: Verdict::Note, ..Self::problem(check, found, next) }
    }

    pub(super) fn on(self, channel: u8) -> Self {
        Self { channel: Some(channel), ..self }
    }
}

/// Whether the user wants it to end.
pub(super) fn is_stopped() -> bool {
    interrupt::requested()
}

/// The channels of a device that are to be examined.
pub(super) fn channels<'a>(
    examination: &'a Examination,
    hello: &Hello,
) -> impl Iterator<Item = Channel> + use<'a> {
    let count = hello.channels;
    Channel::ALL
        .into_iter()
        .filter(move |channel| channel.number() <= count && examination.channels.has(channel.number()))
}
