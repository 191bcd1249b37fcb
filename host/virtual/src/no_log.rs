//! In place of `log.rs` in a build without the feature `nodes`: nothing there reads trace files.

use std::path::Path;

use super::options::{BadOption, Options};

impl Options {
    /// Refuses to replay a trace file.
    pub fn read_log(&mut self, path: &Path) -> Result<(), BadOption> {
        Err(BadOption::Value {
            key: "log".to_owned(),
            value: path.display().to_string(),
            reason: "this build reads no trace files; build it with the feature `nodes`".to_owned(),
        })
    }
}
