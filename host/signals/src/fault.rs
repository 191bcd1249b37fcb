//! What can be wrong with a database, each fault with its line and symbol.

use std::fmt;

use cantap_trace::clean;

/// Why a database could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatabaseError {
    /// The file could not be read.
    #[error("cannot read database {file}: {source}")]
    Read {
        /// The file.
        file: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// The suffix does not belong to any kind of database.
    #[error(
        "{file} is not a known kind of database; use a .dbc, .kcd, .sym, .arxml or .dbf file, a table of signals (.xlsx, .csv), or a .toml signal file (docs/signal-file.md)"
    )]
    UnknownKind {
        /// The file.
        file: String,
    },
    /// An archive or a compressed file is damaged, or has no database.
    #[error("cannot read a database in {file}: {what}")]
    Packed {
        /// The file.
        file: String,
        /// What is wrong.
        what: String,
    },
    /// An archive has several databases, or not the one that was named.
    #[error("{}; name the one to read: {}", several(file, missing.as_deref()), members(file, names))]
    Several {
        /// The archive.
        file: String,
        /// The name that was asked for and is not there.
        missing: Option<String>,
        /// The databases in it.
        names: Vec<String>,
    },
    /// The content is wrong.
    #[error("{}", list(file, faults))]
    Faulty {
        /// The file.
        file: String,
        /// Everything that is wrong, by line; at least one fault.
        faults: Vec<Fault>,
    },
}

fn several(file: &str, missing: Option<&str>) -> String {
    match missing {
        Some(name) => format!("{file} has no file {}", clean::line(name)),
        None => format!("{file} has several databases"),
    }
}

/// The first databases of an archive, as they are to be written.
fn members(file: &str, names: &[String]) -> String {
    const SHOWN: usize = 20;
    let mut shown: Vec<_> = names.iter().take(SHOWN).map(|name| format!("{file}/{name}")).collect();
    if names.len() > SHOWN {
        shown.push(format!("{} more", names.len() - SHOWN));
    }
    clean::line(&shown.join(", ")).into_owned()
}

/// More would scroll the first one, usually the cause of the others, off the screen.
const FAULTS_SHOWN: usize = 10;

fn list(file: &str, faults: &[Fault]) -> String {
    let mut text: Vec<_> = faults.iter().take(FAULTS_SHOWN).map(|fault| format!("{file}: {fault}")).collect();
    if let Some(more) = faults.len().checked_sub(FAULTS_SHOWN).filter(|&more| more > 0) {
        text.push(format!("{file}: and {more} more"));
    }
    text.join("\n")
}

/// The longest chain of multiplexers that a signal may depend on. Databases have two or three.
pub(super) const MAX_SWITCHES: usize = 16;

/// One thing that is wrong in a database.
#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    /// The line, from 1; 0 if unknown.
    pub line: u32,
    /// The message or signal (`Message.Signal`), or the statement; empty if unknown.
    pub symbol: String,
    /// What is wrong.
    pub kind: FaultKind,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.line > 0 {
            write!(f, "line {}: ", self.line)?;
        }
        // Both contain words of the file.
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
    /// The text does not follow the format. Contains what was expected.
    #[error("{0}")]
    Syntax(String),
    /// An identifier that no frame can have.
    #[error("identifier 0x{0:X} does not fit 11 bits (standard) or 29 bits (extended)")]
    Id(u64),
    /// Identifiers of 29 bits that the file does not mark as extended, such as by the flag of DBC files. Each is taken for an extended one.
    #[error(
        "identifier 0x{id:X} is not marked as extended and does not fit 11 bits; {messages} such {} read as extended", if *.messages == 1 { "message is" } else { "messages are" }
    )]
    UnflaggedIds {
        /// The first such identifier, as written in the file.
        id: u64,
        /// The number of messages with such identifiers.
        messages: usize,
    },
    /// A signal without bits.
    #[error("a signal needs at least 1 bit")]
    NoBits,
    /// More bits than a value can have.
    #[error("{0} bits are more than a number can have (64); the signal is left out")]
    TooManyBits(u64),
    /// A position that no message has.
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
    /// Factor or offset is not a finite number.
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
    /// Several buses are read as one, and some of their messages have the same identifier.
    #[error(
        "the file has the buses {}, of which {messages} messages have the identifier of another bus's; name the channel's bus behind \
         the file, as in FILE#{}", .buses.join(", "), .buses[0]
    )]
    SeveralBuses {
        /// Their names, at least two.
        buses: Vec<String>,
        /// The number of messages whose identifier is also used on an earlier bus.
        messages: usize,
    },
    /// Two signals of a message with the same name.
    #[error("the message has another signal of this name")]
    DuplicateSignal,
    /// A multiplexed signal whose multiplexer does not exist.
    #[error("there is no multiplexer {0:?} in this message; the signal is taken as always present")]
    NoMultiplexer(String),
    /// Multiplexers that depend on each other, or too long a chain of them.
    #[error("the signal is multiplexed by itself through {0:?}, or through more than {max} others", max = MAX_SWITCHES)]
    Multiplexers(String),
    /// A statement about a message or signal that does not exist.
    #[error("there is no such message or signal; the statement is left out")]
    UnknownSymbol,
    /// A statement that cannot be understood, but does not affect values.
    #[error("this statement is not understood and left out ({0})")]
    Ignored(String),
    /// A statement that affects a message's values and cannot be understood.
    #[error("a statement that its values depend on is not understood")]
    Related,
    /// A message that is left out because a fault would make its values wrong; the rest of the database is
    /// usable.
    #[error("{0}; the message is left out")]
    LeftOut(Box<FaultKind>),
    /// The file is not in one of the usual encodings; which one was taken.
    #[error("the file is read as {0}; if texts look wrong, save it as UTF-8")]
    Encoding(&'static str),
    /// What a table of signals does not say, and how it is read.
    #[error("{0}")]
    Guessed(String),
    /// A float with a length that most programs refuse.
    #[error("a float of {0} bits is unusual; it is read as the upper bits of the next longer one")]
    OddFloat(u16),
}

impl FaultKind {
    /// Whether the message can still be used. All other faults make values wrong.
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
                | Self::Encoding(_)
                | Self::UnflaggedIds { .. }
                | Self::OddFloat(_)
                | Self::Guessed(_)
        )
    }

    /// The fault that has no line.
    pub(super) fn of_whole_file(self) -> Fault {
        Fault { line: 0, symbol: String::new(), kind: self }
    }
}
