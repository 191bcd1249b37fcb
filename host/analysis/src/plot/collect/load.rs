//! Bus load over time.

use super::super::{Content, Curve, Pane, Plot};
use super::{Gaps, TimeAxis};
use crate::stats::{BadOptions, Options, Statistics, Window};
use cantap_trace::TraceRecord;

/// Collects bus load over time.
pub struct LoadCollector {
    statistics: Statistics,
    axis: TimeAxis,
    gaps: Gaps,
    end: f64,
    channels: Vec<(u8, Curve)>,
    in_per_cent: bool,
    /// Windows with frames whose load cannot be told.
    unknown: u64,
}

impl LoadCollector {
    /// Nothing has been collected yet. Without a bit rate it shows frames per second.
    pub fn new(options: Options) -> Result<Self, BadOptions> {
        let in_per_cent = options.bitrate_bps.is_some() || !options.channel_bitrate_bps.is_empty();
        Ok(Self {
            statistics: Statistics::new(options)?,
            axis: TimeAxis::default(),
            gaps: Gaps::default(),
            end: 0.0,
            channels: Vec::new(),
            in_per_cent,
            unknown: 0,
        })
    }

    /// As [`Statistics::learn_bitrate`]: a trace has said a channel's bit rate. Before the first record, the load is drawn then.
    pub fn learn_bitrate(&mut self, channel: u8, bitrate_bps: u32) {
        self.statistics.learn_bitrate(channel, bitrate_bps);
        self.in_per_cent |= self.channels.is_empty() && !self.statistics.channel_bitrates_bps().is_empty();
    }

    /// Takes the next record of the trace.
    pub fn push(&mut self, record: &TraceRecord) {
        let x = self.axis.seconds(record.time_ns);
        self.end = self.end.max(x);
        self.gaps.push(record, x);
        let (axis, channels, in_per_cent) = (&mut self.axis, &mut self.channels, self.in_per_cent);
        let unknown = &mut self.unknown;
        self.statistics.push_with(record, |window| {
            *unknown += u64::from(is_unknown(window, in_per_cent));
            add_window(window, axis, channels, in_per_cent);
        });
    }

    /// The picture.
    pub fn finish(self, title: String) -> Plot {
        self.finish_counting(title).0
    }

    /// The picture, and how many windows have frames but no known load: a bit rate is missing, in most cases that of the data phase of CAN FD.
    pub fn finish_counting(mut self, title: String) -> (Plot, u64) {
        let (axis, channels, in_per_cent) = (&mut self.axis, &mut self.channels, self.in_per_cent);
        let unknown = &mut self.unknown;
        self.statistics.finish_with(|window| {
            *unknown += u64::from(is_unknown(window, in_per_cent));
            add_window(window, axis, channels, in_per_cent);
        });
        let unknown = self.unknown;
        self.channels.sort_by_key(|(channel, _)| *channel);
        let curves: Vec<_> = self.channels.into_iter().map(|(_, curve)| curve).collect();
        let points = curves.iter().flat_map(|curve| curve.series.points());
        let most = points.map(|point| point.y).fold(0.0, f64::max);
        // From zero, so that heights can be compared; a quiet bus should not be a line at the bottom.
        let top = [5.0, 10.0, 20.0, 50.0, 100.0].into_iter().find(|top| *top >= most).unwrap_or(100.0);
        let (label, range) = if in_per_cent { ("load %", Some((0.0, top))) } else { ("frames/s", None) };
        let pane = Pane { label: label.to_owned(), range, content: Content::Analogue(curves) };
        let plot =
            Plot { title, axis: self.axis.axis(), panes: vec![pane], gaps: self.gaps.finish(self.end) };
        (plot, unknown)
    }
}

/// Whether a window has frames whose load cannot be told.
fn is_unknown(window: &Window, in_per_cent: bool) -> bool {
    in_per_cent && window.frames > 0 && window.load_pct.is_none()
}

fn add_window(window: &Window, axis: &mut TimeAxis, channels: &mut Vec<(u8, Curve)>, in_per_cent: bool) {
    let place = channels.iter().position(|(channel, _)| *channel == window.channel).unwrap_or_else(|| {
        let curve = Curve { stepped: true, ..Curve::new(format!("channel {}", window.channel)) };
        channels.push((window.channel, curve));
        channels.len() - 1
    });
    let y = match window.load_pct {
        // If all its frames are missing, nothing is known. If only some are, it is drawn as a lower bound.
        _ if window.incomplete && window.frames == 0 => f64::NAN,
        Some(load) if in_per_cent => load,
        _ if in_per_cent => f64::NAN,
        _ => window.frames_per_s(),
    };
    let series = &mut channels[place].1.series;
    series.push(axis.seconds(window.start_ns).max(0.0), y);
    series.push(axis.seconds(window.start_ns.saturating_add(window.length_ns as i64)), y);
}

#[cfg(test)]
mod tests {
    use super::super::testing::{frame, lost};
    use super::*;

    #[test]
    fn load_over_time_is_a_step_per_window() {
        let options = Options {
            bitrate_bps: Some(1_000_000),
            window: std::time::Duration::from_millis(1),
            ..Options::default()
        };
        let mut collector = LoadCollector::new(options).unwrap();
        for n in 0..40 {
            // 58 bits every 116 µs.
            collector.push(&TraceRecord { time_ns: 55_000 + n * 116_000, ..frame(0, "000#55") });
        }
        let plot = collector.finish(String::new());
        let points = plot.panes[0].content.curves()[0].series.points();
        assert!(points.iter().all(|point| (point.y - 50.0).abs() < 6.0), "{points:?}");
        assert!(matches!(plot.panes[0].range, Some((0.0, 50.0 | 100.0))));
    }

    /// It was an empty picture, and success.
    #[test]
    fn the_load_of_frames_that_switch_their_bit_rate_is_known_with_both_rates() {
        let of = |data_bitrate_bps| {
            let options = Options { bitrate_bps: Some(500_000), data_bitrate_bps, ..Options::default() };
            let mut collector = LoadCollector::new(options).unwrap();
            for n in 0..40 {
                collector.push(&frame(n * 100, "123##1112233445566778899AABBCC"));
            }
            let (plot, unknown) = collector.finish_counting(String::new());
            (plot.is_empty(), unknown)
        };
        assert_eq!(of(None), (true, 4));
        assert_eq!(of(Some(2_000_000)), (false, 0));
    }

    #[test]
    fn a_gap_at_which_the_clock_is_set_back_is_drawn_forwards() {
        let options = Options { bitrate_bps: Some(500_000), ..Options::default() };
        let mut collector = LoadCollector::new(options).unwrap();
        for record in [frame(1000, "123#"), frame(2000, "123#"), lost(1500, 9), frame(1600, "123#")] {
            collector.push(&record);
        }
        let plot = collector.finish(String::new());
        assert!(plot.gaps.iter().all(|gap| gap.from < gap.to), "{:?}", plot.gaps);
        let text = plot.to_text(&crate::plot::TextStyle::default());
        assert!(text.contains("load"), "{text}");
    }

    #[test]
    fn load_is_not_drawn_where_all_frames_are_missing() {
        let options = Options { window: std::time::Duration::from_millis(10), ..Options::default() };
        let mut collector = LoadCollector::new(options).unwrap();
        for record in [frame(0, "123#"), frame(12, "123#"), lost(55, 9), frame(55, "123#"), frame(75, "123#")]
        {
            collector.push(&record);
        }
        let plot = collector.finish(String::new());
        let points = plot.panes[0].content.curves()[0].series.points();
        let missing = points.iter().filter(|point| point.y.is_nan()).count();
        assert!(missing > 0, "{points:?}");
        assert!(points.iter().all(|point| !(0.021..0.049).contains(&point.x)), "{points:?}");
    }
}
