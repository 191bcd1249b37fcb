//! The columns by which the fixed view can be sorted.

/// A column to sort by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Column {
    /// Identifier.
    Id,
    /// Frames so far, most first.
    Count,
    /// Period, shortest first.
    Period,
    /// Jitter, largest first.
    Jitter,
    /// Last frame, newest first.
    Time,
    /// Name.
    Name,
}

impl Column {
    /// The next one.
    pub const fn next(self) -> Self {
        match self {
            Self::Id => Self::Count,
            Self::Count => Self::Period,
            Self::Period => Self::Jitter,
            Self::Jitter => Self::Time,
            Self::Time => Self::Name,
            Self::Name => Self::Id,
        }
    }
}
