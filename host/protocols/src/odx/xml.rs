//! What all readers of ODX elements need.

use cantap_trace::clean;
use roxmltree::Node;

/// The child elements of this name.
pub fn children<'a, 'i>(node: Node<'a, 'i>, name: &'static str) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(move |child| child.is_element() && child.tag_name().name() == name)
}

/// The first child element of this name.
pub fn child<'a, 'i>(node: Node<'a, 'i>, name: &'static str) -> Option<Node<'a, 'i>> {
    children(node, name).next()
}

/// The child elements of this name in a group, as DATA-OBJECT-PROP in DATA-OBJECT-PROPS.
pub fn grouped<'a, 'i>(
    node: Node<'a, 'i>,
    group: &'static str,
    name: &'static str,
) -> impl Iterator<Item = Node<'a, 'i>> {
    children(node, group).flat_map(move |group| children(group, name))
}

/// The text of a child element, made safe for a terminal, without spaces around it.
pub fn text(node: Node<'_, '_>, name: &'static str) -> Option<std::sync::Arc<str>> {
    child(node, name).map(content)
}

/// The text of an element, as [`text`].
pub fn content(node: Node<'_, '_>) -> std::sync::Arc<str> {
    let text: String = node.descendants().filter(Node::is_text).filter_map(|node| node.text()).collect();
    clean::line(text.trim()).into()
}

/// The short name of an element; empty without one.
pub fn short_name(node: Node<'_, '_>) -> std::sync::Arc<str> {
    text(node, "SHORT-NAME").unwrap_or_default()
}

/// An attribute that has a prefix or none, as `xsi:type`.
pub fn attribute<'a>(node: Node<'a, '_>, name: &str) -> Option<&'a str> {
    node.attributes().find(|attribute| attribute.name() == name).map(|attribute| attribute.value())
}

/// The number in a child element.
pub fn number(node: Node<'_, '_>, name: &'static str) -> Option<u32> {
    integer(&text(node, name)?).and_then(|number| u32::try_from(number).ok())
}

/// An integer in decimal, or in hexadecimal with 0x.
pub fn integer(text: &str) -> Option<i128> {
    let text = text.trim();
    match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(digits) => u64::from_str_radix(digits, 16).ok().map(i128::from),
        None => text.parse().ok(),
    }
}

/// Bytes in hexadecimal.
pub fn bytes(text: &str) -> Option<Vec<u8>> {
    let text = text.trim();
    (text.is_ascii() && text.len().is_multiple_of(2))
        .then(|| {
            (0..text.len()).step_by(2).map(|at| u8::from_str_radix(&text[at..at + 2], 16).ok()).collect()
        })
        .flatten()
}
