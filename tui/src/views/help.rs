//! All keys.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::Line;
use ratatui::widgets::{Block, Clear};

use super::super::app::App;
use super::super::cut::draw_lines;
use super::super::theme::Theme;

/// Every key; `tests/help.rs` checks these against the keys that are handled.
pub const KEYS: &[(&str, &str)] = &[
    ("1 … 9, Tab  0", "pages: trace, fixed, signals, graph …; 0 asks a vehicle"),
    ("q, Ctrl-C Ctrl-Z", "leave; give the shell back for a while"),
    ("h ? F1", "this"),
    ("Space", "stop or go on: display, file, OBD; send, scripts: on or off"),
    ("c  t", "clear; times: relative, delta, time of day (UTC)"),
    ("f", "show only some frames, by candump's filters or a condition"),
    ("/  n  N", "search this page, next, and the other way"),
    ("y", "trace: copy the selected frame"),
    ("arrows, Pg, End", "scroll; End is the newest"),
    ("s  S  g", "fixed, signals: sort, reverse, group; or click on headings"),
    ("#  *  H", "fixed: hide what changes anyway, show it again, bits' heat"),
    ("z", "fixed: only what changes from now on; again: all rows"),
    ("x  u  o", "fixed: hide the row, show all, colour the row"),
    ("Enter", "trace, fixed: signals; signals: into the graph; send: once"),
    ("F", "signals, fixed: show only some, by name, value, alarm"),
    ("+ -  ↑ ↓ wheel", "graph: zoom, around the cursor or the mouse"),
    ("← → PgUp PgDn", "graph: move the cursor or pan; Home is oldest, End follows"),
    ("x  a  s  Esc", "graph: cursors, show all, steps or lines, no cursors"),
    ("a  e  d", "send: add, edit, delete"),
    ("a  e  d  K", "scripts: add, edit, remove; the next key is for them"),
    ("g  x  i", "send: group on or off, write the list, add a file's"),
    ("m  R", "listen-only or normal; bring a bus-off channel back"),
    ("r", "start or stop recording"),
    ("b  A  D", "bit rates, find the bit rates by listening, device"),
    ("O  w  W", "open a database, or a trace beside; next source; close it"),
    (",  .  p  >  l", "file: slower, faster, stop, one frame, loop"),
    ("[  ]  T", "file: 10 s back, 10 s on, go to a time"),
    ("B  {  }", "bookmark here, go to the one before, after"),
];

/// Draws the help over the page; the arrows scroll to the rest.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App) {
    let width = area.width.min(92);
    let height = area.height.min(KEYS.len() as u16 + 2);
    let place =
        Rect { x: area.x + (area.width - width) / 2, y: area.y + (area.height - height) / 2, width, height };
    let hidden = KEYS.len().saturating_sub(usize::from(height.saturating_sub(2)));
    app.help_first = app.help_first.min(hidden);
    let shown = KEYS.iter().skip(app.help_first);
    let lines: Vec<_> = shown.map(|(keys, what)| Line::from(format!(" {keys:<16} {what}"))).collect();
    frame.render_widget(Clear, place);
    let title =
        if hidden > 0 { " Keys; ↑ ↓ show more, any key closes " } else { " Keys, any key closes " };
    let block = Block::bordered().title(title).title_style(Theme::heading());
    let inner = block.inner(place);
    frame.render_widget(block, place);
    draw_lines(frame, inner, lines);
}
