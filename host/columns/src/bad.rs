//! What may be wrong with a table.

use arrow_schema::ArrowError;

/// Why columns are not a trace.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BadColumns {
    /// A column is missing or has another type.
    #[error("a trace has a column '{column}' ({wanted}); {found}")]
    Column {
        /// Its name.
        column: String,
        /// The types that are taken.
        wanted: &'static str,
        /// What was found instead.
        found: String,
    },
    /// A row contains something that a trace cannot hold.
    #[error("row {row}: {what}")]
    Row {
        /// The row's index in its batch, from 0.
        row: usize,
        /// What is wrong there.
        what: String,
    },
    /// The file cannot be read.
    #[error(transparent)]
    Arrow(#[from] ArrowError),
}

impl BadColumns {
    /// The same, of a batch that comes after so many rows.
    #[must_use]
    pub fn after(self, rows: usize) -> Self {
        match self {
            Self::Row { row, what } => Self::Row { row: row + rows, what },
            other => other,
        }
    }
}
