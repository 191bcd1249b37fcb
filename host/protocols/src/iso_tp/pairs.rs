//! Pairs of senders that answer each other.

use std::fmt;
use std::str::FromStr;

use cantap_trace::Id;
use rustc_hash::FxHashMap;

use crate::Party;

/// How many pairs that were found are kept for all channels together.
const MOST_FOUND: usize = 1024;

/// A sender: its identifier and, in extended and mixed addressing, the first data byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Endpoint {
    /// The identifier of its frames.
    pub id: Id,
    /// The first data byte of its frames: the receiver's address (extended addressing) or the address extension (mixed).
    pub address: Option<u8>,
}

/// Two senders that talk to each other: each one's flow control is for the other's transfers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Pair {
    /// One of them, usually the one that asks.
    pub a: Endpoint,
    /// The other.
    pub b: Endpoint,
}

/// A text that is not a pair.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "'{0}' is not a pair; write two identifiers, as 7E0:7E8, or 6F1/12:612/F1 where the first data byte is an address"
)]
pub struct BadPair(String);

impl From<Endpoint> for Party {
    fn from(Endpoint { id, address }: Endpoint) -> Self {
        address.map_or(Self::Id(id), |address| Self::Addressed(id, address))
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Party::from(*self).fmt(f)
    }
}

impl fmt::Display for Pair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.a, self.b)
    }
}

impl FromStr for Pair {
    type Err = BadPair;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let endpoint = |text: &str| {
            let (id, address) =
                text.split_once('/').map_or((text, None), |(id, address)| (id, Some(address)));
            let address = match address {
                Some(address) if (1..=2).contains(&address.len()) => {
                    Some(u8::from_str_radix(address, 16).ok()?)
                }
                Some(_) => return None,
                None => None,
            };
            Some(Endpoint { id: id.parse().ok()?, address })
        };
        let pair = text.split_once(':').and_then(|(a, b)| Some(Self { a: endpoint(a)?, b: endpoint(b)? }));
        // Either all frames of both have an address, or none.
        let pair =
            pair.filter(|pair| pair.a.address.is_some() == pair.b.address.is_some() && pair.a != pair.b);
        pair.ok_or_else(|| BadPair(text.to_owned()))
    }
}

/// The identifiers that take part, and their other sides.
#[derive(Clone, Debug, Default)]
pub(super) struct Pairs {
    /// Number of address bytes before the control information, by channel (0 for all) and identifier.
    offsets: FxHashMap<(u8, Id), u8>,
    partners: FxHashMap<(u8, Endpoint), Endpoint>,
}

/// The identifiers reserved by ISO 15765-4 and ISO 15765-2.
pub(super) enum Fixed {
    /// 7E0 to 7EF, 18DAxxyy.
    Physical(Id),
    /// 7DF, 18DBxxyy: to all.
    Functional,
    /// 18CExxyy: like 18DAxxyy, with an address extension.
    MixedPhysical(Id),
    /// 18CDxxyy.
    MixedFunctional,
}

/// The reserved use of an identifier, if any.
pub(super) fn fixed(id: Id) -> Option<Fixed> {
    let raw = id.raw();
    if !id.is_extended() {
        return match raw {
            0x7DF => Some(Fixed::Functional),
            0x7E0..=0x7EF => Some(Fixed::Physical(Id::standard_truncated(raw ^ 8))),
            _ => None,
        };
    }
    // Any priority; the last two bytes are target and source.
    let other = || Id::extended_truncated(raw & 0x1FFF_0000 | raw >> 8 & 0xFF | raw << 8 & 0xFF00);
    match raw >> 16 & 0x3FF {
        0xDA => Some(Fixed::Physical(other())),
        0xDB => Some(Fixed::Functional),
        0xCE => Some(Fixed::MixedPhysical(other())),
        0xCD => Some(Fixed::MixedFunctional),
        _ => None,
    }
}

impl Pairs {
    /// Adds a pair for a channel, or for all (0); false if the limit is reached.
    pub fn add(&mut self, channel: u8, pair: Pair) -> bool {
        if channel != 0 && self.offsets.len() >= 2 * MOST_FOUND {
            return false;
        }
        for (from, to) in [(pair.a, pair.b), (pair.b, pair.a)] {
            self.offsets.insert((channel, from.id), u8::from(from.address.is_some()));
            self.partners.insert((channel, from), to);
        }
        true
    }

    /// The number of address bytes in the identifier's frames; `None` if it takes part in no transfers.
    pub fn offset(&self, channel: u8, id: Id) -> Option<usize> {
        if !self.offsets.is_empty() {
            let known = self.offsets.get(&(channel, id)).or_else(|| self.offsets.get(&(0, id)));
            if let Some(offset) = known {
                return Some(usize::from(*offset));
            }
        }
        fixed(id).map(|fixed| usize::from(matches!(fixed, Fixed::MixedPhysical(_) | Fixed::MixedFunctional)))
    }

    /// The other side.
    pub fn partner(&self, channel: u8, from: Endpoint) -> Option<Endpoint> {
        if !self.partners.is_empty() {
            let known = self.partners.get(&(channel, from)).or_else(|| self.partners.get(&(0, from)));
            if known.is_some() {
                return known.copied();
            }
        }
        match fixed(from.id)? {
            Fixed::Physical(id) | Fixed::MixedPhysical(id) => Some(Endpoint { id, address: from.address }),
            Fixed::Functional | Fixed::MixedFunctional => None,
        }
    }
}
