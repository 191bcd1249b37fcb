//! Where a writer's bytes go: a file or standard output, plain or compressed.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

use super::compressed::Compressed;
use super::compression::Compression;

/// A destination of bytes.
pub(crate) enum Output {
    /// A plain file: can be patched, and is cut back to whole records when the disk is full.
    File {
        file: File,
        written: u64,
        /// How long the file is with its provisional end.
        extent: u64,
    },
    /// A compressed file.
    Compressed(Box<Compressed>),
    /// Standard output and whatever else only takes bytes.
    Stream(Box<dyn Write + Send>),
}

/// Bytes to be changed after the fact, such as a length in a header.
pub(crate) struct Patch {
    /// From the start of the file.
    pub offset: u64,
    /// What shall stand there.
    pub bytes: Vec<u8>,
    /// What other programs miss where it cannot be done.
    pub missed: Option<&'static str>,
}

impl Output {
    /// Creates a file, or uses standard output for `-`.
    pub(crate) fn create(path: &Path) -> io::Result<Self> {
        if path.as_os_str() == "-" {
            return Ok(Self::Stream(Box::new(io::stdout())));
        }
        let file = File::create(path)?;
        Ok(match Compression::of_path(path) {
            // A pipe or device has no place to go back to.
            None if !file.metadata()?.is_file() => Self::Stream(Box::new(file)),
            None => Self::File { file, written: 0, extent: 0 },
            Some(compression) => Self::Compressed(Box::new(Compressed::new(file, compression)?)),
        })
    }

    /// Writes whole records. If that fails half-way, a plain file is cut back to the last record
    /// that is complete, as `whole` tells from the bytes that went out.
    pub(crate) fn write(&mut self, bytes: &[u8], whole: impl Fn(&[u8]) -> usize) -> io::Result<()> {
        let (file, written, extent) = match self {
            Self::Compressed(compressed) => return compressed.write(bytes),
            Self::Stream(stream) => return stream.write_all(bytes),
            Self::File { file, written, extent } => (file, written, extent),
        };
        let mut done = 0;
        while done < bytes.len() {
            let error = match file.write(&bytes[done..]) {
                Ok(0) => io::ErrorKind::WriteZero.into(),
                Ok(count) => {
                    done += count;
                    continue;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => error,
            };
            let kept = *written + whole(&bytes[..done]) as u64;
            // The first error is the one to report; this is only tidying up after it.
            if file.set_len(kept).and_then(|()| file.seek(SeekFrom::Start(kept))).is_ok() {
                *written = kept;
            }
            return Err(error);
        }
        *written += done as u64;
        // What is left of a provisional end that was longer.
        if *extent > *written {
            file.set_len(*written)?;
        }
        *extent = *written;
        Ok(())
    }

    /// Writes a provisional end, so that the file is whole if nothing more comes: what does come is written over it.
    /// Where that cannot be done, nothing is written.
    pub(crate) fn provisional_end(&mut self, bytes: &[u8]) -> io::Result<()> {
        let Self::File { file, written, extent } = self else { return Ok(()) };
        if bytes.is_empty() {
            return Ok(());
        }
        *extent = *written + bytes.len() as u64;
        let result = file.write_all(bytes);
        if result.is_err() {
            // The first error is the one to report; this is only tidying up after it.
            let _ = file.set_len(*written);
        }
        file.seek(SeekFrom::Start(*written))?;
        result
    }

    /// How large the file is by now, with what is to be written next; `None` for what is no file. What a compressor still
    /// holds is not in it.
    pub(crate) fn size(&mut self) -> Option<u64> {
        match self {
            Self::File { written, .. } => Some(*written),
            Self::Compressed(compressed) => Some(compressed.size()),
            Self::Stream(_) => None,
        }
    }

    /// Changes bytes already written. False where that cannot be done.
    pub(crate) fn patch(&mut self, patch: &Patch) -> io::Result<bool> {
        let Self::File { file, written, .. } = self else { return Ok(false) };
        file.seek(SeekFrom::Start(patch.offset))?;
        file.write_all(&patch.bytes)?;
        file.seek(SeekFrom::Start(*written))?;
        Ok(true)
    }

    /// Hands everything to the system, so that a crash of this program loses none of it.
    pub(crate) fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::File { file, .. } => file.flush(),
            Self::Compressed(compressed) => compressed.flush(),
            Self::Stream(stream) => stream.flush(),
        }
    }

    /// Ends the file.
    pub(crate) fn finish(self) -> io::Result<()> {
        match self {
            Self::File { mut file, .. } => file.flush(),
            Self::Compressed(compressed) => compressed.finish(),
            Self::Stream(mut stream) => stream.flush(),
        }
    }
}
