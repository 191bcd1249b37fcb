//! Marks for identifiers: one without its mark is in no list, which most frames on a bus need to know quickly.

use cantap_trace::Id;

/// A set of identifiers that may have others in it, too.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Marks([u64; 16]);

impl Marks {
    /// Word and bit. Neighbouring identifiers, common on most buses, have different marks.
    const fn place(id: Id) -> (usize, u64) {
        let mark = id.raw() ^ id.raw() >> 10 ^ id.raw() >> 20;
        ((mark >> 6 & 15) as usize, 1 << (mark & 63))
    }

    pub fn set(&mut self, id: Id) {
        let (word, bit) = Self::place(id);
        self.0[word] |= bit;
    }

    pub fn may_have(&self, id: Id) -> bool {
        let (word, bit) = Self::place(id);
        self.0[word] & bit != 0
    }
}
