//! Handles keys and the mouse.

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers, MouseButton, MouseEvent, MouseEventKind};

use super::super::event_text::candump_line;
use super::super::model::{Model, SourceState};
use super::super::order::Order;
use super::super::plan::Plan;
use super::line::PromptKind;
use super::request::Request;
use super::scroll::first_row;
use super::state::{App, Direction, Flow, View};

/// The row where a page's own rows begin: its heading.
const BODY_ROW: u16 = 2;
/// Number of rows that one step of the wheel scrolls.
const WHEEL_ROWS: usize = 3;

impl App {
    /// Handles a key.
    pub fn key(&mut self, key: KeyEvent, model: &mut Model) -> Flow {
        // A message that promised it only ends with any key; a key pressed for that must do nothing else.
        let only_ends = std::mem::take(&mut self.any_key_continues) || self.search.is_some();
        self.message.clear();
        self.search = None;
        // Anyone who presses a key has read it.
        model.notice.clear();
        let key = match (key.code, key.modifiers) {
            // This is how Enter arrives when typed before the program took over the terminal, or when pasted.
            (KeyCode::Char('j'), KeyModifiers::CONTROL) => KeyEvent::from(KeyCode::Enter),
            _ => key,
        };
        if key.modifiers.contains(KeyModifiers::CONTROL) {
            return self.key_with_control(key);
        }
        // On a slow line, Escape and a key typed after it look the same as that key with Alt. Neither is any command's key.
        if key.modifiers.contains(KeyModifiers::ALT) {
            return Flow::GoOn;
        }
        if self.prompt.is_some() {
            self.prompt_key(key.code, model);
            return Flow::GoOn;
        }
        if only_ends && !matches!(key.code, KeyCode::Char('h')) {
            return Flow::GoOn;
        }
        if self.help {
            let page = 10;
            match key.code {
                KeyCode::Up => self.help_first = self.help_first.saturating_sub(1),
                KeyCode::Down => self.help_first += 1,
                KeyCode::PageUp => self.help_first = self.help_first.saturating_sub(page),
                KeyCode::PageDown => self.help_first += page,
                // It says that any key closes it: none does more.
                _ => self.help = false,
            }
            return Flow::GoOn;
        }
        match key.code {
            KeyCode::Char('q') => return Flow::Quit,
            KeyCode::Char('h' | '?') | KeyCode::F(1) => (self.help, self.help_first) = (true, 0),
            KeyCode::Char(digit @ '1'..='9') => self.show(View::ALL[digit as usize - '1' as usize]),
            KeyCode::Char('0') => self.open_vehicle(model),
            KeyCode::Tab => self.show(self.view.neighbour(true)),
            KeyCode::BackTab => self.show(self.view.neighbour(false)),
            // On every page, as its last line says.
            KeyCode::Char(' ') if matches!(model.source, SourceState::Playing(_)) => {
                self.toggle_playback(model);
            }
            KeyCode::Char(' ') if self.view == View::Send => self.toggle_sending(),
            KeyCode::Char(' ') if self.view == View::Scripts => self.toggle_script(model),
            KeyCode::Char(' ') if self.view == View::Obd => self.toggle_asking(model),
            KeyCode::Char(' ') => self.pause(model),
            KeyCode::Char('c') => self.clear(model),
            KeyCode::Char('t') => self.time_mode = self.time_mode.next(),
            KeyCode::Char('/') if self.can_search() => self.ask(PromptKind::Search, ""),
            KeyCode::Char('n') if self.can_search() => self.find(model, Direction::Back),
            KeyCode::Char('N') if self.can_search() => self.find(model, Direction::Forward),
            KeyCode::Char('f') => {
                let filters = model.history.filters().iter().map(ToString::to_string);
                let only_while = model.history.only_while().map(|condition| format!("if {condition}"));
                self.ask(PromptKind::Filter, &filters.chain(only_while).collect::<Vec<_>>().join(" "));
            }
            KeyCode::Char('r') if model.recording.is_some() => self.order(Order::StopRecording),
            KeyCode::Char('r') => self.ask(PromptKind::Record, ""),
            KeyCode::Char('b') => self.ask_bit_rate(model),
            KeyCode::Char('A') if self.plan.is_some() => self.order(Order::Autobaud),
            KeyCode::Char('A') => "a file has no bit rate to be found".clone_into(&mut self.message),
            KeyCode::Char('D') => {
                let address = self.plan.as_ref().map_or("virtual".to_owned(), Plan::name);
                self.ask(PromptKind::Device, &address);
            }
            KeyCode::Char('m') => self.toggle_mode(),
            KeyCode::Char(',') => self.order(Order::Slower),
            KeyCode::Char('.') => self.order(Order::Faster),
            KeyCode::Char('p') => self.toggle_playback(model),
            KeyCode::Char('[') => self.seek_by(-1, model),
            KeyCode::Char(']') => self.seek_by(1, model),
            KeyCode::Char('T') => self.ask(PromptKind::Time, ""),
            KeyCode::Char('B') => self.bookmark(model),
            KeyCode::Char('{') => self.go_to_bookmark(false, model),
            KeyCode::Char('}') => self.go_to_bookmark(true, model),
            KeyCode::Char('O') => self.ask(PromptKind::Open, ""),
            KeyCode::Char('w') => self.request = Some(Request::Next),
            KeyCode::Char('W') => self.request = Some(Request::Close),
            KeyCode::Char('R') => self.order(Order::Recover),
            KeyCode::Char('>') => self.order(Order::Step),
            KeyCode::Char('l') => self.order(Order::ToggleLoop),
            code => self.page_key(code, model),
        }
        Flow::GoOn
    }

    /// A key with Control, which must not act like the plain letter.
    fn key_with_control(&mut self, key: KeyEvent) -> Flow {
        match (key.code, &mut self.prompt) {
            (KeyCode::Char('c'), _) => return Flow::Quit,
            (KeyCode::Char('z'), _) => return Flow::Suspend,
            (KeyCode::Char('u'), Some(prompt)) if prompt.kind != PromptKind::Normal => prompt.line.clear(),
            _ => {}
        }
        Flow::GoOn
    }

    /// Keys that have a meaning only on this page.
    fn page_key(&mut self, code: KeyCode, model: &mut Model) {
        match (self.view, code) {
            (View::Trace, KeyCode::Char('y')) => self.copy(model),
            (View::Trace, KeyCode::Enter) => self.record_opened = !self.record_opened,
            (View::Trace, code) => self.scroll_trace(code, model),
            (View::Fixed, KeyCode::Enter) => self.open_row(),
            (View::Fixed, KeyCode::Char('s')) => self.sort = self.sort.next(),
            (View::Fixed, KeyCode::Char('S')) => self.reverse = !self.reverse,
            (View::Fixed, KeyCode::Char('g')) => self.grouped = !self.grouped,
            (View::Fixed, KeyCode::Char('H')) => self.heat = !self.heat,
            (View::Fixed, KeyCode::Char('#')) => self.each_seen(model, |seen| seen.table.notch()),
            (View::Fixed, KeyCode::Char('*')) => self.each_seen(model, |seen| seen.table.unnotch()),
            (View::Fixed, KeyCode::Char('z')) => {
                let begins = model.seen.table.compared_since_ns.is_none();
                self.each_seen(model, |seen| seen.table.compare_since(begins.then_some(seen.now_ns)));
            }
            (View::Fixed, KeyCode::Char('u')) => self.each_seen(model, |seen| seen.table.unhide()),
            (View::Fixed, KeyCode::Char(key @ ('x' | 'o'))) => self.mark_row(key == 'x', model),
            (View::Signals, KeyCode::Enter) => {
                if let Some(row) = self.signal_order.get(self.selected).copied().flatten() {
                    self.toggle_signal(row, model);
                }
            }
            (View::Signals, KeyCode::Char('s')) => self.signals.sort = self.signals.sort.next(),
            (View::Signals, KeyCode::Char('S')) => self.signals.reverse = !self.signals.reverse,
            (View::Signals, KeyCode::Char('g')) => self.signals.grouped = !self.signals.grouped,
            (View::Signals | View::Fixed, KeyCode::Char('F')) => {
                let text = self.signal_filter().text().to_owned();
                self.ask(PromptKind::Signals, &text);
            }
            (View::Graph, code) => self.graph.key(code),
            (View::Send, KeyCode::Enter) => self.send_once(),
            (View::Send, KeyCode::Char('a')) => self.ask(PromptKind::Send, ""),
            (View::Send, KeyCode::Char('e')) => self.edit_entry(),
            (View::Send, KeyCode::Char('d') | KeyCode::Delete) => self.delete_entry(),
            (View::Send, KeyCode::Char('g')) => self.toggle_group(),
            (View::Send, KeyCode::Char('x')) => self.ask(PromptKind::Export, ""),
            (View::Send, KeyCode::Char('i')) => self.ask(PromptKind::Import, ""),
            (View::Scripts, KeyCode::Char('a')) => self.ask(PromptKind::Script, ""),
            (View::Scripts, KeyCode::Char('e')) => self.edit_script(model),
            (View::Scripts, KeyCode::Char('d') | KeyCode::Delete) => self.remove_script(model),
            (View::Scripts, KeyCode::Char('K')) => self.ask_script_key(model),
            (View::Scripts, code) => self.scroll_scripts(code),
            (_, code) => self.scroll(code),
        }
    }

    /// Shows or hides the signals of the selected row below it in the fixed view.
    fn open_row(&mut self) {
        if let Some(key) = self.fixed_order.get(self.selected).copied()
            && !self.opened.remove(&key)
        {
            self.opened.insert(key);
        }
    }

    /// Hides the selected row of the fixed view, or gives it the next colour.
    fn mark_row(&mut self, hide: bool, model: &mut Model) {
        let Some((channel, id)) = self.fixed_order.get(self.selected).copied() else {
            return;
        };
        self.each_seen(model, |seen| {
            if let Some(row) = seen.table.row_mut(channel, id) {
                if hide {
                    row.hidden = true;
                } else {
                    row.mark = (row.mark + 1) % 7;
                }
            }
        });
    }

    /// Adds a signal to the graph, or removes it, both in what is shown and in what continues behind it.
    fn toggle_signal(&mut self, row: usize, model: &mut Model) {
        let Model { history, seen, .. } = model;
        for seen in std::iter::once(seen).chain(self.frozen.as_deref_mut()) {
            seen.signals.toggle(row, history.all());
        }
    }

    /// Sorts by the heading in this column; a second time in reverse.
    fn click_heading(&mut self, column: u16) {
        match self.view {
            View::Fixed => {
                let found = self.sort_columns.iter().find(|(columns, _)| columns.contains(&column));
                match found.map(|(_, column)| *column) {
                    Some(column) if self.sort == column => self.reverse = !self.reverse,
                    Some(column) => (self.sort, self.reverse) = (column, false),
                    None => {}
                }
            }
            View::Signals => {
                let headings = &self.signals.headings;
                let found = headings.iter().find(|(columns, _)| columns.contains(&column));
                if let Some(column) = found.map(|(_, column)| *column) {
                    self.signals.sort_by(column);
                }
            }
            _ => {}
        }
    }

    fn copy(&mut self, model: &Model) {
        let place = self.cursor.or(model.history.end().checked_sub(1));
        self.clipboard = place.and_then(|place| candump_line(&model.history.get(place)?));
        let said =
            if self.clipboard.is_some() { "copied" } else { "this is not a frame; nothing was copied" };
        said.clone_into(&mut self.message);
    }

    /// Handles the mouse.
    pub fn mouse(&mut self, event: MouseEvent, model: &mut Model) {
        let is_busy = self.prompt.is_some() || self.help;
        let is_on_page = event.row >= BODY_ROW;
        if self.view == View::Graph && is_on_page && !is_busy {
            return self.graph.mouse(event);
        }
        let code = match event.kind {
            MouseEventKind::ScrollUp => KeyCode::Up,
            MouseEventKind::ScrollDown => KeyCode::Down,
            MouseEventKind::Down(MouseButton::Left) => {
                if !is_busy {
                    self.click(event, model);
                }
                return;
            }
            _ => return,
        };
        if !is_busy {
            for _ in 0..WHEEL_ROWS {
                self.page_key(code, model);
            }
        }
    }

    fn click(&mut self, event: MouseEvent, model: &Model) {
        if event.row == 0 {
            let tab = self.tab_columns.iter().find(|(columns, _)| columns.contains(&event.column));
            match tab.map(|(_, view)| *view) {
                Some(View::Obd) => self.open_vehicle(model),
                Some(view) => self.show(view),
                None => {}
            }
            return;
        }
        if let Some(bar) = self.bar.filter(|bar| bar.contains((event.column, event.row).into())) {
            let share = f64::from(event.column - bar.x) / f64::from(bar.width.max(2) - 1);
            return self.seek_share(share, model);
        }
        if event.row == BODY_ROW {
            return self.click_heading(event.column);
        }
        // A page begins with a heading; that of the send list is below what is said.
        let is_list = matches!(self.view, View::Send | View::Scripts);
        let body_row = if is_list { self.rows_at } else { BODY_ROW + 1 };
        let Some(row) = event.row.checked_sub(body_row).map(usize::from).filter(|row| *row < self.page_rows)
        else {
            return;
        };
        match self.view {
            View::Fixed | View::Signals | View::Send | View::Scripts => {
                self.selected = first_row(self.selected, self.page_rows) + row;
            }
            View::Trace => {
                let top = self.bottom.saturating_sub(self.page_rows as u64).max(model.history.first());
                let place = top + row as u64;
                if place < self.bottom {
                    self.cursor = Some(place);
                }
            }
            View::Graph | View::Statistics | View::Record | View::Nodes | View::Obd => {}
        }
    }
}
