//! Why a request is refused: each text says what to do next.

use cantap_formats::{NothingRead, OpenError};
use cantap_signals::DatabaseError;

/// Why a request is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EngineError {
    /// Its bytes are not those of a message: page and engine are of different builds.
    #[error("the page and its engine do not belong together; get both from one build of cantap")]
    BadMessage,
    /// Its head is not that of a request.
    #[error("the engine does not know this request ({0}); get page and engine from one build of cantap")]
    BadRequest(String),
    /// No trace is open.
    #[error("no trace is open; open one first")]
    NoTrace,
    /// What a live source sent is damaged.
    #[error("{0}; load the page anew")]
    Damaged(#[from] cantap_trace::packed::Damaged),
    /// A board's session is under way.
    #[error(
        "a board is open, and what it sends is being taken in; close it first, and save what is not to be lost"
    )]
    BoardOpen,
    /// No board is open.
    #[error("no board is open; open one first")]
    NoBoard,
    /// `append` after the end.
    #[error("the trace is complete; open a new one")]
    Complete,
    /// The trace's format is not recognised.
    #[error("{0}; give the file a name that shows its format, such as .log, .asc, .blf or .trc")]
    Format(String),
    /// A file of a format that is read at many places, and more than fits into the page.
    #[error(
        "a file of this format must fit into the page as a whole, and this one is too large; \
         convert it to BLF, or a part of it, with cantap convert"
    )]
    TooLarge,
    /// The trace could not be opened.
    #[error(transparent)]
    Open(OpenError),
    /// Nothing of the trace could be read.
    #[error(transparent)]
    Nothing(#[from] NothingRead),
    /// A database is unusable.
    #[error(transparent)]
    Database(#[from] DatabaseError),
    /// A description is unusable.
    #[error("{0}")]
    Description(String),
    /// A text is no filter and no condition.
    #[error("{0}")]
    Filter(String),
    /// A view is no longer kept.
    #[error("this view is no longer kept; filter again")]
    NoView,
    /// A row that there is not.
    #[error("the trace has no record {0}")]
    NoRecord(u64),
    /// A key of a signal from before a database changed.
    #[error("this signal is no longer known, because a database has changed; ask for the messages again")]
    NoSignal,
    /// An impossible identifier.
    #[error("{0:X} is no identifier: a standard one has 11 bits, an extended one 29")]
    BadId(u32),
    /// An impossible bit rate.
    #[error("a bit rate of {0} bit/s is impossible; give one such as 500000")]
    BadBitrate(u32),
    /// A signal that cannot be.
    #[error("{0}")]
    Signal(String),
    /// The export failed.
    #[error("cannot write this as {0}: {1}")]
    Export(String, String),
}

impl From<OpenError> for EngineError {
    fn from(error: OpenError) -> Self {
        match error {
            OpenError::Format(unknown) => Self::Format(unknown.to_string()),
            error => Self::Open(error),
        }
    }
}
