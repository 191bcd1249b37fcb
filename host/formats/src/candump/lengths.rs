//! Remembers how long an identifier's frames were, which distinguishes a cut last line from a short frame.

use cantap_can::Id;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Lengths of the longest data frames of recent identifiers.
pub(super) struct Lengths {
    places: Box<[(u32, u8); Self::PLACES]>,
    /// Whether there was any data frame.
    pub(super) any: bool,
}

impl Lengths {
    /// More identifiers than most buses have, but few enough for the processor's cache.
    const PLACES: usize = 512;
    const EXTENDED: u32 = 1 << 31;

    #[inline]
    fn key(id: Id) -> (usize, u32) {
        let raw = id.raw();
        let place = (raw ^ raw >> 9 ^ raw >> 18) as usize % Self::PLACES;
        (place, raw | if id.is_extended() { Self::EXTENDED } else { 0 })
    }

    #[inline]
    pub(super) fn note(&mut self, id: Id, dlc: u8) {
        let (place, key) = Self::key(id);
        let (known, longest) = &mut self.places[place];
        *longest = if *known == key { dlc.max(*longest) } else { dlc };
        *known = key;
        self.any = true;
    }

    pub(super) fn of(&self, id: Id) -> Option<u8> {
        let (place, key) = Self::key(id);
        let (known, len) = self.places[place];
        (known == key).then_some(len)
    }
}

impl Default for Lengths {
    fn default() -> Self {
        // No identifier has this value.
        Self { places: Box::new([(u32::MAX, 0); Self::PLACES]), any: false }
    }
}

/// Only what is known: most places are free.
impl Serialize for Lengths {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let places = self.places.iter().zip(0_u16..);
        let known: Vec<_> = places.filter(|((key, _), _)| *key != u32::MAX).collect();
        (self.any, known).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Lengths {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let (any, known) = <(bool, Vec<((u32, u8), u16)>)>::deserialize(deserializer)?;
        let mut lengths = Self { any, ..Self::default() };
        for (length, place) in known {
            if let Some(free) = lengths.places.get_mut(usize::from(place)) {
                *free = length;
            }
        }
        Ok(lengths)
    }
}
