//! Finds the checksum in the frames of one identifier: a value that follows from all other bytes.

use std::collections::{BTreeMap, BTreeSet};

use super::counters::Counter;
use crate::checksum;

/// The fewest payloads, checksum aside, that show a checksum of eight bits, and one of four.
const FEWEST: usize = 6;
const FEWEST_OF_NIBBLE: usize = 12;
/// The fewest values that it has, and payloads with the same constant that differ independently: less fits some CRC by chance.
const FEWEST_VALUES: usize = 4;
const FEWEST_INDEPENDENT: usize = 3;
/// The most payloads that are looked at.
const MOST: usize = 4096;
/// The largest modulus of a counter that may select the checksum's constant.
const MAX_CONSTANTS: i32 = 16;

/// The part of a byte that holds a checksum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// All of it.
    Byte,
    /// The low four bits.
    Low,
    /// The high four bits.
    High,
}

impl Part {
    /// Its bits.
    pub const fn mask(self) -> u8 {
        match self {
            Self::Byte => 0xFF,
            Self::Low => 0x0F,
            Self::High => 0xF0,
        }
    }

    /// How far its lowest bit is from the byte's.
    pub const fn shift(self) -> u32 {
        if matches!(self, Self::High) { 4 } else { 0 }
    }
}

/// How a checksum is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Algorithm {
    /// The exclusive or of bytes, exclusive-ored with a constant.
    Xor,
    /// The sum of bytes, plus a constant.
    Sum,
    /// A constant minus the sum of bytes.
    NegatedSum,
    /// CRC-8, exclusive-ored with a constant.
    Crc {
        /// Without the highest bit.
        polynomial: u8,
        /// Least significant bit first.
        reflected: bool,
        /// One more byte follows the data, which the constant stands for: AUTOSAR's profile 2 has it by the counter.
        followed: bool,
    },
    /// The sum of half bytes, plus a constant.
    NibbleSum,
    /// A constant minus the sum of half bytes.
    NegatedNibbleSum,
    /// Nothing but a constant for each value of the counter.
    ByCounter,
}

impl Algorithm {
    fn of(self, bytes: impl IntoIterator<Item = u8>) -> u8 {
        match self {
            Self::Xor => checksum::xor8(bytes),
            Self::Sum | Self::NegatedSum => checksum::sum8(bytes),
            Self::Crc { polynomial, reflected, followed } => {
                let bytes = bytes.into_iter().chain(followed.then_some(0));
                if reflected {
                    checksum::crc8_reflected(bytes, polynomial, 0, 0)
                } else {
                    checksum::crc8(bytes, polynomial, 0, 0)
                }
            }
            Self::NibbleSum | Self::NegatedNibbleSum => checksum::nibble_sum(bytes),
            Self::ByCounter => 0,
        }
    }

    /// The checksum of a sum and a constant.
    const fn joined(self, sum: u8, constant: u8) -> u8 {
        match self {
            Self::Xor | Self::Crc { .. } | Self::ByCounter => sum ^ constant,
            Self::Sum | Self::NibbleSum => sum.wrapping_add(constant),
            Self::NegatedSum | Self::NegatedNibbleSum => constant.wrapping_sub(sum),
        }
    }

    /// The constant with which a sum gives this checksum.
    const fn constant(self, sum: u8, checksum: u8) -> u8 {
        match self {
            Self::Xor | Self::Crc { .. } | Self::ByCounter => sum ^ checksum,
            Self::Sum | Self::NibbleSum => checksum.wrapping_sub(sum),
            Self::NegatedSum | Self::NegatedNibbleSum => checksum.wrapping_add(sum),
        }
    }
}

/// A checksum.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Checksum {
    /// Its byte, from 0.
    pub byte: usize,
    /// Its part of that byte.
    pub part: Part,
    /// How it is computed over the other bytes, for half a byte with the other half of its own.
    pub algorithm: Algorithm,
    /// Its constant; several are selected by the first counter's value, less that counter's smallest.
    pub constants: Vec<u8>,
}

impl Checksum {
    fn sum(&self, data: &[u8]) -> u8 {
        let own = !self.part.mask();
        let others = data.iter().enumerate().filter(|(at, _)| self.part != Part::Byte || *at != self.byte);
        self.algorithm.of(others.map(|(at, byte)| if at == self.byte { byte & own } else { *byte }))
    }

    /// The constant for a frame.
    fn constant(&self, data: [u8; 8], counter: Option<&Counter>) -> u8 {
        let place = counter.filter(|_| self.constants.len() > 1).map_or(0, |counter| place(counter, data));
        self.constants.get(place).copied().unwrap_or_default()
    }

    /// Whether a frame with this data, of which `len` bytes count, has it right.
    pub fn is_right(&self, data: [u8; 8], len: usize, counter: Option<&Counter>) -> bool {
        if self.byte >= len {
            return false;
        }
        let checksum = self.algorithm.joined(self.sum(&data[..len]), self.constant(data, counter));
        (checksum << self.part.shift()) & self.part.mask() == data[self.byte] & self.part.mask()
    }

    /// Its bits.
    pub fn mask(&self) -> [u8; 8] {
        let mut mask = [0; 8];
        mask[self.byte] = self.part.mask();
        mask
    }
}

/// The place of a frame's constant.
fn place(counter: &Counter, data: [u8; 8]) -> usize {
    usize::try_from(counter.field.get(data) - counter.first).unwrap_or_default()
}

/// Finds the checksum of frames with `len` bytes each.
pub fn find(payloads: &[[u8; 8]], len: usize, counters: &[Counter]) -> Option<Checksum> {
    if len < 2 {
        return None;
    }
    let distinct: BTreeSet<[u8; 8]> = payloads.iter().copied().collect();
    let distinct: Vec<[u8; 8]> = distinct.into_iter().take(MOST).collect();
    let first = *distinct.first()?;
    // A part of a checksum may look like a counter; the best counter is one.
    let counted = |at: usize| counters.first().map_or(0, |counter| counter.field.mask()[at]);
    // Of bytes that follow from each other, the checksum is the one that changes most often; most are the last byte or the first.
    let mut ordered: Vec<usize> = [len - 1, 0].into_iter().chain(1..len - 1).collect();
    let changes = |at: usize| payloads.windows(2).filter(|pair| pair[0][at] != pair[1][at]).count();
    ordered.sort_by_cached_key(|at| std::cmp::Reverse(changes(*at)));
    let places = || ordered.iter().copied();
    let parts = |part: Part| {
        let varies = move |at: usize, data: &[[u8; 8]]| {
            data.iter().any(|each| (each[at] ^ first[at]) & part.mask() != 0)
        };
        let distinct = &distinct;
        places()
            .filter(move |at| counted(*at) & part.mask() == 0 && varies(*at, distinct))
            .map(move |at| (at, part))
    };
    let crcs = [false, true].into_iter().flat_map(|followed| {
        (1..=u8::MAX).flat_map(move |polynomial| {
            [false, true].map(|reflected| Algorithm::Crc { polynomial, reflected, followed })
        })
    });
    let simple = [Algorithm::Xor, Algorithm::Sum, Algorithm::NegatedSum];
    let mut of_bytes: Vec<Algorithm> = simple.into_iter().chain(crcs).collect();
    let of_nibbles = [Algorithm::NibbleSum, Algorithm::NegatedNibbleSum];
    let selecting = counters.first().filter(|counter| counter.modulus <= MAX_CONSTANTS);
    let whole = || parts(Part::Byte);
    // Two bytes that change alike are copies, unless one counts.
    let varying = (0..len).filter(|at| distinct.iter().any(|each| each[*at] != first[*at])).count();
    let of_bytes =
        if varying > 2 || !counters.is_empty() { of_bytes } else { of_bytes.split_off(simple.len()) };
    whole()
        .find_map(|(at, part)| search(&distinct, len, at, part, &of_bytes, None))
        .or_else(|| {
            let halves = parts(Part::Low).chain(parts(Part::High));
            halves.into_iter().find_map(|(at, part)| search(&distinct, len, at, part, &of_nibbles, None))
        })
        .or_else(|| {
            let counter = selecting?;
            whole().find_map(|(at, part)| search(&distinct, len, at, part, &of_bytes, Some(counter)))
        })
        .or_else(|| {
            let counter = selecting?;
            let all = &payloads[..payloads.len().min(MOST)];
            whole().find_map(|(at, part)| search(all, len, at, part, &[Algorithm::ByCounter], Some(counter)))
        })
}

/// The first of some algorithms with which all payloads have the right checksum.
fn search(
    payloads: &[[u8; 8]],
    len: usize,
    byte: usize,
    part: Part,
    algorithms: &[Algorithm],
    counter: Option<&Counter>,
) -> Option<Checksum> {
    let cleared = |data: &[u8; 8]| {
        let mut data = *data;
        data[byte] &= !part.mask();
        data
    };
    // The same data with two checksums has none.
    let others: BTreeSet<[u8; 8]> = payloads.iter().map(cleared).collect();
    let is_lookup = algorithms == [Algorithm::ByCounter];
    let constants = counter.map_or(1, |counter| usize::try_from(counter.modulus).unwrap_or(1));
    let fewest = if part == Part::Byte { FEWEST } else { FEWEST_OF_NIBBLE };
    let samples = if is_lookup { payloads.len() } else { others.len() };
    // Each constant is taken from one payload, which then shows nothing.
    if samples < fewest + constants - 1 {
        return None;
    }
    let values: BTreeSet<u8> = payloads.iter().map(|data| data[byte] & part.mask()).collect();
    if values.len() < FEWEST_VALUES || (!is_lookup && independent(&others, counter) < FEWEST_INDEPENDENT) {
        return None;
    }
    algorithms.iter().find_map(|algorithm| {
        let mut checksum = Checksum { byte, part, algorithm: *algorithm, constants: vec![0; constants] };
        let mut known: BTreeMap<usize, u8> = BTreeMap::new();
        for data in payloads {
            let place = counter.map_or(0, |counter| place(counter, *data));
            let wanted = (data[byte] & part.mask()) >> part.shift();
            let significant = if part == Part::Byte { 0xFF } else { 0x0F };
            let constant = algorithm.constant(checksum.sum(&data[..len]), wanted) & significant;
            if *known.entry(place).or_insert(constant) != constant {
                return None;
            }
        }
        for (place, constant) in known {
            *checksum.constants.get_mut(place)? = constant;
        }
        Some(checksum)
    })
}

/// How many differences between payloads with the same constant are independent of each other, bit by bit: a CRC that is right for these is
/// right for all that can be made of them.
fn independent(payloads: &BTreeSet<[u8; 8]>, counter: Option<&Counter>) -> usize {
    let mut first_of: BTreeMap<usize, u64> = BTreeMap::new();
    let mut basis: Vec<u64> = Vec::new();
    for data in payloads {
        let number = u64::from_be_bytes(*data);
        let first = *first_of.entry(counter.map_or(0, |counter| place(counter, *data))).or_insert(number);
        let rest = basis.iter().fold(number ^ first, |rest, each| rest.min(rest ^ each));
        if rest != 0 {
            basis.push(rest);
        }
    }
    basis.len()
}
