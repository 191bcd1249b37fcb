//! Pixels: the scene drawn with tiny-skia, and text as outlines of a built-in font.

use ab_glyph::{Font, FontRef, OutlineCurve, ScaleFont};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, PathBuilder, Pixmap, Rect, Stroke, StrokeDash, Transform,
};

use super::PlotError;
use super::scene::{Anchor, Colour, Scene, Shape};

/// Pixels per scene unit: sharp on today's screens.
const PIXELS_PER_UNIT: f32 = 1.5;

/// The scene as a PNG file's content.
pub(super) fn write(scene: &Scene) -> Result<Vec<u8>, PlotError> {
    let width = (scene.width * PIXELS_PER_UNIT).ceil() as u32;
    let height = (scene.height * PIXELS_PER_UNIT).ceil() as u32;
    let mut pixmap = Pixmap::new(width, height).ok_or(PlotError::Size { width, height })?;
    pixmap.fill(Color::WHITE);
    let font = FontRef::try_from_slice(dejavu::sans::regular())
        .map_err(|error| PlotError::Png(format!("the program's own font: {error}")))?;
    for shape in &scene.shapes {
        draw(shape, &mut pixmap, &font);
    }
    pixmap.encode_png().map_err(|error| PlotError::Png(error.to_string()))
}

fn draw(shape: &Shape, pixmap: &mut Pixmap, font: &FontRef<'_>) {
    let scale = Transform::from_scale(PIXELS_PER_UNIT, PIXELS_PER_UNIT);
    match shape {
        Shape::Area { x, y, width, height, colour } => {
            if let Some(area) = Rect::from_xywh(*x, *y, *width, *height) {
                pixmap.fill_rect(area, &paint(*colour), scale, None);
            }
        }
        Shape::Line { points, colour, width, dashed, .. } => {
            let mut path = PathBuilder::new();
            for (index, (x, y)) in points.iter().enumerate() {
                if index == 0 { path.move_to(*x, *y) } else { path.line_to(*x, *y) }
            }
            let dash = if *dashed { StrokeDash::new(vec![6.0, 4.0], 0.0) } else { None };
            let stroke = Stroke {
                width: *width,
                line_join: LineJoin::Round,
                line_cap: LineCap::Butt,
                dash,
                ..Stroke::default()
            };
            if let Some(path) = path.finish() {
                pixmap.stroke_path(&path, &paint(*colour), &stroke, scale, None);
            }
        }
        Shape::Dot { x, y, radius, colour, .. } => {
            if let Some(path) = PathBuilder::from_circle(*x, *y, *radius) {
                pixmap.fill_path(&path, &paint(*colour), FillRule::Winding, scale, None);
            }
        }
        Shape::Text { x, y, size, anchor, colour, text, .. } => {
            draw_text(pixmap, font, (*x, *y), *size, *anchor, *colour, text);
        }
    }
}

fn draw_text(
    pixmap: &mut Pixmap,
    font: &FontRef<'_>,
    (x, y): (f32, f32),
    size: f32,
    anchor: Anchor,
    colour: Colour,
    text: &str,
) {
    // A size in pixels means the em square, as in SVG; ab_glyph's own scale means ascent plus descent.
    let units_per_em = font.units_per_em().unwrap_or(1000.0);
    let scale = size * font.height_unscaled() / units_per_em;
    let scaled = font.as_scaled(scale);
    let advance: f32 = text.chars().map(|character| scaled.h_advance(scaled.glyph_id(character))).sum();
    let mut left = match anchor {
        Anchor::Start => x,
        Anchor::Middle => x - advance / 2.0,
        Anchor::End => x - advance,
    };
    let factor = size / units_per_em;
    let mut path = PathBuilder::new();
    for character in text.chars() {
        let glyph = scaled.glyph_id(character);
        if let Some(outline) = font.outline(glyph) {
            // Font units grow upwards, pixels downwards.
            let place = |point: ab_glyph::Point| (left + point.x * factor, y - point.y * factor);
            let mut end = None;
            for curve in &outline.curves {
                let (start, next) = match curve {
                    OutlineCurve::Line(a, b)
                    | OutlineCurve::Quad(a, _, b)
                    | OutlineCurve::Cubic(a, _, _, b) => (place(*a), place(*b)),
                };
                if end != Some(start) {
                    path.move_to(start.0, start.1);
                }
                match curve {
                    OutlineCurve::Line(..) => path.line_to(next.0, next.1),
                    OutlineCurve::Quad(_, by, _) => {
                        let by = place(*by);
                        path.quad_to(by.0, by.1, next.0, next.1);
                    }
                    OutlineCurve::Cubic(_, first, second, _) => {
                        let (first, second) = (place(*first), place(*second));
                        path.cubic_to(first.0, first.1, second.0, second.1, next.0, next.1);
                    }
                }
                end = Some(next);
            }
        }
        left += scaled.h_advance(glyph);
    }
    if let Some(path) = path.finish() {
        let transform = Transform::from_scale(PIXELS_PER_UNIT, PIXELS_PER_UNIT);
        pixmap.fill_path(&path, &paint(colour), FillRule::Winding, transform, None);
    }
}

fn paint(Colour([red, green, blue], opacity): Colour) -> Paint<'static> {
    let mut paint = Paint::default();
    paint.set_color_rgba8(red, green, blue, opacity);
    paint.anti_alias = true;
    paint
}
