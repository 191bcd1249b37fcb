//! The servers of a CANopen node: its object dictionary and SDO (CiA 301, 7.2.4).

mod dictionary;
mod sdo;

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

pub use self::dictionary::{MOST_OBJECT_BYTES, ObjectDictionary};
pub use self::sdo::{SdoReply, SdoServer};

use crate::active::Machine;
use crate::canopen::codec::sdo::SdoObject;
use crate::canopen::eds::Eds;

/// The client's frames, and the server's, with the node's number added (CiA 301, 7.3.5).
const REQUEST: u32 = 0x600;
const RESPONSE: u32 = 0x580;
/// How many writes may wait to be taken.
const MOST_WRITES: usize = 1024;

/// A node's dictionary, and the server through which others reach it.
#[derive(Debug)]
pub struct CanOpenServer {
    sheet: Eds,
    node: u8,
    /// Its objects.
    pub dictionary: ObjectDictionary,
    server: SdoServer,
    /// Whether it answers: a node does when it is pre-operational or operational.
    pub is_serving: bool,
    out: VecDeque<Frame>,
    written: VecDeque<SdoObject>,
}

impl CanOpenServer {
    /// A node with this number, 1 to 127, and the objects and values of a sheet.
    pub fn new(sheet: Eds, node: u8) -> Self {
        let mut made = Self {
            sheet,
            node,
            dictionary: ObjectDictionary::default(),
            server: SdoServer::default(),
            is_serving: true,
            out: VecDeque::new(),
            written: VecDeque::new(),
        };
        made.reset();
        made
    }

    /// Its number, 1 to 127.
    pub const fn node(&self) -> u8 {
        self.node
    }

    /// It has another number from now on; in its objects from the next [`Self::reset`] on.
    pub const fn set_node(&mut self, node: u8) {
        self.node = node;
    }

    /// All objects have the sheet's values again, and what was under way is over.
    pub fn reset(&mut self) {
        self.dictionary = ObjectDictionary::new(&self.sheet, self.node);
        self.server = SdoServer::default();
        self.out.clear();
        self.written.clear();
    }

    /// Takes the data of an RPDO by its mapping; returns false if it is too short.
    pub fn take_pdo(&mut self, mapping: u16, data: &[u8]) -> bool {
        let objects = self.dictionary.take_pdo(mapping, data);
        objects.map(|objects| objects.into_iter().for_each(|object| self.note(object))).is_some()
    }

    /// The next object that another node has written and nobody has taken.
    pub fn take_written(&mut self) -> Option<SdoObject> {
        self.written.pop_front()
    }

    fn note(&mut self, object: SdoObject) {
        if self.written.len() < MOST_WRITES {
            self.written.push_back(object);
        }
    }

    fn respond(&mut self, bytes: [u8; 8]) {
        let id = Id::standard_truncated(RESPONSE + u32::from(self.node));
        self.out.push_back(Frame::from_bus(id, false, 8, bytes));
    }
}

impl Machine for CanOpenServer {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        if self.server.due().is_some_and(|due_ns| due_ns <= now_ns) {
            let abort = self.server.give_up();
            self.respond(abort);
        }
        self.out.pop_front()
    }

    fn sent(&mut self, _now_ns: u64) {}

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        let is_ours = id == Id::standard_truncated(REQUEST + u32::from(self.node));
        let Ok(bytes) = data.try_into() else { return };
        if is_ours && self.is_serving {
            let SdoReply { frames, written } = self.server.take(bytes, &mut self.dictionary, now_ns);
            for frame in frames {
                self.respond(frame);
            }
            if let Some(object) = written {
                self.note(object);
            }
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        // A lost segment shows by its toggle bit or number, and the client begins again.
    }

    fn due_ns(&self) -> Option<u64> {
        self.server.due()
    }

    fn is_done(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHEET: &str = "[DeviceInfo]\nProductName=x\n[6064]\nParameterName=Position\nDataType=4\nAccessType=ro\nPDOMapping=1\n\
[6040]\nParameterName=Controlword\nDataType=6\nAccessType=rw\nPDOMapping=1\n[1600]\nParameterName=R\nObjectType=9\nSubNumber=2\n\
[1600sub0]\nParameterName=n\nDataType=5\nAccessType=rw\nDefaultValue=1\n[1600sub1]\nParameterName=m\nDataType=7\nAccessType=rw\nDefaultValue=0x60400010\n\
[1A00]\nParameterName=T\nObjectType=9\nSubNumber=3\n[1A00sub0]\nParameterName=n\nDataType=5\nAccessType=rw\nDefaultValue=2\n\
[1A00sub1]\nParameterName=m\nDataType=7\nAccessType=rw\nDefaultValue=0x60400010\n[1A00sub2]\nParameterName=m\nDataType=7\nAccessType=rw\nDefaultValue=0x60640020\n";

    #[test]
    fn pdos_carry_what_is_mapped_and_a_short_one_sets_nothing() {
        let mut node = CanOpenServer::new(Eds::parse(SHEET.as_bytes()), 5);
        node.dictionary.set_integer(0x6064, 0, -2).unwrap();
        assert_eq!(node.dictionary.integer(0x6064, 0), Ok(Some(-2)));
        assert!(node.take_pdo(0x1600, &[0x0F, 0x01]));
        assert_eq!(node.take_written(), Some(SdoObject { index: 0x6040, sub: 0 }));
        assert_eq!(node.dictionary.pdo(0x1A00), [0x0F, 0x01, 0xFE, 0xFF, 0xFF, 0xFF]);
        assert!(!node.take_pdo(0x1600, &[0x07]));
        assert_eq!((node.take_written(), node.dictionary.integer(0x6040, 0)), (None, Ok(Some(0x010F))));
    }

    #[test]
    fn a_write_is_confirmed_and_handed_over_and_a_stopped_node_is_silent() {
        let mut node = CanOpenServer::new(Eds::parse(SHEET.as_bytes()), 5);
        let write = [0x2B, 0x40, 0x60, 0, 6, 0, 0, 0];
        node.is_serving = false;
        node.hear(0, Id::standard_truncated(0x605), &write);
        assert_eq!((node.next(0), node.take_written()), (None, None));
        node.is_serving = true;
        node.hear(0, Id::standard_truncated(0x605), &write);
        assert_eq!(node.next(0).unwrap().to_string(), "585#6040600000000000");
        assert_eq!(node.take_written(), Some(SdoObject { index: 0x6040, sub: 0 }));
    }
}
