//! Handles the text of a DBC file before it is parsed: which line contains what.
//!
//! can-dbc's result has no positions, so the lines of messages and signals are found here. A
//! statement starts on a new line; a string may span several.

use std::borrow::Cow;
use std::collections::HashMap;
use std::ops::Range;

/// Statements that do not affect how frames are decoded.
const NEEDLESS: &[&str] = &[
    "VERSION",
    "NS_",
    "BS_",
    "BU_",
    "CM_",
    "BA_DEF_",
    "BA_DEF_DEF_",
    "BA_DEF_REL_",
    "BA_DEF_DEF_REL_",
    "BA_DEF_SGTYPE_",
    "BA_REL_",
    "BA_SGTYPE_",
    "BA_",
    "EV_",
    "EV_DATA_",
    "ENVVAR_DATA_",
    "BO_TX_BU_",
    "BU_SG_REL_",
    "BU_EV_REL_",
    "BU_BO_REL_",
    "CAT_",
    "CAT_DEF_",
    "FILTER",
    "SGTYPE_",
    "SGTYPE_VAL_",
    "SIGTYPE_VALTYPE_",
    "SIG_TYPE_REF_",
    "SIG_GROUP_",
    "SIG_TYPE_DEF_",
    "SIG_TYPE_",
    "VAL_TABLE_",
];

/// Statements that do.
const NEEDED: &[&str] = &["BO_", "SG_", "VAL_", "SIG_VALTYPE_", "SG_MUL_VAL_"];

/// The text with a receiver in each `SG_` that has none, which can-dbc's grammar requires and some tools do not write.
pub fn with_receivers(text: &str) -> Cow<'_, str> {
    let lacks_receiver = |line: &str| {
        let line = line.trim();
        line.starts_with("SG_ ") && line.len() > 4 && line.ends_with('"') && line.matches('"').count() == 2
    };
    if !text.lines().any(lacks_receiver) {
        return Cow::Borrowed(text);
    }
    let mut all = String::with_capacity(text.len() + 64);
    for line in text.split_inclusive('\n') {
        if lacks_receiver(line) {
            let end = line.trim_end();
            all.push_str(end);
            all.push_str(" Vector__XXX");
            all.push_str(&line[end.len()..]);
        } else {
            all.push_str(line);
        }
    }
    all.into()
}

/// A statement's place in the text.
#[derive(Debug)]
pub struct Statement {
    /// Its first line, from 1.
    pub line: u32,
    /// Its bytes, up to the next statement.
    pub range: Range<usize>,
    /// Its first word.
    pub keyword: String,
    /// `Message` or `Message.Signal` for definitions, otherwise the keyword and the words after it.
    pub symbol: String,
}

/// The positions of everything.
#[derive(Debug, Default)]
pub struct Index {
    /// In the order of the text.
    pub statements: Vec<Statement>,
    /// Identifier as written in the file, name and line of each `BO_`.
    pub messages: Vec<(u64, String, u32)>,
    /// Lines of signals, by their message's index in `messages` and their name.
    signals: HashMap<(usize, String), u32>,
    /// Lines of the first statement about a signal, by keyword, message identifier and name.
    references: HashMap<(String, String, String), u32>,
}

impl Index {
    /// Finds all statements.
    pub fn of(text: &str) -> Self {
        let mut index = Self::default();
        let mut in_string = false;
        let mut in_symbols = false;
        let mut offset = 0;
        for (number, line) in text.split_inclusive('\n').enumerate() {
            if !in_string {
                // The list after NS_ names keywords on separate, indented lines.
                in_symbols &= line.starts_with([' ', '\t', '\r', '\n']);
                if !in_symbols {
                    index.start_statement(line, number as u32 + 1, offset);
                }
                in_symbols |= line.trim_start().starts_with("NS_");
            }
            in_string = ends_in_string(line, in_string);
            offset += line.len();
            if let Some(statement) = index.statements.last_mut() {
                statement.range.end = offset;
            }
        }
        index
    }

    fn start_statement(&mut self, line: &str, number: u32, offset: usize) {
        let mut words = line.split(|c: char| c.is_ascii_whitespace() || c == ':').filter(|w| !w.is_empty());
        let Some(keyword) = words.next() else { return };
        if !NEEDED.contains(&keyword) && !NEEDLESS.contains(&keyword) {
            // An unknown keyword starts a statement if it looks like one.
            let looks_like = keyword.len() > 1
                && keyword.ends_with('_')
                && keyword.bytes().all(|byte| byte.is_ascii_uppercase() || byte == b'_');
            if !looks_like {
                return;
            }
        }
        let (first, second) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
        let symbol = match keyword {
            "BO_" => {
                if let Ok(id) = first.parse() {
                    self.messages.push((id, second.to_owned(), number));
                }
                second.to_owned()
            }
            "SG_" => {
                let message = self.messages.len().checked_sub(1);
                let message_name = message.map_or("", |message| self.messages[message].1.as_str());
                let symbol = format!("{message_name}.{first}");
                if let Some(message) = message {
                    self.signals.entry((message, first.to_owned())).or_insert(number);
                }
                symbol
            }
            _ => {
                if NEEDED.contains(&keyword) {
                    let reference = (keyword.to_owned(), first.to_owned(), second.to_owned());
                    self.references.entry(reference).or_insert(number);
                }
                [keyword, first, second].join(" ").trim_end().to_owned()
            }
        };
        let range = offset..offset;
        self.statements.push(Statement { line: number, range, keyword: keyword.to_owned(), symbol });
    }

    /// The line of the `message`th message; 0 if unknown.
    pub fn message_line(&self, message: usize) -> u32 {
        self.messages.get(message).map_or(0, |&(_, _, line)| line)
    }

    /// The line of a signal of the `message`th message; 0 if unknown.
    pub fn signal_line(&self, message: usize, name: &str) -> u32 {
        self.signals.get(&(message, name.to_owned())).copied().unwrap_or_default()
    }

    /// The index in [`Self::statements`] of the one that a line belongs to.
    pub fn place_at(&self, line: u32) -> Option<usize> {
        self.statements.partition_point(|statement| statement.line <= line).checked_sub(1)
    }

    /// The line of the first statement of that keyword about a signal; 0 if unknown.
    pub fn reference_line(&self, keyword: &str, id: u32, signal: &str) -> u32 {
        let reference = (keyword.to_owned(), id.to_string(), signal.to_owned());
        self.references.get(&reference).copied().unwrap_or_default()
    }
}

/// Whether a string is open at the line's end. `\"` inside one does not close it.
fn ends_in_string(line: &str, mut in_string: bool) -> bool {
    let mut bytes = line.bytes().peekable();
    while let Some(byte) = bytes.next() {
        match byte {
            b'\\' if in_string && bytes.peek() == Some(&b'"') => {
                bytes.next();
            }
            b'"' => in_string = !in_string,
            b'/' if !in_string && bytes.peek() == Some(&b'/') => break,
            _ => {}
        }
    }
    in_string
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "VERSION \"\"\nNS_ :\n\tCM_\n\tVAL_\n\nBU_: A\n\nBO_ 5 First: 8 A\n SG_ One : 0|8@1+ (1,0) [0|0] \"\" A\n\
                        CM_ BO_ 5 \"BO_ 6 \\\"No\\\"\nBO_ 7 Neither: 8 A\";\nBO_ 8 Last : 8 A\n SG_ One m0 : 0|8@1+ (1,0) [0|0] \"\" A\n";

    #[test]
    fn statements_are_found_and_strings_are_not() {
        let index = Index::of(TEXT);
        let found: Vec<_> = index.statements.iter().map(|s| (s.line, s.symbol.as_str())).collect();
        assert_eq!(
            found,
            [
                (1, "VERSION \"\""),
                (2, "NS_"),
                (6, "BU_ A"),
                (8, "First"),
                (9, "First.One"),
                (10, "CM_ BO_ 5"),
                (12, "Last"),
                (13, "Last.One")
            ]
        );
        assert_eq!(
            (index.message_line(1), index.signal_line(0, "One"), index.signal_line(1, "One")),
            (12, 9, 13)
        );
        assert_eq!(index.place_at(11), Some(5));
    }
}
