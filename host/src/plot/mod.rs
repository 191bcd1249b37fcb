//! Pictures of a trace: signals, bus load and period histograms as SVG, PNG, HTML or characters in a terminal.
//!
//! A [`Plot`] says what is to be seen: panes above each other that share a horizontal axis. `layout` turns
//! it once into lines, areas and text at places; the SVG, PNG and HTML writers only write those down, so
//! they show the same. The terminal has its own drawing, made of characters. The font is part of the
//! program: nothing is looked up on the machine.

mod collect;
mod histogram;
mod html;
mod layout;
mod png;
mod scale;
mod scene;
mod series;
mod svg;
mod text;

use std::path::Path;

pub use collect::{LoadCollector, MOST_CURVES, SignalCollector, TimingCollector};
pub use histogram::{Bar, Histogram};
pub use series::{MOST_POINTS, Point, Series};
pub use text::TextStyle;

/// A picture.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    /// What it shows, above everything.
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
        /// What zero is, such as a date; may be empty.
        zero: String,
    },
    /// Anything else, with its unit.
    Value {
        /// What it is, such as `period in ms`.
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
    /// The last thing known before it, on the horizontal axis.
    pub from: f64,
    /// The first thing known after it.
    pub to: f64,
    /// How many frames, as far as known.
    pub frames: u64,
}

/// One of the areas above each other.
#[derive(Clone, Debug)]
pub struct Pane {
    /// What its vertical axis shows, such as a unit; may be empty.
    pub label: String,
    /// The vertical range; by the data where there is none.
    pub range: Option<(f64, f64)>,
    /// What is in it.
    pub content: Content,
}

/// What a pane shows.
#[derive(Clone, Debug)]
pub enum Content {
    /// Curves over a common vertical axis.
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
    /// Its colour as red, green, blue; chosen from a palette for colour-blind eyes where there is none.
    pub colour: Option<[u8; 3]>,
    /// Its points. Between them a line is drawn, or for a stepped curve the value before.
    pub series: Series,
    /// Keeps its value until the next point instead of moving there in a line.
    pub stepped: bool,
    /// Below this value it is an alarm: shaded blue.
    pub alarm_below: Option<f64>,
    /// Above this value it is an alarm: shaded red.
    pub alarm_above: Option<f64>,
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
        }
    }
}

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The name does not say which format.
    #[error("'{0}' names no picture format; let it end in .svg, .png or .html")]
    UnknownFormat(String),
    /// The picture is too large, or too small, for PNG.
    #[error("a picture of {width} × {height} pixels cannot be drawn; choose another size")]
    Size {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// PNG encoding failed.
    #[error("cannot encode the picture as PNG: {0}")]
    Png(String),
    /// The file cannot be written.
    #[error("cannot write {0}: {1}; check folder, rights and free space")]
    Write(String, #[source] std::io::Error),
}

/// Format of a picture file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureFormat {
    /// Scalable vector graphics.
    Svg,
    /// Pixels.
    Png,
    /// A page with the vector graphics in it and a cursor that reads values.
    Html,
}

impl PictureFormat {
    /// The format that a file's name ends in.
    pub fn of_path(path: &Path) -> Result<Self, PlotError> {
        let suffix = path.extension().and_then(|suffix| suffix.to_str()).map(str::to_ascii_lowercase);
        match suffix.as_deref() {
            Some("svg") => Ok(Self::Svg),
            Some("png") => Ok(Self::Png),
            Some("html" | "htm") => Ok(Self::Html),
            _ => Err(PlotError::UnknownFormat(path.display().to_string())),
        }
    }
}

/// Width of a picture where none is asked for, in pixels.
pub const DEFAULT_WIDTH: u32 = 1200;

impl Plot {
    /// The picture as a file's content, `width` pixels wide; its height follows from its panes.
    pub fn render(&self, format: PictureFormat, width: u32) -> Result<Vec<u8>, PlotError> {
        let scene = layout::lay_out(self, width.clamp(320, 16_384));
        match format {
            PictureFormat::Svg => Ok(svg::write(&scene).into_bytes()),
            PictureFormat::Html => Ok(html::write(self, &scene).into_bytes()),
            PictureFormat::Png => png::write(&scene),
        }
    }

    /// Writes the picture to a file in the format of its suffix.
    pub fn save(&self, path: &Path, width: u32) -> Result<(), PlotError> {
        let bytes = self.render(PictureFormat::of_path(path)?, width)?;
        std::fs::write(path, bytes).map_err(|error| PlotError::Write(path.display().to_string(), error))
    }

    /// The picture as lines of characters.
    pub fn to_text(&self, style: &TextStyle) -> String {
        text::draw(self, style)
    }

    /// The horizontal range of everything in it; zero to one where there is nothing.
    fn span(&self) -> (f64, f64) {
        let mut span = scale::Range::default();
        for pane in &self.panes {
            for curve in pane.content.curves() {
                for point in curve.series.points() {
                    span.include(point.x);
                }
            }
            if let Content::Bars(bars) = &pane.content {
                // A clock's ticks, all alike, are one bar and no wall.
                for bar in bars {
                    span.include(bar.from - 10.0 * (bar.to - bar.from));
                    span.include(bar.to + 10.0 * (bar.to - bar.from));
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

/// Colours that all eyes can tell apart (Okabe and Ito, "Color Universal Design", 2008), without its yellow,
/// which is too pale on white.
const PALETTE: [[u8; 3]; 7] = [
    [0x00, 0x72, 0xB2],
    [0xD5, 0x5E, 0x00],
    [0x00, 0x9E, 0x73],
    [0xCC, 0x79, 0xA7],
    [0x56, 0xB4, 0xE9],
    [0xE6, 0x9F, 0x00],
    [0x33, 0x33, 0x33],
];

/// The colour of the curve that is `index`th in the whole plot.
fn colour_of(curve: &Curve, index: usize) -> [u8; 3] {
    curve.colour.unwrap_or(PALETTE[index % PALETTE.len()])
}

#[cfg(test)]
mod tests;
