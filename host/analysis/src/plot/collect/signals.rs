//! The curves of signals, and of values that something else than a database has named.

use std::collections::HashMap;

use super::super::layout::vertical_range;
use super::super::model::{Content, Curve, PALETTE, Pane, Plot};
use super::named::{Named, NamedValue, distinct_names};
use super::{Gaps, TimeAxis};
use crate::Cadence;
use cantap_signals::{Decoder, MessageRef, Signal, SignalValue};
use cantap_trace::TraceRecord;

/// The default limit of curves in one picture: more could hardly be told apart.
pub const MOST_CURVES: usize = 24;

/// Collects the curves of the signals selected in a decoder, and of [`NamedValue`]s.
pub struct SignalCollector<'a> {
    decoder: &'a Decoder,
    axis: TimeAxis,
    gaps: Gaps,
    end: f64,
    /// Curve of each signal: channel, message, signal.
    places: HashMap<(u8, MessageRef, u32), usize>,
    /// Curve of each value that has a name of its own, by channel.
    named: HashMap<(u8, Named), usize>,
    curves: Vec<Collected>,
    most_curves: usize,
    left_out: u64,
    values: Vec<SignalValue>,
}

struct Collected {
    channel: u8,
    of: Of,
    unit: String,
    curve: Curve,
    digital: bool,
    state: bool,
    cadence: Cadence,
}

/// What a curve shows. Signals come before others.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Of {
    Signal(MessageRef, u32),
    Named(Named),
}

impl<'a> SignalCollector<'a> {
    /// Nothing has been collected yet.
    pub fn new(decoder: &'a Decoder) -> Self {
        Self {
            decoder,
            axis: TimeAxis::default(),
            gaps: Gaps::default(),
            end: 0.0,
            places: HashMap::new(),
            named: HashMap::new(),
            curves: Vec::new(),
            most_curves: MOST_CURVES,
            left_out: 0,
            values: Vec::new(),
        }
    }

    /// Draws up to this many curves instead of [`MOST_CURVES`].
    #[must_use]
    pub fn with_most_curves(self, most_curves: usize) -> Self {
        Self { most_curves, ..self }
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
                self.value(record, message, value, x);
            }
        }
        self.values = values;
    }

    fn value(&mut self, record: &TraceRecord, message: MessageRef, value: &SignalValue, x: f64) {
        let (decoder, channel, most) = (self.decoder, record.channel, self.most_curves);
        let Some(signal) = decoder.message(message).signals.get(value.signal as usize) else {
            return;
        };
        let curves = &mut self.curves;
        let place = match self.places.entry((channel, message, value.signal)) {
            std::collections::hash_map::Entry::Occupied(place) => *place.get(),
            std::collections::hash_map::Entry::Vacant(_) if curves.len() >= most => {
                self.left_out += 1;
                return;
            }
            std::collections::hash_map::Entry::Vacant(vacant) => {
                curves.push(Collected {
                    channel,
                    of: Of::Signal(message, value.signal),
                    unit: signal.unit.clone(),
                    curve: curve_of(signal),
                    digital: signal.digital.is_some() || signal.length == 1,
                    state: false,
                    cadence: Cadence::new(decoder.message(message).cycle_ms),
                });
                *vacant.insert(curves.len() - 1)
            }
        };
        let collected = &mut curves[place];
        // Its value while it was silent is unknown: a line would suggest otherwise.
        if collected.cadence.arrive(record.time_ns) {
            collected.curve.series.interrupt();
        }
        let y = if value.value.is_nan() {
            f64::NAN
        } else if collected.digital {
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

    /// Takes a value that something else than a database has named; one that is missing interrupts its curve. Records and values come in the order of their times.
    pub fn push_named(&mut self, value: &NamedValue<'_>) {
        let x = self.axis.seconds(value.time_ns);
        self.end = self.end.max(x);
        let key = (value.channel, Named::of(value));
        let place = match self.named.get(&key) {
            Some(place) => *place,
            None if value.value.is_nan() => return,
            None if self.curves.len() >= self.most_curves => {
                self.left_out += 1;
                return;
            }
            None => {
                self.curves.push(Collected {
                    channel: value.channel,
                    of: Of::Named(key.1.clone()),
                    unit: value.unit.to_owned(),
                    curve: Curve::new(value.name.to_owned()),
                    digital: false,
                    state: false,
                    cadence: Cadence::new(None),
                });
                self.named.insert(key, self.curves.len() - 1);
                self.curves.len() - 1
            }
        };
        let collected = &mut self.curves[place];
        if collected.cadence.arrive(value.time_ns) {
            collected.curve.series.interrupt();
        }
        if let Some(text) = value.text.filter(|_| value.value.is_finite()) {
            collected.curve.stepped = true;
            let texts = &mut collected.curve.texts;
            // A text belongs to one number, exactly.
            if texts.len() < MOST_TEXTS
                && !texts.iter().any(|(known, _)| known.total_cmp(&value.value).is_eq())
            {
                texts.push((value.value, text.to_owned()));
            }
        }
        collected.curve.series.push(x, value.value);
    }

    /// The number of values of signals beyond the limit of curves.
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Whether there are no curves.
    pub fn is_empty(&self) -> bool {
        self.curves.is_empty()
    }

    /// The picture: a pane per unit (and per this many curves as there are colours), one per signal without a unit, and a last one for digital
    /// signals.
    pub fn finish(mut self, title: String) -> Plot {
        self.name_curves();
        let mut panes: Vec<Pane> = Vec::new();
        let mut digital = Vec::new();
        // Signals come in the order of their first frames, but are easier to find by message and position.
        self.curves.sort_by(|a, b| (a.channel, &a.of).cmp(&(b.channel, &b.of)));
        for mut collected in self.curves {
            collected.curve.texts.sort_by(|(a, _), (b, _)| a.total_cmp(b));
            if collected.digital {
                digital.push(collected.curve);
                continue;
            }
            let has_room = |pane: &&mut Pane| {
                !collected.unit.is_empty()
                    && pane.label == collected.unit
                    && pane.content.curves().len() < PALETTE.len()
            };
            let same_unit = panes.iter_mut().find(has_room);
            match same_unit.map(|pane| &mut pane.content) {
                Some(Content::Analogue(curves)) => curves.push(collected.curve),
                _ => panes.push(Pane {
                    label: collected.unit,
                    range: None,
                    content: Content::Analogue(vec![collected.curve]),
                }),
            }
        }
        share_scales(&mut panes);
        if !digital.is_empty() {
            panes.push(Pane { label: String::new(), range: None, content: Content::Digital(digital) });
        }
        Plot { title, axis: self.axis.axis(), panes, gaps: self.gaps.finish(self.end) }
    }

    /// Names curves by signal, adding message and channel where the name would be ambiguous; values with a name of their own by that.
    fn name_curves(&mut self) {
        let mut names: Vec<_> = self
            .curves
            .iter()
            .map(|collected| match &collected.of {
                Of::Signal(message, signal) => {
                    let message = self.decoder.message(*message);
                    let name = &message.signals[*signal as usize].name;
                    (name.clone(), format!("{}.{name}", message.name), collected.channel)
                }
                Of::Named(named) => (named.name.clone(), String::new(), collected.channel),
            })
            .collect();
        let named = self.curves.iter().map(|collected| match &collected.of {
            Of::Signal(..) => None,
            Of::Named(named) => Some((collected.channel, named)),
        });
        for (name, distinct) in names.iter_mut().zip(distinct_names(&named.collect::<Vec<_>>())) {
            if let Some(distinct) = distinct {
                (name.0, name.1) = (distinct.clone(), distinct);
            }
        }
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

/// Gives panes with the same unit the same range, so that their heights can be compared.
fn share_scales(panes: &mut [Pane]) {
    for first in 0..panes.len() {
        let label = panes[first].label.clone();
        let same: Vec<_> =
            (first..panes.len()).filter(|&at| !label.is_empty() && panes[at].label == label).collect();
        if same.len() < 2 || panes[first].range.is_some() {
            continue;
        }
        let ranges: Vec<_> = same.iter().map(|&at| vertical_range(&panes[at])).collect();
        let low = ranges.iter().map(|range| range.0).fold(f64::INFINITY, f64::min);
        let high = ranges.iter().map(|range| range.1).fold(f64::NEG_INFINITY, f64::max);
        for at in same {
            panes[at].range = Some((low, high));
        }
    }
}

/// Limit on the texts of a table on an axis.
const MOST_TEXTS: usize = 64;

fn curve_of(signal: &Signal) -> Curve {
    let texts = signal.values.iter().take(MOST_TEXTS);
    let value = |raw: i64| raw as f64 * signal.factor + signal.offset;
    Curve {
        texts: texts.map(|(raw, text)| (value(raw), text.to_owned())).collect(),
        whole: signal.integer(0).is_some() && signal.factor.fract() == 0.0 && signal.offset.fract() == 0.0,
        colour: signal.colour.map(|colour| [colour.red, colour.green, colour.blue]),
        // A gear or state has no values in between.
        stepped: !signal.values.is_empty() || signal.digital.is_some() || signal.length == 1,
        alarm_below: signal.alarms.min,
        alarm_above: signal.alarms.max,
        ..Curve::new(signal.name.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::Gap;
    use super::super::testing::{frame, lost};
    use super::*;
    use cantap_signals::{Database, Digital, Message, Source};
    use cantap_trace::Id;

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
            container: None,
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

    /// Twenty-five minutes without a frame must not become a straight line.
    #[test]
    fn silence_interrupts_a_curve() {
        let decoder = decoder();
        let mut collector = SignalCollector::new(&decoder);
        for time in (0..10).map(|n| n * 100).chain((0..10).map(|n| 1_500_000 + n * 100)) {
            collector.push(&frame(time, &format!("123#{:02X}", time / 100 % 200)));
        }
        let plot = collector.finish(String::new());
        let points = plot.panes[0].content.curves()[0].series.points();
        let breaks: Vec<_> = points.iter().filter(|point| point.y.is_nan()).map(|point| point.x).collect();
        assert_eq!(breaks, [0.9]);
    }

    #[test]
    fn many_curves_of_a_unit_share_their_scale_and_as_many_as_wanted_are_drawn() {
        let signals: Vec<_> = (0..8)
            .map(|n| Signal { unit: "V".to_owned(), ..Signal::new(format!("Cell{n}"), n * 8, 8) })
            .collect();
        let message = Message {
            signals,
            length: 8,
            ..decoder().message(decoder().signals().next().unwrap().0).clone()
        };
        let database = Database { messages: vec![message], ..Database::default() };
        let decoder = Decoder::new(vec![Source { channel: None, database }]);
        let mut collector = SignalCollector::new(&decoder);
        for (time, text) in [(0, "123#00.01.02.03.04.05.06.C8"), (10, "123#01.02.03.04.05.06.07.C9")] {
            collector.push(&frame(time, text));
        }
        let plot = collector.finish(String::new());
        assert_eq!(plot.panes.len(), 2);
        assert_eq!(plot.panes[0].range, plot.panes[1].range);
        assert!(plot.panes[0].range.is_some_and(|(low, high)| low <= 0.0 && high >= 201.0));
        let mut few = SignalCollector::new(&decoder).with_most_curves(3);
        few.push(&frame(0, "123#0001020304050607"));
        assert_eq!((few.left_out(), few.finish(String::new()).panes[0].content.curves().len()), (5, 3));
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
}
