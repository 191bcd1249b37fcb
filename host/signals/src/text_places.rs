//! The text of a file, apart from what it says: where its lines begin, and what the entities of XML come to.

use std::fmt;

/// How many bytes all references to a document's own entities may come to.
const MOST_EXPANDED_BYTES: usize = 64 << 20;
/// The entities that every document has; they come to one character.
const COMMON: [&str; 6] = ["#", "amp;", "lt;", "gt;", "apos;", "quot;"];

/// Where the lines of a text begin: looking for it anew for each of many elements would take longer the more there are.
#[derive(Clone, Debug, Default)]
pub struct Lines(Vec<u32>);

impl Lines {
    /// Of a text of less than 4 GiB.
    pub fn of(text: &str) -> Self {
        Self::of_bytes(text.as_bytes())
    }

    /// The same, of what may be no text.
    pub fn of_bytes(bytes: &[u8]) -> Self {
        Self((0..).zip(bytes).filter(|(_, byte)| **byte == b'\n').map(|(at, _)| at).collect())
    }

    /// The line of a byte, from 1.
    pub fn line(&self, byte: usize) -> u32 {
        self.0.partition_point(|end| (*end as usize) < byte) as u32 + 1
    }
}

/// A document's own entities come to more than is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooManyEntities;

impl fmt::Display for TooManyEntities {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("its entities are made of others, or come to more than 64 MiB; save it without entities of its own")
    }
}

/// Checks that a document does not expand to much more than it is. The parser limits entities in entities, but not how often one of them is
/// referred to.
///
/// # Errors
///
/// If it does.
pub fn check_entities(text: &str) -> Result<(), TooManyEntities> {
    let mut longest = None;
    for (at, declared) in text.match_indices("<!ENTITY") {
        let rest = &text[at + declared.len()..];
        let Some(from) = rest.find(['"', '\'']) else { break };
        let quote = char::from(rest.as_bytes()[from]);
        let value = rest[from + 1..].split(quote).next().unwrap_or_default();
        let refers = |reference: &str| !COMMON.iter().any(|common| reference.starts_with(common));
        if value.split('&').skip(1).any(refers) {
            return Err(TooManyEntities);
        }
        longest = longest.max(Some(value.len()));
    }
    let Some(longest) = longest else { return Ok(()) };
    let references = text.bytes().filter(|byte| *byte == b'&').count();
    if longest.saturating_mul(references) > MOST_EXPANDED_BYTES { Err(TooManyEntities) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_count_from_one() {
        let lines = Lines::of("a\nbc\n\nd");
        assert_eq!([0, 1, 2, 4, 5, 6, 99].map(|at| lines.line(at)), [1, 1, 2, 2, 3, 4, 4]);
    }

    /// Each of these took minutes when the text was counted anew for each message.
    #[test]
    fn large_files_have_their_lines_at_once() {
        let many = |one: &dyn Fn(usize) -> String| (0..30_000).map(one).collect::<String>();
        let kcd =
            many(&|at| format!("<Message id=\"{at}\" format=\"extended\" name=\"M{at}\" length=\"8\"/>\n"));
        let kcd = format!("<NetworkDefinition><Bus name=\"b\">\n{kcd}</Bus></NetworkDefinition>");
        let toml = many(&|at| format!("[[message]]\nname = \"M{at}\"\nid = {at}\nextended = true\n"));
        let triggering = |at: usize| {
            format!(
                "<CAN-FRAME-TRIGGERING><CAN-ADDRESSING-MODE>EXTENDED</CAN-ADDRESSING-MODE><IDENTIFIER>{at}</IDENTIFIER><FRAME-REF>/F</FRAME-REF>\
                 </CAN-FRAME-TRIGGERING>\n"
            )
        };
        let arxml = format!(
            "<AUTOSAR>\n{}<CAN-FRAME><SHORT-NAME>F</SHORT-NAME><FRAME-LENGTH>8</FRAME-LENGTH></CAN-FRAME></AUTOSAR>",
            many(&triggering)
        );
        let toml = format!("version = 1\n{toml}");
        for (name, text, line) in
            [("a.kcd", kcd, 30_001), ("a.toml", toml, 119_998), ("a.arxml", arxml, 30_001)]
        {
            let database = crate::parse(name, text.as_bytes()).unwrap();
            let last = database.messages.iter().map(|message| message.line).max();
            assert_eq!((database.messages.len(), last), (30_000, Some(line)), "{name}");
        }
        // Elements in elements, each with the names of all around it.
        let deep = format!(
            "<AUTOSAR>{}{}</AUTOSAR>",
            "<A><SHORT-NAME>n</SHORT-NAME>".repeat(20_000),
            "</A>".repeat(20_000)
        );
        let error = crate::parse("a.arxml", deep.as_bytes()).unwrap_err().to_string();
        assert!(error.contains("the paths of its elements come to more than"), "{error}");
    }

    #[test]
    fn entities_come_to_what_is_bounded() {
        let document = |entities: &str, body: &str| format!("<!DOCTYPE a [{entities}]><a>{body}</a>");
        assert_eq!(check_entities("<a>&amp;</a>"), Ok(()));
        assert_eq!(
            check_entities(&document("<!ENTITY b \"Motor &#38; &lt;\">", &"&b;".repeat(1000))),
            Ok(())
        );
        assert_eq!(
            check_entities(&document("<!ENTITY b \"x\"><!ENTITY c '&b;'>", "&c;")),
            Err(TooManyEntities)
        );
        let long = format!("<!ENTITY b \"{}\">", "x".repeat(100_000));
        assert_eq!(check_entities(&document(&long, &"&b;".repeat(10))), Ok(()));
        assert_eq!(check_entities(&document(&long, &"&b;".repeat(10_000))), Err(TooManyEntities));
        for odd in ["<!ENTITY", "<!ENTITY \"", "<!ENTITY '&", "&"] {
            let _ = check_entities(odd);
        }
    }
}
