//! What nodes of Cyphal tell about their subjects: registers `uavcan.pub.NAME.id` and `uavcan.pub.NAME.type` (and `sub`) have number
//! and data type.

use rustc_hash::FxHashMap;

use super::header::{Header, Purpose};
use crate::dsdl::{DataTypes, Definition, Generation};
use crate::{Event, EventKind, Party, Protocol, Value};

/// How many ports are remembered.
const MOST_PORTS: usize = 4096;

/// By channel, node, and the register's name without its last part.
#[derive(Debug, Default)]
pub struct Registers {
    ports: FxHashMap<(u8, Party, String), Port>,
    /// The names of types by channel and subject.
    subjects: FxHashMap<(u8, u16), String>,
}

#[derive(Clone, Debug, Default)]
struct Port {
    number: Option<u16>,
    kind: Option<String>,
}

impl Registers {
    /// Takes a response to an access to a register.
    pub fn take(&mut self, event: &Event) {
        let is_access = event.protocol == Protocol::Cyphal
            && event.kind == EventKind::Exchange
            && event.title.starts_with("uavcan.register.Access.");
        let Some(Value::Text(name)) = event.field("request.name.name").map(|field| &field.value) else {
            return;
        };
        let Some((port, what)) = name.rsplit_once('.').filter(|_| is_access) else { return };
        if !port.starts_with("uavcan.pub.") && !port.starts_with("uavcan.sub.") {
            return;
        }
        let key = (event.channel, event.to, port.to_owned());
        if self.ports.len() >= MOST_PORTS && !self.ports.contains_key(&key) {
            return;
        }
        let port = self.ports.entry(key).or_default();
        match what {
            "id" => {
                let value = event.field("value.natural16.value[0]").and_then(|field| field.value.as_number());
                port.number = value.map(|value| value as u16);
            }
            "type" => {
                if let Some(Value::Text(kind)) = event.field("value.string.value").map(|field| &field.value) {
                    port.kind = Some(kind.to_string());
                }
            }
            _ => return,
        }
        if let Port { number: Some(number), kind: Some(kind) } = port {
            self.subjects.insert((event.channel, *number), kind.clone());
        }
    }

    /// The type of a message, as a node has told it.
    pub fn type_of<'a>(&self, channel: u8, header: Header, types: &'a DataTypes) -> Option<&'a Definition> {
        if self.subjects.is_empty() || header.purpose != Purpose::Message {
            return None;
        }
        types.of(Generation::Cyphal).named(self.subjects.get(&(channel, header.port))?)
    }
}
