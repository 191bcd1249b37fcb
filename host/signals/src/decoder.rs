//! Finds a frame's message, over several databases and channels.

use std::collections::HashMap;

use cantap_can::Id;
use cantap_trace::TraceFrame;
use rustc_hash::FxHashMap;

use super::container::NotDecoded;
use super::model::{Database, Message, Signal};
use super::plan::{MessagePlan, MessageRows, SignalValue};
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

impl MessageRef {
    /// Its index in [`Decoder::messages`], from 0.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

/// Decodes frames with one or several databases.
///
/// An extended frame whose exact identifier is not in the database is looked up as a J1939 parameter
/// group: without its priority, then also without its source address.
#[derive(Clone, Debug)]
pub struct Decoder {
    messages: Vec<(Option<u8>, Message, MessagePlan)>,
    /// For channels without a database of their own.
    common: Lookup,
    by_channel: HashMap<u8, Lookup>,
    overrides: Vec<Override>,
    faults: usize,
}

/// Messages of one database that a later one for the same channel describes differently.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Override {
    /// The file whose messages are ignored.
    pub file: String,
    /// The later file, whose messages are used.
    pub by: String,
    /// The names of the ignored messages.
    pub messages: Vec<String>,
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

/// The identifier bits that make up a parameter group's number: they exclude priority and source address, and
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

    /// Adds a message; returns the one with the same identifier that it replaces. Messages below `own` belong to other
    /// databases and are also replaced as parameter groups.
    fn insert(&mut self, place: u32, id: Id, j1939: bool, own: u32) -> Option<u32> {
        let raw = id.raw();
        if !id.is_extended() {
            let before = std::mem::replace(&mut self.standard[raw as usize], place);
            return (before != NONE).then_some(before);
        }
        if j1939 {
            let group = parameter_group(raw);
            let first_of_database = |lookup: &mut FxHashMap<u32, u32>, key| {
                let entry = lookup.entry(key).or_insert(place);
                if *entry < own {
                    *entry = place;
                }
            };
            first_of_database(&mut self.from_source, group | raw & 0xFF);
            first_of_database(&mut self.parameter_group, group);
        }
        self.extended.insert(raw, place)
    }

    #[inline]
    fn find(&self, id: Id) -> Option<u32> {
        if id.is_extended() {
            return self.find_extended(id.raw());
        }
        let place = *self.standard.get(id.raw() as usize)?;
        (place != NONE).then_some(place)
    }

    fn find_extended(&self, raw: u32) -> Option<u32> {
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
    /// Compiles the databases. If two for the same channel have the same identifier, the later one is used.
    pub fn new(sources: Vec<Source>) -> Self {
        let mut common = Lookup::new();
        let mut by_channel = HashMap::new();
        let mut messages: Vec<(Option<u8>, Message, MessagePlan)> = Vec::new();
        let mut overrides: Vec<Override> = Vec::new();
        let faults = sources.iter().map(|source| source.database.warnings.len()).sum();
        // Each database's first message and file.
        let mut files: Vec<(u32, String)> = Vec::new();
        for Source { channel, database } in sources {
            let lookup = match channel {
                None => &mut common,
                Some(channel) => by_channel.entry(channel).or_insert_with(Lookup::new),
            };
            let own = messages.len() as u32;
            for message in database.messages {
                let replaced = lookup.insert(messages.len() as u32, message.id, message.j1939, own);
                if let Some(replaced) = replaced.filter(|&replaced| replaced < own) {
                    let of = files.partition_point(|&(first, _)| first <= replaced) - 1;
                    let (file, by) = (files[of].1.clone(), database.file.clone());
                    let name = messages[replaced as usize].1.name.clone();
                    match overrides.iter_mut().find(|known| known.file == file && known.by == by) {
                        Some(known) => known.messages.push(name),
                        None => overrides.push(Override { file, by, messages: vec![name] }),
                    }
                }
                let plan = MessagePlan::new(&message, |_, _| true);
                messages.push((channel, message, plan));
            }
            files.push((own, database.file));
        }
        Self { messages, common, by_channel, overrides, faults }
    }

    /// The number of faults in the databases (see [`Database::warnings`]).
    pub const fn faults(&self) -> usize {
        self.faults
    }

    /// Messages that a later database of the same channel replaces.
    pub fn overrides(&self) -> &[Override] {
        &self.overrides
    }

    /// Treats every extended message as a J1939 parameter group, for databases that do not say so. Call it before choosing
    /// signals.
    pub fn assume_j1939(&mut self) {
        for (place, (channel, message, plan)) in self.messages.iter_mut().enumerate() {
            if message.id.is_extended() && !message.j1939 {
                message.j1939 = true;
                *plan = MessagePlan::new(message, |_, _| true);
                let lookup = match channel {
                    Some(channel) => self.by_channel.get_mut(channel),
                    None => Some(&mut self.common),
                };
                if let Some(lookup) = lookup {
                    lookup.insert(place as u32, message.id, true, 0);
                }
            }
        }
    }

    /// Restricts decoding to the chosen signals.
    pub fn select(&mut self, selection: &Selection) -> Result<(), SelectionError> {
        selection.check(&self.messages.iter().map(|(_, message, _)| message))?;
        for (_, message, plan) in &mut self.messages {
            *plan = MessagePlan::new(message, |_, signal| selection.matches(message, signal));
        }
        Ok(())
    }

    /// Restricts decoding to the signals that `keep` accepts, by message and index.
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

    /// The message for a reference of this decoder.
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
    #[inline]
    pub fn find(&self, channel: u8, id: Id) -> Option<MessageRef> {
        self.by_channel.get(&channel).unwrap_or(&self.common).find(id).map(MessageRef)
    }

    /// Whether any of the message's signals is chosen.
    pub fn is_selected(&self, message: MessageRef) -> bool {
        !self.messages[message.0 as usize].2.is_empty()
    }

    /// Decodes a frame: `values` is cleared and gets the chosen signals that are present and fit the frame.
    /// `None` for remote frames and for identifiers without a message.
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

    /// Adds what of this data the message's container has beside its values.
    pub fn count_not_decoded(&self, message: MessageRef, data: &[u8], counts: &mut NotDecoded) {
        if let Some(container) = &self.message(message).container {
            counts.add(container, data);
        }
    }

    /// For decoding frames of this message together: much faster than one by one if columns are needed.
    pub fn rows(&self, message: MessageRef) -> MessageRows {
        let (_, message, plan) = &self.messages[message.0 as usize];
        MessageRows::new(message.clone(), plan.clone())
    }

    /// Decodes a message's data of any length, appending to `values`.
    pub fn decode_data(&self, message: MessageRef, data: &[u8], values: &mut Vec<SignalValue>) {
        let (_, message, plan) = &self.messages[message.0 as usize];
        plan.decode(message, data, values);
    }
}
