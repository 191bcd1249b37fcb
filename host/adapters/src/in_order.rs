//! The order of an adapter's reports in time.
//!
//! An adapter stamps frames, and what it does not stamp (errors, states, losses) is placed when it arrives. On a busy computer that is
//! late, by seconds even, so that the frames behind it would be earlier. The host takes a stream whose times go back for one that lies.

use std::time::{Duration, Instant};

use cantap_wire::CHANNELS;
use cantap_wire::record::Stamp;

use crate::driver::{At, Incoming};

/// How far a report's time may be before that of an earlier report: half of what the host allows.
const DISORDER: Duration = Duration::from_millis(50);

/// Keeps an adapter's reports in order.
#[derive(Default)]
pub(crate) struct InOrder {
    latest: Option<Instant>,
}

impl InOrder {
    /// Corrects the times of what the driver has reported at once, in its order. What was placed when it arrived happened no later than what is behind
    /// it on its channel; what is still too early is moved, and its time marked as an upper bound.
    pub fn correct(&mut self, reports: &mut [Incoming]) {
        let mut limits: [Option<Instant>; CHANNELS] = [None; CHANNELS];
        for (channel, at) in reports.iter_mut().rev().map(Incoming::place_mut) {
            let limit = &mut limits[channel.index()];
            let earliest = limit.map_or(at.instant, |limit| limit.min(at.instant));
            if at.stamp == Stamp::UpperBound {
                at.instant = earliest;
            }
            *limit = Some(earliest);
        }
        for (_, at) in reports.iter_mut().map(Incoming::place_mut) {
            let latest = *self.latest.get_or_insert(at.instant);
            if let Some(earliest) = latest.checked_sub(DISORDER)
                && at.instant < earliest
            {
                *at = At::arrival(earliest);
            }
            self.latest = Some(latest.max(at.instant));
        }
    }
}

#[cfg(test)]
mod tests {
    use cantap_wire::record::{BusErrorKind, LossStage};
    use cantap_wire::{Channel, Frame};

    use super::*;

    const CHANNEL: Channel = Channel::Can1;

    fn frame(instant: Instant) -> Incoming {
        let frame: Frame = "123#".parse().unwrap();
        Incoming::Received { channel: CHANNEL, frame: frame.into(), at: At { instant, stamp: Stamp::Exact } }
    }

    fn error(instant: Instant) -> Incoming {
        Incoming::BusError { channel: CHANNEL, kind: BusErrorKind::Stuff, at: At::arrival(instant) }
    }

    fn times(reports: &mut [Incoming], start: Instant) -> Vec<(u64, Stamp)> {
        let of = |at: &mut At| ((at.instant - start).as_millis() as u64, at.stamp);
        reports.iter_mut().map(|report| of(report.place_mut().1)).collect()
    }

    #[test]
    fn what_arrives_late_between_stamped_frames_is_no_later_than_the_next() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut reports = [frame(at(1000)), error(at(1600)), frame(at(1002)), error(at(1601))];
        InOrder::default().correct(&mut reports);
        let expected = [
            (1000, Stamp::Exact),
            (1002, Stamp::UpperBound),
            (1002, Stamp::Exact),
            (1601, Stamp::UpperBound),
        ];
        assert_eq!(times(&mut reports, start), expected);
    }

    #[test]
    fn what_comes_in_another_batch_goes_back_no_further_than_the_host_allows() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut order = InOrder::default();
        let lost = Incoming::Lost {
            channel: CHANNEL,
            stage: LossStage::Queue,
            count: 1,
            at_least: false,
            at: At::arrival(at(1600)),
        };
        order.correct(&mut [frame(at(1000)), lost]);
        let mut reports = [frame(at(1002)), frame(at(1540)), frame(at(1560)), frame(at(1700))];
        order.correct(&mut reports);
        let expected = [
            (1550, Stamp::UpperBound),
            (1550, Stamp::UpperBound),
            (1560, Stamp::Exact),
            (1700, Stamp::Exact),
        ];
        assert_eq!(times(&mut reports, start), expected);
    }
}
