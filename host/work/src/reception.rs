//! Notices quickly that a channel receives errors but no frame: the sign of a wrong bit rate.

use std::time::{Duration, Instant};

use cantap::{TraceEvent, TraceRecord};

use crate::bus_hints::{BusEvidence, BusHint};

/// How long after its first error a channel that has received no frame is reported. By then, at any bit rate, an active
/// bus has had frames.
const PATIENCE: Duration = Duration::from_secs(1);

/// What each channel has received so far.
#[derive(Clone, Debug, Default)]
pub struct Reception {
    /// By number, from 1.
    channels: Vec<ChannelReception>,
}

#[derive(Clone, Debug, Default)]
struct ChannelReception {
    evidence: BusEvidence,
    first_error: Option<Instant>,
    is_reported: bool,
}

impl Reception {
    /// Takes what was received until `now`.
    pub fn take(&mut self, records: &[TraceRecord], now: Instant) {
        for record in records {
            let index = usize::from(record.channel.saturating_sub(1));
            if index >= self.channels.len() {
                self.channels.resize(index + 1, ChannelReception::default());
            }
            let channel = &mut self.channels[index];
            channel.evidence.take(&record.event);
            if matches!(record.event, TraceEvent::BusError { .. } | TraceEvent::ErrorsSuppressed { .. }) {
                channel.first_error.get_or_insert(now);
            }
        }
    }

    /// The channels, from 1, that have received errors but no frame for long enough, and have not been reported yet.
    pub fn news(&mut self, now: Instant) -> Vec<u8> {
        let is_new = |channel: &ChannelReception| !channel.is_reported && channel.has_errors_only_since(now);
        let new: Vec<u8> = (1..)
            .zip(&self.channels)
            .filter_map(|(number, channel)| is_new(channel).then_some(number))
            .collect();
        for number in &new {
            self.channels[usize::from(*number - 1)].is_reported = true;
        }
        new
    }

    /// The channels, from 1, that have received errors but no frame for long enough, reported or not.
    pub fn errors_only(&self, now: Instant) -> impl Iterator<Item = u8> {
        (1..)
            .zip(&self.channels)
            .filter(move |(_, channel)| channel.has_errors_only_since(now))
            .map(|(number, _)| number)
    }

    /// The channels, from 1, that have received errors but no frame in the end, however short that was.
    pub fn deaf(&self) -> impl Iterator<Item = u8> {
        let is_deaf = |channel: &ChannelReception| !channel.has_frames() && channel.first_error.is_some();
        (1..).zip(&self.channels).filter_map(move |(number, channel)| is_deaf(channel).then_some(number))
    }

    /// Whether any channel has received a frame.
    pub fn has_frames(&self) -> bool {
        self.channels.iter().any(ChannelReception::has_frames)
    }

    /// What a channel's errors or its silence mean, numbered from 1; see [`BusEvidence::hint`].
    pub fn hint(&self, number: u8, is_filtered: bool) -> Option<BusHint> {
        let silent = BusEvidence::default();
        let channel = self.channels.get(usize::from(number.saturating_sub(1)));
        channel.map_or(&silent, |channel| &channel.evidence).hint(is_filtered)
    }

    /// Whether this was reported for a channel.
    pub fn is_reported(&self, number: u8) -> bool {
        self.channels.get(usize::from(number.saturating_sub(1))).is_some_and(|channel| channel.is_reported)
    }
}

impl ChannelReception {
    /// Lost frames count as frames, too.
    const fn has_frames(&self) -> bool {
        self.evidence.frames() > 0
    }

    fn has_errors_only_since(&self, now: Instant) -> bool {
        !self.has_frames()
            && self.first_error.is_some_and(|first| now.saturating_duration_since(first) >= PATIENCE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::Direction;

    const ERROR: TraceEvent = TraceEvent::BusError { kind: None, counters: None };

    fn record(channel: u8, event: TraceEvent) -> TraceRecord {
        TraceRecord { time_ns: 0, device_ns: None, channel, event }
    }

    #[test]
    fn a_channel_with_errors_and_no_frame_is_reported_after_a_second_and_once() {
        let start = Instant::now();
        let after = |ms| start + Duration::from_millis(ms);
        let mut reception = Reception::default();
        let frame =
            TraceEvent::Frame { frame: "123#".parse().unwrap(), direction: Direction::Rx, late: false };
        reception.take(&[record(1, ERROR), record(1, frame), record(3, ERROR)], start);
        reception.take(&[record(3, ERROR)], after(900));
        assert_eq!(reception.news(after(999)), [0; 0]);
        assert_eq!(reception.news(after(1000)), [3]);
        assert_eq!(reception.news(after(2000)), [0; 0]);
        assert!(reception.is_reported(3) && !reception.is_reported(1));
        assert_eq!(reception.errors_only(after(2000)).collect::<Vec<_>>(), [3]);
        assert_eq!(reception.hint(3, false), Some(BusHint::WrongBitRate));
        assert_eq!((reception.hint(1, false), reception.hint(2, false)), (None, Some(BusHint::Silent)));
        assert_eq!(reception.hint(9, true), None);
        reception.take(&[record(3, frame)], after(2100));
        assert_eq!(reception.errors_only(after(2200)).count(), 0);
    }
}
