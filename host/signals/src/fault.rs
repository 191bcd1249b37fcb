//! What can be wrong with a database, each fault with its line and symbol.

use std::fmt;

use super::clean;

/// Why a database could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatabaseError {
    /// The file could not be read.
    #[error("cannot read database {file}: {source}")]
    Read {
        /// The file.
        file: String,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The suffix is that of no database.
    #[error(
        "{file} is no known kind of database; use a .dbc, .kcd, .sym or .arxml file, or a .toml signal file (docs/signal-file.md)"
    )]
    UnknownKind {
        /// The file.
        file: String,
    },
    /// The content is wrong.
    #[error("{}", list(file, faults))]
    Faulty {
        /// The file.
        file: String,
        /// Everything that is wrong, in the order of lines; at least one.
        faults: Vec<Fault>,
    },
}

/// More would scroll the first, which is mostly the cause of the others, off the screen.
const FAULTS_SHOWN: usize = 10;

fn list(file: &str, faults: &[Fault]) -> String {
    let mut text: Vec<_> = faults.iter().take(FAULTS_SHOWN).map(|fault| format!("{file}: {fault}")).collect();
    if let Some(more) = faults.len().checked_sub(FAULTS_SHOWN).filter(|&more| more > 0) {
        text.push(format!("{file}: and {more} more"));
    }
    text.join("\n")
}

/// Most multiplexers, one after another, that a signal may depend on. Databases have two or three.
pub(super) const MAX_SWITCHES: usize = 16;

/// One thing that is wrong in a database.
#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    /// The line, from 1; 0 if it is not known.
    pub line: u32,
    /// The message or signal (`Message.Signal`), or the statement; empty if it is not known.
    pub symbol: String,
    /// What is wrong.
    pub kind: FaultKind,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.line > 0 {
            write!(f, "line {}: ", self.line)?;
        }
        // Words of the file stand in both.
        if !self.symbol.is_empty() {
            write!(f, "{}: ", clean::line(&self.symbol))?;
        }
        f.write_str(&clean::line(&self.kind.to_string()))
    }
}

/// What is wrong.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FaultKind {
    /// The text is not what the format says. Carries what was expected.
    #[error("{0}")]
    Syntax(String),
    /// An identifier that no frame can have.
    #[error(
        "identifier 0x{0:X} does not fit 11 bits (standard) or 29 bits (extended: add 0x80000000 in DBC)"
    )]
    Id(u64),
    /// A signal without bits.
    #[error("a signal needs at least 1 bit")]
    NoBits,
    /// More bits than a value can have.
    #[error("{0} bits are more than a number can have (64); the signal is left out")]
    TooManyBits(u64),
    /// A place that no message has.
    #[error("start bit {0} is beyond the longest message")]
    Start(u64),
    /// A message longer than any transport carries.
    #[error("{0} bytes are more than the longest message has")]
    MessageLength(u64),
    /// A float with a length that IEEE 754 does not have.
    #[error("a float of {0} bits does not exist; it has 16, 32 or 64")]
    FloatLength(u16),
    /// The signal ends beyond its message.
    #[error("the signal needs {needed} bytes, the message has {length}")]
    OutsideMessage {
        /// Bytes that the signal needs.
        needed: u32,
        /// Bytes that the message has.
        length: u16,
    },
    /// The factor is zero.
    #[error("the factor is 0, so that every value is the offset")]
    ZeroFactor,
    /// Factor or offset is no finite number.
    #[error("factor {factor} and offset {offset} make no value")]
    Scale {
        /// The factor.
        factor: f64,
        /// The offset.
        offset: f64,
    },
    /// Two messages with the same identifier.
    #[error("identifier {id} is already that of {other}; frames are decoded as the later one")]
    DuplicateId {
        /// The identifier, as text.
        id: String,
        /// The earlier message.
        other: String,
    },
    /// Several buses are read as one, and messages of different ones have the same identifier.
    #[error(
        "the file has the buses {}, of which {messages} messages have the identifier of another bus's; name the channel's bus behind \
         the file, as in FILE#{}", .buses.join(", "), .buses[0]
    )]
    SeveralBuses {
        /// Their names, at least two.
        buses: Vec<String>,
        /// Messages whose identifier is also that of one on a bus before.
        messages: usize,
    },
    /// Two signals of a message with the same name.
    #[error("the message has another signal of this name")]
    DuplicateSignal,
    /// A multiplexed signal whose multiplexer is not there.
    #[error("there is no multiplexer {0:?} in this message; the signal is taken as always present")]
    NoMultiplexer(String),
    /// Multiplexers that depend on each other, or too many of them.
    #[error("the signal is multiplexed by itself through {0:?}, or through more than {max} others", max = MAX_SWITCHES)]
    Multiplexers(String),
    /// A statement about a message or signal that is not there.
    #[error("there is no such message or signal; the statement is left out")]
    UnknownSymbol,
    /// A statement without which the values stay right, and that cannot be understood.
    #[error("this statement is not understood and left out ({0})")]
    Ignored(String),
    /// A statement that a message's values depend on cannot be understood.
    #[error("a statement that its values depend on is not understood")]
    Related,
    /// A message with a fault that would make values wrong, in a database that can be used without it.
    #[error("{0}; the message is left out")]
    LeftOut(Box<FaultKind>),
    /// A float with a length that most programs refuse.
    #[error("a float of {0} bits is unusual; it is read as the upper bits of the next longer one")]
    OddFloat(u16),
}

impl FaultKind {
    /// Whether the message can still be used. Everything else makes values wrong.
    pub fn is_warning(&self) -> bool {
        matches!(
            self,
            Self::TooManyBits(_)
                | Self::ZeroFactor
                | Self::OutsideMessage { .. }
                | Self::DuplicateId { .. }
                | Self::SeveralBuses { .. }
                | Self::DuplicateSignal
                | Self::NoMultiplexer(_)
                | Self::UnknownSymbol
                | Self::Ignored(_)
                | Self::LeftOut(_)
                | Self::OddFloat(_)
        )
    }
}
