//! Types of values in a CDD: IDENT, LINCOMP and TEXTTBL.

use roxmltree::Node;

use super::super::super::compu::{BoundValue, Compu, CompuScale, Limit, LimitKind};
use super::super::super::model::{BaseType, Coded, Coding, Data, Dop, DopKind, End, Item, Length, Link};
use super::super::super::xml::{child, children, text};
use super::{Loader, Reader, number, qualifier, translated};

impl<'a, 'i> Reader<'a, 'i> {
    /// The type of an object, and how many bits it takes; `None` if that depends on the message.
    pub(super) fn type_of(&mut self, loader: &mut Loader, object: Node<'a, 'i>) -> (u32, Option<u32>) {
        let is_type = |node: &Node<'_, '_>| matches!(node.tag_name().name(), "IDENT" | "LINCOMP" | "TEXTTBL");
        // It may stand in the object itself.
        if let Some(own) = object.children().find(is_type) {
            return simple(loader, own);
        }
        let Some(id) = object.attribute("dtref") else {
            return unknown(loader, object, "an object without a type");
        };
        if let Some(known) = self.types.get(id) {
            return *known;
        }
        let read = match self.ids.get(id).copied() {
            Some(node) if is_type(&node) => simple(loader, node),
            Some(node) => {
                let kind = node.tag_name().name().to_owned();
                let bits = child(node, "CVALUETYPE").and_then(fixed_bits);
                let (dop, _) = unknown(loader, node, &format!("a type of the kind {kind}"));
                (dop, bits)
            }
            None => unknown(loader, object, "an object whose type is not in the file"),
        };
        self.types.insert(id, read);
        read
    }
}

/// A type that is not evaluated.
fn unknown(loader: &mut Loader, node: Node<'_, '_>, what: &str) -> (u32, Option<u32>) {
    loader.issue(node, format!("{what} is not evaluated"));
    let kind = DopKind::NotEvaluated(what.into());
    loader.model.dops.push(Dop { name: qualifier(node), kind });
    (loader.model.dops.len() as u32 - 1, None)
}

/// How many bits a value takes in each message.
fn fixed_bits(value: Node<'_, '_>) -> Option<u32> {
    let bits = number(value, "bl")?;
    if value.attribute("qty") != Some("field") {
        return Some(bits);
    }
    let (least, most) = (number(value, "minsz")?, number(value, "maxsz")?);
    let is_fixed = least == most && value.attribute("sz").is_none_or(|size| size == "no");
    is_fixed.then(|| bits.checked_mul(most)).flatten()
}

fn simple(loader: &mut Loader, node: Node<'_, '_>) -> (u32, Option<u32>) {
    let Some(value) = child(node, "CVALUETYPE") else {
        return unknown(loader, node, "a type without CVALUETYPE");
    };
    let bits = fixed_bits(value);
    let coded = match coded(value, bits) {
        Ok(coded) => coded,
        Err(what) => return (unknown(loader, node, &what).0, bits),
    };
    let shown = child(node, "PVALUETYPE");
    let physical = match shown.and_then(|shown| shown.attribute("enc")) {
        Some("dbl" | "flt") => BaseType::Float64,
        Some("sgn") => BaseType::Int,
        _ if node.has_tag_name("TEXTTBL") => BaseType::Unicode,
        _ => coded.base,
    };
    let compu = match node.tag_name().name() {
        "LINCOMP" => Compu::Scales(children(node, "COMP").map(scale).collect()),
        "TEXTTBL" => Compu::Texts(children(node, "TEXTMAP").map(text_of).collect(), None),
        _ => Compu::Identical,
    };
    let unit = shown.and_then(|shown| text(shown, "UNIT")).filter(|unit| !unit.is_empty());
    let unit = unit.map(|unit| -> Link {
        loader.model.units.push(unit);
        let number = loader.model.units.len() as u32 - 1;
        loader.item_link(Item::Unit(number))
    });
    let is_hex = shown.and_then(|shown| shown.attribute("df")) == Some("hex");
    let data = Data { coded, compu, physical, is_hex, unit, invalid: Vec::new() };
    loader.model.dops.push(Dop { name: qualifier(node), kind: DopKind::Data(Box::new(data)) });
    (loader.model.dops.len() as u32 - 1, bits)
}

fn coded(value: Node<'_, '_>, bits: Option<u32>) -> Result<Coded, String> {
    let is_field = value.attribute("qty") == Some("field");
    let encoding = value.attribute("enc").unwrap_or("uns");
    let (base, coding) = match (encoding, is_field) {
        ("asc", _) => (BaseType::Ascii, Coding::Plain),
        ("utf" | "utf8", _) => (BaseType::Utf8, Coding::Utf8),
        (_, true) => (BaseType::Bytes, Coding::Plain),
        ("uns", false) => (BaseType::Uint, Coding::Plain),
        ("sgn", false) => (BaseType::Int, Coding::Plain),
        ("bcd", false) => (BaseType::Uint, Coding::BcdPacked),
        ("flt", false) => (BaseType::Float32, Coding::Plain),
        ("dbl", false) => (BaseType::Float64, Coding::Plain),
        (other, false) => return Err(format!("the encoding {other}")),
    };
    let big_endian = match value.attribute("bo") {
        Some("21") | None => true,
        Some("12") => false,
        Some(other) => return Err(format!("the byte order {other}")),
    };
    let of_elements = |name| number(value, name)?.checked_mul(number(value, "bl")?);
    let length = match (bits, value.attribute("sz")) {
        (Some(bits), _) => Length::Bits { bits, mask: None },
        (None, Some("lszbyte")) => Length::Leading { bits: 8 },
        (None, Some("lsz2bytes")) => Length::Leading { bits: 16 },
        (None, Some("lsz3bytes")) => Length::Leading { bits: 24 },
        (None, Some("lsz4bytes")) => Length::Leading { bits: 32 },
        (None, Some("no") | None) => {
            let min = of_elements("minsz").unwrap_or(0) / 8;
            Length::MinMax { min, max: of_elements("maxsz").map(|bits| bits / 8), end: End::OfMessage }
        }
        (None, Some(other)) => return Err(format!("the length {other}")),
    };
    Ok(Coded { base, coding, big_endian, length })
}

/// A limit; parentheses around it say only that there are values beyond.
fn limit(node: Node<'_, '_>, name: &str) -> Option<Limit> {
    let text = node.attribute(name)?.trim().trim_matches(['(', ')']);
    Some(Limit { value: Some(BoundValue::read(text)), kind: LimitKind::Closed })
}

/// `raw * f / div + o`.
fn scale(comp: Node<'_, '_>) -> CompuScale {
    let read = |name: &str, default: f64| {
        comp.attribute(name).and_then(|text| text.trim().parse().ok()).unwrap_or(default)
    };
    let (factor, offset) = (read("f", 1.0), read("o", 0.0));
    let (numerator, denominator) = if comp.has_attribute("div") {
        let divisor: f64 = read("div", 1.0);
        (vec![offset * divisor, factor], vec![divisor])
    } else {
        (vec![offset, factor], Vec::new())
    };
    CompuScale { low: limit(comp, "s"), high: limit(comp, "e"), numerator, denominator, constant: None }
}

fn text_of(map: Node<'_, '_>) -> CompuScale {
    let constant = Some(translated(map, "TEXT"));
    CompuScale { low: limit(map, "s"), high: limit(map, "e"), constant, ..CompuScale::default() }
}
