//! Types of values, and what is made of them.

use std::collections::BTreeMap;

use roxmltree::Node;

use super::super::compu::{BoundValue, Compu, CompuScale, Limit, LimitKind};
use super::super::model::{Case, Data, Dop, DopKind, Dtcs, Item, Mux, Name, OdxDtc, Place};
use super::super::xml::{attribute, child, children, content, grouped, integer, number, short_name, text};
use super::Loader;
use super::params::base_type;

const STRUCTURE: &[&str] = &[
    "BASIC-STRUCTURE-REF",
    "BASIC-STRUCTURE-SNREF",
    "STRUCTURE-REF",
    "STRUCTURE-SNREF",
    "ENV-DATA-DESC-REF",
    "ENV-DATA-DESC-SNREF",
];
const DATA: &[&str] = &["DATA-OBJECT-PROP-REF", "DATA-OBJECT-PROP-SNREF"];

impl Loader {
    /// Reads a type; one that is not understood is a type, too, so that whoever refers to it says so.
    pub(super) fn dop(&mut self, node: Node<'_, '_>) -> u32 {
        let number = self.model.dops.len() as u32;
        self.register(node, Item::Dop(number));
        self.model.dops.push(Dop { name: short_name(node), kind: DopKind::NotEvaluated("".into()) });
        let element = node.tag_name().name();
        let kind = match element {
            "DATA-OBJECT-PROP" => self.data(node),
            "DTC-DOP" => self.dtcs(node, number),
            "STRUCTURE" | "ENV-DATA" => {
                let byte_size = super::super::xml::number(node, "BYTE-SIZE");
                Some(DopKind::Structure { params: self.params(node), byte_size })
            }
            "END-OF-PDU-FIELD" => self.child_link(node, STRUCTURE).map(|item| DopKind::ToEnd { item }),
            "STATIC-FIELD" => self.static_field(node),
            "DYNAMIC-LENGTH-FIELD" => self.counted_field(node),
            "DYNAMIC-ENDMARKER-FIELD" => self.marked_field(node),
            "MUX" => self.mux(node),
            _ => None,
        };
        let kind = kind.unwrap_or_else(|| {
            self.issue(node, format!("{element} {} is not evaluated", short_name(node)));
            DopKind::NotEvaluated(element.into())
        });
        self.model.dops[number as usize].kind = kind;
        number
    }

    fn data(&mut self, node: Node<'_, '_>) -> Option<DopKind> {
        let coded = self.child_coded(node)?;
        let physical = child(node, "PHYSICAL-TYPE");
        let base = physical.and_then(|node| attribute(node, "BASE-DATA-TYPE")).and_then(base_type);
        let is_hex = physical.and_then(|node| attribute(node, "DISPLAY-RADIX")) == Some("HEX");
        let invalid = child(node, "INTERNAL-CONSTR").map(invalid).unwrap_or_default();
        let unit = self.child_link(node, &["UNIT-REF"]);
        let physical = base.unwrap_or(coded.base);
        let compu = self.compu(node);
        Some(DopKind::Data(Box::new(Data { coded, compu, physical, is_hex, unit, invalid })))
    }

    fn dtcs(&mut self, node: Node<'_, '_>, own: u32) -> Option<DopKind> {
        let coded = self.child_coded(node)?;
        let mut codes = BTreeMap::new();
        let mut others = Vec::new();
        let entries: Vec<_> =
            children(node, "DTCS").flat_map(|node| node.children()).filter(Node::is_element).collect();
        for node in entries {
            match node.tag_name().name() {
                "DTC" => {
                    let code = text(node, "TROUBLE-CODE").and_then(|text| integer(&text));
                    let Some(code) = code.and_then(|code| u32::try_from(code).ok()) else {
                        self.issue(node, format!("the trouble code {} has no number", short_name(node)));
                        continue;
                    };
                    self.register(node, Item::Dtc(own, code));
                    codes.insert(
                        code,
                        OdxDtc {
                            name: short_name(node),
                            display: text(node, "DISPLAY-TROUBLE-CODE").unwrap_or_default(),
                            text: text(node, "TEXT").unwrap_or_default(),
                        },
                    );
                }
                "DTC-REF" => others.extend(self.link(node)),
                _ => {}
            }
        }
        let linked: Vec<_> = grouped(node, "LINKED-DTC-DOPS", "LINKED-DTC-DOP").collect();
        for linked in linked {
            others.extend(self.child_link(linked, &["DTC-DOP-REF"]));
        }
        let compu = self.compu(node);
        Some(DopKind::Dtcs(Box::new(Dtcs { coded, compu, codes, others })))
    }

    fn static_field(&mut self, node: Node<'_, '_>) -> Option<DopKind> {
        Some(DopKind::Static {
            item: self.child_link(node, STRUCTURE)?,
            count: number(node, "FIXED-NUMBER-OF-ITEMS")?,
            item_bytes: number(node, "ITEM-BYTE-SIZE")?,
        })
    }

    fn counted_field(&mut self, node: Node<'_, '_>) -> Option<DopKind> {
        let count = self.place(child(node, "DETERMINE-NUMBER-OF-ITEMS")?)?;
        let item = self.child_link(node, STRUCTURE)?;
        Some(DopKind::Counted { item, offset: number(node, "OFFSET").unwrap_or(0), count })
    }

    fn marked_field(&mut self, node: Node<'_, '_>) -> Option<DopKind> {
        let end = child(node, "DYN-END-DOP-REF").or_else(|| child(node, "DYN-END-DOP-SNREF"))?;
        let value = text(end, "TERMINATION-VALUE")?;
        Some(DopKind::Marked { item: self.child_link(node, STRUCTURE)?, end: self.link(end)?, value })
    }

    fn place(&mut self, node: Node<'_, '_>) -> Option<Place> {
        let dop = self.child_link(node, DATA)?;
        Some(Place {
            byte: number(node, "BYTE-POSITION").unwrap_or(0),
            bit: number(node, "BIT-POSITION").unwrap_or(0),
            dop,
        })
    }

    fn mux(&mut self, node: Node<'_, '_>) -> Option<DopKind> {
        let switch = self.place(child(node, "SWITCH-KEY")?)?;
        let cases: Vec<_> = grouped(node, "CASES", "CASE").collect();
        let cases = cases.into_iter().map(|case| self.case(case)).collect();
        let default = child(node, "DEFAULT-CASE").map(|case| self.case(case));
        let byte = number(node, "BYTE-POSITION").unwrap_or(0);
        Some(DopKind::Mux(Box::new(Mux { byte, switch, cases, default })))
    }

    fn case(&mut self, node: Node<'_, '_>) -> Case {
        let limits = (child(node, "LOWER-LIMIT").map(limit), child(node, "UPPER-LIMIT").map(limit));
        Case { name: short_name(node), limits, structure: self.child_link(node, STRUCTURE) }
    }

    fn compu(&mut self, node: Node<'_, '_>) -> Compu {
        let Some(method) = child(node, "COMPU-METHOD") else { return Compu::Identical };
        let category = text(method, "CATEGORY").unwrap_or_default();
        let forward = child(method, "COMPU-INTERNAL-TO-PHYS");
        let scales = || -> Vec<CompuScale> {
            forward
                .into_iter()
                .flat_map(|node| grouped(node, "COMPU-SCALES", "COMPU-SCALE"))
                .map(scale)
                .collect()
        };
        let compu = match &*category {
            "IDENTICAL" => Compu::Identical,
            "LINEAR" | "SCALE-LINEAR" | "RAT-FUNC" | "SCALE-RAT-FUNC" => Compu::Scales(scales()),
            "TEXTTABLE" => {
                let default = forward.and_then(|node| child(node, "COMPU-DEFAULT-VALUE"));
                Compu::Texts(scales(), default.and_then(constant))
            }
            "TAB-INTP" => {
                let point = |scale: &CompuScale| {
                    let x = match scale.low.as_ref()?.value.as_ref()? {
                        BoundValue::Int(value) => *value as f64,
                        BoundValue::Real(value) => *value,
                        BoundValue::Text(_) => return None,
                    };
                    Some((x, scale.constant.as_ref()?.trim().parse().ok()?))
                };
                match scales().iter().map(point).collect::<Option<Vec<_>>>() {
                    Some(points) => Compu::Points(points),
                    None => Compu::NotEvaluated("TAB-INTP without its points".into()),
                }
            }
            other => Compu::NotEvaluated(other.into()),
        };
        let compu = match compu {
            Compu::Scales(scales)
                if scales.is_empty()
                    || scales.iter().any(|scale| scale.numerator.is_empty() && scale.constant.is_none()) =>
            {
                Compu::NotEvaluated(format!("{category} without coefficients").into())
            }
            compu => compu,
        };
        if let Compu::NotEvaluated(what) = &compu {
            self.issue(method, format!("{}: the conversion {what} is not evaluated", short_name(node)));
        }
        compu
    }
}

fn scale(node: Node<'_, '_>) -> CompuScale {
    let coefficients = |name| {
        let node = child(node, "COMPU-RATIONAL-COEFFS").and_then(|node| child(node, name));
        let values = node.into_iter().flat_map(|node| children(node, "V"));
        // One that is no number makes all of them unusable, which is said.
        values.map(|node| content(node).parse().ok()).collect::<Option<Vec<f64>>>().unwrap_or_default()
    };
    CompuScale {
        low: child(node, "LOWER-LIMIT").map(limit),
        high: child(node, "UPPER-LIMIT").map(limit),
        numerator: coefficients("COMPU-NUMERATOR"),
        denominator: coefficients("COMPU-DENOMINATOR"),
        constant: child(node, "COMPU-CONST").and_then(constant),
    }
}

/// The text or number of a constant.
fn constant(node: Node<'_, '_>) -> Option<Name> {
    text(node, "VT").or_else(|| text(node, "V"))
}

fn limit(node: Node<'_, '_>) -> Limit {
    let kind = match attribute(node, "INTERVAL-TYPE") {
        Some("OPEN") => LimitKind::Open,
        Some("INFINITE") => LimitKind::Infinite,
        _ => LimitKind::Closed,
    };
    let content = content(node);
    Limit { value: (!content.is_empty()).then(|| BoundValue::read(&content)), kind }
}

/// The ranges that are not valid, with what they mean.
fn invalid(node: Node<'_, '_>) -> Vec<(Limit, Limit, Name)> {
    let infinite = || Limit { value: None, kind: LimitKind::Infinite };
    let ranges = grouped(node, "SCALE-CONSTRS", "SCALE-CONSTR").filter_map(|range| {
        let meaning = match attribute(range, "VALIDITY") {
            Some("NOT-VALID") => "not valid",
            Some("NOT-DEFINED") => "not defined",
            Some("NOT-AVAILABLE") => "not available",
            _ => return None,
        };
        let side = |name| child(range, name).map_or_else(infinite, limit);
        let label = text(range, "SHORT-LABEL").filter(|label| !label.is_empty());
        Some((side("LOWER-LIMIT"), side("UPPER-LIMIT"), label.unwrap_or_else(|| meaning.into())))
    });
    ranges.collect()
}
