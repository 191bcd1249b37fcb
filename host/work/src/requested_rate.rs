//! A bit rate that a user requests for opening channels: a number, or `auto`, which is found by listening.

use std::str::FromStr;

use crate::channel_bitrate::{AUTO, ChannelBitrate, split};

/// A bit rate, or the request to find it, for one channel or for all that have none of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RequestedRate {
    /// From 1.
    pub channel: Option<u8>,
    /// In bit/s; `None` if it is to be found by listening.
    pub bitrate_bps: Option<u32>,
}

impl From<ChannelBitrate> for RequestedRate {
    fn from(rate: ChannelBitrate) -> Self {
        Self { channel: rate.channel, bitrate_bps: Some(rate.bitrate_bps) }
    }
}

impl FromStr for RequestedRate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (channel, rate) = split(text)?;
        if rate == AUTO {
            return Ok(Self { channel, bitrate_bps: None });
        }
        let rate = text.parse::<ChannelBitrate>();
        rate.map(Self::from).map_err(|error| format!("{error}, or auto to find it by listening"))
    }
}

impl RequestedRate {
    /// The request for a channel, from 1: the last one of its own, otherwise the last one for all.
    pub fn of(rates: &[Self], channel: u8) -> Option<Self> {
        let last = |wanted: Option<u8>| rates.iter().rev().find(|rate| rate.channel == wanted).copied();
        last(Some(channel)).or_else(|| last(None))
    }

    /// Whether it is to be found by listening.
    pub const fn is_auto(&self) -> bool {
        self.bitrate_bps.is_none()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_may_be_left_to_be_found_for_all_channels_or_for_one() {
        let parse = |text: &str| text.parse::<RequestedRate>().map(|rate| (rate.channel, rate.bitrate_bps));
        assert_eq!(parse("auto"), Ok((None, None)));
        assert_eq!(parse("can1:auto"), Ok((Some(2), None)));
        assert_eq!(parse("2:250k"), Ok((Some(2), Some(250_000))));
        let error = parse("500").unwrap_err();
        assert!(
            error.contains("write 500k") && error.ends_with("or auto to find it by listening"),
            "{error}"
        );
        for text in ["0:auto", "x:auto", "automatic", ":auto", "auto:1"] {
            assert!(parse(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_channels_own_request_comes_before_the_one_for_all_and_the_last_one_counts() {
        let rates = ["auto", "2:250k", "500k", "2:auto"].map(|text| text.parse::<RequestedRate>().unwrap());
        let of = |channel| RequestedRate::of(&rates, channel).unwrap().bitrate_bps;
        assert_eq!((of(1), of(2), of(3)), (Some(500_000), None, Some(500_000)));
        assert_eq!(RequestedRate::of(&rates[1..2], 1), None);
    }
}
