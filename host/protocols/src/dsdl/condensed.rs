//! Many definitions in one text: a line `=== PATH` before each, without what nobody needs who reads messages.

use std::fmt::Write as _;

use super::parse::{DsdlSource, constant};
use super::unit;

const MARK: &str = "=== ";

/// The definitions in one text, in the order of their paths: without empty lines, assertions, and comments but for units. This is how those that
/// are built in were made.
pub fn condensed(sources: &[DsdlSource]) -> String {
    let mut sources: Vec<_> = sources.iter().collect();
    sources.sort_by(|a, b| a.path.cmp(&b.path));
    let mut text = String::new();
    for source in sources {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{MARK}{}", source.path);
        for line in source.text.lines() {
            let (code, comment) = line.split_once('#').unwrap_or((line, ""));
            let code = code.split_whitespace().collect::<Vec<_>>().join(" ");
            if code.is_empty() || code.starts_with("@assert") || code == "@deprecated" {
                continue;
            }
            text.push_str(&code);
            let unit = if constant(&code).is_some() { "" } else { unit::of_comment(comment) };
            if !unit.is_empty() {
                let _ = write!(text, " # {unit}");
            }
            text.push('\n');
        }
    }
    text
}

/// The definitions of such a text; lines before the first are comments.
pub fn split(text: &str) -> impl Iterator<Item = DsdlSource> + '_ {
    let starts_file = |line: &str| line.strip_prefix(MARK).map(str::to_owned);
    let mut lines = text.lines().skip_while(move |line| starts_file(line).is_none()).peekable();
    std::iter::from_fn(move || {
        let path = starts_file(lines.next()?)?;
        let mut text = String::new();
        while let Some(line) = lines.next_if(|line| starts_file(line).is_none()) {
            text.push_str(line);
            text.push('\n');
        }
        Some(DsdlSource { path, text })
    })
}
