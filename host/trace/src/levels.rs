//! A frame as the levels that cross the bus, bit by bit (ISO 11898-1:2015, 10.4 and 10.5), for simulating or reading edges. If you need only
//! lengths, [`crate::bits`] is a hundred times faster.

use cantap_can::{Frame, FrameBits};

/// After this many equal bits in a row, the sender inserts an opposite one.
const STUFF_AFTER: usize = 5;
/// Bits of the end of frame.
const END_OF_FRAME_BITS: usize = 7;

/// The bits from start of frame to the last bit of end of frame, true for recessive, including stuff bits. The ACK slot is recessive, as
/// the sender leaves it; it is at [`ACK_SLOT_FROM_END`] from the end.
pub fn levels(frame: &Frame) -> Vec<bool> {
    let id = frame.id();
    let mut bits = vec![false];
    let mut put = |value: u32, count: u32| bits.extend((0..count).rev().map(|bit| value >> bit & 1 != 0));
    let remote = u32::from(frame.is_remote());
    if id.is_extended() {
        put(id.raw() >> 18, 11);
        // SRR and IDE.
        put(0b11, 2);
        put(id.raw() & 0x3_FFFF, 18);
        // RTR, r1, r0.
        put(remote << 2, 3);
    } else {
        put(id.raw(), 11);
        // RTR, IDE, r0.
        put(remote << 2, 3);
    }
    put(frame.dlc().into(), 4);
    frame.data().iter().for_each(|byte| put((*byte).into(), 8));
    put(FrameBits::of(frame).crc.into(), 15);
    let mut sent: Vec<bool> = Vec::with_capacity(bits.len() * 5 / 4 + 10);
    let mut run = 0;
    for bit in bits {
        run = if sent.last() == Some(&bit) { run + 1 } else { 1 };
        sent.push(bit);
        if run == STUFF_AFTER {
            sent.push(!bit);
            run = 1;
        }
    }
    // CRC delimiter, ACK slot and its delimiter.
    sent.extend([true; 3 + END_OF_FRAME_BITS]);
    sent
}

/// Where the ACK slot is in [`levels`], counted from the end: 1 is the last bit.
pub const ACK_SLOT_FROM_END: usize = 2 + END_OF_FRAME_BITS;

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_can::bits::{INTERMISSION_BITS, bits_on_bus};

    #[test]
    fn the_levels_are_as_many_as_bits_on_the_bus() {
        for text in ["123#", "7FF#FFFFFFFFFFFFFFFF", "1ABCDEF0#1122334455667788", "000#R8", "2AA#5555"] {
            let frame: Frame = text.parse().unwrap();
            assert_eq!(levels(&frame).len() as u32 + INTERMISSION_BITS, bits_on_bus(&frame), "{text}");
        }
    }

    /// ID 0 without data: five zeros and a one, twice, as ISO 11898-1 stuffs them.
    #[test]
    fn a_stuff_bit_stands_behind_five_equal_bits() {
        let levels = levels(&"000#".parse().unwrap());
        let begin: String = levels[..12].iter().map(|recessive| if *recessive { '1' } else { '0' }).collect();
        assert_eq!(begin, "000001000001");
        let ack = levels.len() - ACK_SLOT_FROM_END;
        assert!(levels[ack - 1..].iter().all(|recessive| *recessive));
    }

    /// Start of frame, the base identifier, SRR and IDE, the extension, RTR, r1 and r0, the DLC.
    #[test]
    fn the_header_of_a_remote_frame_is_as_iso_11898_has_it() {
        let begin = |text: &str, len| -> String {
            levels(&text.parse().unwrap())[..len]
                .iter()
                .map(|recessive| if *recessive { '1' } else { '0' })
                .collect()
        };
        assert_eq!(begin("2AA#R5", 19), ["0", "01010101010", "1", "0", "0", "0101"].concat());
        assert_eq!(
            begin("0AAAAAAA#R5", 39),
            ["0", "01010101010", "11", "101010101010101010", "1", "0", "0", "0101"].concat()
        );
        assert_eq!(begin("0AAAAAAA#5A", 33), ["0", "01010101010", "11", "101010101010101010", "0"].concat());
    }
}
