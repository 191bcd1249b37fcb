//! The values of an ECU by name and by address.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use super::if_data::{DaqEvent, EcuConnection};
use super::object::MemoryObject;
use crate::Field;
use crate::calibration::connection::MasterSlave;
use crate::calibration::parts::ByteOrder;

/// The most values of arrays that are found by their address.
const MOST_ELEMENTS: usize = 1 << 20;
/// Of one array.
const MOST_OF_ARRAY: u32 = 1 << 16;

/// What an A2L file says about an ECU.
#[derive(Clone, Debug, Default)]
pub struct Description {
    name: String,
    objects: Vec<MemoryObject>,
    by_name: HashMap<String, usize>,
    /// Objects and which of their values, by extension and address in bytes.
    by_address: BTreeMap<(u8, u64), Vec<(usize, u32)>>,
    elements: usize,
    transport: EcuConnection,
    /// What was not understood, in words.
    pub issues: Vec<String>,
}

impl Description {
    /// Of an ECU with this name and connection.
    pub(super) fn new(name: String, transport: EcuConnection) -> Self {
        Self { name, transport, ..Self::default() }
    }

    /// Adds an object.
    pub(super) fn add(&mut self, object: MemoryObject) {
        let place = self.objects.len();
        let count = if object.stays() { object.count().min(MOST_OF_ARRAY) } else { 0 };
        let begin = u64::from(object.address) * u64::from(self.granularity()) + u64::from(object.offset);
        for element in 0..count {
            if self.elements == MOST_ELEMENTS {
                break;
            }
            self.elements += 1;
            let address = begin + u64::from(object.element_offset(element));
            self.by_address.entry((object.extension, address)).or_default().push((place, element));
        }
        self.by_name.entry(object.name.clone()).or_insert(place);
        self.objects.push(object);
    }

    /// The ECU's name: that of its module.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// All objects, in the file's order.
    pub fn objects(&self) -> &[MemoryObject] {
        &self.objects
    }

    /// The object with this name; upper and lower case count only if there are two.
    pub fn object(&self, name: &str) -> Option<&MemoryObject> {
        if let Some(place) = self.by_name.get(name) {
            return self.objects.get(*place);
        }
        let mut same = self.objects.iter().filter(|object| object.name.eq_ignore_ascii_case(name));
        same.next().filter(|_| same.next().is_none())
    }

    /// The object with this name, or the one of which the name says an element, as `Table[3][2]`.
    pub fn element(&self, name: &str) -> Option<(&MemoryObject, Option<u32>)> {
        let mut indices = Vec::new();
        let mut rest = name;
        loop {
            if let Some(object) = self.object(rest) {
                indices.reverse();
                let element = if indices.is_empty() { None } else { Some(object.element(&indices)?) };
                return Some((object, element));
            }
            let (before, index) = rest.strip_suffix(']')?.rsplit_once('[')?;
            indices.push(index.parse().ok()?);
            rest = before;
        }
    }

    /// Bytes of one of XCP's address units: 1, 2 or 4.
    pub fn granularity(&self) -> u8 {
        self.transport.granularity.max(1)
    }

    /// The identifiers of XCP.
    pub const fn xcp(&self) -> Option<MasterSlave> {
        self.transport.xcp
    }

    /// The identifiers of CCP.
    pub const fn ccp(&self) -> Option<MasterSlave> {
        self.transport.ccp
    }

    /// The station address of CCP.
    pub const fn station(&self) -> u16 {
        self.transport.station
    }

    /// The order of CCP's numbers.
    pub const fn ccp_order(&self) -> Option<ByteOrder> {
        self.transport.ccp_order
    }

    /// The events of XCP.
    pub fn events(&self) -> &[DaqEvent] {
        &self.transport.events
    }

    /// What is in these bytes of the memory, from this address in the ECU's units: each value that is whole within them.
    pub fn fields(&self, extension: u8, address: u32, bytes: &[u8], order: Option<ByteOrder>) -> Vec<Field> {
        let Some(last) = (bytes.len() as u64).checked_sub(1) else { return Vec::new() };
        let begin = u64::from(address) * u64::from(self.granularity());
        let range = (extension, begin)..=(extension, begin + last);
        let mut fields = Vec::new();
        for ((_, at), places) in self.by_address.range(range) {
            for &(place, element) in places {
                let object = &self.objects[place];
                let from = (at - begin) as usize;
                if let Some(bytes) = bytes.get(from..from.saturating_add(object.element_size())) {
                    fields.push(object.field(element, bytes, order));
                }
            }
        }
        fields
    }

    /// The same for an entry of a list: values that are exactly it, if there are any.
    pub fn entry_fields(
        &self,
        extension: u8,
        address: u32,
        bytes: &[u8],
        order: Option<ByteOrder>,
    ) -> Vec<Field> {
        let begin = u64::from(address) * u64::from(self.granularity());
        let exact = self.by_address.get(&(extension, begin)).into_iter().flatten();
        let exact = exact.map(|&(place, element)| (&self.objects[place], element));
        let exact = exact.filter(|(object, _)| !object.is_text() && object.data_type.size() == bytes.len());
        let exact: Vec<_> = exact.map(|(object, element)| object.field(element, bytes, order)).collect();
        if exact.is_empty() { self.fields(extension, address, bytes, order) } else { exact }
    }
}

/// The descriptions of all ECUs on a bus.
#[derive(Clone, Debug, Default)]
pub struct A2lDescriptions {
    all: Vec<Arc<Description>>,
}

impl A2lDescriptions {
    /// These.
    pub fn new(all: Vec<Arc<Description>>) -> Self {
        Self { all }
    }

    /// All of them.
    pub fn all(&self) -> &[Arc<Description>] {
        &self.all
    }

    /// That of a connection: the one that has its identifiers, otherwise the only one that has none.
    pub fn of(&self, parties: MasterSlave) -> Option<Arc<Description>> {
        let has = |one: &&Arc<Description>| [one.xcp(), one.ccp()].contains(&Some(parties));
        let bare = |one: &&Arc<Description>| one.xcp().is_none() && one.ccp().is_none();
        let mut without = self.all.iter().filter(bare);
        let only = without.next().filter(|_| without.next().is_none());
        self.all.iter().find(has).or(only).cloned()
    }

    /// The connections of XCP that they name.
    pub fn xcp_parties(&self) -> impl Iterator<Item = MasterSlave> {
        self.all.iter().filter_map(|one| one.xcp())
    }

    /// The connections of CCP that they name.
    pub fn ccp_parties(&self) -> impl Iterator<Item = MasterSlave> {
        self.all.iter().filter_map(|one| one.ccp())
    }
}
