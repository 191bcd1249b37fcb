//! Exact length of a classical CAN frame on the bus: every bit from the start of frame to the end of
//! the intermission, stuff bits included (ISO 11898-1:2015, 10.4 and 10.5).
//!
//! The bus load, the tightening of stamps and the bus simulator call this once per frame, so the CRC
//! comes from one table per byte position and stuff bits are found with whole-word operations.

use crate::Frame;

/// The generator polynomial of classical CAN's CRC-15, without the leading term.
const CRC15_POLYNOMIAL: u16 = 0x4599;
/// Bits of the CRC sequence.
const CRC_BITS: u32 = 15;
/// CRC delimiter, ACK slot, ACK delimiter and the seven bits of the end of frame: never stuffed.
const TAIL_BITS: u32 = 1 + 1 + 1 + 7;
/// Bits of the intermission, which keeps two frames apart.
pub const INTERMISSION_BITS: u32 = 3;
/// Start of frame, 11 identifier bits, RTR, IDE, r0, four bits DLC.
const STANDARD_HEADER_BITS: u32 = 1 + 11 + 1 + 1 + 1 + 4;
/// Start of frame, 11 identifier bits, SRR, IDE, 18 identifier bits, RTR, r1, r0, four bits DLC.
const EXTENDED_HEADER_BITS: u32 = 1 + 11 + 1 + 1 + 18 + 1 + 1 + 1 + 4;
/// SRR and IDE of an extended frame, both recessive.
const SRR_AND_IDE: u64 = 0b11;
/// The most bytes that the CRC covers: 39 header bits fill five bytes, then the data.
const MAX_CRC_BYTES: usize = 5 + 8;

/// `CRC_OF[k][b]` is the CRC of byte `b` followed by `k` zero bytes. The CRC is linear and starts at
/// zero, so a frame's CRC is the exclusive or of one entry per byte, and leading zeros do not change
/// it.
static CRC_OF: [[u16; 256]; MAX_CRC_BYTES] = crc_tables();

const fn crc_tables() -> [[u16; 256]; MAX_CRC_BYTES] {
    let mut tables = [[0; 256]; MAX_CRC_BYTES];
    let mut byte = 0;
    while byte < 256 {
        let mut crc = 0;
        let mut position = 0;
        while position < MAX_CRC_BYTES {
            let next = if position == 0 { byte as u16 } else { 0 };
            crc = crc_byte(crc, next);
            tables[position][byte] = crc;
            position += 1;
        }
        byte += 1;
    }
    tables
}

const fn crc_byte(mut crc: u16, byte: u16) -> u16 {
    let mut bit = 8;
    while bit > 0 {
        bit -= 1;
        let feedback = (crc >> (CRC_BITS - 1)) ^ (byte >> bit & 1);
        crc = crc << 1 & 0x7FFF;
        if feedback & 1 != 0 {
            crc ^= CRC15_POLYNOMIAL;
        }
    }
    crc
}

/// The bits that make up a frame on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct FrameBits {
    /// Bits without stuff bits, with the intermission's three.
    pub unstuffed: u32,
    /// Stuff bits, all between start of frame and the end of the CRC.
    pub stuff: u32,
    /// The CRC-15 sequence.
    pub crc: u16,
}

impl FrameBits {
    /// Computes them for `frame`.
    #[inline]
    pub fn of(frame: &Frame) -> Self {
        let id = frame.id();
        let raw = u64::from(id.raw());
        let remote = u64::from(frame.is_remote());
        let dlc = u64::from(frame.dlc());
        // Dominant is 0: start of frame and the reserved bits add nothing.
        let (header, header_bits) = if id.is_extended() {
            let (base, extension) = (raw >> 18, raw & 0x3_FFFF);
            (base << 27 | SRR_AND_IDE << 25 | extension << 7 | remote << 6 | dlc, EXTENDED_HEADER_BITS)
        } else {
            (raw << 7 | remote << 6 | dlc, STANDARD_HEADER_BITS)
        };
        let (bytes, len) = (frame.padded_data(), frame.data_len());
        let message_bits = header_bits + 8 * len as u32;
        let of_header = CRC_OF[len..].iter().zip(header.to_le_bytes()).take(header_bits.div_ceil(8) as usize);
        let of_data = CRC_OF[..len].iter().rev().zip(bytes);
        let crc = of_header.chain(of_data).fold(0, |crc, (table, byte)| crc ^ table[usize::from(byte)]);
        // Everything that is subject to stuffing, the first bit in the top position: the header, the data, the CRC.
        let data = u64::from_be_bytes(bytes);
        let mut high = header << (64 - header_bits) | data >> header_bits;
        let mut low = data << (64 - header_bits);
        let crc_on_top = u64::from(crc) << (64 - CRC_BITS);
        if message_bits < 64 {
            high |= crc_on_top >> message_bits;
            low |= crc_on_top << (64 - message_bits);
        } else {
            low |= crc_on_top >> (message_bits - 64);
        }
        let stuffed_bits = message_bits + CRC_BITS;
        let sequence = halves(high, low);
        Self {
            unstuffed: stuffed_bits + TAIL_BITS + INTERMISSION_BITS,
            stuff: count_stuff_bits(sequence, stuffed_bits),
            crc,
        }
    }

    /// All bits, from start of frame to the end of the intermission.
    pub const fn total(&self) -> u32 {
        self.unstuffed + self.stuff
    }

    /// How long all bits take at `bitrate_bps`, in nanoseconds, rounded down.
    pub const fn duration_ns(&self, bitrate_bps: u32) -> u64 {
        // Zero is refused wherever a bit rate is entered; here it would divide by zero.
        let bitrate_bps = if bitrate_bps == 0 { 1 } else { bitrate_bps };
        self.total() as u64 * 1_000_000_000 / bitrate_bps as u64
    }
}

/// Bits that `frame` takes on the bus, with stuff bits and intermission.
#[inline]
pub fn bits_on_bus(frame: &Frame) -> u32 {
    FrameBits::of(frame).total()
}

/// Counts the stuff bits of the top `len` bits of `sequence` (at most 118).
///
/// After five equal bits the opposite bit is inserted, which counts towards the next five. So a run of five to nine
/// equal bits has one stuff bit, and nearly all runs are like that; only a longer run, or a run of exactly five
/// followed by exactly four of the opposite bit, needs a closer look.
#[inline]
fn count_stuff_bits(sequence: u128, len: u32) -> u32 {
    // Bit i of each mask, counted from the top, describes bit i of the sequence.
    let same_as_before = !(sequence ^ sequence >> 1) & !TOP_BIT;
    let valid = first_bits(len);
    let four_equal = same_as_before & same_as_before >> 1 & same_as_before >> 2;
    let five_equal = four_equal & same_as_before >> 3 & valid;
    let four_equal_after_a_change = four_equal & !(same_as_before >> 3) & valid;

    let ends = five_equal & !(five_equal >> 1);
    let two_fives = five_equal & five_equal >> 5;
    if two_fives | ends >> 4 & four_equal_after_a_change == 0 {
        return ends.count_ones();
    }
    count_one_by_one(five_equal, four_equal_after_a_change)
}

/// The first bit of a sequence.
const TOP_BIT: u128 = 1 << 127;

// Shifts of 128 bits by a number that only a frame shows are calls in WebAssembly and on a Cortex-M: here, all such shifts are of 64.

const fn halves(high: u64, low: u64) -> u128 {
    (high as u128) << 64 | low as u128
}

/// The first bits of a sequence, fewer than 128 of them.
const fn first_bits(count: u32) -> u128 {
    if count < 64 { halves(!(u64::MAX >> count), 0) } else { halves(u64::MAX, !(u64::MAX >> (count - 64))) }
}

/// Whether a bit is set, counted from the top.
const fn has_bit(sequence: u128, place: u32) -> bool {
    let half = if place < 64 { (sequence >> 64) as u64 } else { sequence as u64 };
    half & 1 << 63 >> (place & 63) != 0
}

/// The next stuff bit comes four bits on if these all repeat the last one; otherwise after the next five equal
/// bits.
fn count_one_by_one(five_equal: u128, four_equal_after_a_change: u128) -> u32 {
    let mut count = 0;
    let mut ahead = five_equal;
    while ahead != 0 {
        let mut place = ahead.leading_zeros();
        count += 1;
        while has_bit(four_equal_after_a_change, place + 4) {
            place += 4;
            count += 1;
        }
        ahead = five_equal & !first_bits(place + 5);
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame(text: &str) -> Frame {
        text.parse().unwrap()
    }

    /// The same as the standard describes it, one bit at a time.
    fn bit_by_bit(frame: &Frame) -> FrameBits {
        let mut bits = Vec::new();
        let mut put = |value: u32, width: u32| bits.extend((0..width).rev().map(|bit| value >> bit & 1));
        let (raw, remote) = (frame.id().raw(), u32::from(frame.is_remote()));
        put(0, 1);
        if frame.id().is_extended() {
            put(raw >> 18, 11);
            put(0b11, 2);
            put(raw, 18);
            put(remote, 1);
            put(0, 2);
        } else {
            put(raw, 11);
            put(remote, 1);
            put(0, 2);
        }
        put(u32::from(frame.dlc()), 4);
        frame.data().iter().for_each(|byte| put(u32::from(*byte), 8));
        let mut crc: u16 = 0;
        for bit in &bits {
            let feedback = *bit as u16 ^ crc >> 14 & 1;
            crc = (crc << 1 & 0x7FFF) ^ (feedback * 0x4599);
        }
        bits.extend((0..15).rev().map(|bit| u32::from(crc >> bit & 1)));
        let unstuffed = bits.len() as u32 + 1 + 2 + 7 + 3;
        let (mut stuff, mut run, mut last) = (0, 0, 2);
        for bit in bits {
            run = if bit == last { run + 1 } else { 1 };
            last = bit;
            if run == 5 {
                stuff += 1;
                last = 1 - bit;
                run = 1;
            }
        }
        FrameBits { unstuffed, stuff, crc }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20_000))]
        #[test]
        fn any_frame_agrees_with_the_bit_by_bit_model(
            extended: bool, raw: u32, remote: bool, dlc in 0..16u8, data: [u8; 8], sparse: bool,
        ) {
            // Sparse data and identifiers cause many stuff bits.
            let (raw, data) = if sparse { (raw & raw >> 3 & raw << 2, data.map(|byte| byte & 0x81)) } else { (raw, data) };
            let id = if extended { crate::Id::extended_truncated(raw) } else { crate::Id::standard_truncated(raw) };
            let frame = Frame::from_bus(id, remote, dlc, data);
            prop_assert_eq!(FrameBits::of(&frame), bit_by_bit(&frame));
        }
    }

    #[test]
    fn the_earlier_analysers_first_example_agrees() {
        let bits = FrameBits::of(&frame("000#55"));
        assert_eq!(bits, FrameBits { unstuffed: 55, stuff: 3, crc: 0x722 });
        assert_eq!(bits.duration_ns(1_000_000), 58_000);
        // Rounded down; no bit rate divides by zero.
        assert_eq!((bits.duration_ns(83_333), bits.duration_ns(0)), (696_002, 58_000_000_000));
    }

    #[test]
    fn the_two_node_traffic_agrees_bit_for_bit() {
        for (text, total) in [
            ("001#8001880189018C02", 119),
            ("001#88098A0088008101", 119),
            ("001#88008C810C800980", 120),
            ("001#0880018001890181", 121),
            ("001#0C820C881888018B", 119),
            ("001#8080008001800288", 121),
        ] {
            assert_eq!(bits_on_bus(&frame(text)), total, "{text}");
        }
    }

    #[test]
    fn no_frame_is_shorter_or_longer_than_the_bus_limits() {
        let all_ids = |remote, dlc| {
            (0..=0x7FF).map(move |raw| {
                let id = crate::Id::standard_truncated(raw);
                bits_on_bus(&Frame::from_bus(id, remote, dlc, [0; 8]))
            })
        };
        assert_eq!(all_ids(false, 0).min(), Some(48));
        assert_eq!((0..16).flat_map(|dlc| all_ids(true, dlc)).min(), Some(47));
        assert_eq!(bits_on_bus(&frame("555#")), 48);
        assert_eq!(FrameBits::of(&frame("00000000#0000000000000000")).unstuffed, 131);
        assert_eq!(FrameBits::of(&frame("000#0000000000000000")).unstuffed, 111);
    }

    #[test]
    fn a_dlc_above_eight_and_a_remote_frame_carry_what_the_bus_carries() {
        let nine = FrameBits::of(&frame("123#1122334455667788_9"));
        let eight = FrameBits::of(&frame("123#1122334455667788"));
        assert_eq!((nine.unstuffed, eight.unstuffed), (111, 111));
        assert_ne!(nine.crc, eight.crc);
        assert_eq!(FrameBits::of(&frame("123#R8")).unstuffed, 47);
        assert_eq!(FrameBits::of(&frame("00000123#R8_F")).unstuffed, 67);
    }
}
