//! Requests from one source's keys to the whole display.

use std::path::PathBuf;

/// What only the owner of the display can do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Request {
    /// Open this trace beside what is running.
    Open(PathBuf),
    /// Have the user edit this script, with the terminal.
    Edit(PathBuf),
    /// Show the next source.
    Next,
    /// Close this one, unless it is the only one.
    Close,
}
