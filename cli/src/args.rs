//! Command-line values that several commands have in common.

use std::time::Duration;

use cantap::Channel;
use cantap::wire::CHANNELS;

use crate::wrong::wrong;

pub use cantap_work::{duration, positive_duration};

/// The most channels that a command supports, over all its devices.
pub const MOST_CHANNELS: u8 = 32;

/// Below this, in bit/s, the k was probably forgotten. Controllers start at 5000.
const LEAST_BITRATE_BPS: f64 = 1_500.0;

/// A bit rate in bit/s: `500000`, `500k`, `83.333k`, `1M`.
pub fn bitrate(text: &str) -> Result<u32, String> {
    let bps = per_second(text).ok_or("write a bit rate in bit/s, such as 500000, 500k or 1M")?;
    if f64::from(bps) < LEAST_BITRATE_BPS {
        return Err(format!("{text} bit/s is slower than any CAN bus; write {text}k for {text} kbit/s"));
    }
    Ok(bps)
}

/// A number per second, at least one: bits or clock cycles.
pub fn per_second(text: &str) -> Option<u32> {
    let (number, factor) = match text.as_bytes().last() {
        Some(b'k' | b'K') => (&text[..text.len() - 1], 1_000.0),
        Some(b'm' | b'M') => (&text[..text.len() - 1], 1_000_000.0),
        _ => (text, 1.0),
    };
    if !number.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.') {
        return None;
    }
    let value = (number.parse::<f64>().ok()? * factor).round();
    (1.0..=f64::from(u32::MAX)).contains(&value).then_some(value as u32)
}

/// In nanoseconds, bounded so that deadlines can be added to it.
pub fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX).min(u64::MAX / 4)
}

/// Channels, as `1`, `2`, several separated by commas, or `both`, which means all.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channels {
    /// From 1; empty for all.
    numbers: Vec<u8>,
}

impl Channels {
    /// All channels.
    pub const fn all() -> Self {
        Self { numbers: Vec::new() }
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
    pub fn check(&self, boards: usize) -> anyhow::Result<()> {
        let count = boards * CHANNELS;
        match self.numbers.iter().find(|number| usize::from(**number) > count) {
            None => Ok(()),
            Some(number) if boards == 1 => {
                Err(wrong(format!("a device has channels 1 and 2, and no channel {number}")))
            }
            Some(number) => {
                Err(wrong(format!("{boards} devices have channels 1 to {count}, and no channel {number}")))
            }
        }
    }
}

/// See [`Channels`].
pub fn channels(text: &str) -> Result<Channels, String> {
    if matches!(text, "both" | "all") {
        return Ok(Channels::all());
    }
    let numbers = text.split(',').map(channel_number).collect::<Option<Vec<_>>>();
    numbers.map(|numbers| Channels { numbers }).ok_or_else(|| {
        "channels are 1, 2, several as 1,3, or both; a second device has 3 and 4, and can0 in a trace is channel 1"
            .to_owned()
    })
}

/// Like [`channels`], for one device.
pub fn channels_of_one(text: &str) -> Result<Channels, String> {
    let channels = channels(text)?;
    channels.check(1).map_err(|error| error.to_string())?;
    Ok(channels)
}

/// A channel of a trace, which may have more channels than any device: as `1`, or as an interface, `can0`.
pub fn channel_of_trace(text: &str) -> Result<u8, String> {
    let number = match text.strip_prefix("can") {
        Some(index) => index.parse::<u8>().ok().and_then(|index| index.checked_add(1)),
        None => text.parse().ok(),
    };
    number.ok_or_else(|| {
        "a trace's channels are 1, 2 and so on up to 255, several as 1,3; can0 is channel 1".to_owned()
    })
}

/// The number of a channel, from 1: as `1`, or as its interface in traces, `can0`.
fn channel_number(text: &str) -> Option<u8> {
    channel_of_trace(text).ok().filter(|number| (1..=MOST_CHANNELS).contains(number))
}

/// One channel of a device, as `1`, `2`, or as an interface: `can0` is channel 1, as in every trace.
pub fn channel(text: &str) -> Result<Channel, String> {
    let found = channel_number(text)
        .and_then(|number| Channel::ALL.into_iter().find(|channel| channel.number() == number));
    found.ok_or_else(|| "a channel is 1 or 2; can0 is channel 1, can1 is channel 2".to_owned())
}

/// Whether the terminal shows more than ASCII, judging by its environment.
pub fn is_utf8_locale() -> bool {
    if cfg!(windows) {
        return true;
    }
    // The first that is set and not empty decides (POSIX.1-2017, 8.2).
    let set = ["LC_ALL", "LC_CTYPE", "LANG"].into_iter().filter_map(|name| std::env::var(name).ok());
    let locale = set.into_iter().find(|value| !value.is_empty()).unwrap_or_default().to_ascii_lowercase();
    locale.contains("utf-8") || locale.contains("utf8")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_need_a_known_unit() {
        assert_eq!(duration("400ms"), Ok(Duration::from_millis(400)));
        assert_eq!(duration("1.5"), Ok(Duration::from_millis(1500)));
        assert_eq!(duration("2m"), Ok(Duration::from_mins(2)));
        for text in ["", "ms", "-1s", "3 weeks", "1e400", "nan"] {
            assert!(duration(text).is_err(), "{text}");
        }
    }

    #[test]
    fn channels_have_numbers_and_the_names_that_traces_give_them() {
        let numbers =
            |text| channels_of_one(text).map(|channels| channels.iter().map(Channel::number).collect());
        assert_eq!(numbers("2"), Ok(vec![2]));
        assert_eq!(numbers("both"), Ok(vec![1, 2]));
        assert_eq!(numbers("1,2"), Ok(vec![1, 2]));
        assert_eq!(numbers("can1"), Ok(vec![2]));
        assert_eq!(numbers("3"), Err("a device has channels 1 and 2, and no channel 3".to_owned()));
        for text in ["", "0", "1,", "33", "vcan0", "can", "-1"] {
            assert!(channels(text).unwrap_err().starts_with("channels are 1, 2"), "{text}");
        }
        assert_eq!((channel("1"), channel("can1")), (Ok(Channel::Can1), Ok(Channel::Can2)));
        assert!(channel("3").is_err() && channel("can2").is_err());
    }

    #[test]
    fn bit_rates_take_can_users_units() {
        for (text, bps) in [("500000", 500_000), ("500k", 500_000), ("83.333k", 83_333), ("1M", 1_000_000)] {
            assert_eq!(bitrate(text), Ok(bps), "{text}");
        }
        assert_eq!(
            bitrate("500").unwrap_err(),
            "500 bit/s is slower than any CAN bus; write 500k for 500 kbit/s"
        );
        for text in ["", "0", "fast", "-5", "1e3", "5G", "k", "1.2.3", "inf", "83.333"] {
            assert!(bitrate(text).is_err(), "{text}");
        }
    }
}
