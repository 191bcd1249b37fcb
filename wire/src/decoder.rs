//! The host's end of the stream: bytes in, records and responses out.
//!
//! It holds one message and no more. Whatever the bytes are, it does not panic, accepts nothing
//! whose CRC does not match, finds the next message after garbage, and reports what is missing.

use crate::batch::BatchHeader;
use crate::framing::{FramingError, MAX_ENCODED, unseal};
use crate::message::{DeviceMessage, EndReason, Reply, Response, SessionEnd};
use crate::record::{self, Record};
use crate::{CHANNELS, PROTOCOL_VERSION};

/// Why bytes were thrown away.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Corruption {
    /// Not a message: framing or CRC.
    Framing(FramingError),
    /// More bytes without a zero than any message has.
    TooLong,
    /// A message that is not of this protocol version.
    Unknown,
    /// The last batch again. Nothing is missing.
    Repeated {
        /// Its sequence number.
        sequence: u32,
    },
    /// A batch that is older than one already seen. A device never goes back within a session: this one belongs to
    /// another session, and how many frames are missing cannot be known.
    OutOfOrder {
        /// Its sequence number.
        sequence: u32,
    },
    /// A batch whose records end in something unreadable. The records before it are good, and the
    /// next batch's [`Decoded::BatchesLost`] counts the frames that follow it.
    Records,
}

/// What [`Decoder::push`] reports.
#[derive(Clone, Debug, PartialEq, Eq)]
#[allow(clippy::large_enum_variant, reason = "responses are rare and passed by reference")]
pub enum Decoded<'a> {
    /// A record at its absolute device time.
    Record {
        /// Ticks since the device started.
        ticks: u64,
        /// The record.
        record: Record,
    },
    /// An answer.
    Response(&'a Response),
    /// Whole batches or the end of one are missing between the last record and the next.
    BatchesLost {
        /// How many whole batches.
        batches: u32,
        /// How many received frames went with them, per channel.
        frames: [u32; CHANNELS],
    },
    /// The device has ended the session; nothing more follows.
    Ended {
        /// Ticks since the device started, when both channels were off their buses.
        ticks: u64,
        /// Why.
        reason: EndReason,
    },
    /// Bytes were thrown away.
    Corrupt(Corruption),
    /// The device speaks this other protocol version.
    OtherProtocol(u16),
}

/// Decodes a device's byte stream.
pub struct Decoder {
    partial: [u8; MAX_ENCODED],
    len: usize,
    /// Everything up to the next zero is being thrown away.
    overlong: bool,
    expected: Expected,
    message: [u8; MAX_ENCODED],
}

/// What the next batch's header should say.
struct Expected {
    sequence: u32,
    frames: [u32; CHANNELS],
    /// The last batch's, to recognise a repetition.
    last: Option<BatchHeader>,
}

impl Expected {
    const FIRST: Self = Self { sequence: 0, frames: [0; CHANNELS], last: None };

    /// Compares a header with what was expected. Returns whether the batch may be read.
    fn take(&mut self, header: &BatchHeader, report: &mut impl FnMut(Decoded<'_>)) -> bool {
        let goes_back = |ahead: u32| ahead > u32::MAX / 2;
        let ahead = header.sequence.wrapping_sub(self.sequence);
        let lost =
            core::array::from_fn(|channel| header.frames_before[channel].wrapping_sub(self.frames[channel]));
        if goes_back(ahead) || lost.into_iter().any(goes_back) {
            let sequence = header.sequence;
            report(Decoded::Corrupt(if self.last.as_ref() == Some(header) {
                Corruption::Repeated { sequence }
            } else {
                Corruption::OutOfOrder { sequence }
            }));
            return false;
        }
        if ahead > 0 || lost != [0; CHANNELS] {
            report(Decoded::BatchesLost { batches: ahead, frames: lost });
        }
        *self = Self {
            sequence: header.sequence.wrapping_add(1),
            frames: header.frames_before,
            last: Some(*header),
        };
        true
    }
}

impl Decoder {
    /// A decoder that expects the first batch after `Hello`.
    pub const fn new() -> Self {
        Self {
            partial: [0; MAX_ENCODED],
            len: 0,
            overlong: false,
            expected: Expected::FIRST,
            message: [0; MAX_ENCODED],
        }
    }

    /// Takes any piece of the stream and reports everything that it completes.
    pub fn push(&mut self, mut bytes: &[u8], mut report: impl FnMut(Decoded<'_>)) {
        while let Some(end) = bytes.iter().position(|&byte| byte == 0) {
            let (piece, rest) = bytes.split_at(end);
            bytes = &rest[1..];
            if self.overlong {
                self.overlong = false;
            } else if self.len == 0 {
                self.message(Some(piece), &mut report);
            } else if self.keep(piece) {
                self.message(None, &mut report);
            } else {
                report(Decoded::Corrupt(Corruption::TooLong));
            }
            self.len = 0;
        }
        if !self.overlong && !self.keep(bytes) {
            self.overlong = true;
            self.len = 0;
            report(Decoded::Corrupt(Corruption::TooLong));
        }
    }

    fn keep(&mut self, piece: &[u8]) -> bool {
        let Some(slot) = self.partial.get_mut(self.len..self.len + piece.len()) else {
            return false;
        };
        slot.copy_from_slice(piece);
        self.len += piece.len();
        true
    }

    /// One whole message: `piece`, or the bytes kept so far.
    fn message(&mut self, piece: Option<&[u8]>, report: &mut impl FnMut(Decoded<'_>)) {
        let encoded = piece.unwrap_or(&self.partial[..self.len]);
        // Zeros in a row are idle, not messages.
        if encoded.is_empty() {
            return;
        }
        if encoded.len() > self.message.len() {
            return report(Decoded::Corrupt(Corruption::TooLong));
        }
        let message = match unseal(encoded, &mut self.message) {
            Ok(message) => message,
            Err(error) => return report(Decoded::Corrupt(Corruption::Framing(error))),
        };
        match postcard::take_from_bytes(message) {
            Ok((DeviceMessage::Batch(header), records)) => {
                if self.expected.take(&header, report) {
                    walk(records, header.base_ticks, &mut self.expected.frames, report);
                }
            }
            Ok((DeviceMessage::Ended(SessionEnd { reason, header }), [])) => {
                if self.expected.take(&header, report) {
                    report(Decoded::Ended { ticks: header.base_ticks, reason });
                }
            }
            // A Hello whose fixed first field gives another version is read no further.
            Ok((DeviceMessage::Response(response), [])) => {
                if let Some(version) = foreign_protocol(message) {
                    return report(Decoded::OtherProtocol(version));
                }
                if matches!(response.result, Ok(Reply::Hello(_))) {
                    // A session begins: the next batch is its first, and may follow directly.
                    self.expected = Expected::FIRST;
                }
                report(Decoded::Response(&response));
            }
            _ => match foreign_protocol(message) {
                Some(version) => report(Decoded::OtherProtocol(version)),
                None => report(Decoded::Corrupt(Corruption::Unknown)),
            },
        }
    }
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

/// Reports a batch's records.
fn walk(
    mut records: &[u8],
    base_ticks: u64,
    frames: &mut [u32; CHANNELS],
    report: &mut impl FnMut(Decoded<'_>),
) {
    let mut ticks = base_ticks;
    while !records.is_empty() {
        let Ok((record, difference, rest)) = record::decode(records) else {
            return report(Decoded::Corrupt(Corruption::Records));
        };
        ticks = ticks.wrapping_add_signed(difference);
        if let Some(channel) = record.received_on() {
            let frames = &mut frames[channel.index()];
            *frames = frames.wrapping_add(1);
        }
        report(Decoded::Record { ticks, record });
        records = rest;
    }
}

/// The version in a response to `Hello`, if it is not ours. It reads only what never changes: kind,
/// request id, `Ok(Hello)` or `Err(Protocol)`, and the version that comes first in either.
fn foreign_protocol(message: &[u8]) -> Option<u16> {
    let ((kind, _id, result, variant, version), _) =
        postcard::take_from_bytes::<(u8, u16, u8, u8, u16)>(message).ok()?;
    (kind == 1 && result <= 1 && variant == 0 && version != PROTOCOL_VERSION).then_some(version)
}
