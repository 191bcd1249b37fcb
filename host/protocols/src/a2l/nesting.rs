//! How deep and how large an A2L is before the crate a2lfile reads it, which calls itself for each block in a block and makes a copy of a type
//! of A2ML wherever that is named: a small file could otherwise use up the stack, or all memory.

use rustc_hash::FxHashMap;

/// Blocks in blocks, and types in types: files of tools have about ten.
const DEEPEST: usize = 64;
/// What the types of A2ML come to with all that they name, in words. Those of tools come to some thousands.
const MOST_WORDS: u64 = 1_000_000;

/// A file has more blocks in blocks than are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooDeep;

/// The text without such a grammar of IF_DATA (A2ML) as cannot be read, which says nothing that is needed, and whether there was one.
///
/// # Errors
///
/// Blocks are in each other too deep.
pub fn bounded(text: String) -> Result<(String, bool), TooDeep> {
    let (mut depth, mut cut) = (0_usize, Vec::new());
    let mut scanner = Scanner { text: &text, at: 0 };
    let mut begins = None;
    while let Some((at, word)) = scanner.next() {
        match word {
            "/begin" => {
                depth += 1;
                if depth > DEEPEST {
                    return Err(TooDeep);
                }
                begins = Some(at);
                continue;
            }
            "/end" => depth = depth.saturating_sub(1),
            "A2ML" if let Some(begin) = begins => {
                let from = scanner.at;
                let end = end_of_grammar(&text, from);
                scanner.at = end;
                if !is_small(&text[from..end]) {
                    // With the two words at its end.
                    scanner.next();
                    scanner.next();
                    cut.push(begin..scanner.at);
                    depth = depth.saturating_sub(1);
                }
            }
            _ => {}
        }
        begins = None;
    }
    if cut.is_empty() {
        return Ok((text, false));
    }
    let (mut out, mut kept) = (String::with_capacity(text.len()), 0);
    for range in cut {
        out.push_str(&text[kept..range.start]);
        kept = range.end;
    }
    out.push_str(&text[kept..]);
    Ok((out, true))
}

/// The words of a text outside of its comments; a string is one.
struct Scanner<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Scanner<'a> {
    /// Up to where something is found that begins so, and behind it; or up to the end.
    fn pass(&mut self, what: &str) {
        self.at = self.text[self.at..].find(what).map_or(self.text.len(), |at| self.at + at + what.len());
    }

    /// The next word with its place.
    fn next(&mut self) -> Option<(usize, &'a str)> {
        loop {
            let rest = &self.text[self.at..];
            self.at += rest.len() - rest.trim_start().len();
            let rest = &self.text[self.at..];
            if rest.starts_with("/*") {
                self.at += 2;
                self.pass("*/");
            } else if rest.starts_with("//") {
                self.pass("\n");
            } else {
                break;
            }
        }
        let (from, rest) = (self.at, &self.text[self.at..]);
        let mut characters = rest.char_indices();
        let length = match characters.next()?.1 {
            '"' => string_length(rest),
            '/' => {
                let end = characters.find(|(_, character)| !character.is_ascii_alphabetic());
                end.map_or(rest.len(), |(end, _)| end)
            }
            '{' | '}' | '(' | ')' | '[' | ']' | ';' | ',' | '*' | '=' => 1,
            _ => rest.find(is_end_of_word).unwrap_or(rest.len()).max(1),
        };
        // A character of several bytes is a word of its own at least.
        let length = (length..=rest.len()).find(|length| rest.is_char_boundary(*length))?;
        self.at += length;
        Some((from, &rest[..length]))
    }
}

fn is_end_of_word(character: char) -> bool {
    character.is_whitespace() || "\"/{}()[];,*=".contains(character)
}

/// The bytes of a string with its quotation marks, of which one that is doubled, or behind a backslash, is part of it.
fn string_length(text: &str) -> usize {
    let bytes = text.as_bytes();
    let mut at = 1;
    while at < bytes.len() {
        at += match bytes[at..] {
            [b'\\', _, ..] | [b'"', b'"', ..] => 2,
            [b'"', ..] => return at + 1,
            _ => 1,
        };
    }
    bytes.len()
}

/// Where a grammar ends: at the next end of a block that is not in a comment.
fn end_of_grammar(text: &str, from: usize) -> usize {
    let mut at = from;
    while let Some(found) = text[at..].find('/') {
        at += found;
        let rest = &text[at..];
        let passed = match rest.as_bytes() {
            [b'/', b'/', ..] => rest.find('\n'),
            [b'/', b'*', ..] => rest[2..].find("*/").map(|end| end + 4),
            _ if rest.starts_with("/end") => return at,
            _ => Some(1),
        };
        match passed {
            Some(passed) => at += passed,
            None => break,
        }
    }
    text.len()
}

/// A type that is being read.
#[derive(Default)]
struct Open<'a> {
    key: Option<(&'a str, &'a str)>,
    words: u64,
    /// What the last member comes to, and whether it is letters, of which any number is one text.
    last: u64,
    is_text: bool,
}

/// Whether a grammar's types, with all that they name, are not too deep and not too many.
fn is_small(grammar: &str) -> bool {
    let mut known = FxHashMap::<(&str, &str), u64>::default();
    let mut open = vec![Open::default()];
    let (mut scanner, mut total) = (Scanner { text: grammar, at: 0 }, 0_u64);
    // A kind of type, and perhaps its name.
    let mut kind: Option<(&str, Option<&str>)> = None;
    let mut brackets = 0_usize;
    while let Some((_, word)) = scanner.next() {
        let Some(top) = open.last_mut() else { return false };
        let opens = matches!(word, "{" | "(");
        if !opens && let (Some((of, Some(name))), false) = (kind, is_name(word)) {
            // It is named here, and stands elsewhere.
            let size = known.get(&(of, name)).copied().unwrap_or(1);
            (top.words, top.last, top.is_text) = (top.words.saturating_add(size), size, false);
            total = total.saturating_add(size);
        }
        match word {
            "struct" | "taggedstruct" | "taggedunion" | "enum" => {
                kind = Some((word, None));
                continue;
            }
            "{" | "(" => {
                let key = kind.take().and_then(|(of, name)| Some((of, name?)));
                open.push(Open { key: key.filter(|_| word == "{"), ..Open::default() });
            }
            "}" | ")" => {
                let Some(Open { key, words, .. }) = open.pop() else { return false };
                let Some(outer) = open.last_mut() else { return false };
                (outer.words, outer.last, outer.is_text) = (outer.words.saturating_add(words), words, false);
                known.extend(key.map(|key| (key, words)));
            }
            "[" => brackets += 1,
            "]" => brackets = brackets.saturating_sub(1),
            _ if brackets > 0 => {
                let hex = word.strip_prefix("0x").map(|digits| u64::from_str_radix(digits, 16));
                let count = hex.unwrap_or_else(|| word.parse()).unwrap_or(u64::MAX);
                let more = if top.is_text { 0 } else { top.last.max(1).saturating_mul(count) };
                (top.words, top.last) = (top.words.saturating_add(more), more.max(1));
                total = total.saturating_add(more);
            }
            _ => {
                if let Some((_, name @ None)) = &mut kind
                    && is_name(word)
                {
                    *name = Some(word);
                    continue;
                }
                (top.words, top.last, top.is_text) = (top.words.saturating_add(1), 1, word == "char");
                total = total.saturating_add(1);
            }
        }
        kind = None;
        if total > MOST_WORDS || open.len() > DEEPEST {
            return false;
        }
    }
    true
}

/// Whether a word can be the name of a type.
fn is_name(word: &str) -> bool {
    word.starts_with(|first: char| first.is_alphabetic() || first == '_')
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_grammar(grammar: &str) -> String {
        format!(
            "/begin MODULE m \"\" /begin A2ML {grammar} /end A2ML /* /begin */ \"/begin \\\" /begin\" /end MODULE"
        )
    }

    fn is_cut(grammar: &str) -> bool {
        let text = with_grammar(grammar);
        let (left, is_cut) = bounded(text.clone()).unwrap();
        assert_eq!(left.contains("A2ML"), !is_cut);
        assert!(is_cut || left == text);
        assert!(left.starts_with("/begin MODULE m") && left.ends_with("/end MODULE"));
        is_cut
    }

    #[test]
    fn a_grammar_as_tools_write_it_stays() {
        let common = "struct Can { uchar; uint[4]; char[4096]; }; taggedstruct Common { (block \"EVENT\" struct { char[101]; uint; })*; \
                      \"CAN\" struct Can; };";
        assert!(!is_cut(&format!(
            "{common} block \"IF_DATA\" taggedunion if_data {{ \"XCP\" taggedstruct Common; }};"
        )));
        assert!(!is_cut("/* struct { */ enum { \"A\" = 1, \"B\" = 0x2 };"));
    }

    #[test]
    fn a_grammar_that_comes_to_too_much_is_left_out() {
        let twice = |at| format!("struct a{at} {{ struct a{0}; struct a{0}; }};", at - 1);
        let doubled = (1..40).map(twice).collect::<Vec<_>>().concat();
        assert!(is_cut(&format!("struct a0 {{ uchar; }}; {doubled}")), "each is twice the one before");
        assert!(is_cut("struct { taggedstruct { }[1000][1000][1000]; };"));
        assert!(is_cut("struct { uchar[4000000000]; };"));
        assert!(is_cut(&"struct { ".repeat(100_000)));
        assert!(is_cut(&"taggedstruct { (\"Y\" ".repeat(1000)));
    }

    #[test]
    fn blocks_in_blocks_end() {
        assert_eq!(bounded("/begin X ".repeat(DEEPEST + 1)), Err(TooDeep));
        let closed = "/begin X /end X ".repeat(1000);
        assert_eq!(bounded(closed.clone()), Ok((closed, false)));
        for odd in
            ["\"", "/*", "//", "/", "/begin A2ML", "/begin A2ML /*", "ü\u{1F600}/ü", "/begin\u{A0}A2ML {"]
        {
            let _ = bounded(odd.to_owned());
        }
    }
}
