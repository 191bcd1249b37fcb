//! Finds counters in the frames of one identifier.

use std::collections::BTreeMap;

/// The fewest pairs of frames that show a counter.
const FEWEST: usize = 8;
/// The most pairs that are looked at.
const MOST: usize = 4096;
/// The share of pairs in which it counts; the others are losses that nobody noticed.
const MOSTLY: f64 = 0.85;
/// Shares of pairs this close are the same: a loss can look right by chance in a part of a counter.
const SAME: f64 = 0.0005;

/// Where in the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Field {
    /// Some bits of a byte.
    Bits {
        /// The byte, from 0.
        byte: usize,
        /// The lowest bit, from 0.
        low: u32,
        /// How many.
        width: u32,
    },
    /// Two bytes, the more significant first.
    Big {
        /// The first byte.
        byte: usize,
    },
    /// Two bytes, the less significant first.
    Little {
        /// The first byte.
        byte: usize,
    },
}

impl Field {
    /// How many bits it has.
    pub const fn width(self) -> u32 {
        match self {
            Self::Bits { width, .. } => width,
            Self::Big { .. } | Self::Little { .. } => 16,
        }
    }

    /// Its value.
    pub fn get(self, data: [u8; 8]) -> i32 {
        match self {
            Self::Bits { byte, low, width } => i32::from(data[byte]) >> low & ((1 << width) - 1),
            Self::Big { byte } => i32::from(u16::from_be_bytes([data[byte], data[byte + 1]])),
            Self::Little { byte } => i32::from(u16::from_le_bytes([data[byte], data[byte + 1]])),
        }
    }

    /// Its bits.
    pub fn mask(self) -> [u8; 8] {
        let mut mask = [0; 8];
        match self {
            Self::Bits { byte, low, width } => mask[byte] = (((1_u32 << width) - 1) << low) as u8,
            Self::Big { byte } | Self::Little { byte } => mask[byte..byte + 2].fill(0xFF),
        }
        mask
    }
}

/// A number that each frame has larger than the one before, up to its last value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counter {
    /// Where.
    pub field: Field,
    /// Its smallest value.
    pub first: i32,
    /// How many values lie between a value and the same one again.
    pub modulus: i32,
    /// How much is added each time, from 1 to the modulus.
    pub step: i32,
}

impl Counter {
    /// The value after this one.
    pub const fn after(&self, value: i32) -> i32 {
        self.first + (value - self.first + self.step).rem_euclid(self.modulus)
    }
}

/// Finds the counters of frames with `len` bytes each, given as pairs of neighbours without a loss between them.
pub fn find(pairs: &[([u8; 8], [u8; 8])], len: usize) -> Vec<Counter> {
    let pairs = &pairs[..pairs.len().min(MOST)];
    if pairs.len() < FEWEST {
        return Vec::new();
    }
    let first = pairs[0].0;
    let varying = pairs.iter().fold([0; 8], |mut bits: [u8; 8], (_, b)| {
        (0..8).for_each(|at| bits[at] |= first[at] ^ b[at]);
        bits
    });
    let mut found: Vec<(Counter, f64)> =
        fields(&varying, len).filter_map(|field| counter(field, pairs)).collect();
    // The best is first, and of equally good ones the widest.
    found.sort_by(|(a, a_share), (b, b_share)| {
        let by_share = if (a_share - b_share).abs() < SAME {
            std::cmp::Ordering::Equal
        } else {
            b_share.total_cmp(a_share)
        };
        by_share.then(b.field.width().cmp(&a.field.width()))
    });
    let mut taken = [0_u8; 8];
    let mut counters: Vec<Counter> = Vec::new();
    for (counter, _) in found {
        let mask = counter.field.mask();
        if (0..8).all(|at| taken[at] & mask[at] == 0) {
            (0..8).for_each(|at| taken[at] |= mask[at]);
            counters.push(widened(counter, varying, pairs));
        }
    }
    counters
}

/// Fields whose first and last bit vary.
fn fields(varying: &[u8; 8], len: usize) -> impl Iterator<Item = Field> {
    let has = |byte: usize, bit: u32| varying[byte] >> bit & 1 == 1;
    let bits = (0..len).flat_map(move |byte| {
        let ends = (0..8).flat_map(|low| (low + 1..8).map(move |high| (low, high)));
        let ends = ends.filter(move |(low, high)| has(byte, *low) && has(byte, *high));
        ends.map(move |(low, high)| Field::Bits { byte, low, width: high - low + 1 })
    });
    let wide = (1..len).flat_map(move |second| {
        let byte = second - 1;
        let big = (varying[byte] != 0 && varying[second] & 1 == 1).then_some(Field::Big { byte });
        let little = (varying[second] != 0 && varying[byte] & 1 == 1).then_some(Field::Little { byte });
        big.into_iter().chain(little)
    });
    bits.chain(wide).collect::<Vec<_>>().into_iter()
}

/// A counter in this field, with the share of pairs in which it counts.
fn counter(field: Field, pairs: &[([u8; 8], [u8; 8])]) -> Option<(Counter, f64)> {
    let whole = 1 << field.width();
    let mut differences: BTreeMap<i32, usize> = BTreeMap::new();
    let (mut least, mut most) = (i32::MAX, i32::MIN);
    for (a, b) in pairs {
        let (a, b) = (field.get(*a), field.get(*b));
        (least, most) = (least.min(a).min(b), most.max(a).max(b));
        *differences.entry((b - a).rem_euclid(whole)).or_default() += 1;
    }
    let (&step, _) =
        differences.iter().max_by_key(|(difference, times)| (**times, std::cmp::Reverse(**difference)))?;
    if step == 0 {
        return None;
    }
    // Counting down by one is adding all but one.
    let signed = if step > whole / 2 { step - whole } else { step };
    let span = most - least + signed.abs();
    let part = Counter { field, first: least, modulus: span, step: signed.rem_euclid(span.max(1)) };
    let natural = Counter { field, first: 0, modulus: whole, step };
    let share = |counter: &Counter| {
        let right = pairs.iter().filter(|(a, b)| counter.after(field.get(*a)) == field.get(*b)).count();
        right as f64 / pairs.len() as f64
    };
    let mut best = (natural, share(&natural));
    if span < whole && span > signed.abs() {
        let of_part = share(&part);
        if of_part > best.1 {
            best = (part, of_part);
        }
    }
    (best.1 >= MOSTLY).then_some(best)
}

/// A counter that was never seen to begin again has the rest of its byte too, if that was never anything but zero.
fn widened(counter: Counter, varying: [u8; 8], pairs: &[([u8; 8], [u8; 8])]) -> Counter {
    let Field::Bits { byte, low, width } = counter.field else { return counter };
    let above = (0xFF_u32 << (low + width)) as u8;
    let began_again = pairs.iter().any(|(a, b)| counter.field.get(*b) < counter.field.get(*a));
    let is_natural = counter.first == 0 && counter.modulus == 1 << width;
    if began_again || !is_natural || varying[byte] & above != 0 || pairs[0].0[byte] & above != 0 {
        return counter;
    }
    Counter { field: Field::Bits { byte, low, width: 8 - low }, modulus: 1 << (8 - low), ..counter }
}
