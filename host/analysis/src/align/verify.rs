//! Checks whether two aligned traces really have the same frames at the same times.

use std::collections::VecDeque;

use hdrhistogram::Histogram;

use super::Alignment;
use cantap_trace::{TraceEvent, TraceFrame, TraceRecord};

/// The longest difference that is counted, in nanoseconds: longer than any tolerance.
const MOST_NS: u64 = 1_000_000_000;

/// Compares two traces frame by frame, in order of the common time.
pub struct Verifier {
    channels: Vec<(u8, u8)>,
    common_ns: (i64, i64),
    tolerance_ns: i64,
    waiting: [VecDeque<Waiting>; 2],
    differences: Histogram<u64>,
    both: u64,
    only: [u64; 2],
}

/// A frame whose counterpart has not been found yet.
struct Waiting {
    time_ns: i64,
    /// Index of the pair of channels.
    bus: usize,
    frame: TraceFrame,
    late: bool,
}

/// How well two traces agree.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Agreement {
    /// Frames that both have.
    pub both: u64,
    /// Frames that only the first has, during the time when both recorded.
    pub only_first: u64,
    /// Frames that only the second has.
    pub only_second: u64,
    /// The median distance between the two stamps of a frame, in nanoseconds. Stamps that are only upper bounds are
    /// excluded.
    pub median_ns: u64,
    /// The same for the 99th percentile.
    pub most_ns: u64,
    /// The same for the maximum.
    pub worst_ns: u64,
}

impl Verifier {
    /// Nothing has been compared yet.
    pub fn new(alignment: &Alignment) -> Self {
        // This cannot fail: the bounds are constants, and two digits are few.
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

    /// Takes the second trace's next record, its time already mapped but not its channel.
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

    /// Frames before this time have no counterpart.
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
