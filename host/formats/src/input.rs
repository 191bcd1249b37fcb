//! Where a reader's bytes come from: a file or standard input, plain or compressed, finished or
//! still growing. One buffer of bounded size; lines are slices of it.

mod blocks;

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::time::Duration;

use super::carriage_return::{self, ToLineFeed};
use super::compression::{self, Compression};
use super::found::Found;
use super::issue::{Fault, Place};
use super::seek::Blocks;
use super::utf16::{self, ToUtf8, Utf16};
use super::whole::{MAX_MEMORY_BYTES, Whole};
use super::zone::Zone;

/// Bytes asked of the system at a time.
const CHUNK_BYTES: usize = 256 * 1024;

/// Longest line or object held at once. It is far more than anything in a trace, and little
/// enough for a machine with little memory.
pub(crate) const MAX_ITEM_BYTES: usize = 8 * 1024 * 1024;

/// How long to wait before checking a followed file again. It is short enough not to be noticed
/// by a viewer, and long compared with the cost of the check.
const FOLLOW_INTERVAL: Duration = Duration::from_millis(50);

/// A buffered source of bytes.
pub(crate) struct Input {
    source: Box<dyn Read + Send>,
    /// Bytes read; those before `start` are used up.
    buffer: Vec<u8>,
    start: usize,
    end: usize,
    /// Offset of `start` in the (decompressed) file.
    offset: u64,
    /// Lines handed out so far.
    lines: u64,
    follow: bool,
    /// Whether its bytes may arrive slowly: a pipe, a terminal, a followed file.
    may_wait: bool,
    ended: bool,
    cut: bool,
    damage: Option<String>,
    stop: Box<dyn Fn() -> bool + Send>,
    /// The same file again, if it is a plain one: for formats read with random access.
    file: Option<File>,
    /// Digests of what is read of it, if there is an index.
    blocks: Option<Blocks>,
    /// Whether its bytes are the file's own, neither decompressed nor converted.
    is_as_it_is: bool,
    zone: Zone,
    /// The beginning of a line too long to hold.
    long: Vec<u8>,
    /// Whether a NUL byte was read, which no text has.
    has_nul: bool,
    /// The lines with one, until they are asked for.
    nul_lines: VecDeque<u64>,
}

/// One line, without its end.
#[derive(Clone, Copy)]
pub(crate) struct Line<'a> {
    /// Its text.
    pub text: &'a [u8],
    /// Its number, from 1.
    pub number: u64,
    /// Whether a line end follows: false only for the last line of a file.
    pub terminated: bool,
    /// Whether the text is only the beginning of a line that is too long to hold.
    pub too_long: bool,
}

impl Line<'_> {
    /// The issue with this line. The last line of a truncated file is not reported as broken.
    pub(crate) fn issue(&self, fault: Fault) -> Found {
        let fault = match fault {
            Fault::Malformed { .. } if !self.terminated && !self.too_long => Fault::Truncated("a line"),
            fault => fault,
        };
        Found::Issue(Place::Line(self.number), fault)
    }

    /// The issue for a file's last line that looks whole but may have lost its end.
    pub(crate) fn cut(&self) -> Found {
        Found::Issue(Place::Line(self.number), Fault::Truncated("a line"))
    }
}

impl Input {
    /// Reads from any source. With `follow`, the end only means "not yet".
    pub(crate) fn new(source: Box<dyn Read + Send>, follow: bool) -> Self {
        Self {
            source,
            buffer: Vec::new(),
            start: 0,
            end: 0,
            offset: 0,
            lines: 0,
            follow,
            may_wait: true,
            ended: false,
            cut: false,
            damage: None,
            stop: Box::new(|| false),
            file: None,
            blocks: None,
            is_as_it_is: true,
            zone: Zone::default(),
            long: Vec::new(),
            has_nul: false,
            nul_lines: VecDeque::new(),
        }
    }

    /// Opens a file, or standard input for `-`; recognises compression by the first bytes.
    pub(crate) fn open(path: &Path, follow: bool) -> io::Result<Self> {
        if path.as_os_str() == "-" {
            // The end of a pipe is final.
            return Self::decompressing(Box::new(io::stdin()), false);
        }
        // Opening a directory succeeds on Unix, and only reading it fails.
        if path.is_dir() {
            return Err(io::Error::new(io::ErrorKind::IsADirectory, "it is a directory"));
        }
        let file = File::open(path)?;
        let is_file = file.metadata()?.is_file();
        let same = if is_file { Some(file.try_clone()?) } else { None };
        let mut input = Self::decompressing(Box::new(file), follow)?;
        input.may_wait = follow || !is_file;
        input.file = same.filter(|_| input.is_as_it_is);
        Ok(input)
    }

    /// Reads from a source that may be compressed, or a text in UTF-16.
    pub(crate) fn decompressing(source: Box<dyn Read + Send>, follow: bool) -> io::Result<Self> {
        Self::new(source, follow).recognised()
    }

    /// Reads from what unpacks a file of an archive, which may be compressed or in UTF-16, too.
    pub(crate) fn unpacking(source: Box<dyn Read + Send>) -> io::Result<Self> {
        Self { is_as_it_is: false, ..Self::new(source, false) }.recognised()
    }

    /// Reads from what unpacks a part of a file, and takes its bytes as they are.
    pub(crate) fn unpacked(source: Box<dyn Read + Send>) -> Self {
        Self { is_as_it_is: false, ..Self::new(source, false) }
    }

    fn recognised(self) -> io::Result<Self> {
        let mut input = self;
        if let Some(compression) = Compression::of_content(input.peek(compression::MAGIC_BYTES)?) {
            let unpacked = compression.unpack(input.into_rest())?;
            input = Self { is_as_it_is: false, ..Self::new(unpacked, false) };
        }
        if let Some(order) = Utf16::of_content(input.peek(utf16::HEAD_BYTES)?) {
            input = input.converted(|rest, follow| Box::new(ToUtf8::new(rest, order, follow)));
        }
        // Only what is there is looked at: more may be long in coming.
        if carriage_return::ends_lines(input.buffered()) {
            input = input.converted(|rest, _| Box::new(ToLineFeed(rest)));
        }
        input.without_byte_order_mark()
    }

    /// The same, passed through something that is told whether the end only means "not yet". What is known about unpacking stays.
    fn converted(mut self, through: impl FnOnce(Box<dyn Read + Send>, bool) -> Box<dyn Read + Send>) -> Self {
        let (follow, cut, damage) = (self.follow, self.cut, self.damage.take());
        let source = through(Box::new(self.into_rest()), follow);
        Self { cut, damage, is_as_it_is: false, ..Self::new(source, follow) }
    }

    /// Skips UTF-8's byte order mark, which some editors put at the beginning of a text.
    fn without_byte_order_mark(mut self) -> io::Result<Self> {
        const MARK: &[u8] = &[0xEF, 0xBB, 0xBF];
        if self.peek(MARK.len())?.starts_with(MARK) {
            self.consume(MARK.len());
        }
        Ok(self)
    }

    /// The buffered bytes and all that follow, as a reader.
    fn into_rest(self) -> impl Read + Send {
        let buffered = self.buffer[self.start..self.end].to_vec();
        io::Cursor::new(buffered).chain(self.source)
    }

    /// All of it, for formats read with random access: the file itself, or a copy in memory if it is compressed or comes
    /// through a pipe. Nothing may have been used up before.
    pub(crate) fn whole(&mut self) -> io::Result<Whole> {
        if let Some(file) = &self.file {
            let same = file.try_clone()?;
            self.consume(self.buffered().len());
            self.ended = true;
            return Whole::new(Box::new(same));
        }
        let mut bytes = self.buffered().to_vec();
        self.consume(bytes.len());
        while self.fill()? {
            bytes.extend_from_slice(self.buffered());
            self.consume(self.buffered().len());
            if bytes.len() as u64 > MAX_MEMORY_BYTES {
                let message =
                    "it is larger than 1 GiB and is read at many places; unpack it into a file first";
                return Err(io::Error::new(io::ErrorKind::OutOfMemory, message));
            }
        }
        Whole::new(Box::new(io::Cursor::new(bytes)))
    }

    /// The zone of dates in a file that names none.
    pub(crate) fn zone(&self) -> &Zone {
        &self.zone
    }

    /// Sets the zone of dates.
    pub(crate) fn set_zone(&mut self, zone: Zone) {
        self.zone = zone;
    }

    /// Ends the input as soon as `stop` returns true.
    pub(crate) fn end_when(&mut self, stop: Box<dyn Fn() -> bool + Send>) {
        self.stop = stop;
    }

    /// Whether its bytes may arrive slowly.
    #[inline]
    pub(crate) fn may_wait(&self) -> bool {
        self.may_wait
    }

    /// Whether its end only means "not yet".
    pub(crate) fn follows(&self) -> bool {
        self.follow
    }

    /// Whether a whole line has been read and not used up.
    pub(crate) fn has_line(&self) -> bool {
        memchr::memchr(b'\n', &self.buffer[self.start..self.end]).is_some()
    }

    /// The next line with a NUL byte that was handed out, once. A text has none: a part of the file was lost there, however well the rest of
    /// the line reads.
    pub(crate) fn nul_line(&mut self) -> Option<u64> {
        self.nul_lines.pop_front()
    }

    /// Whether compressed data ended before its own end mark.
    pub(crate) fn compressed_data_cut(&self) -> bool {
        self.cut
    }

    /// Why compressed data could not be unpacked to their end, if they are damaged.
    pub(crate) fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
    }

    /// Offset of the next byte in the decompressed file.
    pub(crate) fn offset(&self) -> u64 {
        self.offset
    }

    /// The number of the last line handed out.
    pub(crate) fn line_number(&self) -> u64 {
        self.lines
    }

    /// Reads more, keeping what has not been used up. False at the end.
    fn fill(&mut self) -> io::Result<bool> {
        if self.ended {
            return Ok(false);
        }
        if self.start > 0 {
            self.buffer.copy_within(self.start..self.end, 0);
            self.end -= self.start;
            self.start = 0;
        }
        if self.buffer.len() < self.end + CHUNK_BYTES {
            self.buffer.resize(self.end + CHUNK_BYTES, 0);
        }
        // An endless source is left on request; what it has delivered is still read.
        if (self.stop)() {
            self.ended = true;
            return Ok(false);
        }
        if self.blocks.is_some() {
            return self.fill_block();
        }
        loop {
            match self.source.read(&mut self.buffer[self.end..]) {
                Ok(0) if self.follow && !(self.stop)() => std::thread::sleep(FOLLOW_INTERVAL),
                Ok(0) => {
                    self.ended = true;
                    return Ok(false);
                }
                Ok(read) => {
                    // In one go, because nearly no text has any.
                    let new = &self.buffer[self.end..self.end + read];
                    self.has_nul = self.has_nul || memchr::memchr(0, new).is_some();
                    self.end += read;
                    return Ok(true);
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                // A truncated compressed file ends where it was cut.
                Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {
                    self.ended = true;
                    self.cut = true;
                    return Ok(false);
                }
                // The system's errors have a number. Everything else comes from what unpacks the file, and is its damage.
                Err(error) if !self.is_as_it_is && error.raw_os_error().is_none() => {
                    self.ended = true;
                    self.damage = Some(error.to_string());
                    return Ok(false);
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// At least `len` bytes (at most [`MAX_ITEM_BYTES`]) without using them up; fewer only at the end.
    /// Everything buffered is returned.
    #[inline]
    pub(crate) fn peek(&mut self, len: usize) -> io::Result<&[u8]> {
        while self.end - self.start < len.min(MAX_ITEM_BYTES) && self.fill()? {}
        Ok(&self.buffer[self.start..self.end])
    }

    /// Uses up `len` bytes that [`Self::peek`] showed.
    #[inline]
    pub(crate) fn consume(&mut self, len: usize) {
        let len = len.min(self.end - self.start);
        self.start += len;
        self.offset += len as u64;
    }

    /// Everything buffered and not used up.
    #[inline]
    pub(crate) fn buffered(&self) -> &[u8] {
        &self.buffer[self.start..self.end]
    }

    /// Uses up this many lines that [`Self::buffered`] showed, `len` bytes in total.
    pub(crate) fn consume_lines(&mut self, len: usize, lines: u64) {
        if self.has_nul {
            self.note_nul_lines(len);
        }
        self.consume(len);
        self.lines += lines;
    }

    /// Keeps the numbers of the lines with a NUL byte among the next `len` bytes, which are whole lines.
    #[cold]
    fn note_nul_lines(&mut self, len: usize) {
        let lines = self.buffer[self.start..self.start + len].split_inclusive(|byte| *byte == b'\n');
        let numbered = (self.lines + 1..).zip(lines);
        self.nul_lines
            .extend(numbered.filter(|(_, line)| memchr::memchr(0, line).is_some()).map(|(number, _)| number));
    }

    /// The next line; `None` at the end.
    #[inline]
    pub(crate) fn line(&mut self) -> io::Result<Option<Line<'_>>> {
        let mut searched = 0;
        let (len, terminated) = loop {
            let unsearched = &self.buffer[self.start + searched..self.end];
            if let Some(at) = memchr::memchr(b'\n', unsearched) {
                break (searched + at, true);
            }
            searched = self.end - self.start;
            if searched >= MAX_ITEM_BYTES {
                return self.long_line().map(Some);
            }
            if !self.fill()? {
                break (searched, false);
            }
        };
        if len == 0 && !terminated {
            return Ok(None);
        }
        let at = self.start;
        self.consume(len + usize::from(terminated));
        self.lines += 1;
        let mut text = &self.buffer[at..at + len];
        if let [rest @ .., b'\r'] = text {
            text = rest;
        }
        if self.has_nul && memchr::memchr(0, text).is_some() {
            self.nul_lines.push_back(self.lines);
        }
        Ok(Some(Line { text, number: self.lines, terminated, too_long: false }))
    }

    /// A line too long to hold: its beginning. The rest is skipped.
    #[cold]
    fn long_line(&mut self) -> io::Result<Line<'_>> {
        const KEPT: usize = 200;
        self.long = self.buffer[self.start..self.end].iter().take(KEPT).copied().collect();
        let terminated = loop {
            let rest = &self.buffer[self.start..self.end];
            let (used, found) = memchr::memchr(b'\n', rest).map_or((rest.len(), false), |at| (at + 1, true));
            self.consume(used);
            if found || !self.fill()? {
                break found;
            }
        };
        self.lines += 1;
        if self.has_nul && self.long.contains(&0) {
            self.nul_lines.push_back(self.lines);
        }
        Ok(Line { text: &self.long, number: self.lines, terminated, too_long: true })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn input(bytes: impl Into<Vec<u8>>) -> Input {
        Input::decompressing(Box::new(io::Cursor::new(bytes.into())), false).unwrap()
    }

    fn lines(mut input: Input) -> Vec<(u64, String, bool)> {
        let mut lines = Vec::new();
        while let Some(line) = input.line().unwrap() {
            lines.push((line.number, String::from_utf8_lossy(line.text).into_owned(), line.terminated));
        }
        lines
    }

    #[test]
    fn lines_end_in_lf_or_crlf_and_the_last_may_end_in_neither() {
        let expected =
            [(1, "a".into(), true), (2, String::new(), true), (3, "b".into(), true), (4, "c".into(), false)];
        assert_eq!(lines(input("a\n\r\nb\r\nc")), expected);
        assert_eq!(lines(input("")), []);
    }

    #[cfg(feature = "zstd")]
    #[test]
    fn a_byte_order_mark_is_no_part_of_the_first_line() {
        let text = "\u{feff}a\nb\n";
        let zstd = zstd::stream::encode_all(text.as_bytes(), 1).unwrap();
        for bytes in [text.as_bytes().to_vec(), zstd] {
            assert_eq!(lines(input(bytes)), [(1, "a".into(), true), (2, "b".into(), true)]);
        }
    }

    #[cfg(feature = "zstd")]
    #[test]
    fn utf16_is_read_as_any_text_also_when_it_is_compressed() {
        let text = "a\r\nµ\n";
        let little: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
        let big: Vec<u8> = text.encode_utf16().flat_map(u16::to_be_bytes).collect();
        let marked = [&[0xFF, 0xFE][..], &little].concat();
        let packed = zstd::stream::encode_all(&marked[..], 1).unwrap();
        for bytes in [marked, [&[0xFE, 0xFF][..], &big].concat(), little, big, packed] {
            assert_eq!(lines(input(bytes)), [(1, "a".into(), true), (2, "µ".into(), true)]);
        }
    }

    #[test]
    fn lines_that_end_with_a_carriage_return_alone_are_lines() {
        let expected = [(1, "a".into(), true), (2, "b".into(), true)];
        assert_eq!(lines(input(b"a\rb\r".to_vec())), expected);
        assert_eq!(lines(input(b"a\r\nb\r\n".to_vec())), expected);
        // Bytes of something else are left alone.
        assert_eq!(lines(input(b"\0\r\r\n".to_vec())), [(1, "\0\r".into(), true)]);
    }

    #[cfg(feature = "zstd")]
    #[test]
    fn compressed_files_are_recognised_and_give_all_they_can_when_cut() {
        let text = "0123456789\n".repeat(50_000);
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gzip.write_all(text.as_bytes()).unwrap();
        let gzip = gzip.finish().unwrap();
        let zstd = zstd::stream::encode_all(text.as_bytes(), 1).unwrap();
        for whole in [gzip, zstd] {
            assert_eq!(lines(input(whole.clone())).len(), 50_000);
            let cut = lines(input(&whole[..whole.len() - 20]));
            assert!(cut.len() <= 50_000);
        }
    }

    #[test]
    fn a_line_without_end_does_not_take_all_memory() {
        let endless = io::repeat(b'x').take(3 * MAX_ITEM_BYTES as u64);
        let mut input = Input::new(Box::new(endless), false);
        let first = input.line().unwrap().unwrap();
        assert!(first.too_long && first.text.len() <= MAX_ITEM_BYTES + CHUNK_BYTES);
        while input.line().unwrap().is_some() {}
        assert!(input.buffer.len() <= MAX_ITEM_BYTES + 2 * CHUNK_BYTES);
    }
}
