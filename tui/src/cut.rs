//! Lines that do not fit end in `…`, as [texts](cantap_work::cut) do.

use cantap_work::cut::MARK;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};
use ratatui::widgets::Paragraph;

/// A line in at most this many columns.
pub fn cut_line(line: Line<'static>, columns: usize) -> Line<'static> {
    // Blanks are not missed.
    if line.width() <= columns || Line::from(line.to_string().trim_end()).width() <= columns {
        return line;
    }
    let mut spans: Vec<Span<'static>> = Vec::new();
    let mut room = columns.saturating_sub(1);
    for grapheme in line.styled_graphemes(Style::new()) {
        let span = Span::styled(grapheme.symbol.to_owned(), grapheme.style);
        let Some(rest) = room.checked_sub(span.width()) else { break };
        room = rest;
        spans.push(span);
    }
    if columns > 0 {
        spans.push(Span::raw(MARK));
    }
    Line { spans, ..line }
}

/// Draws lines, each cut to the area's width.
pub fn draw_lines(frame: &mut Frame<'_>, area: Rect, lines: Vec<Line<'static>>) {
    let lines: Vec<_> =
        lines.into_iter().take(area.height.into()).map(|line| cut_line(line, area.width.into())).collect();
    frame.render_widget(Paragraph::new(lines), area);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_cut_says_so() {
        let line = Line::from(vec![Span::raw("Speed "), Span::raw("255")]);
        let cut = |columns| cut_line(line.clone(), columns).to_string();
        assert_eq!([cut(9), cut(8), cut(6), cut(1), cut(0)], ["Speed 255", "Speed 2…", "Speed…", "…", ""]);
        assert_eq!(cut_line(Line::from("255  "), 3).to_string(), "255  ");
        // Characters that take two columns are not halved.
        assert_eq!(cut_line(Line::from("日本語"), 4).to_string(), "日…");
    }
}
