//! `virtual:canopen`: a CANopen drive on the first bus, and another one that has no node number yet.
//!
//! Both follow from their sheet, [`SHEET`], and from the server, the slave and the state machine in this module: no frame is scripted. The
//! nodes do nothing for which the sheet has no object: they send neither SYNC nor TIME, and keep nothing across a reset.

mod node;
#[cfg(test)]
mod tests;

use cantap_protocols::canopen::codec::lss::NO_NODE;
use cantap_protocols::canopen::eds::Eds;
use cantap_wire::Frame;

use self::node::CanOpenNode;
use crate::simbus::{Senders, arbitration_field};

/// The nodes' sheet, an EDS file.
pub const SHEET: &str = include_str!("node.eds");
/// The number of the node that has one.
pub const NODE: u8 = 5;
/// The nodes' serial numbers.
const SERIALS: [u32; 2] = [1001, 1002];

/// The nodes on the bus.
#[derive(Debug)]
pub struct CanOpenBus {
    nodes: Vec<CanOpenNode>,
    /// The node whose frame is on the bus.
    sending: usize,
}

impl CanOpenBus {
    /// Both nodes, as they are when somebody starts to listen.
    pub fn in_use() -> Self {
        let sheet = Eds::parse(SHEET.as_bytes());
        let numbers = [NODE, NO_NODE].into_iter().zip(SERIALS);
        let nodes = numbers.map(|(node, serial)| CanOpenNode::new(&sheet, node, serial)).collect();
        Self { nodes, sending: 0 }
    }

    fn advance(&mut self, now_ns: u64) {
        self.nodes.iter_mut().for_each(|node| node.advance(now_ns));
    }

    /// Of the frames that are due, the one with the lowest identifier, with its node.
    fn first(&mut self, now_ns: u64) -> Option<(usize, Frame)> {
        self.advance(now_ns);
        let bids = self.nodes.iter().enumerate().filter_map(|(place, node)| {
            let (due_ns, frame) = node.bid()?;
            (due_ns <= now_ns).then_some((place, frame))
        });
        bids.min_by_key(|(_, frame)| arbitration_field(frame.id(), frame.is_remote()))
    }
}

impl Senders for CanOpenBus {
    fn due(&mut self, now_ns: u64) -> Option<u64> {
        self.advance(now_ns);
        self.nodes.iter().map(CanOpenNode::due).min().filter(|due_ns| *due_ns != u64::MAX)
    }

    fn bid(&mut self, now_ns: u64) -> Option<Frame> {
        self.first(now_ns).map(|(_, frame)| frame)
    }

    fn take(&mut self, now_ns: u64) {
        if let Some((place, _)) = self.first(now_ns) {
            self.sending = place;
            self.nodes[place].sent();
        }
    }

    fn delivered(&mut self) {}

    fn destroyed(&mut self, frame: &Frame, _now_ns: u64) {
        self.nodes[self.sending].send_again(*frame);
    }

    fn hear(&mut self, frame: &Frame, now_ns: u64) {
        self.advance(now_ns);
        self.nodes.iter_mut().for_each(|node| node.hear(frame, now_ns));
    }
}
