//! Curves of the chosen signals: analogue ones by unit, digital ones below each other, with a cursor.

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::Style;
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::canvas::{Canvas, Line as Stroke};
use ratatui::widgets::{Block, Borders, Paragraph, Wrap};

use super::super::app::App;
use super::super::model::{Sample, Seen, SignalRow};
use super::signals::short;

/// Signals with two states are drawn as such.
fn is_digital(row: &SignalRow, seen: &Seen) -> bool {
    let signal = seen.signals.signal(row);
    signal.digital.is_some() || signal.length == 1
}

/// The signal's name; with its channel where another chosen one has the same.
fn name(row: &SignalRow, seen: &Seen) -> String {
    let own = &seen.signals.signal(row).name;
    let others = seen.signals.rows().iter().filter(|other| other.chosen && !std::ptr::eq(*other, row));
    let same = others.into_iter().any(|other| seen.signals.signal(other).name == *own);
    if same { format!("{}:{own}", row.channel) } else { own.clone() }
}

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, seen: &Seen) {
    let chosen: Vec<_> = seen.signals.rows().iter().filter(|row| row.chosen).collect();
    if chosen.is_empty() {
        let text = "No signal is chosen. On the page Signals (3), select one and press Enter.";
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), area);
        return;
    }
    let digital: Vec<_> = chosen.iter().copied().filter(|row| is_digital(row, seen)).collect();
    let mut panes: Vec<(String, Vec<&SignalRow>)> = Vec::new();
    for row in chosen.iter().copied().filter(|row| !is_digital(row, seen)) {
        let unit = &seen.signals.signal(row).unit;
        match panes.iter_mut().find(|(label, _)| !unit.is_empty() && label == unit) {
            Some((_, rows)) => rows.push(row),
            None => panes.push((unit.clone(), vec![row])),
        }
    }
    let mut heights: Vec<_> = panes.iter().map(|_| Constraint::Fill(1)).collect();
    heights.extend(digital.iter().map(|_| Constraint::Length(2)));
    heights.push(Constraint::Length(1));
    let areas = Layout::vertical(heights).split(area);
    let window = Window { now_ns: seen.now_ns, span_s: app.graph_span, cursor: app.graph_cursor };
    let mut colour = 0;
    for ((label, rows), area) in panes.iter().zip(areas.iter()) {
        analogue(frame, *area, label, rows, &window, colour, app, seen);
        colour += rows.len();
    }
    for (row, area) in digital.iter().zip(areas.iter().skip(panes.len())) {
        lane(frame, *area, row, &window, colour, app, seen);
        colour += 1;
    }
    let at = app
        .graph_cursor
        .map_or(String::new(), |share| format!("   cursor at {:.3} s", (share - 1.0) * app.graph_span));
    let scale = Line::from(format!(" the last {} s{at}", short(app.graph_span))).style(app.theme.label());
    if let Some(area) = areas.last() {
        frame.render_widget(Paragraph::new(scale), *area);
    }
}

/// The time that the graph shows.
struct Window {
    now_ns: i64,
    span_s: f64,
    cursor: Option<f64>,
}

impl Window {
    /// Seconds before now, negative.
    fn x(&self, time_ns: i64) -> f64 {
        time_ns.saturating_sub(self.now_ns) as f64 / 1e9
    }

    /// The samples to draw, and where on the time axis.
    fn shown<'a>(&self, row: &'a SignalRow) -> impl Iterator<Item = (f64, &'a Sample)> + use<'a> {
        let (now, span) = (self.now_ns, self.span_s);
        // One more on the left, where the curve comes from.
        let first =
            row.samples.partition_point(|sample| (sample.time_ns.saturating_sub(now) as f64) < -span * 1e9);
        row.samples.iter().skip(first.saturating_sub(1)).map(move |sample| {
            let x = sample.time_ns.saturating_sub(now) as f64 / 1e9;
            (x.max(-span), sample)
        })
    }

    /// The value that a curve has at the cursor.
    fn value(&self, row: &SignalRow) -> Option<f64> {
        let at = (self.cursor? - 1.0) * self.span_s;
        row.samples.iter().rev().find(|sample| self.x(sample.time_ns) <= at).map(|sample| sample.last)
    }
}

#[expect(clippy::too_many_arguments, reason = "a pane's place, content and colours belong together")]
fn analogue(
    frame: &mut Frame<'_>,
    area: Rect,
    label: &str,
    rows: &[&SignalRow],
    window: &Window,
    first_colour: usize,
    app: &App,
    seen: &Seen,
) {
    let mut low = f64::INFINITY;
    let mut high = f64::NEG_INFINITY;
    for (_, sample) in rows.iter().flat_map(|row| window.shown(row)) {
        low = low.min(sample.min);
        high = high.max(sample.max);
    }
    if low > high {
        (low, high) = (0.0, 1.0);
    }
    let margin = if high > low { (high - low) * 0.06 } else { low.abs().max(1.0) * 0.05 };
    let range = [low - margin, high + margin];
    let mut title = vec![Span::raw(format!(" {label} {} to {} ", short(low), short(high)))];
    for (index, row) in rows.iter().enumerate() {
        // At the cursor there may have been no value yet.
        let value = match window.cursor {
            None => short(row.value),
            Some(_) => window.value(row).map_or("–".to_owned(), short),
        };
        let text = format!("{} {value}  ", name(row, seen));
        title.push(Span::styled(text, app.theme.series(first_colour + index)));
    }
    let colour = |style: Style| style.fg.unwrap_or_default();
    let canvas = Canvas::default()
        .block(Block::new().borders(Borders::TOP).title(Line::from(title)))
        .marker(if app.theme.unicode { Marker::Braille } else { Marker::Dot })
        .x_bounds([-window.span_s, 0.0])
        .y_bounds(range)
        .paint(|context| {
            for row in rows {
                let alarms = seen.signals.signal(row).alarms;
                let limits = [(alarms.max, app.theme.error()), (alarms.min, app.theme.below())];
                for (limit, style) in limits {
                    if let Some(y) = limit.filter(|limit| (range[0]..=range[1]).contains(limit)) {
                        context.draw(&Stroke::new(-window.span_s, y, 0.0, y, colour(style)));
                    }
                }
            }
            context.layer();
            for (index, row) in rows.iter().enumerate() {
                let colour = colour(app.theme.series(first_colour + index));
                let mut before: Option<(f64, f64)> = None;
                for (x, sample) in window.shown(row) {
                    if let Some((from_x, from_y)) = before.filter(|_| !sample.after_gap) {
                        context.draw(&Stroke::new(from_x, from_y, x, sample.last, colour));
                    }
                    context.draw(&Stroke::new(x, sample.min, x, sample.max, colour));
                    before = Some((x, sample.last));
                }
            }
            if let Some(share) = window.cursor {
                let x = (share - 1.0) * window.span_s;
                context.draw(&Stroke::new(x, range[0], x, range[1], ratatui::style::Color::Reset));
            }
        });
    frame.render_widget(canvas, area);
}

/// A digital signal: its name, and high or low per column.
fn lane(
    frame: &mut Frame<'_>,
    area: Rect,
    row: &SignalRow,
    window: &Window,
    colour: usize,
    app: &App,
    seen: &Seen,
) {
    let signal = seen.signals.signal(row);
    let columns = usize::from(area.width);
    let symbols = if app.theme.unicode { [' ', '▁', '▔', '█'] } else { [' ', '_', '-', '#'] };
    let mut levels = vec![0usize; columns];
    let mut before: Option<(usize, usize)> = None;
    let mut state = false;
    for (x, sample) in window.shown(row) {
        state = match signal.digital {
            Some(digital) => digital.state(state, sample.last),
            None => sample.last != 0.0,
        };
        let place = (((x / window.span_s + 1.0) * columns as f64) as usize).min(columns.saturating_sub(1));
        if let Some((from, level)) = before.filter(|_| !sample.after_gap) {
            levels[from..=place].iter_mut().for_each(|cell| *cell |= level);
        }
        before = Some((place, if state { 2 } else { 1 }));
    }
    if let Some((from, level)) = before {
        levels[from..].iter_mut().for_each(|cell| *cell |= level);
    }
    let style = app.theme.series(colour);
    let mut line: Vec<char> = levels.into_iter().map(|level| symbols[level]).collect();
    let mut value = seen.signals.text(row);
    if let Some(share) = window.cursor {
        let place = ((share * columns as f64) as usize).min(columns.saturating_sub(1));
        if let Some(cell) = line.get_mut(place) {
            *cell = if app.theme.unicode { '│' } else { '|' };
        }
        value = window.value(row).map_or("–".to_owned(), short);
    }
    let line: String = line.into_iter().collect();
    let text =
        vec![Line::from(format!(" {} {value}", name(row, seen))).style(style), Line::from(line).style(style)];
    frame.render_widget(Paragraph::new(text), area);
}
