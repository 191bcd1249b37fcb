//! What users are shown of a file.

use cantap_trace::clean;

/// How many things that are left out are listed by name.
pub const MOST_ISSUES: usize = 1000;

/// A text of the file, as it can be shown.
pub fn shown(text: &str) -> String {
    clean::line(text).into_owned()
}
