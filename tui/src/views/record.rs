//! The current recording, if any.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::Line;
use ratatui::widgets::{Paragraph, Wrap};

use super::super::app::App;
use super::super::model::Model;
use super::list::bytes;
use cantap_work::recording::RecordingState;

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model) {
    let lines = match &model.recording {
        None => vec![
            Line::from("Nothing is recorded. r starts: the file's suffix chooses the format."),
            Line::from(
                "FILE if CONDITION, as in fast.blf if Speed > 80, keeps 2 s before and 5 s after each event.",
            ),
            Line::from(
                "Otherwise everything that comes is recorded, whatever is shown, paused or filtered here.",
            ),
        ],
        Some(RecordingState { path, condition: Some(condition), events: 0, .. }) => vec![
            Line::from(format!("Armed: {} begins when {condition}", path.display())).style(app.theme.loss()),
            Line::from("It has not come true yet. Nothing is recorded, and there is no file."),
            Line::from("r gives it up."),
        ],
        Some(recording) => {
            let seconds = model.seen.now_ns.saturating_sub(recording.since_ns) as f64 / 1e9;
            let seconds = if recording.records == 0 { 0.0 } else { seconds.max(0.0) };
            let events = recording.condition.as_ref();
            let events =
                events.map(|condition| Line::from(format!("Events    {} of {condition}", recording.events)));
            let mut lines = vec![
                Line::from(format!("Recording to {}", recording.path.display())).style(app.theme.error()),
                Line::from(format!("Records   {}", recording.records)),
                Line::from(format!("Size      {}", bytes(recording.bytes))),
                Line::from(format!("Time      {seconds:.1} s")),
            ];
            lines.extend(events);
            lines.push(Line::from("r stops."));
            lines
        }
    };
    frame.render_widget(Paragraph::new(lines).wrap(Wrap { trim: true }), area);
}
