//! Interface names (`can0`, `vcan1`, `OBD`) as channel numbers.

use serde::{Deserialize, Serialize};

/// Remembers the channel of each interface name in a file. `can0` is channel 1, as users count, and so are `CAN 1` and `CAN-1`, as programs
/// that count so write it; a name without a number, or with a number already used by another name, gets the next free one.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct Interfaces {
    known: Vec<(Vec<u8>, u8)>,
    /// The place of the last one asked for.
    #[serde(skip)]
    last: usize,
}

/// More names than this are noise, not channels; they share the last number.
const MAX_NAMES: usize = 255;

impl Interfaces {
    /// The channel of a name.
    #[inline]
    pub(crate) fn channel(&mut self, name: &[u8]) -> u8 {
        match self.known.get(self.last) {
            Some((known, channel)) if known == name => *channel,
            _ => self.search(name),
        }
    }

    fn search(&mut self, name: &[u8]) -> u8 {
        if let Some(at) = self.known.iter().position(|(known, _)| known == name) {
            self.last = at;
            return self.known[at].1;
        }
        if name == cantap_trace::CHANNEL_0.as_bytes() {
            return 0;
        }
        if self.known.len() >= MAX_NAMES {
            return u8::MAX;
        }
        let digits = name.iter().rev().take_while(|byte| byte.is_ascii_digit()).count();
        let number = super::text::decimal(&name[name.len() - digits..]);
        let stem = &name[..name.len() - digits];
        let counts_from_1 = stem.ends_with(b" ") || stem.ends_with(b"-");
        let wanted =
            number.and_then(|number| u8::try_from(number.saturating_add(u64::from(!counts_from_1))).ok());
        let wanted = wanted.filter(|channel| *channel > 0);
        let taken = |channel: u8| self.known.iter().any(|(_, known)| *known == channel);
        let channel = wanted
            .filter(|channel| !taken(*channel))
            .or_else(|| (1..=u8::MAX).find(|channel| !taken(*channel)))
            .unwrap_or(u8::MAX);
        self.last = self.known.len();
        self.known.push((name.to_vec(), channel));
        channel
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_follow_the_names_and_never_collide() {
        let mut interfaces = Interfaces::default();
        for (name, channel) in
            [("can0", 1), ("can1", 2), ("vcan1", 3), ("OBD", 4), ("can7", 8), ("can300", 5), ("can0", 1)]
        {
            assert_eq!(interfaces.channel(name.as_bytes()), channel, "{name}");
        }
        let mut interfaces = Interfaces::default();
        for (name, channel) in [("CAN 2", 2), ("CAN 1", 1), ("CAN 0", 3), ("USB-to-CAN V2 CAN-4", 4)] {
            assert_eq!(interfaces.channel(name.as_bytes()), channel, "{name}");
        }
        for extra in 0..1000 {
            interfaces.channel(format!("x{extra}").as_bytes());
        }
        assert_eq!(interfaces.known.len(), MAX_NAMES);
    }
}
