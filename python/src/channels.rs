//! Which channels a trace has, and which of those that a program names are not among them.

use serde::{Deserialize, Serialize};

/// A set of channels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Channels([u64; 4]);

impl Channels {
    /// Adds one.
    pub fn insert(&mut self, channel: u8) {
        self.0[usize::from(channel / 64)] |= 1 << (channel % 64);
    }

    /// Whether it is one of them.
    pub fn contains(&self, channel: u8) -> bool {
        self.0[usize::from(channel / 64)] & (1 << (channel % 64)) != 0
    }

    /// All, in order.
    pub fn iter(&self) -> impl Iterator<Item = u8> {
        (0..=u8::MAX).filter(|channel| self.contains(*channel))
    }
}

impl Extend<u8> for Channels {
    fn extend<T: IntoIterator<Item = u8>>(&mut self, channels: T) {
        channels.into_iter().for_each(|channel| self.insert(channel));
    }
}

impl FromIterator<u8> for Channels {
    fn from_iter<T: IntoIterator<Item = u8>>(channels: T) -> Self {
        let mut all = Self::default();
        all.extend(channels);
        all
    }
}

/// The channels that an argument names.
#[derive(Clone, Debug)]
pub struct Named {
    /// What the argument is called.
    pub argument: &'static str,
    /// The channels.
    pub channels: Channels,
}

impl Named {
    /// Of an argument, unless it names none.
    pub fn by(argument: &'static str, channels: impl IntoIterator<Item = u8>) -> Option<Self> {
        let channels: Channels = channels.into_iter().collect();
        (channels != Channels::default()).then_some(Self { argument, channels })
    }

    /// That a trace does not have some of them, in words. A trace without records has no channels that it could be about.
    pub fn missing_in(&self, source: &str, trace: &Channels) -> Option<String> {
        let missing: Vec<_> = self.channels.iter().filter(|channel| !trace.contains(*channel)).collect();
        if missing.is_empty() || *trace == Channels::default() {
            return None;
        }
        let s = if missing.len() == 1 { "" } else { "s" };
        let (missing, there) = (listed(&missing), listed(&trace.iter().collect::<Vec<_>>()));
        let argument = self.argument;
        Some(format!(
            "{source}: {argument}= names channel{s} {missing}, which it does not have; it has {there}"
        ))
    }
}

/// `1`, `1 and 2`, `1, 2 and 3`.
fn listed(channels: &[u8]) -> String {
    let mut texts: Vec<_> = channels.iter().map(ToString::to_string).collect();
    match texts.pop() {
        Some(last) if texts.is_empty() => last,
        Some(last) => format!("{} and {last}", texts.join(", ")),
        None => String::new(),
    }
}
