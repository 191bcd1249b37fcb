//! The FIFOs of OTG_FS: words, not packets. What a driver leaves behind in one stays there and gets
//! in the way of what follows, as in the chip.

use std::collections::VecDeque;

/// One word of the receive FIFO. The chip distinguishes status words from data only by their
/// position; the model marks them, so that it notices when a driver takes one for the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RxWord {
    Status(u32),
    Data(u32),
}

/// The one receive FIFO that all OUT endpoints share, with its status queue.
#[derive(Debug, Default)]
pub struct RxFifo {
    words: VecDeque<RxWord>,
    statuses: usize,
}

impl RxFifo {
    /// Words in it.
    pub fn len(&self) -> usize {
        self.words.len()
    }

    /// Whether a packet's status is waiting.
    pub fn has_status(&self) -> bool {
        self.statuses > 0
    }

    /// Appends a status word with the data of its packet.
    pub fn push(&mut self, endpoint: u8, state: u32, toggle: bool, data: &[u8]) {
        let status = u32::from(endpoint) | (data.len() as u32) << 4 | u32::from(toggle) << 16 | state << 17;
        self.words.push_back(RxWord::Status(status));
        self.statuses += 1;
        for piece in data.chunks(4) {
            let mut word = [0; 4];
            word[..piece.len()].copy_from_slice(piece);
            self.words.push_back(RxWord::Data(u32::from_le_bytes(word)));
        }
    }

    /// Appends an impossible status, without data.
    pub fn push_bogus(&mut self, status: u32) {
        self.words.push_back(RxWord::Status(status));
        self.statuses += 1;
    }

    /// The status at the front, without removing it.
    pub fn peek_status(&self) -> Option<u32> {
        match self.words.front() {
            Some(RxWord::Status(status)) => Some(*status),
            _ => None,
        }
    }

    /// Takes the status at the front.
    pub fn pop_status(&mut self) -> Option<u32> {
        let status = self.peek_status()?;
        self.words.pop_front();
        self.statuses -= 1;
        Some(status)
    }

    /// Takes the data word at the front.
    pub fn pop_data(&mut self) -> Option<u32> {
        match self.words.front() {
            Some(&RxWord::Data(word)) => {
                self.words.pop_front();
                Some(word)
            }
            _ => None,
        }
    }

    /// Empties it.
    pub fn flush(&mut self) {
        self.words.clear();
        self.statuses = 0;
    }
}

/// A transmit FIFO.
#[derive(Debug, Default)]
pub struct TxFifo {
    words: VecDeque<u32>,
}

impl TxFifo {
    /// Words in it.
    pub fn len(&self) -> usize {
        self.words.len()
    }

    /// Appends a word.
    pub fn push(&mut self, word: u32) {
        self.words.push_back(word);
    }

    /// Whether it holds a packet of `bytes` bytes.
    pub fn holds(&self, bytes: usize) -> bool {
        self.words.len() >= bytes.div_ceil(4)
    }

    /// A copy of the first `bytes` bytes.
    pub fn front(&self, bytes: usize) -> Vec<u8> {
        let mut packet: Vec<u8> =
            self.words.iter().take(bytes.div_ceil(4)).flat_map(|word| word.to_le_bytes()).collect();
        packet.truncate(bytes);
        packet
    }

    /// Drops the words of a packet of `bytes` bytes.
    pub fn consume(&mut self, bytes: usize) {
        self.words.drain(..bytes.div_ceil(4).min(self.words.len()));
    }

    /// Empties it.
    pub fn flush(&mut self) {
        self.words.clear();
    }
}
