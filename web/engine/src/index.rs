//! Which rows belong to an identifier: so that a signal of one message does not go through the whole trace.

use cantap_trace::Id;
use rustc_hash::FxHashMap;

use crate::error::EngineError;
use crate::store::Store;

/// So many identifiers have a list. Random or hostile traffic may have half a billion; frames of those beyond are found in the trace
/// alone, and are counted.
const MOST_LISTS: usize = 65_536;

/// One identifier on one channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Place {
    /// From 1.
    pub channel: u8,
    /// The identifier.
    pub id: Id,
}

/// The rows of each identifier, in the order of their times.
#[derive(Default)]
pub struct Index {
    lists: Vec<(Place, Vec<u32>)>,
    /// Frames of each list that are no longer kept.
    gone: Vec<usize>,
    by_place: FxHashMap<Place, usize>,
    scanned: usize,
    unlisted: u64,
}

impl Index {
    /// Takes the rows that are new. Returns whether rows that were there before may have another place now.
    pub fn extend(&mut self, store: &Store) -> bool {
        if self.scanned == store.len() {
            return false;
        }
        // The previous frame's list: traffic comes in bursts, and a comparison is cheaper than a look-up.
        let mut latest: Option<(Place, usize)> = None;
        store.each_key(self.scanned, |row, key| {
            let Some(id) = key.id else { return };
            let place = Place { channel: key.channel, id };
            let list = match latest {
                Some((known, list)) if known == place => Some(list),
                _ => self.list(place),
            };
            latest = list.map(|list| (place, list));
            match list {
                Some(list) => self.lists[list].1.push(row as u32),
                None => self.unlisted += 1,
            }
        });
        self.scanned = store.len();
        if store.is_unordered() {
            for (_, rows) in &mut self.lists {
                rows.sort_by_key(|row| store.time_ns(*row as usize));
            }
        }
        store.is_unordered()
    }

    /// The first rows are no longer there: the others have lower numbers now.
    pub fn forget_first(&mut self, forgotten: usize) {
        for ((_, rows), gone) in self.lists.iter_mut().zip(&mut self.gone) {
            *gone += shift(rows, forgotten);
        }
        self.scanned = self.scanned.saturating_sub(forgotten);
    }

    fn list(&mut self, place: Place) -> Option<usize> {
        if let Some(list) = self.by_place.get(&place) {
            return Some(*list);
        }
        if self.lists.len() >= MOST_LISTS {
            return None;
        }
        self.lists.push((place, Vec::new()));
        self.gone.push(0);
        self.by_place.insert(place, self.lists.len() - 1);
        Some(self.lists.len() - 1)
    }

    /// The rows of an identifier; none if it does not occur.
    pub fn rows(&self, place: Place) -> &[u32] {
        self.by_place.get(&place).map_or(&[], |list| &self.lists[*list].1)
    }

    /// How many frames an identifier had, kept or not.
    pub fn frames(&self, place: Place) -> usize {
        self.by_place.get(&place).map_or(0, |list| self.gone[*list] + self.lists[*list].1.len())
    }

    /// All identifiers in the order in which they first came, with their rows.
    pub fn all(&self) -> impl Iterator<Item = (Place, &[u32])> {
        self.lists.iter().map(|(place, rows)| (*place, rows.as_slice()))
    }

    /// Frames whose identifier has no list.
    pub const fn unlisted(&self) -> u64 {
        self.unlisted
    }
}

/// Takes rows from a list that are no longer there, and gives the others their lower numbers. Returns how many were taken.
pub fn shift(rows: &mut Vec<u32>, forgotten: usize) -> usize {
    let before = rows.len();
    rows.retain_mut(|row| match (*row as usize).checked_sub(forgotten) {
        Some(shifted) => {
            *row = shifted as u32;
            true
        }
        None => false,
    });
    before - rows.len()
}

/// Where in a list the rows from this time on begin.
pub fn first_at(rows: &[u32], store: &Store, time_ns: i64) -> usize {
    rows.partition_point(|row| store.time_ns(*row as usize) < time_ns)
}

/// Where in a list those after this time begin.
pub fn first_after(rows: &[u32], store: &Store, time_ns: i64) -> usize {
    rows.partition_point(|row| store.time_ns(*row as usize) <= time_ns)
}

/// The rows of a list from one time to another.
pub fn window<'a>(rows: &'a [u32], store: &Store, from_ns: i64, to_ns: i64) -> &'a [u32] {
    let first = first_at(rows, store, from_ns);
    let end = first_after(rows, store, to_ns).max(first);
    &rows[first..end]
}

/// The identifier of a request.
pub fn identifier(id: u32, extended: bool) -> Result<Id, EngineError> {
    let id_of = if extended { Id::extended(id) } else { Id::standard(id) };
    id_of.ok_or(EngineError::BadId(id))
}
