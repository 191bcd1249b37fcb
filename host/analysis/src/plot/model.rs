//! What to show: panes above each other that share a horizontal axis.

use super::histogram::Bar;
use super::scale::{self, Range};
use super::series::Series;

/// A picture.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    /// Its title, at the top.
    pub title: String,
    /// The horizontal axis of all panes.
    pub axis: Axis,
    /// The panes, the uppermost first.
    pub panes: Vec<Pane>,
    /// Where frames are missing, shaded on every pane.
    pub gaps: Vec<Gap>,
}

/// What the horizontal axis shows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Axis {
    /// Time in seconds.
    Time {
        /// What zero means, such as a date; may be empty.
        zero: String,
    },
    /// Anything else, with its unit.
    Value {
        /// Its label, such as `period in ms`.
        label: String,
    },
}

impl Default for Axis {
    fn default() -> Self {
        Self::Time { zero: String::new() }
    }
}

/// A place where frames are missing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gap {
    /// The last known point before it, on the horizontal axis.
    pub from: f64,
    /// The first known point after it.
    pub to: f64,
    /// Number of missing frames, as far as known.
    pub frames: u64,
}

/// One of the areas above each other.
#[derive(Clone, Debug)]
pub struct Pane {
    /// The label of its vertical axis, such as a unit; may be empty.
    pub label: String,
    /// The vertical range; `None` to derive it from the data.
    pub range: Option<(f64, f64)>,
    /// Its content.
    pub content: Content,
}

/// What a pane shows.
#[derive(Clone, Debug)]
pub enum Content {
    /// Curves on a common vertical axis.
    Analogue(Vec<Curve>),
    /// Signals that are on (1) or off (0), one above the other.
    Digital(Vec<Curve>),
    /// How often something was between two values.
    Bars(Vec<Bar>),
}

impl Content {
    /// The curves, if it has any.
    pub fn curves(&self) -> &[Curve] {
        match self {
            Self::Analogue(curves) | Self::Digital(curves) => curves,
            Self::Bars(_) => &[],
        }
    }
}

/// One signal.
#[derive(Clone, Debug)]
pub struct Curve {
    /// Its name, for the legend.
    pub name: String,
    /// Its colour as red, green, blue; `None` for one from a palette suitable for colour-blind people.
    pub colour: Option<[u8; 3]>,
    /// Its points. They are joined by lines; a stepped curve keeps the previous value in between.
    pub series: Series,
    /// Whether the value stays the same until the next point instead of moving there in a line.
    pub stepped: bool,
    /// Values below this are an alarm: shaded blue.
    pub alarm_below: Option<f64>,
    /// Values above this are an alarm: shaded red.
    pub alarm_above: Option<f64>,
    /// Texts for values, in ascending order: shown on the axis and at the cursor.
    pub texts: Vec<(f64, String)>,
    /// Whether it has only whole numbers, so that its axis shows nothing between them.
    pub whole: bool,
}

impl Curve {
    /// A curve without points.
    pub fn new(name: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            colour: None,
            series: Series::default(),
            stepped: false,
            alarm_below: None,
            alarm_above: None,
            texts: Vec::new(),
            whole: false,
        }
    }
}

impl Pane {
    /// Whether its vertical axis has only whole numbers.
    pub(super) fn is_whole(&self) -> bool {
        match &self.content {
            Content::Bars(_) => true,
            Content::Analogue(curves) => !curves.is_empty() && curves.iter().all(|curve| curve.whole),
            Content::Digital(_) => false,
        }
    }

    /// The texts on its vertical axis, if it has a single curve.
    pub(super) fn texts(&self) -> &[(f64, String)] {
        match &self.content {
            Content::Analogue(curves) if curves.len() == 1 => &curves[0].texts,
            _ => &[],
        }
    }

    /// Ticks of the vertical axis, about `wanted` of them, with their labels.
    pub(super) fn ticks(&self, range: (f64, f64), wanted: usize) -> Vec<(f64, String)> {
        let shown = |(value, _): &&(f64, String)| (range.0..=range.1).contains(value);
        let texts: Vec<_> = self.texts().iter().filter(shown).cloned().collect();
        if !texts.is_empty() && texts.len() <= wanted * 2 {
            return texts;
        }
        let (ticks, step) =
            if self.is_whole() { scale::whole_ticks(range, wanted) } else { scale::ticks(range, wanted) };
        ticks.into_iter().map(|tick| (tick, scale::label(tick, step))).collect()
    }
}

impl Plot {
    /// Whether there is not a single value in it.
    pub fn is_empty(&self) -> bool {
        self.panes.iter().all(|pane| match &pane.content {
            Content::Bars(bars) => bars.iter().all(|bar| bar.count == 0),
            content => content
                .curves()
                .iter()
                .all(|curve| curve.series.points().iter().all(|point| point.y.is_nan())),
        })
    }

    /// The horizontal range of its whole content; zero to one if it is empty.
    pub(super) fn span(&self) -> (f64, f64) {
        let mut span = Range::default();
        for pane in &self.panes {
            for curve in pane.content.curves() {
                for point in curve.series.points() {
                    span.include(point.x);
                }
            }
            if let Content::Bars(bars) = &pane.content {
                // From zero, so that the scatter is seen in proportion to the period.
                span.include(0.0);
                for bar in bars {
                    span.include(bar.to * 1.05);
                }
            }
        }
        for gap in &self.gaps {
            span.include(gap.from);
            span.include(gap.to);
        }
        span.or_unit()
    }
}

/// Colours that everyone can tell apart (Okabe and Ito, "Color Universal Design", 2008), without its yellow,
/// which is too pale on white.
pub(super) const PALETTE: [[u8; 3]; 7] = [
    [0x00, 0x72, 0xB2],
    [0xD5, 0x5E, 0x00],
    [0x00, 0x9E, 0x73],
    [0xCC, 0x79, 0xA7],
    [0x56, 0xB4, 0xE9],
    [0xE6, 0x9F, 0x00],
    [0x33, 0x33, 0x33],
];

/// The colour of a curve with this index in the whole plot.
pub(super) fn colour_of(curve: &Curve, index: usize) -> [u8; 3] {
    curve.colour.unwrap_or(PALETTE[index % PALETTE.len()])
}
