//! Frames to send, once or periodically.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::Line;
use ratatui::widgets::{Paragraph, Wrap};

use super::super::app::App;
use super::super::model::Seen;
use super::list::{list, notice};

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, seen: &Seen) {
    let (text, style) = match &app.plan {
        None => ("A file sends nothing. Open a device with D.", app.theme.label()),
        Some(plan) if plan.mode().transmits() => {
            ("Normal mode: what is sent here goes onto the bus.", app.theme.loss())
        }
        Some(_) => (
            "Listen-only: nothing is sent, not even an acknowledge. m takes part in the bus.",
            app.theme.label(),
        ),
    };
    let body = notice(frame, area, text, style);
    if app.send.is_empty() {
        let database = if seen.signals.has_database() { ", or Message:Signal=value,…" } else { "" };
        let text = format!("The list is empty. a adds a frame, such as 123#DEADBEEF 100ms{database}.");
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), body);
        return;
    }
    let heading = Line::from(format!("   C {:<24} {:>10} {:>8}  As typed", "Frame", "Period", "By key"));
    let lines: Vec<_> = app
        .send
        .iter()
        .map(|entry| {
            let period = entry.period.map_or("once".to_owned(), |period| format!("{period:?}"));
            format!(
                "{} {} {:<24} {period:>10} {:>8}  {}",
                if entry.slot.is_some() { "on" } else { "  " },
                entry.channel,
                entry.frame.to_string(),
                entry.sent,
                entry.text
            )
        })
        .collect();
    list(frame, body, app, heading, lines.len(), |index, _| Line::from(lines[index].clone()));
}
