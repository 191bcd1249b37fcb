//! An index: what it has, and as bytes.

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use super::blocks::{Blocks, Digest};
use super::identity::Identity;
use super::{BLOCK_BYTES, STEP_BYTES};
use crate::LeftOut;

/// Which cantap made it: other decoders may have another state, or read something else out of the same bytes. So it has the hash of the
/// sources, which `build.rs` makes, besides the version, which stands for those of other packages.
const MADE_BY: &str =
    concat!("cantap index, ", env!("CARGO_PKG_VERSION"), ", ", env!("CANTAP_FORMATS_SOURCES"));

/// Longest description of what was left out.
const MOST_TEXT_BYTES: usize = 400;
/// Descriptions that are kept until the program ends.
const MOST_TEXTS: usize = 256;

/// Where to read on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Place {
    pub offset: u64,
    /// Lines before it.
    pub lines: u64,
    /// What the decoder knows.
    pub state: Vec<u8>,
}

/// What is between two places.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Part {
    pub records: u64,
    /// The earliest and the latest time.
    pub min_ns: i64,
    pub max_ns: i64,
    /// Something in it is wrong: what, only reading it tells.
    pub has_issues: bool,
    /// Of its records.
    pub channels: Vec<u8>,
    pub notes: Vec<(u32, u64)>,
    pub left_out: Vec<(u32, u64)>,
}

/// A file's index.
#[derive(Clone, Debug, Default)]
pub(super) struct Index {
    pub identity: Option<Identity>,
    /// Whether the file is read at many places: then there are no digests.
    pub is_random: bool,
    /// Where its data is, if it is read at many places: what a decoder needs besides a place's state.
    pub layout: Vec<u8>,
    /// Of the first record.
    pub first_ns: Option<i64>,
    pub places: Vec<Place>,
    /// One less than places.
    pub parts: Vec<Part>,
    texts: Vec<&'static str>,
    pub blocks: Blocks,
}

/// As it stands in its file.
#[derive(Serialize, Deserialize)]
struct Stored<'a> {
    made_by: &'a str,
    /// What it depends on besides the file: how that is read.
    how: &'a str,
    identity: Option<Identity>,
    is_random: bool,
    #[serde(borrow)]
    layout: &'a [u8],
    first_ns: Option<i64>,
    places: Vec<Place>,
    parts: Vec<Part>,
    #[serde(borrow)]
    texts: Vec<&'a str>,
    digests: Vec<Digest>,
}

/// A text of the same content that stays; `None` if there are too many, or if it is not one of ours.
fn kept(text: &str) -> Option<&'static str> {
    use std::sync::{Mutex, PoisonError};
    static KEPT: Mutex<Vec<&'static str>> = Mutex::new(Vec::new());
    let mut kept = KEPT.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(known) = kept.iter().find(|known| **known == text) {
        return Some(known);
    }
    let is_fine = text.len() <= MOST_TEXT_BYTES && !text.contains(cantap_trace::clean::is_harmful);
    (is_fine && kept.len() < MOST_TEXTS).then(|| {
        kept.push(Box::leak(Box::from(text)));
        kept[kept.len() - 1]
    })
}

impl Index {
    /// One without parts.
    pub(super) fn beginning_at(place: Place, is_random: bool) -> Self {
        Self { places: vec![place], is_random, ..Self::default() }
    }

    /// The last place.
    pub(super) fn end(&self) -> Option<&Place> {
        self.places.last()
    }

    /// Adds what was read since the last place, up to this one.
    pub(super) fn add(&mut self, part: Part, place: Place) {
        self.parts.push(part);
        self.places.push(place);
    }

    /// Keeps what is about the first `bytes` of the file.
    pub(super) fn cut(&mut self, bytes: u64) {
        let places = self.places.iter().take_while(|place| place.offset <= bytes).count();
        self.places.truncate(places);
        self.parts.truncate(places.saturating_sub(1));
        // The first record may be behind that, and be another one now.
        if self.parts.iter().all(|part| part.records == 0) {
            self.first_ns = None;
        }
    }

    /// How much there is of what, as a part has it.
    fn counted(&mut self, counts: &LeftOut, before: &LeftOut) -> Vec<(u32, u64)> {
        let before = |what| before.iter().find(|(known, _)| *known == what).map_or(0, |(_, count)| count);
        let mut counted = Vec::new();
        for (what, count) in counts.iter() {
            let more = count.saturating_sub(before(what));
            if more > 0 {
                let known = self.texts.iter().position(|text| *text == what);
                let number = known.unwrap_or_else(|| {
                    self.texts.push(what);
                    self.texts.len() - 1
                });
                counted.push((number as u32, more));
            }
        }
        counted
    }

    /// Puts into a part what was noted and left out up to its end and before it.
    pub(super) fn count(&mut self, part: &mut Part, notes: [&LeftOut; 2], left_out: [&LeftOut; 2]) {
        part.notes = self.counted(notes[0], notes[1]);
        part.left_out = self.counted(left_out[0], left_out[1]);
    }

    /// Adds what would have been noted and left out in a part that was passed over.
    pub(super) fn pass(&self, part: &Part, notes: &mut LeftOut, left_out: &mut LeftOut) {
        for (counts, sum) in [(&part.notes, notes), (&part.left_out, left_out)] {
            for (number, count) in counts {
                if let Some(what) = self.texts.get(*number as usize) {
                    sum.add(what, *count);
                }
            }
        }
    }

    /// Its file's content.
    pub(super) fn to_bytes(&self, how: &str) -> Option<Vec<u8>> {
        let stored = Stored {
            made_by: MADE_BY,
            how,
            identity: self.identity,
            is_random: self.is_random,
            layout: &self.layout,
            first_ns: self.first_ns,
            places: self.places.clone(),
            parts: self.parts.clone(),
            texts: self.texts.clone(),
            digests: self.blocks.digests.clone(),
        };
        let mut bytes = Vec::new();
        super::save(&stored, &mut bytes).then_some(())?;
        bytes.extend(Sha256::digest(&bytes));
        Some(bytes)
    }

    /// What a file has; `None` if it is not whole, not of this version, about another way of reading, or contradicts itself.
    pub(super) fn of_bytes(bytes: &[u8], how: &str) -> Option<Self> {
        let (bytes, sum) = bytes.split_last_chunk::<32>()?;
        (Sha256::digest(bytes)[..] == sum[..]).then_some(())?;
        let (stored, rest): (Stored<'_>, _) = postcard::take_from_bytes(bytes).ok()?;
        let texts = stored.texts.iter().map(|text| kept(text)).collect::<Option<Vec<_>>>()?;
        let blocks = Blocks { digests: stored.digests, differs: false };
        let places = &stored.places;
        let is_known =
            |counts: &[(u32, u64)]| counts.iter().all(|(number, _)| (*number as usize) < texts.len());
        let is_one = rest.is_empty()
            && stored.made_by == MADE_BY
            && stored.how == how
            && stored.parts.len() + 1 == places.len()
            && places
                .windows(2)
                .all(|pair| pair[0].offset < pair[1].offset && pair[0].lines <= pair[1].lines)
            && (stored.is_random && stored.identity.is_some()
                || places.last().is_some_and(|end| end.offset <= blocks.bytes()))
            && stored.parts.iter().all(|part| is_known(&part.notes) && is_known(&part.left_out));
        is_one.then_some(())?;
        let Stored { identity, is_random, layout, first_ns, places, parts, .. } = stored;
        let layout = layout.to_vec();
        Some(Self { identity, is_random, layout, first_ns, places, parts, texts, blocks })
    }

    /// Whether it is time for another place.
    pub(super) fn is_due(&self, offset: u64) -> bool {
        self.end().is_some_and(|end| offset >= end.offset + STEP_BYTES)
    }

    /// The part that begins at this place of the file.
    pub(super) fn at(&self, offset: u64) -> Option<usize> {
        self.places.binary_search_by_key(&offset, |place| place.offset).ok()
    }

    /// Keeps only what its digests prove.
    pub(super) fn prove(&mut self) {
        if self.is_random {
            return;
        }
        self.cut(self.blocks.bytes());
        let needed = self.end().map_or(0, |end| end.offset.div_ceil(BLOCK_BYTES as u64));
        self.blocks.digests.truncate(needed as usize);
    }
}
