//! The chip's storage: the firmware's own log of settings, in a sector that a file can keep.

use std::path::{Path, PathBuf};

use cantap_firmware::saved::{self, ERASED, Sector};

/// Words of the sector: 16 KiB, the smallest of the chip's (RM0090 Rev 21 §3.4, table 5).
const WORDS: usize = 16 * 1024 / 4;

/// One sector of flash. Without a file it lasts as long as the virtual device.
pub struct Flash {
    words: Vec<u32>,
    file: Option<PathBuf>,
}

impl Flash {
    /// Erased, or as an earlier device left it in the file. A file that does not exist yet, or is something else, reads
    /// as erased.
    pub fn new(file: Option<PathBuf>) -> Self {
        let kept = file.as_ref().and_then(|file| std::fs::read(file).ok()).unwrap_or_default();
        let mut words: Vec<u32> = kept
            .chunks_exact(4)
            .map(|word| u32::from_le_bytes([word[0], word[1], word[2], word[3]]))
            .take(WORDS)
            .collect();
        words.resize(WORDS, ERASED);
        Self { words, file }
    }

    /// Whether the file may be written: there is none, it is empty, or it is as long as such a file is. Anything else was not written here.
    fn may_write(file: &Path) -> bool {
        match file.metadata() {
            Ok(there) => there.is_file() && [0, (WORDS * 4) as u64].contains(&there.len()),
            Err(error) => error.kind() == std::io::ErrorKind::NotFound,
        }
    }

    /// Saves like the board. Returns whether it worked and, if there is a file, whether it was written.
    pub fn save(&mut self, bytes: &[u8]) -> bool {
        let saved = saved::save(self, bytes);
        let kept = self.file.as_ref().is_none_or(|file| {
            let image: Vec<u8> = self.words.iter().flat_map(|word| word.to_le_bytes()).collect();
            Self::may_write(file) && std::fs::write(file, image).is_ok()
        });
        saved && kept
    }

    /// Reads what was last saved into `out`, and returns its length.
    pub fn load(&self, out: &mut [u8]) -> usize {
        saved::load(self, out)
    }
}

impl Sector for Flash {
    fn words(&self) -> &[u32] {
        &self.words
    }

    fn program(&mut self, index: usize, word: u32) -> bool {
        // Programming only clears bits.
        self.words[index] &= word;
        self.words[index] == word
    }

    fn erase(&mut self) -> bool {
        self.words.fill(ERASED);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An address may name any file.
    #[test]
    fn a_file_that_was_not_written_here_is_not_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let (notes, settings) = (folder.path().join("notes.txt"), folder.path().join("settings.bin"));
        std::fs::write(&notes, "mine").unwrap();
        assert!(!Flash::new(Some(notes.clone())).save(&[1, 2, 3, 4]));
        assert_eq!(std::fs::read_to_string(&notes).unwrap(), "mine");
        for bytes in [[1, 2, 3, 4], [5, 6, 7, 8]] {
            assert!(Flash::new(Some(settings.clone())).save(&bytes));
            let mut out = [0; 4];
            assert_eq!((Flash::new(Some(settings.clone())).load(&mut out), out), (4, bytes));
        }
    }
}
