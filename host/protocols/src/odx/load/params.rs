//! Parameters, and how their values are coded.

use roxmltree::Node;

use super::super::model::{BaseType, Coded, Coding, End, Internal, Item, KeyName, Length, Param, ParamKind};
use super::super::xml::{
    attribute, bytes, child, children, content, grouped, integer, number, short_name, text,
};
use super::Loader;

const TYPE: &[&str] = &["DOP-REF", "DOP-SNREF"];

impl Loader {
    /// The parameters of a message or a structure.
    pub(super) fn params(&mut self, node: Node<'_, '_>) -> Vec<Param> {
        let params: Vec<_> = grouped(node, "PARAMS", "PARAM").collect();
        params.into_iter().map(|param| self.param(param)).collect()
    }

    fn param(&mut self, node: Node<'_, '_>) -> Param {
        let kind = attribute(node, "type").unwrap_or_default();
        let kind = self.param_kind(node, kind);
        if attribute(node, "ID").is_some() {
            self.named(node, Item::Key);
        }
        if let ParamKind::NotEvaluated(what) = &kind {
            self.issue(node, format!("parameter {}: {what} is not evaluated", short_name(node)));
        }
        Param {
            name: short_name(node),
            byte: number(node, "BYTE-POSITION"),
            bit: number(node, "BIT-POSITION").unwrap_or(0),
            kind,
        }
    }

    fn param_kind(&mut self, node: Node<'_, '_>, kind: &str) -> ParamKind {
        let not_evaluated = |what: String| ParamKind::NotEvaluated(what.into());
        let without = |what: &str| not_evaluated(format!("{kind} without {what}"));
        match kind {
            "CODED-CONST" | "NRC-CONST" => {
                let Some(coded) = self.child_coded(node) else { return without("a coded type") };
                let values: Option<Vec<_>> = match kind {
                    "CODED-CONST" => {
                        children(node, "CODED-VALUE").map(|node| coded.constant(&content(node))).collect()
                    }
                    _ => grouped(node, "CODED-VALUES", "CODED-VALUE")
                        .map(|node| coded.constant(&content(node)))
                        .collect(),
                };
                match values.filter(|values| !values.is_empty()) {
                    Some(values) if kind == "NRC-CONST" => ParamKind::OneOf { coded, values },
                    Some(mut values) => ParamKind::Constant { coded, value: values.swap_remove(0) },
                    None => without("a value that its type has"),
                }
            }
            "PHYS-CONST" => match (self.child_link(node, TYPE), text(node, "PHYS-CONSTANT-VALUE")) {
                (Some(dop), Some(value)) => ParamKind::Physical { dop, value },
                _ => without("its type and value"),
            },
            "VALUE" | "SYSTEM" => match self.child_link(node, TYPE) {
                Some(dop) => ParamKind::Value { dop },
                None => without("its type"),
            },
            "LENGTH-KEY" => match self.child_link(node, TYPE) {
                Some(dop) => ParamKind::Length { dop },
                None => without("its type"),
            },
            "MATCHING-REQUEST-PARAM" => {
                let byte = text(node, "REQUEST-BYTE-POS").and_then(|text| integer(&text));
                match (byte.and_then(|byte| i64::try_from(byte).ok()), number(node, "BYTE-LENGTH")) {
                    (Some(byte), Some(length)) => ParamKind::FromRequest { byte, length },
                    _ => without("its place in the request"),
                }
            }
            "RESERVED" => match number(node, "BIT-LENGTH") {
                Some(bits) => ParamKind::Reserved { bits },
                None => without("a length"),
            },
            "TABLE-KEY" => match self.child_link(node, &["TABLE-REF", "TABLE-SNREF", "TABLE-ROW-REF"]) {
                Some(table) => ParamKind::TableKey { table },
                None => without("a table"),
            },
            "TABLE-STRUCT" => match self.key_name(node, "TABLE-KEY-REF", "TABLE-KEY-SNREF") {
                Some(key) => ParamKind::TableStruct { key },
                None => without("a key"),
            },
            "" => not_evaluated("a parameter without xsi:type".to_owned()),
            other => not_evaluated(other.to_owned()),
        }
    }

    fn key_name(
        &mut self,
        node: Node<'_, '_>,
        by_id: &'static str,
        by_name: &'static str,
    ) -> Option<KeyName> {
        if let Some(reference) = child(node, by_id) {
            return self.link(reference).map(KeyName::Link);
        }
        child(node, by_name)
            .and_then(|node| attribute(node, "SHORT-NAME"))
            .map(|name| KeyName::Name(name.into()))
    }

    /// The DIAG-CODED-TYPE of a parameter or type.
    pub(super) fn child_coded(&mut self, node: Node<'_, '_>) -> Option<Coded> {
        let node = child(node, "DIAG-CODED-TYPE")?;
        let Some(base) = attribute(node, "BASE-DATA-TYPE").and_then(base_type) else {
            self.issue(node, "a coded type without a known BASE-DATA-TYPE");
            return None;
        };
        let encoding = attribute(node, "BASE-TYPE-ENCODING").unwrap_or("NONE");
        let coding = coding(encoding).unwrap_or_else(|| {
            self.issue(node, format!("the encoding {encoding} is not known; the type's own is taken"));
            Coding::Plain
        });
        let big_endian = attribute(node, "IS-HIGHLOW-BYTE-ORDER").is_none_or(is_true);
        let length = self.length(node);
        if let Length::NotEvaluated(what) = &length {
            self.issue(node, format!("a coded type: {what} is not evaluated"));
        }
        Some(Coded { base, coding, big_endian, length })
    }

    fn length(&mut self, node: Node<'_, '_>) -> Length {
        let kind = attribute(node, "type").unwrap_or_default();
        let bits = || number(node, "BIT-LENGTH");
        let not_evaluated = |what: &str| Length::NotEvaluated(format!("{kind} without {what}").into());
        match kind {
            "STANDARD-LENGTH-TYPE" => {
                let mask = text(node, "BIT-MASK");
                let read = mask.as_ref().and_then(|mask| u64::from_str_radix(mask, 16).ok());
                match bits() {
                    Some(_) if mask.is_some() && read.is_none() => not_evaluated("a mask of up to 64 bits"),
                    // Tools disagree on which side of the conversion the gaps are.
                    Some(_) if attribute(node, "CONDENSED").is_some_and(is_true) => {
                        Length::NotEvaluated("a condensed bit mask".into())
                    }
                    Some(bits) => Length::Bits { bits, mask: read },
                    None => not_evaluated("BIT-LENGTH"),
                }
            }
            "LEADING-LENGTH-INFO-TYPE" => {
                bits().map_or_else(|| not_evaluated("BIT-LENGTH"), |bits| Length::Leading { bits })
            }
            "MIN-MAX-LENGTH-TYPE" => {
                let end = match attribute(node, "TERMINATION") {
                    Some("ZERO") => End::Zero,
                    Some("HEX-FF") => End::HexFf,
                    Some("END-OF-PDU") => End::OfMessage,
                    _ => return not_evaluated("a known TERMINATION"),
                };
                let min = number(node, "MIN-LENGTH").unwrap_or(0);
                Length::MinMax { min, max: number(node, "MAX-LENGTH"), end }
            }
            "PARAM-LENGTH-INFO-TYPE" => {
                let key = self.key_name(node, "LENGTH-KEY-REF", "LENGTH-KEY-SNREF");
                key.map_or_else(|| not_evaluated("LENGTH-KEY-REF"), Length::Key)
            }
            other => Length::NotEvaluated(other.into()),
        }
    }
}

impl Coded {
    /// A constant as it is written.
    pub fn constant(&self, text: &str) -> Option<Internal> {
        match self.base {
            BaseType::Int | BaseType::Uint => integer(text).map(Internal::Int),
            BaseType::Float32 => text.trim().parse::<f32>().ok().map(|value| Internal::Real(value.into())),
            BaseType::Float64 => text.trim().parse().ok().map(Internal::Real),
            BaseType::Bytes => bytes(text).map(Internal::Bytes),
            BaseType::Ascii | BaseType::Utf8 | BaseType::Unicode => Some(Internal::Text(text.to_owned())),
        }
    }
}

fn is_true(text: &str) -> bool {
    matches!(text, "true" | "1")
}

/// A type of values by its name.
pub fn base_type(name: &str) -> Option<BaseType> {
    Some(match name {
        "A_INT32" | "A_INT64" => BaseType::Int,
        "A_UINT32" | "A_UINT64" => BaseType::Uint,
        "A_FLOAT32" => BaseType::Float32,
        "A_FLOAT64" => BaseType::Float64,
        "A_ASCIISTRING" => BaseType::Ascii,
        "A_UTF8STRING" => BaseType::Utf8,
        "A_UNICODE2STRING" => BaseType::Unicode,
        "A_BYTEFIELD" => BaseType::Bytes,
        _ => return None,
    })
}

fn coding(name: &str) -> Option<Coding> {
    Some(match name {
        "NONE" | "2C" => Coding::Plain,
        "BCD-P" => Coding::BcdPacked,
        "BCD-UP" => Coding::BcdUnpacked,
        "1C" => Coding::OnesComplement,
        "SM" => Coding::SignMagnitude,
        "UTF-8" => Coding::Utf8,
        "UCS-2" => Coding::Ucs2,
        "ISO-8859-1" => Coding::Latin1,
        "ISO-8859-2" => Coding::Latin2,
        "WINDOWS-1252" => Coding::Windows1252,
        _ => return None,
    })
}
