//! Live values of decoded signals, with extremes, alarms and the recent past.

use cantap_signals::{Alarm, Number};
use cantap_work::cut::cut;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Paragraph, Wrap};

use super::super::app::{App, SignalColumn};
use super::super::model::{Decoded, Model, Seen, SignalRow};
use super::super::theme::Theme;
use super::list::list;

/// Number of columns in the small curve.
const SPARK_COLUMNS: usize = 16;
/// Time per column: the last eight seconds altogether.
const SPARK_COLUMN_NS: i64 = 500_000_000;

/// A line of the page.
enum Entry<'a> {
    /// A message's name, above its signals.
    Message(String),
    /// A signal.
    Signal(&'a SignalRow),
}

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model, seen: &Seen) {
    let rows = seen.signals.rows();
    let places = chosen(app, model, seen);
    if places.is_empty() {
        app.signal_order.clear();
        let text = if !app.signals.filter.text().is_empty() && !rows.is_empty() {
            "No signal matches the condition; F changes it."
        } else if !rows.is_empty() {
            "The filter hides all signals; f changes it."
        } else if seen.signals.has_database() {
            "No frame of the databases was seen yet."
        } else {
            "There is no signal database. O opens one: a DBC file, a .toml signal file and the like."
        };
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), area);
        return;
    }
    app.signal_order.clear();
    let mut entries = Vec::with_capacity(places.len());
    let mut message = None;
    for place in places {
        let row = &rows[place];
        let is_next = message != Some((row.channel, row.message));
        if app.signals.grouped && is_next {
            message = Some((row.channel, row.message));
            entries.push(Entry::Message(format!("  {} {}", row.channel, seen.signals.message_name(row))));
            app.signal_order.push(None);
        }
        entries.push(Entry::Signal(row));
        app.signal_order.push(Some(place));
    }
    let width = usize::from(area.width);
    let name_columns = width.saturating_sub(2 + 2 + 22 + 10 + 10 + SPARK_COLUMNS + 5).clamp(12, 48);
    let heading = heading(app, name_columns);
    list(frame, area, app, heading, entries.len(), |index, app| match &entries[index] {
        Entry::Message(name) => Line::styled(name.clone(), Theme::heading()),
        Entry::Signal(row) => line(row, name_columns, app, seen),
    });
}

/// The indexes of the signals shown, in order.
fn chosen(app: &App, model: &Model, seen: &Seen) -> Vec<usize> {
    let rows = seen.signals.rows();
    let filter = &app.signals.filter;
    let is_shown = |place: &usize| {
        let row = &rows[*place];
        model.history.accepts(&row.last())
            && filter.accepts(&seen.signals.full_name(row), row.value, seen.signals.alarm(row).is_some())
    };
    let mut places: Vec<usize> = (0..rows.len()).filter(is_shown).collect();
    let largest = |value: fn(&SignalRow) -> f64| {
        move |a: &usize, b: &usize| value(&rows[*b]).total_cmp(&value(&rows[*a]))
    };
    match app.signals.sort {
        SignalColumn::Seen => {}
        SignalColumn::Name => places.sort_by_cached_key(|place| seen.signals.full_name(&rows[*place])),
        SignalColumn::Value => places.sort_by(largest(|row| row.value)),
        SignalColumn::Min => places.sort_by(largest(|row| row.min)),
        SignalColumn::Max => places.sort_by(largest(|row| row.max)),
        SignalColumn::Changed => places.sort_by_key(|place| std::cmp::Reverse(rows[*place].changed_ns)),
    }
    if app.signals.reverse {
        places.reverse();
    }
    if app.signals.grouped {
        places.sort_by_cached_key(|place| {
            let row = &rows[*place];
            (row.channel, seen.signals.message_name(row).to_owned(), row.message)
        });
    }
    places
}

/// The headings; the positions of those that sort are recorded for clicks.
fn heading(app: &mut App, name_columns: usize) -> Line<'static> {
    let page = &mut app.signals;
    let arrow = match (app.theme.unicode, page.reverse) {
        (true, false) => '▾',
        (true, true) => '▴',
        (false, false) => 'v',
        (false, true) => '^',
    };
    let mut text = String::from("  C ");
    page.headings.clear();
    for (title, column, width) in [
        ("Signal", SignalColumn::Name, name_columns),
        ("Value", SignalColumn::Value, 22),
        ("Min", SignalColumn::Min, 10),
        ("Max", SignalColumn::Max, 10),
        ("Last 8 s", SignalColumn::Changed, SPARK_COLUMNS),
    ] {
        let title = if page.sort == column { format!("{title}{arrow}") } else { title.to_owned() };
        let start = text.chars().count() as u16;
        let left = matches!(column, SignalColumn::Name | SignalColumn::Changed);
        let cell = if left { format!("{title:<width$} ") } else { format!("{title:>width$} ") };
        text.push_str(&cell);
        page.headings.push((start..text.chars().count() as u16, column));
    }
    Line::from(text.trim_end().to_owned())
}

/// An alarm's arrow, and the style for the value that raises it.
pub fn alarm(alarm: Option<Alarm>, theme: Theme) -> (&'static str, Style) {
    match alarm {
        Some(Alarm::Above) => (if theme.unicode { "▲" } else { "^" }, theme.error()),
        Some(Alarm::Below) => (if theme.unicode { "▼" } else { "v" }, theme.below()),
        None => (" ", Style::new()),
    }
}

/// A frame's signals one after the other, for display beside its data.
pub fn in_line(signals: &[Decoded], theme: Theme) -> Vec<Span<'static>> {
    let spans = signals.iter().flat_map(|signal| {
        let (arrow, style) = alarm(signal.alarm, theme);
        [
            Span::styled(format!("  {} ", signal.name), theme.label()),
            Span::styled(format!("{}{}", signal.text, arrow.trim()), style),
        ]
    });
    spans.collect()
}

fn line(row: &SignalRow, name_columns: usize, app: &App, seen: &Seen) -> Line<'static> {
    let theme = app.theme;
    let signal = seen.signals.signal(row);
    let (arrow, style) = alarm(seen.signals.alarm(row), theme);
    let label = signal.label();
    let full = seen.signals.full_name(row);
    let name =
        if app.signals.grouped || full.chars().count() > name_columns { label.into_owned() } else { full };
    let name = cut(&name, name_columns);
    let value = seen.signals.short_text(row, 21);
    let extreme = |value: f64| short(signal.for_people(Number::Real(value)).as_f64());
    Line::from(vec![
        Span::raw(if row.series.is_some() { "* " } else { "  " }),
        Span::raw(format!("{} {name:<name_columns$} ", row.channel)),
        Span::styled(format!("{value:>21}{arrow}"), style),
        Span::styled(format!(" {:>10} {:>10} ", extreme(row.min), extreme(row.max)), theme.label()),
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

/// The recent past as a row of blocks, each for the signal's value at that time, from its lowest to its
/// highest.
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
