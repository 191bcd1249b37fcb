//! Rows below a heading, what is said above them, and text that several pages have in common.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::Style;
use ratatui::text::Line;

use super::super::app::{App, first_row};
use super::super::cut::draw_lines;
use super::super::theme::Theme;
use super::bottom::wrapped;

/// Most lines of a notice above a page's rows.
const MOST_NOTICE_LINES: usize = 3;

/// A number of bytes for display.
pub fn bytes(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} B"),
        10_000..10_000_000 => format!("{} kB", bytes / 1000),
        10_000_000..10_000_000_000 => format!("{} MB", bytes / 1_000_000),
        _ => format!("{} GB", bytes / 1_000_000_000),
    }
}

/// Draws a text at the top of a page, in as many lines as it needs: the end may be the key that is looked for. Returns the rest of the page.
pub fn notice(frame: &mut Frame<'_>, area: Rect, text: &str, style: Style) -> Rect {
    let mut lines = wrapped(text, area.width.into());
    lines.truncate(MOST_NOTICE_LINES);
    let [top, rest] =
        Layout::vertical([Constraint::Length(lines.len() as u16), Constraint::Min(1)]).areas(area);
    draw_lines(frame, top, lines.into_iter().map(|line| Line::styled(line, style)).collect());
    rest
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
    app.rows_at = area.y + 1;
    app.selected = app.selected.min(count.saturating_sub(1));
    let first = first_row(app.selected, rows);
    let mut lines = vec![heading.style(Theme::heading())];
    for index in first..count.min(first + rows) {
        let line = row(index, app);
        lines.push(if index == app.selected { line.style(Theme::bar()) } else { line });
    }
    draw_lines(frame, area, lines);
}
