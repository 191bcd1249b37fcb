//! The chip's storage: the firmware's own log of settings, in a sector that a file can keep.

use std::path::PathBuf;

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

    /// Saves like the board. Returns whether it worked and, if there is a file, whether it was written.
    pub fn save(&mut self, bytes: &[u8]) -> bool {
        let saved = saved::save(self, bytes);
        let kept = self.file.as_ref().is_none_or(|file| {
            let image: Vec<u8> = self.words.iter().flat_map(|word| word.to_le_bytes()).collect();
            std::fs::write(file, image).is_ok()
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
