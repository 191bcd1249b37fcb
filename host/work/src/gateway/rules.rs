//! The file of rules, and the wire's rules that it stands for.

mod file;

use std::path::Path;
use std::time::Duration;

use cantap::Channel;
use cantap::wire::message::{GatewayRule, MAX_GATEWAY_RULES};

/// What a file of rules says, in its order.
#[derive(Clone, Debug)]
pub struct Rules {
    /// The rules. Of those for a channel, the first that matches a frame decides.
    pub rules: Vec<Rule>,
}

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

impl Rules {
    /// Reads a file.
    pub fn read(path: &Path) -> Result<Self, RulesError> {
        let file = path.display().to_string();
        match std::fs::read_to_string(path) {
            Ok(text) => Self::parse(&file, &text),
            Err(error) => Err(RulesError::Unreadable { file, error }),
        }
    }

    /// Reads a text; `file` is its name in errors.
    pub fn parse(file: &str, text: &str) -> Result<Self, RulesError> {
        let rules = Self { rules: file::parse(file, text)? };
        for from in Channel::ALL {
            let needed = rules.places(from).count();
            if needed > MAX_GATEWAY_RULES {
                return Err(RulesError::TooMany { file: file.to_owned(), from, needed });
            }
        }
        Ok(rules)
    }

    /// For each place in a device's list for a channel, the number of the rule in [`Self::rules`] that it belongs to.
    pub fn places(&self, from: Channel) -> impl Iterator<Item = usize> {
        let rules = self.rules.iter().enumerate().filter(move |(_, rule)| rule.from == from);
        rules.flat_map(|(number, rule)| std::iter::repeat_n(number, rule.parts.len()))
    }

    /// Whether a rule drops what it matches.
    pub fn drops(&self, number: usize) -> bool {
        self.rules.get(number).is_some_and(|rule| rule.parts.iter().all(|part| part.pass.is_none()))
    }

    /// What a device is given for a channel. `tick_hz` is the rate of its clock.
    pub fn of_device(&self, from: Channel, tick_hz: u32) -> Vec<GatewayRule> {
        let ticks = |time: Duration| {
            let ticks = time.as_nanos() * u128::from(tick_hz) / 1_000_000_000;
            // [`file`] has seen to it that the longest fits for any rate up to 40 MHz.
            u32::try_from(ticks).unwrap_or(u32::MAX).max(u32::from(!time.is_zero()))
        };
        let mut all = Vec::new();
        for rule in self.rules.iter().filter(|rule| rule.from == from) {
            for part in &rule.parts {
                let mut part = part.clone();
                if let Some(pass) = &mut part.pass {
                    (pass.period_ticks, pass.delay_ticks) = (ticks(rule.period), ticks(rule.delay));
                }
                all.push(part);
            }
        }
        all
    }
}
