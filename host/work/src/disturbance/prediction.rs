//! When a periodic frame will be on the bus, from the times of the last ones.

use std::collections::VecDeque;

use anyhow::bail;
use cantap::{Id, TraceRecord};

/// Frames from which a period is taken, and the least number.
const KEPT: usize = 9;
const LEAST: usize = 4;

/// A frame that is to come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expected {
    pub id: Id,
    /// When it will be half over, and over.
    pub middle_ns: i64,
    /// See above.
    pub end_ns: i64,
}

/// The frames of one identifier so far.
pub struct Prediction {
    id: Id,
    channel: u8,
    /// When the last ones ended.
    ends_ns: VecDeque<i64>,
    /// How many there have been.
    seen: u64,
    /// Bits of the last one.
    bits: u32,
    /// Nanoseconds of a bit.
    bit_ns: u64,
}

impl Prediction {
    /// None yet.
    pub fn new(id: Id, channel: u8, bit_ns: u64) -> Self {
        Self { id, channel, ends_ns: VecDeque::new(), seen: 0, bits: 0, bit_ns }
    }

    /// Takes the next record.
    pub fn take(&mut self, record: &TraceRecord) {
        let Some(frame) = record.frame().filter(|frame| frame.id() == self.id) else { return };
        if record.channel != self.channel {
            return;
        }
        self.seen += 1;
        self.bits = frame.bus_bits().nominal;
        self.ends_ns.push_back(record.time_ns);
        if self.ends_ns.len() > KEPT {
            self.ends_ns.pop_front();
        }
    }

    /// The `nth` frame, or the first that begins no sooner than `soonest_ns`; `None` as long as it cannot be predicted.
    ///
    /// # Errors
    ///
    /// If it never can: it is over, or too near, or the frames are not periodic.
    pub fn next(&self, nth: Option<u64>, soonest_ns: i64) -> anyhow::Result<Option<Expected>> {
        let length_ns = i64::from(self.bits) * self.bit_ns as i64;
        let Some(last_ns) = self.ends_ns.back().copied().filter(|_| self.ends_ns.len() >= LEAST) else {
            return Ok(None);
        };
        let mut gaps: Vec<i64> =
            self.ends_ns.iter().zip(self.ends_ns.iter().skip(1)).map(|(a, b)| b - a).collect();
        gaps.sort_unstable();
        let period_ns = gaps[gaps.len() / 2].max(1);
        // One that was disturbed comes late, and the next early: the rest must agree.
        let spread_ns = gaps[gaps.len() - 2] - gaps[1];
        if self.ends_ns.len() == KEPT && spread_ns > length_ns {
            bail!(
                "frames of {} come at intervals from {:.3} to {:.3} ms: their times cannot be predicted to within their length, {:.3} ms",
                self.id,
                gaps[1] as f64 / 1e6,
                gaps[gaps.len() - 2] as f64 / 1e6,
                length_ns as f64 / 1e6
            );
        }
        let start_ns = |periods: i64| last_ns + periods * period_ns - length_ns;
        let periods = match nth {
            Some(nth) if nth <= self.seen => {
                bail!("frame {nth} of {} is over: choose --nth at least {}", self.id, self.seen + 2);
            }
            Some(nth) => {
                let periods = (nth - self.seen) as i64;
                if start_ns(periods) < soonest_ns {
                    bail!("frame {nth} of {} comes too soon: choose --nth at least {}", self.id, nth + 2);
                }
                // The nearer, the better the prediction.
                if start_ns(periods - 1) > soonest_ns {
                    return Ok(None);
                }
                periods
            }
            None => (soonest_ns + length_ns - last_ns).div_euclid(period_ns).max(0) + 1,
        };
        let end_ns = last_ns + periods * period_ns;
        Ok(Some(Expected { id: self.id, middle_ns: end_ns - length_ns / 2, end_ns }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::{Direction, TraceEvent};

    fn prediction(ends_ms: &[i64]) -> Prediction {
        let frame: cantap::Frame = "123#11".parse().unwrap();
        let mut prediction = Prediction::new(frame.id(), 1, 2000);
        for end_ms in ends_ms {
            let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
            prediction.take(&TraceRecord { time_ns: end_ms * 1_000_000, device_ns: None, channel: 1, event });
        }
        prediction
    }

    #[test]
    fn the_next_frame_is_a_period_after_the_last() {
        let of = prediction(&[0, 10, 20, 30]);
        let expected = of.next(None, 35_000_000).unwrap().unwrap();
        assert_eq!(expected.end_ns, 40_000_000);
        let half = expected.end_ns - expected.middle_ns;
        assert!((45_000..65_000).contains(&half), "{half}");
        // Too near: the one after it.
        assert_eq!(of.next(None, 39_950_000).unwrap().unwrap().end_ns, 50_000_000);
    }

    #[test]
    fn a_wanted_frame_is_planned_as_late_as_possible() {
        let of = prediction(&[0, 10, 20, 30]);
        assert_eq!(of.next(Some(9), 35_000_000).unwrap(), None);
        assert_eq!(of.next(Some(6), 45_000_000).unwrap().unwrap().end_ns, 50_000_000);
        assert!(of.next(Some(4), 35_000_000).unwrap_err().to_string().contains("is over"));
        assert!(of.next(Some(5), 45_000_000).unwrap_err().to_string().contains("too soon"));
    }

    #[test]
    fn frames_without_a_period_are_refused_and_too_few_are_waited_for() {
        assert_eq!(prediction(&[0, 10, 20]).next(None, 0).unwrap(), None);
        let irregular = prediction(&[0, 10, 25, 30, 47, 50, 68, 71, 90]);
        assert!(irregular.next(None, 0).unwrap_err().to_string().contains("cannot be predicted"));
        // One that came late by an error frame does not matter.
        let disturbed = prediction(&[0, 10, 20, 31, 40, 50, 60, 70, 80]);
        assert_eq!(disturbed.next(None, 85_000_000).unwrap().unwrap().end_ns, 90_000_000);
    }
}
