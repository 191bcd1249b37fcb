//! An ECU as a layer describes it: which service a message belongs to, and what it says.

use std::collections::BTreeMap;
use std::sync::Arc;

use rustc_hash::FxHashMap;

use super::coded::Stop;
use super::decode::{Reading, read};
use super::error::OdxError;
use super::layer::View;
use super::model::{DiagService, Item, LayerKind, Link, Message, Model, Name, OdxDtc};
use super::prefix::Prefix;
use crate::iso_tp::Pair;

/// Candidates for a message that are looked at.
const MOST_CANDIDATES: usize = 256;

/// A layer with everything that it inherits.
#[derive(Clone, Debug)]
pub struct Ecu {
    pub(super) model: Arc<Model>,
    pub(super) view: Arc<View>,
    pub(super) kind: LayerKind,
    name: Name,
    long_name: Name,
    pairs: Vec<Pair>,
    /// Messages by their first byte.
    requests: FxHashMap<u8, Vec<Candidate>>,
    responses: FxHashMap<u8, Vec<Candidate>>,
    dtcs: BTreeMap<u32, OdxDtc>,
}

#[derive(Clone, Copy, Debug)]
struct Candidate {
    service: u32,
    message: u32,
    prefix: Prefix,
}

/// What is known of an exchange.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Described {
    /// The service's short name; those of several that cannot be told apart, with `or` between them.
    pub service: String,
    /// Its long name; empty without one.
    pub long_name: String,
    /// The request.
    pub request: Option<Reading>,
    /// The response.
    pub response: Option<Reading>,
}

impl Ecu {
    pub(super) fn new(model: &Arc<Model>, number: u32) -> Result<Self, OdxError> {
        let view = model.view(number)?;
        let layer = &model.layers[number as usize];
        let pairs = super::addressing::pairs(model, &view);
        let mut ecu = Self {
            model: model.clone(),
            kind: layer.kind,
            name: layer.name.clone(),
            long_name: layer.long_name.clone(),
            pairs,
            requests: FxHashMap::default(),
            responses: FxHashMap::default(),
            dtcs: model.dtcs(&view),
            view,
        };
        ecu.index();
        Ok(ecu)
    }

    fn index(&mut self) {
        let (model, view) = (self.model.clone(), self.view.clone());
        for number in view.services.values() {
            let service = &model.services[*number as usize];
            let request = service.request.and_then(|link| model.message(link));
            let prefix =
                request.map(|message| Prefix::of(&model, &view, &model.messages[message as usize], None));
            if let (Some(message), Some(prefix)) = (request, prefix)
                && let Some(first) = prefix.first()
            {
                self.requests.entry(first).or_default().push(Candidate { service: *number, message, prefix });
            }
            for message in service.responses.iter().filter_map(|link| model.message(*link)) {
                let prefix = Prefix::of(&model, &view, &model.messages[message as usize], prefix);
                if let Some(first) = prefix.first() {
                    self.responses.entry(first).or_default().push(Candidate {
                        service: *number,
                        message,
                        prefix,
                    });
                }
            }
        }
    }

    /// The layer's short name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The layer's long name; empty without one.
    pub fn long_name(&self) -> &str {
        &self.long_name
    }

    /// The layer's kind.
    pub const fn kind(&self) -> LayerKind {
        self.kind
    }

    /// The identifiers on CAN of requests and responses, by its communication parameters.
    pub fn pairs(&self) -> &[Pair] {
        &self.pairs
    }

    /// How many services it has.
    pub fn service_count(&self) -> usize {
        self.view.services.len()
    }

    /// The texts of trouble codes, by number.
    pub fn trouble_codes(&self) -> impl ExactSizeIterator<Item = (u32, String)> {
        self.dtcs.iter().map(|(code, dtc)| (*code, dtc.description()))
    }

    /// What a trouble code means: of three bytes, as UDS has it.
    pub fn trouble_code(&self, code: u32) -> Option<String> {
        self.dtcs.get(&code).map(OdxDtc::description)
    }

    /// What a request and its response say, or one of them.
    pub fn describe(&self, request: Option<&[u8]>, response: Option<&[u8]>) -> Option<Described> {
        let Some(request) = request else { return self.describe_response(response?) };
        let (found, reading) = self.best(self.requests.get(request.first()?)?, request, None);
        if found.is_empty() {
            return None;
        }
        let mut described = self.named(&found);
        described.request = Some(reading);
        described.response = response.and_then(|response| {
            let mut readings =
                found.iter().map(|candidate| self.best_response(candidate.service, response, request));
            let first = readings.next()?;
            if readings.all(|other| other == first) { first } else { Some(several(response)) }
        });
        Some(described)
    }

    fn best_response(&self, service: u32, response: &[u8], request: &[u8]) -> Option<Reading> {
        let service = &self.model.services[service as usize];
        let links = service.responses.iter().chain(&service.refusals);
        let messages =
            links.filter_map(|link| self.model.message(*link)).chain(self.view.refusals.values().copied());
        let readings = messages.map(|message| self.read(message, response, Some(request)));
        readings.filter(|reading| !reading.differs()).min_by_key(Reading::misfit)
    }

    fn describe_response(&self, response: &[u8]) -> Option<Described> {
        let (found, reading) = self.best(self.responses.get(response.first()?)?, response, None);
        if found.is_empty() {
            return None;
        }
        Some(Described { response: Some(reading), ..self.named(&found) })
    }

    fn named(&self, found: &[Candidate]) -> Described {
        let services: Vec<&DiagService> =
            found.iter().map(|candidate| &self.model.services[candidate.service as usize]).collect();
        let mut names: Vec<&str> = services.iter().map(|service| &*service.name).collect();
        names.dedup();
        let long_name = if names.len() == 1 { services[0].long_name.to_string() } else { String::new() };
        Described { service: names.join(" or "), long_name, request: None, response: None }
    }

    /// The messages that fit best, and what they say. If several fit equally and do not say the same, their values are left out.
    fn best(&self, all: &[Candidate], data: &[u8], request: Option<&[u8]>) -> (Vec<Candidate>, Reading) {
        let fitting = all.iter().filter(|candidate| candidate.prefix.fits(data)).take(MOST_CANDIDATES);
        let read = fitting.map(|candidate| (*candidate, self.read(candidate.message, data, request)));
        let mut read: Vec<_> = read.filter(|(_, reading)| !reading.differs()).collect();
        let rank = |(candidate, reading): &(Candidate, Reading)| {
            (reading.misfit(), u32::MAX - candidate.prefix.mask.count_ones())
        };
        let Some(best) = read.iter().map(rank).min() else { return (Vec::new(), Reading::default()) };
        read.retain(|one| rank(one) == best);
        let is_same = read.windows(2).all(|two| two[0].1 == two[1].1);
        let candidates = read.iter().map(|(candidate, _)| *candidate).collect();
        let reading = read.swap_remove(0).1;
        (candidates, if is_same { reading } else { several(data) })
    }

    fn read(&self, message: u32, data: &[u8], request: Option<&[u8]>) -> Reading {
        read(&self.model, &self.view, &self.message(message).params, data, request)
    }

    pub(super) fn message(&self, number: u32) -> &Message {
        &self.model.messages[number as usize]
    }
}

/// What is said of a message that several services have, each with other values.
fn several(data: &[u8]) -> Reading {
    let stop = Stop::not_evaluated("several services have such messages");
    Reading { stop: Some((String::new(), stop)), undescribed: data.to_vec(), ..Reading::default() }
}

impl Model {
    /// The message that a reference leads to.
    pub fn message(&self, link: Link) -> Option<u32> {
        match self.item(link)? {
            Item::Message(message) => Some(message),
            _ => None,
        }
    }
}
