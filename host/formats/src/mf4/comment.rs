//! What a program or a logger writes about a measurement, in the comments of a file's head: device, session, author. They are XML.

use std::collections::BTreeMap;

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::blocks::Block;

/// Properties of a measurement by name, such as `author`; of a group of them, `Device Information.serial number`.
pub(crate) type Properties = BTreeMap<String, String>;

/// The property of our files with the channels' bit rates.
pub(super) const BIT_RATES: &str = "cantap.bit-rates";

/// More than these are not kept: the comment may come from anyone.
const MOST_PROPERTIES: usize = 1_000;
/// A longer name is none: each property inside a group has the group's name in front of its own.
const MOST_NAME_BYTES: usize = 256;
/// Groups inside groups; deeper ones are named by the outer ones alone.
const MOST_DEPTH: usize = 16;
/// Elements of the standard (ASAM MDF 4.2, comments of the head and of the history) that are properties by themselves.
const OWN_ELEMENTS: [&str; 6] =
    ["time_source", "tool_id", "tool_vendor", "tool_version", "user_name", "comment"];

/// The properties in the head's own comment, and in that of the program that wrote the file.
pub(super) fn properties(file: &mut Whole, header: &Block) -> Result<Properties, Fault> {
    const FIRST_HISTORY: usize = 1;
    const HISTORY_COMMENT: usize = 1;
    const HEAD_COMMENT: usize = 5;
    let mut found = Properties::new();
    collect(&file.text(header.link(HEAD_COMMENT))?, &mut found);
    let first = header.link(FIRST_HISTORY);
    if first != 0 {
        let history = file.block(first, *b"##FH")?;
        let mut by = Properties::new();
        collect(&file.text(history.link(HISTORY_COMMENT))?, &mut by);
        by.retain(|name, _| OWN_ELEMENTS.contains(&name.as_str()) && name != "comment");
        by.extend(found);
        found = by;
    }
    Ok(found)
}

/// The properties in a comment. What is not XML is a comment as a whole.
fn collect(text: &str, found: &mut Properties) {
    if !text.trim_start().starts_with('<') {
        insert(found, "comment", text);
        return;
    }
    // The names of open elements; an empty one names nothing.
    let mut path: Vec<(String, String)> = Vec::new();
    let mut rest = text;
    while let Some((before, tag)) = rest.split_once('<') {
        if let Some(after) = tag.strip_prefix("!--") {
            rest = after.split_once("-->").map_or("", |(_, after)| after);
            continue;
        }
        let Some((tag, after)) = tag.split_once('>') else { return };
        rest = after;
        let tag = tag.trim();
        if let Some(element) = tag.strip_prefix('/') {
            let element = local(element.trim());
            if path.last().is_some_and(|(open, _)| open == element) {
                let is_property = element == "e" || element == "TX" || OWN_ELEMENTS.contains(&element);
                let names: Vec<_> =
                    path.iter().map(|(_, name)| name.as_str()).filter(|name| !name.is_empty()).collect();
                if is_property && !names.is_empty() {
                    insert(found, &names.join("."), &plain(before));
                }
                path.pop();
            }
        } else if !tag.ends_with('/') && !tag.starts_with(['?', '!']) && path.len() < MOST_DEPTH {
            let element = local(tag.split_whitespace().next().unwrap_or_default()).to_owned();
            let name = match element.as_str() {
                "e" | "tree" | "list" | "elist" => attribute(tag, "name").unwrap_or_default(),
                "TX" => "comment".to_owned(),
                own if OWN_ELEMENTS.contains(&own) => own.to_owned(),
                _ => String::new(),
            };
            path.push((element, name));
        }
    }
}

/// The name of an element without its namespace.
fn local(element: &str) -> &str {
    element.rsplit(':').next().unwrap_or(element)
}

fn insert(found: &mut Properties, name: &str, value: &str) {
    let value = value.trim();
    if !value.is_empty() && found.len() < MOST_PROPERTIES {
        found.insert(name.to_owned(), value.to_owned());
    }
}

/// An attribute's value, in quotes of either kind.
fn attribute(tag: &str, name: &str) -> Option<String> {
    let mut rest = tag;
    loop {
        let (before, after) = rest.split_once('=')?;
        let after = after.trim_start();
        let quote = after.chars().next().filter(|quote| matches!(quote, '"' | '\''))?;
        let (value, next) = after[1..].split_once(quote)?;
        if before.split_whitespace().last() == Some(name) {
            return Some(plain(value)).filter(|value| value.len() <= MOST_NAME_BYTES);
        }
        rest = next;
    }
}

/// A text without its escapes.
fn plain(text: &str) -> String {
    let text = text.replace("&lt;", "<").replace("&gt;", ">").replace("&quot;", "\"").replace("&apos;", "'");
    text.replace("&amp;", "&")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(text: &str) -> Vec<(String, String)> {
        let mut found = Properties::new();
        collect(text, &mut found);
        found.into_iter().collect()
    }

    fn pairs(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
        pairs.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
    }

    /// As a logger writes them: groups of properties of the device and of the session.
    #[test]
    fn properties_have_the_names_of_their_groups() {
        let text = "<HDcomment xmlns='http://www.asam.net/mdf/v4'><TX>Winter &amp; snow</TX><common_properties>\
                    <tree name=\"Device Information\"><e name=\"serial number\" type=\"string\" ro=\"true\">3BA19CDF</e>\
                    <tree name='Storage'><e name=\"total\">32</e></tree></tree>\
                    <e name=\"author\">A. Driver</e><e name='empty'/></common_properties><!-- <e name=\"no\">x</e> --></HDcomment>";
        assert_eq!(
            found(text),
            pairs(&[
                ("Device Information.Storage.total", "32"),
                ("Device Information.serial number", "3BA19CDF"),
                ("author", "A. Driver"),
                ("comment", "Winter & snow"),
            ])
        );
    }

    #[test]
    fn a_comment_that_is_no_xml_is_one_text() {
        assert_eq!(found(" just a note "), pairs(&[("comment", "just a note")]));
        assert_eq!(found(""), []);
    }

    /// Anything that is cut or wrongly nested gives less, and never more than was written.
    #[test]
    fn damaged_comments_end_early() {
        let whole = "<a><common_properties><e name=\"x\">1</e></common_properties></a>";
        for end in 0..whole.len() {
            let there = found(&whole[..end]);
            assert!(there.is_empty() || there == pairs(&[("x", "1")]), "{end}: {there:?}");
        }
        assert_eq!(found("<e name=>1</e><e name=\"y\">2</f>"), []);
        assert_eq!(found(&"<tree name=\"t\">".repeat(100_000)), []);
        let one = |at| format!("<e name=\"n{at}\">{at}</e>");
        let many: String = (0..5_000).map(one).collect();
        assert_eq!(found(&many).len(), MOST_PROPERTIES);
        let long = format!("<tree name='{}'>{many}</tree>", "n".repeat(1 << 20));
        assert!(found(&long).iter().all(|(name, _)| name.len() < 10));
    }
}
