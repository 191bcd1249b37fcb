//! A bit rate on the command line, for all channels or for one: `500k`, `2:250k`.

use std::str::FromStr;

use cantap_analysis::stats::Options;
use cantap_trace::grammar;

/// What is written for a bit rate that is to be found by listening: see [`crate::requested_rate`].
pub(crate) const AUTO: &str = "auto";

/// A bit rate, for one channel or for all that have none of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChannelBitrate {
    /// From 1.
    pub channel: Option<u8>,
    /// In bit/s.
    pub bitrate_bps: u32,
}

impl FromStr for ChannelBitrate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (channel, bitrate) = split(text)?;
        if bitrate == AUTO {
            return Err(
                "auto listens to a device, which is not possible here; give the bus's bit rate, such as 500k"
                    .to_owned(),
            );
        }
        Ok(Self { channel, bitrate_bps: grammar::bit_rate(bitrate)? })
    }
}

/// A channel, if one is named, and what is written for its bit rate.
pub(crate) fn split(text: &str) -> Result<(Option<u8>, &str), String> {
    let Some((channel, bitrate)) = text.split_once(':') else { return Ok((None, text)) };
    match grammar::channel(channel) {
        Some(channel) => Ok((Some(channel), bitrate)),
        None => Err("write it as BITRATE or CHANNEL:BITRATE, such as 500k or 2:250k".to_owned()),
    }
}

impl ChannelBitrate {
    /// The library's options with these bit rates.
    pub fn options(rates: &[Self]) -> Options {
        let own = rates.iter().rev().filter_map(|rate| Some((rate.channel?, rate.bitrate_bps)));
        let common = rates.iter().rev().find(|rate| rate.channel.is_none());
        Options {
            bitrate_bps: common.map(|rate| rate.bitrate_bps),
            channel_bitrate_bps: own.collect(),
            ..Options::default()
        }
    }

    /// The bit rate of a channel, from 1, in bit/s: its own, or the one for all.
    pub fn of(rates: &[Self], channel: u8) -> Option<u32> {
        Self::options(rates).bitrate_of(channel)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bit_rate_may_name_its_channel() {
        let parse = |text: &str| text.parse::<ChannelBitrate>().map(|rate| (rate.channel, rate.bitrate_bps));
        assert_eq!(parse("500k"), Ok((None, 500_000)));
        assert_eq!(parse("2:83.333k"), Ok((Some(2), 83_333)));
        assert_eq!(parse("can1:1M"), Ok((Some(2), 1_000_000)));
        for wrong in ["0:500k", "2:", "x:500k", "300:1M", "2:fast"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }
}
