//! Answers to requests, held until the outbox has room for them. They are kept as encoded bytes: as a value, every answer
//! has the size of the largest, and each move copies all of it.

use cantap_wire::framing::{CRC_LEN, MAX_REQUEST, max_encoded_len, seal};
use cantap_wire::message::write_response;
use cantap_wire::{Refusal, Reply};

/// Largest response before CRC and COBS: saved settings with as many filters as there can be, 12 bytes each.
const MAX_RESPONSE: usize = MAX_REQUEST;
/// Largest answer on the wire, with the zero in front of it.
const MAX_ANSWER: usize = 1 + max_encoded_len(MAX_RESPONSE);
/// Room for the longest answer and short ones before it: those to the requests that a host has under way while a batch goes
/// out.
pub const ROOM: usize = MAX_ANSWER + 256;

/// Answers in the order of their requests.
pub struct Answers {
    encoded: [u8; ROOM],
    len: usize,
    /// Where each answer is written before it is encoded. Kept here, because clearing it on the stack would cost more than
    /// most answers do.
    message: [u8; MAX_RESPONSE + CRC_LEN],
}

impl Answers {
    /// No answers.
    pub const fn new() -> Self {
        Self { encoded: [0; ROOM], len: 0, message: [0; MAX_RESPONSE + CRC_LEN] }
    }

    /// Forgets them.
    pub const fn clear(&mut self) {
        self.len = 0;
    }

    /// Whether there is room for another answer of any size.
    pub const fn have_room(&self) -> bool {
        ROOM - self.len >= MAX_ANSWER
    }

    /// Adds the answer to the request with this id. A zero goes first: a packet of the last session may still have been in
    /// the endpoint when this one began, and the zero ends whatever it left unfinished.
    pub fn add(&mut self, id: u16, result: &Result<Reply, Refusal>) {
        let Some((end, out)) = self.encoded[self.len..].split_first_mut() else { return };
        // Cannot fail: every response is shorter (tested), and there is room for the longest.
        let len = write_response(id, result, &mut self.message[..MAX_RESPONSE]).unwrap_or(0);
        let Some(encoded) = seal(&mut self.message, len, out) else { return };
        *end = 0;
        self.len += 1 + encoded;
    }

    /// Moves the answers to `out`, which holds [`ROOM`] bytes, and returns their length.
    pub fn take(&mut self, out: &mut [u8]) -> usize {
        let len = core::mem::take(&mut self.len);
        let Some(out) = out.get_mut(..len) else { return 0 };
        out.copy_from_slice(&self.encoded[..len]);
        len
    }
}

impl Default for Answers {
    fn default() -> Self {
        Self::new()
    }
}
