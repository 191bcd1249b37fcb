//! Texts whose lines end with a carriage return alone, as some old programs and terminals save them.

use std::io::{self, Read};

/// Whether text that begins so has no other line ends, but for one that a shell put at its end. One at the very end may be half of `\r\n`.
/// BEL is an slcan adapter's answer.
pub(crate) fn ends_lines(head: &[u8]) -> bool {
    const BEL: u8 = 7;
    let head = head.strip_suffix(b"\n").unwrap_or(head);
    let is_text = |byte: &u8| *byte >= b' ' || matches!(*byte, b'\r' | b'\t' | BEL);
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
