//! SDO channels beyond the first of each node: their identifiers by the sheets, or as transfers that were heard set or told them.
//!
//! Objects 1200 to 127F say with which identifiers a node serves, 1280 to 12FF with which it asks which other (CiA 301, 7.5.2.33 and
//! 7.5.2.34).

use std::collections::BTreeMap;

use rustc_hash::FxHashMap;

use super::eds::Eds;

/// Parameter objects that are kept of one bus: a tenth of what 127 nodes can have.
const MOST_PARAMETERS: usize = 4096;
/// The COB-ID is not in use, or has 29 bits (CiA 301, table 71).
const NOT_STANDARD: u32 = 0xA000_0000;

/// What a frame with an identifier of such a channel is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SdoChannel {
    /// The node that serves.
    pub node: u8,
    /// The identifier of requests, which names the channel.
    pub request: u16,
    pub from_client: bool,
}

/// Those of one bus.
#[derive(Clone, Debug, Default)]
pub struct SdoChannels {
    /// Sub-indices 1 to 3, by the object's index and the node that has it: servers first, since they know their own identifiers.
    parameters: BTreeMap<(u16, u8), [Option<u32>; 3]>,
    by_id: FxHashMap<u16, SdoChannel>,
}

impl SdoChannels {
    /// Takes what a node's sheet says. Where the sheet is not `of_the_node` alone, only identifiers that its number is a part of.
    pub fn add_sheet(&mut self, eds: &Eds, node: u8, of_the_node: bool) {
        for (&index, object) in eds.objects.range(0x1200..=0x12FF) {
            for sub in 1..=3 {
                let Some(entry) = object.entries.get(&sub) else { continue };
                let is_own = of_the_node || entry.value.to_ascii_uppercase().contains("$NODEID");
                if let Some(value) = eds.value_of(index, sub, node).filter(|_| is_own) {
                    self.keep(node, index, sub, value);
                }
            }
        }
        self.renew();
    }

    /// Takes what an object of a node was heard to be.
    pub fn learn(&mut self, node: u8, index: u16, sub: u8, data: &[u8]) {
        let value = match (sub, data) {
            (1 | 2, &[a, b, c, d]) => u32::from_le_bytes([a, b, c, d]),
            // Also where its size was not said.
            (3, &[server] | &[server, _, _, _]) => server.into(),
            _ => return,
        };
        if (0x1200..=0x12FF).contains(&index) {
            self.keep(node, index, sub, value);
            self.renew();
        }
    }

    /// The channel that has this identifier.
    pub fn find(&self, id: u16) -> Option<SdoChannel> {
        if self.by_id.is_empty() { None } else { self.by_id.get(&id).copied() }
    }

    fn keep(&mut self, node: u8, index: u16, sub: u8, value: u32) {
        let key = (index, node);
        if self.parameters.len() < MOST_PARAMETERS || self.parameters.contains_key(&key) {
            self.parameters.entry(key).or_default()[usize::from(sub) - 1] = Some(value);
        }
    }

    fn renew(&mut self) {
        self.by_id.clear();
        for (&(index, holder), &parameter) in &self.parameters {
            let [Some(request), Some(response), server] = parameter else { continue };
            let node = if index < 0x1280 { u32::from(holder) } else { server.unwrap_or_default() };
            if (request | response) & NOT_STANDARD != 0 || !(1..=127).contains(&node) {
                continue;
            }
            let (request, response) = ((request & 0x7FF) as u16, (response & 0x7FF) as u16);
            // The first one needs no telling, and identifiers below 080 are not SDO's to have.
            let is_first = (request, response) == (0x600 + node as u16, 0x580 + node as u16);
            if is_first || request == response || request.min(response) <= 0x80 {
                continue;
            }
            for (id, from_client) in [(request, true), (response, false)] {
                // Of two that claim one identifier, the first has it.
                self.by_id.entry(id).or_insert(SdoChannel { node: node as u8, request, from_client });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_is_known_when_both_identifiers_are_and_forgotten_when_one_is_switched_off() {
        let mut channels = SdoChannels::default();
        channels.learn(5, 0x1201, 1, &0x645_u32.to_le_bytes());
        assert_eq!(channels.find(0x645), None);
        channels.learn(5, 0x1201, 2, &0x5C5_u32.to_le_bytes());
        assert_eq!(channels.find(0x645), Some(SdoChannel { node: 5, request: 0x645, from_client: true }));
        assert_eq!(channels.find(0x5C5), Some(SdoChannel { node: 5, request: 0x645, from_client: false }));
        channels.learn(5, 0x1201, 1, &0x8000_0645_u32.to_le_bytes());
        assert_eq!(channels.find(0x5C5), None);
        // A client says whom it asks, and the first channel of a node stays what it is.
        channels.learn(9, 0x1280, 1, &0x646_u32.to_le_bytes());
        channels.learn(9, 0x1280, 2, &0x5C6_u32.to_le_bytes());
        assert_eq!(channels.find(0x646), None);
        channels.learn(9, 0x1280, 3, &[6]);
        assert_eq!(channels.find(0x5C6).map(|channel| channel.node), Some(6));
        channels.learn(9, 0x1281, 1, &0x606_u32.to_le_bytes());
        channels.learn(9, 0x1281, 2, &0x586_u32.to_le_bytes());
        channels.learn(9, 0x1281, 3, &[6]);
        assert_eq!(channels.find(0x606), None);
    }

    /// In whatever order they were heard: servers before clients, lower indices and nodes first.
    #[test]
    fn of_two_that_claim_one_identifier_the_same_one_always_has_it() {
        let claims = [
            (9, 0x1280, Some(6)),
            (7, 0x1201, None),
            (5, 0x1201, None),
            (4, 0x1202, None),
            (3, 0x1281, Some(2)),
        ];
        for first in 0..claims.len() {
            let mut channels = SdoChannels::default();
            for (node, index, server) in claims.iter().cycle().skip(first).take(claims.len()) {
                // The responses are their own.
                let response = 0x5C0 + u32::from(*node);
                channels.learn(*node, *index, 1, &0x645_u32.to_le_bytes());
                channels.learn(*node, *index, 2, &response.to_le_bytes());
                if let Some(server) = server {
                    channels.learn(*node, *index, 3, &[*server]);
                }
            }
            assert_eq!(channels.find(0x645).map(|channel| channel.node), Some(5), "{first}");
        }
    }
}
