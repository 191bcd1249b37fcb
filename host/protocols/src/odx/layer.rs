//! A layer as it is with everything that it inherits.

use std::collections::BTreeMap;
use std::sync::Arc;

use rustc_hash::{FxHashMap, FxHashSet};

use super::error::OdxError;
use super::model::{Comparam, DopKind, Item, Layer, Link, Model, Name, OdxDtc, ServiceEntry, Target};

/// Layers inherit from others up to this depth, of which the standard has five.
const DEEPEST: usize = 16;
/// So many names are inherited, counted once for each layer on the way.
const MOST_INHERITED: usize = 10_000_000;

/// What can be seen from a layer.
#[derive(Clone, Debug, Default)]
pub struct View {
    pub services: BTreeMap<Name, u32>,
    pub dops: FxHashMap<Name, u32>,
    pub tables: FxHashMap<Name, u32>,
    pub refusals: BTreeMap<Name, u32>,
    /// The values of communication parameters by name and protocol.
    pub comparams: BTreeMap<(Name, Option<Name>), Vec<Vec<Name>>>,
}

impl Model {
    /// The thing that a reference leads to from a layer.
    pub fn item(&self, link: Link) -> Option<Item> {
        match self.links.get(link as usize)? {
            Target::Item(item) => Some(*item),
            Target::Name(_) | Target::Missing => None,
        }
    }

    /// What a layer has: its own before what it inherits, and of that the nearest. A circle ends where it closes.
    ///
    /// # Errors
    ///
    /// It inherits more than any ECU has.
    pub fn view(&self, layer: u32) -> Result<Arc<View>, OdxError> {
        Inheritance { model: self, views: FxHashMap::default(), left: MOST_INHERITED }.view(layer, 0)
    }

    fn add_own(&self, layer: &Layer, view: &mut View) {
        for entry in &layer.services {
            let service = match entry {
                ServiceEntry::Own(service) => *service,
                ServiceEntry::Shared(link) => match self.item(*link) {
                    Some(Item::Service(service)) => service,
                    _ => continue,
                },
            };
            view.services.insert(self.services[service as usize].name.clone(), service);
        }
        view.dops.extend(layer.dops.iter().map(|dop| (self.dops[*dop as usize].name.clone(), *dop)));
        view.tables
            .extend(layer.tables.iter().map(|table| (self.tables[*table as usize].name.clone(), *table)));
        let refusals = layer.global_refusals.iter();
        view.refusals
            .extend(refusals.map(|message| (self.messages[*message as usize].name.clone(), *message)));
        let mut own: BTreeMap<_, Vec<_>> = BTreeMap::new();
        for comparam in &layer.comparams {
            let key = (self.comparam_name(comparam), comparam.protocol.clone());
            own.entry(key).or_default().push(comparam.values.clone());
        }
        view.comparams.extend(own);
    }

    /// The name of a communication parameter; that in its identifier, if the file does not have the parameter itself.
    fn comparam_name(&self, comparam: &Comparam) -> Name {
        match self.item(comparam.link) {
            Some(Item::Comparam(number)) => self.names[number as usize].clone(),
            _ => comparam.id.rfind("CP_").map_or_else(|| comparam.id.clone(), |at| comparam.id[at..].into()),
        }
    }

    /// The type that a reference leads to, as seen from a layer.
    pub fn dop(&self, view: &View, link: Link) -> Option<u32> {
        match self.links.get(link as usize)? {
            Target::Item(Item::Dop(dop)) => Some(*dop),
            Target::Name(name) => view.dops.get(name).copied(),
            _ => None,
        }
    }

    /// All trouble codes of a layer; of several texts for a code, that of the type whose name comes first.
    pub fn dtcs(&self, view: &View) -> BTreeMap<u32, OdxDtc> {
        let mut dops: Vec<_> = view.dops.iter().collect();
        dops.sort();
        let mut all = BTreeMap::new();
        self.each_dtc(dops.into_iter().map(|(_, dop)| *dop), |code, dtc| {
            all.entry(code).or_insert_with(|| dtc.clone());
        });
        all
    }

    /// A trouble code of a type, or of those that it includes.
    pub fn dtc_of(&self, dop: u32, code: u32) -> Option<OdxDtc> {
        if let DopKind::Dtcs(dtcs) = &self.dops[dop as usize].kind
            && let Some(dtc) = dtcs.codes.get(&code)
        {
            return Some(dtc.clone());
        }
        let mut found = None;
        self.each_dtc([dop].into_iter(), |of, dtc| {
            if of == code {
                found.get_or_insert(dtc);
            }
        });
        found.cloned()
    }

    /// The codes of types, each followed by those that it includes: each type once, however often and in which circles they include each other.
    fn each_dtc<'a>(
        &'a self,
        dops: impl DoubleEndedIterator<Item = u32>,
        mut take: impl FnMut(u32, &'a OdxDtc),
    ) {
        let mut left: Vec<Item> = dops.rev().map(Item::Dop).collect();
        let mut seen = FxHashSet::default();
        while let Some(item) = left.pop() {
            let (dop, only) = match item {
                Item::Dop(dop) if seen.insert(dop) => (dop, None),
                Item::Dtc(dop, code) => (dop, Some(code)),
                _ => continue,
            };
            let DopKind::Dtcs(dtcs) = &self.dops[dop as usize].kind else { continue };
            if let Some(code) = only {
                if let Some(dtc) = dtcs.codes.get(&code) {
                    take(code, dtc);
                }
                continue;
            }
            for (code, dtc) in &dtcs.codes {
                take(*code, dtc);
            }
            left.extend(dtcs.others.iter().rev().filter_map(|other| self.item(*other)));
        }
    }
}

impl OdxDtc {
    /// As a person knows it, and what it means.
    pub fn description(&self) -> String {
        let name = if self.display.is_empty() { &self.name } else { &self.display };
        if self.text.is_empty() { name.to_string() } else { format!("{name}: {}", self.text) }
    }
}

/// The layers on the way to one, each of them once.
struct Inheritance<'a> {
    model: &'a Model,
    /// `None` while it is looked at.
    views: FxHashMap<u32, Option<Arc<View>>>,
    left: usize,
}

impl Inheritance<'_> {
    fn view(&mut self, number: u32, depth: usize) -> Result<Arc<View>, OdxError> {
        if depth == DEEPEST {
            return Err(OdxError::Inheritance);
        }
        let layer = match self.views.get(&number) {
            Some(known) => return Ok(known.clone().unwrap_or_default()),
            None => &self.model.layers[number as usize],
        };
        self.views.insert(number, None);
        let mut view = View::default();
        let layer_of = |link| match self.model.item(link) {
            Some(Item::Layer(layer)) => Some(layer),
            _ => None,
        };
        let imports: Vec<_> = layer.imports.iter().filter_map(|link| layer_of(*link)).collect();
        // Those of the nearer kind last, since they override.
        let mut parents: Vec<_> =
            layer.parents.iter().filter_map(|parent| Some((layer_of(parent.layer)?, parent))).collect();
        parents.sort_by_key(|(layer, _)| self.model.layers[*layer as usize].kind);
        for import in imports {
            let imported = self.view(import, depth + 1)?;
            view.dops.extend(imported.dops.clone());
            view.tables.extend(imported.tables.clone());
        }
        for (parent, without) in parents {
            let inherited = self.view(parent, depth + 1)?;
            let of = |names: &'_ [Name], name: &Name| !names.contains(name);
            let services = inherited.services.iter().filter(|(name, _)| of(&without.without_services, name));
            view.services.extend(services.map(|(name, service)| (name.clone(), *service)));
            let dops = inherited.dops.iter().filter(|(name, _)| of(&without.without_dops, name));
            view.dops.extend(dops.map(|(name, dop)| (name.clone(), *dop)));
            let tables = inherited.tables.iter().filter(|(name, _)| of(&without.without_tables, name));
            view.tables.extend(tables.map(|(name, table)| (name.clone(), *table)));
            let refusals = inherited.refusals.iter().filter(|(name, _)| of(&without.without_refusals, name));
            view.refusals.extend(refusals.map(|(name, refusal)| (name.clone(), *refusal)));
            view.comparams.extend(inherited.comparams.clone());
        }
        self.model.add_own(layer, &mut view);
        let size = view.services.len() + view.dops.len() + view.tables.len() + view.comparams.len();
        self.left = self.left.checked_sub(size).ok_or(OdxError::Inheritance)?;
        let view = Arc::new(view);
        self.views.insert(number, Some(view.clone()));
        Ok(view)
    }
}
