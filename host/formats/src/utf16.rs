//! Converts texts in UTF-16, as Windows programs save them, to UTF-8.

use std::io::{self, Read};

/// The byte order of a text's words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Utf16 {
    LittleEndian,
    BigEndian,
}

/// This many bytes are enough to recognise a text in UTF-16.
pub(crate) const HEAD_BYTES: usize = 4;

impl Utf16 {
    /// Detects UTF-16 by the first [`HEAD_BYTES`]: a byte order mark, or two ASCII characters without one, with which no
    /// other format here begins.
    pub(crate) fn of_content(head: &[u8]) -> Option<Self> {
        match head {
            [0xFF, 0xFE, ..] | [9..=126, 0, 9..=126, 0, ..] => Some(Self::LittleEndian),
            [0xFE, 0xFF, ..] | [0, 9..=126, 0, 9..=126, ..] => Some(Self::BigEndian),
            _ => None,
        }
    }
}

/// Converts UTF-16 to UTF-8. Invalid characters become the replacement character, so that lines stay lines.
pub(crate) struct ToUtf8<R> {
    source: R,
    order: Utf16,
    /// Bytes read that are not yet a complete character.
    rest: Vec<u8>,
    /// Converted text; the bytes before `at` are used up.
    text: Vec<u8>,
    at: usize,
    /// Whether the source's end only means "not yet".
    grows: bool,
}

/// Bytes requested from the source at a time.
const CHUNK_BYTES: usize = 64 * 1024;

impl<R: Read> ToUtf8<R> {
    pub(crate) fn new(source: R, order: Utf16, grows: bool) -> Self {
        Self { source, order, rest: Vec::new(), text: Vec::new(), at: 0, grows }
    }

    /// Reads more; false if nothing came.
    fn fill(&mut self) -> io::Result<bool> {
        let kept = self.rest.len();
        self.rest.resize(kept + CHUNK_BYTES, 0);
        let read = self.source.read(&mut self.rest[kept..]);
        self.rest.truncate(kept + read.as_ref().map_or(0, |read| *read));
        let came = read? > 0;
        let ended = !came && !self.grows;
        let word = |pair: &[u8]| match self.order {
            Utf16::LittleEndian => u16::from_le_bytes([pair[0], pair[1]]),
            Utf16::BigEndian => u16::from_be_bytes([pair[0], pair[1]]),
        };
        let mut words: Vec<u16> = self.rest.chunks_exact(2).map(word).collect();
        // The first half of a character whose second half has not arrived.
        let halved = !ended && words.last().is_some_and(|word| (0xD800..0xDC00).contains(word));
        words.truncate(words.len() - usize::from(halved));
        let odd = ended && self.rest.len() % 2 == 1;
        self.text.clear();
        self.at = 0;
        let characters = char::decode_utf16(words.iter().copied());
        let text: String =
            characters.map(|character| character.unwrap_or(char::REPLACEMENT_CHARACTER)).collect();
        self.text.extend_from_slice(text.as_bytes());
        if odd {
            self.text.extend_from_slice("\u{fffd}".as_bytes());
            self.rest.clear();
        } else {
            self.rest.drain(..2 * words.len());
        }
        Ok(came)
    }
}

impl<R: Read> Read for ToUtf8<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while self.at == self.text.len() && self.fill()? {}
        let len = out.len().min(self.text.len() - self.at);
        out[..len].copy_from_slice(&self.text[self.at..self.at + len]);
        self.at += len;
        Ok(len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A source that delivers few bytes at a time.
    struct Slow<'a>(&'a [u8], usize);

    impl Read for Slow<'_> {
        fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
            let len = self.1.min(out.len()).min(self.0.len());
            out[..len].copy_from_slice(&self.0[..len]);
            self.0 = &self.0[len..];
            Ok(len)
        }
    }

    proptest! {
        #[test]
        fn any_text_comes_out_as_it_went_in(text: String, at_a_time in 1..9_usize) {
            let words: Vec<u16> = text.encode_utf16().collect();
            for (order, bytes) in [
                (Utf16::LittleEndian, words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>()),
                (Utf16::BigEndian, words.iter().flat_map(|word| word.to_be_bytes()).collect()),
            ] {
                let mut read = String::new();
                ToUtf8::new(Slow(&bytes, at_a_time), order, false).read_to_string(&mut read).unwrap();
                prop_assert_eq!(&read, &text);
            }
        }

        #[test]
        fn no_bytes_make_it_panic_or_give_what_is_no_text(bytes: Vec<u8>) {
            let mut read = String::new();
            ToUtf8::new(&bytes[..], Utf16::LittleEndian, false).read_to_string(&mut read).unwrap();
        }
    }
}
