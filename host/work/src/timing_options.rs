//! How a channel's bit timing is chosen: by bit rate, with wishes, or as a whole.

use cantap::Channel;
use cantap::bit_timing::{TimingError, TimingRequest};
use cantap::wire::{BitTiming, CHANNELS};

use crate::channel_bitrate::{AUTO, ChannelBitrate};
use crate::channels::{MOST_CHANNELS, place_of};
use crate::requested_rate::RequestedRate;

/// A bit timing, as far as it is given.
#[derive(Clone, Debug, Default)]
pub struct TimingOptions {
    /// Bit rates, at most one for a channel and one for all others.
    pub bitrates: Vec<RequestedRate>,
    /// The sample point in per cent of the bit, instead of the one that CiA recommends.
    pub sample_point: Option<f64>,
    /// Resynchronisation jump width in quanta, 1 to 4.
    pub sjw: Option<u8>,
    /// Sample each bit three times: refused, since bxCAN cannot do this.
    pub triple: bool,
    /// The whole timing, which leaves no wishes.
    pub exact: Option<BitTiming>,
}

/// A timing that cannot be requested.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TimingOptionsError {
    /// A bit rate for a channel that the only device does not have.
    #[error("a device has no channel {number}; give a bit rate for channel 1 or 2, as -b 2:250k")]
    NoChannel {
        /// From 1.
        number: u8,
    },
    /// A bit rate for a channel that none of several devices has.
    #[error(
        "{boards} devices have no channel {number}; give a bit rate for channels 1 to {count}, as -b 2:250k"
    )]
    NoChannelOfSeveral {
        /// How many devices there are.
        boards: usize,
        /// How many channels they have.
        count: usize,
        /// From 1.
        number: u8,
    },
    /// Different bit rates for the same channel, or for all: whoever means one for each would take part in a bus at the wrong one.
    #[error(
        "two bit rates for {of}, {first} and {second}; one for each channel is written -b 1:{first} -b 2:{second}"
    )]
    Twice {
        /// Which channel.
        of: String,
        /// What was requested first.
        first: String,
        /// What was requested then.
        second: String,
    },
    /// A sample point or a jump width, and no bit rate.
    #[error("a sample point or jump width needs a bit rate; add -b RATE")]
    NoBitRate,
    /// The controller cannot have it.
    #[error(transparent)]
    Timing(#[from] TimingError),
}

impl TimingOptions {
    /// Whether any timing was given.
    pub fn is_given(&self) -> bool {
        !self.bitrates.is_empty() || self.exact.is_some()
    }

    /// Whether anything was given, even if only a sample point or a jump width.
    pub fn is_given_in_part(&self) -> bool {
        self.is_given() || self.sample_point.is_some() || self.sjw.is_some() || self.triple
    }

    /// Requests these bit rates instead of any other timing.
    pub fn set_bit_rates(&mut self, rates: impl IntoIterator<Item = impl Into<RequestedRate>>) {
        self.exact = None;
        self.bitrates = rates.into_iter().map(Into::into).collect();
    }

    /// Requests a bit rate for one channel, from 1, instead of any other timing; the other channels keep theirs.
    pub fn set_bit_rate_of(&mut self, rate: RequestedRate) {
        self.exact = None;
        self.bitrates.retain(|before| before.channel != rate.channel);
        self.bitrates.push(rate);
    }

    /// Whether any bit rate is to be found by listening.
    pub fn has_auto(&self) -> bool {
        self.bitrates.iter().any(RequestedRate::is_auto)
    }

    /// Whether a channel's bit rate, from 1, is to be found by listening.
    pub fn is_auto(&self, channel: u8) -> bool {
        RequestedRate::of(&self.bitrates, channel).is_some_and(|rate| rate.is_auto())
    }

    /// The bit rates that are numbers. A channel whose bit rate is to be found has none.
    pub fn known(&self) -> Vec<ChannelBitrate> {
        let number = |rate: RequestedRate| {
            Some(ChannelBitrate { channel: rate.channel, bitrate_bps: rate.bitrate_bps? })
        };
        if !self.has_auto() {
            return self.bitrates.iter().copied().filter_map(number).collect();
        }
        // The one for all channels does not concern those that are to be found.
        let of = |channel| {
            number(RequestedRate { channel: Some(channel), ..RequestedRate::of(&self.bitrates, channel)? })
        };
        (1..=MOST_CHANNELS).filter_map(of).collect()
    }

    /// Refuses bit rates of channels that this number of boards does not have, and different ones for the same channel.
    pub fn check_channels(&self, boards: usize) -> Result<(), TimingOptionsError> {
        for (place, rate) in self.bitrates.iter().enumerate() {
            let same = |other: &&RequestedRate| other.channel == rate.channel && *other != rate;
            let Some(second) = self.bitrates[place..].iter().find(same) else { continue };
            let text = |rate: &RequestedRate| {
                rate.bitrate_bps.map_or_else(|| AUTO.to_owned(), |bitrate_bps| bitrate_bps.to_string())
            };
            let of =
                rate.channel.map_or_else(|| "all channels".to_owned(), |number| format!("channel {number}"));
            return Err(TimingOptionsError::Twice { of, first: text(rate), second: text(second) });
        }
        let count = boards * CHANNELS;
        let named = self.bitrates.iter().filter_map(|rate| rate.channel);
        let Some(number) = named.into_iter().find(|number| usize::from(*number) > count) else {
            return Ok(());
        };
        Err(match boards {
            1 => TimingOptionsError::NoChannel { number },
            _ => TimingOptionsError::NoChannelOfSeveral { boards, count, number },
        })
    }

    /// The part for one of several boards, counted from 0, whose channels have their own numbers there.
    #[must_use]
    pub fn on_board(&self, board: usize) -> Self {
        let own = |rate: &RequestedRate| match rate.channel.map(place_of) {
            None => Some(*rate),
            Some((place, channel)) if place == board => {
                Some(RequestedRate { channel: Some(channel.number()), ..*rate })
            }
            Some(_) => None,
        };
        Self { bitrates: self.bitrates.iter().filter_map(own).collect(), ..self.clone() }
    }

    /// The request for a channel, if any; of one whose bit rate is to be found, `found_bps` is what was found, in bit/s.
    pub fn request_with(
        &self,
        channel: Channel,
        found_bps: Option<u32>,
    ) -> Result<Option<TimingRequest>, TimingOptionsError> {
        let Some(bitrate_bps) = found_bps.filter(|_| self.is_auto(channel.number())) else {
            return self.request(channel);
        };
        let Self { sample_point, sjw, .. } = *self;
        Ok(Some(TimingRequest::Rate { bitrate_bps, sample_point_percent: sample_point, sjw }))
    }

    /// The request for a channel, if any; none if its bit rate is to be found.
    pub fn request(&self, channel: Channel) -> Result<Option<TimingRequest>, TimingOptionsError> {
        if self.triple {
            return Err(TimingError::TripleSampling.into());
        }
        self.check_channels(1)?;
        if let Some(timing) = self.exact {
            return Ok(Some(TimingRequest::Exact(timing)));
        }
        let Self { sample_point, sjw, .. } = *self;
        if self.is_auto(channel.number()) {
            return Ok(None);
        }
        match RequestedRate::of(&self.bitrates, channel.number()).and_then(|rate| rate.bitrate_bps) {
            Some(bitrate_bps) => {
                Ok(Some(TimingRequest::Rate { bitrate_bps, sample_point_percent: sample_point, sjw }))
            }
            None if sample_point.is_some() || sjw.is_some() => Err(TimingOptionsError::NoBitRate),
            None => Ok(None),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Found as a newcomer: the last one counted, and the first channel took part at the second one's bit rate.
    #[test]
    fn two_bit_rates_for_the_same_channels_are_refused() {
        let check = |texts: &[&str]| {
            let bitrates = texts.iter().map(|text| text.parse().unwrap()).collect();
            let options = TimingOptions { bitrates, ..TimingOptions::default() };
            options.check_channels(1).map_err(|error| error.to_string())
        };
        assert_eq!(
            check(&["500k", "250k"]),
            Err("two bit rates for all channels, 500000 and 250000; one for each channel is written -b 1:500000 -b 2:250000"
                .to_owned())
        );
        assert!(
            check(&["2:auto", "500k", "2:250k"])
                .unwrap_err()
                .starts_with("two bit rates for channel 2, auto and 250000")
        );
        for fine in
            [&["500k"][..], &["500k", "2:250k"], &["1:500k", "2:250k"], &["500k", "500k"], &["auto", "2:1M"]]
        {
            assert_eq!(check(fine), Ok(()), "{fine:?}");
        }
    }
}
