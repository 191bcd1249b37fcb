//! Counts with their nouns.

use std::fmt::Display;

/// `1 frame`, `2 frames`, `at least 1 frame`; `1 entry`, `2 entries`; `1 loss`, `2 losses`. The noun is an English one whose plural is regular.
pub fn counted(count: impl Display, noun: &str) -> String {
    let count = count.to_string();
    if count == "1" || count.ends_with(" 1") {
        return format!("{count} {noun}");
    }
    match noun.strip_suffix('y') {
        Some(stem) if !stem.ends_with(['a', 'e', 'o', 'u']) => format!("{count} {stem}ies"),
        _ if noun.ends_with(['s', 'x']) || noun.ends_with("ch") || noun.ends_with("sh") => {
            format!("{count} {noun}es")
        }
        _ => format!("{count} {noun}s"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_singular_and_everything_else_plural() {
        assert_eq!(counted("at least 1", "frame"), "at least 1 frame");
        assert_eq!(counted("at least 11", "frame"), "at least 11 frames");
        let cases = [
            (0, "frame", "0 frames"),
            (1, "frame", "1 frame"),
            (2, "frame", "2 frames"),
            (11, "entry", "11 entries"),
            (1, "entry", "1 entry"),
            (3, "loss", "3 losses"),
            (2, "stretch", "2 stretches"),
            (2, "delay", "2 delays"),
            (2, "more place", "2 more places"),
        ];
        for (count, noun, text) in cases {
            assert_eq!(counted(count, noun), text);
        }
    }
}
