//! The pages, each a file of its own, and what is around them.

pub mod fixed;
pub mod graph;
pub mod help;
pub mod record;
pub mod send;
pub mod signals;
pub mod statistics;
pub mod trace;

use cantap::wire::message::Mode;
use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::Paragraph;

use super::app::{App, PromptKind, View};
use super::model::{Model, SourceState};
use super::theme::Theme;

/// The smallest screen that anything fits on.
pub const LEAST: (u16, u16) = (40, 8);

/// Draws everything.
pub fn draw(frame: &mut Frame<'_>, app: &mut App, model: &Model) {
    let area = frame.area();
    if area.width < LEAST.0 || area.height < LEAST.1 {
        let text = format!("too small: {}×{}, {}×{} needed", area.width, area.height, LEAST.0, LEAST.1);
        frame.render_widget(Paragraph::new(text), area);
        return;
    }
    let [top, state, body, bottom] = Layout::vertical([
        Constraint::Length(1),
        Constraint::Length(1),
        Constraint::Min(1),
        Constraint::Length(1),
    ])
    .areas(area);
    frame.render_widget(Paragraph::new(tabs(app)).style(Theme::bar()), top);
    frame.render_widget(Paragraph::new(state_line(app, model)), state);
    // While the display is stopped, the pages show what was seen then.
    let frozen = app.frozen.take();
    let seen = frozen.as_deref().unwrap_or(&model.seen);
    match app.view {
        View::Trace => trace::draw(frame, body, app, model),
        View::Fixed => fixed::draw(frame, body, app, model, seen),
        View::Signals => signals::draw(frame, body, app, model, seen),
        View::Graph => graph::draw(frame, body, app, seen),
        View::Statistics => statistics::draw(frame, body, app, model, seen),
        View::Send => send::draw(frame, body, app, seen),
        View::Record => record::draw(frame, body, app, model),
    }
    app.frozen = frozen;
    frame.render_widget(
        Paragraph::new(bottom_line(app, model, usize::from(area.width))).style(Theme::bar()),
        bottom,
    );
    if app.help {
        help::draw(frame, area);
    }
    if !app.theme.unicode {
        make_ascii(frame.buffer_mut());
    }
}

/// Replaces what a terminal without Unicode cannot show.
fn make_ascii(buffer: &mut Buffer) {
    for cell in &mut buffer.content {
        let plain = match cell.symbol() {
            symbol if symbol.is_ascii() => continue,
            "─" | "–" => "-",
            "│" => "|",
            "┌" | "┐" | "└" | "┘" => "+",
            "▸" | "→" => ">",
            "←" => "<",
            "↑" => "^",
            "↓" => "v",
            "×" => "x",
            "µ" => "u",
            "…" => ".",
            "•" => "*",
            _ => "?",
        };
        cell.set_symbol(plain);
    }
}

fn tabs(app: &App) -> Line<'static> {
    let mut spans = vec![Span::raw(" ")];
    for (index, view) in View::ALL.into_iter().enumerate() {
        let text = format!("{}{}{} ", index + 1, if view == app.view { '▸' } else { ' ' }, view.title());
        let style = if view == app.view { Theme::heading() } else { Style::new() };
        spans.push(Span::styled(text, style));
    }
    Line::from(spans)
}

/// The page whose tab is in this column.
pub fn tab_at(column: u16) -> Option<View> {
    let mut end = 1;
    View::ALL.into_iter().find(|view| {
        end += view.title().len() as u16 + 3;
        column < end
    })
}

/// Source, load per channel, recording, filters.
fn state_line(app: &App, model: &Model) -> Line<'static> {
    let theme = app.theme;
    let source = app.plan.as_ref().map_or("file".to_owned(), |plan| {
        let mode = match plan.mode() {
            Mode::ListenOnly => "listen-only",
            Mode::Normal => "normal",
            Mode::Loopback => "loopback",
            Mode::SilentLoopback => "silent loopback",
        };
        format!("{} {mode}", plan.address)
    });
    let style = match model.source {
        SourceState::Gone(_) => theme.error(),
        _ => theme.label(),
    };
    let mut spans = vec![Span::styled(format!(" {source}: {}", source_text(app, model)), style)];
    if let Some((count, _)) = &model.unread {
        spans.push(Span::styled(format!("  {count} unreadable"), theme.error()));
    }
    for (channel, windows) in &model.seen.loads {
        if let Some(load) = windows.back().and_then(|window| window.load_pct) {
            spans.push(Span::raw(format!("  {channel} ")));
            spans.push(Span::styled(format!("{load:.1} %"), theme.load(load)));
        }
    }
    let (lost, or_more) = model.seen.lost();
    if lost > 0 || or_more {
        let more = if or_more { "+" } else { "" };
        spans.push(Span::styled(format!("  lost {lost}{more}"), theme.loss()));
    }
    if let Some(recording) = &model.recording {
        spans.push(Span::styled(format!("  REC {}", bytes(recording.bytes)), theme.error()));
    }
    if app.frozen.is_some() {
        spans.push(Span::styled("  PAUSED", Theme::heading()));
    }
    if !model.history.filters().is_empty() {
        spans.push(Span::styled("  FILTER", Theme::heading()));
    }
    Line::from(spans)
}

fn bottom_line(app: &App, model: &Model, width: usize) -> Line<'static> {
    if let Some(prompt) = &app.prompt {
        let question = match prompt.kind {
            PromptKind::Search => "search",
            PromptKind::Filter => "show only, in candump's syntax (empty: all)",
            PromptKind::Record => {
                "record to FILE, or FILE if CONDITION (.log .asc .blf .csv .trc .pcapng, .gz .zst)"
            }
            PromptKind::Send => "[CHANNEL:]FRAME or Message:Signal=…, then a period",
            PromptKind::BitRate => "bit rates",
            PromptKind::Device => "device",
        };
        let said = if app.message.is_empty() { String::new() } else { format!("  ({})", app.message) };
        let (before, behind) = prompt.line.halves();
        let mut behind = behind.chars();
        // The place is a block, and an underscore where there is nothing.
        let place = behind.next().map_or("_".to_owned(), String::from);
        return Line::from(vec![
            Span::raw(format!(" {question}: {before}")),
            Span::styled(place, Style::new().add_modifier(Modifier::REVERSED)),
            Span::raw(format!("{}{said}", behind.as_str())),
        ]);
    }
    if !app.message.is_empty() {
        return Line::from(format!(" {}", app.message));
    }
    if !model.notice.is_empty() {
        return Line::from(format!(" {}   (h help)", model.notice));
    }
    if let SourceState::Gone(reason) = &model.source {
        return Line::from(format!(" {reason}   (h help)"));
    }
    if let (Some((count, first)), View::Statistics) = (&model.unread, app.view) {
        return Line::from(format!(" {count} places could not be read and are left out, the first: {first}"));
    }
    let keys = match app.view {
        View::Trace => "t time  / search  n N next  y copy  ↑↓ scroll  End newest",
        View::Fixed => "s S sort  g group  # * notch  H heat  x u hide  o colour",
        View::Signals => "↑↓ select  Enter into the graph",
        View::Graph => "+ - zoom  ← → cursor  Esc no cursor",
        View::Statistics => "b bit rate  A find it  D device",
        View::Send => "a add  e edit  d delete  Enter once  Space on/off  m mode",
        View::Record => "r start or stop",
    };
    let playback = match model.source {
        SourceState::Playing { .. } => "  , . speed  p stop  > step  l loop",
        _ => "",
    };
    let all = format!("h help  q quit  {keys}{playback}  Space pause  c clear");
    Line::from(format!(" {}", fitting(&all, width.saturating_sub(1))))
}

/// As many of the hints, which stand two blanks apart, as there is room for.
fn fitting(hints: &str, width: usize) -> &str {
    if hints.chars().count() <= width {
        return hints;
    }
    let ends = hints.match_indices("  ").map(|(at, _)| at);
    let end = ends.filter(|end| hints[..*end].chars().count() <= width).last().unwrap_or(0);
    &hints[..end]
}

/// How the source is, in words for the second line.
fn source_text(app: &App, model: &Model) -> String {
    match &model.source {
        SourceState::Starting => "connecting".to_owned(),
        SourceState::Running => "running".to_owned(),
        SourceState::Searching => "finding the bit rate".to_owned(),
        SourceState::Gone(_) if app.plan.is_some() => "GONE, trying again".to_owned(),
        SourceState::Gone(_) => "cannot be played".to_owned(),
        SourceState::Playing { factor, paused, looped, ended } => {
            let state = match (paused, ended) {
                (_, true) => "ended",
                (true, _) => "stopped",
                _ => "playing",
            };
            let looped = if *looped { ", loop" } else { "" };
            let speed =
                if *factor == 0.0 { "as fast as can be".to_owned() } else { format!("delay ×{factor}") };
            format!("{state}, {speed}{looped}")
        }
    }
}

/// A number of bytes for people.
pub fn bytes(bytes: u64) -> String {
    match bytes {
        0..10_000 => format!("{bytes} B"),
        10_000..10_000_000 => format!("{} kB", bytes / 1000),
        10_000_000..10_000_000_000 => format!("{} MB", bytes / 1_000_000),
        _ => format!("{} GB", bytes / 1_000_000_000),
    }
}

/// The first row to show so that the selected one is on the page.
pub fn first_row(selected: usize, rows: usize) -> usize {
    selected.saturating_sub(rows.saturating_sub(1))
}

/// Lines below a heading, from the first row that keeps the selected one in sight.
fn list(
    frame: &mut Frame<'_>,
    area: Rect,
    app: &mut App,
    heading: Line<'static>,
    count: usize,
    row: impl Fn(usize, &App) -> Line<'static>,
) {
    let rows = usize::from(area.height).saturating_sub(1);
    app.page_rows = rows;
    app.selected = app.selected.min(count.saturating_sub(1));
    let first = first_row(app.selected, rows);
    let mut lines = vec![heading.style(Theme::heading())];
    for index in first..count.min(first + rows) {
        let line = row(index, app);
        lines.push(if index == app.selected { line.style(Theme::bar()) } else { line });
    }
    frame.render_widget(Paragraph::new(lines), area);
}
