//! Databases from ARXML files, AUTOSAR's system descriptions of version 3 and 4.
//!
//! A frame's identifier is where a CAN channel sends it, its signals are in the PDUs mapped into it, and how their bits become values is in yet
//! other places, all named by paths. Of a secured PDU, the payload is read and what follows it: freshness value and authenticator.

mod containers;

use std::collections::{HashMap, HashSet};
use std::rc::Rc;

use cantap_trace::counted;
use roxmltree::{Document, Node};

use super::container::Container;
use super::fault::{DatabaseError, Fault, FaultKind};
use super::layout::{self, ByteOrder};
use super::model::{Database, Message, Multiplexed, Signal, ValueKind, ValueTable};
use super::text_places::Lines;
use super::unflagged::Unflagged;
use super::{buses, validate, xml};

/// Parses an ARXML file's content, all of its buses (CAN clusters); `file` is its name for messages to the user.
pub fn parse(file: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    parse_bus(file, bytes, None)
}

/// Like [`parse`], but only the bus of this name.
pub fn parse_bus(file: &str, bytes: &[u8], bus: Option<&str>) -> Result<Database, DatabaseError> {
    let text = xml::decode(bytes);
    let document = xml::parse(file, &text)?;
    let root = document.root_element();
    if root.tag_name().name() != "AUTOSAR" {
        let reason = format!("its element is <{}>; an ARXML file's is <AUTOSAR>", root.tag_name().name());
        return Err(xml::faulty(file, reason));
    }
    let (by_path, faults, unflagged) = (HashMap::new(), Vec::new(), Unflagged::default());
    let mut reader = Reader { document: &document, lines: Lines::of(&text), by_path, faults, unflagged };
    reader.index(root).map_err(|reason| xml::faulty(file, reason.to_owned()))?;
    let triggerings = root.descendants().filter(|node| node.tag_name().name() == "CAN-FRAME-TRIGGERING");
    let triggerings: Vec<_> = triggerings.map(|node| (node, bus_of(node))).collect();
    let mut names: Vec<String> = Vec::new();
    for (_, name) in &triggerings {
        if !name.is_empty() && !names.contains(name) {
            names.push(name.clone());
        }
    }
    let buses = buses::chosen(file, names, bus)?;
    let mut seen = HashSet::new();
    let mut messages = Vec::new();
    let mut ids = Vec::new();
    for (triggering, name) in triggerings {
        let at = buses.iter().position(|bus| *bus == name);
        if at.is_none() && bus.is_some() {
            continue;
        }
        let Some(message) = reader.message(triggering) else { continue };
        // A frame sent by several channels is one message.
        if seen.insert((message.id, message.name.clone())) {
            ids.extend(at.map(|at| (message.id, at)));
            messages.push(message);
        }
    }
    reader.faults.extend(reader.unflagged.warning());
    reader.faults.extend(buses::warning(&buses, ids));
    if messages.is_empty() && reader.faults.is_empty() {
        let reason = "no CAN frame is in it: there is no CAN-FRAME-TRIGGERING".to_owned();
        return Err(xml::faulty(file, reason));
    }
    let database = validate::finish(file, messages, reader.faults)?;
    Ok(Database { buses, ..database })
}

/// The name of the bus (a cluster) on which a frame is sent; empty if it is in none.
fn bus_of(triggering: Node<'_, '_>) -> String {
    let cluster = triggering.ancestors().find(|node| node.tag_name().name() == "CAN-CLUSTER");
    cluster.map(short_name).unwrap_or_default()
}

struct Reader<'a> {
    document: &'a Document<'a>,
    lines: Lines,
    /// Everything with a name, by its path.
    by_path: HashMap<String, Node<'a, 'a>>,
    faults: Vec<Fault>,
    unflagged: Unflagged,
}

fn within<'a>(node: Node<'a, 'a>, name: &'static str) -> impl Iterator<Item = Node<'a, 'a>> {
    node.descendants().filter(move |child| child.tag_name().name() == name)
}

fn content(node: Node<'_, '_>, name: &str) -> Option<String> {
    let child = node.children().find(|child| child.tag_name().name() == name)?;
    Some(xml::text(child).trim().to_owned())
}

fn number(node: Node<'_, '_>, name: &str) -> Option<i64> {
    content(node, name).and_then(|text| integer(&text)).and_then(|value| i64::try_from(value).ok())
}

/// Integers as AUTOSAR writes them: a leading zero makes them octal.
fn integer(text: &str) -> Option<i128> {
    let text = text.trim();
    let (sign, digits) = text.strip_prefix('-').map_or((1, text), |digits| (-1, digits));
    let octal = digits.strip_prefix('0').filter(|rest| !rest.is_empty());
    match octal.and_then(|digits| i128::from_str_radix(digits, 8).ok()) {
        Some(magnitude) => Some(sign * magnitude),
        None => xml::integer(text),
    }
}

/// An integer or a floating-point number.
fn real(text: &str) -> Option<f64> {
    integer(text).map(|value| value as f64).or_else(|| text.trim().parse().ok())
}

fn short_name(node: Node<'_, '_>) -> String {
    content(node, "SHORT-NAME").unwrap_or_default()
}

fn description(node: Node<'_, '_>) -> String {
    let of = |node: Node<'_, '_>| Some(xml::text(node).trim().to_owned());
    let desc = node.children().find(|child| child.tag_name().name() == "DESC");
    desc.and_then(|desc| desc.children().find(|child| child.tag_name().name() == "L-2"))
        .and_then(of)
        .unwrap_or_default()
}

fn order_of(node: Node<'_, '_>, name: &str) -> ByteOrder {
    if content(node, name).as_deref() == Some("MOST-SIGNIFICANT-BYTE-FIRST") {
        ByteOrder::Big
    } else {
        ByteOrder::Little
    }
}

/// Where a PDU's signals go.
struct Target<'m> {
    name: &'m str,
    /// The position of the PDU's first bit in its frame, always a whole number of bytes.
    offset: u16,
    signals: Vec<Signal>,
    cycle_ms: Option<u32>,
    /// The container that is in the frame.
    container: Option<Container>,
    /// The contained PDU that is being read.
    contained: Option<String>,
    /// How deeply nested the current PDU is, and how many have been read for this frame.
    depth: u32,
    pdus: u32,
}

/// Limits on the nesting of PDUs and on their number in a frame: a file can name a PDU as part of itself.
const MOST_DEPTH: u32 = 8;
const MOST_PDUS: u32 = 1000;
/// How many bytes all paths may have together: of elements in elements, each has the names of all around it.
const MOST_PATH_BYTES: usize = 256 << 20;

impl<'a> Reader<'a> {
    /// Indexes everything below `node` by path.
    fn index(&mut self, root: Node<'a, 'a>) -> Result<(), &'static str> {
        let (mut open, mut left) = (vec![(root, Rc::<str>::from(""))], MOST_PATH_BYTES);
        while let Some((node, path)) = open.pop() {
            for child in node.children().filter(Node::is_element) {
                let name = child.children().find(|node| node.tag_name().name() == "SHORT-NAME");
                let path = match name {
                    Some(name) => {
                        let path = format!("{path}/{}", xml::text(name).trim());
                        left = left
                            .checked_sub(2 * path.len())
                            .ok_or("the paths of its elements come to more than 256 MiB")?;
                        self.by_path.insert(path.clone(), child);
                        path.into()
                    }
                    None => Rc::clone(&path),
                };
                open.push((child, path));
            }
        }
        Ok(())
    }

    /// The element that a reference below `node` points to.
    fn reference(&self, node: Node<'a, 'a>, name: &str) -> Option<Node<'a, 'a>> {
        self.by_path.get(&content(node, name)?).copied()
    }

    fn line(&self, node: Node<'_, '_>) -> u32 {
        xml::line(&self.lines, node)
    }

    fn message(&mut self, triggering: Node<'a, 'a>) -> Option<Message> {
        let line = self.line(triggering);
        let Some(frame) = self.reference(triggering, "FRAME-REF") else {
            let reason = format!(
                "the frame {:?} is not in the file",
                content(triggering, "FRAME-REF").unwrap_or_default()
            );
            let kind = FaultKind::LeftOut(FaultKind::Syntax(reason).into());
            self.faults.push(Fault { line, symbol: short_name(triggering), kind });
            return None;
        };
        let name = short_name(frame);
        let mut fault = |kind| self.faults.push(Fault { line, symbol: name.clone(), kind });
        let Some(written) = number(triggering, "IDENTIFIER") else {
            fault(FaultKind::Syntax("the frame has no identifier".to_owned()));
            return None;
        };
        let extended = content(triggering, "CAN-ADDRESSING-MODE").as_deref() == Some("EXTENDED");
        let raw = u32::try_from(written).ok();
        let Some(id) = raw.and_then(|raw| self.unflagged.id(raw, extended, &name, line)) else {
            fault(FaultKind::Id(written as u64));
            return None;
        };
        let length = number(frame, "FRAME-LENGTH").unwrap_or(8);
        let Some(length) = u16::try_from(length).ok().filter(|&length| length <= validate::MAX_BYTES) else {
            fault(FaultKind::MessageLength(length.unsigned_abs()));
            return None;
        };
        let mut target = Target {
            name: &name,
            offset: 0,
            signals: Vec::new(),
            cycle_ms: None,
            container: None,
            contained: None,
            depth: 0,
            pdus: 0,
        };
        let mappings = within(frame, "PDU-TO-FRAME-MAPPING");
        for mapping in mappings.collect::<Vec<_>>() {
            let start =
                number(mapping, "START-POSITION").and_then(|start| u16::try_from(start).ok()).unwrap_or(0);
            target.offset = start / 8 * 8;
            let Some(pdu) = self.reference(mapping, "PDU-REF") else {
                self.warn(mapping, &name, "a PDU of the frame is not in the file");
                continue;
            };
            if let Err((node, kind)) = self.pdu(pdu, &mut target) {
                self.faults.push(Fault {
                    line: self.line(node),
                    symbol: format!("{name}.{}", short_name(node)),
                    kind,
                });
                return None;
            }
        }
        let Target { signals, cycle_ms, container, .. } = target;
        Some(Message {
            id,
            description: description(frame),
            length,
            cycle_ms,
            j1939: false,
            container,
            signals,
            line,
            name,
        })
    }

    fn warn(&mut self, node: Node<'_, '_>, name: &str, reason: &str) {
        let kind = FaultKind::Ignored(reason.to_owned());
        self.faults.push(Fault { line: self.line(node), symbol: name.to_owned(), kind });
    }

    fn pdu(&mut self, pdu: Node<'a, 'a>, target: &mut Target) -> Result<(), (Node<'a, 'a>, FaultKind)> {
        target.pdus += 1;
        if target.depth >= MOST_DEPTH || target.pdus > MOST_PDUS {
            let reason = "its PDUs are made of each other without an end, or are too many".to_owned();
            return Err((pdu, FaultKind::Syntax(reason)));
        }
        target.depth += 1;
        let result = self.pdu_of_any_kind(pdu, target);
        target.depth -= 1;
        result
    }

    fn pdu_of_any_kind(
        &mut self,
        pdu: Node<'a, 'a>,
        target: &mut Target,
    ) -> Result<(), (Node<'a, 'a>, FaultKind)> {
        match pdu.tag_name().name() {
            "MULTIPLEXED-I-PDU" => self.multiplexed(pdu, target),
            "CONTAINER-I-PDU" => self.container(pdu, target),
            "SECURED-I-PDU" => self.secured(pdu, target),
            _ => {
                target.cycle_ms = target.cycle_ms.or_else(|| cycle_ms(pdu));
                let mappings = within(pdu, "I-SIGNAL-TO-I-PDU-MAPPING");
                for mapping in mappings.collect::<Vec<_>>() {
                    // A group's mapping has no position: those of its signals do.
                    if number(mapping, "START-POSITION").is_none() {
                        continue;
                    }
                    let found = self
                        .reference(mapping, "I-SIGNAL-REF")
                        .or_else(|| self.reference(mapping, "SIGNAL-REF"));
                    let Some(i_signal) = found else {
                        self.warn(mapping, target.name, "a signal of the PDU is not in the file");
                        continue;
                    };
                    match self.signal(mapping, i_signal, target.offset) {
                        Ok(signal) => target.signals.push(signal),
                        Err(kind) if kind.is_warning() => {
                            let symbol = format!("{}.{}", target.name, short_name(i_signal));
                            self.faults.push(Fault { line: self.line(i_signal), symbol, kind });
                        }
                        Err(kind) => return Err((i_signal, kind)),
                    }
                }
                Ok(())
            }
        }
    }

    /// A PDU with the payload of another one, followed by the proof of who sent it.
    fn secured(&mut self, pdu: Node<'a, 'a>, target: &mut Target) -> Result<(), (Node<'a, 'a>, FaultKind)> {
        let name = short_name(pdu);
        if content(pdu, "USE-AS-CRYPTOGRAPHIC-I-PDU").as_deref() == Some("true") {
            self.warn(
                pdu,
                target.name,
                &format!("{name} only has the authenticator of a PDU in another frame"),
            );
            return Ok(());
        }
        target.cycle_ms = target.cycle_ms.or_else(|| cycle_ms(pdu));
        let triggering = self.reference(pdu, "PAYLOAD-REF");
        let payload = triggering.and_then(|node| self.reference(node, "I-PDU-REF"));
        if let Some(payload) = payload {
            self.pdu(payload, target)?;
            self.proof(pdu, payload, target);
            return Ok(());
        }
        self.warn(pdu, target.name, &format!("the payload of {name}, a secured PDU, is not in the file"));
        Ok(())
    }

    /// The freshness value and the authenticator after a payload, as far as a frame carries them. They have no names in the file;
    /// cantools gives them these.
    fn proof(&mut self, pdu: Node<'a, 'a>, payload: Node<'a, 'a>, target: &mut Target) {
        let parts = [
            ("Freshness", "FRESHNESS-PROPS-REF", "FRESHNESS-VALUE-TX-LENGTH"),
            ("Authenticator", "AUTHENTICATION-PROPS-REF", "AUTH-INFO-TX-LENGTH"),
        ];
        let mut at = number(payload, "LENGTH").and_then(|bytes| u16::try_from(bytes).ok()?.checked_mul(8));
        for (name, props, bits) in parts {
            let Some(length) = self.reference(pdu, props).and_then(|props| number(props, bits)) else {
                continue;
            };
            let length = match u16::try_from(length) {
                Ok(0) => continue,
                Ok(length) => length,
                Err(_) => u16::MAX,
            };
            let place =
                at.and_then(|at| at.checked_add(target.offset)).filter(|at| *at < validate::MAX_BYTES * 8);
            let Some(first) = place.filter(|_| length <= 64) else {
                let reason = format!(
                    "the {} of {}, {length}, is not read",
                    name.to_lowercase(),
                    short_name(pdu),
                    length = counted(length, "bit")
                );
                self.warn(pdu, target.name, &reason);
                at = at.and_then(|at| at.checked_add(length));
                continue;
            };
            target.signals.push(Signal {
                order: ByteOrder::Big,
                line: self.line(pdu),
                // The most significant bit comes first.
                ..Signal::new(
                    format!("{}_{name}", target.contained.as_deref().unwrap_or(target.name)),
                    first / 8 * 8 + 7 - first % 8,
                    length,
                )
            });
            at = at.and_then(|at| at.checked_add(length));
        }
    }

    /// A PDU whose selector says which of several others it contains.
    fn multiplexed(
        &mut self,
        pdu: Node<'a, 'a>,
        target: &mut Target,
    ) -> Result<(), (Node<'a, 'a>, FaultKind)> {
        target.cycle_ms = target.cycle_ms.or_else(|| cycle_ms(pdu));
        for part in within(pdu, "STATIC-PART").collect::<Vec<_>>() {
            if let Some(inner) = self.reference(part, "I-PDU-REF") {
                self.pdu(inner, target)?;
            }
        }
        let place = number(pdu, "SELECTOR-FIELD-START-POSITION").zip(number(pdu, "SELECTOR-FIELD-LENGTH"));
        let bits =
            place.and_then(|(start, length)| u16::try_from(start).ok().zip(u16::try_from(length).ok()));
        let Some((start, length)) = bits.filter(|&(_, length)| (1..=64).contains(&length)) else {
            return Err((pdu, FaultKind::Syntax("the selector has no place".to_owned())));
        };
        let switch = target.signals.len();
        // A selector has no name in the file; cantools gives it this one.
        let selectors = target.signals.iter().filter(|signal| signal.is_switch).count();
        let name = format!("{}_selector{}", target.name, selectors + 1);
        target.signals.push(Signal {
            order: order_of(pdu, "SELECTOR-FIELD-BYTE-ORDER"),
            is_switch: true,
            line: self.line(pdu),
            ..Signal::new(name, start + target.offset, length)
        });
        for alternative in within(pdu, "DYNAMIC-PART-ALTERNATIVE").collect::<Vec<_>>() {
            let code = number(alternative, "SELECTOR-FIELD-CODE").and_then(|code| u64::try_from(code).ok());
            let Some((inner, code)) = self.reference(alternative, "I-PDU-REF").zip(code) else {
                self.warn(alternative, target.name, "an alternative of the PDU is not in the file");
                continue;
            };
            let first = target.signals.len();
            self.pdu(inner, target)?;
            for signal in &mut target.signals[first..] {
                signal.multiplexed.get_or_insert(Multiplexed { switch, values: vec![code..=code] });
            }
        }
        Ok(())
    }

    fn signal(
        &self,
        mapping: Node<'a, 'a>,
        i_signal: Node<'a, 'a>,
        offset: u16,
    ) -> Result<Signal, FaultKind> {
        let system = self.reference(i_signal, "SYSTEM-SIGNAL-REF");
        let length = number(i_signal, "LENGTH").or_else(|| number(system?, "LENGTH"));
        let length = match length {
            None | Some(0) => return Err(FaultKind::NoBits),
            Some(length @ 1..=64) => length as u16,
            Some(length) => return Err(FaultKind::TooManyBits(length.unsigned_abs())),
        };
        let start = number(mapping, "START-POSITION").unwrap_or(0);
        let start = start.saturating_add(offset.into());
        let place = u16::try_from(start).ok().filter(|&start| start < validate::MAX_BYTES * 8);
        let place = place.ok_or(FaultKind::Start(start.unsigned_abs()))?;
        let mut description = description(i_signal);
        if description.is_empty() {
            description = system.map(self::description).unwrap_or_default();
        }
        let mut signal = Signal {
            description,
            order: order_of(mapping, "PACKING-BYTE-ORDER"),
            line: self.line(i_signal),
            ..Signal::new(short_name(i_signal), place, length)
        };
        // How it is transmitted takes precedence over how a control unit stores it; in version 3 the type
        // says so.
        let data_type = system.and_then(|system| self.reference(system, "DATA-TYPE-REF"));
        let sources: Vec<_> = [Some(i_signal), system, data_type].into_iter().flatten().collect();
        let find = |name: &'static str| {
            sources.iter().flat_map(|source| within(*source, name)).find_map(|node| {
                let parent = node.parent()?;
                self.reference(parent, name)
            })
        };
        if let Some(base_type) = find("BASE-TYPE-REF") {
            let encoding =
                within(base_type, "BASE-TYPE-ENCODING").next().map(|node| xml::text(node).trim().to_owned());
            signal.kind = kind(encoding.as_deref().unwrap_or_default(), length);
        } else if let Some(data_type) = data_type {
            let encoding = within(data_type, "ENCODING").next().map(|node| xml::text(node).trim().to_owned());
            let encoding = match (data_type.tag_name().name(), encoding.as_deref()) {
                ("REAL-TYPE", _) | (_, Some("SINGLE" | "DOUBLE")) => "IEEE754",
                _ => "NONE",
            };
            signal.kind = kind(encoding, length);
        }
        let method = find("COMPU-METHOD-REF");
        if let Some(method) = method {
            compute(method, &mut signal)?;
        }
        let unit = method.and_then(|method| self.reference(method, "UNIT-REF")).or_else(|| find("UNIT-REF"));
        if let Some(unit) = unit {
            let name = content(unit, "DISPLAY-NAME").unwrap_or_else(|| short_name(unit));
            // What tools call the unit of a signal that has none.
            signal.unit = if name == "NoUnit" { String::new() } else { name };
        }
        let initial = i_signal.children().find(|child| child.tag_name().name() == "INIT-VALUE");
        let initial = initial.and_then(|initial| within(initial, "VALUE").next()).map(xml::text);
        if let Some(initial) = initial.and_then(|text| integer(&text)) {
            signal.initial_raw = initial as u64 & layout::mask(length);
        }
        Ok(signal)
    }
}

/// The value kind for the name of an encoding.
fn kind(encoding: &str, length: u16) -> ValueKind {
    match (encoding, length) {
        ("2C", _) => ValueKind::Signed,
        ("SM", _) => ValueKind::SignMagnitude,
        ("1C", _) => ValueKind::OnesComplement,
        ("IEEE754", 16) => ValueKind::Half,
        ("IEEE754", ..=32) => ValueKind::Single,
        ("IEEE754", _) => ValueKind::Double,
        _ => ValueKind::Unsigned,
    }
}

/// The first cyclic timing of a PDU.
fn cycle_ms(pdu: Node<'_, '_>) -> Option<u32> {
    let is_period = |node: &Node<'_, '_>| matches!(node.tag_name().name(), "TIME-PERIOD" | "REPEATING-TIME");
    let value =
        |node: Node<'_, '_>| node.descendants().find(|node| node.tag_name().name() == "VALUE").map(xml::text);
    let seconds = pdu.descendants().filter(is_period).find_map(value)?.trim().parse::<f64>().ok()?;
    let ms = (seconds * 1000.0).round();
    (ms >= 1.0).then_some(ms as u32)
}

/// Factor, offset, limits and texts of a computation method.
fn compute(method: Node<'_, '_>, signal: &mut Signal) -> Result<(), FaultKind> {
    let is_scale = |node: &Node<'_, '_>| node.tag_name().name() == "COMPU-SCALE";
    let mut texts = Vec::new();
    let mut line: Option<(f64, f64)> = None;
    let mut limits: Option<(f64, f64)> = None;
    for scale in method.descendants().filter(is_scale) {
        let limit = |name: &str| content(scale, name).and_then(|text| real(&text));
        let (low, high) = (limit("LOWER-LIMIT"), limit("UPPER-LIMIT"));
        let named = |name: &'static str| scale.descendants().find(move |node| node.tag_name().name() == name);
        if let Some(text) = named("VT") {
            // A single limit is both.
            if let Some((low, high)) = low.or(high).zip(high.or(low))
                && low <= high
                && high - low < xml::MOST_TEXTS as f64
            {
                let text = xml::text(text).trim().to_owned();
                texts.extend((low as i64..=high as i64).map(|value| (value, text.clone())));
            }
            continue;
        }
        let values = |name: &'static str| -> Vec<f64> {
            let parent = named(name).into_iter();
            let all =
                parent.flat_map(|parent| parent.children().filter(|node| node.tag_name().name() == "V"));
            all.filter_map(|node| real(&xml::text(node))).collect()
        };
        let (numerator, denominator) = (values("COMPU-NUMERATOR"), values("COMPU-DENOMINATOR"));
        if numerator.is_empty() && denominator.is_empty() {
            continue;
        }
        let (&[offset, factor], [divisor]) = (&numerator[..], &denominator[..]) else {
            return Err(FaultKind::Syntax(format!("{} is not a linear computation", short_name(method))));
        };
        let found = (factor / divisor, offset / divisor);
        if line.replace(found).is_some_and(|before| before != found) {
            let reason = format!("{} has several lines, of which only one can be read", short_name(method));
            return Err(FaultKind::Syntax(reason));
        }
        if let Some((low, high)) = low.zip(high) {
            let (least, most) = limits.unwrap_or((low, high));
            limits = Some((least.min(low), most.max(high)));
        }
    }
    if let Some((factor, offset)) = line {
        (signal.factor, signal.offset) = (factor, offset);
        let ends = limits.map(|(low, high)| (low * factor + offset, high * factor + offset));
        signal.min = ends.map(|(low, high)| low.min(high));
        signal.max = ends.map(|(low, high)| low.max(high));
    }
    signal.values = ValueTable::new(texts);
    Ok(())
}
