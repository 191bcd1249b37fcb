//! Channels as a user names them: by number, several, or all.

use cantap::Channel;
use cantap::wire::CHANNELS;
use cantap_trace::grammar;

/// The most channels that a command supports, over all its devices.
pub const MOST_CHANNELS: u8 = 32;

/// Channels, as `1`, `2`, several separated by commas, or `both`, which means all.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channels {
    /// From 1; empty for all.
    numbers: Vec<u8>,
}

/// A channel that the devices do not have.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoSuchChannel {
    /// Of a single device.
    #[error("a device has channels 1 and 2, and no channel {number}")]
    OfOne {
        /// From 1.
        number: u8,
    },
    /// Of several devices.
    #[error("{boards} devices have channels 1 to {count}, and no channel {number}")]
    OfSeveral {
        /// How many devices there are.
        boards: usize,
        /// How many channels they have.
        count: usize,
        /// From 1.
        number: u8,
    },
}

impl Channels {
    /// All channels.
    pub const fn all() -> Self {
        Self { numbers: Vec::new() }
    }

    /// Those with these numbers, from 1; all if there is none.
    pub const fn of_numbers(numbers: Vec<u8>) -> Self {
        Self { numbers }
    }

    /// Whether the channel with this number, from 1, is included.
    pub fn has(&self, number: u8) -> bool {
        self.numbers.is_empty() || self.numbers.contains(&number)
    }

    /// Those of a single device, one by one.
    pub fn iter(&self) -> impl Iterator<Item = Channel> + use<'_> {
        Channel::ALL.into_iter().filter(|channel| self.has(channel.number()))
    }

    /// Refuses channels that this number of boards does not have.
    pub fn check(&self, boards: usize) -> Result<(), NoSuchChannel> {
        let count = boards * CHANNELS;
        match self.numbers.iter().find(|number| usize::from(**number) > count) {
            None => Ok(()),
            Some(&number) if boards == 1 => Err(NoSuchChannel::OfOne { number }),
            Some(&number) => Err(NoSuchChannel::OfSeveral { boards, count, number }),
        }
    }
}

/// The number of a device's channel, from 1 to [`MOST_CHANNELS`], as `1` or as an interface, `can0`.
pub fn channel_number(text: &str) -> Option<u8> {
    grammar::channel(text).filter(|number| *number <= MOST_CHANNELS)
}

/// The board, from 0, and its channel for a number, from 1.
pub fn place_of(number: u8) -> (usize, Channel) {
    let index = usize::from(number.saturating_sub(1));
    (index / CHANNELS, Channel::ALL[index % CHANNELS])
}
