//! Checks the law of counting: every frame that was on the bus was delivered, in order and bit for bit, or is
//! counted as lost exactly where it is missing.

use crate::simbus::FrameSource;
use cantap_trace::{TraceEvent, TraceRecord};

/// Follows one channel's records along the sequence that was sent.
#[derive(Clone, Debug)]
pub struct SequenceCheck {
    source: FrameSource,
    delivered: u64,
    lost: u64,
    in_order: bool,
    exact: bool,
}

impl SequenceCheck {
    /// A check that expects this sequence from its beginning.
    pub const fn new(source: FrameSource) -> Self {
        Self { source, delivered: 0, lost: 0, in_order: true, exact: true }
    }

    /// Takes the channel's next record.
    pub fn push(&mut self, record: &TraceRecord) {
        match record.event {
            TraceEvent::Frame { frame, .. } => {
                self.delivered += 1;
                self.in_order &= self.source.next().is_some_and(|expected| frame == expected);
            }
            TraceEvent::Lost { count, at_least, .. } => {
                self.lost += u64::from(count);
                self.exact &= !at_least;
                if let Some(behind) = (count as usize).checked_sub(1) {
                    self.source.nth(behind);
                }
            }
            _ => {}
        }
    }

    /// Frames delivered.
    pub const fn delivered(&self) -> u64 {
        self.delivered
    }

    /// Frames counted as lost.
    pub const fn lost(&self) -> u64 {
        self.lost
    }

    /// Whether each delivered frame was the expected one, with each loss counting for its number of frames.
    pub const fn in_order(&self) -> bool {
        self.in_order
    }

    /// Whether the law holds for this many frames on the bus.
    pub const fn holds(&self, sent: u64) -> bool {
        self.in_order && self.exact && self.delivered + self.lost == sent
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simbus::Frames;
    use cantap_trace::Direction;

    fn lost(count: u32, at_least: bool) -> TraceRecord {
        TraceRecord {
            time_ns: 0,
            device_ns: None,
            channel: 1,
            event: TraceEvent::Lost { stage: None, count, at_least },
        }
    }

    fn run(take: impl Fn(usize) -> Option<usize>, losses: &[TraceRecord]) -> SequenceCheck {
        let source = || FrameSource::new(Frames::Std8, 5);
        let frames: Vec<_> = source().take(20).collect();
        let mut check = SequenceCheck::new(source());
        for index in 0..20 {
            if index == 10 {
                for loss in losses {
                    check.push(loss);
                }
            }
            let Some(index) = take(index) else { continue };
            let event =
                TraceEvent::Frame { frame: frames[index].into(), direction: Direction::Rx, late: false };
            check.push(&TraceRecord { time_ns: 0, device_ns: None, channel: 1, event });
        }
        check
    }

    #[test]
    fn a_complete_sequence_and_one_with_counted_losses_hold() {
        assert!(run(Some, &[]).holds(20));
        let gap = |index| (!(10..15).contains(&index)).then_some(index);
        assert!(run(gap, &[lost(3, false), lost(2, false)]).holds(20));
    }

    #[test]
    fn a_missing_swapped_or_uncounted_frame_breaks_the_law() {
        let gap = |index| (!(10..15).contains(&index)).then_some(index);
        assert!(!run(gap, &[]).holds(20));
        assert!(!run(gap, &[lost(4, false)]).holds(20));
        assert!(!run(gap, &[lost(5, true)]).holds(20));
        let swapped = |index| Some(if index == 7 || index == 8 { 15 - index } else { index });
        assert!(!run(swapped, &[]).in_order());
        assert!(!run(Some, &[]).holds(21));
    }
}
