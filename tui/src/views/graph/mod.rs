//! Curves of the chosen signals: analogue ones by unit, digital ones below each other, on the same time axis, with two
//! cursors.

mod axis;
mod curve;

use std::fmt::Write as _;

use cantap_signals::Digital;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Style};
use ratatui::symbols::Marker;
use ratatui::text::{Line, Span};
use ratatui::widgets::canvas::{Canvas, Line as Stroke};
use ratatui::widgets::{Block, Borders, Paragraph, Wrap};

use super::super::app::{App, Drawn};
use super::super::cut::{cut_line, draw_lines};
use super::super::model::{History, Seen, Series, SignalRow};
use super::super::times::clock;
use super::signals::short;
use axis::GUTTER;
use curve::{Curve, Time, Trail};

/// With fewer columns, there is no room for values on the left.
const LEAST_WITH_GUTTER: u16 = 50;
/// The cursors' names.
const CURSORS: [char; 2] = ['A', 'B'];

/// A chosen signal and its values.
#[derive(Clone, Copy)]
struct Chosen<'a> {
    row: &'a SignalRow,
    series: &'a Series,
    colour: usize,
}

/// What all panes have in common.
struct Page<'a> {
    app: &'a App,
    history: &'a History,
    seen: &'a Seen,
    /// The columns of the curves; each pane has its own rows.
    columns: Rect,
    from_ns: i64,
}

/// Whether a signal has two states and is drawn as such.
fn is_digital(row: &SignalRow, seen: &Seen) -> bool {
    let signal = seen.signals.signal(row);
    signal.digital.is_some() || signal.length == 1
}

/// The signal's name, with its channel if another chosen one has the same name.
fn name(row: &SignalRow, seen: &Seen) -> String {
    let own = &seen.signals.signal(row).name;
    let others =
        seen.signals.rows().iter().filter(|other| other.series.is_some() && !std::ptr::eq(*other, row));
    let same = others.into_iter().any(|other| seen.signals.signal(other).name == *own);
    if same { format!("{}:{own}", row.channel) } else { own.clone() }
}

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, history: &History, seen: &Seen) {
    let chosen = seen.signals.rows().iter().filter_map(|row| Some((row, row.series.as_ref()?)));
    let (digital, analogue): (Vec<_>, Vec<_>) = chosen.partition(|(row, _)| is_digital(row, seen));
    if digital.is_empty() && analogue.is_empty() {
        app.graph.drawn = Drawn::default();
        let text = "No signal is chosen. On the page Signals (3), select one and press Enter.";
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), area);
        return;
    }
    let mut colours = 0..;
    let mut with_colour = |(row, series)| Chosen { row, series, colour: colours.next().unwrap_or_default() };
    let mut panes: Vec<(&str, Vec<Chosen<'_>>)> = Vec::new();
    for chosen in analogue.into_iter().map(&mut with_colour) {
        let unit = seen.signals.signal(chosen.row).unit.as_str();
        match panes.iter_mut().find(|(label, _)| !unit.is_empty() && *label == unit) {
            Some((_, rows)) => rows.push(chosen),
            None => panes.push((unit, vec![chosen])),
        }
    }
    let lanes: Vec<_> = digital.into_iter().map(with_colour).collect();

    let mut heights: Vec<_> = panes.iter().map(|_| Constraint::Fill(1)).collect();
    heights.extend(lanes.iter().map(|_| Constraint::Length(2)));
    if panes.is_empty() {
        // Lanes are at the top.
        heights.push(Constraint::Fill(1));
    }
    heights.extend([Constraint::Length(1), Constraint::Length(1)]);
    let areas = Layout::vertical(heights).split(area);
    let gutter = if area.width < LEAST_WITH_GUTTER { 0 } else { GUTTER };
    let columns = Rect { x: area.x + gutter, width: area.width - gutter, ..area };
    let all = panes.iter().flat_map(|(_, rows)| rows).chain(&lanes);
    let oldest = all.filter_map(|chosen| chosen.series.first_ns()).min().unwrap_or(seen.now_ns);
    let (from_ns, _) = app.graph.window(seen.now_ns);
    app.graph.drawn = Drawn {
        area: Rect { height: area.height.saturating_sub(1), ..columns },
        from_ns,
        oldest_ns: oldest,
        now_ns: seen.now_ns,
    };
    let page = Page { app, history, seen, columns, from_ns };
    for ((label, rows), area) in panes.iter().zip(areas.iter()) {
        page.analogue(frame, *area, label, rows);
    }
    for (chosen, area) in lanes.iter().zip(areas.iter().skip(panes.len())) {
        page.lane(frame, *area, *chosen);
    }
    if let [.., times, said] = areas[..] {
        let is_cut =
            panes.iter().flat_map(|(_, rows)| rows).chain(&lanes).any(|chosen| chosen.series.is_cut());
        let not_kept = (is_cut && from_ns < oldest).then_some(oldest);
        let is_shown = page.times(frame, times, not_kept);
        draw_lines(frame, said, vec![page.time_line(not_kept.filter(|_| !is_shown))]);
    }
}

/// Shown if the window begins before the oldest value.
fn not_kept_before(oldest_ns: i64) -> String {
    format!("before {} nothing is kept (--history)", clock(oldest_ns, 0))
}

impl Page<'_> {
    fn time(&self, columns: usize) -> Time {
        Time { from_ns: self.from_ns, span_ns: self.app.graph.span_ns, columns }
    }

    /// The cursors with their names.
    fn cursors(&self) -> impl Iterator<Item = (char, i64)> {
        CURSORS.into_iter().zip(self.app.graph.cursors).filter_map(|(name, at)| Some((name, at?)))
    }

    /// A signal's value; its values at the cursors and their difference, if there are any.
    fn values(&self, chosen: Chosen<'_>, text: impl Fn(f64) -> String) -> String {
        let at: Vec<_> = self.cursors().map(|(name, time_ns)| (name, chosen.series.at(time_ns))).collect();
        // There may have been no value yet at a cursor.
        let shown = |value: Option<f64>| value.map_or("–".to_owned(), &text);
        match at[..] {
            [] => text(chosen.row.value),
            [(name, value)] => format!("{name} {}", shown(value)),
            [(_, first), (_, second), ..] => {
                let difference = first.zip(second).map(|(first, second)| second - first);
                let difference = difference.map_or("–".to_owned(), short);
                format!("A {} B {} Δ {difference}", shown(first), shown(second))
            }
        }
    }

    fn analogue(&self, frame: &mut Frame<'_>, area: Rect, label: &str, rows: &[Chosen<'_>]) {
        let theme = self.app.theme;
        let graph = &self.app.graph;
        // A Braille cell is two dots wide and four high.
        let dots = if theme.unicode { (2, 4) } else { (1, 1) };
        let time = self.time(usize::from(self.columns.width) * dots.0);
        let trails: Vec<_> = rows.iter().map(|chosen| Trail::new(chosen.series, time)).collect();
        let extremes = trails.iter().filter_map(|trail| trail.extremes(graph.lines));
        let (low, high) =
            extremes.reduce(|(low, high), (min, max)| (low.min(min), high.max(max))).unwrap_or((0.0, 1.0));
        let margin = if high > low { (high - low) * 0.06 } else { low.abs().max(1.0) * 0.05 };
        let range = [low - margin, high + margin];
        let mut title = vec![Span::raw(format!(" {label} ").replace("  ", " "))];
        for chosen in rows {
            let text = format!("{} {}  ", name(chosen.row, self.seen), self.values(*chosen, short));
            title.push(Span::styled(text, theme.series(chosen.colour)));
        }
        let block = Block::new().borders(Borders::TOP).title(cut_line(Line::from(title), area.width.into()));
        let inner = block.inner(area);
        frame.render_widget(block, area);
        let place = Rect { x: self.columns.x, width: self.columns.width, ..inner };
        for (row, text) in axis::values(range, place.height) {
            let tick = if theme.unicode { '┤' } else { '+' };
            let text = format!("{text:>width$}{tick}", width = usize::from(GUTTER) - 1);
            let at = Rect { y: place.y + row, height: 1, x: area.x, width: self.columns.x - area.x };
            frame.render_widget(Paragraph::new(Line::styled(text, theme.label())), at);
        }
        let colour = |style: Style| style.fg.unwrap_or_default();
        let canvas = Canvas::default()
            .marker(if theme.unicode { Marker::Braille } else { Marker::Dot })
            .x_bounds([0.0, 1.0])
            .y_bounds(range)
            .paint(|context| {
                for chosen in rows {
                    let alarms = self.seen.signals.signal(chosen.row).alarms;
                    let limits = [(alarms.max, theme.error()), (alarms.min, theme.below())];
                    for (limit, style) in limits {
                        if let Some(y) = limit.filter(|limit| (range[0]..=range[1]).contains(limit)) {
                            context.draw(&Stroke::new(0.0, y, 1.0, y, colour(style)));
                        }
                    }
                }
                context.layer();
                for (trail, chosen) in trails.iter().zip(rows) {
                    context.draw(&Curve {
                        trail,
                        range,
                        rows: usize::from(place.height) * dots.1,
                        colour: colour(theme.series(chosen.colour)),
                        lines: graph.lines,
                    });
                }
                context.layer();
                for (_, at) in self.cursors() {
                    if let Some(column) = time.place(at) {
                        let x = (column as f64 + 0.5) / time.columns as f64;
                        context.draw(&Stroke::new(x, range[0], x, range[1], Color::Reset));
                    }
                }
            });
        frame.render_widget(canvas, place);
    }

    /// A digital signal: its name, and for each column high, low, or both.
    fn lane(&self, frame: &mut Frame<'_>, area: Rect, chosen: Chosen<'_>) {
        let theme = self.app.theme;
        let signal = self.seen.signals.signal(chosen.row);
        let is_on = |before: bool, value: f64| {
            signal.digital.map_or(value != 0.0, |digital: Digital| digital.state(before, value))
        };
        let symbols = if theme.unicode { [' ', '▁', '▔', '█'] } else { [' ', '_', '-', '#'] };
        let time = self.time(usize::from(self.columns.width));
        let trail = Trail::new(chosen.series, time);
        let level = |state: bool| if state { 2 } else { 1 };
        let mut levels = vec![0usize; time.columns];
        let mut state = trail.before().map(|value| is_on(false, value));
        let mut from = 0;
        for (place, column) in trail.columns().iter().enumerate() {
            let Some(column) = column else { continue };
            if let Some(before) = state.filter(|_| !column.after_gap) {
                levels[from..=place].iter_mut().for_each(|cell| *cell |= level(before));
            }
            let first = is_on(state.unwrap_or(false), column.first.value);
            for value in [column.first.value, column.min, column.max] {
                levels[place] |= level(is_on(first, value));
            }
            let last = is_on(first, column.last.value);
            levels[place] |= level(last);
            state = (!column.before_gap).then_some(last);
            from = place;
        }
        if let Some(state) = state.filter(|_| trail.goes_on()) {
            levels[from..].iter_mut().for_each(|cell| *cell |= level(state));
        }
        let style = theme.series(chosen.colour);
        let mut line: Vec<char> = levels.into_iter().map(|level| symbols[level]).collect();
        for (_, at) in self.cursors() {
            if let Some(place) = time.place(at) {
                line[place] = if theme.unicode { '│' } else { '|' };
            }
        }
        let value = if self.cursors().next().is_none() {
            self.seen.signals.text(chosen.row)
        } else {
            self.values(chosen, short)
        };
        let indent = usize::from(self.columns.x - area.x);
        let line: String = line.into_iter().collect();
        let text = vec![
            Line::from(format!(" {} {value}", name(chosen.row, self.seen))).style(style),
            Line::from(format!("{:indent$}{line}", "")).style(style),
        ];
        draw_lines(frame, area, text);
    }

    /// Times of day below the curves, and the cursors' names at their positions. If older values have been dropped, that is shown
    /// instead of times if there is room; returns whether it was.
    fn times(&self, frame: &mut Frame<'_>, area: Rect, not_kept: Option<i64>) -> bool {
        let time = self.time(usize::from(self.columns.width));
        let tick = if self.app.theme.unicode { '╵' } else { '|' };
        let mut line: Vec<char> = axis::times(time, tick).chars().collect();
        let nothing = not_kept.map(|oldest_ns| (time.place(oldest_ns), not_kept_before(oldest_ns)));
        let nothing = nothing.and_then(|(place, text)| Some((place?, text)));
        let is_shown = nothing.is_some_and(|(place, text)| {
            let fits = text.chars().count() < place;
            if fits {
                line[..place].fill(' ');
                line.iter_mut().zip(text.chars()).for_each(|(cell, character)| *cell = character);
            }
            fits
        });
        for (name, at) in self.cursors() {
            if let Some(cell) = time.place(at).and_then(|place| line.get_mut(place)) {
                *cell = name;
            }
        }
        let utc = if self.columns.x > area.x { " UTC" } else { "" };
        let indent = usize::from(self.columns.x - area.x);
        let line: String = line.into_iter().collect();
        let line = Line::styled(format!("{utc:<indent$}{line}"), self.app.theme.label());
        frame.render_widget(Paragraph::new(line), area);
        is_shown
    }

    /// The window's length, the cursors' positions, and what is out of sight.
    fn time_line(&self, not_kept: Option<i64>) -> Line<'static> {
        let theme = self.app.theme;
        let graph = &self.app.graph;
        let mut text = format!(" {} s", short(graph.span_ns as f64 / 1e9));
        text.push_str(if graph.lines { ", lines" } else { ", steps" });
        // Writing to a String cannot fail.
        for (name, at) in self.cursors() {
            let _ = write!(text, "  {name} {}", clock(at, 6));
        }
        if let [Some(first), Some(second)] = graph.cursors {
            let between = self.history.interval(first, second);
            let clock = if between.by_device { " by the device's clock" } else { "" };
            let _ = write!(text, "  Δt {:.6} s{clock}", between.ns as f64 / 1e9);
        }
        let mut spans = vec![Span::styled(text, theme.label())];
        if let Some(oldest_ns) = not_kept {
            spans.push(Span::styled(format!("  {}", not_kept_before(oldest_ns)), theme.loss()));
        }
        Line::from(spans)
    }
}
