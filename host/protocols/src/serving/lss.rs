//! A slave of the layer setting services (CiA 305).

use crate::canopen::codec::lss::{Bound, LssRequest, LssResponse, NO_NODE, Part, Service, WHOLE_SCAN};

/// The slave. It is given the master's frames, and knows the node's number.
#[derive(Clone, Debug)]
pub struct LssSlave {
    /// Vendor, product, revision, serial number.
    identity: [u32; 4],
    /// Its current number.
    node: u8,
    /// The one that it will have.
    pending: u8,
    configured: bool,
    /// How many of the four parts the master has named correctly, one after the other.
    selected: usize,
    identified: usize,
    /// How far the fast scan has got.
    scanned: u8,
}

impl LssSlave {
    /// One with this vendor, product, revision and serial number, and this node's number: 1 to 127, or [`NO_NODE`] for none yet.
    pub const fn new(identity: [u32; 4], node: u8) -> Self {
        Self { identity, node, pending: node, configured: false, selected: 0, identified: 0, scanned: 0 }
    }

    /// The node's number. A node without one takes part as soon as the master has given it one and released it, which is in [`Self::take`];
    /// that of another changes with [`Self::reset`].
    pub const fn node(&self) -> u8 {
        self.node
    }

    /// Takes a frame from the master; returns the answer.
    pub fn take(&mut self, bytes: &[u8]) -> Option<[u8; 8]> {
        // All frames have 8 bytes (CiA 305, 3.2).
        let request = LssRequest::decode(bytes).filter(|_| bytes.len() == 8)?;
        if let LssRequest::SwitchGlobal(mode) = request {
            self.configured = mode == 1;
            // A node without a number takes part once it is released with one.
            if !self.configured && self.node == NO_NODE && self.pending != NO_NODE {
                self.node = self.pending;
            }
            return None;
        }
        self.respond(request).map(LssResponse::encode)
    }

    fn respond(&mut self, request: LssRequest) -> Option<LssResponse> {
        let outcome = |service, is_right: bool| {
            Some(LssResponse::Outcome { service, error: u8::from(!is_right), device_error: 0 })
        };
        match request {
            LssRequest::SwitchSelective(part, value) => {
                let place = part as usize;
                let is_right = self.selected == place && self.part(part) == value;
                self.selected = if is_right {
                    place + 1
                } else {
                    usize::from(part == Part::Vendor && self.part(Part::Vendor) == value)
                };
                if self.selected < Part::ALL.len() {
                    return None;
                }
                (self.selected, self.configured) = (0, true);
                Some(LssResponse::Selected)
            }
            LssRequest::Identify(bound, value) => {
                let place = bound as usize;
                let [vendor, product, revision, serial] = self.identity;
                let is_right = match bound {
                    Bound::Vendor => vendor == value,
                    Bound::Product => product == value,
                    Bound::LowestRevision => revision >= value,
                    Bound::HighestRevision => revision <= value,
                    Bound::LowestSerial => serial >= value,
                    Bound::HighestSerial => serial <= value,
                };
                self.identified =
                    if is_right && (place == 0 || self.identified == place) { place + 1 } else { 0 };
                (self.identified == Bound::ALL.len()).then_some(LssResponse::Identified)
            }
            LssRequest::IdentifyWithoutNumber if self.node == NO_NODE => Some(LssResponse::WithoutNumber),
            LssRequest::FastScan { value, unchecked, part, next }
                if self.node == NO_NODE && !self.configured =>
            {
                self.scan(value, unchecked, part, next)
            }
            _ if !self.configured => None,
            LssRequest::ConfigureNode(node) => {
                let is_right = matches!(node, 1..=127 | NO_NODE);
                if is_right {
                    self.pending = node;
                }
                outcome(Service::ConfigureNode, is_right)
            }
            // Table 0, without its reserved entry. The node keeps its bit rate.
            LssRequest::ConfigureBitTiming { table, index } => {
                outcome(Service::ConfigureBitTiming, table == 0 && matches!(index, 0..=4 | 6..=8))
            }
            LssRequest::Store => outcome(Service::Store, true),
            LssRequest::Inquire(part) => Some(LssResponse::Address(part, self.part(part))),
            LssRequest::InquireNode => Some(LssResponse::Node(self.node)),
            _ => None,
        }
    }

    const fn part(&self, part: Part) -> u32 {
        self.identity[part as usize]
    }

    fn scan(&mut self, value: u32, unchecked: u8, part: u8, next: u8) -> Option<LssResponse> {
        if unchecked == WHOLE_SCAN {
            self.scanned = 0;
            return Some(LssResponse::Identified);
        }
        let own = *self.identity.get(usize::from(part))?;
        if part != self.scanned || unchecked > 31 || own >> unchecked != value >> unchecked {
            return None;
        }
        self.scanned = next;
        self.configured = unchecked == 0 && next < part;
        Some(LssResponse::Identified)
    }

    /// The new number applies from the next reset.
    pub const fn reset(&mut self) {
        self.node = self.pending;
        self.configured = false;
    }
}
