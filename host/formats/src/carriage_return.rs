//! Texts whose lines end with a carriage return alone, as some old programs and terminals save them.

use std::io::{self, Read};

/// Whether text that begins so has no other line ends. One at the very end may be half of `\r\n`.
pub(crate) fn ends_lines(head: &[u8]) -> bool {
    let is_text = |byte: &u8| *byte >= b' ' || matches!(byte, b'\r' | b'\t');
    head.iter().all(is_text) && memchr::memchr_iter(b'\r', head).nth(1).is_some()
}

/// Ends lines with `\n` in their place.
pub(crate) struct ToLineFeed<R>(pub(crate) R);

impl<R: Read> Read for ToLineFeed<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let len = self.0.read(out)?;
        for byte in out[..len].iter_mut().filter(|byte| **byte == b'\r') {
            *byte = b'\n';
        }
        Ok(len)
    }
}
