//! Makes texts that come from outside (a device, a server, a file, a database) safe for a terminal: the one place that decides what is.

use std::borrow::Cow;

/// Whether a character moves the cursor, starts an escape sequence (C0, DEL and C1), ends a line or changes the writing direction: none of
/// that may come from somebody else.
pub fn is_harmful(character: char) -> bool {
    character.is_control()
        || matches!(
            character,
            '\u{061C}' | '\u{2028}' | '\u{2029}' | '\u{200E}' | '\u{200F}' | '\u{202A}'..='\u{202E}' | '\u{2066}'..='\u{2069}'
        )
}

/// The text on one line, with `\u{FFFD}` for characters that a terminal would interpret. Line ends and tabs
/// become spaces.
pub fn line(text: &str) -> Cow<'_, str> {
    if !text.contains(is_harmful) {
        return Cow::Borrowed(text);
    }
    let text = text.replace("\r\n", "\n");
    let harmless = |character| match character {
        '\n' | '\r' | '\t' => ' ',
        character if is_harmful(character) => '\u{FFFD}',
        character => character,
    };
    text.chars().map(harmless).collect::<String>().into()
}

/// Like [`line()`], but keeps the text's own lines, each ended by `\n`.
pub fn lines(text: &str) -> Cow<'_, str> {
    if !text.contains(is_harmful) {
        return Cow::Borrowed(text);
    }
    let text = text.replace("\r\n", "\n").replace('\r', "\n");
    text.split('\n').map(line).collect::<Vec<_>>().join("\n").into()
}

/// Cleans a string if necessary.
pub fn make(text: &mut String, clean: fn(&str) -> Cow<'_, str>) {
    if let Cow::Owned(cleaned) = clean(text) {
        *text = cleaned;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_that_a_terminal_obeys_is_left() {
        assert_eq!(line("\x1b[31mred\r\nnext\u{9b}2J\u{202e}"), "\u{FFFD}[31mred next\u{FFFD}2J\u{FFFD}");
        assert_eq!(lines("one\r\ntwo\x07\rthree"), "one\ntwo\u{FFFD}\nthree");
        assert!(matches!(line("°C µ 温度"), Cow::Borrowed(_)));
    }

    #[test]
    fn a_text_is_cleaned_where_it_stands_and_left_alone_if_it_is_clean() {
        for (text, clean) in [("a\x1b[0m\nb", "a\u{FFFD}[0m b"), ("plain", "plain")] {
            let mut text = text.to_owned();
            make(&mut text, line);
            assert_eq!(text, clean);
        }
    }
}
