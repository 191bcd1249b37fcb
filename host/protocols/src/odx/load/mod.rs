//! From XML to the model: documents one after another, then what they refer to.

mod cdd;
mod dops;
mod layers;
mod params;

use cantap_signals::text_places::{Lines, check_entities};
use roxmltree::{Document, Node, ParsingOptions};
use rustc_hash::FxHashMap;

use super::error::{Issue, OdxError};
use super::model::{Item, Link, Model, Name, Target};
use super::xml::{attribute, children, content, grouped, short_name};

/// So many issues are listed; the others are counted.
const MOST_ISSUES: usize = 1000;
/// So many elements and texts a document may have: about what `MOST_BYTES` of ordinary ODX have.
const MOST_NODES: u32 = 16_000_000;

/// A reference that waits for all documents to be read.
struct Wanted {
    id: Name,
    /// The document that it names.
    document: Option<Name>,
    /// Where it is: its layer and its container.
    home: [u32; 2],
    file: usize,
    line: u32,
    /// Nothing is missing without it.
    is_optional: bool,
}

/// Reads documents.
#[derive(Default)]
pub struct Loader {
    pub model: Model,
    pub issues: Vec<Issue>,
    pub left_out: usize,
    /// Identifiers, by the layer or container in which they are.
    ids: FxHashMap<(u32, Name), Item>,
    documents: FxHashMap<Name, u32>,
    /// One for each link; `None` for those by name.
    wanted: Vec<Option<Wanted>>,
    known: FxHashMap<(Name, Option<Name>, [u32; 2]), Link>,
    by_name: FxHashMap<Name, Link>,
    files: Vec<String>,
    /// Where each line of the document begins.
    lines: Lines,
    container: u32,
    layer: u32,
}

impl Loader {
    /// Reads a document.
    pub fn document(&mut self, name: &str, text: &str) -> Result<(), OdxError> {
        let no_xml = |reason: String| OdxError::Xml { document: name.to_owned(), reason };
        check_entities(text).map_err(|error| no_xml(error.to_string()))?;
        let options =
            ParsingOptions { allow_dtd: true, nodes_limit: MOST_NODES, ..ParsingOptions::default() };
        let document = Document::parse_with_options(text, options).map_err(|error| match error {
            roxmltree::Error::NodesLimitReached => OdxError::TooLarge,
            error => no_xml(error.to_string()),
        })?;
        self.files.push(cantap_trace::clean::line(name).into_owned());
        self.lines = Lines::of(text);
        let root = document.root_element();
        if root.tag_name().name() == "CANDELA" {
            self.candela(root);
            return Ok(());
        }
        if root.tag_name().name() != "ODX" {
            // The package's index, or another kind of file.
            self.issue(root, format!("a document of {}, not of ODX", root.tag_name().name()));
            return Ok(());
        }
        let version = attribute(root, "MODEL-VERSION").unwrap_or("none");
        if !version.starts_with("2.") {
            self.issue(root, format!("ODX of version {version}; versions 2.0 to 2.2 are known"));
        }
        for part in root.children().filter(Node::is_element) {
            self.container = self.document_number(&short_name(part));
            self.layer = self.container;
            match part.tag_name().name() {
                "DIAG-LAYER-CONTAINER" => self.container(part),
                "COMPARAM-SUBSET" => self.comparams(part),
                // Communication parameters of whole stacks, vehicles, flash data, jobs, configurations, functions: none has messages.
                "COMPARAM-SPEC"
                | "VEHICLE-INFO-SPEC"
                | "FLASH"
                | "MULTIPLE-ECU-JOB-SPEC"
                | "ECU-CONFIG"
                | "FUNCTION-DICTIONARY" => {}
                other => self.issue(part, format!("{other} is not known")),
            }
        }
        Ok(())
    }

    fn container(&mut self, container: Node<'_, '_>) {
        for group in container.children().filter(Node::is_element) {
            match group.tag_name().name() {
                "PROTOCOLS" | "FUNCTIONAL-GROUPS" | "ECU-SHARED-DATAS" | "BASE-VARIANTS" | "ECU-VARIANTS" => {
                    for layer in group.children().filter(Node::is_element) {
                        self.layer(layer);
                    }
                }
                "SHORT-NAME" | "LONG-NAME" | "DESC" | "ADMIN-DATA" | "COMPANY-DATAS" | "SDGS" => {}
                other => self.issue(group, format!("{other} is not known")),
            }
        }
    }

    fn comparams(&mut self, subset: Node<'_, '_>) {
        for param in grouped(subset, "COMPARAMS", "COMPARAM") {
            self.named(param, Item::Comparam);
        }
        for param in grouped(subset, "COMPLEX-COMPARAMS", "COMPLEX-COMPARAM") {
            let Item::Comparam(number) = self.named(param, Item::Comparam) else { continue };
            let parts = children(param, "COMPARAM").map(short_name).collect();
            self.model.complex.insert(number, parts);
        }
    }

    /// Registers something of which only the name counts.
    pub fn named(&mut self, node: Node<'_, '_>, item: fn(u32) -> Item) -> Item {
        let item = item(self.model.names.len() as u32);
        self.model.names.push(short_name(node));
        self.register(node, item);
        item
    }

    /// Makes something known by its identifier, if it has one.
    pub fn register(&mut self, node: Node<'_, '_>, item: Item) {
        if let Some(id) = attribute(node, "ID") {
            for document in [self.container, self.layer] {
                self.ids.insert((document, id.into()), item);
            }
        }
    }

    fn document_number(&mut self, name: &Name) -> u32 {
        let next = self.documents.len() as u32;
        *self.documents.entry(name.clone()).or_insert(next)
    }

    /// The reference in a child element `X-REF` or `X-SNREF`.
    pub fn child_link(&mut self, node: Node<'_, '_>, names: &[&str]) -> Option<Link> {
        let is_one = |child: &Node<'_, '_>| names.contains(&child.tag_name().name());
        let found = node.children().filter(Node::is_element).find(is_one)?;
        self.link(found)
    }

    /// The reference that an element is.
    pub fn link(&mut self, node: Node<'_, '_>) -> Option<Link> {
        self.link_or_not(node, false)
    }

    /// The reference that an element is; one that is optional may lead nowhere.
    pub fn link_or_not(&mut self, node: Node<'_, '_>, is_optional: bool) -> Option<Link> {
        if let Some(id) = attribute(node, "ID-REF") {
            let document: Option<Name> = attribute(node, "DOCREF").map(Into::into);
            let home = [self.layer, self.container];
            let key = (Name::from(id), document.clone(), home);
            if let Some(link) = self.known.get(&key) {
                return Some(*link);
            }
            let (file, line) = (self.files.len() - 1, self.line(node));
            let link = self.model.links.len() as Link;
            self.model.links.push(Target::Missing);
            self.wanted.push(Some(Wanted { id: id.into(), document, home, file, line, is_optional }));
            self.known.insert(key, link);
            return Some(link);
        }
        let name = attribute(node, "SHORT-NAME");
        if name.is_none() {
            self.issue(node, format!("{} refers to nothing", node.tag_name().name()));
        }
        Some(self.name_link(&Name::from(name?)))
    }

    /// A reference by name.
    pub fn name_link(&mut self, name: &Name) -> Link {
        if let Some(link) = self.by_name.get(name) {
            return *link;
        }
        let link = self.model.links.len() as Link;
        self.model.links.push(Target::Name(name.clone()));
        self.wanted.push(None);
        self.by_name.insert(name.clone(), link);
        link
    }

    fn line(&self, node: Node<'_, '_>) -> u32 {
        self.lines.line(node.range().start)
    }

    /// Something at this place is not understood.
    pub fn issue(&mut self, node: Node<'_, '_>, what: impl AsRef<str>) {
        if self.issues.len() >= MOST_ISSUES {
            self.left_out += 1;
            return;
        }
        let line = self.line(node);
        let file = self.files.last().cloned().unwrap_or_default();
        self.issues.push(Issue { file, line, what: cantap_trace::clean::line(what.as_ref()).into_owned() });
    }

    /// All documents are read: every reference gets what it refers to.
    pub fn resolve(&mut self) {
        for (link, wanted) in self.wanted.iter().enumerate() {
            let Some(wanted) = wanted else { continue };
            let homes = match &wanted.document {
                Some(name) => [self.documents.get(name).copied(), None],
                None => wanted.home.map(Some),
            };
            let found = homes.into_iter().flatten().find_map(|home| self.ids.get(&(home, wanted.id.clone())));
            match found {
                Some(item) => self.model.links[link] = Target::Item(*item),
                None if wanted.is_optional => {}
                None if self.issues.len() < MOST_ISSUES => {
                    let document = wanted.document.as_deref().map(|name| format!(" of {name}"));
                    let what = format!("{}{} is not in this file", wanted.id, document.unwrap_or_default());
                    let what = cantap_trace::clean::line(&what).into_owned();
                    self.issues.push(Issue {
                        file: self.files[wanted.file].clone(),
                        line: wanted.line,
                        what,
                    });
                }
                None => self.left_out += 1,
            }
        }
    }
}

/// The texts of short-name references in a group, as NOT-INHERITED-DIAG-COMMS.
fn names_in(node: Node<'_, '_>, group: &'static str) -> Vec<Name> {
    let all = children(node, group).flat_map(|group| group.descendants());
    all.filter_map(|node| attribute(node, "SHORT-NAME")).map(Into::into).collect()
}

/// All texts of elements with this name in a node, in order.
fn texts(node: Node<'_, '_>, name: &'static str) -> Vec<Name> {
    node.descendants()
        .filter(|node| node.is_element() && node.tag_name().name() == name)
        .map(content)
        .collect()
}
