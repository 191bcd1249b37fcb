//! A line of text being typed.

use ratatui::crossterm::event::KeyCode;

/// Text with a cursor.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Line {
    text: Vec<char>,
    place: usize,
    /// The whole text was suggested, and nothing was typed yet: the first character replaces it.
    suggested: bool,
}

impl Line {
    /// This text, with the cursor at its end.
    pub fn new(text: &str) -> Self {
        let text: Vec<char> = text.chars().collect();
        Self { place: text.len(), text, suggested: false }
    }

    /// This text as a suggestion: Enter takes it, a character replaces it, and moving the cursor makes it text to edit.
    pub fn suggested(text: &str) -> Self {
        Self { suggested: !text.is_empty(), ..Self::new(text) }
    }

    /// Whether the next character replaces the whole text.
    pub const fn is_suggested(&self) -> bool {
        self.suggested
    }

    /// The whole text.
    pub fn text(&self) -> String {
        self.text.iter().collect()
    }

    /// The text before the cursor, and the text after it.
    pub fn halves(&self) -> (String, String) {
        let (before, behind) = self.text.split_at(self.place);
        (before.iter().collect(), behind.iter().collect())
    }

    /// Replaces the text before the cursor.
    pub fn replace_before(&mut self, text: &str) {
        let behind = self.text.split_off(self.place);
        self.suggested = false;
        self.text = text.chars().collect();
        self.place = self.text.len();
        self.text.extend(behind);
    }

    /// Empties it.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Handles an editing key; others do nothing.
    pub fn key(&mut self, code: KeyCode) {
        let replaces = matches!(code, KeyCode::Char(_) | KeyCode::Backspace | KeyCode::Delete);
        if std::mem::take(&mut self.suggested) && replaces {
            self.clear();
        }
        match code {
            KeyCode::Char(character) => {
                self.text.insert(self.place, character);
                self.place += 1;
            }
            KeyCode::Backspace if self.place > 0 => {
                self.place -= 1;
                self.text.remove(self.place);
            }
            KeyCode::Delete if self.place < self.text.len() => {
                self.text.remove(self.place);
            }
            KeyCode::Left => self.place = self.place.saturating_sub(1),
            KeyCode::Right => self.place = (self.place + 1).min(self.text.len()),
            KeyCode::Home => self.place = 0,
            KeyCode::End => self.place = self.text.len(),
            _ => {}
        }
    }
}

/// The purpose of an input line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PromptKind {
    /// Text to search for in the trace.
    Search,
    /// Filters in candump's syntax.
    Filter,
    /// A file to record to.
    Record,
    /// A frame or message to send, with its period.
    Send,
    /// Bit rates.
    BitRate,
    /// A device.
    Device,
    /// Whether to take part in the bus.
    Normal,
    /// Which signals to show.
    Signals,
    /// A position in a file.
    Time,
    /// A trace or a database.
    Open,
    /// A file to write the send list to.
    Export,
    /// A script for the list.
    Script,
    /// A key for the scripts.
    ScriptKey,
    /// A file with entries for the send list.
    Import,
}

/// An input line.
#[derive(Clone, Debug)]
pub struct Prompt {
    /// Its purpose.
    pub kind: PromptKind,
    /// What was typed.
    pub line: Line,
    /// The entry of the send list that it edits.
    pub entry: Option<usize>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_edited_where_the_cursor_stands() {
        let mut line = Line::new("12ä#11");
        for code in [KeyCode::Left, KeyCode::Left, KeyCode::Left, KeyCode::Backspace, KeyCode::Char('3')] {
            line.key(code);
        }
        assert_eq!(line.halves(), ("123".to_owned(), "#11".to_owned()));
        line.key(KeyCode::Home);
        line.key(KeyCode::Backspace);
        line.key(KeyCode::Delete);
        line.key(KeyCode::End);
        line.key(KeyCode::Delete);
        line.key(KeyCode::Right);
        line.key(KeyCode::Char('!'));
        assert_eq!(line.text(), "23#11!");
        line.clear();
        assert_eq!(line, Line::default());
    }

    #[test]
    fn what_is_suggested_is_replaced_by_typing_and_kept_by_moving() {
        let after = |codes: &[KeyCode]| {
            let mut line = Line::suggested("1:500000");
            for code in codes {
                line.key(*code);
            }
            line.text()
        };
        assert_eq!(after(&[]), "1:500000");
        assert_eq!(after(&[KeyCode::Char('2'), KeyCode::Char('5')]), "25");
        assert_eq!(after(&[KeyCode::Backspace]), "");
        assert_eq!(after(&[KeyCode::Delete, KeyCode::Char('x')]), "x");
        assert_eq!(after(&[KeyCode::End, KeyCode::Char('1')]), "1:5000001");
        assert_eq!(after(&[KeyCode::Left, KeyCode::Backspace]), "1:50000");
    }
}
