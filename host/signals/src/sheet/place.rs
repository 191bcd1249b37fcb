//! Where the signals of a table are: tables number the bits of Motorola signals in three ways, and seldom say in which.

use super::super::layout::{ByteOrder, wire_position};
use super::super::validate;
use super::cells::Mux;

/// Which bit of a Motorola signal a start bit is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Numbering {
    /// The most significant, as in DBC.
    #[default]
    Highest,
    /// The least significant.
    Lowest,
    /// The most significant, counted from the most significant of the first byte, as canmatrix writes it.
    FromHighest,
}

const TAKEN_AS_HIGHEST: &str = "start bits of Motorola signals are taken for the most significant bit, as in DBC; a byte order of Motorola LSB says that they are the least significant";
const TAKEN_AS_LOWEST: &str = "start bits of Motorola signals are taken for the least significant bit, with which they overlap least; a byte order of Motorola MSB says that they are not";

/// A place as the table gives it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    byte: Option<f64>,
    bit: Option<f64>,
    bits: u16,
    pub order: ByteOrder,
    /// Whether the start bit is the lowest, if the table says so.
    lowest: Option<bool>,
}

impl Place {
    /// `None` if nothing says where it is.
    pub fn of(
        byte: Option<f64>,
        bit: Option<f64>,
        bits: u16,
        (order, lowest): (ByteOrder, Option<bool>),
    ) -> Option<Self> {
        let is_whole = |value: &f64| value.fract() == 0.0 && *value >= 0.0;
        let valid = byte.iter().chain(bit.iter()).all(is_whole) && (byte.is_some() || bit.is_some());
        valid.then_some(Self { byte, bit, bits, order, lowest })
    }

    /// The first bit in DBC's numbering. `None` if it is before the first byte, or beyond the longest message.
    pub fn start(&self, numbering: Numbering) -> Option<u16> {
        let bit = self.bit.unwrap_or(0.0);
        let number = self.byte.map_or(bit, |byte| byte * 8.0 + bit);
        if number >= f64::from(validate::MAX_BYTES) * 8.0 {
            return None;
        }
        let number = number as u32;
        if self.order == ByteOrder::Little {
            return u16::try_from(number).ok();
        }
        let numbering = match self.lowest {
            Some(true) => Numbering::Lowest,
            Some(false) => Numbering::Highest,
            // A byte alone: the signal begins at its top.
            None if self.bit.is_none() => Numbering::FromHighest,
            None => numbering,
        };
        let highest = match numbering {
            Numbering::Highest => number,
            Numbering::FromHighest => wire_position(number),
            Numbering::Lowest => {
                let last = wire_position(number);
                wire_position(last.checked_sub(u32::from(self.bits) - 1)?)
            }
        };
        u16::try_from(highest).ok()
    }

    /// The bits in the order in which they are sent.
    fn sent(&self, numbering: Numbering) -> Option<Vec<u32>> {
        let start = u32::from(self.start(numbering)?);
        let bits = u32::from(self.bits);
        Some(match self.order {
            ByteOrder::Little => (start..start + bits).map(wire_position).collect(),
            ByteOrder::Big => (wire_position(start)..wire_position(start) + bits).collect(),
        })
    }
}

/// How all places of a table are numbered.
pub(super) struct Places {
    pub numbering: Numbering,
    pub guess: Option<&'static str>,
}

impl Places {
    /// The numbering with which signals overlap least and lie in their messages.
    pub fn of<'a, S>(messages: impl Iterator<Item = (Option<u16>, S)>, is_canmatrix: bool) -> Self
    where
        S: Iterator<Item = (&'a Place, Option<&'a Mux>)>,
    {
        let messages: Vec<(Option<u16>, Vec<_>)> =
            messages.map(|(length, signals)| (length, signals.collect())).collect();
        let depends = |place: &Place| {
            place.order == ByteOrder::Big && place.lowest.is_none() && place.bit.is_some() && place.bits > 1
        };
        if !messages.iter().flat_map(|(_, signals)| signals).any(|(place, _)| depends(place)) {
            return Self { numbering: Numbering::default(), guess: None };
        }
        let ways = if is_canmatrix {
            [Numbering::FromHighest, Numbering::Highest, Numbering::Lowest]
        } else {
            [Numbering::Highest, Numbering::Lowest, Numbering::FromHighest]
        };
        let misfits = ways.map(|way| {
            messages.iter().map(|(length, signals)| misfits(*length, signals, way)).sum::<usize>()
        });
        let best = (0..ways.len()).min_by_key(|at| misfits[*at]).unwrap_or(0);
        let numbering = ways[best];
        let guess = match numbering {
            Numbering::Highest => Some(TAKEN_AS_HIGHEST),
            Numbering::Lowest => Some(TAKEN_AS_LOWEST),
            Numbering::FromHighest => None,
        };
        // canmatrix's own way needs no word, and one that fits where no other does neither.
        let is_sure = misfits[best] == 0 && misfits.iter().filter(|misfits| **misfits == 0).count() == 1;
        Self { numbering, guess: guess.filter(|_| !is_sure) }
    }
}

/// How many signals of a message do not fit into it, or meet others.
fn misfits(length: Option<u16>, signals: &[(&Place, Option<&Mux>)], way: Numbering) -> usize {
    let mut taken: Vec<(u32, Option<&Mux>)> = Vec::new();
    let mut misfits = 0;
    for (place, mux) in signals {
        let Some(bits) = place.sent(way) else {
            misfits += 1;
            continue;
        };
        let end = bits.iter().max().map_or(0, |bit| bit / 8 + 1);
        let meets = |bit: &u32| {
            taken.iter().any(|(other, with)| {
                let together = match (mux, with) {
                    (Some(Mux::For(one)), Some(Mux::For(other))) => one == other,
                    _ => true,
                };
                other == bit && together
            })
        };
        let is_out = length.is_some_and(|length| end > u32::from(length));
        misfits += usize::from(is_out || bits.iter().any(meets));
        taken.extend(bits.into_iter().map(|bit| (bit, *mux)));
    }
    misfits
}
