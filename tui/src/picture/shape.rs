//! Characters as shapes. Fonts differ in how wide their Braille, block and line characters are, or lack them; in a curve or a frame made of
//! them, that shows.

use std::fmt::Write as _;

/// Thickness of a thin line, and of a thick one.
const THICKNESS: [f64; 2] = [1.2, 2.8];
/// A Braille dot's side.
const DOT: f64 = 2.4;

/// A character's place: the left upper corner of its cell, and its size.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub x: f64,
    pub y: f64,
    pub width: f64,
    pub height: f64,
}

/// Appends the shape to the data of an SVG path; false if the character is one to be written with a font.
pub fn append(path: &mut String, character: char, place: Place) -> bool {
    let Place { width, height, .. } = place;
    let (middle_x, middle_y) = (width / 2.0, height / 2.0);
    match character {
        '\u{2800}'..='\u{28FF}' => braille(path, character as u32 - 0x2800, place),
        // Blocks of one to eight eighths, from below.
        '▁'..='█' => {
            let filled = height * f64::from(character as u32 - 0x2580) / 8.0;
            place.rectangle(path, (0.0, height - filled), (width, filled));
        }
        '▔' => place.rectangle(path, (0.0, 0.0), (width, height / 8.0)),
        // A quarter of the cell.
        '░' => {
            for dot in 0..8 {
                let (column, row) = (f64::from(dot % 2), f64::from(dot / 2));
                let corner = (column * width / 2.0, row * height / 4.0);
                place.rectangle(path, corner, (width / 4.0, height / 8.0));
            }
        }
        '▲' | '▴' | '▼' | '▾' | '▸' => {
            let (side, small) = (width - 1.0, if matches!(character, '▲' | '▼') { 1.0 } else { 0.75 });
            let half = side * small / 2.0;
            place.polygon(
                path,
                &match character {
                    '▲' | '▴' => [(-half, half), (0.0, -half), (half, half)],
                    '▼' | '▾' => [(-half, -half), (0.0, half), (half, -half)],
                    _ => [(-half, -half), (half, 0.0), (-half, half)],
                },
            );
        }
        '◆' => {
            let half = middle_x - 0.4;
            place.polygon(path, &[(-half, 0.0), (0.0, -half), (half, 0.0), (0.0, half)]);
        }
        '●' => {
            let radius = middle_x - 0.8;
            let (left, y) = (place.x + middle_x - radius, place.y + middle_y);
            // Two half circles. Writing to a String cannot fail.
            for (x, way) in [(left, 2.0 * radius), (left + 2.0 * radius, -2.0 * radius)] {
                let _ = write!(path, "M{x:.1} {y:.1}a{radius:.1} {radius:.1} 0 0 1 {way:.1} 0");
            }
            path.push('z');
        }
        _ => return lines(path, character, place),
    }
    true
}

/// The dots of a Braille character, one bit each.
fn braille(path: &mut String, dots: u32, place: Place) {
    /// Column and row of each bit's dot.
    const DOTS: [(u8, u8); 8] = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3)];
    for (bit, (column, row)) in DOTS.into_iter().enumerate() {
        if dots >> bit & 1 == 1 {
            let x = (f64::from(column) + 0.5) * place.width / 2.0 - DOT / 2.0;
            let y = (f64::from(row) + 0.5) * place.height / 4.0 - DOT / 2.0;
            place.rectangle(path, (x, y), (DOT, DOT));
        }
    }
}

/// Lines from the middle of the cell to its edges.
fn lines(path: &mut String, character: char, place: Place) -> bool {
    // To the left, right, top, and bottom.
    let (arms, thickness) = match character {
        '─' => ([true, true, false, false], THICKNESS[0]),
        '━' => ([true, true, false, false], THICKNESS[1]),
        '│' => ([false, false, true, true], THICKNESS[0]),
        '╵' => ([false, false, true, false], THICKNESS[0]),
        '┌' => ([false, true, false, true], THICKNESS[0]),
        '┐' => ([true, false, false, true], THICKNESS[0]),
        '└' => ([false, true, true, false], THICKNESS[0]),
        '┘' => ([true, false, true, false], THICKNESS[0]),
        '├' => ([false, true, true, true], THICKNESS[0]),
        '┤' => ([true, false, true, true], THICKNESS[0]),
        '┬' => ([true, true, false, true], THICKNESS[0]),
        '┴' => ([true, true, true, false], THICKNESS[0]),
        '┼' => ([true; 4], THICKNESS[0]),
        _ => return false,
    };
    let [left, right, top, bottom] = arms;
    let half = thickness / 2.0;
    let (x, y) = (place.width / 2.0, place.height / 2.0);
    if left || right {
        let from = if left { 0.0 } else { x - half };
        let to = if right { place.width } else { x + half };
        place.rectangle(path, (from, y - half), (to - from, thickness));
    }
    if top || bottom {
        let from = if top { 0.0 } else { y - half };
        let to = if bottom { place.height } else { y + half };
        place.rectangle(path, (x - half, from), (thickness, to - from));
    }
    true
}

impl Place {
    /// A rectangle by its corner within the cell and its size.
    fn rectangle(self, path: &mut String, (x, y): (f64, f64), (width, height): (f64, f64)) {
        let (x, y) = (self.x + x, self.y + y);
        // Writing to a String cannot fail.
        let _ = write!(path, "M{x:.1} {y:.1}h{width:.1}v{height:.1}h-{width:.1}z");
    }

    /// A polygon around the cell's middle.
    fn polygon(self, path: &mut String, corners: &[(f64, f64)]) {
        for (at, (x, y)) in corners.iter().enumerate() {
            let (x, y) = (self.x + self.width / 2.0 + x, self.y + self.height / 2.0 + y);
            // Writing to a String cannot fail.
            let _ = write!(path, "{}{x:.1} {y:.1}", if at == 0 { 'M' } else { 'L' });
        }
        path.push('z');
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shape(character: char) -> Option<String> {
        let mut path = String::new();
        append(&mut path, character, Place { x: 10.0, y: 20.0, width: 8.0, height: 16.0 }).then_some(path)
    }

    #[test]
    fn characters_that_make_pictures_are_shapes_within_their_cell() {
        assert_eq!(shape('█').as_deref(), Some("M10.0 20.0h8.0v16.0h-8.0z"));
        assert_eq!(shape('▄').as_deref(), Some("M10.0 28.0h8.0v8.0h-8.0z"));
        // Dots 1 and 8: the left upper and the right lower one.
        assert_eq!(shape('⢁').as_deref(), Some("M10.8 20.8h2.4v2.4h-2.4zM14.8 32.8h2.4v2.4h-2.4z"));
        assert_eq!(shape('\u{2800}').as_deref(), Some(""));
        assert_eq!(shape('┤').unwrap().matches('M').count(), 2);
        for character in "▁▂▃▄▅▆▇█▔░▲▼▴▾▸●◆─━│╵┌┐└┘├┤┬┴┼⣿".chars()
        {
            assert!(shape(character).is_some_and(|path| path.starts_with('M')), "{character}");
        }
        for character in "aµΔ–→…".chars() {
            assert_eq!(shape(character), None, "{character}");
        }
    }
}
