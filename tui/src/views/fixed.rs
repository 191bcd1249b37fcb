//! One row per identifier, with what changes highlighted.

use std::collections::HashSet;
use std::fmt::Write as _;

use cantap_signals::MessageRef;
use cantap_trace::counted;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::app::{App, Column};
use super::super::event_text::printable;
use super::super::model::{Decoded, Model, Row, Seen, SignalRow};
use super::super::theme::Theme;
use super::list::list;
use super::signals::{alarm, in_line};

/// With at least this many columns, there is room for the rows' signals beside the data.
const LEAST_WITH_SIGNALS: u16 = 120;
/// A column of the page.
struct Heading {
    title: &'static str,
    /// The column by which a click sorts.
    sorts: Option<Column>,
    /// Number of characters; the last column takes the rest.
    width: usize,
    left: bool,
    /// It is shown if the screen has at least this many columns. On a narrow one, the data are more important than the rest.
    from: u16,
}

impl Heading {
    const fn new(title: &'static str, sorts: Option<Column>, width: usize, from: u16) -> Self {
        Self { title, sorts, width, left: false, from }
    }

    const fn left(title: &'static str, sorts: Option<Column>, width: usize, from: u16) -> Self {
        Self { title, sorts, width, left: true, from }
    }
}

const COUNT: Heading = Heading::new("Count", Some(Column::Count), 9, 50);
const PERIOD: Heading = Heading::new("Period ms", Some(Column::Period), 10, 60);
const JITTER: Heading = Heading::new("Jitter", Some(Column::Jitter), 9, 70);
const CHARACTERS: Heading = Heading::left("ASCII", None, 8, 100);
const COLUMNS: [Heading; 9] = [
    Heading::left("C", None, 1, 0),
    Heading::new("ID", Some(Column::Id), 9, 0),
    COUNT,
    PERIOD,
    JITTER,
    Heading::left("L", None, 1, 0),
    Heading::left("Data", Some(Column::Time), 23, 0),
    CHARACTERS,
    Heading::left("Name", Some(Column::Name), usize::MAX, 0),
];

/// A line of the page.
enum Entry<'a> {
    /// An identifier.
    Row(&'a Row),
    /// A signal of the opened row above.
    Signal(Decoded),
}

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model, seen: &Seen) {
    let rows = sorted(app, model, seen);
    let hidden = seen.table.rows().len() - rows.len();
    let mut entries = Vec::with_capacity(rows.len());
    app.fixed_order.clear();
    for row in rows {
        let key = (row.channel, row.frame.id());
        app.fixed_order.push(key);
        entries.push(Entry::Row(row));
        if app.opened.contains(&key) {
            let signals = seen.signals.in_frame(row.channel, &row.frame);
            app.fixed_order.extend(signals.iter().map(|_| key));
            entries.extend(signals.into_iter().map(Entry::Signal));
        }
    }
    let heading = heading(app, seen, area.width, hidden);
    list(frame, area, app, heading, entries.len(), |index, app| match &entries[index] {
        Entry::Row(row) => line(row, area.width, app, seen),
        Entry::Signal(signal) => signal_line(signal, app.theme),
    });
}

/// The headings; the positions of those that sort are recorded for clicks.
fn heading(app: &mut App, seen: &Seen, screen: u16, hidden: usize) -> Line<'static> {
    let mut text = String::new();
    app.sort_columns.clear();
    for Heading { title, sorts, width, left, .. } in
        COLUMNS.into_iter().filter(|column| screen >= column.from)
    {
        let title = format!("{title}{}", arrow(app, sorts));
        let start = text.chars().count();
        let width = if width == usize::MAX { title.chars().count() } else { width };
        let cell = if left { format!("{title:<width$} ") } else { format!("{title:>width$} ") };
        text.push_str(&cell);
        if let Some(column) = sorts {
            app.sort_columns.push((start as u16..text.chars().count() as u16, column));
        }
    }
    let mut notes = Vec::new();
    let condition = app.row_filter.text();
    if !condition.is_empty() {
        notes.push(format!("F {condition}: {hidden} hidden"));
    } else if hidden > 0 {
        notes.push(format!("{hidden} hidden"));
    }
    if seen.table.unlisted > 0 {
        notes.push(format!("{} of further IDs", counted(seen.table.unlisted, "frame")));
    }
    let muted = seen.table.notched_bits();
    if muted > 0 {
        notes.push(format!("{muted} muted", muted = counted(muted, "bit")));
    }
    if notes.is_empty() {
        return Line::from(text.trim_end().to_owned());
    }
    Line::from(format!("{text}({})", notes.join(", ")))
}

/// The direction in which the page is sorted by a column, if it is.
fn arrow(app: &App, column: Option<Column>) -> &'static str {
    match (app.theme.unicode, app.reverse) {
        _ if column != Some(app.sort) => "",
        (true, false) => "▾",
        (true, true) => "▴",
        (false, false) => "v",
        (false, true) => "^",
    }
}

/// A signal below its row.
fn signal_line(signal: &Decoded, theme: Theme) -> Line<'static> {
    let (arrow, style) = alarm(signal.alarm, theme);
    Line::from(vec![
        Span::styled(format!("{:13}{:<30} ", "", signal.name), theme.label()),
        Span::styled(format!("{} {arrow}", signal.text), style),
    ])
}

fn sorted<'a>(app: &App, model: &Model, seen: &'a Seen) -> Vec<&'a Row> {
    let chosen = chosen_messages(app, seen);
    let decoder = seen.signals.decoder();
    let has_signal = |row: &Row| {
        let message = decoder.find(row.channel, row.frame.id());
        message.is_some_and(|message| chosen.contains(&(row.channel, message)))
    };
    let shown = |row: &&Row| {
        !row.hidden
            && (seen.table.compared_since_ns.is_none() || row.has_changed())
            && model.history.accepts(&row.last())
            && (app.row_filter.text().is_empty() || has_signal(row))
    };
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

/// The messages, each with its channel, that have a signal matching the page's condition.
fn chosen_messages(app: &App, seen: &Seen) -> HashSet<(u8, MessageRef)> {
    let filter = &app.row_filter;
    let is_chosen = |row: &&SignalRow| {
        filter.accepts(&seen.signals.full_name(row), row.value, seen.signals.alarm(row).is_some())
    };
    if filter.text().is_empty() {
        return HashSet::new();
    }
    seen.signals.rows().iter().filter(is_chosen).map(|row| (row.channel, row.message)).collect()
}

fn name<'a>(row: &Row, seen: &'a Seen) -> &'a str {
    let decoder = seen.signals.decoder();
    decoder.find(row.channel, row.frame.id()).map_or("", |message| &decoder.message(message).name)
}

fn line(row: &Row, screen: u16, app: &App, seen: &Seen) -> Line<'static> {
    let theme = app.theme;
    let base = if row.mark > 0 { theme.series(usize::from(row.mark) - 1) } else { Style::new() };
    let period = row.period_ns.map_or("–".to_owned(), |ns| format!("{:.3}", ns / 1e6));
    let jitter = row.period_ns.map_or(String::new(), |_| format!("{:.3}", row.jitter_ns / 1e6));
    let mut start = format!("{} {:>9} ", row.channel, row.frame.id().to_string());
    for (column, text) in [(COUNT, row.count.to_string()), (PERIOD, period), (JITTER, jitter)] {
        if screen >= column.from {
            // Writing to a String cannot fail.
            let _ = write!(start, "{text:>width$} ", width = column.width);
        }
    }
    let length = if row.frame.is_remote() { "R".to_owned() } else { row.frame.dlc().to_string() };
    let is_marked = seen.table.compared_since_ns.is_some() && row.length_changed;
    let length_style = if is_marked { theme.changed(0) } else { base };
    let mut spans = vec![Span::styled(start, base), Span::styled(length, length_style), Span::raw(" ")];
    let data = row.frame.data();
    for (index, byte) in data.iter().enumerate() {
        for (digit, value) in [(2 * index, byte >> 4), (2 * index + 1, byte & 0xF)] {
            let style = if seen.table.compared_since_ns.is_some() {
                if row.has_digit_changed(digit) { app.theme.changed(0) } else { app.theme.dim() }
            } else if app.heat {
                heat_style(row, digit, app)
            } else {
                changed_style(row, digit, seen.now_ns, app)
            };
            spans.push(Span::styled(format!("{value:X}"), style));
        }
        spans.push(Span::raw(" "));
    }
    let room = 3 * 8_usize.saturating_sub(data.len());
    let characters =
        if screen >= CHARACTERS.from { format!("{:<8} ", printable(data)) } else { String::new() };
    spans.push(Span::raw(format!("{:room$}{characters}", "")));
    spans.push(Span::styled(name(row, seen).to_owned(), base));
    if screen >= LEAST_WITH_SIGNALS {
        spans.extend(in_line(&seen.signals.in_frame(row.channel, &row.frame), theme));
    }
    Line::from(spans)
}

/// Highlighted for a while after a change, unless its bits are suppressed.
fn changed_style(row: &Row, digit: usize, now_ns: i64, app: &App) -> Style {
    match row.changed_ns[digit] {
        i64::MIN => Style::new(),
        changed_ns => app.theme.changed(now_ns.saturating_sub(changed_ns).max(0)),
    }
}

/// The more often the digit's most active bit changes, the hotter.
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
