//! Bytes from the host, until a whole request or line is there.

/// Room for bytes: several of the longest requests.
const INBOX: usize = 2048;

/// Received bytes in order.
pub struct Inbox {
    bytes: [u8; INBOX],
    len: usize,
    /// In the middle of something too long: all up to the next end is thrown away.
    skipping: bool,
}

impl Inbox {
    /// Empty.
    pub const fn new() -> Self {
        Self { bytes: [0; INBOX], len: 0, skipping: false }
    }

    /// Forgets everything.
    pub const fn clear(&mut self) {
        self.len = 0;
        self.skipping = false;
    }

    /// Appends a packet, all or none; returns whether there was room.
    pub fn push(&mut self, packet: &[u8]) -> bool {
        let Some(room) = self.bytes.get_mut(self.len..self.len + packet.len()) else { return false };
        room.copy_from_slice(packet);
        self.len += packet.len();
        true
    }

    /// The first byte.
    pub fn first(&self) -> Option<u8> {
        self.bytes[..self.len].first().copied()
    }

    /// Drops the first bytes.
    pub fn skip(&mut self, count: usize) {
        let count = count.min(self.len);
        self.bytes.copy_within(count..self.len, 0);
        self.len -= count;
    }

    /// The end of something too long has come: what follows is good again. Returns whether something was being thrown away.
    pub const fn end_skipping(&mut self) -> bool {
        core::mem::replace(&mut self.skipping, false)
    }

    /// Throws away an unfinished line: what stands before a zero that comes earlier than the next `end`. Returns whether there
    /// was one.
    pub fn drop_unfinished(&mut self, end: u8) -> bool {
        match self.bytes[..self.len].iter().position(|&byte| byte == 0 || byte == end) {
            Some(at) if self.bytes[at] == 0 => {
                self.skipping = false;
                self.skip(at);
                true
            }
            _ => false,
        }
    }

    /// Shows `read` what stands before the first `end`, which is then dropped with it. `None` if there is
    /// no `end` yet; `Some(None)` if something longer than `max` was thrown away.
    pub fn take_until<R>(&mut self, end: u8, max: usize, read: impl FnOnce(&[u8]) -> R) -> Option<Option<R>> {
        let Some(at) = self.bytes[..self.len].iter().position(|&byte| byte == end) else {
            if self.len > max {
                self.skipping = true;
                self.len = 0;
            }
            return None;
        };
        let good = !self.skipping && at <= max;
        self.skipping = false;
        let result = good.then(|| read(&self.bytes[..at]));
        self.skip(at + 1);
        Some(result)
    }
}

impl Default for Inbox {
    fn default() -> Self {
        Self::new()
    }
}
