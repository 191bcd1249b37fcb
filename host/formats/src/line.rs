//! A line of text built in place, for writers with many short lines: appending field by field to a growing buffer costs
//! more than formatting the fields.

use super::text;

/// No line built here is longer.
const LONGEST: usize = 80;

/// A line so far. Everything not yet written is spaces.
pub(crate) struct Line {
    bytes: [u8; LONGEST],
    len: usize,
}

impl Line {
    /// An empty line.
    #[inline]
    pub(crate) fn new() -> Self {
        Self { bytes: [b' '; LONGEST], len: 0 }
    }

    /// Appends a text.
    #[inline]
    pub(crate) fn put<const N: usize>(&mut self, text: &[u8; N]) {
        self.bytes[self.len..self.len + N].copy_from_slice(text);
        self.len += N;
    }

    /// Appends the first `len` bytes of a text. The bytes after them must be spaces or be overwritten later.
    #[inline]
    pub(crate) fn put_start<const N: usize>(&mut self, text: &[u8; N], len: usize) {
        self.put(text);
        self.len -= N - len;
    }

    /// Appends spaces.
    #[inline]
    pub(crate) fn space(&mut self, count: usize) {
        self.len += count;
    }

    /// Appends a channel or another small number in decimal digits.
    #[inline]
    pub(crate) fn put_small(&mut self, value: u8) {
        if value >= 10 {
            if value >= 100 {
                self.put(&[b'0' + value / 100]);
            }
            self.put(&[b'0' + value / 10 % 10]);
        }
        self.put(&[b'0' + value % 10]);
    }

    /// Appends a number in as many hexadecimal digits as it needs; returns how many.
    #[inline]
    pub(crate) fn put_hex(&mut self, value: u32) -> usize {
        let digits = text::hex_len(value);
        let (aligned, spaces) = (8 * (8 - digits as u32), 8 * digits as u32);
        let all = u64::from_be_bytes(text::hex_digits_of(value)) << aligned;
        let behind = u64::from_be_bytes([b' '; 8]).checked_shr(spaces).unwrap_or(0);
        self.put_start(&(all | behind).to_be_bytes(), digits);
        digits
    }

    /// Appends the whole line to a file.
    #[inline]
    pub(crate) fn end(self, out: &mut Vec<u8>) {
        // Copying a constant length is faster than copying the exact length.
        let end = out.len() + self.len;
        out.extend_from_slice(&self.bytes);
        out.truncate(end);
    }
}

/// Seconds in digits, remembered from line to line: most lines are in the same second as the one before.
pub(crate) struct Seconds<const WIDTH: usize> {
    last: u64,
    text: [u8; 24],
    len: usize,
}

impl<const WIDTH: usize> Seconds<WIDTH> {
    /// With nothing remembered.
    pub(crate) fn new() -> Self {
        let mut new = Self { last: 0, text: [b' '; 24], len: 0 };
        new.render(0);
        new
    }

    #[cold]
    fn render(&mut self, seconds: u64) {
        let mut text = Vec::with_capacity(24);
        text::push_decimal(&mut text, seconds);
        text::pad_left(&mut text, 0, WIDTH);
        text.push(b'.');
        self.len = text.len();
        self.text = [b' '; 24];
        self.text[..text.len()].copy_from_slice(&text);
        self.last = seconds;
    }

    /// Appends a time given in microseconds as seconds, right-aligned to the width, with six decimals.
    #[inline]
    pub(crate) fn put(&mut self, line: &mut Line, us: u64) {
        const US_PER_S: u64 = 1_000_000;
        let seconds = us / US_PER_S;
        if seconds != self.last {
            self.render(seconds);
        }
        line.put_start(&self.text, self.len);
        line.put(&text::six_digits((us % US_PER_S) as u32));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn text(build: impl FnOnce(&mut Line)) -> String {
        let mut line = Line::new();
        build(&mut line);
        let mut out = b"> ".to_vec();
        line.end(&mut out);
        String::from_utf8(out).unwrap()
    }

    proptest! {
        #[test]
        fn numbers_are_as_they_are_formatted_elsewhere(hex: u32, small: u8, us in prop::collection::vec(0..u64::MAX / 1000, 1..4)) {
            prop_assert_eq!(text(|line| _ = line.put_hex(hex)), format!("> {hex:X}"));
            prop_assert_eq!(text(|line| _ = line.put_hex(hex & 0xFFF)), format!("> {:X}", hex & 0xFFF));
            prop_assert_eq!(text(|line| line.put_small(small)), format!("> {small}"));
            let mut seconds = Seconds::<4>::new();
            for us in us.into_iter().flat_map(|us| [us, us % 20_000_000_000, us % 1_000_000]) {
                let expected = format!("> {:>4}.{:06}", us / 1_000_000, us % 1_000_000);
                prop_assert_eq!(text(|line| seconds.put(line, us)), expected);
            }
        }
    }
}
