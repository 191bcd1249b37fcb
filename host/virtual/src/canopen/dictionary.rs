//! A node's object dictionary, made from its sheet (CiA 306).

use std::collections::BTreeMap;

use cantap_protocols::canopen::codec::sdo::{SdoObject, abort};
use cantap_protocols::canopen::eds::{self, Eds};

/// Longest value that is accepted, in bytes.
pub const MOST_BYTES: usize = 1 << 16;

#[derive(Clone, Debug)]
struct Entry {
    /// Length of a value in bytes; `None` if it may have any.
    length: Option<usize>,
    can_read: bool,
    can_write: bool,
    mappable: bool,
    value: Vec<u8>,
}

/// All of the node's objects.
#[derive(Clone, Debug, Default)]
pub struct Dictionary {
    entries: BTreeMap<(u16, u8), Entry>,
}

/// Bytes of a data type (CiA 301, table 44); `None` for texts and domains.
const fn length(data_type: u16) -> Option<usize> {
    Some(match data_type {
        0x01 | 0x02 | 0x05 => 1,
        0x03 | 0x06 => 2,
        0x04 | 0x07 | 0x08 => 4,
        0x11 | 0x15 | 0x1B => 8,
        _ => return None,
    })
}

impl Dictionary {
    /// The sheet's values, for a node with this number.
    pub fn new(sheet: &Eds, node: u8) -> Self {
        let mut entries = BTreeMap::new();
        for (&index, object) in &sheet.objects {
            for (&sub, entry) in &object.entries {
                let length = entry.data_type.and_then(length);
                let value = match length {
                    Some(length) => {
                        let number = eds::number(&entry.value, node).unwrap_or(0);
                        number.to_le_bytes()[..length].to_vec()
                    }
                    None => entry.value.clone().into_bytes(),
                };
                let access = entry.access.as_str();
                let (can_read, can_write) = (access != "wo", access.starts_with("rw") || access == "wo");
                let mappable = entry.mappable;
                entries.insert((index, sub), Entry { length, can_read, can_write, mappable, value });
            }
        }
        Self { entries }
    }

    fn entry(&self, index: u16, sub: u8) -> Result<&Entry, u32> {
        let missing = || {
            let known = self.entries.range((index, 0)..=(index, u8::MAX)).next().is_some();
            if known { abort::NO_ENTRY } else { abort::NO_OBJECT }
        };
        self.entries.get(&(index, sub)).ok_or_else(missing)
    }

    /// A client reads.
    pub fn read(&self, object: SdoObject) -> Result<&[u8], u32> {
        let entry = self.entry(object.index, object.sub)?;
        if entry.can_read { Ok(&entry.value) } else { Err(abort::WRITE_ONLY) }
    }

    /// Whether a client may write this many bytes, or any number if it does not say.
    pub fn may_write(&self, object: SdoObject, bytes: Option<usize>) -> Result<(), u32> {
        let entry = self.entry(object.index, object.sub)?;
        if !entry.can_write {
            return Err(abort::READ_ONLY);
        }
        match (bytes, entry.length) {
            (Some(bytes), Some(length)) if bytes != length => Err(abort::LENGTH),
            (Some(bytes), _) if bytes > MOST_BYTES => Err(abort::MEMORY),
            _ => Ok(()),
        }
    }

    /// A client writes.
    pub fn write(&mut self, object: SdoObject, value: &[u8]) -> Result<(), u32> {
        self.may_write(object, Some(value.len()))?;
        let SdoObject { index, sub } = object;
        let number = value.iter().take(4).rev().fold(0_u32, |number, byte| number << 8 | u32::from(*byte));
        match (index, sub) {
            // The history can only be cleared.
            (0x1003, 0) if number != 0 => return Err(abort::VALUE),
            (0x1600..=0x17FF | 0x1A00..=0x1BFF, 0) => self.check_mapping(index, number)?,
            // CiA 301, 7.5.2.36: first set the number to zero, then map objects, then set their number.
            (0x1600..=0x17FF | 0x1A00..=0x1BFF, 1..) if self.number(index, 0) != 0 => {
                return Err(abort::STATE);
            }
            _ => {}
        }
        self.set(index, sub, value);
        Ok(())
    }

    /// Whether the first `count` entries of a mapping can be sent or received.
    fn check_mapping(&self, index: u16, count: u32) -> Result<(), u32> {
        let mut bits = 0;
        for sub in 1..=u8::try_from(count).map_err(|_| abort::VALUE)? {
            let mapped = self.entry(index, sub).map_err(|_| abort::VALUE).map(|_| self.number(index, sub))?;
            let (object, of) = ((mapped >> 16) as u16, (mapped >> 8) as u8);
            // Below 20h it is a type: a placeholder for unused bytes.
            if object >= 0x20 && !self.entry(object, of)?.mappable {
                return Err(abort::NOT_MAPPABLE);
            }
            bits += mapped & 0xFF;
        }
        if bits > 64 { Err(abort::PDO_LENGTH) } else { Ok(()) }
    }

    /// Sets the node's own value; without an entry, nothing happens.
    pub fn set(&mut self, index: u16, sub: u8, value: &[u8]) {
        if let Some(entry) = self.entries.get_mut(&(index, sub)) {
            entry.value = value.to_vec();
        }
    }

    /// A value as a number; 0 if there is none.
    pub fn number(&self, index: u16, sub: u8) -> u32 {
        let value = self.entries.get(&(index, sub)).map_or(&[][..], |entry| &entry.value);
        value.iter().take(4).rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
    }

    /// The mapping of a PDO, in order: object, entry, bits.
    pub fn mapping(&self, index: u16) -> impl Iterator<Item = (u16, u8, usize)> + '_ {
        (1..=self.number(index, 0).min(64) as u8).map(move |sub| {
            let mapped = self.number(index, sub);
            ((mapped >> 16) as u16, (mapped >> 8) as u8, (mapped & 0xFF) as usize)
        })
    }
}
