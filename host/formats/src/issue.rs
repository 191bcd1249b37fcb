//! What can be wrong with a trace file, and where, so that users can look there.

use std::borrow::Cow;
use std::fmt;
use std::io;
use std::sync::Arc;

/// Where in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Place {
    /// A line of a text file, counted from 1.
    Line(u64),
    /// Bytes from the start of a binary file, after decompression.
    Offset(u64),
    /// A row of a database table, by its number.
    Row(i64),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(line) => write!(f, "line {line}"),
            Self::Offset(offset) => write!(f, "offset {offset:#x}"),
            Self::Row(row) => write!(f, "row {row}"),
        }
    }
}

/// What is wrong there.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Fault {
    /// The text or bytes do not follow the format.
    #[error("expected {expected}, found {found}")]
    Malformed {
        /// What should be there.
        expected: Cow<'static, str>,
        /// What is there, shortened.
        found: String,
    },
    /// The file ends in the middle of something.
    #[error("the file ends inside {0}; everything before it was read")]
    Truncated(&'static str),
    /// Well-formed, but not part of a classical CAN trace.
    #[error("{0} cannot be represented and is left out")]
    Unsupported(Cow<'static, str>),
    /// The system could not deliver the bytes. Reading ends here.
    #[error("cannot read on: {0}")]
    Io(#[from] io::Error),
}

impl Fault {
    /// A [`Fault::Malformed`] that shows the start of what was found.
    pub(crate) fn malformed(expected: impl Into<Cow<'static, str>>, found: &[u8]) -> Self {
        const SHOWN: usize = 60;
        let mut shown = String::from_utf8_lossy(&found[..found.len().min(SHOWN)]).into_owned();
        shown.retain(|character| !cantap_trace::clean::is_harmful(character));
        let found = match (found.len(), shown.is_empty()) {
            (0, _) => "nothing".to_owned(),
            (_, true) => "unprintable bytes".to_owned(),
            (len, _) if len > SHOWN => format!("'{shown}…'"),
            _ => format!("'{shown}'"),
        };
        Self::Malformed { expected: expected.into(), found }
    }
}

/// One thing wrong with a file. Reading continues after it, except after [`Fault::Io`] and in
/// strict mode.
#[derive(Debug, thiserror::Error)]
#[error("{file}, {place}: {fault}")]
pub struct ReadIssue {
    /// The file's name, as given.
    pub file: Arc<str>,
    /// The place.
    pub place: Place,
    /// The fault.
    #[source]
    pub fault: Fault,
}
