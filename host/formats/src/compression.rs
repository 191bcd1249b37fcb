//! How files are compressed: detected by suffix, and by their first bytes.

use std::io::{self, Read};
use std::path::Path;

use super::lz4;

/// A way to compress a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Compression {
    Gzip,
    Zstd,
    Xz,
    Lz4,
    /// Only read.
    Bzip2,
}

/// Each with its suffix and as many of its first four bytes as do not vary.
const KNOWN: [(Compression, &str, &[u8]); 6] = [
    (Compression::Gzip, ".gz", &[0x1F, 0x8B]),
    (Compression::Zstd, ".zst", &[0x28, 0xB5, 0x2F, 0xFD]),
    (Compression::Xz, ".xz", &[0xFD, b'7', b'z', b'X']),
    (Compression::Lz4, ".lz4", &lz4::MAGIC),
    (Compression::Lz4, ".lz4", &lz4::LEGACY_MAGIC),
    (Compression::Bzip2, ".bz2", b"BZh"),
];

/// This many bytes are enough to detect how a file is compressed.
pub(crate) const MAGIC_BYTES: usize = 4;

/// An xz file says how much memory unpacking takes; `xz -9` takes 65 MiB. More than this is damage or malice.
const XZ_MEMORY_KIB: u32 = 256 * 1024;

/// Reads Zstandard.
#[cfg(feature = "zstd")]
pub(crate) fn unpack_zstd<'a>(source: impl Read + Send + 'a) -> io::Result<impl Read + Send + 'a> {
    zstd::stream::read::Decoder::new(source)
}

#[cfg(all(feature = "zstd-in-rust", not(feature = "zstd")))]
pub(crate) fn unpack_zstd<'a>(source: impl Read + Send + 'a) -> io::Result<impl Read + Send + 'a> {
    Ok(crate::zstd_frames::Frames::new(source))
}

#[cfg(not(any(feature = "zstd", feature = "zstd-in-rust")))]
pub(crate) fn unpack_zstd<'a>(_: impl Read + Send + 'a) -> io::Result<io::Empty> {
    Err(without_zstd())
}

/// The error for such a file in a build without zstd.
#[cfg(not(feature = "zstd"))]
pub(crate) fn without_zstd() -> io::Error {
    let reason = "this build has no zstd; build it with the feature `zstd`, or use gzip";
    io::Error::new(io::ErrorKind::Unsupported, reason)
}

impl Compression {
    /// By suffix: `.gz`, `.zst`, `.xz`, `.lz4`, `.bz2`.
    pub(crate) fn of_path(path: &Path) -> Option<Self> {
        Self::split(&path.file_name()?.to_string_lossy()).1
    }

    /// Splits a file's name into the part without the compression suffix and the compression.
    pub(crate) fn split(name: &str) -> (&str, Option<Self>) {
        KNOWN
            .iter()
            .find_map(|(compression, suffix, _)| {
                let bare = name.len().checked_sub(suffix.len())?;
                let ends = name.get(bare..)?.eq_ignore_ascii_case(suffix);
                ends.then(|| (&name[..bare], Some(*compression)))
            })
            .unwrap_or((name, None))
    }

    /// By a file's first [`MAGIC_BYTES`].
    pub(crate) fn of_content(head: &[u8]) -> Option<Self> {
        KNOWN.iter().find(|(.., magic)| head.starts_with(magic)).map(|(compression, ..)| *compression)
    }

    /// Whether files can be written so. If not, the error says what else there is.
    pub(crate) fn check_written(self) -> io::Result<()> {
        if self != Self::Bzip2 {
            return Ok(());
        }
        let reason = "bzip2 is only read; .gz, .zst, .xz and .lz4 are written";
        Err(io::Error::new(io::ErrorKind::Unsupported, reason))
    }

    /// Unpacks a file; several members, frames or streams one after another are one file.
    pub(crate) fn unpack(self, source: impl Read + Send + 'static) -> io::Result<Box<dyn Read + Send>> {
        Ok(match self {
            Self::Gzip => Box::new(flate2::read::MultiGzDecoder::new(source)),
            Self::Zstd => Box::new(unpack_zstd(source)?),
            Self::Xz => Box::new(XzStreams::new(source)),
            Self::Lz4 => Box::new(lz4::Unpacker::new(source)),
            Self::Bzip2 => Box::new(bzip2::read::MultiBzDecoder::new(source)),
        })
    }
}

/// xz streams one after another: the crate's decoder takes a file that ends between two blocks for a complete
/// one.
struct XzStreams<R: Read>(lzma_rust2::XzReader<Tail<R>>);

/// A source that remembers the last two bytes read: zeros may follow a stream.
struct Tail<R> {
    source: R,
    last: [u8; 2],
}

impl<R: Read> Read for Tail<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let read = self.source.read(out)?;
        for byte in out[..read].iter().filter(|byte| **byte != 0) {
            self.last = [self.last[1], *byte];
        }
        Ok(read)
    }
}

impl<R: Read> XzStreams<R> {
    fn new(source: R) -> Self {
        let source = Tail { source, last: [0; 2] };
        Self(lzma_rust2::XzReader::new_mem_limit(source, true, XZ_MEMORY_KIB))
    }
}

impl<R: Read> Read for XzStreams<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        /// How each stream ends.
        const END: &[u8; 2] = b"YZ";
        /// If the file ends within what the decoder was asked for, it returns none of it.
        const MOST: usize = 4096;
        let len = out.len().min(MOST);
        let read = self.0.read(&mut out[..len])?;
        if read == 0 && !out.is_empty() && self.0.inner().last != *END {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use base64::Engine;
    use std::io::Write;

    fn unpack(compression: Compression, bytes: &[u8]) -> (Vec<u8>, Option<io::ErrorKind>) {
        let mut out = Vec::new();
        let result = compression.unpack(io::Cursor::new(bytes.to_vec())).unwrap().read_to_end(&mut out);
        (out, result.err().map(|error| error.kind()))
    }

    #[test]
    fn pieces_one_behind_the_other_are_one_file_and_a_missing_end_is_noticed() {
        let text = b"0123456789\n".repeat(20_000);
        let xz = |bytes: &[u8]| {
            let options = lzma_rust2::XzOptions::with_preset(1);
            let mut writer = lzma_rust2::XzWriter::new(Vec::new(), options).unwrap();
            writer.write_all(bytes).unwrap();
            writer.finish().unwrap()
        };
        let lz4 = |bytes: &[u8]| {
            let mut writer = lz4_flex::frame::FrameEncoder::new(Vec::new());
            writer.write_all(bytes).unwrap();
            writer.finish().unwrap()
        };
        let (first, second) = text.split_at(100_000);
        for (compression, pieces) in
            [(Compression::Xz, [xz(first), xz(second)]), (Compression::Lz4, [lz4(first), lz4(second)])]
        {
            let whole = pieces.concat();
            assert_eq!(Compression::of_content(&whole), Some(compression));
            assert_eq!(unpack(compression, &whole), (text.clone(), None));
            let (read, error) = unpack(compression, &whole[..whole.len() - 4]);
            assert!(text.starts_with(&read), "{compression:?}");
            assert_eq!(error, Some(io::ErrorKind::UnexpectedEof), "{compression:?}");
        }
    }

    /// `python3 -c "import bz2; print(bz2.compress(b'(1.0) can0 123#11\n' * 3 + b'a' * 300, 1))"`, in Base64.
    fn bzip2() -> (Vec<u8>, Vec<u8>) {
        const PACKED: &str = "QlpoMTFBWSZTWRaBmiMAAAZZAIAQSGF4ACgBAAggADEAAAj1CGj1GlFGjg+GkWTwiBCESdKLUNY+h2b4u5IpwoSAtAzRGA==";
        let content = [&b"(1.0) can0 123#11\n".repeat(3)[..], &[b'a'; 300]].concat();
        (base64::engine::general_purpose::STANDARD.decode(PACKED).unwrap(), content)
    }

    #[test]
    fn bzip2_s_streams_one_after_another_are_one_file() {
        let (packed, content) = bzip2();
        assert_eq!(Compression::of_content(&packed), Some(Compression::Bzip2));
        assert_eq!(unpack(Compression::Bzip2, &packed), (content.clone(), None));
        assert_eq!(unpack(Compression::Bzip2, &packed.repeat(3)), (content.repeat(3), None));
    }

    #[test]
    fn a_cut_in_bzip2_is_an_unexpected_end_and_nothing_before_it_is_lost() {
        let (packed, content) = bzip2();
        let whole = packed.repeat(2);
        for len in 1..whole.len() {
            let (out, error) = unpack(Compression::Bzip2, &whole[..len]);
            let is_between = len == packed.len();
            assert_eq!(error, (!is_between).then_some(io::ErrorKind::UnexpectedEof), "{len}");
            assert!(content.repeat(2).starts_with(&out), "{len}");
            assert!(len < packed.len() || out.len() >= content.len(), "{len}");
        }
    }

    #[test]
    fn every_changed_byte_of_bzip2_is_noticed_and_none_is_a_panic() {
        let (whole, content) = bzip2();
        for at in 0..whole.len() {
            for change in 1..=255 {
                let mut bytes = whole.clone();
                bytes[at] ^= change;
                let (out, error) = unpack(Compression::Bzip2, &bytes);
                // The last bits fill a byte up, and the size of blocks may be larger than needed.
                assert!(error.is_some() || out == content, "{at} {change}");
            }
        }
        // What follows the end and is no stream is damage, too.
        let (out, error) = unpack(Compression::Bzip2, &[&whole[..], b"more"].concat());
        assert!(out == content && error.is_some(), "{error:?}");
    }

    #[test]
    fn names_are_looked_through() {
        for (name, bare, compression) in [
            ("a.log.gz", "a.log", Some(Compression::Gzip)),
            ("a.blf.XZ", "a.blf", Some(Compression::Xz)),
            ("a.lz4", "a", Some(Compression::Lz4)),
            ("a.asc.bz2", "a.asc", Some(Compression::Bzip2)),
            ("µ", "µ", None),
            ("a.gzip", "a.gzip", None),
        ] {
            assert_eq!(Compression::split(name), (bare, compression));
        }
    }
}
