//! Which of two dialects a server speaks, UDS or KWP2000, by what it answers.
//!
//! They share numbers of services with different names and contents. A service that only one of them has is evidence, but servers of
//! UDS often kept one or two of KWP2000's for older testers: so what a server answers is weighed, and whatever comes later can turn it.

use rustc_hash::FxHashMap;

use super::names;
use crate::iso_tp::Endpoint;

/// How many servers are kept.
const MOST_SERVERS: usize = 1024;
/// No server is further from turning than this.
const FARTHEST: i8 = 8;

/// Stop of the session and the communication, and data rates: a server of UDS may have kept them.
const KEPT_BY_SERVERS_OF_UDS: [u8; 4] = [0x20, 0x26, 0x81, 0x82];
/// The service is not supported, or not in this session.
const UNKNOWN_SERVICE: [u8; 2] = [0x11, 0x7F];

/// The balance of each server: above 0 it speaks KWP2000.
#[derive(Clone, Debug, Default)]
pub struct Dialects {
    servers: FxHashMap<(u8, Endpoint), i8>,
}

impl Dialects {
    /// Whether one of these two speaks KWP2000, to the other.
    pub fn is_kwp(&self, channel: u8, side: Endpoint, other: Option<Endpoint>) -> bool {
        let is_kwp = |side| self.servers.get(&(channel, side)).is_some_and(|balance| *balance > 0);
        !self.servers.is_empty() && (is_kwp(side) || other.is_some_and(is_kwp))
    }

    /// A server is taken to speak KWP2000 until it shows something else.
    pub fn assume_kwp(&mut self, channel: u8, server: Endpoint) {
        if self.servers.len() < MOST_SERVERS {
            self.servers.entry((channel, server)).or_insert(1);
        }
    }

    /// A server has answered this request.
    pub fn learn(&mut self, channel: u8, server: Endpoint, request: &[u8], response: &[u8]) {
        let weight = weight(request, response);
        if weight == 0 || self.servers.len() >= MOST_SERVERS && !self.servers.contains_key(&(channel, server))
        {
            return;
        }
        let balance = self.servers.entry((channel, server)).or_default();
        // A refusal does not outweigh what an answer has shown.
        if response.first() != Some(&0x7F) || *balance == 0 {
            *balance = balance.saturating_add(weight).clamp(-FARTHEST, FARTHEST);
        }
    }
}

/// How much an exchange speaks for KWP2000; below 0 for UDS.
fn weight(request: &[u8], response: &[u8]) -> i8 {
    match (request, response) {
        // It has the service.
        (&[sid, ..], &[0x7F, _, nrc, ..]) => {
            let is_known = names::kwp_only_service(sid).is_some() && !KEPT_BY_SERVERS_OF_UDS.contains(&sid);
            i8::from(is_known && !UNKNOWN_SERVICE.contains(&nrc))
        }
        // Sessions of KWP2000 have numbers above 80; UDS has a bit there that responses do not repeat. Some servers of UDS have such
        // sessions all the same (Renault's C0).
        (_, [0x50, 0x80..=0xFF, ..]) => 4,
        // UDS has the times of the session here.
        (_, [0x50, _, _, _, _, _]) => -FARTHEST,
        // ReadDTCInformation, which KWP2000 does not have.
        (&[0x19, report, ..], &[0x59, repeated, ..]) if report == repeated => -FARTHEST,
        (&[0x3E, 0x00 | 0x80], [0x7E, 0x00]) => -1,
        (&[sid, ..], _) if names::kwp_only_service(sid).is_some() => {
            if KEPT_BY_SERVERS_OF_UDS.contains(&sid) { 0 } else { 2 }
        }
        _ => 0,
    }
}

#[cfg(test)]
mod tests {
    use cantap_trace::Id;

    use super::*;

    #[test]
    fn a_server_is_known_by_its_answers_and_may_turn() {
        let server = Endpoint { id: Id::standard_truncated(0x7E8), address: None };
        let mut dialects = Dialects::default();
        let mut after = |request: &[u8], response: &[u8]| {
            dialects.learn(1, server, request, response);
            dialects.is_kwp(1, server, None)
        };
        assert!(!after(&[0x20], &[0x60]));
        assert!(!after(&[0x18, 0], &[0x7F, 0x18, 0x11]));
        assert!(after(&[0x21, 1], &[0x61, 1, 0x41]));
        assert!(!after(&[0x19, 2, 8], &[0x59, 2, 0xFF]), "UDS alone has it");
        assert!(!after(&[0x21, 1], &[0x61, 1, 0x41]), "one old service does not outweigh it");
        assert!(!after(&[0x18, 0], &[0x7F, 0x18, 0x31]));
        assert!(!after(&[0x10, 0xC0], &[0x50, 0xC0]));
        assert!((0..4).any(|_| after(&[0x21, 1], &[0x61, 1])), "many do");
        assert!(!after(&[0x10, 3], &[0x50, 3, 0, 50, 1, 0xF4]));
    }

    #[test]
    fn servers_are_bounded() {
        let mut dialects = Dialects::default();
        for number in 0..10_000 {
            let server = Endpoint { id: Id::extended_truncated(number), address: None };
            dialects.learn(1, server, &[0x21, 1], &[0x61, 1]);
        }
        assert_eq!(dialects.servers.len(), MOST_SERVERS);
    }
}
