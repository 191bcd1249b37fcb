//! Decodes all connections of a protocol: found, or known beforehand.

use std::collections::BTreeMap;
use std::sync::Arc;

use cantap_trace::{Id, TraceRecord};
use rustc_hash::FxHashMap;

use super::connection::{MasterSlave, is_short_gap};
use super::finding::{ConnectionFinder, Sign};
use super::known::Known;
use crate::a2l::{A2lDescriptions, Description};
use crate::{Assembler, Event};

/// The most connections that are followed.
const MOST_CONNECTIONS: usize = 256;
/// How often to look for what was not answered, in nanoseconds.
const SWEEP_NS: i64 = 100_000_000;

/// A connection of a master with its slave, from frames to events.
pub trait Connection {
    /// Finds connections that nobody has named.
    type Finder: ConnectionFinder;

    /// Nothing has been heard of it yet.
    fn new(parties: MasterSlave, description: Option<Arc<Description>>) -> Self;

    /// Those that are known beforehand.
    fn known(known: &Known) -> Vec<MasterSlave>;

    /// A frame of the master.
    fn hear_master(&mut self, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>);

    /// A frame of the slave.
    fn hear_slave(&mut self, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>);

    /// An identifier of its own that the slave's data packets have got.
    fn take_daq_id(&mut self) -> Option<Id>;

    /// Reports what was not answered in time.
    fn sweep(&mut self, now_ns: i64, channel: u8, events: &mut Vec<Event>);

    /// Frames of the channel were lost; if `is_short`, no more than a list that runs survives.
    fn gap(&mut self, is_short: bool, channel: u8, events: &mut Vec<Event>);

    /// The trace has ended.
    fn finish(&mut self, channel: u8, events: &mut Vec<Event>);
}

/// Whose frames an identifier has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    Master,
    Slave,
}

/// All connections of a protocol.
#[derive(Debug)]
pub struct Connections<C: Connection> {
    known: Vec<MasterSlave>,
    descriptions: Option<Arc<A2lDescriptions>>,
    finder: C::Finder,
    /// By channel and number.
    all: BTreeMap<(u8, usize), C>,
    /// The connection and side of each identifier.
    users: FxHashMap<(u8, Id), (usize, Side)>,
    sweep_ns: i64,
}

impl<C: Connection> Connections<C> {
    /// Nothing has been heard yet.
    pub fn new(known: Known) -> Self {
        Self {
            known: C::known(&known),
            descriptions: known.descriptions,
            finder: C::Finder::default(),
            all: BTreeMap::new(),
            users: FxHashMap::default(),
            sweep_ns: i64::MIN,
        }
    }

    /// Whether frames with this identifier are those of a connection.
    pub fn has(&self, channel: u8, id: Id) -> bool {
        self.users.contains_key(&(channel, id))
    }

    fn connect(&mut self, channel: u8, parties: MasterSlave) -> Option<usize> {
        let number = self.all.len();
        if number >= MOST_CONNECTIONS {
            return None;
        }
        let description = self.descriptions.as_ref().and_then(|all| all.of(parties));
        self.all.insert((channel, number), C::new(parties, description));
        self.users.insert((channel, parties.master), (number, Side::Master));
        self.users.insert((channel, parties.slave), (number, Side::Slave));
        Some(number)
    }

    /// The connection and side of an identifier.
    fn user(&mut self, channel: u8, id: Id) -> Option<(usize, Side)> {
        if let Some(user) = self.users.get(&(channel, id)) {
            return Some(*user);
        }
        let parties = *self.known.iter().find(|parties| parties.master == id || parties.slave == id)?;
        let number = self.connect(channel, parties)?;
        Some((number, if parties.master == id { Side::Master } else { Side::Slave }))
    }

    fn frame(&mut self, record: &TraceRecord, id: Id, data: &[u8], events: &mut Vec<Event>) {
        let channel = record.channel;
        let Some((number, side)) = self.user(channel, id) else {
            if let Sign::Certain(parties, records) = self.finder.look(record, id, data)
                && self.connect(channel, parties).is_some()
            {
                for record in records.iter().chain([record]) {
                    if let Some(frame) = record.frame() {
                        self.frame(record, frame.id(), frame.data(), events);
                    }
                }
            }
            return;
        };
        let Some(connection) = self.all.get_mut(&(channel, number)) else { return };
        match side {
            Side::Master => connection.hear_master(record, data, events),
            Side::Slave => connection.hear_slave(record, data, events),
        }
        if let Some(id) = connection.take_daq_id() {
            self.users.entry((channel, id)).or_insert((number, Side::Slave));
        }
    }
}

impl<C: Connection> Assembler for Connections<C> {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        if record.time_ns >= self.sweep_ns && !self.all.is_empty() {
            self.sweep_ns = record.time_ns.saturating_add(SWEEP_NS);
            for (&(channel, _), connection) in &mut self.all {
                connection.sweep(record.time_ns, channel, events);
            }
        }
        if let Some(frame) = record.frame() {
            if !frame.is_remote() {
                self.frame(record, frame.id(), frame.data(), events);
            }
        } else if let Some(is_short) = is_short_gap(record) {
            let channel = record.channel;
            let of_channel = self.all.range_mut((channel, 0)..=(channel, usize::MAX));
            of_channel.for_each(|(_, connection)| connection.gap(is_short, channel, events));
        }
    }

    fn finish(&mut self, events: &mut Vec<Event>) {
        for (&(channel, _), connection) in &mut self.all {
            connection.finish(channel, events);
        }
    }
}
