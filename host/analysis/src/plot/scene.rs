//! Positioned shapes: what every picture format can draw.

/// A finished picture.
#[derive(Clone, Debug)]
pub(super) struct Scene {
    /// In pixels.
    pub width: f32,
    /// In pixels.
    pub height: f32,
    /// In drawing order.
    pub shapes: Vec<Shape>,
    /// The inner areas of the panes, for a cursor.
    pub panes: Vec<PaneArea>,
    /// The horizontal range that the panes' width shows.
    pub span: (f64, f64),
}

/// Where a pane is.
#[derive(Clone, Copy, Debug)]
pub(super) struct PaneArea {
    pub left: f32,
    pub top: f32,
    pub right: f32,
    pub bottom: f32,
}

/// Red, green, blue and opacity: 0 to 255.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Colour(pub [u8; 3], pub u8);

/// Which part of a text its position refers to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

/// Something to draw. Coordinates are in pixels from the upper left corner.
#[derive(Clone, Debug)]
pub(super) enum Shape {
    Area {
        x: f32,
        y: f32,
        width: f32,
        height: f32,
        colour: Colour,
    },
    Line {
        points: Vec<(f32, f32)>,
        colour: Colour,
        width: f32,
        dashed: bool,
        curve: Option<usize>,
    },
    Dot {
        x: f32,
        y: f32,
        radius: f32,
        colour: Colour,
        curve: Option<usize>,
    },
    Text {
        x: f32,
        y: f32,
        size: f32,
        anchor: Anchor,
        colour: Colour,
        text: String,
        /// The whole text, if this may be only its beginning.
        full: Option<String>,
        curve: Option<usize>,
    },
}
