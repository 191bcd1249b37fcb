//! Pictures from records as they go by: signals, bus load, periods. Memory does not grow with the trace.

use std::collections::HashMap;

use super::{Axis, Content, Curve, Gap, Histogram, Pane, Plot};
use crate::signals::{Decoder, MessageRef, Signal, SignalValue};
use crate::stats::{BadOptions, Options, Statistics, Window};
use crate::{Id, TraceEvent, TraceRecord};

/// Curves in one picture; more cannot be told apart.
pub const MOST_CURVES: usize = 24;

/// Gaps that are kept one by one. Behind them, the last one grows.
const MOST_GAPS: usize = 2000;

/// Bars of a histogram.
const HISTOGRAM_BARS: usize = 80;

/// The horizontal axis of a trace: seconds since its first record.
#[derive(Clone, Debug, Default)]
struct TimeAxis {
    first_ns: Option<i64>,
}

impl TimeAxis {
    fn seconds(&mut self, time_ns: i64) -> f64 {
        let first = *self.first_ns.get_or_insert(time_ns);
        time_ns.saturating_sub(first) as f64 / 1e9
    }

    fn axis(&self) -> Axis {
        // The form that candump's logs have, so that a place in the picture is found in the file.
        let first = self.first_ns.unwrap_or(0);
        let zero = if first == 0 {
            String::new()
        } else {
            format!("{}.{:06}", first.div_euclid(1_000_000_000), first.rem_euclid(1_000_000_000) / 1000)
        };
        Axis::Time { zero }
    }
}

/// Where frames are missing, per channel.
#[derive(Clone, Debug, Default)]
struct Gaps {
    gaps: Vec<Gap>,
    channels: HashMap<u8, ChannelGap>,
}

#[derive(Clone, Debug, Default)]
struct ChannelGap {
    last_frame: Option<f64>,
    lost: u64,
}

impl Gaps {
    /// Takes a record; returns whether it is a loss.
    fn push(&mut self, record: &TraceRecord, x: f64) -> bool {
        let channel = self.channels.entry(record.channel).or_default();
        match record.event {
            TraceEvent::Lost { count, .. } => {
                channel.lost += u64::from(count);
                true
            }
            TraceEvent::Frame { .. } => {
                let before = channel.last_frame.replace(x).unwrap_or(x);
                let frames = std::mem::take(&mut channel.lost);
                if frames > 0 {
                    // A trace's clock may be set back.
                    self.add(Gap { from: before.min(x), to: before.max(x), frames });
                }
                false
            }
            _ => false,
        }
    }

    fn add(&mut self, gap: Gap) {
        let full = self.gaps.len() >= MOST_GAPS;
        match self.gaps.last_mut() {
            Some(last) if full => {
                last.to = last.to.max(gap.to);
                last.frames += gap.frames;
            }
            _ => self.gaps.push(gap),
        }
    }

    /// The gaps, with those that reach the trace's end.
    fn finish(mut self, end: f64) -> Vec<Gap> {
        for channel in std::mem::take(&mut self.channels).into_values().filter(|channel| channel.lost > 0) {
            let from = channel.last_frame.unwrap_or(end);
            self.add(Gap { from, to: end, frames: channel.lost });
        }
        self.gaps
    }
}

/// Collects the curves of the signals that a decoder has selected.
pub struct SignalCollector<'a> {
    decoder: &'a Decoder,
    axis: TimeAxis,
    gaps: Gaps,
    end: f64,
    /// Curve of each signal: channel, message, signal.
    places: HashMap<(u8, MessageRef, u32), usize>,
    curves: Vec<Collected>,
    left_out: u64,
    values: Vec<SignalValue>,
}

struct Collected {
    channel: u8,
    message: MessageRef,
    signal: u32,
    curve: Curve,
    digital: bool,
    state: bool,
}

impl<'a> SignalCollector<'a> {
    /// Nothing collected yet.
    pub fn new(decoder: &'a Decoder) -> Self {
        Self {
            decoder,
            axis: TimeAxis::default(),
            gaps: Gaps::default(),
            end: 0.0,
            places: HashMap::new(),
            curves: Vec::new(),
            left_out: 0,
            values: Vec::new(),
        }
    }

    /// Takes the next record of the trace.
    pub fn push(&mut self, record: &TraceRecord) {
        let x = self.axis.seconds(record.time_ns);
        self.end = self.end.max(x);
        if self.gaps.push(record, x) {
            let of_channel = self.curves.iter_mut().filter(|collected| collected.channel == record.channel);
            of_channel.for_each(|collected| collected.curve.series.interrupt());
            return;
        }
        let Some(frame) = record.frame() else {
            return;
        };
        let mut values = std::mem::take(&mut self.values);
        if let Some(message) = self.decoder.decode(record.channel, frame, &mut values) {
            for value in &values {
                self.value(record.channel, message, value, x);
            }
        }
        self.values = values;
    }

    fn value(&mut self, channel: u8, message: MessageRef, value: &SignalValue, x: f64) {
        let decoder = self.decoder;
        let Some(signal) = decoder.message(message).signals.get(value.signal as usize) else {
            return;
        };
        let curves = &mut self.curves;
        let place = match self.places.entry((channel, message, value.signal)) {
            std::collections::hash_map::Entry::Occupied(place) => *place.get(),
            std::collections::hash_map::Entry::Vacant(_) if curves.len() == MOST_CURVES => {
                self.left_out += 1;
                return;
            }
            std::collections::hash_map::Entry::Vacant(vacant) => {
                curves.push(Collected {
                    channel,
                    message,
                    signal: value.signal,
                    curve: curve_of(signal),
                    digital: signal.digital.is_some() || signal.length == 1,
                    state: false,
                });
                *vacant.insert(curves.len() - 1)
            }
        };
        let collected = &mut curves[place];
        let y = if collected.digital {
            collected.state = match signal.digital {
                Some(digital) => digital.state(collected.state, value.value),
                None => value.raw != 0,
            };
            f64::from(u8::from(collected.state))
        } else {
            value.value
        };
        collected.curve.series.push(x, y);
    }

    /// Values of signals that found no room among [`MOST_CURVES`].
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Whether any signal was seen.
    pub fn is_empty(&self) -> bool {
        self.curves.is_empty()
    }

    /// The picture: a pane per unit, one per signal without a unit, and a last one for digital signals.
    pub fn finish(mut self, title: String) -> Plot {
        self.name_curves();
        let mut panes: Vec<Pane> = Vec::new();
        let mut digital = Vec::new();
        // Signals come in the order of their first frames; by message and place they are easier to find.
        self.curves.sort_by_key(|collected| (collected.channel, collected.message, collected.signal));
        for collected in self.curves {
            let signal = &self.decoder.message(collected.message).signals[collected.signal as usize];
            if collected.digital {
                digital.push(collected.curve);
                continue;
            }
            let same_unit =
                panes.iter_mut().find(|pane| !signal.unit.is_empty() && pane.label == signal.unit);
            match same_unit.map(|pane| &mut pane.content) {
                Some(Content::Analogue(curves)) => curves.push(collected.curve),
                _ => panes.push(Pane {
                    label: signal.unit.clone(),
                    range: None,
                    content: Content::Analogue(vec![collected.curve]),
                }),
            }
        }
        if !digital.is_empty() {
            panes.push(Pane { label: String::new(), range: None, content: Content::Digital(digital) });
        }
        Plot { title, axis: self.axis.axis(), panes, gaps: self.gaps.finish(self.end) }
    }

    /// The signal's name; with its message and channel where it would not be the only one.
    fn name_curves(&mut self) {
        let names: Vec<_> = self
            .curves
            .iter()
            .map(|collected| {
                let message = self.decoder.message(collected.message);
                let name = &message.signals[collected.signal as usize].name;
                (name.clone(), format!("{}.{name}", message.name), collected.channel)
            })
            .collect();
        for (index, (name, full, channel)) in names.iter().enumerate() {
            let others =
                || names.iter().enumerate().filter(|(other, _)| *other != index).map(|(_, name)| name);
            self.curves[index].curve.name = if others().any(|(_, other, _)| other == full) {
                format!("{channel}:{full}")
            } else if others().any(|(other, _, _)| other == name) {
                full.clone()
            } else {
                name.clone()
            };
        }
    }
}

fn curve_of(signal: &Signal) -> Curve {
    Curve {
        colour: signal.colour.map(|colour| [colour.red, colour.green, colour.blue]),
        // A gear or a state has nothing between its values.
        stepped: !signal.values.is_empty() || signal.digital.is_some() || signal.length == 1,
        alarm_below: signal.alarms.min,
        alarm_above: signal.alarms.max,
        ..Curve::new(signal.name.clone())
    }
}

/// Collects bus load over time.
pub struct LoadCollector {
    statistics: Statistics,
    axis: TimeAxis,
    gaps: Gaps,
    end: f64,
    channels: Vec<(u8, Curve)>,
    in_per_cent: bool,
}

impl LoadCollector {
    /// Nothing collected yet. Without a bit rate it shows frames per second.
    pub fn new(options: Options) -> Result<Self, BadOptions> {
        let in_per_cent = options.bitrate_bps.is_some() || !options.channel_bitrate_bps.is_empty();
        Ok(Self {
            statistics: Statistics::new(options)?,
            axis: TimeAxis::default(),
            gaps: Gaps::default(),
            end: 0.0,
            channels: Vec::new(),
            in_per_cent,
        })
    }

    /// Takes the next record of the trace.
    pub fn push(&mut self, record: &TraceRecord) {
        let x = self.axis.seconds(record.time_ns);
        self.end = self.end.max(x);
        self.gaps.push(record, x);
        let (axis, channels, in_per_cent) = (&mut self.axis, &mut self.channels, self.in_per_cent);
        self.statistics.push_with(record, |window| add_window(window, axis, channels, in_per_cent));
    }

    /// The picture.
    pub fn finish(mut self, title: String) -> Plot {
        let (axis, channels, in_per_cent) = (&mut self.axis, &mut self.channels, self.in_per_cent);
        self.statistics.finish_with(|window| add_window(window, axis, channels, in_per_cent));
        self.channels.sort_by_key(|(channel, _)| *channel);
        let curves: Vec<_> = self.channels.into_iter().map(|(_, curve)| curve).collect();
        let points = curves.iter().flat_map(|curve| curve.series.points());
        let most = points.map(|point| point.y).fold(0.0, f64::max);
        // From zero, so that heights compare; a quiet bus should not be a line at the bottom.
        let top = [5.0, 10.0, 20.0, 50.0, 100.0].into_iter().find(|top| *top >= most).unwrap_or(100.0);
        let (label, range) = if in_per_cent { ("load %", Some((0.0, top))) } else { ("frames/s", None) };
        let pane = Pane { label: label.to_owned(), range, content: Content::Analogue(curves) };
        Plot { title, axis: self.axis.axis(), panes: vec![pane], gaps: self.gaps.finish(self.end) }
    }
}

fn add_window(window: &Window, axis: &mut TimeAxis, channels: &mut Vec<(u8, Curve)>, in_per_cent: bool) {
    let place = channels.iter().position(|(channel, _)| *channel == window.channel).unwrap_or_else(|| {
        let curve = Curve { stepped: true, ..Curve::new(format!("channel {}", window.channel)) };
        channels.push((window.channel, curve));
        channels.len() - 1
    });
    let y = match window.load_pct {
        // All its frames are missing: nothing is known. One that lacks some is drawn, as the lower bound that it is.
        _ if window.incomplete && window.frames == 0 => f64::NAN,
        Some(load) if in_per_cent => load,
        _ if in_per_cent => f64::NAN,
        _ => window.frames_per_s(),
    };
    let series = &mut channels[place].1.series;
    series.push(axis.seconds(window.start_ns).max(0.0), y);
    series.push(axis.seconds(window.start_ns.saturating_add(window.length_ns as i64)), y);
}

/// Collects how long the intervals between an identifier's frames are.
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
    /// Nothing collected yet.
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

    /// The picture, a pane per channel; empty where there are not two frames.
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
    use super::*;
    use crate::Direction;
    use crate::signals::{Database, Digital, Message, Source};

    fn frame(time_ms: i64, text: &str) -> TraceRecord {
        let frame = text.parse().unwrap();
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        TraceRecord { time_ns: time_ms * 1_000_000, channel: 1, event }
    }

    fn lost(time_ms: i64, count: u32) -> TraceRecord {
        let event = TraceEvent::Lost { stage: None, count, at_least: false };
        TraceRecord { event, ..frame(time_ms, "000#") }
    }

    fn decoder() -> Decoder {
        let signal =
            |name: &str, start, unit: &str| Signal { unit: unit.to_owned(), ..Signal::new(name, start, 8) };
        let message = Message {
            id: Id::standard(0x123).unwrap(),
            name: "Engine".to_owned(),
            description: String::new(),
            length: 4,
            cycle_ms: None,
            j1939: false,
            signals: vec![
                signal("Oil", 0, "°C"),
                signal("Water", 8, "°C"),
                signal("Speed", 16, "km/h"),
                Signal { digital: Some(Digital { low: 10.0, high: 20.0 }), ..signal("Warm", 0, "") },
            ],
            line: 0,
        };
        let database = Database { messages: vec![message], ..Database::default() };
        Decoder::new(vec![Source { channel: None, database }])
    }

    #[test]
    fn signals_of_a_unit_share_a_pane_and_digital_ones_have_their_own() {
        let decoder = decoder();
        let mut collector = SignalCollector::new(&decoder);
        for (time, text) in [(0, "123#05.10.00"), (10, "123#19.11.01"), (20, "123#0F.12.02"), (25, "456#00")]
        {
            collector.push(&frame(time, text));
        }
        let plot = collector.finish("Engine".to_owned());
        let labels: Vec<_> = plot.panes.iter().map(|pane| pane.label.as_str()).collect();
        assert_eq!(labels, ["°C", "km/h", ""]);
        let names: Vec<_> = plot.panes[0].content.curves().iter().map(|curve| curve.name.as_str()).collect();
        assert_eq!(names, ["Oil", "Water"]);
        let Content::Digital(digital) = &plot.panes[2].content else { panic!("{:?}", plot.panes[2]) };
        // Off, on above the upper threshold, and still on between the two.
        let states: Vec<_> = digital[0].series.points().iter().map(|point| point.y).collect();
        assert_eq!(states, [0.0, 1.0, 1.0]);
    }

    #[test]
    fn a_loss_interrupts_curves_and_is_shaded_between_the_frames_around_it() {
        let decoder = decoder();
        let mut collector = SignalCollector::new(&decoder);
        for record in [frame(0, "123#01"), frame(10, "123#02"), lost(12, 7), frame(30, "123#03"), lost(35, 2)]
        {
            collector.push(&record);
        }
        let plot = collector.finish(String::new());
        let gaps = [Gap { from: 0.01, to: 0.03, frames: 7 }, Gap { from: 0.03, to: 0.035, frames: 2 }];
        assert_eq!(plot.gaps, gaps);
        let points = plot.panes[0].content.curves()[0].series.points();
        assert_eq!(
            points.iter().map(|point| point.y.is_nan()).collect::<Vec<_>>(),
            [false, false, true, false, true]
        );
    }

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
