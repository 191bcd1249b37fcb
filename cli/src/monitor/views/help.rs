//! All keys.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::Line;
use ratatui::widgets::{Block, Clear, Paragraph};

use super::super::theme::Theme;

const KEYS: &[(&str, &str)] = &[
    ("1 … 7, Tab", "pages: trace, fixed, signals, graph, statistics, send, record"),
    ("q, Ctrl-C", "leave"),
    ("Space", "stop the display, go on; send: the entry on or off"),
    ("c", "clear"),
    ("t", "times: relative, delta, absolute"),
    ("f", "show only some frames, by filters in candump's syntax"),
    ("/  n  N", "trace: search, next older, next newer"),
    ("y", "trace: copy the selected frame"),
    ("arrows, Pg, End", "scroll; End is the newest"),
    ("s  S  g", "fixed: sort by the next column, reverse, group by channel"),
    ("#  *  H", "fixed: hide what changes anyway, show it again, heat of bits"),
    ("x  u  o", "fixed: hide the row, show all, colour the row"),
    ("Enter", "signals: into the graph; send: send once"),
    ("+ -  ↑ ↓ wheel", "graph: zoom, around the cursor or the mouse"),
    ("← → PgUp PgDn", "graph: move the cursor, or pan; Home is the oldest, End follows"),
    ("x  a  s  Esc", "graph: cursors A and B, show all, steps or lines, no cursors"),
    ("a  e  d", "send: add, edit, delete"),
    ("m", "listen-only or normal"),
    ("r", "start or stop recording"),
    ("b  A  D", "bit rates, find the bit rates by listening, device"),
    (",  .  p  >  l", "file: slower, faster, stop, one frame, loop"),
];

/// Draws the help over the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect) {
    let width = area.width.min(92);
    let height = area.height.min(KEYS.len() as u16 + 2);
    let place =
        Rect { x: area.x + (area.width - width) / 2, y: area.y + (area.height - height) / 2, width, height };
    let lines: Vec<_> = KEYS.iter().map(|(keys, what)| Line::from(format!(" {keys:<15} {what}"))).collect();
    frame.render_widget(Clear, place);
    let block = Block::bordered().title(" Keys, any key closes ").title_style(Theme::heading());
    frame.render_widget(Paragraph::new(lines).block(block), place);
}
