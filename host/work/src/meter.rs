//! The figures for a channel in a capture's summary.

use cantap::wire::message::ChannelConfig;
use cantap::{TraceEvent, TraceRecord};
use cantap_analysis::stats::WorkLoad;

/// Counts one channel's frames as they are delivered.
pub struct Meter {
    frames: u64,
    lost: u64,
    lost_at_least: bool,
    bus_errors: u64,
    /// Time of the last frame, if nothing lies between it and the next.
    latest_ns: Option<i64>,
    /// The sum of the times from one frame to the next, and their number.
    covered_ns: i64,
    intervals: u64,
    load: WorkLoad,
    omits_data: bool,
    omits_stamps: bool,
    without_data: u64,
    /// A filter keeps frames back in the device.
    is_filtered: bool,
    bitrate_bps: u32,
    /// Of data phases, if known.
    data_bitrate_bps: Option<u32>,
    /// Frames that switched to a bit rate that is not known.
    of_unknown_length: u64,
}

impl Meter {
    /// Nothing has been delivered yet, for a channel that streams everything. A bit rate of 0 is not known.
    pub fn new(bitrate_bps: u32) -> Self {
        Self {
            frames: 0,
            lost: 0,
            lost_at_least: false,
            bus_errors: 0,
            latest_ns: None,
            covered_ns: 0,
            intervals: 0,
            load: WorkLoad::new(bitrate_bps),
            omits_data: false,
            omits_stamps: false,
            without_data: 0,
            is_filtered: false,
            bitrate_bps,
            data_bitrate_bps: None,
            of_unknown_length: 0,
        }
    }

    /// Nothing has been delivered yet, for a channel opened in this way.
    pub fn of(config: &ChannelConfig, can_clock_hz: u32) -> Self {
        Self {
            omits_data: config.omit_data,
            omits_stamps: config.omit_stamps,
            ..Self::new(config.timing.bitrate_bps(can_clock_hz))
        }
    }

    /// Of a channel of which only some frames arrive, because the device has a filter: what they are of the bus's load is not its load.
    #[must_use]
    pub fn filtered(self) -> Self {
        Self { is_filtered: true, ..self }
    }

    /// With the bit rate of the bus's data phases, in bit/s, if it is known.
    #[must_use]
    pub fn with_data_bitrate(self, data_bitrate_bps: Option<u32>) -> Self {
        Self { data_bitrate_bps, ..self }
    }

    /// Takes the channel's next record, if it is not wanted: it loads the bus all the same.
    pub fn pass_by(&mut self, record: &TraceRecord) {
        match &record.event {
            TraceEvent::Frame { frame, .. } => {
                self.without_data += u64::from(self.omits_data && frame.data_len() > 0);
                let bits = frame.bus_bits();
                let data = match self.data_bitrate_bps {
                    Some(rate) => f64::from(bits.data) * f64::from(self.bitrate_bps) / f64::from(rate.max(1)),
                    None => 0.0,
                };
                self.of_unknown_length += u64::from(bits.data > 0 && self.data_bitrate_bps.is_none());
                self.load.frame(record.time_ns, f64::from(bits.nominal) + data);
            }
            TraceEvent::Lost { .. } => self.load.gap(),
            _ => {}
        }
    }

    /// Takes the channel's next record.
    pub fn push(&mut self, record: &TraceRecord) {
        match &record.event {
            TraceEvent::Frame { .. } => {
                self.frames += 1;
                if let Some(latest_ns) = self.latest_ns.replace(record.time_ns) {
                    self.covered_ns += record.time_ns - latest_ns;
                    self.intervals += 1;
                }
                self.pass_by(record);
            }
            event if *event == TraceEvent::GAP => {
                self.lost_at_least = true;
                self.latest_ns = None;
                self.load.gap();
            }
            TraceEvent::Lost { count, at_least, .. } => {
                self.lost += u64::from(*count);
                self.lost_at_least |= at_least;
                // The rate is over the same time as the load.
                self.latest_ns = None;
                self.load.gap();
            }
            TraceEvent::BusError { .. } => self.bus_errors += 1,
            TraceEvent::ErrorsSuppressed { count } => self.bus_errors += u64::from(*count),
            TraceEvent::State { .. }
            | TraceEvent::TransmitFailed { .. }
            | TraceEvent::Disturbed { .. }
            | TraceEvent::Lin { .. } => {}
        }
    }

    /// Frames delivered.
    pub const fn frames(&self) -> u64 {
        self.frames
    }

    /// Frames lost.
    pub const fn lost(&self) -> u64 {
        self.lost
    }

    /// Whether there may be more: an overrun of the controller cannot be counted, nor what is on the bus while the device is not.
    pub const fn lost_at_least(&self) -> bool {
        self.lost_at_least
    }

    /// Bus errors, including those only counted.
    pub const fn bus_errors(&self) -> u64 {
        self.bus_errors
    }

    /// From the first frame to the last, in seconds, excluding times from which frames are missing.
    pub fn seconds(&self) -> f64 {
        self.covered_ns as f64 / 1e9
    }

    /// Delivered frames per second, over [`Self::seconds`]; `None` if frames came without times.
    pub fn frames_per_s(&self) -> Option<f64> {
        let seconds = self.seconds();
        let rate = if seconds > 0.0 { self.intervals as f64 / seconds } else { 0.0 };
        (!self.omits_stamps).then_some(rate)
    }

    /// Bus load in per cent, from exact lengths, over the intervals without a loss; `None` if it is unknown.
    pub fn bus_load_pct(&self) -> Option<f64> {
        self.no_bus_load_because().is_none().then(|| self.load.mean_pct().unwrap_or(0.0))
    }

    /// Why the bus load is unknown, if it is.
    pub const fn no_bus_load_because(&self) -> Option<&'static str> {
        if self.is_filtered {
            Some("the device's filters keep frames back")
        } else if self.omits_stamps {
            Some("frames come without times")
        } else if self.without_data > 0 {
            // Stuff bits depend on them.
            Some("frames come without data")
        } else if self.bitrate_bps == 0 {
            Some("the bit rate is not known: give it with -b")
        } else if self.of_unknown_length > 0 {
            Some("frames switch to a data bit rate that is not known")
        } else {
            None
        }
    }
}

/// For people: with as many decimals as are meaningful.
pub fn rounded(value: f64, decimals: i32) -> f64 {
    let factor = 10_f64.powi(decimals);
    (value * factor).round() / factor
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::Direction;
    use cantap::wire::{BitTiming, Frame};

    fn meter(change: impl FnOnce(&mut ChannelConfig), frames: &[&str]) -> Meter {
        let timing = BitTiming::choose(36_000_000, 500_000, None).unwrap();
        let mut config = ChannelConfig::listen_only(timing);
        change(&mut config);
        let mut meter = Meter::of(&config, 36_000_000);
        for (at, text) in frames.iter().enumerate() {
            let frame: Frame = text.parse().unwrap();
            let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
            meter.push(&TraceRecord { time_ns: at as i64 * 1_000_000, device_ns: None, channel: 1, event });
        }
        meter
    }

    #[test]
    fn errors_are_those_reported_and_those_only_counted() {
        let mut meter = meter(|_| {}, &[]);
        for event in [
            TraceEvent::BusError { kind: None, counters: None },
            TraceEvent::ErrorsSuppressed { count: 40 },
            TraceEvent::ErrorsSuppressed { count: u32::MAX },
        ] {
            meter.push(&TraceRecord { time_ns: 0, device_ns: None, channel: 1, event });
        }
        assert_eq!((meter.bus_errors(), meter.frames()), (41 + u64::from(u32::MAX), 0));
    }

    #[test]
    fn no_load_is_told_where_data_is_not_known() {
        let data = ["123#0000", "123#R", "123#"];
        let with = meter(|_| {}, &data);
        assert!(with.without_data == 0 && with.bus_load_pct() > Some(0.0));
        let without = meter(|config| config.omit_data = true, &data);
        assert_eq!((without.without_data, without.bus_load_pct()), (1, None));
        assert_eq!(without.frames_per_s(), Some(1000.0));
        // A channel without data does not lack them.
        let without = meter(|config| config.omit_data = true, &data[1..]);
        assert!(without.without_data == 0 && without.bus_load_pct() > Some(0.0));
    }

    #[test]
    fn without_a_bit_rate_the_rest_is_known() {
        let meter = meter(|config| config.timing = BitTiming::UNKNOWN, &["123#0011", "123#0011"]);
        let reason = "the bit rate is not known: give it with -b";
        assert_eq!((meter.bus_load_pct(), meter.no_bus_load_because()), (None, Some(reason)));
        assert_eq!((meter.frames(), meter.frames_per_s()), (2, Some(1000.0)));
    }

    #[test]
    fn the_load_of_frames_that_switch_their_bit_rate_is_exact_or_unknown() {
        let switched: cantap::TraceFrame = "123##1112233445566778899AABBCC".parse().unwrap();
        let event = TraceEvent::Frame { frame: switched, direction: Direction::Rx, late: false };
        let load = |data_bitrate_bps| {
            let mut meter = meter(|_| {}, &[]).with_data_bitrate(data_bitrate_bps);
            (0..3).for_each(|at| {
                meter.push(&TraceRecord { time_ns: at * 1_000_000, device_ns: None, channel: 1, event });
            });
            (meter.bus_load_pct(), meter.no_bus_load_because())
        };
        let bits = switched.bus_bits();
        let busy_us = f64::from(bits.nominal) * 2.0 + f64::from(bits.data) * 0.5;
        let (Some(load_pct), None) = load(Some(2_000_000)) else { panic!("no load") };
        assert!((load_pct - busy_us / 10.0).abs() < 1e-9, "{load_pct}");
        assert_eq!(load(None), (None, Some("frames switch to a data bit rate that is not known")));
    }

    /// A stopped computer, for example: the bus was not empty meanwhile.
    #[test]
    fn rate_and_load_are_over_the_same_time_where_frames_were_lost() {
        let mut meter = meter(|_| {}, &["123#0011", "123#0011", "123#0011"]);
        let before = (meter.frames_per_s(), meter.bus_load_pct());
        let record = |time_ns, event| TraceRecord { time_ns, device_ns: None, channel: 1, event };
        meter.push(&record(60_000_000_000, TraceEvent::Lost { stage: None, count: 60_000, at_least: false }));
        for ms in [60_000, 60_001] {
            let frame: Frame = "123#0011".parse().unwrap();
            let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
            meter.push(&record(ms * 1_000_000, event));
        }
        assert_eq!((meter.frames(), meter.lost()), (5, 60_000));
        assert_eq!((meter.frames_per_s(), meter.bus_load_pct()), before);
    }

    #[test]
    fn the_load_is_the_bus_s_whatever_is_wanted_of_it() {
        let all = meter(|_| {}, &["123#0011"; 8]);
        let mut some = meter(|_| {}, &[]);
        for at in 0..8 {
            let frame: Frame = "123#0011".parse().unwrap();
            let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
            let record = TraceRecord { time_ns: at * 1_000_000, device_ns: None, channel: 1, event };
            if at % 4 == 0 { some.push(&record) } else { some.pass_by(&record) }
        }
        assert_eq!((some.frames(), some.frames_per_s()), (2, Some(250.0)));
        assert_eq!(some.bus_load_pct(), all.bus_load_pct());
        let filtered = some.filtered();
        assert_eq!(filtered.bus_load_pct(), None);
        assert_eq!(filtered.no_bus_load_because(), Some("the device's filters keep frames back"));
    }

    #[test]
    fn neither_rate_nor_load_is_told_where_times_are_not_known() {
        let meter = meter(|config| config.omit_stamps = true, &["123#00", "123#00"]);
        assert_eq!((meter.frames(), meter.frames_per_s(), meter.bus_load_pct()), (2, None, None));
    }
}
