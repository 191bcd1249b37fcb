//! Rows below a heading, and text that several pages have in common.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::Line;

use super::super::app::{App, first_row};
use super::super::cut::draw_lines;
use super::super::theme::Theme;

/// A number of bytes for display.
pub fn bytes(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} B"),
        10_000..10_000_000 => format!("{} kB", bytes / 1000),
        10_000_000..10_000_000_000 => format!("{} MB", bytes / 1_000_000),
        _ => format!("{} GB", bytes / 1_000_000_000),
    }
}

/// Lines below a heading, starting at a row that keeps the selected one in sight.
pub fn list(
    frame: &mut Frame<'_>,
    area: Rect,
    app: &mut App,
    heading: Line<'static>,
    count: usize,
    row: impl Fn(usize, &App) -> Line<'static>,
) {
    let rows = usize::from(area.height).saturating_sub(1);
    app.page_rows = rows;
    app.selected = app.selected.min(count.saturating_sub(1));
    let first = first_row(app.selected, rows);
    let mut lines = vec![heading.style(Theme::heading())];
    for index in first..count.min(first + rows) {
        let line = row(index, app);
        lines.push(if index == app.selected { line.style(Theme::bar()) } else { line });
    }
    draw_lines(frame, area, lines);
}
