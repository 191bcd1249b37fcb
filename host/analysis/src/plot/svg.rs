//! Scalable vector graphics.

use std::fmt::Write as _;

use super::scene::{Anchor, Colour, Scene, Shape};

/// The scene as an SVG document.
pub(super) fn write(scene: &Scene) -> String {
    let (width, height) = (scene.width, scene.height);
    let mut out = String::new();
    // Writing to a String cannot fail.
    let _ = write!(
        out,
        r#"<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" font-family="DejaVu Sans, Verdana, sans-serif">
<rect width="100%" height="100%" fill="white"/>
"#
    );
    for shape in &scene.shapes {
        shape_to(shape, &mut out);
    }
    out.push_str("</svg>\n");
    out
}

fn shape_to(shape: &Shape, out: &mut String) {
    let _ = match shape {
        Shape::Area { x, y, width, height, colour } => writeln!(
            out,
            r#"<rect x="{x:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}" {}/>"#,
            paint("fill", *colour)
        ),
        Shape::Line { points, colour, width, dashed, curve } => {
            let mut places = String::with_capacity(points.len() * 12);
            for (x, y) in points {
                let _ = write!(places, "{x:.1},{y:.1} ");
            }
            let dash = if *dashed { r#" stroke-dasharray="6 4""# } else { "" };
            writeln!(
                out,
                r#"<polyline{} points="{}" fill="none" {} stroke-width="{width}" stroke-linejoin="round"{dash}/>"#,
                belongs(*curve),
                places.trim_end(),
                paint("stroke", *colour)
            )
        }
        Shape::Dot { x, y, radius, colour, curve } => writeln!(
            out,
            r#"<circle{} cx="{x:.1}" cy="{y:.1}" r="{radius}" {}/>"#,
            belongs(*curve),
            paint("fill", *colour)
        ),
        Shape::Text { x, y, size, anchor, colour, text, full, curve } => {
            let anchor = match anchor {
                Anchor::Start => "start",
                Anchor::Middle => "middle",
                Anchor::End => "end",
            };
            // Shown where the pointer is.
            let full = full.as_ref().filter(|full| *full != text);
            let full = full.map_or(String::new(), |full| format!("<title>{}</title>", escaped(full)));
            writeln!(
                out,
                r#"<text{} x="{x:.1}" y="{y:.1}" font-size="{size}" text-anchor="{anchor}" {}>{full}{}</text>"#,
                belongs(*curve),
                paint("fill", *colour),
                escaped(text)
            )
        }
    };
}

fn belongs(curve: Option<usize>) -> String {
    curve.map(|curve| format!(r#" data-curve="{curve}""#)).unwrap_or_default()
}

fn paint(attribute: &str, Colour([red, green, blue], opacity): Colour) -> String {
    let mut out = format!(r##"{attribute}="#{red:02x}{green:02x}{blue:02x}""##);
    if opacity < 255 {
        let _ = write!(out, r#" {attribute}-opacity="{:.2}""#, f32::from(opacity) / 255.0);
    }
    out
}

/// Text with everything that has a meaning in XML escaped, and without characters that XML forbids.
pub(super) fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            character if cantap_trace::clean::is_harmful(character) => {}
            character => out.push(character),
        }
    }
    out
}
