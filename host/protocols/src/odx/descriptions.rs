//! Which description belongs to whom on a bus.

use std::sync::Arc;

use super::{Ecu, LayerKind, Odx, OdxError};
use crate::iso_tp::{Endpoint, Pair};

/// A file, and the layer that is meant.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// The file.
    pub odx: &'a Odx,
    /// The name of a layer; without one, each ECU is known by its identifiers.
    pub layer: Option<&'a str>,
}

/// Descriptions for the ECUs of a bus.
#[derive(Clone, Debug, Default)]
pub struct Descriptions {
    by_pair: Vec<(Pair, Arc<Ecu>)>,
    /// For everyone whose identifiers no description has.
    others: Option<Arc<Ecu>>,
}

impl Descriptions {
    /// Takes descriptions from files. Of ECUs with the same identifiers the first counts, a base variant before variants of it. A layer that
    /// was chosen and has no identifiers is for all that no other one is for; so is the only ECU of a file without identifiers.
    ///
    /// # Errors
    ///
    /// A layer is not there, or inherits too much; nothing says which one is meant.
    pub fn new<'a>(sources: impl IntoIterator<Item = Source<'a>>) -> Result<Self, OdxError> {
        let mut this = Self::default();
        let mut all: Vec<_> = sources.into_iter().collect();
        all.sort_by_key(|source| source.layer.is_none());
        for Source { odx, layer } in all {
            if let Some(name) = layer {
                this.add(Arc::new(odx.ecu(name)?), true);
                continue;
            }
            let mut names: Vec<_> = odx.layers().filter(|(kind, _)| kind.is_ecu()).collect();
            names.sort_by_key(|(kind, _)| *kind != LayerKind::BaseVariant);
            let ecus = names.iter().map(|(_, name)| odx.ecu(name).map(Arc::new));
            let ecus = ecus.collect::<Result<Vec<_>, _>>()?;
            let bases: Vec<_> = ecus.iter().filter(|ecu| ecu.kind() == LayerKind::BaseVariant).collect();
            let only = match (&ecus[..], &bases[..]) {
                ([one], _) => Some(one),
                (_, [one]) => Some(*one),
                _ => None,
            };
            if ecus.iter().all(|ecu| ecu.pairs().is_empty()) {
                let Some(only) = only else {
                    let layers = odx.layers().map(|(_, name)| name.to_owned()).collect();
                    return Err(OdxError::WhichLayer { layers });
                };
                this.add(only.clone(), true);
            }
            for ecu in ecus {
                this.add(ecu, false);
            }
        }
        Ok(this)
    }

    fn add(&mut self, ecu: Arc<Ecu>, is_for_others: bool) {
        for pair in ecu.pairs() {
            if !self.by_pair.iter().any(|(known, _)| known == pair) {
                self.by_pair.push((*pair, ecu.clone()));
            }
        }
        if is_for_others && ecu.pairs().is_empty() && self.others.is_none() {
            self.others = Some(ecu);
        }
    }

    /// Who answers with, or is asked by, these: the sender of responses decides where a request is for all.
    pub fn of(&self, requests: Option<Endpoint>, responses: Option<Endpoint>) -> Option<&Arc<Ecu>> {
        let is = |pair: &Pair| match (requests, responses) {
            (Some(a), Some(b)) => pair.a == a && pair.b == b,
            (Some(a), None) => pair.a == a,
            (None, Some(b)) => pair.b == b,
            (None, None) => false,
        };
        let found = self.by_pair.iter().find(|(pair, _)| is(pair));
        found.map(|(_, ecu)| ecu).or(self.others.as_ref())
    }

    /// The pairs of identifiers of its ECUs.
    pub fn pairs(&self) -> impl Iterator<Item = Pair> {
        self.by_pair.iter().map(|(pair, _)| *pair)
    }

    /// The ECUs, each once.
    pub fn ecus(&self) -> Vec<&Arc<Ecu>> {
        let mut ecus: Vec<&Arc<Ecu>> = Vec::new();
        for ecu in self.by_pair.iter().map(|(_, ecu)| ecu).chain(&self.others) {
            if !ecus.iter().any(|known| Arc::ptr_eq(known, ecu)) {
                ecus.push(ecu);
            }
        }
        ecus
    }
}
