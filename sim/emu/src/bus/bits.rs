//! A frame as the bits that cross the bus, one by one (ISO 11898-1). It works bit by bit, deliberately
//! without any of the shortcuts of the firmware and the host, which are compared with it.

use cantap_can::{Frame, Id};

/// Bits of the intermission between frames.
pub const INTERMISSION: usize = 3;
/// Bits of the end of frame.
pub const END_OF_FRAME: usize = 7;

/// CRC-15 of CAN, without its highest term.
const CRC_POLYNOMIAL: u16 = 0x4599;

/// A frame's bits, `true` for recessive, from the start of frame to the last bit of the end of frame.
/// The ACK slot is recessive, as the sender leaves it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameBits {
    bits: Vec<bool>,
    /// One entry per bit up to the end of the CRC: whether it is a stuff bit.
    stuff: Vec<bool>,
    arbitration_end: usize,
}

impl FrameBits {
    /// The bits of `frame`.
    pub fn new(frame: &Frame) -> Self {
        let (fields, arbitration) = fields(frame);
        let crc = crc15(&fields);
        let mut bits: Vec<bool> = Vec::with_capacity(160);
        let mut stuff = Vec::with_capacity(160);
        let mut arbitration_end = 0;
        let mut run = 0;
        let crc_bits = (0..15).rev().map(|bit| crc >> bit & 1 != 0);
        for (index, bit) in fields.iter().copied().chain(crc_bits).enumerate() {
            if run == 5 {
                let opposite = !bits[bits.len() - 1];
                bits.push(opposite);
                stuff.push(true);
                run = 1;
            }
            run = if bits.last() == Some(&bit) { run + 1 } else { 1 };
            bits.push(bit);
            stuff.push(false);
            if index + 1 == arbitration {
                arbitration_end = bits.len();
            }
        }
        if run == 5 {
            bits.push(!bits[bits.len() - 1]);
            stuff.push(true);
        }
        // CRC delimiter, ACK slot, ACK delimiter, end of frame.
        bits.extend([true; 3 + END_OF_FRAME]);
        Self { bits, stuff, arbitration_end }
    }

    /// Bits from the start of frame to the last bit of the end of frame.
    #[expect(clippy::len_without_is_empty, reason = "a frame has at least 44 bits")]
    pub fn len(&self) -> usize {
        self.bits.len()
    }

    /// All bits, `true` for recessive.
    pub fn levels(&self) -> &[bool] {
        &self.bits
    }

    /// How many of them are stuff bits.
    pub fn stuff_bits(&self) -> usize {
        self.stuff.iter().filter(|stuff| **stuff).count()
    }

    /// Whether a bit is a stuff bit.
    pub(super) fn is_stuff(&self, index: usize) -> bool {
        self.stuff.get(index) == Some(&true)
    }

    /// Index of the first bit after the arbitration field (ID and RTR, with SRR and IDE between).
    pub fn arbitration_end(&self) -> usize {
        self.arbitration_end
    }

    /// Index of the CRC delimiter.
    pub fn crc_delimiter(&self) -> usize {
        self.bits.len() - END_OF_FRAME - 3
    }

    /// Index of the ACK slot.
    pub fn ack_slot(&self) -> usize {
        self.crc_delimiter() + 1
    }

    /// Index of the ACK delimiter.
    pub fn ack_delimiter(&self) -> usize {
        self.crc_delimiter() + 2
    }

    /// Bits that a receiver must have seen without error to accept the frame: all but the last of the
    /// end of frame (ISO 11898-1, "message validation"; RM0090 Rev 21 §32.7.3).
    pub fn valid_after(&self) -> usize {
        self.bits.len() - 1
    }

    /// Dominant bits among the first `count`.
    pub fn dominant_in(&self, count: usize) -> u64 {
        self.bits[..count].iter().filter(|recessive| !**recessive).count() as u64
    }
}

/// Bits that `frame` takes on the bus, with stuff bits and intermission.
pub fn bus_bits(frame: &Frame) -> u32 {
    (FrameBits::new(frame).len() + INTERMISSION) as u32
}

/// The unstuffed bits from the start of frame to the end of the data, and the length of the
/// arbitration field.
fn fields(frame: &Frame) -> (Vec<bool>, usize) {
    let mut bits = Vec::with_capacity(110);
    let mut put = |value: u32, count: u32| bits.extend((0..count).rev().map(|bit| value >> bit & 1 != 0));
    let remote = u32::from(frame.is_remote());
    let id: Id = frame.id();
    put(0, 1);
    let arbitration = if id.is_extended() {
        put(id.raw() >> 18, 11);
        put(0b11, 2); // SRR, IDE
        put(id.raw() & 0x3_FFFF, 18);
        put(remote, 1);
        put(0, 2); // r1, r0
        33
    } else {
        put(id.raw(), 11);
        put(remote, 1);
        put(0, 2); // IDE, r0
        14
    };
    put(frame.dlc().into(), 4);
    for byte in frame.data() {
        put((*byte).into(), 8);
    }
    (bits, arbitration)
}

/// The CRC over unstuffed bits.
pub(crate) fn crc15(bits: &[bool]) -> u16 {
    bits.iter().fold(0, |crc, bit| {
        let feedback = (crc >> 14 & 1 != 0) != *bit;
        (crc << 1 & 0x7FFF) ^ if feedback { CRC_POLYNOMIAL } else { 0 }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bits_of(text: &str) -> u32 {
        bus_bits(&text.parse().unwrap())
    }

    /// The earlier analyser's own calibration frame: CRC 0x722, 55 bits and 3 stuff bits.
    #[test]
    fn the_calibration_frame_is_58_bits_long() {
        let frame: Frame = "000#55".parse().unwrap();
        let (fields, _) = fields(&frame);
        assert_eq!(crc15(&fields), 0x722);
        assert_eq!(FrameBits::new(&frame).stuff_bits(), 3);
        assert_eq!(bus_bits(&frame), 58);
    }

    #[test]
    fn the_two_node_traffic_has_its_golden_lengths() {
        let data = [
            ("8001880189018C02", 119),
            ("88098A0088008101", 119),
            ("88008C810C800980", 120),
            ("0880018001890181", 121),
            ("0C820C881888018B", 119),
            ("8080008001800288", 121),
        ];
        for (bytes, bits) in data {
            assert_eq!(bits_of(&format!("001#{bytes}")), bits, "{bytes}");
        }
    }

    #[test]
    fn the_shortest_frames_are_as_short_as_the_standard_allows() {
        assert_eq!(bits_of("555#"), 48);
        assert!((0..0x800).all(|id| bits_of(&format!("{id:03X}#")) >= 48));
        let shortest_remote =
            (0..0x800).flat_map(|id| (1..=8).map(move |dlc| bits_of(&format!("{id:03X}#R{dlc}")))).min();
        assert_eq!(shortest_remote, Some(47));
    }

    #[test]
    fn no_six_equal_bits_before_the_crc_delimiter() {
        for text in ["000#0000000000000000", "7FF#FFFFFFFFFFFFFFFF", "00000000#00", "1FFFFFFF#R8"] {
            let bits = FrameBits::new(&text.parse().unwrap());
            let stuffed = &bits.levels()[..bits.crc_delimiter()];
            assert!(stuffed.windows(6).all(|six| six.iter().any(|bit| *bit != six[0])), "{text}");
        }
    }
}
