//! Bit rates of an interface's channels: given, saved on the board, or found by listening.

use std::str::FromStr;
use std::time::Duration;

use cantap::Channel;
use cantap::autobaud::Limits;
use cantap_address::Address;

use crate::args;
use cantap_work::bit_rate_search::{self, Search};
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::interrupt;

/// The ones offered in a list; any other can be given, too.
pub const OFFERED: [(&str, &str); 12] = [
    ("1M", "1 Mbit/s"),
    ("800k", "800 kbit/s"),
    ("500k", "500 kbit/s"),
    ("250k", "250 kbit/s"),
    ("200k", "200 kbit/s"),
    ("125k", "125 kbit/s"),
    ("100k", "100 kbit/s"),
    ("83.333k", "83.333 kbit/s"),
    ("50k", "50 kbit/s"),
    ("33.333k", "33.333 kbit/s"),
    ("20k", "20 kbit/s"),
    ("10k", "10 kbit/s"),
];

/// The choice for one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BitRate {
    /// As saved on the board; otherwise found by listening.
    #[default]
    Auto,
    /// The channel is not captured.
    Off,
    /// In bit/s.
    Given(u32),
}

impl FromStr for BitRate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "auto" => Ok(Self::Auto),
            "off" => Ok(Self::Off),
            rate => args::bitrate(rate).map(Self::Given).map_err(|error| {
                format!("{error}; or write auto, or off for a channel that is not captured")
            }),
        }
    }
}

/// How long to wait for a silent channel if another one can be captured: Wireshark shows nothing meanwhile.
const PATIENCE_BESIDE: Duration = Duration::from_secs(3);

/// Determines the channels to capture, by number, and the bit rates that must be given for them. Reports progress. A silent
/// channel is left out if there is traffic on another one.
pub fn settle(
    wanted: [BitRate; 2],
    address: &Address,
    report: &mut dyn FnMut(&str),
) -> anyhow::Result<(Vec<u8>, Vec<ChannelBitrate>)> {
    let mut channels = Vec::new();
    let mut rates = Vec::new();
    let mut reasons = Vec::new();
    // Opened only if it has to be asked.
    let mut device = None;
    for (channel, wanted) in Channel::ALL.into_iter().zip(wanted) {
        let number = channel.number();
        let rate = |bitrate_bps| ChannelBitrate { channel: Some(number), bitrate_bps };
        match wanted {
            BitRate::Off => continue,
            BitRate::Given(bitrate_bps) => rates.push(rate(bitrate_bps)),
            BitRate::Auto if address.has_bit_rate() => {}
            BitRate::Auto if address.bitrates_of_buses()[channel.index()].is_some() => {}
            BitRate::Auto => {
                let device = match &device {
                    Some(device) => device,
                    None => device.insert(address.open()?),
                };
                if device.defaults(channel)?.is_none() {
                    report(&format!("channel {number}: listening for its bit rate"));
                    let mut limits = Limits::default();
                    if !channels.is_empty() {
                        limits.silence = PATIENCE_BESIDE;
                    }
                    let found =
                        bit_rate_search::search(device, channel, &limits, &mut |_| !interrupt::requested())?;
                    match (found.bitrate_bps(), found) {
                        (Some(bitrate_bps), _) | (None, Search::Confirmed { bitrate_bps }) => {
                            report(&format!("channel {number}: {bitrate_bps} bit/s found"));
                            rates.push(rate(bitrate_bps));
                        }
                        (None, Search::Measured(outcome)) => {
                            let seconds = limits.silence.as_secs_f64();
                            let reason = bit_rate_search::failure(outcome, number, seconds);
                            report(&format!("{reason}; it is not captured"));
                            reasons.push(reason);
                            continue;
                        }
                    }
                }
            }
        }
        channels.push(number);
    }
    if channels.is_empty() {
        anyhow::bail!(if reasons.is_empty() {
            "both channels are off; choose a bit rate for one of them".to_owned()
        } else {
            format!("{}; choose the bit rate in the interface's options", reasons.join("; "))
        });
    }
    Ok((channels, rates))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bit_rate_is_a_number_or_where_to_get_one() {
        assert_eq!("83.333k".parse(), Ok(BitRate::Given(83_333)));
        assert_eq!("auto".parse(), Ok(BitRate::Auto));
        assert_eq!("off".parse(), Ok(BitRate::Off));
        assert!("fast".parse::<BitRate>().unwrap_err().contains("auto"));
        for (offered, _) in OFFERED {
            assert!(matches!(offered.parse(), Ok(BitRate::Given(_))), "{offered}");
        }
    }

    #[test]
    fn what_is_off_is_left_out_and_a_virtual_bus_needs_no_search() {
        let address: Address = "virtual".parse().unwrap();
        let settle = |wanted| settle(wanted, &address, &mut |text| panic!("{text}"));
        let (channels, rates) = settle([BitRate::Auto, BitRate::Given(250_000)]).unwrap();
        assert_eq!(channels, [1, 2]);
        assert_eq!(rates, [ChannelBitrate { channel: Some(2), bitrate_bps: 250_000 }]);
        assert_eq!(settle([BitRate::Off, BitRate::Auto]).unwrap().0, [2]);
        assert!(settle([BitRate::Off; 2]).unwrap_err().to_string().contains("both channels are off"));
    }
}
