//! The pages, each a file of its own, and what is around them.

pub mod fixed;
pub mod graph;
pub mod help;
pub mod record;
pub mod send;
pub mod signals;
pub mod statistics;
pub mod trace;

use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::text::{Line, Span};
use ratatui::widgets::Paragraph;

use super::app::{App, PromptKind, View, source_text};
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
    match app.view {
        View::Trace => trace::draw(frame, body, app, model),
        View::Fixed => fixed::draw(frame, body, app, model),
        View::Signals => signals::draw(frame, body, app, model),
        View::Graph => graph::draw(frame, body, app, model),
        View::Statistics => statistics::draw(frame, body, app, model),
        View::Send => send::draw(frame, body, app, model),
        View::Record => record::draw(frame, body, app, model),
    }
    frame.render_widget(Paragraph::new(bottom_line(app, model)).style(Theme::bar()), bottom);
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
        let style = if view == app.view { Theme::heading() } else { ratatui::style::Style::new() };
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
        let mode = if plan.mode.transmits() { "normal" } else { "listen-only" };
        format!("{} {mode}", plan.address)
    });
    let style = match model.source {
        SourceState::Gone(_) => theme.error(),
        _ => theme.label(),
    };
    let mut spans = vec![Span::styled(format!(" {source}: {}", source_text(model)), style)];
    for (channel, windows) in &model.loads {
        if let Some(load) = windows.back().and_then(|window| window.load_pct) {
            spans.push(Span::raw(format!("  {channel} ")));
            spans.push(Span::styled(format!("{load:.1} %"), theme.load(load)));
        }
    }
    let lost: u64 = model.statistics.channels().iter().map(|channel| channel.losses.total()).sum();
    if lost > 0 {
        spans.push(Span::styled(format!("  lost {lost}"), theme.loss()));
    }
    if let Some(recording) = &model.recording {
        spans.push(Span::styled(format!("  REC {}", bytes(recording.bytes)), theme.error()));
    }
    if app.paused {
        spans.push(Span::styled("  PAUSED", Theme::heading()));
    }
    if !model.filters.is_empty() {
        spans.push(Span::styled("  FILTER", Theme::heading()));
    }
    Line::from(spans)
}

fn bottom_line(app: &App, model: &Model) -> Line<'static> {
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
        return Line::from(format!(" {question}: {}_{said}", prompt.text));
    }
    if !app.message.is_empty() {
        return Line::from(format!(" {}", app.message));
    }
    if !model.notice.is_empty() {
        return Line::from(format!(" {}   (h help)", model.notice));
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
    Line::from(format!(" h help  q quit  {keys}{playback}  Space pause  c clear"))
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
