//! The graph's time window and its two cursors, and how keys and the mouse change them.

use ratatui::crossterm::event::{KeyCode, KeyModifiers, MouseButton, MouseEvent, MouseEventKind};
use ratatui::layout::Rect;

/// The shortest window, in nanoseconds: 0.1 ms, which contains two frames of a fast bus.
const LEAST_SPAN_NS: i64 = 100_000;
/// The longest, in nanoseconds: a week.
const MOST_SPAN_NS: i64 = 604_800_000_000_000;
/// A key pans by the window's length divided by this.
const PAN: i64 = 10;

/// The graph's view of time.
#[derive(Clone, Debug)]
pub struct Graph {
    /// Length of the window, in nanoseconds.
    pub span_ns: i64,
    /// Its end, in nanoseconds as in a record; `None` to follow the newest.
    pub end_ns: Option<i64>,
    /// The cursors A and B.
    pub cursors: [Option<i64>; 2],
    /// The cursor moved by the keys.
    pub active: usize,
    /// Straight lines from value to value, instead of steps that hold each value until the next.
    pub lines: bool,
    /// What was last drawn.
    pub drawn: Drawn,
}

/// A graph as it was drawn.
#[derive(Clone, Copy, Debug, Default)]
pub struct Drawn {
    /// The columns taken by the curves.
    pub area: Rect,
    /// The window's begin.
    pub from_ns: i64,
    /// The time of the oldest value.
    pub oldest_ns: i64,
    /// The time of the newest record.
    pub now_ns: i64,
}

impl Default for Graph {
    fn default() -> Self {
        Self {
            span_ns: 10_000_000_000,
            end_ns: None,
            cursors: [None; 2],
            active: 0,
            lines: false,
            drawn: Drawn::default(),
        }
    }
}

impl Graph {
    /// The time window: its beginning and end.
    pub fn window(&self, now_ns: i64) -> (i64, i64) {
        let end = self.end_ns.unwrap_or(now_ns);
        (end.saturating_sub(self.span_ns), end)
    }

    /// The time in the middle of a screen column, if it is part of the curves.
    fn time_at(&self, column: u16) -> Option<i64> {
        let area = self.drawn.area;
        let place = column.checked_sub(area.x).filter(|place| *place < area.width)?;
        let share = (f64::from(place) + 0.5) / f64::from(area.width);
        Some(self.drawn.from_ns.saturating_add((share * self.span_ns as f64) as i64))
    }

    /// Ends the window at this time; at the newest, it continues to follow.
    fn end_at(&mut self, end_ns: i64) {
        self.end_ns = (end_ns < self.drawn.now_ns).then_some(end_ns);
    }

    fn pan(&mut self, by_ns: i64) {
        let end = self.drawn.from_ns.saturating_add(self.span_ns).saturating_add(by_ns);
        // Some of the past stays in sight.
        self.end_at(end.max(self.drawn.oldest_ns.saturating_add(self.span_ns / PAN)));
    }

    /// Changes the window's length while one time keeps its place; without one, the end does when following, otherwise the
    /// middle.
    fn zoom(&mut self, factor: f64, around_ns: Option<i64>) {
        let (from, span) = (self.drawn.from_ns, self.span_ns);
        let wanted = ((span as f64 * factor) as i64).clamp(LEAST_SPAN_NS, MOST_SPAN_NS);
        let around = around_ns.or_else(|| self.end_ns.map(|_| from.saturating_add(span / 2)));
        self.span_ns = wanted;
        if let Some(around) = around {
            let share = around.saturating_sub(from) as f64 / span as f64;
            let before = (share * wanted as f64) as i64;
            self.end_at(around.saturating_sub(before).saturating_add(wanted));
        }
    }

    /// Shows the whole time.
    fn show_all(&mut self) {
        let all = self.drawn.now_ns.saturating_sub(self.drawn.oldest_ns);
        self.span_ns = all.saturating_add(all / 50).clamp(LEAST_SPAN_NS, MOST_SPAN_NS);
        self.end_ns = None;
    }

    /// The cursor moved by keys, if it is in sight.
    fn cursor_in_sight(&self) -> Option<i64> {
        let (from, until) = (self.drawn.from_ns, self.drawn.from_ns.saturating_add(self.span_ns));
        self.cursors[self.active].filter(|cursor| (from..=until).contains(cursor))
    }

    /// Sets the first cursor, then the second, each in the middle; after that, switches the cursor that keys
    /// move.
    fn next_cursor(&mut self) {
        let middle = self.drawn.from_ns.saturating_add(self.span_ns / 2);
        match self.cursors {
            [None, _] => (self.cursors[0], self.active) = (Some(middle), 0),
            [_, None] => (self.cursors[1], self.active) = (Some(middle), 1),
            _ => self.active = 1 - self.active,
        }
    }

    /// Moves a cursor by columns; the window follows a cursor that leaves it.
    fn move_cursor(&mut self, cursor_ns: i64, columns: i64) {
        let column = self.span_ns / i64::from(self.drawn.area.width.max(1));
        let moved = cursor_ns.saturating_add(columns.saturating_mul(column.max(1)));
        self.cursors[self.active] = Some(moved);
        let (from, until) = (self.drawn.from_ns, self.drawn.from_ns.saturating_add(self.span_ns));
        if moved < from || moved > until {
            self.pan(columns.signum() * self.span_ns / PAN);
        }
    }

    /// Handles a key on the graph's page.
    pub fn key(&mut self, code: KeyCode) {
        let step = self.span_ns / PAN;
        let cursor = self.cursor_in_sight();
        match code {
            KeyCode::Char('+') | KeyCode::Up => self.zoom(0.5, cursor),
            KeyCode::Char('-') | KeyCode::Down => self.zoom(2.0, cursor),
            KeyCode::Left | KeyCode::Right => {
                let way = if code == KeyCode::Left { -1 } else { 1 };
                match cursor {
                    Some(cursor) => self.move_cursor(cursor, way),
                    None => self.pan(way * step),
                }
            }
            KeyCode::PageUp => self.pan(-self.span_ns / 2),
            KeyCode::PageDown => self.pan(self.span_ns / 2),
            KeyCode::Home => self.pan(self.drawn.oldest_ns.saturating_sub(self.drawn.from_ns)),
            KeyCode::End => self.end_ns = None,
            KeyCode::Char('a') => self.show_all(),
            KeyCode::Char('x') => self.next_cursor(),
            KeyCode::Char('s') => self.lines = !self.lines,
            KeyCode::Esc if self.cursors == [None; 2] => self.end_ns = None,
            KeyCode::Esc => (self.cursors, self.active) = ([None; 2], 0),
            _ => {}
        }
    }

    /// Handles the mouse on the graph: its buttons set a cursor each and drag it, the wheel zooms at the pointer, or pans with
    /// Shift.
    pub fn mouse(&mut self, event: MouseEvent) {
        let at = self.time_at(event.column);
        let step = self.span_ns / PAN;
        let shift = event.modifiers.contains(KeyModifiers::SHIFT);
        let is_in = self.drawn.area.contains((event.column, event.row).into());
        match event.kind {
            MouseEventKind::Down(button) | MouseEventKind::Drag(button) if is_in => {
                let cursor = match button {
                    MouseButton::Left => 0,
                    MouseButton::Right => 1,
                    MouseButton::Middle => return,
                };
                self.active = cursor;
                self.cursors[cursor] = at;
            }
            MouseEventKind::ScrollUp if shift => self.pan(-step),
            MouseEventKind::ScrollDown if shift => self.pan(step),
            MouseEventKind::ScrollLeft => self.pan(-step),
            MouseEventKind::ScrollRight => self.pan(step),
            // The time under the pointer stays where it is; at the newest, it continues to follow.
            MouseEventKind::ScrollUp => self.zoom(0.5, at),
            MouseEventKind::ScrollDown => self.zoom(2.0, at),
            _ => {}
        }
    }
}
