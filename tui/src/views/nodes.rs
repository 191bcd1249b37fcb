//! What the bus says: its nodes with their states and trouble codes, transfers in progress, and the latest events.

use cantap_trace::counted;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::Line;

use super::super::app::App;
use super::super::cut::draw_lines;
use super::super::model::{Model, Seen};
use super::super::theme::Theme;
use cantap_work::node_text::about;

/// Minimum number of event lines, which on a small screen take precedence over everything else.
const LEAST_SAID: usize = 6;

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model, seen: &Seen) {
    let (talked, rows) = (&seen.talked, usize::from(area.height));
    let mut lines = Vec::new();
    let heading = |text: String| Line::from(text).style(Theme::heading());
    let nodes = talked.overview.nodes().count();
    lines.push(heading(format!(
        "Nodes {nodes}, {}, {} with a fault",
        counted(talked.events, "event"),
        talked.faults
    )));
    if nodes == 0 {
        lines.push(Line::from(
            "Nobody was understood so far; the first three seconds of a bus tell what it speaks.",
        ));
    }
    for ((channel, protocol, node), known) in talked.overview.nodes() {
        let line = format!("{channel} {protocol:<9} {node:<9} {:>7}{}", known.events, about(known));
        let is_bad = known.missed > 0 || known.faults > 0;
        lines.push(if is_bad { Line::styled(line, app.theme.loss()) } else { Line::from(line) });
    }
    lines.push(heading(format!("Transfers under way {}", talked.under_way.len())));
    for transfer in &talked.under_way {
        let whole = transfer.length.map_or_else(|| "?".to_owned(), |length| length.to_string());
        lines.push(Line::from(format!(
            "{} {:<9} {} > {}  {} of {whole}",
            transfer.channel,
            transfer.protocol,
            transfer.from,
            transfer.to,
            transfer.received,
            whole = counted(whole, "byte")
        )));
    }
    app.page_rows = rows;
    // The newest event is in sight as long as nothing was scrolled.
    let said = rows.saturating_sub(lines.len() + 1).max(LEAST_SAID).min(talked.recent.len());
    let mut tail = vec![heading("Said last".to_owned())];
    for event in talked.recent.iter().skip(talked.recent.len() - said) {
        let since_ns = model.first_ns.map_or(0, |first_ns| event.time_ns.saturating_sub(first_ns));
        let line = format!("{:>10.3} {} {event}", since_ns as f64 / 1e9, event.channel);
        tail.push(if event.is_fault() { Line::styled(line, app.theme.error()) } else { Line::from(line) });
    }
    lines.extend(tail);
    let most = lines.len().saturating_sub(rows);
    app.selected = app.selected.min(most);
    draw_lines(frame, area, lines.split_off(app.selected));
}
