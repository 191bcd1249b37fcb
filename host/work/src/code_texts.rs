//! What trouble codes mean, by a table of the user's: makers' texts are nobody's to give away.

use std::collections::BTreeMap;

use cantap_trace::clean;

/// Texts by trouble code.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CodeTexts {
    texts: BTreeMap<String, String>,
}

/// A line that has no code or no text.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line} is no trouble code with its text, as P0133,\"O2 sensor slow response\"")]
pub struct CodeTextsError {
    /// From 1.
    pub line: usize,
}

impl CodeTexts {
    /// Reads a table: code, then a comma, semicolon or tab, then its text. Empty lines and those that begin with `#` are left out, and the first
    /// may be a heading.
    ///
    /// # Errors
    ///
    /// The first other line.
    pub fn read(table: &str) -> Result<Self, CodeTextsError> {
        let mut texts = BTreeMap::new();
        let lines = table.trim_start_matches('\u{FEFF}').lines().map(str::trim);
        let lines = (1..).zip(lines).filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
        for (number, (line, row)) in lines.enumerate() {
            let Some((code, text)) = row.split_once([',', ';', '\t']) else {
                return Err(CodeTextsError { line });
            };
            let code = code.trim().trim_matches('"').to_ascii_uppercase();
            let text = text.trim();
            let text = text.strip_prefix('"').and_then(|text| text.strip_suffix('"')).unwrap_or(text);
            match is_code(&code) {
                true if !text.is_empty() => {
                    let text = clean::line(&text.replace("\"\"", "\"")).into_owned();
                    texts.insert(code, text);
                }
                false if number == 0 => {}
                _ => return Err(CodeTextsError { line }),
            }
        }
        Ok(Self { texts })
    }

    /// The text of a code as `P0133` or, with its type of failure, `P0133-11`; without one for this type, that of the code.
    pub fn get(&self, code: &str) -> Option<&str> {
        let whole = self.texts.get(code);
        whole.or_else(|| self.texts.get(code.split_once('-')?.0)).map(String::as_str)
    }
}

/// A letter of P, C, B and U, four digits of which the first is up to 3, and the type of failure.
fn is_code(code: &str) -> bool {
    let (code, kind) = code.split_once('-').map_or((code, None), |(code, kind)| (code, Some(kind)));
    let is_hex =
        |text: &str, digits| text.len() == digits && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    let Some((letter, rest)) = code.split_at_checked(1) else { return false };
    "PCBU".contains(letter)
        && is_hex(rest, 4)
        && rest.as_bytes()[0] <= b'3'
        && kind.is_none_or(|kind| is_hex(kind, 2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_have_the_texts_of_the_table() {
        let table = "\u{FEFF}Code;Text\n# Comment\np0133;O2 sensor, slow\nP0133-11,\"Short \"\"to\"\" ground\"\nC0155\tBrake\n";
        let texts = CodeTexts::read(table).unwrap();
        let found = ["P0133", "P0133-11", "P0133-12", "C0155", "P0001"].map(|code| texts.get(code));
        assert_eq!(
            found,
            [
                Some("O2 sensor, slow"),
                Some("Short \"to\" ground"),
                Some("O2 sensor, slow"),
                Some("Brake"),
                None
            ]
        );
    }

    #[test]
    fn a_line_that_is_no_code_is_named() {
        for (table, line) in [
            ("P0133,a\nP9133,b", 2),
            ("code,text\nP0133", 2),
            ("P0133,a\n\nP0134,", 3),
            ("P0133,a\nX0134,b", 2),
            ("P0133,a\nP0134-1,b", 2),
        ] {
            assert_eq!(CodeTexts::read(table), Err(CodeTextsError { line }), "{table}");
        }
    }

    /// What is printed must not reach the terminal's own commands.
    #[test]
    fn texts_are_cleaned() {
        let texts = CodeTexts::read("P0133,a\u{1B}[2Jb").unwrap();
        assert!(!texts.get("P0133").unwrap().contains('\u{1B}'));
    }
}
