//! The windows of a trace, on disk until the summary has been printed: a long trace has too many of them for
//! memory.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, Write};

use anyhow::Context;
use cantap_analysis::stats::{PeakSummary, Window};

/// The longest window in the file: a byte, six numbers of 8 bytes or 10, an optional one and a flag.
const MOST_BYTES: usize = 128;

/// Windows in the order in which they were closed.
pub(super) struct Windows {
    /// Each with its length in front, in one byte.
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
            let mut bytes = [0; MOST_BYTES];
            let written = postcard::to_slice(&PeakSummary::of(window), &mut bytes);
            self.result = written.map_err(io::Error::other).and_then(|bytes| {
                self.file.write_all(&[bytes.len() as u8]).and_then(|()| self.file.write_all(bytes))
            });
        }
    }

    /// Passes on all windows.
    pub(super) fn for_each(
        self,
        mut take: impl FnMut(&PeakSummary) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        self.result?;
        let mut file = self.file.into_inner().map_err(io::IntoInnerError::into_error)?;
        let end = file.stream_position()?;
        file.rewind()?;
        let mut file = BufReader::new(file.take(end));
        let mut bytes = [0; MOST_BYTES];
        loop {
            let mut len = [0];
            if file.read(&mut len)? == 0 {
                return Ok(());
            }
            let bytes = &mut bytes[..usize::from(len[0])];
            file.read_exact(bytes)?;
            take(&postcard::from_bytes(bytes)?)?;
        }
    }
}
