//! Layers: what they have, and whose they inherit.

use roxmltree::Node;

use super::super::model::{
    Comparam, DiagService, Item, Layer, LayerKind, Message, OdxTable, Parent, Row, ServiceEntry,
};
use super::super::xml::{attribute, child, children, grouped, short_name, text};
use super::{Loader, names_in, texts};

/// What a layer has that no message depends on.
const NEEDLESS: &[&str] = &[
    "SHORT-NAME",
    "LONG-NAME",
    "DESC",
    "ADMIN-DATA",
    "COMPANY-DATAS",
    "FUNCT-CLASSS",
    "SDGS",
    "STATE-CHARTS",
    "ADDITIONAL-AUDIENCES",
    "LIBRARYS",
    "SUB-COMPONENTS",
    "COMPARAM-SPEC-REF",
    "PROT-STACK-SNREF",
    "DIAG-VARIABLES",
    "VARIABLE-GROUPS",
    "DYN-DEFINED-SPEC",
    "ECU-VARIANT-PATTERNS",
    "BASE-VARIANT-PATTERN",
];

impl Loader {
    pub(super) fn layer(&mut self, node: Node<'_, '_>) {
        let kind = match node.tag_name().name() {
            "PROTOCOL" => LayerKind::Protocol,
            "FUNCTIONAL-GROUP" => LayerKind::FunctionalGroup,
            "ECU-SHARED-DATA" => LayerKind::SharedData,
            "BASE-VARIANT" => LayerKind::BaseVariant,
            "ECU-VARIANT" => LayerKind::EcuVariant,
            other => return self.issue(node, format!("{other} is not known")),
        };
        let name = short_name(node);
        self.layer = self.document_number(&name);
        self.register(node, Item::Layer(self.model.layers.len() as u32));
        let mut layer = Layer {
            kind,
            name,
            long_name: text(node, "LONG-NAME").unwrap_or_default(),
            parents: Vec::new(),
            imports: Vec::new(),
            services: Vec::new(),
            dops: Vec::new(),
            tables: Vec::new(),
            global_refusals: Vec::new(),
            comparams: Vec::new(),
        };
        for part in node.children().filter(Node::is_element) {
            match part.tag_name().name() {
                "DIAG-DATA-DICTIONARY-SPEC" => self.dictionary(part, &mut layer),
                "DIAG-COMMS" => self.services(part, &mut layer),
                "REQUESTS" | "POS-RESPONSES" | "NEG-RESPONSES" => {
                    for message in part.children().filter(Node::is_element) {
                        self.message(message);
                    }
                }
                "GLOBAL-NEG-RESPONSES" => {
                    for message in part.children().filter(Node::is_element) {
                        let message = self.message(message);
                        layer.global_refusals.push(message);
                    }
                }
                "COMPARAM-REFS" => {
                    for value in children(part, "COMPARAM-REF") {
                        self.comparam(value, &mut layer);
                    }
                }
                "PARENT-REFS" => {
                    for parent in children(part, "PARENT-REF") {
                        self.parent(parent, &mut layer);
                    }
                }
                "IMPORT-REFS" => {
                    let links: Vec<_> = children(part, "IMPORT-REF").collect();
                    layer.imports.extend(links.into_iter().filter_map(|node| self.link(node)));
                }
                name if NEEDLESS.contains(&name) => {}
                other => self.issue(part, format!("{other} is not known")),
            }
        }
        self.model.layers.push(layer);
        self.layer = self.container;
    }

    fn parent(&mut self, node: Node<'_, '_>, layer: &mut Layer) {
        let Some(link) = self.link(node) else { return };
        layer.parents.push(Parent {
            layer: link,
            without_services: names_in(node, "NOT-INHERITED-DIAG-COMMS"),
            without_dops: names_in(node, "NOT-INHERITED-DOPS"),
            without_tables: names_in(node, "NOT-INHERITED-TABLES"),
            without_refusals: names_in(node, "NOT-INHERITED-GLOBAL-NEG-RESPONSES"),
        });
    }

    fn comparam(&mut self, node: Node<'_, '_>, layer: &mut Layer) {
        // The definition has the name, which the identifier has as well.
        let Some(link) = self.link_or_not(node, true) else { return };
        let id = attribute(node, "ID-REF").unwrap_or_default().into();
        let protocol = child(node, "PROTOCOL-SNREF").and_then(|node| attribute(node, "SHORT-NAME"));
        let values = match child(node, "COMPLEX-VALUE") {
            Some(complex) => texts(complex, "SIMPLE-VALUE"),
            // ODX 2.0 has the value in VALUE.
            None => text(node, "SIMPLE-VALUE").or_else(|| text(node, "VALUE")).into_iter().collect(),
        };
        layer.comparams.push(Comparam { link, id, protocol: protocol.map(Into::into), values });
    }

    fn services(&mut self, node: Node<'_, '_>, layer: &mut Layer) {
        for service in node.children().filter(Node::is_element) {
            match service.tag_name().name() {
                "DIAG-SERVICE" => {
                    let own = self.service(service);
                    layer.services.push(ServiceEntry::Own(own));
                }
                "DIAG-COMM-REF" => {
                    let link = self.link(service);
                    layer.services.extend(link.map(ServiceEntry::Shared));
                }
                // A program: its requests are those of services.
                "SINGLE-ECU-JOB" => self.register(service, Item::Other),
                other => self.issue(service, format!("{other} is not known")),
            }
        }
    }

    fn service(&mut self, node: Node<'_, '_>) -> u32 {
        let request = self.child_link(node, &["REQUEST-REF", "REQUEST-SNREF"]);
        let mut links = |group, name| {
            let nodes: Vec<_> = grouped(node, group, name).collect();
            nodes.into_iter().filter_map(|node| self.link(node)).collect::<Vec<_>>()
        };
        let service = DiagService {
            name: short_name(node),
            long_name: text(node, "LONG-NAME").unwrap_or_default(),
            request,
            responses: links("POS-RESPONSE-REFS", "POS-RESPONSE-REF"),
            refusals: links("NEG-RESPONSE-REFS", "NEG-RESPONSE-REF"),
        };
        let number = self.model.services.len() as u32;
        self.register(node, Item::Service(number));
        self.model.services.push(service);
        number
    }

    fn message(&mut self, node: Node<'_, '_>) -> u32 {
        let params = self.params(node);
        let number = self.model.messages.len() as u32;
        self.register(node, Item::Message(number));
        self.model.messages.push(Message { name: short_name(node), params });
        number
    }

    fn dictionary(&mut self, node: Node<'_, '_>, layer: &mut Layer) {
        for group in node.children().filter(Node::is_element) {
            match group.tag_name().name() {
                "TABLES" => {
                    for table in children(group, "TABLE") {
                        let table = self.table(table);
                        layer.tables.push(table);
                    }
                }
                "UNIT-SPEC" => {
                    for unit in grouped(group, "UNITS", "UNIT") {
                        let shown = text(unit, "DISPLAY-NAME").unwrap_or_else(|| short_name(unit));
                        self.register(unit, Item::Unit(self.model.units.len() as u32));
                        self.model.units.push(shown);
                    }
                }
                "ADMIN-DATA" | "SDGS" => {}
                _ => {
                    for dop in group.children().filter(Node::is_element) {
                        let dop = self.dop(dop);
                        layer.dops.push(dop);
                    }
                }
            }
        }
    }

    fn table(&mut self, node: Node<'_, '_>) -> u32 {
        let number = self.model.tables.len() as u32;
        self.register(node, Item::Table(number));
        let key = self.child_link(node, &["KEY-DOP-REF", "KEY-DOP-SNREF"]);
        let mut table = OdxTable { name: short_name(node), key, rows: Vec::new(), shared: Vec::new() };
        for row in node.children().filter(Node::is_element) {
            match row.tag_name().name() {
                "TABLE-ROW" => {
                    self.register(row, Item::Row(number, table.rows.len() as u32));
                    let content = [
                        "STRUCTURE-REF",
                        "STRUCTURE-SNREF",
                        "DATA-OBJECT-PROP-REF",
                        "DATA-OBJECT-PROP-SNREF",
                    ];
                    let content = self.child_link(row, &content);
                    table.rows.push(Row {
                        name: short_name(row),
                        long_name: text(row, "LONG-NAME").unwrap_or_default(),
                        key: text(row, "KEY").unwrap_or_default(),
                        content,
                    });
                }
                "TABLE-ROW-REF" => table.shared.extend(self.link(row)),
                _ => {}
            }
        }
        self.model.tables.push(table);
        number
    }
}
