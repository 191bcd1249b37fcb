//! Exact length of a CAN FD frame on the bus (ISO 11898-1:2015, 10.4 and 10.5): which bits have the nominal bit rate and which
//! have that of the data phase.
//!
//! Up to the end of the data, the levels determine where stuff bits are. After it they are in fixed places: one before the stuff
//! count, and one after every four bits of the stuff count and the CRC. So the CRC's value does not change the length.

use crate::fd::FdFrame;
use cantap_can::bits::INTERMISSION_BITS;

/// ACK slot, ACK delimiter, and seven bits of end of frame.
const TAIL_BITS: u32 = 1 + 1 + 7;
/// The stuff count: three bits and their parity.
const STUFF_COUNT_BITS: u32 = 4;
/// Frames with more data than this have the longer CRC.
const MOST_BYTES_OF_CRC17: usize = 16;
/// Generator polynomials without their leading term.
const CRC17_POLYNOMIAL: u32 = 0x1_685B;
const CRC21_POLYNOMIAL: u32 = 0x10_2899;

/// The bits of an FD frame on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct FdBits {
    /// Bits at the nominal rate, including stuff bits and the three bits of intermission: all but those of the
    /// data phase.
    pub nominal: u32,
    /// Bits at the rate of the data phase, including stuff bits; 0 without a switched bit rate.
    ///
    /// The rate changes at the sample points of the BRS bit and of the CRC delimiter, so each of these two is partly nominal,
    /// partly data. Together they take one bit time of each, wherever the sample points are; so the first is counted as nominal,
    /// the second as data.
    pub data: u32,
    /// Stuff bits up to the end of the data, where the levels require them.
    pub stuff: u32,
    /// Stuff bits in fixed places after the data.
    pub fixed_stuff: u32,
    /// The CRC sequence: 17 bits up to 16 data bytes, 21 above.
    pub crc: u32,
}

impl FdBits {
    /// Computes the bits of `frame`.
    pub fn of(frame: &FdFrame) -> Self {
        let length = Length::of(frame);
        let (crc_bits, fixed_stuff) = crc_and_fixed_stuff(frame);
        Self {
            nominal: length.nominal,
            data: length.data,
            stuff: length.stuff,
            fixed_stuff,
            crc: crc(frame, length.stuff, crc_bits),
        }
    }

    /// All bits, from start of frame to the end of the intermission.
    pub const fn total(&self) -> u32 {
        self.nominal + self.data
    }

    /// How long all bits take, in nanoseconds, rounded down.
    pub const fn duration_ns(&self, bitrate_bps: u32, data_bitrate_bps: u32) -> u64 {
        let nominal = if bitrate_bps == 0 { 1 } else { bitrate_bps as u128 };
        let data = if data_bitrate_bps == 0 { 1 } else { data_bitrate_bps as u128 };
        // Over the common denominator, so that nothing is rounded twice.
        let ns =
            (self.nominal as u128 * data + self.data as u128 * nominal) * 1_000_000_000 / (nominal * data);
        ns as u64
    }
}

/// Only the lengths, which statistics need for each frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Length {
    pub nominal: u32,
    pub data: u32,
    stuff: u32,
}

impl Length {
    pub(crate) fn of(frame: &FdFrame) -> Self {
        let (arbitration, arbitration_bits) = arbitration(frame);
        let (control, control_bits) = control(frame);
        let mut stuffing = Stuffing::default();
        stuffing.bits(arbitration, arbitration_bits);
        let first_stuff = stuffing.count();
        stuffing.bits(control, control_bits);
        frame.data().iter().for_each(|byte| stuffing.byte(*byte));
        // A stuff bit due after the last data bit is the first of those in fixed places.
        let stuff = stuffing.count();
        let (crc_bits, fixed_stuff) = crc_and_fixed_stuff(frame);
        let first = arbitration_bits + first_stuff;
        let delimiter = 1;
        let second = control_bits
            + 8 * frame.data_len() as u32
            + (stuff - first_stuff)
            + STUFF_COUNT_BITS
            + crc_bits
            + fixed_stuff
            + delimiter;
        let last = TAIL_BITS + INTERMISSION_BITS;
        if frame.brs() {
            Self { nominal: first + last, data: second, stuff }
        } else {
            Self { nominal: first + second + last, data: 0, stuff }
        }
    }
}

/// From start of frame to BRS: the bits, the last one lowest, and how many.
fn arbitration(frame: &FdFrame) -> (u64, u32) {
    let (id, brs) = (frame.id(), u64::from(frame.brs()));
    let raw = u64::from(id.raw());
    // FDF is recessive (1); start of frame, RRS and the reserved bit are dominant (0).
    let fdf_to_brs = 0b100 | brs;
    if id.is_extended() {
        let (base, extension) = (raw >> 18, raw & 0x3_FFFF);
        let srr_and_ide = 0b11;
        (base << 24 | srr_and_ide << 22 | extension << 4 | fdf_to_brs, 1 + 11 + 2 + 18 + 1 + 3)
    } else {
        (raw << 5 | fdf_to_brs, 1 + 11 + 2 + 3)
    }
}

/// ESI and the length code.
fn control(frame: &FdFrame) -> (u64, u32) {
    (u64::from(frame.esi()) << 4 | u64::from(frame.dlc()), 1 + 4)
}

/// Number of bits in the CRC sequence, and of the fixed stuff bits in and before it.
fn crc_and_fixed_stuff(frame: &FdFrame) -> (u32, u32) {
    let crc_bits = if frame.data_len() <= MOST_BYTES_OF_CRC17 { 17 } else { 21 };
    (crc_bits, 1 + (STUFF_COUNT_BITS + crc_bits) / 4)
}

/// Counts stuff bits while bits pass.
///
/// The state is the last level and how many times in a row it has occurred. A stuff bit is counted before the bit that follows
/// it, so one due at the very end is not counted.
#[derive(Clone, Copy)]
struct Stuffing {
    state: usize,
    count: u32,
}

/// A stuff bit follows this many equal bits in a row.
const LONGEST_RUN: usize = 5;
/// One state for each level and run.
const STATES: usize = 2 * LONGEST_RUN;

/// By state and byte: the state afterwards, and in the bits above it the number of stuff bits counted.
static BYTES: [[u8; 256]; STATES] = {
    let mut table = [[0; 256]; STATES];
    let mut state = 0;
    while state < STATES {
        let mut byte = 0;
        while byte < 256 {
            let (mut at, mut count, mut bit) = (state, 0, 8);
            while bit > 0 {
                bit -= 1;
                let (next, stuffed) = step(at, byte >> bit & 1);
                at = next;
                count += stuffed;
            }
            table[state][byte] = (count << 4 | at) as u8;
            byte += 1;
        }
        state += 1;
    }
    table
};

/// Takes the next bit: the state afterwards, and whether a stuff bit came before it.
const fn step(state: usize, bit: usize) -> (usize, usize) {
    let (level, run) = (state / LONGEST_RUN, state % LONGEST_RUN + 1);
    // The stuff bit is the opposite, and the first of a new run.
    let (level, run, stuffed) = if run == LONGEST_RUN { (1 - level, 1, 1) } else { (level, run, 0) };
    let run = if level == bit { run + 1 } else { 1 };
    (bit * LONGEST_RUN + run - 1, stuffed)
}

impl Default for Stuffing {
    /// Before the start of frame: the bus was recessive, and the dominant bit begins a run. It is as if there had been one
    /// recessive bit.
    fn default() -> Self {
        Self { state: LONGEST_RUN, count: 0 }
    }
}

impl Stuffing {
    fn bits(&mut self, bits: u64, len: u32) {
        for bit in (0..len).rev() {
            let (state, stuffed) = step(self.state, (bits >> bit & 1) as usize);
            self.state = state;
            self.count += stuffed as u32;
        }
    }

    fn byte(&mut self, byte: u8) {
        let entry = BYTES[self.state][usize::from(byte)];
        self.state = usize::from(entry & 0xF);
        self.count += u32::from(entry >> 4);
    }

    const fn count(&self) -> u32 {
        self.count
    }
}

/// The CRC sequence: over all bits from start of frame to the end of the data, including stuff bits, and the stuff count.
fn crc(frame: &FdFrame, stuff: u32, crc_bits: u32) -> u32 {
    let polynomial = if crc_bits == 17 { CRC17_POLYNOMIAL } else { CRC21_POLYNOMIAL };
    let mut register = Register { value: 1 << (crc_bits - 1), bits: crc_bits, polynomial };
    let mut state = Stuffing::default().state;
    let mut put = |bits: u64, len: u32| {
        for bit in (0..len).rev() {
            let bit = (bits >> bit & 1) as usize;
            let (next, stuffed) = step(state, bit);
            if stuffed == 1 {
                // The opposite of the level that occurred five times.
                register.push(1 - (state / LONGEST_RUN) as u32);
            }
            register.push(bit as u32);
            state = next;
        }
    };
    for (bits, len) in [arbitration(frame), control(frame)] {
        put(bits, len);
    }
    frame.data().iter().for_each(|byte| put(u64::from(*byte), 8));
    // In Gray code, followed by an even parity bit.
    let count = stuff % 8;
    let gray = count ^ count >> 1;
    let field = gray << 1 | (gray.count_ones() % 2);
    for bit in (0..STUFF_COUNT_BITS).rev() {
        register.push(field >> bit & 1);
    }
    register.value
}

/// A CRC, bit by bit.
struct Register {
    value: u32,
    bits: u32,
    polynomial: u32,
}

impl Register {
    fn push(&mut self, bit: u32) {
        let feedback = (self.value >> (self.bits - 1) ^ bit) & 1;
        self.value = self.value << 1 & ((1 << self.bits) - 1);
        if feedback == 1 {
            self.value ^= self.polynomial;
        }
    }
}

#[cfg(test)]
mod tests;
