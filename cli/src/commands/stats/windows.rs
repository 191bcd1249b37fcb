//! The windows of a trace, on disk until the summary has been printed: a long trace has too many of them for
//! memory.

use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Seek, Write};

use anyhow::Context;
use cantap_analysis::stats::{PeakSummary, Window};

/// Windows in the order in which they were closed.
pub(super) struct Windows {
    /// One JSON object per line.
    file: BufWriter<File>,
    /// The first error.
    result: io::Result<()>,
}

impl Windows {
    /// Empty, in a temporary file.
    pub(super) fn new() -> anyhow::Result<Self> {
        let file = tempfile::tempfile()
            .context("the windows need room for a temporary file; make some, or name a folder in TMPDIR")?;
        Ok(Self { file: BufWriter::new(file), result: Ok(()) })
    }

    /// Adds a window.
    pub(super) fn push(&mut self, window: &Window) {
        if self.result.is_ok() {
            let written = serde_json::to_writer(&mut self.file, &PeakSummary::of(window));
            self.result = written.map_err(io::Error::from).and_then(|()| self.file.write_all(b"\n"));
        }
    }

    /// Passes on all windows, each as a JSON object.
    pub(super) fn for_each(self, mut take: impl FnMut(&str) -> anyhow::Result<()>) -> anyhow::Result<()> {
        self.result?;
        let mut file = self.file.into_inner().map_err(io::IntoInnerError::into_error)?;
        file.rewind()?;
        BufReader::new(file).lines().try_for_each(|line| take(&line?))
    }
}
