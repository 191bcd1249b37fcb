//! Notices quickly that a channel receives errors but no frame: the sign of a wrong bit rate.

use std::time::{Duration, Instant};

use cantap::{TraceEvent, TraceRecord};

/// How long after its first error a channel that has received no frame is reported. By then, at any bit rate, an active
/// bus has had frames.
const PATIENCE: Duration = Duration::from_secs(1);

/// What each channel has received so far.
#[derive(Clone, Debug, Default)]
pub struct Hearing {
    /// By number, from 1.
    channels: Vec<Heard>,
}

#[derive(Clone, Debug, Default)]
struct Heard {
    /// Lost frames count as frames, too.
    has_frames: bool,
    first_error: Option<Instant>,
    is_told: bool,
}

impl Hearing {
    /// Takes what was received until `now`.
    pub fn take(&mut self, records: &[TraceRecord], now: Instant) {
        for record in records {
            let index = usize::from(record.channel.saturating_sub(1));
            if index >= self.channels.len() {
                self.channels.resize(index + 1, Heard::default());
            }
            let heard = &mut self.channels[index];
            match record.event {
                TraceEvent::Frame { .. } | TraceEvent::Lost { .. } => heard.has_frames = true,
                TraceEvent::BusError { .. } | TraceEvent::ErrorsSuppressed { .. } => {
                    heard.first_error.get_or_insert(now);
                }
                _ => {}
            }
        }
    }

    /// The channels, from 1, that have received errors but no frame for long enough, and have not been reported yet.
    pub fn news(&mut self, now: Instant) -> Vec<u8> {
        let is_new = |heard: &Heard| !heard.is_told && heard.has_errors_only_since(now);
        let told: Vec<u8> =
            (1..).zip(&self.channels).filter_map(|(number, heard)| is_new(heard).then_some(number)).collect();
        for number in &told {
            self.channels[usize::from(*number - 1)].is_told = true;
        }
        told
    }

    /// The channels, from 1, that have received errors but no frame for long enough, reported or not.
    pub fn errors_only(&self, now: Instant) -> impl Iterator<Item = u8> {
        (1..)
            .zip(&self.channels)
            .filter(move |(_, heard)| heard.has_errors_only_since(now))
            .map(|(number, _)| number)
    }

    /// The channels, from 1, that have received errors but no frame in the end, however short that was.
    pub fn deaf(&self) -> impl Iterator<Item = u8> {
        let is_deaf = |heard: &Heard| !heard.has_frames && heard.first_error.is_some();
        (1..).zip(&self.channels).filter_map(move |(number, heard)| is_deaf(heard).then_some(number))
    }

    /// Whether any channel has received a frame.
    pub fn has_frames(&self) -> bool {
        self.channels.iter().any(|heard| heard.has_frames)
    }

    /// Whether this was reported for a channel.
    pub fn is_told(&self, number: u8) -> bool {
        self.channels.get(usize::from(number.saturating_sub(1))).is_some_and(|heard| heard.is_told)
    }
}

impl Heard {
    fn has_errors_only_since(&self, now: Instant) -> bool {
        !self.has_frames
            && self.first_error.is_some_and(|first| now.saturating_duration_since(first) >= PATIENCE)
    }
}

/// What it means, and what to do; `device` is the address for finding the bit rate.
pub fn meaning(number: u8, device: &str, channel_there: u8) -> String {
    format!(
        "channel {number}: only errors and no frame, which usually means a wrong bit rate or a broken bus, or a lone node that \
         nobody acknowledges; `cantap autobaud -d {device} -c {channel_there}` finds the bit rate, if the bus is whole"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::Direction;

    const ERROR: TraceEvent = TraceEvent::BusError { kind: None, counters: None };

    fn record(channel: u8, event: TraceEvent) -> TraceRecord {
        TraceRecord { time_ns: 0, channel, event }
    }

    #[test]
    fn a_channel_with_errors_and_no_frame_is_told_after_a_second_and_once() {
        let start = Instant::now();
        let after = |ms| start + Duration::from_millis(ms);
        let mut hearing = Hearing::default();
        let frame =
            TraceEvent::Frame { frame: "123#".parse().unwrap(), direction: Direction::Rx, late: false };
        hearing.take(&[record(1, ERROR), record(1, frame), record(3, ERROR)], start);
        hearing.take(&[record(3, ERROR)], after(900));
        assert_eq!(hearing.news(after(999)), [0; 0]);
        assert_eq!(hearing.news(after(1000)), [3]);
        assert_eq!(hearing.news(after(2000)), [0; 0]);
        assert!(hearing.is_told(3) && !hearing.is_told(1));
        assert_eq!(hearing.errors_only(after(2000)).collect::<Vec<_>>(), [3]);
        hearing.take(&[record(3, frame)], after(2100));
        assert_eq!(hearing.errors_only(after(2200)).count(), 0);
    }
}
