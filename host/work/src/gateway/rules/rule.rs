//! One rule of a file, and what can be wrong with the file.

use std::time::Duration;

use cantap::Channel;
use cantap::wire::message::{GatewayRule, MAX_GATEWAY_RULES};

/// A rule.
#[derive(Clone, Debug)]
pub struct Rule {
    /// As the file calls it; otherwise its filter.
    pub name: String,
    /// Where it begins in the file, from 1.
    pub line: u32,
    /// The channel that receives the frames; the other sends them.
    pub from: Channel,
    /// The same for the device, without [`Self::period`] and [`Self::delay`], whose units are the device's: one for each of its filters.
    pub parts: Vec<GatewayRule>,
    /// At most one frame in so long.
    pub period: Duration,
    /// How long a frame waits.
    pub delay: Duration,
}

/// What is wrong with a file of rules.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RulesError {
    /// It cannot be read.
    #[error("{file}: {error}")]
    Unreadable {
        /// The file.
        file: String,
        /// Why.
        error: std::io::Error,
    },
    /// It is no file of rules.
    #[error(
        "{file} has more than 256 KiB, which no file of rules for a device has; docs/gateway.md says what one contains"
    )]
    TooLarge {
        /// The file.
        file: String,
    },
    /// A place in it.
    #[error("{file}, line {line}: {field}{text}")]
    Faulty {
        /// The file.
        file: String,
        /// The line, from 1.
        line: u32,
        /// The field, with a colon and a blank after it; empty if it is none of them.
        field: String,
        /// What is wrong, and what to write.
        text: String,
    },
    /// A device has no room for that many.
    #[error(
        "{file}: the rules for what channel {} receives take {needed} places, and a device has {MAX_GATEWAY_RULES}; each filter takes one, \
         a range several", from.number()
    )]
    TooMany {
        /// The file.
        file: String,
        /// The channel that receives.
        from: Channel,
        /// How many places they take.
        needed: usize,
    },
}
