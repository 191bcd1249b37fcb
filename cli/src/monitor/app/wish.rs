//! What the keys of one source ask of the whole display.

use std::path::PathBuf;

/// What only whoever has the display can do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Wish {
    /// Open this trace beside what runs.
    Beside(PathBuf),
    /// Look at the next source.
    Next,
    /// Close this one, unless it is the only one.
    Close,
}
