//! Live values of decoded signals, with extremes, alarms and the recent past.

use cantap_signals::Alarm;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Paragraph, Wrap};

use super::super::app::App;
use super::super::model::{Model, Seen, SignalRow};
use super::list::list;

/// Columns of the small curve.
const SPARK_COLUMNS: usize = 16;
/// Time that each of them stands for: the last eight seconds altogether.
const SPARK_COLUMN_NS: i64 = 500_000_000;

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model, seen: &Seen) {
    let rows = seen.signals.rows();
    app.signal_order = (0..rows.len()).filter(|place| model.history.accepts(&rows[*place].last())).collect();
    if app.signal_order.is_empty() {
        let text = if !rows.is_empty() {
            "The filter hides all signals; f changes it."
        } else if seen.signals.has_database() {
            "No frame of the databases was seen yet."
        } else {
            "There is no signal database. Start with --db FILE, a DBC file or a .toml signal file."
        };
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), area);
        return;
    }
    let width = usize::from(area.width);
    let name_columns = width.saturating_sub(2 + 2 + 22 + 10 + 10 + SPARK_COLUMNS + 5).clamp(12, 48);
    let heading = Line::from(format!(
        "  C {:<name_columns$} {:>22} {:>10} {:>10} Last 8 s",
        "Signal", "Value", "Min", "Max"
    ));
    list(frame, area, app, heading, app.signal_order.len(), |index, app| {
        line(&rows[app.signal_order[index]], name_columns, app, seen)
    });
}

fn line(row: &SignalRow, name_columns: usize, app: &App, seen: &Seen) -> Line<'static> {
    let theme = app.theme;
    let signal = seen.signals.signal(row);
    let (arrow, style) = match seen.signals.alarm(row) {
        Some(Alarm::Above) => (if theme.unicode { "▲" } else { "^" }, theme.error()),
        Some(Alarm::Below) => (if theme.unicode { "▼" } else { "v" }, theme.below()),
        None => (" ", Style::new()),
    };
    let label = signal.label();
    let full = format!("{}.{label}", seen.signals.message_name(row));
    let name = if full.chars().count() > name_columns { label.into_owned() } else { full };
    let name: String = name.chars().take(name_columns).collect();
    let value = seen.signals.short_text(row, 21);
    Line::from(vec![
        Span::raw(if row.series.is_some() { "* " } else { "  " }),
        Span::raw(format!("{} {name:<name_columns$} ", row.channel)),
        Span::styled(format!("{value:>21}{arrow}"), style),
        Span::styled(format!(" {:>10} {:>10} ", short(row.min), short(row.max)), theme.label()),
        Span::styled(spark(row, seen.now_ns, theme.unicode), theme.series(0)),
    ])
}

/// A value in at most ten columns.
pub fn short(value: f64) -> String {
    if value.is_nan() {
        return "–".to_owned();
    }
    let text = format!("{value}");
    if text.len() <= 10 {
        return text;
    }
    let rounded = format!("{value:.3}");
    if rounded.len() <= 10 { rounded } else { format!("{value:.3e}") }
}

/// The recent past as a row of blocks, each the value that the signal had then, from its lowest to its highest.
fn spark(row: &SignalRow, now_ns: i64, unicode: bool) -> String {
    let levels: &[char] = if unicode {
        &['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█']
    } else {
        &['_', '.', '-', '=', '*', '#']
    };
    let before = |column: usize| now_ns.saturating_sub((SPARK_COLUMNS - 1 - column) as i64 * SPARK_COLUMN_NS);
    let values: Vec<_> = (0..SPARK_COLUMNS)
        .map(|column| {
            let until = row.recent.partition_point(|(time_ns, _)| *time_ns <= before(column));
            until.checked_sub(1).map(|last| row.recent[last].1)
        })
        .collect();
    let low = values.iter().flatten().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().flatten().copied().fold(f64::NEG_INFINITY, f64::max);
    let level = |value: f64| {
        let share = if high > low { (value - low) / (high - low) } else { 0.0 };
        levels[((share * (levels.len() - 1) as f64).round() as usize).min(levels.len() - 1)]
    };
    values.into_iter().map(|value| value.map_or(' ', level)).collect()
}
