//! A test of a table's row.

use rhai::FnPtr;

/// A test that a script's own lines have made.
#[derive(Clone, Debug)]
pub struct RowTest {
    /// Its name with its row's number.
    pub name: String,
    /// The row, as a text.
    pub row: String,
    /// The function, which has got its row.
    pub call: FnPtr,
}
