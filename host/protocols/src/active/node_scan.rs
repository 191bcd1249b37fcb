//! Finds CANopen nodes: asks each for its device type (1000), and listens to heartbeats meanwhile.

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::Machine;
use super::sdo::SdoIds;
use crate::canopen::codec::sdo::{Content, SdoObject, SdoRequest, SdoResponse, abort};

/// How many questions may wait in the sender's queue at a time.
const MOST_UNDER_WAY: usize = 8;
const DEVICE_TYPE: SdoObject = SdoObject { index: 0x1000, sub: 0 };

/// A node that was found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FoundNode {
    /// Its number, 1 to 127.
    pub node: u8,
    /// Whether it answered by SDO, even if only with a refusal.
    pub answers: bool,
    /// Its device type, if it answered with it.
    pub device_type: Option<u32>,
    /// Its state according to its heartbeat or boot-up message.
    pub state: Option<u8>,
}

/// Asks nodes, and listens.
#[derive(Debug)]
pub struct NodeScan {
    to_ask: VecDeque<u8>,
    /// Frames for nodes that began a longer transfer.
    aborts: VecDeque<Frame>,
    found: [FoundNode; 128],
    asked: [bool; 128],
    /// Nodes that were told not to go on: once, whatever they send.
    aborted: [bool; 128],
    under_way: usize,
    wait_ns: u64,
    until_ns: Option<u64>,
    started: bool,
}

impl NodeScan {
    /// Asks the nodes of a range, each 1 to 127 (none if it is empty), and listens to heartbeats of all. Ends this long after the
    /// last question.
    pub fn new(nodes: impl IntoIterator<Item = u8>, wait_ns: u64) -> Self {
        Self {
            to_ask: nodes.into_iter().filter(|node| (1..=127).contains(node)).collect(),
            aborts: VecDeque::new(),
            found: [FoundNode::default(); 128],
            asked: [false; 128],
            aborted: [false; 128],
            under_way: 0,
            wait_ns,
            until_ns: None,
            started: false,
        }
    }

    /// The nodes found, by number.
    pub fn found(&self) -> impl Iterator<Item = FoundNode> + '_ {
        let there = |node: &&FoundNode| node.answers || node.state.is_some();
        self.found.iter().filter(there).copied()
    }
}

impl Machine for NodeScan {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        if !self.started {
            self.started = true;
            self.until_ns = Some(now_ns + self.wait_ns);
        }
        if self.under_way >= MOST_UNDER_WAY {
            return None;
        }
        let frame = self.aborts.pop_front().or_else(|| {
            let node = self.to_ask.pop_front()?;
            self.asked[usize::from(node)] = true;
            Some(request(node, SdoRequest::Upload(DEVICE_TYPE)))
        });
        if frame.is_some() {
            self.under_way += 1;
        } else if self.under_way == 0 && self.until_ns.is_some_and(|until_ns| now_ns >= until_ns) {
            self.until_ns = None;
        }
        frame
    }

    fn sent(&mut self, now_ns: u64) {
        self.under_way = self.under_way.saturating_sub(1);
        self.until_ns = Some(now_ns + self.wait_ns);
    }

    fn hear(&mut self, _now_ns: u64, id: Id, data: &[u8]) {
        if id.is_extended() {
            return;
        }
        let node = (id.raw() & 0x7F) as u8;
        let place = usize::from(node);
        match (id.raw() & 0x780, data) {
            (0x700, &[state]) if node > 0 => {
                self.found[place].node = node;
                self.found[place].state = Some(state & 0x7F);
            }
            (0x580, data) if self.asked[place] && data.len() >= 4 => {
                // Some nodes leave out the bytes that mean nothing.
                let mut bytes = [0; 8];
                let Some(used) = bytes.get_mut(..data.len()) else { return };
                used.copy_from_slice(data);
                if SdoObject::decode(bytes) != DEVICE_TYPE {
                    return;
                }
                let found = &mut self.found[place];
                (found.node, found.answers) = (node, true);
                match SdoResponse::decode(bytes) {
                    Some(SdoResponse::Upload(_, Content::Expedited { bytes, length: None | Some(4) })) => {
                        found.device_type = Some(u32::from_le_bytes(bytes));
                    }
                    Some(SdoResponse::Upload(_, Content::Segmented(_)))
                        if !std::mem::replace(&mut self.aborted[place], true) =>
                    {
                        // It wants to send segments, which nobody will request.
                        self.aborts.push_back(request(node, SdoRequest::Abort(DEVICE_TYPE, abort::GENERAL)));
                    }
                    _ => {}
                }
            }
            _ => {}
        }
    }

    fn gap(&mut self, _now_ns: u64) {}

    fn due_ns(&self) -> Option<u64> {
        self.until_ns.filter(|_| self.under_way == 0 && self.to_ask.is_empty())
    }

    fn is_done(&self) -> bool {
        self.started && self.until_ns.is_none() && self.under_way == 0 && self.to_ask.is_empty()
    }
}

fn request(node: u8, request: SdoRequest) -> Frame {
    Frame::from_bus(SdoIds::of(node).request, false, 8, request.encode())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::active::testing::{Say, arrives, run};

    #[test]
    fn nodes_are_found_by_answers_and_by_heartbeats() {
        let frame = |id: u32, bytes: &[u8]| Frame::data_frame(Id::standard_truncated(id), bytes).unwrap();
        let mut aborted = false;
        let mut peer = |id: Id, data: &[u8], say: &mut Say| match (id.raw(), data[0]) {
            (0x605, _) => say.push((1000, frame(0x585, &[0x43, 0, 0x10, 0, 0x92, 1, 2, 0]))),
            (0x607, _) => say.push((1000, frame(0x587, &[0x80, 0, 0x10, 0, 0, 0, 2, 6]))),
            (0x608, 0x40) => say.push((1000, frame(0x588, &[0x41, 0, 0x10, 0, 9, 0, 0, 0]))),
            (0x608, 0x80) => aborted = true,
            (0x601, _) => {
                say.push((0, frame(0x70A, &[0x85])));
                // Another node's answer to another client's question.
                say.push((0, frame(0x590, &[0x43, 0, 0x20, 0, 0, 0, 0, 0])));
            }
            _ => {}
        };
        let mut scan = NodeScan::new(1..=127, 100_000_000);
        run(&mut scan, &mut peer, arrives);
        let found: Vec<_> = scan.found().collect();
        let node = |node, answers, device_type, state| FoundNode { node, answers, device_type, state };
        assert_eq!(
            found,
            [
                node(5, true, Some(0x0002_0192), None),
                node(7, true, None, None),
                node(8, true, None, None),
                node(10, false, None, Some(5)),
            ]
        );
        assert!(aborted);
    }

    /// A node that answers an abort with the same again.
    #[test]
    fn a_node_is_told_once_not_to_go_on() {
        let mut aborts = 0;
        let mut peer = |id: Id, data: &[u8], say: &mut Say| {
            aborts += u32::from(data[0] == 0x80);
            let answer = [0x41, 0, 0x10, 0, 9, 0, 0, 0];
            say.push((1000, Frame::data_frame(Id::standard_truncated(id.raw() - 0x80), &answer).unwrap()));
        };
        let mut scan = NodeScan::new(8..=8, 100_000_000);
        run(&mut scan, &mut peer, arrives);
        assert_eq!((scan.found().count(), aborts), (1, 1));
    }

    #[test]
    fn without_questions_it_only_listens() {
        let mut scan = NodeScan::new([], 50);
        assert_eq!(scan.next(1), None);
        scan.hear(2, Id::standard_truncated(0x703), &[127]);
        assert!(!scan.is_done());
        assert_eq!(scan.due_ns(), Some(51));
        assert_eq!(scan.next(51), None);
        assert!(scan.is_done() && scan.found().count() == 1);
    }
}
