//! Whether two aligned traces really have the same frames at the same times.

use std::collections::VecDeque;

use hdrhistogram::Histogram;

use super::Alignment;
use cantap_trace::{TraceEvent, TraceFrame, TraceRecord};

/// The longest difference that is counted, in nanoseconds: beyond every tolerance.
const MOST_NS: u64 = 1_000_000_000;

/// Compares two traces frame by frame as they go by, in order of the common time.
pub struct Verifier {
    channels: Vec<(u8, u8)>,
    common_ns: (i64, i64),
    tolerance_ns: i64,
    waiting: [VecDeque<Waiting>; 2],
    differences: Histogram<u64>,
    both: u64,
    only: [u64; 2],
}

/// A frame whose twin has not come yet.
struct Waiting {
    time_ns: i64,
    /// Which of the pairs of channels.
    bus: usize,
    frame: TraceFrame,
    late: bool,
}

/// How well two traces agree.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Agreement {
    /// Frames that both have.
    pub both: u64,
    /// Frames that only the first has, of the time when both recorded.
    pub only_first: u64,
    /// Frames that only the second has.
    pub only_second: u64,
    /// How far the two stamps of a frame are apart, half of them at most, in nanoseconds. Stamps that are only upper bounds
    /// are not among them.
    pub median_ns: u64,
    /// The same for 99 % of them.
    pub most_ns: u64,
    /// The same for all of them.
    pub worst_ns: u64,
}

impl Verifier {
    /// Nothing compared yet.
    pub fn new(alignment: &Alignment) -> Self {
        // Cannot fail: the bounds are constants, and two digits are few.
        let differences = Histogram::new_with_bounds(1, MOST_NS, 2).expect("constant bounds");
        Self {
            channels: alignment.channels.clone(),
            common_ns: alignment.common_ns,
            tolerance_ns: alignment.tolerance_ns,
            waiting: [VecDeque::new(), VecDeque::new()],
            differences,
            both: 0,
            only: [0; 2],
        }
    }

    /// Takes the first trace's next record.
    pub fn first(&mut self, record: &TraceRecord) {
        let bus = self.channels.iter().position(|channels| channels.0 == record.channel);
        self.take(0, bus, record);
    }

    /// Takes the second trace's next record, its time already mapped, its channel not.
    pub fn second(&mut self, record: &TraceRecord) {
        let bus = self.channels.iter().position(|channels| channels.1 == record.channel);
        self.take(1, bus, record);
    }

    fn take(&mut self, side: usize, bus: Option<usize>, record: &TraceRecord) {
        let (Some(bus), TraceEvent::Frame { frame, late, .. }) = (bus, &record.event) else { return };
        let time_ns = record.time_ns;
        self.give_up(time_ns - self.tolerance_ns);
        let others = &mut self.waiting[1 - side];
        if let Some(at) = others.iter().position(|other| other.bus == bus && other.frame == *frame) {
            let Some(other) = others.remove(at) else { return };
            self.both += 1;
            if !late && !other.late {
                self.differences.saturating_record(other.time_ns.abs_diff(time_ns).max(1));
            }
        } else {
            self.waiting[side].push_back(Waiting { time_ns, bus, frame: *frame, late: *late });
        }
    }

    /// Frames from before have no twin.
    fn give_up(&mut self, before_ns: i64) {
        let (begin, end) = self.common_ns;
        for (waiting, only) in self.waiting.iter_mut().zip(&mut self.only) {
            while let Some(oldest) = waiting.pop_front_if(|oldest| oldest.time_ns < before_ns) {
                *only += u64::from((begin..=end).contains(&oldest.time_ns));
            }
        }
    }

    /// The result, when both traces have ended.
    pub fn finish(mut self) -> Agreement {
        self.give_up(i64::MAX);
        let quantile =
            |part| if self.differences.is_empty() { 0 } else { self.differences.value_at_quantile(part) };
        Agreement {
            both: self.both,
            only_first: self.only[0],
            only_second: self.only[1],
            median_ns: quantile(0.5),
            most_ns: quantile(0.99),
            worst_ns: self.differences.max(),
        }
    }
}
