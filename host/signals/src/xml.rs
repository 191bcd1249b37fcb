//! What the readers of XML databases have in common.

use std::borrow::Cow;

use roxmltree::{Document, Node, ParsingOptions};

use super::fault::{DatabaseError, Fault, FaultKind};
use super::text_places::{Lines, check_entities};

/// A range of values with one text is expanded up to this many values.
pub const MOST_TEXTS: i64 = 4096;

/// The text of an XML file: UTF-8, UTF-16, or otherwise Windows' Western code page.
pub fn decode(bytes: &[u8]) -> Cow<'_, str> {
    super::dbc_text::decode(bytes).0
}

/// Parses XML, or says where the text is not XML. A document type is skipped: nothing is fetched, and nothing expanded without
/// bound.
pub fn parse<'a>(file: &str, text: &'a str) -> Result<Document<'a>, DatabaseError> {
    if text.trim().is_empty() {
        return Err(faulty(
            file,
            "the file is empty; is it the right one, and was it copied to its end?".to_owned(),
        ));
    }
    check_entities(text).map_err(|error| faulty(file, error.to_string()))?;
    let options = ParsingOptions { allow_dtd: true, ..ParsingOptions::default() };
    Document::parse_with_options(text, options).map_err(|error| {
        let (line, kind) = (error.pos().row, FaultKind::Syntax(error.to_string()));
        DatabaseError::Faulty {
            file: file.to_owned(),
            faults: vec![Fault { line, symbol: String::new(), kind }],
        }
    })
}

/// The error for a whole file.
pub fn faulty(file: &str, reason: String) -> DatabaseError {
    let fault = Fault { line: 0, symbol: String::new(), kind: FaultKind::Syntax(reason) };
    DatabaseError::Faulty { file: file.to_owned(), faults: vec![fault] }
}

/// The line on which an element begins.
pub fn line(lines: &Lines, node: Node) -> u32 {
    lines.line(node.range().start)
}

/// All text inside an element.
pub fn text(node: Node) -> String {
    node.descendants().filter(Node::is_text).filter_map(|node| node.text()).collect()
}

/// `12`, `-3`, `0x1F`, `0b11`; a float that is an integer, as some writers have it.
pub fn integer(text: &str) -> Option<i128> {
    let text = text.trim();
    let (sign, digits) = text.strip_prefix('-').map_or((1, text), |digits| (-1, digits));
    let lower = digits.to_ascii_lowercase();
    let magnitude = if let Some(hex) = lower.strip_prefix("0x") {
        i128::from_str_radix(hex, 16).ok()?
    } else if let Some(binary) = lower.strip_prefix("0b") {
        i128::from_str_radix(binary, 2).ok()?
    } else if let Ok(value) = lower.parse() {
        value
    } else {
        let value = lower.parse::<f64>().ok().filter(|value| value.fract() == 0.0 && value.abs() < 1e18)?;
        value as i128
    };
    Some(sign * magnitude)
}
