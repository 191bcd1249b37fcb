//! A data type as it is read.

/// Which of the two languages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Generation {
    /// DroneCAN, which was UAVCAN v0: files `*.uavcan`.
    DroneCan,
    /// Cyphal, which was UAVCAN v1: files `*.dsdl`.
    Cyphal,
}

/// A message type, or a service with its two messages.
#[derive(Clone, Debug, Default)]
pub(crate) struct Definition {
    /// Its full name; Cyphal's with the version: `uavcan.node.Heartbeat.1.0`.
    pub name: String,
    /// Its own data type, subject or service number, if it has one.
    pub port: Option<u16>,
    /// The major and minor version, of Cyphal's.
    pub version: (u8, u8),
    /// The message, or a service's request.
    pub request: Section,
    /// A service's response.
    pub response: Option<Section>,
    /// DroneCAN's data type signature, which the CRC of its transfers begins with.
    pub signature: u64,
}

/// The fields of a message.
#[derive(Clone, Debug, Default)]
pub(crate) struct Section {
    /// Only one of the fields is there.
    pub is_union: bool,
    /// Its length does not stand before it where it is nested (Cyphal).
    pub is_sealed: bool,
    /// In order.
    pub members: Vec<Member>,
    /// The least number of bits, where an array may be empty and without its length (DroneCAN).
    pub least_bits: u32,
}

/// A field.
#[derive(Clone, Debug)]
pub(crate) struct Member {
    /// Its name; empty for a void.
    pub name: String,
    /// How it is read.
    pub kind: Kind,
    /// The unit that the definition names; empty without one.
    pub unit: &'static str,
    /// What its values mean, by the definition's constants.
    pub meanings: Vec<(i64, String)>,
    /// The constants are bits, of which several may be set.
    pub is_flags: bool,
}

/// How a field is read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// This many bits without meaning.
    Void(u8),
    /// One bit.
    Bool,
    /// This many bits.
    Unsigned(u8),
    /// This many bits, in two's complement.
    Signed(u8),
    /// 16, 32 or 64 bits of IEEE 754.
    Float(u8),
    /// An array.
    Array(Box<Self>, Size),
    /// The type with this number in its library.
    Nested(usize),
    /// An array of bytes that is text.
    Text(Size),
}

/// How many elements an array has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Size {
    /// Always so many.
    Fixed(u32),
    /// At most so many; their number stands before them.
    UpTo(u32),
}

impl Size {
    /// The most that there can be.
    pub const fn most(self) -> u32 {
        match self {
            Self::Fixed(count) | Self::UpTo(count) => count,
        }
    }
}

/// How many bits a number of `0..=most` takes.
pub const fn bits_for(most: u32) -> u8 {
    (u32::BITS - most.leading_zeros()) as u8
}
