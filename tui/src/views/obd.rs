//! A vehicle's parameters, as its ECUs answer them.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::Line;

use super::super::app::App;
use super::super::cut::draw_lines;
use super::super::model::Model;
use super::super::theme::Theme;
use super::list::notice;
use cantap_work::obd::AskingState;

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model) {
    let vehicle = &model.vehicle;
    let (text, style) = match (&app.plan, &vehicle.state) {
        (None, _) => ("A file answers nothing. Open a device with D.".to_owned(), app.theme.label()),
        (Some(plan), _) if !plan.mode().transmits() => (
            "Listen-only: nothing is sent, so nothing is asked. m takes part in the bus, and asks."
                .to_owned(),
            app.theme.label(),
        ),
        (Some(_), AskingState::Off) => {
            ("Normal mode, and nothing is asked. Space asks.".to_owned(), app.theme.label())
        }
        (Some(_), AskingState::Ended(_)) => {
            (format!("{} Space asks again.", vehicle.state.sentence()), app.theme.error())
        }
        (Some(_), state) => (format!("{} Space stops.", state.sentence()), app.theme.loss()),
    };
    let body = notice(frame, area, &text, style);
    if vehicle.table.is_empty() {
        return draw_lines(frame, body, vec![Line::from("No values so far.")]);
    }
    let rows = usize::from(body.height);
    let mut lines = vehicle.table.lines(true, (body.width.into(), usize::MAX));
    app.page_rows = rows;
    app.selected = app.selected.min(lines.len().saturating_sub(rows));
    // The heading stays.
    lines.drain(1..=app.selected);
    let lines = lines.into_iter().enumerate().map(|(place, line)| {
        let line = Line::from(line);
        if place == 0 { line.style(Theme::heading()) } else { line }
    });
    draw_lines(frame, body, lines.collect());
}
