//! The answer to the last request until the outbox has room for it, as the bytes that will be sealed: an answer carried as a
//! value has the size of the largest, and each move copies all of it.

use cantap_wire::framing::{CRC_LEN, MAX_REQUEST, seal};
use cantap_wire::message::write_response;
use cantap_wire::{Refusal, Reply};

/// Largest response before CRC and COBS: saved settings with as many filters as there can be, 12 bytes each.
const MAX_RESPONSE: usize = MAX_REQUEST;

/// At most one answer.
pub struct Pending {
    message: [u8; MAX_RESPONSE + CRC_LEN],
    len: usize,
}

impl Pending {
    /// No answer.
    pub const fn new() -> Self {
        Self { message: [0; MAX_RESPONSE + CRC_LEN], len: 0 }
    }

    /// Forgets it.
    pub const fn clear(&mut self) {
        self.len = 0;
    }

    /// Whether there is none.
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Keeps the answer to the request with this id.
    pub fn set(&mut self, id: u16, result: &Result<Reply, Refusal>) {
        // Cannot fail: every response is shorter (tested).
        self.len = write_response(id, result, &mut self.message[..MAX_RESPONSE]).unwrap_or(0);
    }

    /// Writes it, encoded, to `out`, returns its length and forgets it. A zero goes first: a packet of the last session may
    /// still have been in the endpoint when this one began, and the zero ends what it left unfinished.
    pub fn take(&mut self, out: &mut [u8]) -> usize {
        let len = core::mem::take(&mut self.len);
        let Some((end, out)) = out.split_first_mut() else { return 0 };
        *end = 0;
        // Cannot fail: the outbox has room for the largest message.
        1 + seal(&mut self.message, len, out).unwrap_or(0)
    }
}

impl Default for Pending {
    fn default() -> Self {
        Self::new()
    }
}
