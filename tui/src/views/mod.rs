//! The pages, each in its own file, and what surrounds them.

mod bottom;
pub mod fixed;
pub mod graph;
pub mod help;
mod list;
pub mod nodes;
pub mod obd;
pub mod record;
pub mod scripts;
pub mod send;
pub mod signals;
mod state;
pub mod statistics;
pub mod trace;

use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::{Constraint, Layout};
use ratatui::style::Style;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Paragraph, Wrap};

use super::app::{App, View};
use super::cut::cut_line;
use super::model::Model;
use super::theme::Theme;
use cantap_protocols::Protocol;

/// The smallest usable screen.
pub const LEAST: (u16, u16) = (40, 8);

/// Draws everything.
pub fn draw(frame: &mut Frame<'_>, app: &mut App, model: &Model) {
    let area = frame.area();
    if area.width < LEAST.0 || area.height < LEAST.1 {
        let text = format!("too small: {}×{}, {}×{} needed", area.width, area.height, LEAST.0, LEAST.1);
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), area);
        return;
    }
    let [top, state, body, bottom] = Layout::vertical([
        Constraint::Length(1),
        Constraint::Length(1),
        Constraint::Min(1),
        Constraint::Length(1),
    ])
    .areas(area);
    let tabs = tabs(app, model, top.width.into());
    frame.render_widget(Paragraph::new(cut_line(tabs, top.width.into())).style(Theme::bar()), top);
    state::draw(frame, state, app, model);
    // While the display is paused, the pages show what had been seen then.
    let frozen = app.frozen.take();
    let seen = frozen.as_deref().unwrap_or(&model.seen);
    match app.view {
        View::Trace => trace::draw(frame, body, app, model),
        View::Fixed => fixed::draw(frame, body, app, model, seen),
        View::Signals => signals::draw(frame, body, app, model, seen),
        View::Graph => graph::draw(frame, body, app, &model.history, seen),
        View::Statistics => statistics::draw(frame, body, app, model, seen),
        View::Send => send::draw(frame, body, app, seen),
        View::Record => record::draw(frame, body, app, model),
        View::Nodes => nodes::draw(frame, body, app, model, seen),
        View::Scripts => scripts::draw(frame, body, app, model),
        View::Obd => obd::draw(frame, body, app, model),
    }
    app.frozen = frozen;
    bottom::draw(frame, body, bottom, app, model);
    if app.help {
        help::draw(frame, area, app);
    }
    if !app.theme.unicode {
        make_ascii(frame.buffer_mut());
    }
}

/// Replaces characters that a terminal without Unicode cannot show.
fn make_ascii(buffer: &mut Buffer) {
    for cell in &mut buffer.content {
        let plain = match cell.symbol() {
            symbol if symbol.is_ascii() => continue,
            "─" | "–" => "-",
            "━" => "=",
            "●" | "°" => "o",
            "◆" => "B",
            "│" | "╵" => "|",
            "Δ" => "d",
            "┤" | "┌" | "┐" | "└" | "┘" => "+",
            "▸" | "→" => ">",
            "←" => "<",
            "↑" => "^",
            "↓" => "v",
            "×" => "x",
            "µ" => "u",
            // A point after a digit would be a decimal one.
            "…" => "~",
            "•" => "*",
            _ => "?",
        };
        cell.set_symbol(plain);
    }
}

/// Whether a vehicle is there that answers, as far as was heard.
fn is_vehicle(model: &Model) -> bool {
    let mut nodes = model.seen.talked.overview.nodes();
    model.vehicle.is_there || nodes.any(|((_, protocol, _), _)| protocol == Protocol::Obd)
}

/// The pages. Where there is no room for all titles, the longest go, apart from the current page's; that of a vehicle goes first, if there is none.
fn tabs(app: &mut App, model: &Model, width: usize) -> Line<'static> {
    let (this, all) = app.beside;
    let beside = if all > 1 { format!("w {this} of {all}") } else { String::new() };
    let mut titles = View::ALL.map(View::title);
    let text = |index: usize, titles: &[&str]| {
        let mark = if View::ALL[index] == app.view { '▸' } else { ' ' };
        if titles[index].is_empty() {
            format!("{} ", (index + 1) % 10)
        } else {
            format!("{}{mark}{} ", (index + 1) % 10, titles[index])
        }
    };
    let length = |count: usize, titles: &[&str]| {
        (0..count).map(|index| text(index, titles).chars().count()).sum::<usize>()
    };
    // A blank at the end is not missed.
    let room = width + usize::from(beside.is_empty()) - beside.len();
    let mut count = titles.len();
    let is_wanted = app.plan.is_some() && (is_vehicle(model) || length(count, &titles) <= room);
    if app.view != View::Obd && !is_wanted {
        count -= 1;
    }
    while length(count, &titles) > room {
        let others = (0..count).filter(|index| View::ALL[*index] != app.view);
        let longest =
            others.filter(|index| !titles[*index].is_empty()).max_by_key(|index| titles[*index].len());
        let Some(longest) = longest else { break };
        titles[longest] = "";
    }
    let (mut spans, mut columns, mut end) = (Vec::new(), Vec::new(), 0);
    for (index, view) in View::ALL.into_iter().enumerate().take(count) {
        let text = text(index, &titles);
        let begin = end;
        end += text.chars().count() as u16;
        columns.push((begin..end, view));
        let style = if view == app.view { Theme::heading() } else { Style::new() };
        spans.push(Span::styled(text, style));
    }
    app.tab_columns = columns;
    spans.push(Span::styled(beside, Theme::heading()));
    Line::from(spans)
}
