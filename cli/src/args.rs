//! Command-line values that several commands have in common.

use std::path::Path;
use std::time::Duration;

use cantap::Channel;
use cantap_address::Address;
use cantap_trace::grammar;
use cantap_work::channels::{Channels, channel_number};

pub use cantap_trace::grammar::{bit_rate as bitrate, duration, per_second, positive_duration};

/// In milliseconds: a plain number as in can-utils, or a time with its unit.
pub fn milliseconds(text: &str) -> Result<f64, String> {
    let plain = text.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    let value = match text.parse::<f64>() {
        Ok(ms) if plain => Some(ms),
        _ => duration(text).ok().map(|time| time.as_secs_f64() * 1e3),
    };
    value.filter(|ms| (0.0..=3_600_000.0).contains(ms)).ok_or_else(|| {
        "write milliseconds, such as 200 or 0.5, or a time with its unit, such as 1ms or 2s".to_owned()
    })
}

/// A node or an address: in decimal digits, or after `0x` in hexadecimal ones.
pub fn byte(text: &str) -> Option<u8> {
    match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(digits) => u8::from_str_radix(digits, 16).ok().filter(|_| !digits.starts_with('+')),
        None => text.parse().ok().filter(|_| !text.starts_with('+')),
    }
}

/// In nanoseconds, bounded so that deadlines can be added to it.
pub fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX).min(u64::MAX / 4)
}

/// See [`Channels`].
pub fn channels(text: &str) -> Result<Channels, String> {
    if matches!(text, "both" | "all") {
        return Ok(Channels::all());
    }
    let numbers = text.split(',').map(channel_number).collect::<Option<Vec<_>>>();
    numbers.map(Channels::of_numbers).ok_or_else(|| {
        in_place_of_channel(text).unwrap_or_else(|| {
            "channels are 1, 2, several as 1,3, or both; a second device has 3 and 4, and can0 in a trace is channel 1"
                .to_owned()
        })
    })
}

/// Like [`channels`], for a trace, which may have more channels than any device.
pub fn channels_of_trace(text: &str) -> Result<Channels, String> {
    if matches!(text, "both" | "all") {
        return Ok(Channels::all());
    }
    text.split(',').map(channel_of_trace).collect::<Result<_, _>>().map(Channels::of_numbers)
}

/// Like [`channels`], for one device.
pub fn channels_of_one(text: &str) -> Result<Channels, String> {
    let channels = channels(text)?;
    channels.check(1).map_err(|error| error.to_string())?;
    Ok(channels)
}

/// A channel of a trace, which may have more channels than any device: as `1`, or as an interface, `can0`.
pub fn channel_of_trace(text: &str) -> Result<u8, String> {
    grammar::channel(text).ok_or_else(|| {
        "a trace's channels are 1, 2 and so on up to 255, several as 1,3; can0 is channel 1".to_owned()
    })
}

/// What to write if a device stands where a channel should; can2 is an interface, too, and here a channel that there is not.
pub fn in_place_of_channel(text: &str) -> Option<String> {
    let is_device = grammar::channel(text).is_none() && Address::is_meant_by(Path::new(text));
    is_device.then(|| format!("a device is given with -d, as in: -d {text}"))
}

/// One channel of a device, as `1`, `2`, or as an interface: `can0` is channel 1, as in every trace.
pub fn channel(text: &str) -> Result<Channel, String> {
    let found = channel_number(text)
        .and_then(|number| Channel::ALL.into_iter().find(|channel| channel.number() == number));
    found.ok_or_else(|| "a channel is 1 or 2; can0 is channel 1, can1 is channel 2".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_milliseconds_unless_they_have_a_unit() {
        for (text, ms) in
            [("200", 200.0), ("0.5", 0.5), ("1ms", 1.0), ("2s", 2000.0), ("100us", 0.1), ("0", 0.0)]
        {
            assert!((milliseconds(text).unwrap() - ms).abs() < 1e-9, "{text}");
        }
        for text in ["", "-1", "fast", "inf", "2h"] {
            assert!(milliseconds(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_node_is_written_in_either_base() {
        assert_eq!(["5", "0x05", "0x7F", "0XfE", "253"].map(byte).map(Option::unwrap), [5, 5, 127, 254, 253]);
        for text in ["", "0x", "+5", "0x+5", "256", "0x100", "7F", "-1"] {
            assert_eq!(byte(text), None, "{text}");
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
        assert_eq!(numbers("vcan1"), Ok(vec![2]));
        for text in ["", "0", "1,", "33", "xcan0", "can", "-1"] {
            assert!(channels(text).unwrap_err().starts_with("channels are 1, 2"), "{text}");
        }
        assert_eq!((channel("1"), channel("can1")), (Ok(Channel::Can1), Ok(Channel::Can2)));
        assert!(channel("3").is_err() && channel("can2").is_err());
    }
}
