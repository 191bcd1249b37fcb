//! Which ECUs answer, and which parameters they have: what to ask next to learn it, and what the answers say.

use std::collections::BTreeMap;
use std::time::Duration;

use cantap::Id;
use cantap_protocols::active::exchange::ServerAnswer;
use cantap_protocols::iso_tp::{Endpoint, Pair};

use super::services::Services;
use crate::uds::TransferOptions;

/// Parameters of one list; each list tells whether there is another one behind it.
const LIST: u8 = 0x20;
/// How to ask, in turn, until somebody answers: by which services, and whether with identifiers of 29 bits.
const WAYS: [(Services, bool); 4] =
    [(Services::Own, false), (Services::Own, true), (Services::OnUds, false), (Services::OnUds, true)];

/// An ECU that answers.
#[derive(Clone, Debug)]
struct Server {
    answers_with: Endpoint,
    pids: Vec<u8>,
}

/// What is known of a vehicle.
#[derive(Clone, Debug)]
pub struct Vehicle {
    p2: Duration,
    /// How to ask: the place of it.
    way: usize,
    /// Before the parameters of the next list; `None` if all were read.
    base: Option<u8>,
    servers: Vec<Server>,
}

/// The parameters of a list that starts after `base`.
fn listed(base: u8, bits: &[u8]) -> Vec<u8> {
    let bits = bits.iter().take(4).fold(0_u32, |all, byte| all << 8 | u32::from(*byte));
    (0..u32::from(LIST))
        .filter(|at| bits >> (31 - at) & 1 == 1)
        .map(|at| base.wrapping_add(at as u8 + 1))
        .collect()
}

impl Vehicle {
    /// Nothing is known yet. ECUs begin to answer within `p2`, and those that are not known do so, too.
    pub const fn new(p2: Duration) -> Self {
        Self { p2, way: 0, base: Some(0), servers: Vec::new() }
    }

    /// How it is asked.
    fn way(&self) -> (Services, bool) {
        WAYS[self.way.min(WAYS.len() - 1)]
    }

    /// By which services it is asked.
    pub fn services(&self) -> Services {
        self.way().0
    }

    /// How to address all of its ECUs.
    pub fn transfer(&self) -> TransferOptions {
        let endpoint = |id| Endpoint { id, address: None };
        let (a, b) = if self.way().1 {
            (Id::extended_truncated(0x18DA_10F1), Id::extended_truncated(0x18DA_F110))
        } else {
            (Id::standard_truncated(0x7E0), Id::standard_truncated(0x7E8))
        };
        TransferOptions::of_obd(Pair { a: endpoint(a), b: endpoint(b) }, self.p2, true)
    }

    /// The request by which to find out who answers this way; `None` if somebody does, or after the last way.
    pub fn search(&self) -> Option<Vec<u8>> {
        (self.servers.is_empty() && self.way < WAYS.len()).then(|| self.services().value(0))
    }

    /// Takes the answers to [`Self::search`].
    pub fn take_search(&mut self, answers: &[ServerAnswer]) {
        let services = self.services();
        for answer in answers {
            if let Some(bits) = services.bits(0, &answer.data) {
                self.servers.push(Server { answers_with: answer.from, pids: listed(0, bits) });
            }
        }
        if self.servers.is_empty() {
            self.way += 1;
        } else {
            self.base = Some(LIST);
        }
    }

    /// Where its ECUs answer from; empty if none has answered.
    pub fn servers(&self) -> Vec<Endpoint> {
        self.servers.iter().map(|server| server.answers_with).collect()
    }

    /// The request for the next list of parameters, and how many ECUs have that list; `None` after the last one.
    pub fn list(&self) -> Option<(Vec<u8>, usize)> {
        let base = self.base?;
        let servers = self.having(base);
        (servers > 0).then(|| (self.services().value(base), servers))
    }

    /// Takes the answers to [`Self::list`].
    pub fn take_list(&mut self, answers: &[ServerAnswer]) {
        let Some(base) = self.base else { return };
        let services = self.services();
        for answer in answers {
            let Some(bits) = services.bits(base, &answer.data) else { continue };
            if let Some(server) = self.servers.iter_mut().find(|server| server.answers_with == answer.from) {
                server.pids.extend(listed(base, bits));
            }
        }
        self.base = base.checked_add(LIST);
    }

    /// The number of ECUs that have a parameter.
    pub fn having(&self, pid: u8) -> usize {
        self.servers.iter().filter(|server| server.pids.contains(&pid)).count()
    }

    /// The parameters that there are, without lists, each with the ECUs that have it.
    pub fn parameters(&self) -> BTreeMap<u8, Vec<Endpoint>> {
        let mut all: BTreeMap<u8, Vec<Endpoint>> = BTreeMap::new();
        for server in &self.servers {
            for pid in server.pids.iter().filter(|pid| !pid.is_multiple_of(LIST)) {
                all.entry(*pid).or_default().push(server.answers_with);
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(from: u32, data: &[u8]) -> ServerAnswer {
        let from = Endpoint { id: Id::standard_truncated(from), address: None };
        ServerAnswer { from, data: data.to_vec(), pending: 0 }
    }

    #[test]
    fn lists_are_read_as_far_as_an_ecu_has_them() {
        let mut vehicle = Vehicle::new(Duration::ZERO);
        assert_eq!(vehicle.search(), Some(vec![1, 0]));
        vehicle
            .take_search(&[answer(0x7E8, &[0x41, 0, 0x80, 0, 0, 1]), answer(0x7E9, &[0x41, 0, 0, 8, 0, 0])]);
        assert_eq!((vehicle.search(), vehicle.servers().len()), (None, 2));
        // The first one alone has another list.
        assert_eq!(vehicle.list(), Some((vec![1, 0x20], 1)));
        vehicle.take_list(&[answer(0x7E8, &[0x41, 0x20, 0x40, 0, 0, 0])]);
        assert_eq!(vehicle.list(), None);
        assert_eq!(vehicle.parameters().into_keys().collect::<Vec<_>>(), [0x01, 0x0D, 0x22]);
        assert_eq!((vehicle.having(0x0D), vehicle.having(0x22), vehicle.having(0x05)), (1, 1, 0));
    }

    #[test]
    fn each_way_is_tried_once_and_an_ecu_that_has_everything_ends_the_lists() {
        let mut vehicle = Vehicle::new(Duration::ZERO);
        let mut requests = Vec::new();
        while let Some(request) = vehicle.search() {
            requests.push((request, vehicle.transfer().pair.a.id.is_extended()));
            vehicle.take_search(&[answer(0x7E8, &[0x7F, 1, 0x11])]);
        }
        let own = |is_extended| (vec![1, 0], is_extended);
        let on_uds = |is_extended| (vec![0x22, 0xF4, 0], is_extended);
        assert_eq!(requests, [own(false), own(true), on_uds(false), on_uds(true)]);
        let mut vehicle = Vehicle::new(Duration::ZERO);
        vehicle.take_search(&[answer(0x7E8, &[0x41, 0, 255, 255, 255, 255])]);
        let mut lists = 0;
        while let Some((request, _)) = vehicle.list() {
            lists += 1;
            vehicle.take_list(&[answer(0x7E8, &[0x41, request[1], 255, 255, 255, 255])]);
        }
        assert_eq!((lists, vehicle.parameters().len()), (7, 255 - 7));
    }
}
