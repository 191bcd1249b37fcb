//! The file of rules, and the wire's rules that it stands for.

mod file;
mod rule;

use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::time::Duration;

use cantap::wire::message::{GatewayRule, MAX_GATEWAY_RULES};
use cantap::{Channel, Device, DeviceError};

pub use rule::{Rule, RulesError};

/// No file of rules is larger: a device has 64 places.
const MOST_BYTES: u64 = 256 * 1024;

/// What a file of rules says, in its order.
#[derive(Clone, Debug)]
pub struct Rules {
    /// The rules. Of those for a channel, the first that matches a frame decides.
    pub rules: Vec<Rule>,
}

impl Rules {
    /// Reads a file.
    pub fn read(path: &Path) -> Result<Self, RulesError> {
        let file = path.display().to_string();
        let mut text = String::new();
        let read = File::open(path).and_then(|opened| opened.take(MOST_BYTES + 1).read_to_string(&mut text));
        match read {
            _ if text.len() as u64 > MOST_BYTES => Err(RulesError::TooLarge { file }),
            Ok(_) => Self::parse(&file, &text),
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

    /// Gives a device those for both channels.
    pub fn set(&self, device: &Device) -> Result<(), DeviceError> {
        let tick_hz = device.hello().tick_hz;
        Channel::ALL
            .into_iter()
            .try_for_each(|from| device.set_gateway_rules(from, &self.of_device(from, tick_hz)))
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
