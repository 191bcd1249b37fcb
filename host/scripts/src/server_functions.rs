//! The functions with which scripts answer: servers, and nodes of protocols.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::{Rc, Weak};

use cantap_can::Channel;
use cantap_protocols::active::transfer::TransferSettings;
use cantap_protocols::canopen::abort_text;
use cantap_protocols::canopen::codec::lss::NO_NODE;
use cantap_protocols::canopen::codec::sdo::abort;
use cantap_protocols::canopen::eds::Eds;
use cantap_protocols::devicenet::codec::MAC_IDS;
use cantap_protocols::j1939::J1939Name;
use cantap_protocols::serving::canopen::CanOpenServer;
use cantap_protocols::serving::devicenet::DeviceNetServer;
use cantap_protocols::serving::iso_tp::IsoTpServer;
use cantap_protocols::serving::j1939::{J1939Node, NotSent};
use cantap_protocols::serving::lss::LssSlave;
use cantap_trace::grammar;
use rhai::{Array, Blob, Dynamic, Engine, FnPtr, Map};

use crate::byte_functions::{byte, data_of};
use crate::runtime::Runtime;
use crate::script_result::Result;
use crate::servers::{Server, TO_ALL, shown_address, value_of};
use crate::sheets;

/// Why there is a runtime: only its own thread calls a script's functions.
const RUNS: &str = "a script's functions are called while it runs";

/// A J1939 node of a script. Weak, since the runtime holds the script's functions, and these what they have captured: a runtime that held itself
/// would never end.
#[derive(Clone)]
struct J1939(Weak<Runtime>, usize);

/// A CANopen node's dictionary of a script.
#[derive(Clone)]
struct CanOpen(Weak<Runtime>, usize);

/// Makes everything known to an engine.
pub fn register(engine: &mut Engine, runtime: &Rc<Runtime>) {
    settings(engine, runtime);
    diagnostics(engine, runtime);
    j1939(engine, runtime);
    canopen(engine, runtime);
    lss(engine);
    devicenet(engine, runtime);
}

fn settings(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    engine.register_fn("setting", move |name: &str, default: Dynamic| -> Result<Dynamic> {
        of.settings.value(name, default).map_err(Into::into)
    });
}

fn diagnostics(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    let serve = move |request: &str, functional: Option<&str>, response: &str, call: FnPtr| -> Result<()> {
        let functional = functional.map(grammar::identifier).transpose()?;
        let (request, response) = (grammar::identifier(request)?, grammar::identifier(response)?);
        let server = IsoTpServer::new(request, functional, response, TransferSettings::default());
        let name = format!("server {response}");
        of.serve_with(Channel::Can1, name, Server::IsoTp(server, call))?;
        Ok(())
    };
    let one = serve.clone();
    engine.register_fn("on_request", move |request: &str, response: &str, call: FnPtr| {
        one(request, None, response, call)
    });
    engine.register_fn("on_request", move |request: &str, functional: &str, response: &str, call: FnPtr| {
        serve(request, Some(functional), response, call)
    });
}

fn j1939(engine: &mut Engine, runtime: &Rc<Runtime>) {
    engine.register_type_with_name::<J1939>("J1939");
    let of = Rc::clone(runtime);
    engine.register_fn("j1939", move |address: i64, name: Map| -> Result<J1939> {
        let address = u8::try_from(address).ok().filter(|address| *address < 254);
        let address = address.ok_or("an address is 0 to 253")?;
        let server = Server::J1939 {
            node: J1939Node::new(name_of(&name)?.raw(), address),
            requests: BTreeMap::new(),
            messages: BTreeMap::new(),
        };
        let place = of.serve_with(Channel::Can1, format!("node {address}"), server)?;
        Ok(J1939(Rc::downgrade(&of), place))
    });
    engine.register_get("address", |node: &mut J1939| node.with(|node| shown_address(node)));
    let (to_all, usual) = TO_ALL;
    engine.register_fn("send", move |node: &mut J1939, pgn: i64, data: Dynamic| {
        node.send(pgn, to_all, usual, data)
    });
    engine.register_fn("send", move |node: &mut J1939, pgn: i64, data: Dynamic, priority: i64| {
        node.send(pgn, to_all, priority_of(priority)?, data)
    });
    engine.register_fn("send_to", move |node: &mut J1939, to: i64, pgn: i64, data: Dynamic| {
        node.send(pgn, byte(to)?, usual, data)
    });
    engine.register_fn("send_fast", move |node: &mut J1939, pgn: i64, data: Dynamic| {
        node.send_fast(pgn, usual, data)
    });
    engine.register_fn("send_fast", |node: &mut J1939, pgn: i64, data: Dynamic, priority: i64| {
        node.send_fast(pgn, priority_of(priority)?, data)
    });
    engine.register_fn("on_request", |node: &mut J1939, pgn: i64, call: FnPtr| -> Result<()> {
        let pgn = group(pgn)?;
        node.with_functions(|requests, _| requests.insert(pgn, call));
        Ok(())
    });
    engine.register_fn("on_message", |node: &mut J1939, pgn: i64, call: FnPtr| -> Result<()> {
        let pgn = group(pgn)?;
        node.with_functions(|_, messages| messages.insert(pgn, call));
        Ok(())
    });
}

fn canopen(engine: &mut Engine, runtime: &Rc<Runtime>) {
    engine.register_type_with_name::<CanOpen>("CanOpen");
    engine.register_fn("sheet", |name: &str| -> Result<String> {
        let missing = || format!("there is no sheet {name}; there are {}", sheets::names()).into();
        sheets::sheet(name).map(str::to_owned).ok_or_else(missing)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("canopen", move |node: i64, sheet: &str| -> Result<CanOpen> {
        let number = node_number(node)?;
        let sheet = Eds::parse(sheet.as_bytes());
        if sheet.objects.is_empty() {
            return Err("the sheet has no objects; give it the text of an EDS file".into());
        }
        let server = Server::CanOpen { server: CanOpenServer::new(sheet, number), writes: BTreeMap::new() };
        let place = of.serve_with(Channel::Can1, format!("node {number}"), server)?;
        Ok(CanOpen(Rc::downgrade(&of), place))
    });
    engine.register_fn("get", |node: &mut CanOpen, index: i64| node.get(index, 0));
    engine.register_fn("get", |node: &mut CanOpen, index: i64, sub: i64| node.get(index, sub));
    engine.register_fn("set", |node: &mut CanOpen, index: i64, value: Dynamic| node.set(index, 0, value));
    engine.register_fn("set", |node: &mut CanOpen, index: i64, sub: i64, value: Dynamic| {
        node.set(index, sub, value)
    });
    engine
        .register_fn("on_write", |node: &mut CanOpen, index: i64, call: FnPtr| node.on_write(index, 0, call));
    engine.register_fn("on_write", |node: &mut CanOpen, index: i64, sub: i64, call: FnPtr| {
        node.on_write(index, sub, call)
    });
    engine.register_fn("pdo", |node: &mut CanOpen, mapping: i64| -> Result<Blob> {
        let index = object(mapping, 0)?.0;
        Ok(node.with(|server, _| server.dictionary.pdo(index)))
    });
    engine.register_fn("take_pdo", |node: &mut CanOpen, mapping: i64, data: Blob| -> Result<bool> {
        let index = object(mapping, 0)?.0;
        Ok(node.with(|server, _| server.take_pdo(index, &data)))
    });
    engine.register_fn("reset", |node: &mut CanOpen| node.with(|server, _| server.reset()));
    engine.register_get("node", |node: &mut CanOpen| node.with(|server, _| i64::from(server.node())));
    engine.register_set("node", |node: &mut CanOpen, number: i64| -> Result<()> {
        let number = node_number(number)?;
        node.with(|server, _| server.set_node(number));
        Ok(())
    });
    engine.register_get("serves", |node: &mut CanOpen| node.with(|server, _| server.is_serving));
    engine.register_set("serves", |node: &mut CanOpen, serves: bool| {
        node.with(|server, _| server.is_serving = serves);
    });
}

/// A slave of CANopen's layer setting services.
#[derive(Clone)]
struct Lss(Rc<RefCell<LssSlave>>);

fn lss(engine: &mut Engine) {
    engine.register_type_with_name::<Lss>("Lss");
    engine.register_fn("lss", |identity: Array, node: i64| -> Result<Lss> {
        let number = u8::try_from(node).ok().filter(|node| matches!(node, 1..=127 | &NO_NODE));
        let number =
            number.ok_or_else(|| format!("{node} is no node; those are 1 to 127, and 255 without one"))?;
        let part = |value: Dynamic| value.as_int().ok().and_then(|value| u32::try_from(value).ok());
        let parts: Option<Vec<u32>> = identity.into_iter().map(part).collect();
        let parts: Option<[u32; 4]> = parts.and_then(|parts| parts.try_into().ok());
        let parts =
            parts.ok_or("an identity is [vendor, product, revision, serial number], each of 32 bits")?;
        Ok(Lss(Rc::new(RefCell::new(LssSlave::new(parts, number)))))
    });
    engine.register_fn("take", |slave: &mut Lss, data: Blob| -> Dynamic {
        let answer = slave.0.borrow_mut().take(&data);
        answer.map_or(Dynamic::UNIT, |bytes| Dynamic::from_blob(bytes.to_vec()))
    });
    engine.register_fn("reset", |slave: &mut Lss| slave.0.borrow_mut().reset());
    engine.register_get("node", |slave: &mut Lss| i64::from(slave.0.borrow().node()));
}

fn devicenet(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    engine.register_fn("on_explicit", move |mac: i64, call: FnPtr| -> Result<()> {
        let number = u8::try_from(mac).ok().filter(|mac| *mac < MAC_IDS);
        let number = number.ok_or_else(|| format!("{mac} is no MAC ID; those are 0 to 63"))?;
        let server = Server::DeviceNet(DeviceNetServer::new(number), call);
        of.serve_with(Channel::Can1, format!("node {number}"), server)?;
        Ok(())
    });
}

fn node_number(node: i64) -> Result<u8> {
    let number = u8::try_from(node).ok().filter(|node| (1..=127).contains(node));
    number.ok_or_else(|| format!("{node} is no node; those are 1 to 127").into())
}

impl CanOpen {
    fn with<R>(&self, act: impl FnOnce(&mut CanOpenServer, &mut ObjectFunctions) -> R) -> R {
        let runtime = self.0.upgrade().expect(RUNS);
        let mut servers = runtime.servers.borrow_mut();
        match servers.get(self.1) {
            Some(Server::CanOpen { server, writes }) => act(server, writes),
            _ => unreachable!("servers are never removed, and this one was made as a CANopen node"),
        }
    }

    fn get(&self, index: i64, sub: i64) -> Result<Dynamic> {
        let (index, sub) = object(index, sub)?;
        self.with(|server, _| value_of(&server.dictionary, index, sub))
            .map_err(|code| missing(index, sub, code).into())
    }

    fn set(&self, index: i64, sub: i64, value: Dynamic) -> Result<()> {
        let (index, sub) = object(index, sub)?;
        self.with(|server, _| {
            if let Ok(number) = value.as_int() {
                return server.dictionary.set_integer(index, sub, number);
            }
            server.dictionary.bytes(index, sub)?;
            let data = data_of(value).map_err(|_| abort::LENGTH)?;
            server.dictionary.set(index, sub, &data);
            Ok(())
        })
        .map_err(|code| missing(index, sub, code).into())
    }

    fn on_write(&self, index: i64, sub: i64, call: FnPtr) -> Result<()> {
        let (index, sub) = object(index, sub)?;
        self.with(|server, writes| {
            server.dictionary.bytes(index, sub)?;
            writes.insert((index, sub), call);
            Ok(())
        })
        .map_err(|code| missing(index, sub, code).into())
    }
}

fn object(index: i64, sub: i64) -> Result<(u16, u8)> {
    let index = u16::try_from(index).map_err(|_| format!("{index} is no object; those are 0 to 0xFFFF"))?;
    Ok((index, byte(sub)?))
}

fn missing(index: u16, sub: u8, code: u32) -> String {
    format!("object {index:04X}.{sub:02X}: {}", abort_text(code))
}

type ObjectFunctions = BTreeMap<(u16, u8), FnPtr>;
type Functions = BTreeMap<u32, FnPtr>;

impl J1939 {
    fn with_all<R>(&self, act: impl FnOnce(&mut J1939Node, &mut Functions, &mut Functions) -> R) -> R {
        let runtime = self.0.upgrade().expect(RUNS);
        let mut servers = runtime.servers.borrow_mut();
        match servers.get(self.1) {
            Some(Server::J1939 { node, requests, messages }) => act(node, requests, messages),
            _ => unreachable!("servers are never removed, and this one was made as a J1939 node"),
        }
    }

    fn with<R>(&self, act: impl FnOnce(&mut J1939Node) -> R) -> R {
        self.with_all(|node, _, _| act(node))
    }

    fn with_functions(&self, act: impl FnOnce(&mut Functions, &mut Functions) -> Option<FnPtr>) {
        // What was there before is replaced.
        let _ = self.with_all(|_, requests, messages| act(requests, messages));
    }

    fn send(&self, pgn: i64, to: u8, priority: u8, data: Dynamic) -> Result<()> {
        let (pgn, data) = (group(pgn)?, data_of(data)?);
        self.with(|node| node.send(pgn, to, priority, data))
            .map_err(|error: NotSent| error.to_string().into())
    }

    fn send_fast(&self, pgn: i64, priority: u8, data: Dynamic) -> Result<()> {
        let (pgn, data) = (group(pgn)?, data_of(data)?);
        self.with(|node| node.send_fast(pgn, priority, &data))
            .map_err(|error: NotSent| error.to_string().into())
    }
}

fn group(pgn: i64) -> Result<u32> {
    let group = u32::try_from(pgn).ok().filter(|pgn| *pgn <= 0x3_FFFF);
    group.ok_or_else(|| format!("{pgn} is no parameter group; those are 0 to 262143").into())
}

fn priority_of(priority: i64) -> Result<u8> {
    let valid = u8::try_from(priority).ok().filter(|priority| *priority <= 7);
    valid.ok_or_else(|| format!("{priority} is no priority; those are 0, the highest, to 7").into())
}

/// A NAME from its parts; those that are left out are 0.
fn name_of(map: &Map) -> Result<J1939Name> {
    let mut name = J1939Name::default();
    for (part, value) in map {
        let number = |most: i64| -> Result<i64> {
            let number = value.as_int().ok().filter(|number| (0..=most).contains(number));
            number.ok_or_else(|| {
                format!("{part} of a NAME is a number from 0 to {most}, and not {value}").into()
            })
        };
        match part.as_str() {
            "identity" => name.identity = number(0x1F_FFFF)? as u32,
            "manufacturer" => name.manufacturer = number(0x7FF)? as u16,
            "ecu_instance" => name.ecu_instance = number(7)? as u8,
            "function_instance" => name.function_instance = number(31)? as u8,
            "function" => name.function = number(255)? as u8,
            "vehicle_system" => name.vehicle_system = number(127)? as u8,
            "vehicle_system_instance" => name.vehicle_system_instance = number(15)? as u8,
            "industry_group" => name.industry_group = number(7)? as u8,
            "arbitrary_address_capable" => {
                name.takes_any_address = value
                    .as_bool()
                    .map_err(|_| format!("arbitrary_address_capable is true or false, and not {value}"))?;
            }
            other => {
                return Err(format!(
                    "a NAME has no {other}; it has identity, manufacturer, ecu_instance, function_instance, function, vehicle_system, \
                     vehicle_system_instance, industry_group, arbitrary_address_capable"
                )
                .into());
            }
        }
    }
    Ok(name)
}
