//! Pairs of senders that answer each other.

use std::fmt;
use std::ops::RangeInclusive;
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
    partners: FxHashMap<(u8, Endpoint), Partner>,
}

/// The other side of a sender.
#[derive(Clone, Copy, Debug)]
enum Partner {
    One(Endpoint),
    /// Several, or nobody knows which.
    Several,
}

impl Partner {
    const fn one(self) -> Option<Endpoint> {
        match self {
            Self::One(one) => Some(one),
            Self::Several => None,
        }
    }
}

/// How to read the frames of an identifier.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Reading {
    /// Their sender takes part in transfers; so many bytes of address come first.
    Known(usize),
    /// Nobody knows their sender, whose frames may have this many.
    Unknown(RangeInclusive<usize>),
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
        self.insert(channel, pair.a, Partner::One(pair.b))
            && self.insert(channel, pair.b, Partner::One(pair.a))
    }

    /// Adds somebody who talks to several others; false if the limit is reached.
    pub fn add_alone(&mut self, channel: u8, one: Endpoint) -> bool {
        self.insert(channel, one, Partner::Several)
    }

    fn insert(&mut self, channel: u8, from: Endpoint, to: Partner) -> bool {
        let is_full = self.partners.len() >= 2 * MOST_FOUND && !self.partners.contains_key(&(channel, from));
        if channel != 0 && is_full {
            return false;
        }
        self.offsets.insert((channel, from.id), u8::from(from.address.is_some()));
        self.partners.insert((channel, from), to);
        true
    }

    /// How to read the frames of an identifier. With an address, the two together are one side of a conversation: that another address
    /// of the identifier is known says nothing about this one.
    pub fn reading(&self, channel: u8, id: Id, bytes: &[u8]) -> Reading {
        if !self.offsets.is_empty() {
            let known = self.offsets.get(&(channel, id)).or_else(|| self.offsets.get(&(0, id)));
            match known {
                Some(0) => return Reading::Known(0),
                Some(_) => {
                    let from = Endpoint { id, address: bytes.first().copied() };
                    let is_known = self.find(channel, from).is_some();
                    return if is_known { Reading::Known(1) } else { Reading::Unknown(1..=1) };
                }
                None => {}
            }
        }
        match fixed(id) {
            Some(Fixed::MixedPhysical(_) | Fixed::MixedFunctional) => Reading::Known(1),
            Some(_) => Reading::Known(0),
            None => Reading::Unknown(0..=1),
        }
    }

    fn find(&self, channel: u8, from: Endpoint) -> Option<Partner> {
        if self.partners.is_empty() {
            return None;
        }
        self.partners.get(&(channel, from)).or_else(|| self.partners.get(&(0, from))).copied()
    }

    /// The other side.
    pub fn partner(&self, channel: u8, from: Endpoint) -> Option<Endpoint> {
        if let Some(known) = self.find(channel, from) {
            return known.one();
        }
        match fixed(from.id)? {
            Fixed::Physical(id) | Fixed::MixedPhysical(id) => Some(Endpoint { id, address: from.address }),
            Fixed::Functional | Fixed::MixedFunctional => None,
        }
    }

    /// Whether the sender's other side was found on this channel, and may turn out to be one of several.
    pub fn was_found(&self, channel: u8, from: Endpoint) -> bool {
        self.partners.contains_key(&(channel, from))
    }

    /// Whether the sender is known, and on what channel ever.
    pub fn is_known(&self, channel: u8, from: Endpoint) -> bool {
        self.find(channel, from).is_some() || fixed(from.id).is_some()
    }

    /// Whom somebody with this identifier would talk to, by what another address of it shows.
    pub fn sibling_partner(&self, channel: u8, from: Endpoint) -> Option<Endpoint> {
        let address = from.address?;
        self.partners.iter().find_map(|((of, sibling), partner)| {
            let partner = partner.one()?;
            if (*of != channel && *of != 0) || sibling.id != from.id {
                return None;
            }
            if sibling.address == partner.address {
                return Some(Endpoint { address: Some(address), ..partner });
            }
            let base = partner.id.raw().checked_sub(sibling.address?.into())?;
            let is_own = partner.address == Some(from.id.raw() as u8) && base.trailing_zeros() >= 8;
            let id = is_own.then(|| Id::standard(base + u32::from(address)))??;
            Some(Endpoint { id, address: partner.address })
        })
    }
}
