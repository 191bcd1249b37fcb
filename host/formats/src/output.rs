//! Where a writer's bytes go: a file or standard output, plain or compressed.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

use super::compressed::Compressed;
use super::compression::Compression;

/// A destination of bytes.
pub(crate) enum Output {
    /// A plain file: it can be patched, and is truncated to whole records when the disk is full.
    File {
        file: File,
        written: u64,
        /// The file's length including its provisional end.
        extent: u64,
    },
    /// A compressed file.
    Compressed(Box<Compressed>),
    /// Standard output and any other byte stream.
    Stream(Box<dyn Write + Send>),
}

/// Bytes to be changed later, such as a length in a header.
pub(crate) struct Patch {
    /// From the start of the file.
    pub offset: u64,
    /// The new bytes.
    pub bytes: Vec<u8>,
    /// What other programs will miss if it cannot be done.
    pub missed: Option<&'static str>,
}

impl Output {
    /// Creates a file, or uses standard output for `-`.
    pub(crate) fn create(path: &Path) -> io::Result<Self> {
        if path.as_os_str() == "-" {
            return Ok(Self::Stream(Box::new(io::stdout())));
        }
        let compression = Compression::of_path(path);
        // If it cannot be written, nothing is created or overwritten.
        compression.map_or(Ok(()), Compression::check_written)?;
        let file = File::create(path)?;
        Ok(match compression {
            // A pipe or device cannot be rewound.
            None if !file.metadata()?.is_file() => Self::Stream(Box::new(file)),
            None => Self::File { file, written: 0, extent: 0 },
            Some(compression) => Self::Compressed(Box::new(Compressed::new(file, compression)?)),
        })
    }

    /// Writes whole records. If that fails half-way, a plain file is truncated to the last complete record,
    /// which `whole` determines from the bytes that were written.
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
            // The first error is the one to report; this only tidies up after it.
            if file.set_len(kept).and_then(|()| file.seek(SeekFrom::Start(kept))).is_ok() {
                *written = kept;
            }
            return Err(error);
        }
        *written += done as u64;
        // The rest of a longer provisional end.
        if *extent > *written {
            file.set_len(*written)?;
        }
        *extent = *written;
        Ok(())
    }

    /// Writes a provisional end, so that the file is valid if nothing more comes; whatever comes next overwrites it.
    /// If that is impossible, nothing is written.
    pub(crate) fn provisional_end(&mut self, bytes: &[u8]) -> io::Result<()> {
        let Self::File { file, written, extent } = self else { return Ok(()) };
        if bytes.is_empty() {
            return Ok(());
        }
        *extent = *written + bytes.len() as u64;
        let result = file.write_all(bytes);
        if result.is_err() {
            // The first error is the one to report; this only tidies up after it.
            let _ = file.set_len(*written);
        }
        file.seek(SeekFrom::Start(*written))?;
        result
    }

    /// The current size of the file, including what is written next; `None` if it is not a file. What a compressor still
    /// holds is not included.
    pub(crate) fn size(&mut self) -> Option<u64> {
        match self {
            Self::File { written, .. } => Some(*written),
            Self::Compressed(compressed) => Some(compressed.size()),
            Self::Stream(_) => None,
        }
    }

    /// Changes bytes already written. False if that is impossible.
    pub(crate) fn patch(&mut self, patch: &Patch) -> io::Result<bool> {
        let Self::File { file, written, .. } = self else { return Ok(false) };
        file.seek(SeekFrom::Start(patch.offset))?;
        file.write_all(&patch.bytes)?;
        file.seek(SeekFrom::Start(*written))?;
        Ok(true)
    }

    /// Passes everything to the system, so that a crash of this program loses none of it.
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
