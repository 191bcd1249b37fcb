//! Databases from KCD files, Kayak's XML.
//!
//! For big-endian signals, a bit offset counts from the highest bit of the first byte. The file does not say which of its buses a
//! channel is.

use roxmltree::Node;

use super::fault::{DatabaseError, Fault, FaultKind};
use super::layout::{ByteOrder, wire_position};
use super::model::{Database, Message, Multiplexed, Signal, ValueKind, ValueTable};
use super::text_places::Lines;
use super::unflagged::Unflagged;
use super::{buses, validate, xml};

/// Parses a KCD file's content, all of its buses; `file` is its name for messages to the user.
pub fn parse(file: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    parse_bus(file, bytes, None)
}

/// Like [`parse`], but only the bus of this name.
pub fn parse_bus(file: &str, bytes: &[u8], bus: Option<&str>) -> Result<Database, DatabaseError> {
    let text = xml::decode(bytes);
    let document = xml::parse(file, &text)?;
    let lines = Lines::of(&text);
    let root = document.root_element();
    if root.tag_name().name() != "NetworkDefinition" {
        let reason =
            format!("its element is <{}>; a KCD file's is <NetworkDefinition>", root.tag_name().name());
        return Err(xml::faulty(file, reason));
    }
    let (mut faults, mut unflagged) = (Vec::new(), Unflagged::default());
    let nodes: Vec<_> = root.children().filter(|node| node.has_tag_name_of("Bus")).collect();
    let name = |node: &Node| node.attribute("name").unwrap_or_default().to_owned();
    let buses = buses::chosen(file, nodes.iter().map(name).collect(), bus)?;
    let mut messages = Vec::new();
    let mut ids = Vec::new();
    for (at, node) in nodes.iter().filter(|node| buses.contains(&name(node))).enumerate() {
        for node in node.children().filter(|node| node.has_tag_name_of("Message")) {
            let message = message(&lines, node, &mut unflagged, &mut faults);
            ids.extend(message.iter().map(|message| (message.id, at)));
            messages.extend(message);
        }
    }
    faults.extend(unflagged.warning());
    faults.extend(buses::warning(&buses, ids));
    let database = validate::finish(file, messages, faults)?;
    Ok(Database { buses, ..database })
}

/// Elements by local name: writers treat the namespace differently.
trait Local {
    fn has_tag_name_of(&self, name: &str) -> bool;
}

impl Local for Node<'_, '_> {
    fn has_tag_name_of(&self, name: &str) -> bool {
        self.is_element() && self.tag_name().name() == name
    }
}

fn child<'a, 'b>(node: Node<'a, 'b>, name: &str) -> Option<Node<'a, 'b>> {
    node.children().find(|child| child.has_tag_name_of(name))
}

fn notes(node: Node) -> String {
    child(node, "Notes").map(|notes| xml::text(notes).trim().to_owned()).unwrap_or_default()
}

fn message(lines: &Lines, node: Node, unflagged: &mut Unflagged, faults: &mut Vec<Fault>) -> Option<Message> {
    let line = xml::line(lines, node);
    let name = node.attribute("name").unwrap_or_default().to_owned();
    let mut fault = |kind| faults.push(Fault { line, symbol: name.clone(), kind });
    let written = node.attribute("id").unwrap_or_default();
    let Some(number) = xml::integer(written) else {
        fault(FaultKind::Syntax(format!("the identifier {written:?} is not a number")));
        return None;
    };
    let extended = node.attribute("format") == Some("extended");
    let raw = u32::try_from(number).ok();
    let Some(id) = raw.and_then(|raw| unflagged.id(raw, extended, &name, line)) else {
        fault(FaultKind::Id(number as u64));
        return None;
    };
    let mut signals = Vec::new();
    for part in node.children().filter(Node::is_element) {
        let result = match part.tag_name().name() {
            "Signal" => signal(lines, part).map(|signal| signals.push(signal)),
            "Multiplex" => multiplex(lines, part, &mut signals),
            _ => Ok(()),
        };
        if let Err(kind) = result {
            let symbol = format!("{name}.{}", part.attribute("name").unwrap_or_default());
            let is_usable = kind.is_warning();
            faults.push(Fault { line: xml::line(lines, part), symbol, kind });
            if !is_usable {
                return None;
            }
        }
    }
    let length = match node.attribute("length") {
        None | Some("auto") => u64::from(signals.iter().map(Signal::bytes_needed).max().unwrap_or(0)),
        Some(length) => length.parse().unwrap_or(u64::MAX),
    };
    let Some(length) = u16::try_from(length).ok().filter(|&length| length <= validate::MAX_BYTES) else {
        faults.push(Fault { line, symbol: name, kind: FaultKind::MessageLength(length) });
        return None;
    };
    let cycle_ms =
        node.attribute("interval").and_then(|interval| interval.parse().ok()).filter(|&cycle| cycle > 0);
    let (description, container) = (notes(node), None);
    Some(Message { id, name, description, length, cycle_ms, j1939: false, container, signals, line })
}

/// A multiplexer and the signals of its groups.
fn multiplex(lines: &Lines, node: Node, signals: &mut Vec<Signal>) -> Result<(), FaultKind> {
    let switch = signals.len();
    signals.push(Signal { is_switch: true, ..signal(lines, node)? });
    for group in node.children().filter(|node| node.has_tag_name_of("MuxGroup")) {
        let written = group.attribute("count").unwrap_or_default();
        let value = xml::integer(written).and_then(|value| u64::try_from(value).ok());
        let value = value
            .ok_or_else(|| FaultKind::Syntax(format!("the group's count {written:?} is not a number")))?;
        for part in group.children().filter(|node| node.has_tag_name_of("Signal")) {
            let multiplexed = Some(Multiplexed { switch, values: vec![value..=value] });
            signals.push(Signal { multiplexed, ..signal(lines, part)? });
        }
    }
    Ok(())
}

fn signal(lines: &Lines, node: Node) -> Result<Signal, FaultKind> {
    let number = |node: Node, name: &str, default: f64| match node.attribute(name) {
        None => Ok(default),
        Some(text) => text
            .trim()
            .parse::<f64>()
            .map_err(|_| FaultKind::Syntax(format!("{name} = {text:?} is not a number"))),
    };
    let name = node.attribute("name").unwrap_or_default();
    let offset = number(node, "offset", 0.0)? as u64;
    let length = match number(node, "length", 1.0)? as u64 {
        0 => return Err(FaultKind::NoBits),
        length @ 1..=64 => length as u16,
        length => return Err(FaultKind::TooManyBits(length)),
    };
    let order = if node.attribute("endianess") == Some("big") { ByteOrder::Big } else { ByteOrder::Little };
    let offset = u16::try_from(offset).ok().filter(|&offset| offset < validate::MAX_BYTES * 8);
    let offset = offset.ok_or(FaultKind::Start(number(node, "offset", 0.0)? as u64))?;
    let start = if order == ByteOrder::Big { wire_position(offset.into()) as u16 } else { offset };
    let mut signal = Signal {
        description: notes(node),
        order,
        line: xml::line(lines, node),
        ..Signal::new(name, start, length)
    };
    if let Some(value) = child(node, "Value") {
        signal.kind = match (value.attribute("type"), length) {
            (Some("signed"), _) => ValueKind::Signed,
            (Some("single" | "double"), 16) => ValueKind::Half,
            (Some("single"), _) | (Some("double"), 32) => ValueKind::Single,
            (Some("double"), _) => ValueKind::Double,
            _ => ValueKind::Unsigned,
        };
        signal.factor = number(value, "slope", 1.0)?;
        signal.offset = number(value, "intercept", 0.0)?;
        let limit = |name| value.attribute(name).map(|_| number(value, name, 0.0)).transpose();
        (signal.min, signal.max) = (limit("min")?, limit("max")?);
        value.attribute("unit").unwrap_or_default().clone_into(&mut signal.unit);
    }
    let labels = child(node, "LabelSet").into_iter().flat_map(|set| set.children().filter(Node::is_element));
    let mut texts = Vec::new();
    for label in labels {
        let name = label.attribute("name").unwrap_or_default();
        let value = |name: &str| {
            label.attribute(name).and_then(xml::integer).and_then(|value| i64::try_from(value).ok())
        };
        match (label.tag_name().name(), value("value"), value("from"), value("to")) {
            ("Label", Some(value), ..) => texts.push((value, name.to_owned())),
            ("LabelGroup", _, Some(from), Some(to)) if from <= to && to - from < xml::MOST_TEXTS => {
                texts.extend((from..=to).map(|value| (value, name.to_owned())));
            }
            _ => {}
        }
    }
    signal.values = ValueTable::new(texts);
    Ok(signal)
}
