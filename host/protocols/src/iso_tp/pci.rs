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

/// The longest length that the 12 bits of a first frame hold; longer ones follow in 32 bits.
const MOST_SHORT: u32 = 0xFFF;

impl Pci<'_> {
    /// A frame of classical CAN and how many of its bytes count: all eight with padding. `address` is the byte in front of the control
    /// information, if there is one. Data that do not fit are left out: [`Self::room`] says how many do.
    pub fn encode(&self, address: Option<u8>, padding: Option<u8>) -> ([u8; 8], u8) {
        let mut frame = Builder { bytes: [padding.unwrap_or(0); 8], length: 0 };
        frame.push(address.as_slice());
        match *self {
            Self::Single(data) => {
                frame.push(&[data.len().min(7) as u8]);
                frame.push(data);
            }
            Self::First { length, data } => {
                if length <= MOST_SHORT {
                    frame.push(&[0x10 | (length >> 8) as u8, length as u8]);
                } else {
                    frame.push(&[0x10, 0]);
                    frame.push(&length.to_be_bytes());
                }
                frame.push(data);
            }
            Self::Consecutive { number, data } => {
                frame.push(&[0x20 | number & 15]);
                frame.push(data);
            }
            Self::Flow { status, block_size, separation_us } => {
                let status = match status {
                    FlowStatus::Go => 0,
                    FlowStatus::Wait => 1,
                    FlowStatus::Overflow => 2,
                };
                frame.push(&[0x30 | status, block_size, separation_byte(separation_us)]);
            }
        }
        (frame.bytes, if padding.is_some() { 8 } else { frame.length as u8 })
    }

    /// How many data bytes of a message fit in a frame like this one, in classical CAN.
    pub fn room(&self, address: Option<u8>) -> usize {
        let control = match self {
            Self::Single(_) | Self::Consecutive { .. } => 1,
            Self::First { length, .. } if *length <= MOST_SHORT => 2,
            Self::First { .. } => 6,
            Self::Flow { .. } => return 0,
        };
        8 - control - usize::from(address.is_some())
    }
}

struct Builder {
    bytes: [u8; 8],
    length: usize,
}

impl Builder {
    /// Appends as many as fit.
    fn push(&mut self, bytes: &[u8]) {
        for (place, byte) in self.bytes[self.length..].iter_mut().zip(bytes) {
            *place = *byte;
            self.length += 1;
        }
    }
}

/// The shortest time between two frames that flow control can ask for and that is no shorter than this; at most 127 ms.
fn separation_byte(us: u32) -> u8 {
    match us {
        1..=900 => 0xF0 + us.div_ceil(100) as u8,
        _ => us.div_ceil(1000).min(0x7F) as u8,
    }
}

/// Microseconds between two frames, from the byte in flow control. Reserved values mean the longest time (clause 9.6.5.5).
pub fn separation_us(byte: u8) -> u32 {
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
    fn what_is_encoded_is_decoded_with_and_without_address_and_padding() {
        let data = [1, 2, 3, 4, 5, 6, 7];
        let flow = |separation_us| Pci::Flow { status: FlowStatus::Wait, block_size: 3, separation_us };
        for address in [None, Some(0xF1)] {
            for padding in [None, Some(0xCC)] {
                for pci in [
                    Pci::Single(&data[..2]),
                    Pci::Single(&data[..6]),
                    Pci::First { length: 4095, data: &data[..6 - usize::from(address.is_some())] },
                    Pci::First { length: 4096, data: &data[..2 - usize::from(address.is_some())] },
                    Pci::Consecutive { number: 15, data: &data[..7 - usize::from(address.is_some())] },
                    flow(0),
                    flow(300),
                    flow(127_000),
                ] {
                    let (bytes, length) = pci.encode(address, padding);
                    let decoded = parse(&bytes[..usize::from(length)], usize::from(address.is_some()));
                    assert_eq!(decoded, Ok(Some(pci)), "{address:?} {padding:?}");
                    assert!(padding.is_none() || length == 8);
                }
            }
        }
        assert_eq!(
            Pci::Single(&[0x3E, 0]).encode(None, Some(0xAA)),
            ([2, 0x3E, 0, 0xAA, 0xAA, 0xAA, 0xAA, 0xAA], 8)
        );
        assert_eq!(Pci::Single(&[0x3E, 0]).encode(Some(0x12), None), ([0x12, 2, 0x3E, 0, 0, 0, 0, 0], 4));
        assert_eq!(Pci::First { length: 300, data: &[] }.room(Some(0)), 5);
        assert_eq!(Pci::First { length: 70_000, data: &[] }.room(None), 2);
    }

    /// A time between two that can be asked for becomes the longer one.
    #[test]
    fn separation_times_are_never_shortened() {
        for byte in (0..=0x7F).chain(0xF1..=0xF9) {
            assert_eq!(separation_byte(separation_us(byte)), byte);
        }
        for (us, byte) in [(1, 0xF1), (101, 0xF2), (901, 1), (1001, 2), (200_000, 0x7F)] {
            assert_eq!(separation_byte(us), byte, "{us}");
        }
    }

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
