//! Collects pictures from a stream of records: signals, bus load, periods. Memory does not grow with the
//! trace.

mod load;
mod named;
mod signals;
mod timing;

pub use load::LoadCollector;
pub use named::NamedValue;
pub use signals::{MOST_CURVES, SignalCollector};
pub use timing::TimingCollector;

use std::collections::HashMap;

use super::{Axis, Gap};
use cantap_trace::{TraceEvent, TraceRecord};

/// How many gaps are kept individually. After that, the last one is extended.
const MOST_GAPS: usize = 2000;

/// The horizontal axis of a trace: seconds since its first record.
#[derive(Clone, Debug, Default)]
struct TimeAxis {
    first_ns: Option<i64>,
}

impl TimeAxis {
    fn seconds(&mut self, time_ns: i64) -> f64 {
        let first = *self.first_ns.get_or_insert(time_ns);
        time_ns.saturating_sub(first) as f64 / 1e9
    }

    fn axis(&self) -> Axis {
        // In the form of candump's logs, so that a place in the picture can be found in the file.
        let first = self.first_ns.unwrap_or(0);
        let zero = if first == 0 {
            String::new()
        } else {
            let (sign, size) = (if first < 0 { "-" } else { "" }, first.unsigned_abs());
            format!("{sign}{}.{:06}", size / 1_000_000_000, size % 1_000_000_000 / 1000)
        };
        Axis::Time { zero }
    }
}

/// Where frames are missing, per channel.
#[derive(Clone, Debug, Default)]
struct Gaps {
    gaps: Vec<Gap>,
    channels: HashMap<u8, ChannelGap>,
}

#[derive(Clone, Debug, Default)]
struct ChannelGap {
    last_frame: Option<f64>,
    lost: u64,
}

impl Gaps {
    /// Takes a record; returns whether it is a loss.
    fn push(&mut self, record: &TraceRecord, x: f64) -> bool {
        let channel = self.channels.entry(record.channel).or_default();
        match record.event {
            TraceEvent::Lost { count, .. } => {
                channel.lost += u64::from(count);
                true
            }
            TraceEvent::Frame { .. } => {
                let before = channel.last_frame.replace(x).unwrap_or(x);
                let frames = std::mem::take(&mut channel.lost);
                if frames > 0 {
                    // A trace's clock may be set back.
                    self.add(Gap { from: before.min(x), to: before.max(x), frames });
                }
                false
            }
            _ => false,
        }
    }

    fn add(&mut self, gap: Gap) {
        let full = self.gaps.len() >= MOST_GAPS;
        match self.gaps.last_mut() {
            Some(last) if full => {
                last.to = last.to.max(gap.to);
                last.frames += gap.frames;
            }
            _ => self.gaps.push(gap),
        }
    }

    /// The gaps, including those that extend to the trace's end.
    fn finish(mut self, end: f64) -> Vec<Gap> {
        for channel in std::mem::take(&mut self.channels).into_values().filter(|channel| channel.lost > 0) {
            let from = channel.last_frame.unwrap_or(end);
            self.add(Gap { from, to: end, frames: channel.lost });
        }
        self.gaps
    }
}

#[cfg(test)]
mod tests {
    use super::{Axis, TimeAxis};

    /// The seconds were those of the second before.
    #[test]
    fn a_zero_before_the_epoch_is_the_time_in_the_file() {
        for (first_ns, zero) in
            [(-1_500_000_000, "-1.500000"), (-250_000_000, "-0.250000"), (1_250_000_000, "1.250000")]
        {
            assert_eq!(TimeAxis { first_ns: Some(first_ns) }.axis(), Axis::Time { zero: zero.to_owned() });
        }
    }
}

#[cfg(test)]
mod testing {
    use super::*;
    use cantap_trace::Direction;

    pub(super) fn frame(time_ms: i64, text: &str) -> TraceRecord {
        let frame = text.parse().unwrap();
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        TraceRecord { time_ns: time_ms * 1_000_000, device_ns: None, channel: 1, event }
    }

    pub(super) fn lost(time_ms: i64, count: u32) -> TraceRecord {
        let event = TraceEvent::Lost { stage: None, count, at_least: false };
        TraceRecord { event, ..frame(time_ms, "000#") }
    }
}
