//! Compressed files that are whole whenever this program ends.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

/// Compression that leaves a slow machine time to capture: level 1 of 9.
const GZIP_LEVEL: u32 = 1;
/// zstd's own default.
#[cfg(feature = "zstd")]
const ZSTD_LEVEL: i32 = 3;
/// Compressed bytes are kept until so many are together or until a flush.
const COMPRESSED_BYTES: usize = 512 * 1024;

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

/// What a build without zstd says to such a file.
#[cfg(not(feature = "zstd"))]
pub(crate) fn without_zstd() -> io::Error {
    let reason = "this build has no zstd; build it with the feature `zstd`, or use gzip";
    io::Error::new(io::ErrorKind::Unsupported, reason)
}

/// A compressed file. A flush ends what gzip calls a member and zstd a frame, and the next bytes begin another: until then
/// they stay in memory, so that the file is whole whenever this program ends.
pub(crate) struct Compressed {
    file: File,
    compression: Compression,
    encoder: Encoder,
    /// Whether the encoder was given anything since the last flush.
    begun: bool,
    written: u64,
}

enum Encoder {
    Gzip(flate2::write::GzEncoder<Vec<u8>>),
    #[cfg(feature = "zstd")]
    Zstd(zstd::stream::write::Encoder<'static, Vec<u8>>),
}

impl Encoder {
    fn new(compression: Compression) -> io::Result<Self> {
        Ok(match compression {
            #[cfg(feature = "zstd")]
            Compression::Zstd => Self::Zstd(zstd::stream::write::Encoder::new(Vec::new(), ZSTD_LEVEL)?),
            #[cfg(not(feature = "zstd"))]
            Compression::Zstd => return Err(without_zstd()),
            Compression::Gzip | Compression::None => {
                let level = flate2::Compression::new(GZIP_LEVEL);
                Self::Gzip(flate2::write::GzEncoder::new(Vec::new(), level))
            }
        })
    }

    /// What came out and was not taken.
    fn out(&mut self) -> &mut Vec<u8> {
        match self {
            Self::Gzip(encoder) => encoder.get_mut(),
            #[cfg(feature = "zstd")]
            Self::Zstd(encoder) => encoder.get_mut(),
        }
    }
}

impl Compressed {
    /// An empty file.
    pub(crate) fn new(file: File, compression: Compression) -> io::Result<Self> {
        Ok(Self { file, compression, encoder: Encoder::new(compression)?, begun: false, written: 0 })
    }

    /// Takes bytes to be compressed.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.begun |= !bytes.is_empty();
        match &mut self.encoder {
            Encoder::Gzip(encoder) => encoder.write_all(bytes)?,
            #[cfg(feature = "zstd")]
            Encoder::Zstd(encoder) => encoder.write_all(bytes)?,
        }
        if self.encoder.out().len() >= COMPRESSED_BYTES { self.take_out() } else { Ok(()) }
    }

    /// How large the file is, with what is to be written next. What the encoder still holds is not in it.
    pub(crate) fn size(&mut self) -> u64 {
        self.written + self.encoder.out().len() as u64
    }

    fn take_out(&mut self) -> io::Result<()> {
        let out = self.encoder.out();
        self.file.write_all(out)?;
        self.written += out.len() as u64;
        out.clear();
        Ok(())
    }

    /// Ends the member or frame, if there is anything in it.
    pub(crate) fn flush(&mut self) -> io::Result<()> {
        if !std::mem::take(&mut self.begun) {
            return Ok(());
        }
        let rest = match std::mem::replace(&mut self.encoder, Encoder::new(self.compression)?) {
            Encoder::Gzip(encoder) => encoder.finish()?,
            #[cfg(feature = "zstd")]
            Encoder::Zstd(encoder) => encoder.finish()?,
        };
        self.file.write_all(&rest)?;
        self.written += rest.len() as u64;
        Ok(())
    }

    /// Ends the file.
    pub(crate) fn finish(mut self) -> io::Result<()> {
        // A file without anything in it is a compressed one all the same.
        self.begun |= self.written == 0;
        self.flush()
    }
}
