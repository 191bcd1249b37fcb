//! Where a writer's bytes go: a file or standard output, plain or compressed.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;

/// Compression that leaves a slow machine time to capture: level 1 of 9.
const GZIP_LEVEL: u32 = 1;
/// zstd's own default.
const ZSTD_LEVEL: i32 = 3;

/// A destination of bytes.
pub(crate) enum Output {
    /// A plain file: can be patched, and is cut back to whole records when the disk is full.
    File { file: File, written: u64 },
    /// gzip.
    Gzip(flate2::write::GzEncoder<File>),
    /// zstd.
    Zstd(zstd::stream::write::Encoder<'static, File>),
    /// Standard output and whatever else only takes bytes.
    Stream(Box<dyn Write + Send>),
}

/// Bytes to be changed after the fact, such as a length in a header.
pub(crate) struct Patch {
    /// From the start of the file.
    pub offset: u64,
    /// What shall stand there.
    pub bytes: Vec<u8>,
}

/// How a path's last suffix says to compress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Compression {
    None,
    Gzip,
    Zstd,
}

impl Compression {
    /// By suffix: `.gz`, `.zst`.
    pub(crate) fn of(path: &Path) -> Self {
        match path.extension().and_then(|suffix| suffix.to_str()) {
            Some(suffix) if suffix.eq_ignore_ascii_case("gz") => Self::Gzip,
            Some(suffix) if suffix.eq_ignore_ascii_case("zst") => Self::Zstd,
            _ => Self::None,
        }
    }
}

impl Output {
    /// Creates a file, or uses standard output for `-`.
    pub(crate) fn create(path: &Path) -> io::Result<Self> {
        if path.as_os_str() == "-" {
            return Ok(Self::Stream(Box::new(io::stdout())));
        }
        let file = File::create(path)?;
        Ok(match Compression::of(path) {
            Compression::Gzip => {
                Self::Gzip(flate2::write::GzEncoder::new(file, flate2::Compression::new(GZIP_LEVEL)))
            }
            Compression::Zstd => Self::Zstd(zstd::stream::write::Encoder::new(file, ZSTD_LEVEL)?),
            // A pipe or device has no place to go back to.
            Compression::None if !file.metadata()?.is_file() => Self::Stream(Box::new(file)),
            Compression::None => Self::File { file, written: 0 },
        })
    }

    /// Writes whole records. If that fails half-way, a plain file is cut back to the last record
    /// that is complete, as `whole` tells from the bytes that went out.
    pub(crate) fn write(&mut self, bytes: &[u8], whole: impl Fn(&[u8]) -> usize) -> io::Result<()> {
        let (file, written) = match self {
            Self::Gzip(encoder) => return encoder.write_all(bytes),
            Self::Zstd(encoder) => return encoder.write_all(bytes),
            Self::Stream(stream) => return stream.write_all(bytes),
            Self::File { file, written } => (file, written),
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
        Ok(())
    }

    /// How large the file is by now; `None` for what is no file. What a compressor still holds is not in
    /// it.
    pub(crate) fn size(&self) -> Option<u64> {
        let file = match self {
            Self::File { written, .. } => return Some(*written),
            Self::Gzip(encoder) => encoder.get_ref(),
            Self::Zstd(encoder) => encoder.get_ref(),
            Self::Stream(_) => return None,
        };
        file.metadata().ok().map(|metadata| metadata.len())
    }

    /// Changes bytes already written. False where that cannot be done.
    pub(crate) fn patch(&mut self, patch: &Patch) -> io::Result<bool> {
        let Self::File { file, written } = self else { return Ok(false) };
        file.seek(SeekFrom::Start(patch.offset))?;
        file.write_all(&patch.bytes)?;
        file.seek(SeekFrom::Start(*written))?;
        Ok(true)
    }

    /// Hands everything to the system, so that a crash of this program loses none of it.
    pub(crate) fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::File { file, .. } => file.flush(),
            Self::Gzip(encoder) => encoder.flush(),
            Self::Zstd(encoder) => encoder.flush(),
            Self::Stream(stream) => stream.flush(),
        }
    }

    /// Ends the file.
    pub(crate) fn finish(self) -> io::Result<()> {
        match self {
            Self::File { mut file, .. } => file.flush(),
            Self::Gzip(encoder) => encoder.finish()?.flush(),
            Self::Zstd(encoder) => encoder.finish()?.flush(),
            Self::Stream(mut stream) => stream.flush(),
        }
    }
}
