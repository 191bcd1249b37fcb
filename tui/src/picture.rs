//! A screen as an SVG picture with its colours, for documents.

mod shape;

use std::fmt::Write;

use ratatui::buffer::{Buffer, Cell};
use ratatui::style::{Color, Modifier};

use shape::Place;

/// A character's size, in the picture's units.
const CHARACTER: (f64, f64) = (8.4, 18.0);
/// Room around the screen.
const MARGIN: f64 = 10.0;
/// Distance of a character's base line from the lower edge of its row.
const DESCENT: f64 = 5.0;
const BACKGROUND: &str = "#14181d";
const FOREGROUND: &str = "#d4d4d4";

/// Colours and modifiers for a run of characters.
#[derive(Clone, PartialEq)]
struct Look {
    foreground: String,
    background: Option<String>,
    modifier: Modifier,
}

impl Look {
    fn of(cell: &Cell) -> Self {
        let (foreground, background) = (colour(cell.fg), colour(cell.bg));
        let modifier = cell.modifier;
        if modifier.contains(Modifier::REVERSED) {
            let ink = background.unwrap_or_else(|| BACKGROUND.to_owned());
            let paper = foreground.unwrap_or_else(|| FOREGROUND.to_owned());
            return Self { foreground: ink, background: Some(paper), modifier };
        }
        Self { foreground: foreground.unwrap_or_else(|| FOREGROUND.to_owned()), background, modifier }
    }
}

/// The picture of a screen.
pub fn svg(buffer: &Buffer) -> String {
    let (columns, rows) = (f64::from(buffer.area.width), f64::from(buffer.area.height));
    let (width, height) = (columns * CHARACTER.0 + 2.0 * MARGIN, rows * CHARACTER.1 + 2.0 * MARGIN);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" \
         height=\"{height}\" font-family=\"'DejaVu Sans Mono','Cascadia Mono',Menlo,Consolas,monospace\" \
         font-size=\"14\">\n\
         <rect width=\"{width}\" height=\"{height}\" rx=\"6\" fill=\"{BACKGROUND}\"/>\n"
    );
    for row in 0..buffer.area.height {
        let mut column = 0;
        while column < buffer.area.width {
            let look = Look::of(&buffer[(column, row)]);
            let start = column;
            let mut symbols = Vec::new();
            while column < buffer.area.width && Look::of(&buffer[(column, row)]) == look {
                symbols.push(buffer[(column, row)].symbol());
                column += 1;
            }
            run(&mut out, &symbols, &look, (start, row));
        }
    }
    out.push_str("</svg>\n");
    out
}

/// Draws the symbols of a run of cells that begins in this column and row.
fn run(out: &mut String, symbols: &[&str], look: &Look, (column, row): (u16, u16)) {
    let x = MARGIN + f64::from(column) * CHARACTER.0;
    let (y, width) = (MARGIN + f64::from(row) * CHARACTER.1, symbols.len() as f64 * CHARACTER.0);
    // Writing to a String cannot fail.
    if let Some(background) = &look.background {
        let height = CHARACTER.1;
        let _ = writeln!(
            out,
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height}\" fill=\"{background}\"/>"
        );
    }
    let mut style = String::new();
    for (modifier, attribute) in [
        (Modifier::BOLD, " font-weight=\"bold\""),
        (Modifier::ITALIC, " font-style=\"italic\""),
        (Modifier::UNDERLINED, " text-decoration=\"underline\""),
        (Modifier::DIM, " opacity=\"0.6\""),
    ] {
        if look.modifier.contains(modifier) {
            style.push_str(attribute);
        }
    }
    // Each character has its own place, so that columns are aligned whatever the reader's font. Blanks are left out.
    let (mut path, mut places, mut written) = (String::new(), String::new(), String::new());
    for (column, symbol) in symbols.iter().enumerate() {
        let x = x + column as f64 * CHARACTER.0;
        let mut characters = symbol.chars();
        let place = Place { x, y, width: CHARACTER.0, height: CHARACTER.1 };
        if let (Some(character), None) = (characters.next(), characters.next())
            && shape::append(&mut path, character, place)
        {
            continue;
        }
        if symbol.trim().is_empty() {
            continue;
        }
        for character in symbol.chars() {
            let _ = write!(places, "{}{x:.1}", if places.is_empty() { "" } else { " " });
            match character {
                '&' => written.push_str("&amp;"),
                '<' => written.push_str("&lt;"),
                '>' => written.push_str("&gt;"),
                character => written.push(character),
            }
        }
    }
    let foreground = &look.foreground;
    if !path.is_empty() {
        let _ = writeln!(out, "<path d=\"{path}\" fill=\"{foreground}\"{style}/>");
    }
    if !written.is_empty() {
        let baseline = y + CHARACTER.1 - DESCENT;
        let _ = writeln!(
            out,
            "<text x=\"{places}\" y=\"{baseline:.1}\" fill=\"{foreground}\"{style}>{written}</text>"
        );
    }
}

/// As terminals usually show it; `None` is the terminal's own colour.
fn colour(colour: Color) -> Option<String> {
    let fixed = match colour {
        Color::Rgb(red, green, blue) => return Some(format!("#{red:02x}{green:02x}{blue:02x}")),
        Color::Black => "#000000",
        Color::Red => "#cc3333",
        Color::Green => "#33a050",
        Color::Yellow => "#c8a000",
        Color::Blue => "#3a6fd0",
        Color::Magenta => "#a050b0",
        Color::Cyan => "#2aa0a8",
        Color::Gray => "#b0b0b0",
        Color::DarkGray => "#707070",
        Color::LightRed => "#ff6b68",
        Color::LightGreen => "#57d977",
        Color::LightYellow => "#ffe066",
        Color::LightBlue => "#6fa8ff",
        Color::LightMagenta => "#e080e8",
        Color::LightCyan => "#67e0e8",
        Color::White => "#ffffff",
        Color::Reset | Color::Indexed(_) => return None,
    };
    Some(fixed.to_owned())
}

#[cfg(test)]
mod tests {
    use ratatui::layout::Rect;
    use ratatui::style::Style;

    use super::*;

    #[test]
    fn a_screen_becomes_runs_of_text_with_colours() {
        let mut buffer = Buffer::empty(Rect::new(0, 0, 10, 2));
        buffer.set_string(0, 0, "a<b", Style::new().fg(Color::LightRed).add_modifier(Modifier::BOLD));
        buffer.set_string(2, 1, "bar", Style::new().add_modifier(Modifier::REVERSED));
        let picture = svg(&buffer);
        let texts: Vec<_> = picture.lines().filter(|line| line.starts_with("<text")).collect();
        assert_eq!(
            texts,
            [
                "<text x=\"10.0 18.4 26.8\" y=\"23.0\" fill=\"#ff6b68\" font-weight=\"bold\">a&lt;b</text>",
                "<text x=\"26.8 35.2 43.6\" y=\"41.0\" fill=\"#14181d\">bar</text>",
            ]
        );
        assert!(
            picture.contains("<rect x=\"26.8\" y=\"28.0\" width=\"25.2\" height=\"18\" fill=\"#d4d4d4\"/>")
        );
        // What makes up a picture does not depend on a font.
        buffer.set_string(5, 0, "⣿ ┤", Style::new());
        let picture = svg(&buffer);
        assert!(
            !picture.contains(['⣿', '┤']) && picture.matches("<path d=\"M52.9 11.1").count() == 1,
            "{picture}"
        );
        assert!(picture.starts_with("<svg ") && picture.ends_with("</svg>\n"));
    }
}
