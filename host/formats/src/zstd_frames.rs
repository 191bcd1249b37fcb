//! Zstandard without its C library, for targets that cannot compile it. It is read by [`ruzstd`], one block after another, so that from a file that ends
//! within a block everything before that block comes out.

use std::io::{self, Read};

use ruzstd::decoding::errors::{FrameDecoderError, ReadFrameHeaderError};
use ruzstd::decoding::{BlockDecodingStrategy, FrameDecoder};

/// The largest window, in bytes: the library's own limit (`ZSTD_WINDOWLOG_LIMIT_DEFAULT`). More is damage or malice.
const MOST_WINDOW: u64 = 1 << 27;
/// A block's header (RFC 8878 §3.1.1.2): whether it is the last one (1 bit), its type (2), its size (21).
const HEADER: usize = 3;
/// A block that consists of one byte that is repeated.
const REPEATED: u32 = 1;
/// An empty last block, and room for the checksum that may follow: it lets go of what the window still holds.
const END: [u8; HEADER + CHECKSUM] = [1, 0, 0, 0, 0, 0, 0];
const CHECKSUM: usize = 4;

/// Unpacks frames one after another, and skips those that have something else in them.
pub(crate) struct Frames<R> {
    source: R,
    decoder: FrameDecoder,
    place: Place,
    block: Vec<u8>,
}

enum Place {
    /// Before a frame, or at the end.
    Outside,
    /// In one whose blocks go on.
    Inside,
    /// Behind the last block that could be read, with the reason.
    Cut(io::Error),
    /// Nothing more comes.
    Over,
}

impl<R: Read> Frames<R> {
    pub(crate) fn new(source: R) -> Self {
        let mut decoder = FrameDecoder::new();
        decoder.set_max_window_size(MOST_WINDOW);
        Self { source, decoder, place: Place::Outside, block: Vec::new() }
    }

    /// Begins a frame, or skips one; at the end of the file there is none.
    fn begin(&mut self) -> io::Result<Place> {
        let mut first = [0];
        if self.source.read(&mut first)? == 0 {
            return Ok(Place::Over);
        }
        match self.decoder.init(first.chain(&mut self.source)) {
            Ok(()) => Ok(Place::Inside),
            Err(FrameDecoderError::ReadFrameHeaderError(ReadFrameHeaderError::SkipFrame {
                length, ..
            })) => {
                let skipped = io::copy(&mut (&mut self.source).take(length.into()), &mut io::sink())?;
                if skipped < length.into() {
                    return Err(io::ErrorKind::UnexpectedEof.into());
                }
                Ok(Place::Outside)
            }
            Err(error) => Err(invalid(error)),
        }
    }

    /// Decodes the next block.
    fn block(&mut self) -> io::Result<()> {
        self.block.resize(HEADER, 0);
        self.source.read_exact(&mut self.block)?;
        let header = self.block.iter().rev().fold(0, |all, byte| all << 8 | u32::from(*byte));
        let (is_last, kind, size) = (header & 1 != 0, header >> 1 & 3, header >> 3);
        let size = if kind == REPEATED { 1 } else { size };
        // The decoder knows which size is too large; no more is read than there is.
        let read = (&mut self.source).take(size.into()).read_to_end(&mut self.block)?;
        if read < size as usize {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let mut block = self.block.as_slice();
        let decoded = if is_last {
            let mut block = block.chain(&mut self.source);
            self.decoder.decode_blocks(&mut block, BlockDecodingStrategy::UptoBlocks(1))
        } else {
            self.decoder.decode_blocks(&mut block, BlockDecodingStrategy::UptoBlocks(1))
        };
        decoded.map(|_| ()).map_err(invalid)
    }

    /// What the decoder has at a frame's end belongs together, if the frame says so.
    fn check(&self) -> io::Result<()> {
        match (self.decoder.get_checksum_from_data(), self.decoder.get_calculated_checksum()) {
            (Some(told), Some(computed)) if told != computed => Err(invalid("its checksum is wrong")),
            _ => Ok(()),
        }
    }

    fn go_on(&mut self) -> io::Result<()> {
        match std::mem::replace(&mut self.place, Place::Over) {
            Place::Outside => self.place = self.begin()?,
            Place::Inside if self.decoder.is_finished() => {
                self.check()?;
                self.place = Place::Outside;
            }
            Place::Inside => match self.block() {
                Ok(()) => self.place = Place::Inside,
                Err(error) => {
                    // If that fails, too, the window is lost.
                    let _ = self.decoder.decode_blocks(&END[..], BlockDecodingStrategy::UptoBlocks(1));
                    self.place = Place::Cut(error);
                }
            },
            Place::Cut(error) => return Err(error),
            Place::Over => {}
        }
        Ok(())
    }
}

impl<R: Read> Read for Frames<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        while !out.is_empty() {
            let is_inside = matches!(self.place, Place::Inside | Place::Cut(_));
            let read = if is_inside { self.decoder.read(out)? } else { 0 };
            if read > 0 || matches!(self.place, Place::Over) {
                return Ok(read);
            }
            self.go_on()?;
        }
        Ok(0)
    }
}

fn invalid(reason: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unpack(bytes: &[u8]) -> (Vec<u8>, Option<io::ErrorKind>) {
        let mut out = Vec::new();
        let result = Frames::new(bytes).read_to_end(&mut out);
        (out, result.err().map(|error| error.kind()))
    }

    /// Lines as of a log: repeated in part, over several blocks.
    fn text() -> Vec<u8> {
        let mut random = fastrand::Rng::with_seed(5);
        (0..20_000)
            .flat_map(|i| format!("({i}.000000) can0 123#{:08X}\n", random.u32(..)).into_bytes())
            .collect()
    }

    fn packed(text: &[u8], has_checksum: bool) -> Vec<u8> {
        let mut encoder = zstd::stream::write::Encoder::new(Vec::new(), 3).unwrap();
        encoder.include_checksum(has_checksum).unwrap();
        io::Write::write_all(&mut encoder, text).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn frames_of_the_library_come_out_as_they_went_in() {
        let text = text();
        for has_checksum in [false, true] {
            let frame = packed(&text, has_checksum);
            assert_eq!(unpack(&frame), (text.clone(), None));
            let skipped = [&0x184D_2A53_u32.to_le_bytes()[..], &5_u32.to_le_bytes(), b"notes"].concat();
            let several = [&skipped[..], &frame, &skipped, &packed(b"", true), &frame].concat();
            assert_eq!(unpack(&several), ([&text[..], &text].concat(), None));
        }
        assert_eq!(unpack(b""), (Vec::new(), None));
    }

    #[test]
    fn of_a_cut_file_all_whole_blocks_come_out() {
        const BLOCK: usize = 128 << 10;
        let text = text();
        let frame = packed(&text, true);
        for keep in [3, frame.len() / 3, frame.len() / 2, frame.len() - 5, frame.len() - 1] {
            let (out, error) = unpack(&frame[..keep]);
            assert!(error.is_some(), "{keep} of {}", frame.len());
            assert!(text.starts_with(&out), "{keep}");
            let expected = (text.len() * keep / frame.len()).saturating_sub(2 * BLOCK);
            assert!(out.len() >= expected, "{keep}: {} of {}, expected {expected}", out.len(), text.len());
        }
    }

    #[test]
    fn a_changed_byte_is_noticed() {
        let text = text();
        let frame = packed(&text, true);
        let mut random = fastrand::Rng::with_seed(7);
        for _ in 0..200 {
            let mut damaged = frame.clone();
            damaged[random.usize(..frame.len())] ^= 1 << random.u8(..8);
            let (out, error) = unpack(&damaged);
            assert!(error.is_some() || out == text);
        }
    }
}
