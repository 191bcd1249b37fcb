//! The content of PDOs: from an EDS, or from what was written to or read from their mapping parameters.

use rustc_hash::FxHashMap;

use super::drive::DriveView;
use super::eds::Eds;
use super::{drive, names, sdo, types};
use crate::{Bytes, Event, EventKind, Field, Party, Protocol, Trouble};
use cantap_trace::TraceRecord;

/// How many mapping parameters of a node are kept: 512 PDOs with eight entries each.
const MOST_ENTRIES: usize = 512 * 9;

/// The identifier in a node's communication parameter, if it is not the predefined one.
fn own_id(value: u32, index: u16, node: u8) -> Option<u16> {
    // Bit 31: the PDO does not exist; bit 29: an extended identifier.
    let id = (value & 0x7FF) as u16;
    let place = index & 0x1FF;
    let predefined =
        (place < 4).then(|| u16::from(node) + 0x80 * (2 * place + if index < 0x1800 { 4 } else { 3 }));
    (value & 0xA000_0000 == 0 && id != 0 && Some(id) != predefined).then_some(id)
}

/// The identifiers that a sheet assigns to a node's PDOs, each with its communication parameter. If the sheet is `of_the_node`, all of
/// them; otherwise those that depend on the node's number.
pub fn sheet_ids(eds: &Eds, node: u8, of_the_node: bool) -> impl Iterator<Item = (u16, u16)> + '_ {
    let parameters =
        [0x1400..=0x15FF, 0x1800..=0x19FF].into_iter().flat_map(|range| eds.objects.range(range));
    parameters.filter_map(move |(&index, object)| {
        let text = &object.entries.get(&1)?.value;
        if !of_the_node && !text.to_ascii_uppercase().contains("$NODEID") {
            return None;
        }
        Some((own_id(eds.value_of(index, 1, node)?, index, node)?, index))
    })
}

/// One node's PDOs.
#[derive(Default)]
pub struct Pdos {
    /// Observed mapping parameters, by index (1600 to 17FF, 1A00 to 1BFF) and sub-index.
    mapped: FxHashMap<(u16, u8), u32>,
    /// Identifiers that were configured, by communication parameter (1400 to 15FF, 1800 to 19FF).
    ids: FxHashMap<u16, u16>,
}

/// The communication parameter of the PDO with a predefined identifier.
const fn parameter(number: u16) -> u16 {
    let place = (number >> 7) - 3;
    if place.is_multiple_of(2) { 0x1800 + place / 2 } else { 0x1400 + place / 2 }
}

impl Pdos {
    /// Learns from an SDO transfer; returns whether identifiers have changed.
    pub fn learn(&mut self, node: u8, transfer: &sdo::SdoTransfer) -> bool {
        let Ok(bytes) = <[u8; 4]>::try_from(transfer.data.as_slice()) else {
            if let (0x1600..=0x17FF | 0x1A00..=0x1BFF, 0, [count]) =
                (transfer.index, transfer.sub, &transfer.data[..])
            {
                self.map(transfer.index, 0, u32::from(*count));
            }
            return false;
        };
        if let (0x1600..=0x17FF | 0x1A00..=0x1BFF, 0) = (transfer.index, transfer.sub) {
            // Sent without its size: the first byte is the number.
            self.map(transfer.index, 0, bytes[0].into());
            return false;
        }
        let value = u32::from_le_bytes(bytes);
        match (transfer.index, transfer.sub) {
            (0x1600..=0x17FF | 0x1A00..=0x1BFF, 1..=64) => {
                self.map(transfer.index, transfer.sub, value);
                false
            }
            (index @ (0x1400..=0x15FF | 0x1800..=0x19FF), 1) => {
                if let Some(id) = own_id(value, index, node) {
                    self.ids.insert(index, id);
                } else {
                    self.ids.remove(&index);
                }
                true
            }
            _ => false,
        }
    }

    fn map(&mut self, index: u16, sub: u8, value: u32) {
        if self.mapped.len() < MOST_ENTRIES || self.mapped.contains_key(&(index, sub)) {
            self.mapped.insert((index, sub), value);
        }
    }

    /// Identifiers that are not the predefined ones, each with its communication parameter.
    pub fn ids(&self) -> impl Iterator<Item = (u16, u16)> + '_ {
        self.ids.iter().map(|(index, id)| (*id, *index))
    }

    /// A PDO; `number` is its communication parameter, or the predefined identifier without the node. `known` is what is known of the node
    /// as a drive.
    pub fn event(
        &self,
        record: &TraceRecord,
        (node, number): (u8, u16),
        data: &[u8],
        sheet: Option<&Eds>,
        known: &mut DriveView,
    ) -> Event {
        let parameter = if number >= 0x1400 { number } else { parameter(number) };
        let sends = parameter >= 0x1800;
        let title = format!("{}PDO{}", if sends { 'T' } else { 'R' }, (parameter & 0x1FF) + 1);
        let mut event = Event::new(Protocol::CanOpen, record, EventKind::Pdo, title);
        let mapping = parameter + 0x200;
        if sends {
            event.from = Party::Node(node);
        } else {
            event.to = Party::Node(node);
        }
        let entry = |sub: u8| {
            let heard = self.mapped.get(&(mapping, sub)).copied();
            heard.or_else(|| sheet.and_then(|eds| eds.value_of(mapping, sub, node)))
        };
        let count = entry(0).unwrap_or(0).min(64) as u8;
        values((1..=count).map_while(entry), node, data, sheet, known, &mut event);
        event
    }
}

/// Adds the values of what is mapped, each by its object, sub-index and number of bits, in this order; what nothing is mapped to as bytes.
pub fn values(
    mapped: impl IntoIterator<Item = u32>,
    node: u8,
    data: &[u8],
    sheet: Option<&Eds>,
    known: &mut DriveView,
    event: &mut Event,
) {
    let (mut at, mut is_short) = (0, false);
    for mapped in mapped {
        let (index, of, bits) = ((mapped >> 16) as u16, (mapped >> 8) as u8, (mapped & 0xFF) as usize);
        if bits == 0 {
            break;
        }
        if at + bits > data.len() * 8 {
            is_short = true;
            break;
        }
        let mut bytes = cut(data, at, bits);
        at += bits;
        // Below 20h it is a type: a placeholder for unused bytes.
        if index < 0x20 {
            continue;
        }
        known.learn(index, of, bits, &bytes);
        let drive = known.or_sheet(sheet, node);
        let entry = sheet.and_then(|eds| eds.entry_of(index, of));
        let name = entry.map(|entry| entry.name.clone()).filter(|name| !name.is_empty());
        let of_drive = || drive.is_drive().then(|| names::drive_object(index))?;
        let name = name.or_else(|| names::object(index).or_else(of_drive).map(str::to_owned));
        let mut field = Field::bytes(name.unwrap_or_else(|| format!("{index:04X}:{of:02X}")), &[]);
        let data_type = entry.and_then(|entry| entry.data_type).or_else(|| types::known(index, of));
        let data_type = data_type.or_else(|| drive.is_drive().then(|| drive::data_type(index))?);
        if types::is_signed(data_type) {
            extend_sign(&mut bytes, bits);
        }
        field.value = types::value(data_type, &bytes);
        drive.explain(index, of, &bytes, field, &mut event.fields);
    }
    let rest = cut(data, at, data.len() * 8 - at);
    // Fewer than eight bits fill up the last byte.
    let is_filling = data.len() * 8 - at < 8 && rest[..] == [0];
    if at == 0 {
        event.fields.push(Field::bytes("data", data));
    } else if !rest.is_empty() && !is_filling {
        // Starting at the first bit that is not mapped.
        event.fields.push(Field::bytes("rest", &rest));
    }
    if is_short {
        event.trouble = Some(Trouble::Malformed("shorter than what is mapped to it"));
    }
}

/// Repeats the sign of an integer of this many bits in the last byte's other ones.
fn extend_sign(bytes: &mut Bytes, bits: usize) {
    if !bits.is_multiple_of(8)
        && let Some(last) = bytes.last_mut()
        && *last >> (bits % 8 - 1) & 1 == 1
    {
        *last |= 0xFF << (bits % 8);
    }
}

/// Extracts bits from any position as bytes, least significant first.
fn cut(data: &[u8], at: usize, bits: usize) -> Bytes {
    let mut bytes: Bytes = (0..bits.div_ceil(8))
        .map(|number| {
            let first = at + number * 8;
            let byte = |place: usize| u16::from(data.get(place).copied().unwrap_or(0));
            ((byte(first / 8) | byte(first / 8 + 1) << 8) >> (first % 8)) as u8
        })
        .collect();
    if !bits.is_multiple_of(8)
        && let Some(last) = bytes.last_mut()
    {
        *last &= (1 << (bits % 8)) - 1;
    }
    bytes
}
