//! A file that arrives in pieces, as something that can be read.
//!
//! A reader asks for bytes when it needs them, and cannot wait for the page to bring more. So reading goes on only while a reserve of
//! unread bytes is there. A reader that needs more than the reserve, such as one of a format that is read at many places, runs dry: then
//! what it found is dropped, and reading begins anew when twice as much is there.

use std::collections::VecDeque;
use std::io::{self, Read};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The file's bytes as far as they are there.
#[derive(Clone, Default)]
pub struct Pieces(Arc<Mutex<State>>);

#[derive(Default)]
struct State {
    pieces: VecDeque<Vec<u8>>,
    /// The first byte of `pieces[0]`, counted from the file's start.
    dropped: u64,
    /// The next byte to read: the piece's index and the place in it.
    next: (usize, usize),
    read: u64,
    received: u64,
    is_complete: bool,
    ran_dry: bool,
}

impl Pieces {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a piece; the file is complete with it unless more follows.
    pub fn add(&self, bytes: &[u8], more: bool) {
        let mut state = self.lock();
        state.received += bytes.len() as u64;
        state.is_complete = !more;
        state.pieces.push_back(bytes.to_vec());
    }

    /// Whether all of the file is there.
    pub fn is_complete(&self) -> bool {
        self.lock().is_complete
    }

    /// How many bytes have been received.
    pub fn received(&self) -> u64 {
        self.lock().received
    }

    /// How many have been read.
    pub fn read_so_far(&self) -> u64 {
        self.lock().read
    }

    /// Whether the reader came to the end of what is there although more is to come.
    pub fn ran_dry(&self) -> bool {
        self.lock().ran_dry
    }

    /// Begins anew; false if the beginning is no longer there.
    pub fn rewind(&self) -> bool {
        let mut state = self.lock();
        if state.dropped > 0 {
            return false;
        }
        (state.next, state.read, state.ran_dry) = ((0, 0), 0, false);
        true
    }

    /// Frees what has been read, after which it is not possible to begin anew.
    pub fn drop_read(&self) {
        let mut state = self.lock();
        while state.next.0 > 0 {
            let piece = state.pieces.pop_front().unwrap_or_default();
            state.dropped += piece.len() as u64;
            state.next.0 -= 1;
        }
    }
}

impl Read for Pieces {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut state = self.lock();
        let state = &mut *state;
        let (mut piece, mut at) = state.next;
        let mut copied = 0;
        while let Some(rest) =
            state.pieces.get(piece).map(|bytes| &bytes[at..]).filter(|_| copied < out.len())
        {
            let len = rest.len().min(out.len() - copied);
            out[copied..copied + len].copy_from_slice(&rest[..len]);
            copied += len;
            at += len;
            if at == state.pieces[piece].len() {
                (piece, at) = (piece + 1, 0);
            }
        }
        state.next = (piece, at);
        state.read += copied as u64;
        state.ran_dry |= copied == 0 && !out.is_empty() && !state.is_complete;
        Ok(copied)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_read_as_one_and_can_be_begun_anew_until_they_are_freed() {
        let pieces = Pieces::default();
        pieces.add(b"abc", true);
        pieces.add(b"", true);
        let mut reader = pieces.clone();
        let mut out = [0; 10];
        assert_eq!(reader.read(&mut out).unwrap(), 3);
        assert!(!pieces.ran_dry());
        assert_eq!(reader.read(&mut out).unwrap(), 0);
        assert!(pieces.ran_dry());
        pieces.add(b"def", false);
        assert!(pieces.rewind());
        let mut text = String::new();
        pieces.clone().read_to_string(&mut text).unwrap();
        assert_eq!((text.as_str(), pieces.ran_dry(), pieces.read_so_far()), ("abcdef", false, 6));
        pieces.drop_read();
        assert!(!pieces.rewind());
    }
}
