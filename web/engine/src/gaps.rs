//! Stretches of time in which frames are known to be missing, or a controller was off the bus.

use std::collections::BTreeMap;

use cantap_trace::ErrorState;
use cantap_trace::{LossStage, TraceEvent, TraceRecord};

/// So many are kept each for itself; a trace with more has losses nearly everywhere, and the last one is stretched.
const MOST: usize = 100_000;

/// The stage of a gap that is no loss.
pub const BUS_OFF: &str = "bus-off";

/// A stretch of time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// The end of the channel's last frame before it, in nanoseconds.
    pub from_ns: i64,
    /// The end of the first frame after it, in nanoseconds.
    pub to_ns: i64,
    /// From 1.
    pub channel: u8,
    /// Where frames were lost, by [`LossStage::name`]; `unknown`; or [`BUS_OFF`].
    pub stage: &'static str,
    /// How many frames.
    pub count: u64,
    /// Whether it may have been more.
    pub at_least: bool,
}

/// Finds them.
#[derive(Default)]
pub struct Gaps {
    found: Vec<Gap>,
    channels: BTreeMap<u8, Channel>,
}

#[derive(Default)]
struct Channel {
    last_ns: Option<i64>,
    /// Losses since the last frame.
    open: Vec<Gap>,
    off: Option<Gap>,
}

impl Gaps {
    /// Takes the next record of the trace.
    pub fn push(&mut self, record: &TraceRecord) {
        let TraceRecord { time_ns, channel, .. } = *record;
        let of = self.channels.entry(channel).or_default();
        let gap = |stage, count: u32, at_least| Gap {
            from_ns: of.last_ns.unwrap_or(time_ns).min(time_ns),
            to_ns: time_ns,
            channel,
            stage,
            count: count.into(),
            at_least,
        };
        match record.event {
            TraceEvent::Frame { .. } => {
                of.last_ns = Some(time_ns);
                if !of.open.is_empty() || of.off.is_some() {
                    let mut closed = std::mem::take(&mut of.open);
                    closed.extend(of.off.take());
                    for gap in closed {
                        self.close(gap, time_ns);
                    }
                }
            }
            TraceEvent::Lost { stage, count, at_least } => {
                let stage = stage.map_or("unknown", LossStage::name);
                let new = gap(stage, count, at_least);
                match of.open.iter_mut().find(|open| open.stage == stage) {
                    Some(open) => {
                        open.count += new.count;
                        open.at_least |= at_least;
                    }
                    None => of.open.push(new),
                }
            }
            TraceEvent::State { state: ErrorState::BusOff, .. } => {
                let new = Gap { from_ns: time_ns, ..gap(BUS_OFF, 0, true) };
                of.off.get_or_insert(new);
            }
            TraceEvent::State { .. } => {
                if let Some(off) = of.off.take() {
                    self.close(off, time_ns);
                }
            }
            _ => {}
        }
    }

    fn close(&mut self, mut gap: Gap, to_ns: i64) {
        // A trace's clock may be set back.
        gap.to_ns = gap.to_ns.max(to_ns);
        let is_full = self.found.len() >= MOST;
        match self.found.last_mut() {
            Some(last) if is_full => {
                last.to_ns = last.to_ns.max(gap.to_ns);
                last.count += gap.count;
                last.at_least |= gap.at_least;
            }
            _ => self.found.push(gap),
        }
    }

    /// All of them; those that have not ended reach to `end_ns`.
    pub fn all(&self, end_ns: i64) -> impl Iterator<Item = Gap> + '_ {
        let open = self.channels.values().flat_map(|channel| channel.open.iter().chain(&channel.off));
        let open = open.map(move |gap| Gap { to_ns: gap.to_ns.max(end_ns), ..gap.clone() });
        self.found.iter().cloned().chain(open)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::Direction;

    #[test]
    fn a_gap_reaches_from_the_frame_before_to_the_frame_after() {
        let frame =
            TraceEvent::Frame { frame: "123#".parse().unwrap(), direction: Direction::Rx, late: false };
        let lost = |count| TraceEvent::Lost { stage: Some(LossStage::Queue), count, at_least: false };
        let off = TraceEvent::State { state: ErrorState::BusOff, counters: None };
        let mut gaps = Gaps::default();
        for (time_ns, event) in
            [(10, frame), (20, lost(3)), (25, lost(4)), (30, frame), (40, off), (60, frame), (70, lost(1))]
        {
            gaps.push(&TraceRecord { time_ns, device_ns: None, channel: 1, event });
        }
        let found: Vec<_> = gaps.all(90).map(|gap| (gap.from_ns, gap.to_ns, gap.stage, gap.count)).collect();
        assert_eq!(found, [(10, 30, "queue", 7), (40, 60, BUS_OFF, 0), (60, 90, "queue", 1)]);
    }
}
