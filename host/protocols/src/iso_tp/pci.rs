//! The protocol control information at the beginning of each frame (ISO 15765-2:2016, clause 9.6).

/// The role of a frame in a transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pci<'a> {
    /// A complete message.
    Single(&'a [u8]),
    /// The first of several frames.
    First {
        /// Length of the whole message in bytes.
        length: u32,
        /// The first part of it.
        data: &'a [u8],
    },
    /// A consecutive frame.
    Consecutive {
        /// Its sequence number, 0 to 15.
        number: u8,
        /// Its bytes, including padding after the last message byte.
        data: &'a [u8],
    },
    /// Flow control from the receiver.
    Flow {
        /// Whether to continue, wait, or stop.
        status: FlowStatus,
        /// The number of frames until the next flow control; 0 for all.
        block_size: u8,
        /// Minimum time between two frames, in microseconds.
        separation_us: u32,
    },
}

/// The status in a flow control frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlowStatus {
    /// Continue sending.
    Go,
    /// Wait for another flow control frame.
    Wait,
    /// The message is too long for the receiver.
    Overflow,
}

/// Parses a frame after the address, if there is one. `offset` is the number of address bytes, 0 or 1. An error says what is wrong;
/// `None` means that the frame does not belong to this protocol.
pub fn parse(bytes: &[u8], offset: usize) -> Result<Option<Pci<'_>>, &'static str> {
    let Some((&first, rest)) = bytes.get(offset..).and_then(<[u8]>::split_first) else { return Ok(None) };
    let low = first & 15;
    Ok(Some(match first >> 4 {
        0 if bytes.len() > 8 => {
            // An FD frame has its length in the second byte if it exceeds what fits in a classical frame.
            let (0, Some((&length, data))) = (low, rest.split_first()) else {
                return Err("a single frame of more than 8 bytes has its length in the second byte");
            };
            Pci::Single(single(length, data)?)
        }
        0 => Pci::Single(single(low, rest)?),
        1 => {
            let (&second, rest) = rest.split_first().ok_or("a first frame without its length")?;
            let short = u32::from(low) << 8 | u32::from(second);
            let (length, data) = match (short, rest.split_first_chunk::<4>()) {
                (0, Some((length, data))) => (u32::from_be_bytes(*length), data),
                (0, None) => return Err("a first frame without its length"),
                _ => (short, rest),
            };
            if bytes.len() < 8 {
                return Err("a first frame of less than 8 bytes");
            }
            if length as usize <= data.len() {
                return Err("a first frame that has room for the whole message");
            }
            Pci::First { length, data }
        }
        2 => Pci::Consecutive { number: low, data: rest },
        3 => {
            let status = match low {
                0 => FlowStatus::Go,
                1 => FlowStatus::Wait,
                2 => FlowStatus::Overflow,
                _ => return Err("a flow control frame of unknown status"),
            };
            let &[block_size, separation, ..] = rest else {
                return Err("a flow control frame of less than 3 bytes");
            };
            Pci::Flow { status, block_size, separation_us: separation_us(separation) }
        }
        _ => return Ok(None),
    }))
}

fn single(length: u8, data: &[u8]) -> Result<&[u8], &'static str> {
    match data.get(..usize::from(length)) {
        Some([]) => Err("a single frame without data"),
        Some(data) => Ok(data),
        None => Err("a single frame shorter than its length says"),
    }
}

/// Reserved values mean the longest time (clause 9.6.5.5).
fn separation_us(byte: u8) -> u32 {
    match byte {
        0..=0x7F => u32::from(byte) * 1000,
        0xF1..=0xF9 => u32::from(byte - 0xF0) * 100,
        _ => 127_000,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_what_their_first_bytes_say() {
        for (bytes, offset, expected) in [
            (&[0x02, 0x3E, 0x00][..], 0, Ok(Some(Pci::Single(&[0x3E, 0x00])))),
            (&[0xF1, 0x01, 0x3E], 1, Ok(Some(Pci::Single(&[0x3E])))),
            (&[0x00, 0x00], 0, Err("a single frame without data")),
            (&[0x05, 0x3E], 0, Err("a single frame shorter than its length says")),
            (
                &[0x10, 0x14, 1, 2, 3, 4, 5, 6],
                0,
                Ok(Some(Pci::First { length: 20, data: &[1, 2, 3, 4, 5, 6] })),
            ),
            (&[0x10, 0x00, 0, 1, 0, 0, 5, 6], 0, Ok(Some(Pci::First { length: 65_536, data: &[5, 6] }))),
            (&[0x10, 0x06, 1, 2, 3, 4, 5, 6], 0, Err("a first frame that has room for the whole message")),
            (&[0x2F, 9], 0, Ok(Some(Pci::Consecutive { number: 15, data: &[9] }))),
            (
                &[0x30, 8, 0xF3],
                0,
                Ok(Some(Pci::Flow { status: FlowStatus::Go, block_size: 8, separation_us: 300 })),
            ),
            (&[0x33, 8, 0xF3], 0, Err("a flow control frame of unknown status")),
            (&[0x45], 0, Ok(None)),
            (&[], 0, Ok(None)),
            (&[1], 1, Ok(None)),
        ] {
            assert_eq!(parse(bytes, offset), expected, "{bytes:02X?}");
        }
        let mut fd = vec![0x00, 0x0A];
        fd.extend([7; 10]);
        assert_eq!(parse(&fd, 0), Ok(Some(Pci::Single(&[7; 10]))));
    }
}
