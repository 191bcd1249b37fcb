//! Pictures of a trace: signals, bus load and period histograms as SVG, PNG, HTML or text for a terminal.
//!
//! A [`Plot`] describes what to show: panes above each other that share a horizontal axis. `layout` turns it
//! once into positioned lines, areas and text; the SVG, PNG and HTML writers only write those down, so they
//! show the same. The terminal has its own drawing, made of characters. The font is part of the program:
//! nothing is looked up on the machine.

mod collect;
mod error;
mod histogram;
mod html;
mod layout;
mod model;
mod png;
pub mod scale;
mod scene;
mod series;
mod svg;
mod text;

use std::path::Path;

pub use collect::{LoadCollector, MOST_CURVES, NamedValue, SignalCollector, TimingCollector};
pub use error::PlotError;
pub use histogram::{Bar, Histogram};
pub use model::{Axis, Content, Curve, Gap, Pane, Plot};
pub use series::{MOST_POINTS, Point, Series};
pub use text::TextStyle;

/// Format of a picture file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PictureFormat {
    /// Scalable vector graphics.
    Svg,
    /// Pixels.
    Png,
    /// A page with the vector graphics and a cursor that reads values.
    Html,
}

impl PictureFormat {
    /// The format for a file name's suffix.
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

/// Default width of a picture, in pixels.
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
}

#[cfg(test)]
mod tests;
