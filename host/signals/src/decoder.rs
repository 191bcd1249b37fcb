//! Finding a frame's message, over several databases and channels.

use std::collections::HashMap;

use cantap_trace::TraceFrame;
use cantap_wire::Id;
use rustc_hash::FxHashMap;

use super::model::{Database, Message, Signal};
use super::plan::{MessagePlan, SignalValue};
use super::select::{Selection, SelectionError};

/// A database and where it applies.
#[derive(Clone, Debug)]
pub struct Source {
    /// The channel, from 1; `None` for all channels that have no database of their own.
    pub channel: Option<u8>,
    /// The database.
    pub database: Database,
}

/// One message of a [`Decoder`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct MessageRef(u32);

/// Decodes frames by one or several databases.
///
/// An extended frame whose exact identifier is not in the database is looked up as a J1939 parameter
/// group: without its priority, then also without its source address.
#[derive(Clone, Debug)]
pub struct Decoder {
    messages: Vec<(Option<u8>, Message, MessagePlan)>,
    /// For channels without an own database.
    common: Lookup,
    by_channel: HashMap<u8, Lookup>,
}

const NONE: u32 = u32::MAX;

#[derive(Clone, Debug)]
struct Lookup {
    standard: Box<[u32]>,
    extended: FxHashMap<u32, u32>,
    /// By parameter group and source address.
    from_source: FxHashMap<u32, u32>,
    /// By parameter group alone.
    parameter_group: FxHashMap<u32, u32>,
}

/// Identifier bits that are a parameter group's number: priority and source address are not, nor is
/// the destination address, which PDU format 1 (below 240) has in bits 8 to 15 (SAE J1939-21 §5.2).
fn parameter_group(id: u32) -> u32 {
    let group = id & 0x03FF_FF00;
    if group >> 16 & 0xFF < 240 { group & 0x03FF_0000 } else { group }
}

impl Lookup {
    fn new() -> Self {
        Self {
            standard: vec![NONE; 1 << 11].into(),
            extended: FxHashMap::default(),
            from_source: FxHashMap::default(),
            parameter_group: FxHashMap::default(),
        }
    }

    fn insert(&mut self, place: u32, id: Id, j1939: bool) {
        let raw = id.raw();
        if !id.is_extended() {
            self.standard[raw as usize] = place;
            return;
        }
        self.extended.insert(raw, place);
        if j1939 {
            let group = parameter_group(raw);
            self.from_source.entry(group | raw & 0xFF).or_insert(place);
            self.parameter_group.entry(group).or_insert(place);
        }
    }

    fn find(&self, id: Id) -> Option<u32> {
        let raw = id.raw();
        if !id.is_extended() {
            let place = *self.standard.get(raw as usize)?;
            return (place != NONE).then_some(place);
        }
        if let Some(&place) = self.extended.get(&raw) {
            return Some(place);
        }
        if self.parameter_group.is_empty() {
            return None;
        }
        let group = parameter_group(raw);
        self.from_source.get(&(group | raw & 0xFF)).or_else(|| self.parameter_group.get(&group)).copied()
    }
}

impl Decoder {
    /// Compiles the databases. Where two of the same channel have the same identifier, the later one
    /// counts.
    pub fn new(sources: Vec<Source>) -> Self {
        let mut common = Lookup::new();
        let mut by_channel = HashMap::new();
        let mut messages = Vec::new();
        for Source { channel, database } in sources {
            let lookup = match channel {
                None => &mut common,
                Some(channel) => by_channel.entry(channel).or_insert_with(Lookup::new),
            };
            for message in database.messages {
                lookup.insert(messages.len() as u32, message.id, message.j1939);
                let plan = MessagePlan::new(&message, |_, _| true);
                messages.push((channel, message, plan));
            }
        }
        Self { messages, common, by_channel }
    }

    /// Treats every extended message as a J1939 parameter group, for databases that do not say so.
    pub fn assume_j1939(&mut self) {
        for (place, (channel, message, _)) in self.messages.iter_mut().enumerate() {
            if message.id.is_extended() && !message.j1939 {
                message.j1939 = true;
                let lookup = match channel {
                    Some(channel) => self.by_channel.get_mut(channel),
                    None => Some(&mut self.common),
                };
                if let Some(lookup) = lookup {
                    lookup.insert(place as u32, message.id, true);
                }
            }
        }
    }

    /// Decodes only the chosen signals from now on.
    pub fn select(&mut self, selection: &Selection) -> Result<(), SelectionError> {
        selection.check(&self.messages.iter().map(|(_, message, _)| message))?;
        for (_, message, plan) in &mut self.messages {
            *plan = MessagePlan::new(message, |_, signal| selection.matches(message, signal));
        }
        Ok(())
    }

    /// Decodes only those signals from now on that `keep` accepts, by message and index.
    pub fn retain(&mut self, keep: impl Fn(MessageRef, usize, &Signal) -> bool) {
        for (place, (_, message, plan)) in self.messages.iter_mut().enumerate() {
            let reference = MessageRef(place as u32);
            *plan = MessagePlan::new(message, |index, signal| keep(reference, index, signal));
        }
    }

    /// All messages, with the channel their database is for.
    pub fn messages(&self) -> impl Iterator<Item = (MessageRef, Option<u8>, &Message)> + Clone {
        self.messages
            .iter()
            .enumerate()
            .map(|(place, (channel, message, _))| (MessageRef(place as u32), *channel, message))
    }

    /// The message behind a reference of this decoder.
    pub fn message(&self, message: MessageRef) -> &Message {
        &self.messages[message.0 as usize].1
    }

    /// The channel that the message's database is for; `None` if it is for all.
    pub fn channel(&self, message: MessageRef) -> Option<u8> {
        self.messages[message.0 as usize].0
    }

    /// All signals.
    pub fn signals(&self) -> impl Iterator<Item = (MessageRef, usize, &Signal)> {
        self.messages().flat_map(|(place, _, message)| {
            message.signals.iter().enumerate().map(move |(index, signal)| (place, index, signal))
        })
    }

    /// The message that an identifier means on a channel.
    pub fn find(&self, channel: u8, id: Id) -> Option<MessageRef> {
        self.by_channel.get(&channel).unwrap_or(&self.common).find(id).map(MessageRef)
    }

    /// Whether any signal of the message was chosen.
    pub fn is_selected(&self, message: MessageRef) -> bool {
        !self.messages[message.0 as usize].2.is_empty()
    }

    /// Decodes a frame: `values` is emptied and gets the chosen signals that are there and that
    /// fit the frame. `None` for remote frames and for identifiers of no message.
    pub fn decode(
        &self,
        channel: u8,
        frame: &TraceFrame,
        values: &mut Vec<SignalValue>,
    ) -> Option<MessageRef> {
        values.clear();
        if frame.is_remote() {
            return None;
        }
        let place = self.find(channel, frame.id())?;
        self.decode_data(place, frame.data(), values);
        Some(place)
    }

    /// Decodes a message's data of any length, appending to `values`.
    pub fn decode_data(&self, message: MessageRef, data: &[u8], values: &mut Vec<SignalValue>) {
        let (_, message, plan) = &self.messages[message.0 as usize];
        plan.decode(message, data, values);
    }
}
