//! Keeps a few bytes across power cycles: a log in one sector of flash.
//!
//! Flash can be written word by word, but only erased a whole sector at a time, which on the board takes up to two
//! seconds during which no instruction runs. So each save is appended, the newest is the one that counts, and the
//! sector is erased only when it is full: once in some sixty saves of the largest size.
//!
//! An entry is a head (a mark and the length), the bytes in whole words, and their checksum. If a loss
//! of power cuts a save off, the previous one remains in force.

use cantap_wire::framing::checksum;

/// One erasable sector of flash, as words.
pub trait Sector {
    /// Its words; an erased one reads [`ERASED`].
    fn words(&self) -> &[u32];
    /// Writes one erased word; false if it does not read back.
    fn program(&mut self, index: usize, word: u32) -> bool;
    /// Erases the whole sector; false if that failed.
    fn erase(&mut self) -> bool;
}

/// The value of an erased word.
pub const ERASED: u32 = u32::MAX;

/// Upper half of an entry's head; the lower is the length in bytes.
const MARK: u32 = 0xCA17_0000;
const MARK_MASK: u32 = 0xFFFF_0000;

/// Words around an entry's bytes: head and checksum.
const FRAME_WORDS: usize = 2;

/// The state of the log.
struct Scan {
    /// The newest whole entry: the index of its first word of bytes, and their number.
    newest: Option<(usize, usize)>,
    /// The first word after the log, if the rest is erased.
    end: Option<usize>,
}

fn scan(words: &[u32]) -> Scan {
    let mut newest = None;
    let mut at = 0;
    loop {
        match words.get(at) {
            Some(&head) if head & MARK_MASK == MARK => {
                let len = (head & !MARK_MASK) as usize;
                let body = at + 1;
                let Some(&sum) = words.get(body + len.div_ceil(4)) else {
                    // It would reach beyond the sector, so it is not ours.
                    return Scan { newest, end: None };
                };
                if sum == checksum_of(&words[body..], len) {
                    newest = Some((body, len));
                }
                at = body + len.div_ceil(4) + 1;
            }
            Some(&ERASED) => {
                let rest_is_erased = words[at..].iter().all(|&word| word == ERASED);
                return Scan { newest, end: rest_is_erased.then_some(at) };
            }
            _ => return Scan { newest, end: None },
        }
    }
}

fn checksum_of(words: &[u32], len: usize) -> u32 {
    checksum(words.iter().flat_map(|word| word.to_le_bytes()).take(len))
}

/// Saves `bytes`; an empty slice deletes what was saved. Returns whether it worked.
pub fn save(sector: &mut impl Sector, bytes: &[u8]) -> bool {
    let needed = FRAME_WORDS + bytes.len().div_ceil(4);
    if needed > sector.words().len() || bytes.len() > !MARK_MASK as usize {
        return false;
    }
    let fits = |end: &usize| sector.words().len() - end >= needed;
    let start = match scan(sector.words()).end.filter(fits) {
        Some(end) => end,
        None if sector.erase() => 0,
        None => return false,
    };
    let mut programmed = sector.program(start, MARK | bytes.len() as u32);
    let mut at = start + 1;
    for chunk in bytes.chunks(4) {
        let mut word = ERASED.to_le_bytes();
        word[..chunk.len()].copy_from_slice(chunk);
        programmed &= sector.program(at, u32::from_le_bytes(word));
        at += 1;
    }
    programmed && sector.program(at, checksum(bytes.iter().copied()))
}

/// Reads what was last saved into `out`, as far as it fits, and returns the length read: 0 if there is nothing.
pub fn load(sector: &impl Sector, out: &mut [u8]) -> usize {
    let words = sector.words();
    let Some((body, len)) = scan(words).newest else { return 0 };
    let bytes = words[body..].iter().flat_map(|word| word.to_le_bytes()).take(len);
    out.iter_mut().zip(bytes).for_each(|(out, byte)| *out = byte);
    len.min(out.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sector that behaves as flash: programming only clears bits. Power can be cut after some words.
    struct FakeSector {
        words: Vec<u32>,
        words_left: usize,
        erasures: usize,
    }

    impl FakeSector {
        fn new(words: usize) -> Self {
            Self { words: vec![ERASED; words], words_left: usize::MAX, erasures: 0 }
        }

        fn loaded(&self) -> Vec<u8> {
            let mut out = [0; 64];
            let len = load(self, &mut out);
            out[..len].to_vec()
        }
    }

    impl Sector for FakeSector {
        fn words(&self) -> &[u32] {
            &self.words
        }

        fn program(&mut self, index: usize, word: u32) -> bool {
            if self.words_left > 0 {
                self.words_left -= 1;
                self.words[index] &= word;
            }
            self.words[index] == word
        }

        fn erase(&mut self) -> bool {
            self.words.fill(ERASED);
            self.erasures += 1;
            true
        }
    }

    #[test]
    fn the_newest_save_is_loaded() {
        let mut sector = FakeSector::new(64);
        assert_eq!(sector.loaded(), b"");
        assert!(save(&mut sector, b"first"));
        assert!(save(&mut sector, b"the second"));
        assert_eq!(sector.loaded(), b"the second");
        assert_eq!(sector.erasures, 0);
    }

    #[test]
    fn saving_nothing_forgets() {
        let mut sector = FakeSector::new(64);
        assert!(save(&mut sector, b"something"));
        assert!(save(&mut sector, b""));
        assert_eq!(sector.loaded(), b"");
    }

    #[test]
    fn a_full_sector_is_erased_and_goes_on() {
        let mut sector = FakeSector::new(16);
        for round in 0..100u32 {
            assert!(save(&mut sector, &round.to_le_bytes()));
            assert_eq!(sector.loaded(), round.to_le_bytes());
        }
        // Five entries of three words fit.
        assert_eq!(sector.erasures, 19);
    }

    #[test]
    fn a_loss_of_power_leaves_the_save_before_or_the_new_one() {
        for words_left in 0..6 {
            let mut sector = FakeSector::new(64);
            assert!(save(&mut sector, b"before"));
            sector.words_left = words_left;
            let saved = save(&mut sector, b"after, longer");
            assert_eq!(saved, words_left >= 6);
            sector.words_left = usize::MAX;
            assert_eq!(sector.loaded(), b"before", "cut off after {words_left} words");
            assert!(save(&mut sector, b"again"));
            assert_eq!(sector.loaded(), b"again", "cut off after {words_left} words");
        }
    }

    #[test]
    fn foreign_contents_are_no_save_and_are_erased_by_the_next() {
        let mut sector = FakeSector::new(64);
        sector.words[0] = 0x2000_0000;
        assert_eq!(sector.loaded(), b"");
        assert!(save(&mut sector, b"ours"));
        assert_eq!((sector.loaded(), sector.erasures), (b"ours".to_vec(), 1));
    }

    #[test]
    fn too_much_is_refused_and_nothing_changes() {
        let mut sector = FakeSector::new(8);
        assert!(save(&mut sector, b"fits"));
        assert!(!save(&mut sector, &[1; 32]));
        assert_eq!(sector.loaded(), b"fits");
    }
}
