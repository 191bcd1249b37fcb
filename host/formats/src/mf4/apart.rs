//! Values of records that are not in the records themselves.

use std::collections::BTreeMap;

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::blocks::u32_at;
use super::layout::{Apart, Elsewhere};
use super::stream::Stream;

/// Limit for records waiting for their bytes and bytes waiting for their records: if they are farther apart,
/// the file is damaged.
pub(super) const MAX_APART: usize = 1 << 16;

/// Values by their position in the stream of all values of their group.
#[derive(Default)]
pub(super) struct Values {
    kept: BTreeMap<u64, Vec<u8>>,
    /// The position of the next one.
    end: u64,
    /// If positions were not written: how many values came, and how many were requested.
    came: u64,
    asked: u64,
}

/// Whether all values of a record that are in other groups have been read.
pub(super) fn has_arrived(
    apart: &[Apart],
    values: &BTreeMap<u64, Values>,
    record: &[u8],
    by_order: bool,
) -> Result<bool, Fault> {
    for Apart { place, values: at } in apart {
        let Elsewhere::Group(address) = at else { continue };
        let Some(values) = values.get(address) else {
            return Err(Fault::malformed("the group that has the bytes of frames", b"none"));
        };
        if !values.has(place.unsigned(record).unwrap_or(u64::MAX), by_order) {
            return Ok(false);
        }
    }
    Ok(true)
}

impl Apart {
    /// The stream that has the values, if they are in one.
    pub(super) fn stream(&self) -> Option<&Stream> {
        match &self.values {
            Elsewhere::Stream(stream) => Some(stream),
            Elsewhere::Group(_) => None,
        }
    }

    /// The value of a record, which has arrived.
    pub(super) fn take(
        &mut self,
        file: &mut Whole,
        values: &mut BTreeMap<u64, Values>,
        record: &[u8],
        by_order: bool,
    ) -> Result<Vec<u8>, Fault> {
        let at = self.place.unsigned(record).unwrap_or(u64::MAX);
        let value = match &mut self.values {
            Elsewhere::Stream(stream) => {
                let len = stream.at(file, at, 4)?.map_or(0, |head| u32_at(head, 0));
                stream.at(file, at.saturating_add(4), len as usize)?.map(<[u8]>::to_vec)
            }
            Elsewhere::Group(address) => values.get_mut(address).and_then(|values| values.take(at, by_order)),
        };
        Ok(value.unwrap_or_default())
    }
}

impl Values {
    /// Whether none is waiting for its record.
    pub(super) fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    /// How far they were read: the place of the next, how many came, how many were requested.
    pub(super) fn read(&self) -> (u64, u64, u64) {
        (self.end, self.came, self.asked)
    }

    /// Those read so far, none of which is waiting.
    pub(super) fn after((end, came, asked): (u64, u64, u64)) -> Self {
        Self { kept: BTreeMap::new(), end, came, asked }
    }

    pub(super) fn keep(&mut self, value: Vec<u8>, by_order: bool) {
        let place = if by_order { self.came } else { self.end };
        self.came += 1;
        self.end += 4 + value.len() as u64;
        self.kept.insert(place, value);
        if self.kept.len() > MAX_APART {
            self.kept.pop_first();
        }
    }

    fn has(&self, place: u64, by_order: bool) -> bool {
        self.kept.contains_key(&if by_order { self.asked } else { place })
    }

    fn take(&mut self, place: u64, by_order: bool) -> Option<Vec<u8>> {
        let place = if by_order { self.asked } else { place };
        let value = self.kept.remove(&place)?;
        self.asked += 1;
        Some(value)
    }
}
