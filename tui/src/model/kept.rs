//! A record as the history keeps it: less than half of the size of one with room for a CAN FD frame.

use cantap::wire::record::{BusErrorKind, ErrorState, LossStage, TransmitFailure};
use cantap::{Direction, Frame, TraceEvent, TraceFrame, TraceRecord};
use cantap_trace::{LinFrame, Moment};

/// A record. What a classical device delivers is kept here; a CAN FD frame elsewhere, by number.
pub struct Kept {
    at: Moment,
    channel: u8,
    what: What,
}

enum What {
    Frame { frame: Frame, direction: Direction, late: bool },
    BusError { kind: Option<BusErrorKind>, counters: Option<(u8, u8)> },
    ErrorsSuppressed { count: u32 },
    State { state: ErrorState, counters: Option<(u8, u8)> },
    Lost { stage: Option<LossStage>, count: u32, at_least: bool },
    TransmitFailed { tag: u32, reason: TransmitFailure },
    Disturbed { length_ns: u32 },
    Lin { frame: LinFrame, direction: Direction },
    Fd(u32),
}

impl Kept {
    /// Converts a record for keeping. `number` is the one under which its event is kept if it is a CAN FD
    /// frame.
    pub fn new(record: &TraceRecord, number: u32) -> Self {
        let what = match record.event {
            TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction, late } => {
                What::Frame { frame, direction, late }
            }
            TraceEvent::Frame { frame: TraceFrame::Fd(_), .. } => What::Fd(number),
            TraceEvent::BusError { kind, counters } => What::BusError { kind, counters },
            TraceEvent::ErrorsSuppressed { count } => What::ErrorsSuppressed { count },
            TraceEvent::State { state, counters } => What::State { state, counters },
            TraceEvent::Lost { stage, count, at_least } => What::Lost { stage, count, at_least },
            TraceEvent::TransmitFailed { tag, reason } => What::TransmitFailed { tag, reason },
            TraceEvent::Disturbed { length_ns } => What::Disturbed { length_ns },
            TraceEvent::Lin { frame, direction } => What::Lin { frame, direction },
        };
        Self { at: record.moment(), channel: record.channel, what }
    }

    /// When it happened.
    pub const fn moment(&self) -> Moment {
        self.at
    }

    /// Whether its event is kept elsewhere.
    pub fn is_fd(&self) -> bool {
        matches!(self.what, What::Fd(_))
    }

    /// The original record; `elsewhere` returns the CAN FD frame with a number.
    pub fn record(&self, elsewhere: impl FnOnce(u32) -> Option<TraceEvent>) -> Option<TraceRecord> {
        let event = match &self.what {
            What::Frame { frame, direction, late } => {
                TraceEvent::Frame { frame: (*frame).into(), direction: *direction, late: *late }
            }
            What::BusError { kind, counters } => TraceEvent::BusError { kind: *kind, counters: *counters },
            What::ErrorsSuppressed { count } => TraceEvent::ErrorsSuppressed { count: *count },
            What::State { state, counters } => TraceEvent::State { state: *state, counters: *counters },
            What::Lost { stage, count, at_least } => {
                TraceEvent::Lost { stage: *stage, count: *count, at_least: *at_least }
            }
            What::TransmitFailed { tag, reason } => TraceEvent::TransmitFailed { tag: *tag, reason: *reason },
            What::Disturbed { length_ns } => TraceEvent::Disturbed { length_ns: *length_ns },
            What::Lin { frame, direction } => TraceEvent::Lin { frame: *frame, direction: *direction },
            What::Fd(number) => elsewhere(*number)?,
        };
        let Moment { time_ns, device_ns } = self.at;
        Some(TraceRecord { time_ns, device_ns, channel: self.channel, event })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::DeviceNs;

    #[test]
    fn every_record_comes_back_and_takes_little_room() {
        assert_eq!(size_of::<Kept>(), 40);
        let frame = |text: &str| TraceEvent::Frame {
            frame: text.parse().unwrap(),
            direction: Direction::Tx,
            late: true,
        };
        for event in [
            frame("123#1122"),
            frame("123##3000102030405060708090A0B"),
            TraceEvent::BusError { kind: Some(BusErrorKind::Crc), counters: Some((1, 2)) },
            TraceEvent::ErrorsSuppressed { count: 7 },
            TraceEvent::State { state: ErrorState::Passive, counters: None },
            TraceEvent::GAP,
            TraceEvent::TransmitFailed { tag: 3, reason: TransmitFailure::Overtaken { periods: 9 } },
        ] {
            for device_ns in [None, DeviceNs::new(7)] {
                let record = TraceRecord { time_ns: -5, device_ns, channel: 2, event };
                let kept = Kept::new(&record, 7);
                assert_eq!(kept.record(|number| (number == 7).then_some(event)), Some(record));
            }
        }
    }
}
