//! The lengths of an identifier's periods.

use super::super::{Axis, Content, Histogram, Pane, Plot};
use cantap_trace::{Id, TraceEvent, TraceRecord};

/// Number of bars in a histogram.
const HISTOGRAM_BARS: usize = 80;

/// Collects the lengths of the intervals between an identifier's frames.
pub struct TimingCollector {
    id: Id,
    channels: Vec<ChannelTiming>,
}

struct ChannelTiming {
    channel: u8,
    last_ns: Option<i64>,
    histogram: Histogram,
}

impl TimingCollector {
    /// Nothing has been collected yet.
    pub fn new(id: Id) -> Self {
        Self { id, channels: Vec::new() }
    }

    /// Takes the next record of the trace. An interval in which frames were lost is left out.
    pub fn push(&mut self, record: &TraceRecord) {
        let ours = record.frame().is_some_and(|frame| frame.id() == self.id);
        let lost = matches!(record.event, TraceEvent::Lost { .. });
        if !ours && !lost {
            return;
        }
        let found = self.channels.iter().position(|timing| timing.channel == record.channel);
        let place = found.unwrap_or_else(|| {
            let channel = record.channel;
            self.channels.push(ChannelTiming { channel, last_ns: None, histogram: Histogram::default() });
            self.channels.len() - 1
        });
        let timing = &mut self.channels[place];
        if lost {
            timing.last_ns = None;
        } else if let Some(before) = timing.last_ns.replace(record.time_ns) {
            let interval = record.time_ns.saturating_sub(before);
            if interval >= 0 {
                timing.histogram.add(interval);
            }
        }
    }

    /// The picture, with a pane per channel; empty if there are not two frames.
    pub fn finish(mut self, title: String) -> Plot {
        self.channels.sort_by_key(|timing| timing.channel);
        let mut outside_all = 0;
        let mut panes = Vec::new();
        for timing in self.channels.iter().filter(|timing| timing.histogram.total() > 0) {
            let (bars, outside) = timing.histogram.bars(HISTOGRAM_BARS);
            outside_all += outside;
            let label = if self.channels.len() == 1 {
                "count".to_owned()
            } else {
                format!("count {}", timing.channel)
            };
            panes.push(Pane { label, range: None, content: Content::Bars(bars) });
        }
        let label = match outside_all {
            0 => format!("period of {} in ms", self.id),
            outside => format!("period of {} in ms ({outside} periods are further out)", self.id),
        };
        Plot { title, axis: Axis::Value { label }, panes, gaps: Vec::new() }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{frame, lost};
    use super::*;

    #[test]
    fn timing_leaves_out_what_spans_a_loss() {
        let mut collector = TimingCollector::new(Id::standard(0x123).unwrap());
        for record in [frame(0, "123#"), frame(10, "123#"), frame(11, "124#"), lost(15, 1), frame(70, "123#")]
        {
            collector.push(&record);
        }
        let plot = collector.finish(String::new());
        let Content::Bars(bars) = &plot.panes[0].content else { panic!("no bars") };
        assert_eq!(bars.iter().map(|bar| bar.count).sum::<u64>(), 1);
        assert!(TimingCollector::new(Id::standard(1).unwrap()).finish(String::new()).panes.is_empty());
    }
}
