//! Scripts: the list with states and verdicts, what they have said, and the device's gateway.

use std::fmt::Write;

use cantap_work::cut::cut;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::text::Line;
use ratatui::widgets::{Paragraph, Wrap};

use super::super::app::App;
use super::super::cut::draw_lines;
use super::super::model::scripts::ScriptRow;
use super::super::model::{LineKind, Model, ScriptState};
use super::super::theme::Theme;
use super::bottom::wrapped;
use super::list::{list, notice};

/// Columns of a script's name.
const NAME: usize = 28;

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model) {
    let scripts = &model.scripts;
    let (text, style) = match &app.plan {
        None => ("A file runs no scripts. Open a device with D.", app.theme.label()),
        Some(plan) if plan.mode().transmits() => {
            ("Normal mode: what scripts send goes onto the bus.", app.theme.loss())
        }
        Some(_) => (
            "Listen-only: nothing is sent, so no script is started. m takes part in the bus.",
            app.theme.label(),
        ),
    };
    let area = notice(frame, area, text, style);
    let rows = scripts.rows.len().max(1) as u16 + 1;
    let gateway = scripts.gateway.len() as u16;
    // The list and the gateway leave a third of the page to the output.
    let most = area.height / 3;
    let [body, output, rules] = Layout::vertical([
        Constraint::Length(rows.min(most.max(2))),
        Constraint::Min(1),
        Constraint::Length(gateway.min(most)),
    ])
    .areas(area);
    if scripts.rows.is_empty() {
        let text = "The list is empty. a adds a script, or a ready node such as node:obd.";
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), body);
    } else {
        let heading = Line::from(format!("{:<NAME$} {:<18} {:>6} {:>6}", "Script", "State", "ok", "failed"));
        list(frame, body, app, heading, scripts.rows.len(), |index, app| row(&scripts.rows[index], app));
    }
    draw_output(frame, output, app, model);
    let lines = scripts.gateway.iter().enumerate().map(|(place, line)| {
        let line = Line::from(line.clone());
        if place < 2 { line.style(Theme::heading()) } else { line }
    });
    draw_lines(frame, rules, lines.collect());
}

fn row(ScriptRow { name, state, passed, failed }: &ScriptRow, app: &App) -> Line<'static> {
    let (text, is_bad) = match state {
        ScriptState::Off => ("off".to_owned(), false),
        ScriptState::Running(None) => ("RUNNING".to_owned(), false),
        ScriptState::Running(Some(test)) => (format!("RUNNING {test}"), false),
        ScriptState::Stopped => ("stopped".to_owned(), false),
        ScriptState::Ended => ("ended".to_owned(), false),
        ScriptState::Failed(error) => (format!("ERROR: {error}"), true),
    };
    let tests = if passed + failed > 0 { format!(" {passed:>6} {failed:>6}") } else { String::new() };
    // An error takes the whole line.
    let text = if is_bad { text } else { format!("{:<18}{tests}", cut(&text, 18)) };
    let line = format!("{:<NAME$} {text}", cut(name, NAME));
    if is_bad || *failed > 0 { Line::styled(line, app.theme.error()) } else { Line::from(line) }
}

fn draw_output(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model) {
    let counts = model.scripts.counts;
    let mut heading = format!("Output  {} sent, {} received", counts.sent, counts.received);
    for (count, of) in [(counts.waiting, "waiting"), (counts.not_sent, "NOT SENT"), (counts.lost, "LOST")] {
        if count > 0 {
            let _ = write!(heading, ", {count} {of}");
        }
    }
    let room = usize::from(area.height).saturating_sub(1);
    let width = usize::from(area.width);
    app.output_rows = room;
    let output = &model.scripts.output;
    app.output_above = app.output_above.min(output.len().saturating_sub(room));
    let end = output.len() - app.output_above;
    if app.output_above > 0 {
        let _ = write!(heading, "  ({} newer lines below, End)", app.output_above);
    }
    let mut lines = Vec::new();
    // As many of the newest as have room, each whole.
    for (kind, text) in output.range(..end).rev().take(room) {
        let style = match kind {
            LineKind::Log => ratatui::style::Style::new(),
            LineKind::Note => app.theme.label(),
            LineKind::Fault => app.theme.error(),
        };
        let parts = if *kind == LineKind::Fault { wrapped(text, width) } else { vec![text.clone()] };
        lines.extend(parts.into_iter().rev().map(|part| Line::styled(part, style)));
        if lines.len() >= room {
            break;
        }
    }
    lines.truncate(room);
    lines.push(Line::from(heading).style(Theme::heading()));
    lines.reverse();
    draw_lines(frame, area, lines);
}
