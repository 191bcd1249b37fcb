//! Bytes from the host, collected until a whole request or line is there.

/// Room for bytes: six of the longest requests to send.
const INBOX: usize = 4096;

/// Received bytes in order.
pub struct Inbox {
    bytes: [u8; INBOX],
    /// The first unread byte: the rest moves to the front only when room is short.
    start: usize,
    /// One past the last byte.
    end: usize,
    /// What [`Self::take_until`] last looked for, and how many of the unread bytes are known not to match.
    searched: (u8, usize),
    /// In the middle of something too long: everything up to the next end is thrown away.
    skipping: bool,
}

impl Inbox {
    /// Empty.
    pub const fn new() -> Self {
        Self { bytes: [0; INBOX], start: 0, end: 0, searched: (0, 0), skipping: false }
    }

    /// Forgets everything.
    pub const fn clear(&mut self) {
        self.start = 0;
        self.end = 0;
        self.searched.1 = 0;
        self.skipping = false;
    }

    fn unread(&self) -> &[u8] {
        &self.bytes[self.start..self.end]
    }

    /// Appends a packet, all or none; returns whether there was room.
    pub fn push(&mut self, packet: &[u8]) -> bool {
        if packet.len() > INBOX - self.end {
            self.bytes.copy_within(self.start..self.end, 0);
            self.end -= self.start;
            self.start = 0;
        }
        let Some(room) = self.bytes.get_mut(self.end..self.end + packet.len()) else { return false };
        room.copy_from_slice(packet);
        self.end += packet.len();
        true
    }

    /// How many bytes there is room for.
    pub const fn room(&self) -> usize {
        INBOX - (self.end - self.start)
    }

    /// The first byte.
    pub fn first(&self) -> Option<u8> {
        self.unread().first().copied()
    }

    /// Drops the first bytes.
    pub fn skip(&mut self, count: usize) {
        self.start = self.end.min(self.start + count);
        self.searched.1 = 0;
    }

    /// The end of something too long has been reached: what follows is read again. Returns whether something was being thrown
    /// away.
    pub const fn end_skipping(&mut self) -> bool {
        core::mem::replace(&mut self.skipping, false)
    }

    /// Throws away an unfinished line, which is whatever precedes a zero that comes before the next `end`. Returns whether
    /// there was one.
    pub fn drop_unfinished(&mut self, end: u8) -> bool {
        match self.unread().iter().position(|&byte| byte == 0 || byte == end) {
            Some(at) if self.unread()[at] == 0 => {
                self.skipping = false;
                self.skip(at);
                true
            }
            _ => false,
        }
    }

    /// Passes `read` the bytes before the first `end`, then drops them together with it. `None` if there
    /// is no `end` yet; `Some(None)` if something longer than `max` was thrown away.
    pub fn take_until<R>(&mut self, end: u8, max: usize, read: impl FnOnce(&[u8]) -> R) -> Option<Option<R>> {
        let searched = if self.searched.0 == end { self.searched.1 } else { 0 };
        let Some(at) = position(&self.unread()[searched..], end) else {
            self.searched = (end, self.unread().len());
            if self.unread().len() > max {
                self.skipping = true;
                self.skip(self.unread().len());
            }
            return None;
        };
        let at = searched + at;
        let good = !self.skipping && at <= max;
        self.skipping = false;
        let result = good.then(|| read(&self.unread()[..at]));
        self.skip(at + 1);
        Some(result)
    }
}

impl Default for Inbox {
    fn default() -> Self {
        Self::new()
    }
}

/// The first position of a byte; four bytes are checked at a time.
fn position(bytes: &[u8], wanted: u8) -> Option<usize> {
    let (words, rest) = bytes.as_chunks::<4>();
    for (index, word) in words.iter().enumerate() {
        let word = u32::from_le_bytes(*word) ^ u32::from_le_bytes([wanted; 4]);
        // The lowest bit 7 that is set belongs to the first byte that is zero: subtracting 1 borrows there first.
        let found = word.wrapping_sub(0x0101_0101) & !word & 0x8080_8080;
        if found != 0 {
            return Some(4 * index + found.trailing_zeros() as usize / 8);
        }
    }
    let at = rest.iter().position(|&byte| byte == wanted)?;
    Some(4 * words.len() + at)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pushes messages of growing length and takes each a few pushes later, so that the unread bytes wrap past the end many
    /// times.
    #[test]
    fn messages_come_out_as_they_went_in_wherever_they_lie() {
        let mut inbox = Inbox::new();
        let message = |n: usize| vec![n as u8 | 1; n * 7 % 600];
        let take = |inbox: &mut Inbox, n| {
            assert_eq!(inbox.take_until(0, 600, <[u8]>::to_vec), Some(Some(message(n))), "message {n}");
        };
        for n in 0..1000 {
            let sent = [&message(n)[..], &[0]].concat();
            assert!(sent.chunks(64).all(|packet| inbox.push(packet)), "message {n}");
            if n >= 2 {
                take(&mut inbox, n - 2);
            }
        }
        take(&mut inbox, 998);
        take(&mut inbox, 999);
        assert_eq!(inbox.first(), None);
    }

    #[test]
    fn the_first_of_a_byte_is_found_wherever_it_lies() {
        let mut random = fastrand::Rng::with_seed(3);
        for _ in 0..20_000 {
            let bytes: Vec<u8> = (0..random.usize(..12)).map(|_| random.u8(..) & 0x81).collect();
            for wanted in [0, 1, 0x80] {
                assert_eq!(
                    position(&bytes, wanted),
                    bytes.iter().position(|&byte| byte == wanted),
                    "{bytes:?}"
                );
            }
        }
    }

    #[test]
    fn all_of_the_room_is_used_and_what_does_not_fit_is_left_out_whole() {
        let mut inbox = Inbox::new();
        assert!(inbox.push(&[7; INBOX - 1]));
        assert!(!inbox.push(&[8; 2]));
        inbox.skip(1);
        assert!(inbox.push(&[8; 2]));
        assert!(!inbox.push(&[9]));
        assert!(inbox.push(&[]));
        inbox.skip(INBOX - 2);
        assert_eq!(inbox.unread(), [8; 2]);
        inbox.skip(INBOX);
        assert_eq!(inbox.first(), None);
    }
}
