//! Moves through a page's rows.

use ratatui::crossterm::event::KeyCode;

use super::super::model::Model;
use super::state::App;

/// The first row to show so that the selected one is on the page.
pub fn first_row(selected: usize, rows: usize) -> usize {
    selected.saturating_sub(rows.saturating_sub(1))
}

impl App {
    /// In a list: a position past its end is drawn as its end.
    pub(super) fn scroll(&mut self, code: KeyCode) {
        let page = self.page_rows.max(1);
        self.selected = match code {
            KeyCode::Up | KeyCode::Char('k') => self.selected.saturating_sub(1),
            KeyCode::Down | KeyCode::Char('j') => self.selected + 1,
            KeyCode::PageUp => self.selected.saturating_sub(page),
            KeyCode::PageDown => self.selected + page,
            KeyCode::Home => 0,
            KeyCode::End => usize::MAX / 2,
            _ => self.selected,
        };
    }

    /// In the trace, whose end keeps moving.
    pub(super) fn scroll_trace(&mut self, code: KeyCode, model: &Model) {
        let (first, Some(last)) = (model.history.first(), model.history.end().checked_sub(1)) else {
            return;
        };
        let page = self.page_rows.max(1) as u64;
        let cursor = self.cursor.unwrap_or(last);
        let wanted = match code {
            KeyCode::Up | KeyCode::Char('k') => cursor.saturating_sub(1),
            KeyCode::Down | KeyCode::Char('j') => cursor + 1,
            KeyCode::PageUp => cursor.saturating_sub(page),
            KeyCode::PageDown => cursor + page,
            KeyCode::Home => first,
            KeyCode::End | KeyCode::Esc => {
                self.cursor = None;
                self.frozen = None;
                return;
            }
            _ => return,
        };
        // Everything may be filtered out, in which case there is nothing to select.
        self.cursor = (first <= last).then(|| wanted.clamp(first, last));
    }
}
