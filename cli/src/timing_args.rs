//! How a user gives a bit timing: the options of every command that opens a channel.

use cantap::bit_timing::{self, TimingError};
use cantap::wire::BitTiming;
use cantap_work::advice;
use cantap_work::requested_rate::RequestedRate;
use cantap_work::timing_options::TimingOptions;

use crate::completion;

/// A bit timing on the command line; commands flatten this into their arguments.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct TimingArgs {
    /// Bit rate in bit/s: 500000, 500k, 1M; or auto, to find it by listening; with a channel before it (2:250k), only for that
    /// channel. Can be repeated.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE", add = completion::bit_rates())]
    bitrates: Vec<RequestedRate>,
    #[command(flatten)]
    preferences: Preferences,
    /// The whole timing, in quanta: prescaler, PROP+PS1, PS2, jump width.
    #[arg(long, value_name = "BRP,SEG1,SEG2,SJW", value_parser = bit_timing::parse_segments,
          conflicts_with_all = ["bitrates", "sample_point", "sjw", "btr"])]
    segments: Option<BitTiming>,
    /// The whole timing, as bxCAN's register CAN_BTR: 0x001C0008.
    #[arg(long, value_name = "REGISTER", value_parser = register,
          conflicts_with_all = ["bitrates", "sample_point", "sjw"])]
    btr: Option<BitTiming>,
}

/// What a timing should have besides its bit rate.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct Preferences {
    /// Sample point in per cent of the bit, instead of the one that CiA recommends.
    #[arg(long, value_name = "PCT", value_parser = percent)]
    pub sample_point: Option<f64>,
    /// Resynchronisation jump width in quanta, 1 to 4.
    #[arg(long, value_name = "QUANTA", value_parser = clap::value_parser!(u8).range(1..=4))]
    pub sjw: Option<u8>,
    /// Sample each bit three times: refused, since bxCAN cannot do this.
    #[arg(long)]
    triple: bool,
}

impl Preferences {
    /// Refuses what no timing can have.
    pub fn check(&self) -> Result<(), TimingError> {
        if self.triple { Err(TimingError::TripleSampling) } else { Ok(()) }
    }
}

impl TimingArgs {
    /// The first option that was given besides bit rates.
    pub fn given(&self) -> Option<&'static str> {
        let given = [
            (self.preferences.sample_point.is_some(), "--sample-point"),
            (self.preferences.sjw.is_some(), "--sjw"),
            (self.preferences.triple, "--triple"),
            (self.segments.is_some(), "--segments"),
            (self.btr.is_some(), "--btr"),
        ];
        given.into_iter().find_map(|(given, option)| given.then_some(option))
    }

    /// The same without clap.
    pub fn options(&self) -> TimingOptions {
        let Preferences { sample_point, sjw, triple } = self.preferences;
        TimingOptions {
            bitrates: self.bitrates.clone(),
            sample_point,
            sjw,
            triple,
            exact: self.segments.or(self.btr),
        }
    }
}

/// A register in C's notation or plain hexadecimal.
fn register(text: &str) -> Result<BitTiming, String> {
    let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")).unwrap_or(text);
    let plain = digits.bytes().all(|digit| digit.is_ascii_hexdigit());
    let value = u32::from_str_radix(digits, 16).ok().filter(|_| plain);
    let value = value.ok_or("write the register in hexadecimal, such as 0x001C0008")?;
    bit_timing::from_register(value).map_err(|error| advice::explained(&error))
}

/// A sample point.
pub fn percent(text: &str) -> Result<f64, String> {
    let value = text.strip_suffix('%').unwrap_or(text).parse::<f64>();
    value
        .ok()
        .filter(|value| (1.0..100.0).contains(value))
        .ok_or_else(|| "write the sample point in per cent of the bit, such as 80 or 87.5".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::Channel;
    use cantap::bit_timing::TimingRequest;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        timing: TimingArgs,
    }

    fn timing(line: &str) -> Result<Option<BitTiming>, String> {
        let line = Line::try_parse_from(std::iter::once("x").chain(line.split_whitespace()))
            .map_err(|error| error.to_string())?;
        let request = line.timing.options().request(Channel::Can1).map_err(|error| error.to_string())?;
        request.map(|request| request.resolve(36_000_000)).transpose().map_err(|error| error.to_string())
    }

    #[test]
    fn a_timing_is_given_by_rate_segments_or_register() {
        let expected = BitTiming { prescaler: 9, segment1: 13, segment2: 2, jump_width: 2 };
        for line in ["-b 250k", "--segments 9,13,2,2", "--btr 0x011C0008", "--btr 11c0008"] {
            assert_eq!(timing(line), Ok(Some(expected)), "{line}");
        }
        let narrow = BitTiming { jump_width: 1, ..expected };
        assert_eq!(timing("-b 250000 --sample-point 87.5 --sjw 1"), Ok(Some(narrow)));
        assert_eq!(timing(""), Ok(None));
    }

    #[test]
    fn a_channel_may_have_a_bit_rate_of_its_own() {
        let line = Line::try_parse_from("x -b 1M -b 2:250k".split(' ')).unwrap();
        let rate = |channel| match line.timing.options().request(channel).unwrap() {
            Some(TimingRequest::Rate { bitrate_bps, .. }) => bitrate_bps,
            other => panic!("{other:?}"),
        };
        assert_eq!((rate(Channel::Can1), rate(Channel::Can2)), (1_000_000, 250_000));
        // A wrong rate disturbs a bus: of two, none is taken.
        assert!(timing("-b 500k -b 2:250k -b 1M").is_err_and(|reason| reason.contains("500000")));
        let line = Line::try_parse_from("x -b 2:250k".split(' ')).unwrap();
        assert_eq!(line.timing.options().request(Channel::Can1).unwrap(), None);
    }

    #[test]
    fn contradictions_and_impossible_timings_are_refused() {
        for line in [
            "-b 250k --segments 9,13,2,2",
            "--btr 1 --segments 9,13,2,2",
            "--sjw 1",
            "--sample-point 80",
            "-b 250k --sjw 5",
            "-b 250k --sample-point 100",
            "-b 250k --triple",
            "--btr +1",
            "--btr 0x80000000",
            "-b 251000",
            "-b 500k -b 3:250k",
        ] {
            assert!(timing(line).is_err(), "{line}");
        }
    }
}
