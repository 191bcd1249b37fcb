//! Compressed files that are complete whenever this program ends.

use std::fs::File;
use std::io::{self, Write};
use std::time::{Duration, Instant};

use super::compression::Compression;
#[cfg(not(feature = "zstd"))]
use super::compression::without_zstd;

/// A compression level that leaves a slow machine time to capture: 1 of 9.
const GZIP_LEVEL: u32 = 1;
/// zstd's own default.
#[cfg(feature = "zstd")]
const ZSTD_LEVEL: i32 = 3;
/// xz is for archives; with its default a conversion would take minutes.
const XZ_PRESET: u32 = 1;
/// Compressed bytes are collected until there are this many, or until a flush.
const COMPRESSED_BYTES: usize = 512 * 1024;
/// From a truncated file, a reader gets the blocks that are whole. zstd's own have 128 KiB, which can be an entire
/// capture.
const BLOCK_BYTES: usize = 16 * 1024;
/// The xz encoder keeps its output until its stream ends, so streams end after this many bytes at the latest; that much can be lost when
/// a file is truncated. A log in such streams is 3 % larger than in streams of a megabyte, and a third smaller than gzip's.
const XZ_STREAM_BYTES: usize = 128 * 1024;
/// How much a killed program loses at most, if nothing requests a flush.
const KEPT_BACK: Duration = Duration::from_secs(1);

/// A compressed file. A flush ends what gzip calls a member, xz a stream and the others a frame, and the next bytes begin
/// another: until then they stay in memory, so that the file is complete whenever this program ends.
pub(crate) struct Compressed {
    file: File,
    compression: Compression,
    encoder: Encoder,
    /// Bytes given to the encoder since the last flush, and since the last end of a block.
    begun: usize,
    in_block: usize,
    flushed: Instant,
    written: u64,
}

enum Encoder {
    Gzip(flate2::write::GzEncoder<Vec<u8>>),
    #[cfg(feature = "zstd")]
    Zstd(zstd::stream::write::Encoder<'static, Vec<u8>>),
    Lz4(lz4_flex::frame::FrameEncoder<Vec<u8>>),
    Xz(lzma_rust2::XzWriter<Vec<u8>>),
}

impl Encoder {
    fn new(compression: Compression) -> io::Result<Self> {
        compression.check_written()?;
        let out = Vec::new();
        Ok(match compression {
            Compression::Gzip => {
                Self::Gzip(flate2::write::GzEncoder::new(out, flate2::Compression::new(GZIP_LEVEL)))
            }
            #[cfg(feature = "zstd")]
            Compression::Zstd => {
                let mut encoder = zstd::stream::write::Encoder::new(out, ZSTD_LEVEL)?;
                // Neither this nor LZ4 has a checksum by default, and damage would yield wrong frames.
                encoder.include_checksum(true)?;
                Self::Zstd(encoder)
            }
            #[cfg(not(feature = "zstd"))]
            Compression::Zstd => return Err(without_zstd()),
            Compression::Lz4 => {
                let info = lz4_flex::frame::FrameInfo::new().block_checksums(true).content_checksum(true);
                Self::Lz4(lz4_flex::frame::FrameEncoder::with_frame_info(info, out))
            }
            // Refused before.
            Compression::Bzip2 | Compression::Xz => {
                let options = lzma_rust2::XzOptions::with_preset(XZ_PRESET);
                Self::Xz(lzma_rust2::XzWriter::new(out, options)?)
            }
        })
    }

    /// The encoder, as a writer.
    fn writer(&mut self) -> &mut dyn Write {
        match self {
            Self::Gzip(encoder) => encoder,
            #[cfg(feature = "zstd")]
            Self::Zstd(encoder) => encoder,
            Self::Lz4(encoder) => encoder,
            Self::Xz(encoder) => encoder,
        }
    }

    /// Output that was not taken yet, if the encoder exposes it.
    fn out(&mut self) -> Option<&mut Vec<u8>> {
        match self {
            Self::Gzip(encoder) => Some(encoder.get_mut()),
            #[cfg(feature = "zstd")]
            Self::Zstd(encoder) => Some(encoder.get_mut()),
            Self::Lz4(encoder) => Some(encoder.get_mut()),
            Self::Xz(_) => None,
        }
    }

    fn finish(self) -> io::Result<Vec<u8>> {
        match self {
            Self::Gzip(encoder) => encoder.finish(),
            #[cfg(feature = "zstd")]
            Self::Zstd(encoder) => encoder.finish(),
            Self::Lz4(encoder) => Ok(encoder.finish()?),
            Self::Xz(encoder) => encoder.finish(),
        }
    }
}

impl Compressed {
    /// An empty file.
    pub(crate) fn new(file: File, compression: Compression) -> io::Result<Self> {
        let encoder = Encoder::new(compression)?;
        let flushed = Instant::now();
        Ok(Self { file, compression, encoder, begun: 0, in_block: 0, flushed, written: 0 })
    }

    /// Compresses bytes.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        for piece in bytes.chunks(BLOCK_BYTES) {
            self.encoder.writer().write_all(piece)?;
            self.begun += piece.len();
            self.in_block += piece.len();
            if self.in_block >= BLOCK_BYTES {
                self.in_block = 0;
                // gzip's blocks are short enough, and a reader also gets what is whole of them.
                if matches!(self.compression, Compression::Zstd | Compression::Lz4) {
                    self.encoder.writer().flush()?;
                }
            }
        }
        // Only here, where the written data end with a record, so that a killed program leaves no half record.
        let stream_is_long = self.compression == Compression::Xz && self.begun >= XZ_STREAM_BYTES;
        if stream_is_long || self.flushed.elapsed() >= KEPT_BACK {
            return self.flush();
        }
        if self.encoder.out().is_some_and(|out| out.len() >= COMPRESSED_BYTES) {
            self.take_out()?;
        }
        Ok(())
    }

    /// The size of the file including what is written next, but without what the encoder still holds.
    pub(crate) fn size(&mut self) -> u64 {
        self.written + self.encoder.out().map_or(0, |out| out.len() as u64)
    }

    fn take_out(&mut self) -> io::Result<()> {
        let Some(out) = self.encoder.out() else { return Ok(()) };
        self.file.write_all(out)?;
        self.written += out.len() as u64;
        out.clear();
        Ok(())
    }

    /// Ends the member, stream or frame, unless it is empty.
    pub(crate) fn flush(&mut self) -> io::Result<()> {
        if std::mem::take(&mut self.begun) > 0 { self.end() } else { Ok(()) }
    }

    fn end(&mut self) -> io::Result<()> {
        let rest = std::mem::replace(&mut self.encoder, Encoder::new(self.compression)?).finish()?;
        self.file.write_all(&rest)?;
        self.written += rest.len() as u64;
        self.in_block = 0;
        self.flushed = Instant::now();
        Ok(())
    }

    /// Ends the file.
    pub(crate) fn finish(mut self) -> io::Result<()> {
        // A file without content is still a valid compressed file.
        if self.begun > 0 || self.written == 0 { self.end() } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;

    const WRITTEN: &[Compression] = &[
        Compression::Gzip,
        #[cfg(feature = "zstd")]
        Compression::Zstd,
        Compression::Lz4,
        Compression::Xz,
    ];

    /// Text like that of a log, with no two lines equal.
    fn text() -> Vec<u8> {
        let line = |at: u32| {
            format!(
                "(1410714882.{:06}) can0 18EF{:04X}#{:016X}\n",
                at % 1_000_000,
                at % 97,
                at.wrapping_mul(0x9E37_79B9)
            )
        };
        (0..40_000).map(line).collect::<String>().into_bytes()
    }

    /// Found by random damage: zstd and LZ4 files silently gave wrong frames.
    #[test]
    fn damage_to_a_compressed_file_is_noticed() {
        let directory = tempfile::tempdir().unwrap();
        let text = &text()[..50_000];
        for &compression in WRITTEN {
            let path = directory.path().join("a");
            let mut compressed = Compressed::new(File::create(&path).unwrap(), compression).unwrap();
            compressed.write(text).unwrap();
            compressed.finish().unwrap();
            let whole = std::fs::read(&path).unwrap();
            let mut random = fastrand::Rng::with_seed(12);
            for _ in 0..500 {
                let mut damaged = whole.clone();
                let at = random.usize(..whole.len());
                damaged[at] ^= random.u8(1..);
                let mut read = Vec::new();
                let unpacked = compression.unpack(io::Cursor::new(damaged));
                let result = unpacked.and_then(|mut source| source.read_to_end(&mut read));
                assert!(result.is_err() || read == text, "{compression:?}: {at} of {}", whole.len());
            }
        }
    }

    #[test]
    fn a_cut_xz_file_gives_all_but_the_stream_that_the_cut_is_in() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.xz");
        let mut compressed = Compressed::new(File::create(&path).unwrap(), Compression::Xz).unwrap();
        let text = text();
        // As many bytes as a file's writer collects.
        text.chunks(XZ_STREAM_BYTES).try_for_each(|piece| compressed.write(piece)).unwrap();
        compressed.finish().unwrap();
        let whole = std::fs::read(&path).unwrap();
        for percent in [20, 50, 80, 99] {
            let cut = whole[..whole.len() * percent / 100].to_vec();
            let mut read = Vec::new();
            let result = Compression::Xz.unpack(io::Cursor::new(cut)).unwrap().read_to_end(&mut read);
            assert!(result.is_err() && text.starts_with(&read), "{percent}");
            // The text is uniform, so equal fractions of it and of the file correspond.
            let least = text.len() * percent / 100 - 2 * XZ_STREAM_BYTES;
            assert!(read.len() >= least, "{percent} %: {} of {}", read.len(), text.len());
        }
    }

    /// What can be unpacked is read; the rest is an issue with the file and no error of the system.
    #[test]
    fn a_damaged_file_gives_what_comes_before_the_damage_and_says_where_it_ends() {
        let directory = tempfile::tempdir().unwrap();
        let text = &text()[..500_000];
        let frames = |bytes: &[u8]| {
            let path = directory.path().join("a.log");
            std::fs::write(&path, bytes).unwrap();
            let (mut frames, mut issues) = (Vec::new(), Vec::new());
            for found in crate::open_reader(&path, &crate::ReadOptions::default()).unwrap() {
                match found {
                    Ok(record) => frames.push(record),
                    Err(issue) => issues.push(issue),
                }
            }
            (frames, issues)
        };
        let (whole, _) = frames(text);
        for &compression in WRITTEN {
            let path = directory.path().join("a");
            let mut compressed = Compressed::new(File::create(&path).unwrap(), compression).unwrap();
            // As when something is captured: in several streams.
            for piece in text.chunks(100_000) {
                compressed.write(piece).unwrap();
                compressed.flush().unwrap();
            }
            compressed.finish().unwrap();
            let mut damaged = std::fs::read(&path).unwrap();
            let at = damaged.len() * 3 / 4;
            damaged[at..at + 8].fill(0xA5);
            let (found, issues) = frames(&damaged);
            assert!(issues.iter().all(|issue| !matches!(issue.fault, crate::Fault::Io(_))), "{issues:?}");
            let told = issues.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n");
            assert!(told.contains("undamaged compressed data"), "{compression:?}: {told}");
            // Three of five streams are intact.
            let intact = whole.len() * 3 / 5 - 1;
            assert!(
                found.len() > intact && found[..intact] == whole[..intact],
                "{compression:?}: {}",
                found.len()
            );
        }
    }
}
