//! Finds a host's requests in what it sends.

use cantap_wire::Refusal;
use cantap_wire::framing::{CRC_LEN, MAX_REQUEST, max_encoded_len, unseal};
use cantap_wire::message::{Request, why_unreadable};

/// The most bytes before a zero that can be a request.
const MOST: usize = max_encoded_len(MAX_REQUEST) - 1;

/// What came between two zeros.
#[derive(Debug, PartialEq, Eq)]
#[expect(clippy::large_enum_variant, reason = "one for each request, taken at once")]
pub enum Incoming<'a> {
    /// A request.
    Request(Request),
    /// A request of which only the number is readable, and what is wrong with it.
    Unreadable(u16, Refusal),
    /// An undamaged message that is no request. It is not answered.
    Other(&'a [u8]),
    /// Not a message. It cannot be answered: nobody can tell which request it was.
    Damaged,
}

/// Finds requests in any pieces of a stream. It holds at most one.
#[derive(Default)]
pub struct Inbox {
    partial: Vec<u8>,
    is_overlong: bool,
}

impl Inbox {
    /// Whether what is coming is longer than any request.
    pub const fn is_overlong(&self) -> bool {
        self.is_overlong
    }

    /// Takes any piece of the stream and reports what is complete.
    pub fn push(&mut self, bytes: &[u8], mut report: impl FnMut(Incoming<'_>)) {
        for &byte in bytes {
            if byte != 0 {
                if self.partial.len() < MOST {
                    self.partial.push(byte);
                } else {
                    self.is_overlong = true;
                }
                continue;
            }
            if std::mem::take(&mut self.is_overlong) {
                report(Incoming::Damaged);
            } else if !self.partial.is_empty() {
                let mut message = [0; MOST];
                report(read(&self.partial, &mut message));
            }
            self.partial.clear();
        }
    }
}

fn read<'a>(encoded: &[u8], message: &'a mut [u8; MOST]) -> Incoming<'a> {
    let Ok(message) = unseal(encoded, message) else { return Incoming::Damaged };
    match postcard::take_from_bytes(message) {
        Ok((request, _)) => Incoming::Request(request),
        Err(_) => match postcard::take_from_bytes::<u16>(message) {
            Ok((id, _)) => Incoming::Unreadable(id, why_unreadable(message)),
            Err(_) => Incoming::Other(message),
        },
    }
}

// The CRC is included in the count above.
const _: () = assert!(MOST > MAX_REQUEST + CRC_LEN);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::encode;
    use cantap_wire::Command;

    fn check(bytes: &[u8], piece: usize, expected: &[Incoming<'_>]) {
        let mut inbox = Inbox::default();
        let mut expected = expected.iter();
        for bytes in bytes.chunks(piece) {
            inbox.push(bytes, |incoming| assert_eq!(Some(&incoming), expected.next(), "{piece}"));
        }
        assert_eq!(expected.next(), None, "{piece}");
    }

    #[test]
    fn requests_are_found_in_any_pieces_and_behind_anything() {
        let request = |id| Request { id, command: Command::Time };
        let bytes = [
            b"GET / HTTP/1.1\r\n\r\n\0".to_vec(),
            encode(&request(1)).unwrap(),
            vec![0, 0],
            vec![7; 100_000],
            vec![0],
            encode(&request(2)).unwrap(),
        ]
        .concat();
        for piece in [1, 3, 1000, bytes.len()] {
            let expected = [
                Incoming::Damaged,
                Incoming::Request(request(1)),
                Incoming::Damaged,
                Incoming::Request(request(2)),
            ];
            check(&bytes, piece, &expected);
        }
    }

    #[test]
    fn a_command_that_does_not_exist_is_answered_as_malformed() {
        let mut message = [5, 127, 0, 0, 0, 0];
        let mut out = [0; 32];
        let len = cantap_wire::framing::seal(&mut message, 2, &mut out).unwrap();
        check(&out[..len], 32, &[Incoming::Unreadable(5, Refusal::Malformed)]);
    }
}
