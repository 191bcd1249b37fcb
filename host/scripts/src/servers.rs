//! What answers on the bus for a script: it calls the script's functions for their answers.

use std::collections::BTreeMap;

use cantap_can::{Channel, Frame};
use cantap_protocols::active::{Machine, earlier};
use cantap_protocols::canopen::codec::sdo::SdoObject;
use cantap_protocols::serving::canopen::{CanOpenServer, ObjectDictionary};
use cantap_protocols::serving::devicenet::{DeviceNetServer, ExplicitRequest};
use cantap_protocols::serving::iso_tp::{IsoTpServer, ServerRequest};
use cantap_protocols::serving::j1939::{GroupRequest, J1939Node};
use rhai::{Dynamic, FnPtr, Map};

use crate::byte_functions::data_of;
use crate::script_result::Result;

/// The address of J1939 nodes without one.
const NULL: u8 = 254;
/// The address of all.
const GLOBAL: u8 = 255;
/// The priority of J1939's messages unless said otherwise (J1939-21, 5.2.1).
const PRIORITY: u8 = 6;

/// A server of one kind.
#[derive(Debug)]
pub enum Server {
    /// Diagnostics over ISO-TP: the function gets a request and returns the response.
    IsoTp(IsoTpServer, FnPtr),
    /// A J1939 node: functions by group, for requests and for messages.
    J1939 {
        /// The node.
        node: J1939Node,
        /// They return the group's data.
        requests: BTreeMap<u32, FnPtr>,
        /// They get a message.
        messages: BTreeMap<u32, FnPtr>,
    },
    /// A CANopen node's dictionary: functions by object, which get the value that was written.
    CanOpen {
        /// The dictionary and its server.
        server: CanOpenServer,
        /// By index and sub-index.
        writes: BTreeMap<(u16, u8), FnPtr>,
    },
    /// A DeviceNet slave's explicit messages: the function gets a request and returns the response.
    DeviceNet(DeviceNetServer, FnPtr),
}

impl Server {
    fn machine(&mut self) -> &mut dyn Machine {
        match self {
            Self::IsoTp(server, _) => server,
            Self::J1939 { node, .. } => node,
            Self::CanOpen { server, .. } => server,
            Self::DeviceNet(server, _) => server,
        }
    }

    fn due_ns(&self) -> Option<u64> {
        match self {
            Self::IsoTp(server, _) => server.due_ns(),
            Self::J1939 { node, .. } => node.due_ns(),
            Self::CanOpen { server, .. } => server.due_ns(),
            Self::DeviceNet(server, _) => server.due_ns(),
        }
    }
}

/// A function of the script that is to be called.
#[derive(Debug)]
pub struct Call {
    place: usize,
    /// The function.
    pub function: FnPtr,
    /// What it gets.
    pub arguments: Vec<Dynamic>,
    then: Then,
}

/// What becomes of a function's result.
#[derive(Debug)]
enum Then {
    Response(ServerRequest),
    Group(GroupRequest),
    Explicit(ExplicitRequest),
    Nothing,
}

#[derive(Debug)]
struct Attached {
    channel: Channel,
    /// For the log.
    name: String,
    server: Server,
}

/// A script's servers, by their place.
#[derive(Debug, Default)]
pub struct Servers(Vec<Attached>);

impl Servers {
    /// One more; returns its place.
    pub fn add(&mut self, channel: Channel, name: String, server: Server) -> usize {
        self.0.push(Attached { channel, name, server });
        self.0.len() - 1
    }

    /// How many there are.
    pub const fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there is none.
    pub const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The one at this place, which [`Self::add`] has returned.
    pub fn get(&mut self, place: usize) -> Option<&mut Server> {
        self.0.get_mut(place).map(|attached| &mut attached.server)
    }

    /// Another node's data frame was on the bus.
    pub fn hear(&mut self, now_ns: u64, channel: Channel, frame: &Frame) {
        for attached in self.0.iter_mut().filter(|attached| attached.channel == channel) {
            attached.server.machine().hear(now_ns, frame.id(), frame.data());
        }
    }

    /// Frames are missing.
    pub fn gap(&mut self, now_ns: u64) {
        self.0.iter_mut().for_each(|attached| attached.server.machine().gap(now_ns));
    }

    /// The oldest frame of a server was on the bus.
    pub fn sent(&mut self, place: usize, now_ns: u64) {
        if let Some(server) = self.get(place) {
            server.machine().sent(now_ns);
        }
    }

    /// The next frame to send now, and whose it is.
    pub fn next(&mut self, now_ns: u64) -> Option<(usize, Channel, Frame)> {
        self.0.iter_mut().enumerate().find_map(|(place, attached)| {
            Some((place, attached.channel, attached.server.machine().next(now_ns)?))
        })
    }

    /// When one of them has something to do.
    pub fn due_ns(&self) -> Option<u64> {
        self.0.iter().fold(None, |due_ns, attached| earlier(due_ns, attached.server.due_ns()))
    }

    /// What went wrong, for the user.
    pub fn take_trouble(&mut self) -> Option<String> {
        self.0.iter_mut().find_map(|Attached { name, server, .. }| {
            let trouble = match server {
                Server::IsoTp(server, _) => server.take_trouble()?.to_string(),
                Server::J1939 { node, .. } => node.take_trouble()?.to_string(),
                Server::CanOpen { .. } | Server::DeviceNet(..) => return None,
            };
            Some(format!("{name}: {trouble}"))
        })
    }

    /// The function to call for what others ask.
    pub fn take_call(&mut self) -> Option<Call> {
        self.0.iter_mut().enumerate().find_map(|(place, attached)| {
            let (function, arguments, then) = match &mut attached.server {
                Server::IsoTp(server, function) => {
                    let request = server.take_request()?;
                    let arguments = vec![Dynamic::from_blob(request.data.clone())];
                    (function.clone(), arguments, Then::Response(request))
                }
                Server::J1939 { node, requests, messages } => {
                    group_call(node, requests).or_else(|| message_call(node, messages))?
                }
                Server::CanOpen { server, writes } => write_call(server, writes)?,
                Server::DeviceNet(server, function) => {
                    let request = server.take_request()?;
                    let mut map = Map::new();
                    map.insert("from".into(), Dynamic::from(i64::from(request.from)));
                    map.insert("unconnected".into(), Dynamic::from(request.unconnected));
                    map.insert("data".into(), Dynamic::from_blob(request.data.clone()));
                    (function.clone(), vec![Dynamic::from_map(map)], Then::Explicit(request))
                }
            };
            Some(Call { place, function, arguments, then })
        })
    }

    /// What the script's function has returned.
    pub fn answer(&mut self, call: Call, result: Dynamic) -> Result<()> {
        match (self.get(call.place), call.then) {
            (Some(Server::IsoTp(server, _)), Then::Response(request)) => {
                server.answer(&request, data_of(result)?);
                Ok(())
            }
            (Some(Server::J1939 { node, .. }), Then::Group(request)) if result.is_bool() => {
                if result.as_bool() == Ok(true) {
                    node.acknowledge(request);
                } else {
                    node.refuse(request);
                }
                Ok(())
            }
            // Nothing: the function has sent it itself.
            (Some(Server::J1939 { node, .. }), Then::Group(request)) if !result.is_unit() => {
                let to = if request.to_all { GLOBAL } else { request.from };
                node.send(request.pgn, to, PRIORITY, data_of(result)?)
                    .map_err(|error| error.to_string().into())
            }
            (Some(Server::DeviceNet(server, _)), Then::Explicit(request)) => {
                server.answer(&request, data_of(result)?);
                Ok(())
            }
            _ => Ok(()),
        }
    }
}

type Wanted = (FnPtr, Vec<Dynamic>, Then);

/// For the next request for a group that the node has; others are refused.
fn group_call(node: &mut J1939Node, functions: &BTreeMap<u32, FnPtr>) -> Option<Wanted> {
    loop {
        let request = node.take_request()?;
        match functions.get(&request.pgn) {
            Some(function) => return Some((function.clone(), Vec::new(), Then::Group(request))),
            None => node.refuse(request),
        }
    }
}

/// For the next message for which there is a function.
fn message_call(node: &mut J1939Node, functions: &BTreeMap<u32, FnPtr>) -> Option<Wanted> {
    loop {
        let message = node.take_message()?;
        if let Some(function) = functions.get(&message.pgn) {
            let mut map = Map::new();
            map.insert("from".into(), Dynamic::from(i64::from(message.from)));
            map.insert("data".into(), Dynamic::from_blob(message.data));
            return Some((function.clone(), vec![Dynamic::from_map(map)], Then::Nothing));
        }
    }
}

/// For the next object that was written and for which there is a function.
fn write_call(server: &mut CanOpenServer, functions: &BTreeMap<(u16, u8), FnPtr>) -> Option<Wanted> {
    loop {
        let SdoObject { index, sub } = server.take_written()?;
        if let Some(function) = functions.get(&(index, sub)) {
            let value = value_of(&server.dictionary, index, sub).unwrap_or(Dynamic::UNIT);
            return Some((function.clone(), vec![value], Then::Nothing));
        }
    }
}

/// An object's value: a number, or bytes.
pub fn value_of(dictionary: &ObjectDictionary, index: u16, sub: u8) -> std::result::Result<Dynamic, u32> {
    Ok(match dictionary.integer(index, sub)? {
        Some(number) => Dynamic::from(number),
        None => Dynamic::from_blob(dictionary.bytes(index, sub)?.to_vec()),
    })
}

/// The address of a node, as scripts see it.
pub fn shown_address(node: &J1939Node) -> i64 {
    node.address().unwrap_or(NULL).into()
}

/// To all, with the usual priority.
pub const TO_ALL: (u8, u8) = (GLOBAL, PRIORITY);
