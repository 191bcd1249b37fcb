//! Hands messages to the port, transfer by transfer.

use cantap_wire::framing::MAX_ENCODED;

use crate::port::answers;
use crate::ports::{PACKET, Port};

/// Room for all answers and a batch after them.
const ROOM: usize = answers::ROOM + MAX_ENCODED;

/// What is on its way out.
pub struct Outbox {
    bytes: [u8; ROOM],
    len: usize,
    sent: usize,
    /// The last packet was full: without a shorter one the host would wait for more.
    must_end: bool,
}

impl Outbox {
    /// Nothing to send.
    pub const fn new() -> Self {
        Self { bytes: [0; ROOM], len: 0, sent: 0, must_end: false }
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.len = 0;
        self.sent = 0;
        self.must_end = false;
    }

    /// Whether everything has been sent, so that it can be filled again.
    pub const fn is_empty(&self) -> bool {
        self.sent == self.len
    }

    /// Lets `write` fill in what is sent next; `write` returns its length.
    pub fn fill(&mut self, write: impl FnOnce(&mut [u8]) -> usize) {
        self.len = write(&mut self.bytes).min(ROOM);
        self.sent = 0;
    }

    /// Hands bytes to the port until it takes no more or none are left.
    pub fn pump(&mut self, port: &mut impl Port) {
        while self.sent < self.len {
            let Some(taken) = port.write(&self.bytes[self.sent..self.len]) else { return };
            self.must_end = taken.is_multiple_of(PACKET);
            self.sent += taken;
        }
    }

    /// Nothing follows for now: ends the transfer with an empty packet if the last one was full (USB 2.0, 5.8.3).
    pub fn end(&mut self, port: &mut impl Port) {
        if self.must_end && self.is_empty() && port.write(&[]).is_some() {
            self.must_end = false;
        }
    }
}

impl Default for Outbox {
    fn default() -> Self {
        Self::new()
    }
}
