//! From a CDD, Vector's CANdela description of an ECU, to the same model as from ODX: each service of each diagnostic instance of a variant is a service
//! with its request and its positive response.
//!
//! The format is not published. What is read here is what the files themselves show and cantools reads of them: a service's components stand in
//! `PROTOCOLSERVICES`, what an instance puts into them stands with the instance, and `DCLTMPLS` says which belongs where.

mod types;

use roxmltree::Node;
use rustc_hash::FxHashMap;

use super::super::compu::Compu;
use super::super::model::{
    BaseType, Coded, Coding, Comparam, DiagService, Dop, DopKind, Dtcs, Internal, Item, Layer, LayerKind,
    Length, Link, Message, Name, OdxDtc, Param, ParamKind, Parent, ServiceEntry, Target,
};
use super::super::xml::{attribute, child, children, content, integer, text};
use super::Loader;

/// The elements that others refer to, by their identifiers.
type ById<'a, 'i> = FxHashMap<&'a str, Node<'a, 'i>>;

/// What an ECU's identifiers on CAN are called, and the communication parameters of ISO 15765-2 that they are.
const IDENTIFIERS: [(&str, &str); 4] = [
    ("reqcanid", "CP_CanPhysReqId"),
    ("idphysreq", "CP_CanPhysReqId"),
    ("rescanid", "CP_CanRespUSDTId"),
    ("idphysres", "CP_CanRespUSDTId"),
];

impl Loader {
    /// Reads the description.
    pub(super) fn candela(&mut self, root: Node<'_, '_>) {
        let Some(document) = child(root, "ECUDOC") else {
            self.issue(root, "it has no ECUDOC");
            return;
        };
        let ids = document.descendants().filter_map(|node| Some((node.attribute("id")?, node)));
        let ids: ById<'_, '_> = ids.collect();
        let mut reader = Reader { ids, types: FxHashMap::default() };
        for ecu in children(document, "ECU") {
            let comparams = reader.identifiers(self, ecu);
            let mut base = None;
            for variant in children(ecu, "VAR") {
                let is_base = variant.attribute("base") == Some("1");
                let layer = reader.variant(self, variant, is_base, base, &comparams);
                if is_base {
                    base = Some(layer);
                }
            }
        }
    }

    /// A reference to something that is there.
    fn item_link(&mut self, item: Item) -> Link {
        let link = self.model.links.len() as Link;
        self.model.links.push(Target::Item(item));
        self.wanted.push(None);
        link
    }
}

/// A text in English, or else in the first language that it is in.
fn translated(node: Node<'_, '_>, name: &'static str) -> Name {
    let Some(group) = child(node, name) else { return Name::default() };
    let is_english = |one: &Node<'_, '_>| attribute(*one, "lang").is_some_and(|lang| lang.starts_with("en"));
    let english = children(group, "TUV").find(is_english);
    english.or_else(|| children(group, "TUV").next()).map(content).unwrap_or_default()
}

fn qualifier(node: Node<'_, '_>) -> Name {
    text(node, "QUAL").unwrap_or_default()
}

fn number(node: Node<'_, '_>, name: &str) -> Option<u32> {
    u32::try_from(integer(node.attribute(name)?)?).ok()
}

fn constant(bits: u32) -> Coded {
    let length = Length::Bits { bits, mask: None };
    Coded { base: BaseType::Uint, coding: Coding::Plain, big_endian: true, length }
}

struct Reader<'a, 'i> {
    ids: ById<'a, 'i>,
    /// Types that were read, and how many bits they take; `None` if that depends on the message.
    types: FxHashMap<&'a str, (u32, Option<u32>)>,
}

/// Parameters one after another.
struct Row {
    params: Vec<Param>,
    /// Where the next one begins; `None` behind one whose length depends on the message.
    offset: Option<u32>,
}

impl Row {
    fn new() -> Self {
        Self { params: Vec::new(), offset: Some(0) }
    }

    /// Fields are put together from the lowest bit of a byte up.
    fn push(&mut self, name: Name, bits: Option<u32>, kind: ParamKind) {
        let (byte, bit) = (self.offset.map(|offset| offset / 8), self.offset.map_or(0, |offset| offset % 8));
        // Where a part of a byte is cannot be said behind something of unknown length.
        let is_lost = self.offset.is_none() && bits.is_some_and(|bits| !bits.is_multiple_of(8));
        let kind = if is_lost {
            ParamKind::NotEvaluated("a part of a byte behind a field of any length".into())
        } else {
            kind
        };
        self.params.push(Param { name, byte, bit, kind });
        self.offset = self.offset.zip(bits).and_then(|(offset, bits)| offset.checked_add(bits));
    }
}

impl<'a, 'i> Reader<'a, 'i> {
    /// The identifiers on CAN that the ECU itself gives; what its template proposes for any ECU does not count.
    fn identifiers(&self, loader: &mut Loader, ecu: Node<'a, 'i>) -> Vec<Comparam> {
        let mut found = Vec::new();
        for value in children(ecu, "UNS") {
            let definition = value.attribute("attrref").and_then(|id| self.ids.get(id));
            let Some((definition, value)) = definition.zip(value.attribute("v")) else { continue };
            let name = qualifier(*definition).to_ascii_lowercase();
            let known = IDENTIFIERS.iter().find(|(ending, _)| name.ends_with(ending));
            let Some((_, parameter)) = known else { continue };
            let link = loader.model.links.len() as Link;
            loader.model.links.push(Target::Missing);
            loader.wanted.push(None);
            found.push(Comparam {
                link,
                id: (*parameter).into(),
                protocol: None,
                values: vec![value.into()],
            });
        }
        found
    }

    /// Reads a variant; returns the number of its layer.
    fn variant(
        &mut self,
        loader: &mut Loader,
        variant: Node<'a, 'i>,
        is_base: bool,
        base: Option<u32>,
        comparams: &[Comparam],
    ) -> u32 {
        let mut layer = Layer {
            kind: if is_base { LayerKind::BaseVariant } else { LayerKind::EcuVariant },
            name: qualifier(variant),
            long_name: translated(variant, "NAME"),
            parents: Vec::new(),
            imports: Vec::new(),
            services: Vec::new(),
            dops: Vec::new(),
            tables: Vec::new(),
            global_refusals: Vec::new(),
            comparams: comparams.to_vec(),
        };
        if let Some(base) = base {
            let parent = loader.item_link(Item::Layer(base));
            layer.parents.push(Parent { layer: parent, ..Parent::default() });
        }
        let classes = children(variant, "DIAGCLASS").flat_map(|class| children(class, "DIAGINST"));
        for instance in classes.chain(children(variant, "DIAGINST")) {
            self.instance(loader, instance, &mut layer.services);
        }
        for records in variant.descendants().filter(|node| node.has_tag_name("RECORDDT")) {
            layer.dops.push(trouble_codes(loader, records));
        }
        loader.model.layers.push(layer);
        loader.model.layers.len() as u32 - 1
    }

    fn instance(&mut self, loader: &mut Loader, instance: Node<'a, 'i>, services: &mut Vec<ServiceEntry>) {
        let template = instance.attribute("tmplref").and_then(|id| self.ids.get(id)).copied();
        for service in children(instance, "SERVICE") {
            let of_class = service.attribute("tmplref").and_then(|id| self.ids.get(id));
            let protocol = of_class.and_then(|node| self.ids.get(node.attribute("tmplref")?)).copied();
            let Some((template, protocol)) = template.zip(protocol) else {
                loader.issue(service, "a service whose template is not in the file");
                continue;
            };
            let name: Name = format!("{}_{}", qualifier(instance), qualifier(service)).into();
            let [request, response] = ["REQ", "POS"]
                .map(|part| child(protocol, part))
                .map(|part| part.map(|part| self.message(loader, &name, instance, template, part)));
            let long_name = [translated(instance, "NAME"), translated(service, "NAME")];
            let number = loader.model.services.len() as u32;
            loader.model.services.push(DiagService {
                name,
                long_name: long_name.join(" ").trim().into(),
                request,
                responses: response.into_iter().collect(),
                refusals: Vec::new(),
            });
            services.push(ServiceEntry::Own(number));
        }
    }

    /// A request or response: the components of its protocol's service, filled by the instance.
    fn message(
        &mut self,
        loader: &mut Loader,
        name: &Name,
        instance: Node<'a, 'i>,
        template: Node<'a, 'i>,
        part: Node<'a, 'i>,
    ) -> Link {
        let mut row = Row::new();
        for component in part.children().filter(Node::is_element) {
            let own = qualifier(component);
            // Which of the template's parts it is.
            let part_of = |group: &'static str, reference: &'static str| {
                let is_here = |group: &Node<'a, 'i>| {
                    children(*group, reference).any(|one| one.attribute("idref") == component.attribute("id"))
                };
                children(template, group).find(is_here).and_then(|group| group.attribute("id"))
            };
            match component.tag_name().name() {
                "NAME" | "DESC" | "QUAL" => {}
                "CONSTCOMP" => match (number(component, "bl"), component.attribute("v").and_then(integer)) {
                    (Some(bits), Some(value)) => {
                        let kind = ParamKind::Constant { coded: constant(bits), value: Internal::Int(value) };
                        row.push(own, Some(bits), kind);
                    }
                    _ => loader.issue(component, "a constant without bits or value"),
                },
                "STATICCOMP" => {
                    let place = part_of("SHSTATIC", "STATICCOMPREF");
                    let is_it = |value: &Node<'_, '_>| value.attribute("shstaticref") == place;
                    let value = children(instance, "STATICVALUE").find(is_it);
                    let value = value.and_then(|value| integer(value.attribute("v")?));
                    match (number(component, "bl"), value) {
                        (Some(bits), Some(value)) => {
                            let kind =
                                ParamKind::Constant { coded: constant(bits), value: Internal::Int(value) };
                            row.push(own, Some(bits), kind);
                        }
                        (bits, _) => row.push(
                            own,
                            bits,
                            ParamKind::NotEvaluated("a value that is not in the file".into()),
                        ),
                    }
                }
                "SIMPLEPROXYCOMP" => {
                    let place = part_of("SHPROXY", "PROXYCOMPREF");
                    let is_it = |one: &Node<'_, '_>| place.is_some() && one.attribute("shproxyref") == place;
                    let contents: Vec<_> = children(instance, "SIMPLECOMPCONT").filter(is_it).collect();
                    for content in contents {
                        self.objects(loader, content, &mut row, 0);
                    }
                }
                other => {
                    row.push(own, None, ParamKind::NotEvaluated(other.into()));
                    break;
                }
            }
        }
        let number = loader.model.messages.len() as u32;
        loader.model.messages.push(Message { name: name.clone(), params: row.params });
        loader.item_link(Item::Message(number))
    }

    /// The objects in an element, one after another.
    fn objects(&mut self, loader: &mut Loader, group: Node<'a, 'i>, row: &mut Row, depth: usize) {
        /// Structures contain others up to this depth.
        const DEEPEST: usize = 8;
        if depth == DEEPEST {
            loader.issue(group, "structures in each other, too deep");
            return;
        }
        for object in group.children().filter(Node::is_element) {
            match object.tag_name().name() {
                "DATAOBJ" => {
                    let (dop, bits) = self.type_of(loader, object);
                    let dop = loader.item_link(Item::Dop(dop));
                    row.push(qualifier(object), bits, ParamKind::Value { dop });
                }
                "GAPDATAOBJ" => {
                    let bits = number(object, "bl").unwrap_or(0);
                    row.push(qualifier(object), Some(bits), ParamKind::Reserved { bits });
                }
                "STRUCT" | "STRUCTURE" => self.objects(loader, object, row, depth + 1),
                // The same bytes as a whole and in parts.
                "UNION" => match child(object, "STRUCT") {
                    Some(parts) => self.objects(loader, parts, row, depth + 1),
                    None => self.objects(loader, object, row, depth + 1),
                },
                "DIDDATAREF" => match object.attribute("didRef").and_then(|id| self.ids.get(id)).copied() {
                    Some(data) => {
                        for structure in children(data, "STRUCTURE") {
                            self.objects(loader, structure, row, depth + 1);
                        }
                    }
                    None => loader.issue(object, "data that are not in the file"),
                },
                // The reasons of refusals, which are UDS's own.
                "NAME" | "DESC" | "QUAL" | "SPECDATAOBJ" => {}
                other => row.push(qualifier(object), None, ParamKind::NotEvaluated(other.into())),
            }
        }
    }
}

fn trouble_codes(loader: &mut Loader, records: Node<'_, '_>) -> u32 {
    let codes = children(records, "RECORD").filter_map(|record| {
        let code = u32::try_from(integer(record.attribute("v")?)?).ok()?;
        // Its text says all that there is.
        Some((code, OdxDtc { name: translated(record, "TEXT"), ..OdxDtc::default() }))
    });
    let bits = child(records, "CVALUETYPE").and_then(|value| number(value, "bl")).unwrap_or(24);
    let dtcs =
        Dtcs { coded: constant(bits), compu: Compu::Identical, codes: codes.collect(), others: Vec::new() };
    loader.model.dops.push(Dop { name: qualifier(records), kind: DopKind::Dtcs(Box::new(dtcs)) });
    loader.model.dops.len() as u32 - 1
}
