//! One row per identifier, with what changes highlighted.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::app::{App, Column};
use super::super::event_text::printable;
use super::super::model::{Model, Row, Seen};
use super::list::list;

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model, seen: &Seen) {
    let rows = sorted(app, model, seen);
    app.fixed_order = rows.iter().map(|row| (row.channel, row.frame.id())).collect();
    let mark = |column: Column, text: &str| {
        let arrow = match (app.theme.unicode, app.reverse) {
            _ if app.sort != column => "",
            (true, false) => "▾",
            (true, true) => "▴",
            (false, false) => "v",
            (false, true) => "^",
        };
        format!("{text}{arrow}")
    };
    let hidden = seen.table.rows().len() - rows.len();
    let more = match (hidden, seen.table.unlisted) {
        (0, 0) => String::new(),
        (hidden, 0) => format!(" ({hidden} hidden)"),
        (_, unlisted) => format!(" ({unlisted} frames of further IDs)"),
    };
    // Where there is little room, the name is worth more than the characters.
    let ascii = area.width >= 100;
    let heading = Line::from(format!(
        "C {:>9} {:>9} {:>10} {:>9} L {:<23} {}{}{more}",
        mark(Column::Id, "ID"),
        mark(Column::Count, "Count"),
        mark(Column::Period, "Period ms"),
        mark(Column::Jitter, "Jitter"),
        "Data",
        if ascii { "ASCII    " } else { "" },
        mark(Column::Name, "Name"),
    ));
    list(frame, area, app, heading, rows.len(), |index, app| line(rows[index], ascii, app, seen));
}

fn sorted<'a>(app: &App, model: &Model, seen: &'a Seen) -> Vec<&'a Row> {
    let shown = |row: &&Row| !row.hidden && model.history.accepts(&row.last());
    let mut rows: Vec<_> = seen.table.rows().iter().filter(shown).collect();
    let id = |row: &&Row| (row.frame.id().is_extended(), row.frame.id().raw(), row.channel);
    rows.sort_by_key(id);
    match app.sort {
        Column::Id => {}
        Column::Count => rows.sort_by_key(|row| std::cmp::Reverse(row.count)),
        Column::Period => rows.sort_by(|a, b| {
            let period = |row: &Row| row.period_ns.unwrap_or(f64::INFINITY);
            period(a).total_cmp(&period(b))
        }),
        Column::Jitter => rows.sort_by(|a, b| b.jitter_ns.total_cmp(&a.jitter_ns)),
        Column::Time => rows.sort_by_key(|row| std::cmp::Reverse(row.last_ns)),
        // Those without a name come last.
        Column::Name => rows.sort_by_key(|row| (name(row, seen).is_empty(), name(row, seen))),
    }
    if app.reverse {
        rows.reverse();
    }
    if app.grouped {
        rows.sort_by_key(|row| row.channel);
    }
    rows
}

fn name<'a>(row: &Row, seen: &'a Seen) -> &'a str {
    let decoder = seen.signals.decoder();
    decoder.find(row.channel, row.frame.id()).map_or("", |message| &decoder.message(message).name)
}

fn line(row: &Row, ascii: bool, app: &App, seen: &Seen) -> Line<'static> {
    let theme = app.theme;
    let base = if row.mark > 0 { theme.series(usize::from(row.mark) - 1) } else { Style::new() };
    let period = row.period_ns.map_or("–".to_owned(), |ns| format!("{:.3}", ns / 1e6));
    let jitter = row.period_ns.map_or(String::new(), |_| format!("{:.3}", row.jitter_ns / 1e6));
    let mut spans = vec![Span::styled(
        format!(
            "{} {:>9} {:>9} {period:>10} {jitter:>9} {} ",
            row.channel,
            row.frame.id().to_string(),
            row.count,
            if row.frame.is_remote() { "R".to_owned() } else { row.frame.dlc().to_string() },
        ),
        base,
    )];
    let data = row.frame.data();
    for (index, byte) in data.iter().enumerate() {
        for (digit, value) in [(2 * index, byte >> 4), (2 * index + 1, byte & 0xF)] {
            let style = if app.heat {
                heat_style(row, digit, app)
            } else {
                changed_style(row, digit, seen.now_ns, app)
            };
            spans.push(Span::styled(format!("{value:X}"), style));
        }
        spans.push(Span::raw(" "));
    }
    let room = 3 * 8_usize.saturating_sub(data.len());
    let characters = if ascii { format!("{:<8} ", printable(data)) } else { String::new() };
    spans.push(Span::raw(format!("{:room$}{characters}", "")));
    spans.push(Span::styled(name(row, seen).to_owned(), base));
    Line::from(spans)
}

/// Highlighted for a while after a change, unless its bits are notched.
fn changed_style(row: &Row, digit: usize, now_ns: i64, app: &App) -> Style {
    match row.changed_ns[digit] {
        i64::MIN => Style::new(),
        changed_ns => app.theme.changed(now_ns.saturating_sub(changed_ns).max(0)),
    }
}

/// The more often the digit's busiest bit changes, the hotter.
fn heat_style(row: &Row, digit: usize, app: &App) -> Style {
    let busiest = row.heat[digit * 4..digit * 4 + 4].iter().copied().max().unwrap_or(0);
    let share = f64::from(busiest) / row.count.max(1) as f64;
    match share {
        0.0 => app.theme.dim(),
        ..0.05 => Style::new(),
        ..0.3 => app.theme.load(0.0),
        ..0.7 => app.theme.load(60.0),
        _ => app.theme.load(100.0),
    }
}
