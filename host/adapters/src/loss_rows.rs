//! Many losses in a row, without a frame between them: what makes no sense byte by byte would be a record for each of them, and fill a disk with fifty times
//! what the line carries.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::driver::Incoming;

/// How many losses in a row are reported one by one.
const ONE_BY_ONE: u32 = 16;
/// How long the sum of those behind them may wait.
const TOGETHER: Duration = Duration::from_millis(100);

/// Adds up losses in a row. None is lost, and each stays between the frames where it was.
#[derive(Default)]
pub(crate) struct LossRows {
    in_row: u32,
    held: Option<(Incoming, Instant)>,
}

impl LossRows {
    /// Passes reports on, in their order.
    pub fn pass(&mut self, fresh: &mut Vec<Incoming>, now: Instant, to: &mut VecDeque<Incoming>) {
        for report in fresh.drain(..) {
            let Incoming::Lost { count, .. } = report else {
                self.flush(to);
                self.in_row = 0;
                to.push_back(report);
                continue;
            };
            // A gap of unknown size is none that could be added.
            if count == 0 {
                self.flush(to);
                to.push_back(report);
                continue;
            }
            self.in_row = self.in_row.saturating_add(1);
            if self.in_row <= ONE_BY_ONE {
                to.push_back(report);
            } else if !self.adds(&report) {
                self.flush(to);
                self.held = Some((report, now));
            }
        }
        if self.held.is_some_and(|(_, since)| now.saturating_duration_since(since) >= TOGETHER) {
            self.flush(to);
        }
    }

    /// Adds a loss to the one that waits, if it is of the same kind.
    fn adds(&mut self, report: &Incoming) -> bool {
        let (
            Some((Incoming::Lost { channel, stage, count, at_least, .. }, _)),
            Incoming::Lost { channel: of, stage: by, count: more, at_least: or_more, .. },
        ) = (&mut self.held, report)
        else {
            return false;
        };
        let sum = count.checked_add(*more).filter(|_| (*channel, *stage, *at_least) == (*of, *by, *or_more));
        *count = sum.unwrap_or(*count);
        sum.is_some()
    }

    /// Passes on what waits.
    pub fn flush(&mut self, to: &mut VecDeque<Incoming>) {
        to.extend(self.held.take().map(|(report, _)| report));
    }
}

#[cfg(test)]
mod tests {
    use cantap_wire::record::LossStage;
    use cantap_wire::{Channel, Frame};

    use super::*;
    use crate::driver::At;

    #[test]
    fn a_flood_of_losses_is_a_few_reports_with_the_same_sum_between_the_same_frames() {
        let now = Instant::now();
        let at = At::arrival(now);
        let lost = |channel| Incoming::Lost { channel, stage: LossStage::Link, count: 1, at_least: true, at };
        let frame: Frame = "123#".parse().unwrap();
        let frame = Incoming::Received { channel: Channel::Can1, frame: frame.into(), at };
        let (mut rows, mut out) = (LossRows::default(), VecDeque::new());
        // Few of them stay as they are.
        rows.pass(&mut vec![lost(Channel::Can1); 3], now, &mut out);
        rows.pass(&mut vec![frame, lost(Channel::Can1), frame], now, &mut out);
        assert_eq!(out.len(), 6);
        out.clear();
        for _ in 0..10 {
            rows.pass(&mut vec![lost(Channel::Can1); 10_000], now, &mut out);
            rows.pass(&mut vec![lost(Channel::Can2)], now, &mut out);
        }
        rows.pass(&mut vec![frame], now, &mut out);
        assert!(out.len() < 50 && out.back() == Some(&frame), "{}", out.len());
        let sum = |of| {
            let counts = out.iter().map(|report| match report {
                Incoming::Lost { channel, count, .. } if *channel == of => u64::from(*count),
                _ => 0,
            });
            counts.sum::<u64>()
        };
        assert_eq!((sum(Channel::Can1), sum(Channel::Can2)), (100_000, 10));
        let unknown =
            Incoming::Lost { channel: Channel::Can1, stage: LossStage::Link, count: 0, at_least: true, at };
        out.clear();
        rows.pass(&mut vec![unknown; 20], now, &mut out);
        assert_eq!(out.len(), 20, "gaps of unknown size stay");
        // Nothing waits for long.
        rows.pass(&mut vec![lost(Channel::Can1); 20], now, &mut out);
        out.clear();
        rows.pass(&mut Vec::new(), now + TOGETHER, &mut out);
        assert!(matches!(out.make_contiguous(), [Incoming::Lost { count: 4, .. }]), "{out:?}");
    }
}
