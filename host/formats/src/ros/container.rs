//! What MCAP files and the bags of ROS 1 have in common: records one after another, some of them chunks of records that are compressed each by
//! itself. Read as a stream, so that a file without its index, as a crash leaves it, is read, too.

use std::io;

use super::super::codec::Decode;
use super::super::compression::Compression;
use super::super::error_frames::ErrorFrames;
use super::super::found::Found;
use super::super::input::Input;
use super::super::issue::{Fault, Place};
use super::nested::{self, Nested};
use super::{Encoding, Kind, SENT_TOPIC, Topic, Topics, content};
use cantap_trace::counted;
use cantap_trace::{Direction, TraceRecord};

/// A kind of such files.
pub(crate) trait Container: Default + Send {
    /// What a file begins with.
    const MAGIC: &'static [u8];
    /// What is missing if it does not.
    const EXPECTED: &'static str;
    /// What a file is that ends too early.
    const CUT: &'static str;
    /// No chunk has more before its records.
    const CHUNK_HEAD_BYTES: usize;

    /// Reads a record of a file or of a chunk, but not what is in a chunk.
    fn step(&mut self, input: &mut Input, place: Place, known: &mut Known) -> io::Result<Step>;

    /// The chunk that begins here; `None` if none does, or one that contradicts itself.
    fn chunk(bytes: &[u8]) -> Option<ChunkHead>;

    /// Whether a whole file may end at this offset without saying so.
    fn may_end(&self, at: u64) -> bool;

    /// At the file's own end: what is wrong if the file says that it has more, or less, than was read.
    fn end(&mut self, input: &mut Input) -> io::Result<Option<Fault>>;
}

/// What a record was.
pub(crate) enum Step {
    /// Nothing to report.
    Nothing,
    Found(Found),
    /// A chunk, not yet used up.
    Chunk,
    /// The file's own end.
    Last,
    /// There is none: the bytes are at their end.
    End,
    /// It does not end.
    Cut,
    /// No record begins here.
    Wrong(Fault),
}

/// What precedes the records of a chunk.
pub(crate) struct ChunkHead {
    /// How many bytes precede them.
    pub bytes: usize,
    pub crc: Option<u32>,
    pub compression: Option<Compression>,
    /// Length of the records, compressed.
    pub len: u64,
}

/// What is known of a file so far, whatever its kind.
#[derive(Default)]
pub(crate) struct Known {
    pub topics: Topics,
    errors: ErrorFrames,
    note: Option<&'static str>,
}

impl Known {
    /// What a message with a frame contains. `stored_ns`: when it was recorded, in nanoseconds since 1970.
    pub(super) fn message(
        &mut self,
        (kind, encoding): (Kind, Encoding),
        Topic { channel, direction }: Topic,
        stored_ns: i64,
        bytes: &[u8],
        place: Place,
    ) -> Found {
        match content(kind, encoding, direction, bytes, &mut self.errors) {
            Ok(content) => {
                let time_ns = content.time_ns.unwrap_or(stored_ns);
                let record = |event| TraceRecord { time_ns, device_ns: None, channel, event };
                self.errors.keep(content.second.map(record));
                self.note = (direction == Direction::Tx).then_some(SENT_TOPIC);
                Found::Record(record(content.event))
            }
            Err(fault) => Found::Issue(place, fault),
        }
    }
}

/// Reads a file.
#[derive(Default)]
pub(crate) struct Decoder<C> {
    state: State,
    chunk: Option<Chunk>,
    container: C,
    known: Known,
}

#[derive(Clone, Copy, Default, PartialEq, Eq)]
enum State {
    #[default]
    Begin,
    Records,
    End,
}

/// The chunk being read.
struct Chunk {
    nested: Nested,
    place: Place,
    is_cut: bool,
}

impl<C: Container> Decode for Decoder<C> {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn begin_next_file(&mut self) {
        (self.state, self.chunk, self.container) = (State::Begin, None, C::default());
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        loop {
            if let Some(found) = self.known.errors.next() {
                return Ok(found);
            }
            if let Some(note) = self.known.note.take() {
                return Ok(Found::Note(note));
            }
            let found = if let Some(chunk) = &mut self.chunk {
                match chunk.next(&mut self.container, &mut self.known)? {
                    None => self.chunk.take().and_then(Chunk::end),
                    found => found,
                }
            } else {
                match self.state {
                    State::Begin => self.begin(input)?,
                    State::Records => self.record(input)?,
                    State::End => return Ok(Found::End),
                }
            };
            if let Some(found) = found {
                return Ok(found);
            }
        }
    }
}

impl<C: Container> Decoder<C> {
    fn begin(&mut self, input: &mut Input) -> io::Result<Option<Found>> {
        let place = Place::Offset(input.offset());
        let head = input.peek(C::MAGIC.len())?;
        self.state = State::Records;
        if head.starts_with(C::MAGIC) {
            input.consume(C::MAGIC.len());
            return Ok(None);
        }
        if head.is_empty() {
            self.state = State::End;
            return Ok(None);
        }
        let fault = Fault::malformed(C::EXPECTED, &head[..head.len().min(C::MAGIC.len())]);
        self.skip_to_chunk(input)?;
        Ok(Some(Found::Issue(place, fault)))
    }

    /// The next record outside of chunks.
    fn record(&mut self, input: &mut Input) -> io::Result<Option<Found>> {
        let place = Place::Offset(input.offset());
        Ok(match self.container.step(input, place, &mut self.known)? {
            Step::Nothing => None,
            Step::Found(found) => Some(found),
            Step::Chunk => self.open_chunk(input, place)?,
            Step::Last => self.end(input, place)?,
            Step::End if self.container.may_end(input.offset()) => self.end(input, place)?,
            Step::End | Step::Cut => {
                self.state = State::End;
                Some(Found::Issue(place, Fault::Truncated(C::CUT)))
            }
            Step::Wrong(fault) => {
                self.skip_to_chunk(input)?;
                Some(Found::Issue(place, fault))
            }
        })
    }

    fn end(&mut self, input: &mut Input, place: Place) -> io::Result<Option<Found>> {
        self.state = State::End;
        Ok(self.container.end(input)?.map(|fault| Found::Issue(place, fault)))
    }

    /// Opens the chunk that is next.
    fn open_chunk(&mut self, input: &mut Input, place: Place) -> io::Result<Option<Found>> {
        let bytes = input.peek(C::CHUNK_HEAD_BYTES)?;
        let is_short = bytes.len() < C::CHUNK_HEAD_BYTES;
        let Some(head) = C::chunk(bytes) else {
            self.skip_to_chunk(input)?;
            let fault = if is_short {
                Fault::Truncated(C::CUT)
            } else {
                Fault::malformed("a chunk", b"one whose lengths or compression make no sense")
            };
            return Ok(Some(Found::Issue(place, fault)));
        };
        input.consume(head.bytes);
        let Some((bytes, is_whole)) = nested::part(input, head.len)? else {
            let what = format!("a chunk of {}", counted(head.len, "byte"));
            return Ok(Some(Found::Issue(place, Fault::Unsupported(what.into()))));
        };
        let nested = Nested::new(bytes, head.compression, head.crc)?;
        if !is_whole {
            self.state = State::End;
        }
        self.chunk = Some(Chunk { nested, place, is_cut: !is_whole });
        Ok(None)
    }

    /// Skips to the next chunk behind the next byte, or to the end.
    fn skip_to_chunk(&mut self, input: &mut Input) -> io::Result<()> {
        input.consume(1);
        loop {
            let bytes = input.peek(C::CHUNK_HEAD_BYTES)?;
            if bytes.len() < C::CHUNK_HEAD_BYTES {
                let rest = bytes.len();
                input.consume(rest);
                self.state = State::End;
                return Ok(());
            }
            let heads = bytes.windows(C::CHUNK_HEAD_BYTES);
            let known = heads.len();
            let next = bytes.windows(C::CHUNK_HEAD_BYTES).position(|bytes| C::chunk(bytes).is_some());
            input.consume(next.unwrap_or(known));
            if next.is_some() {
                return Ok(());
            }
        }
    }
}

impl Chunk {
    /// What is next in it; `None` at its end.
    fn next<C: Container>(&mut self, container: &mut C, known: &mut Known) -> io::Result<Option<Found>> {
        loop {
            let fault = match container.step(&mut self.nested.input, self.place, known)? {
                Step::Nothing => continue,
                Step::Found(found) => return Ok(Some(found)),
                Step::End => return Ok(None),
                Step::Cut => Fault::malformed("whole messages in a chunk", b"one that ends early"),
                Step::Chunk | Step::Last => Fault::malformed("messages in a chunk", b"a chunk or an end"),
                Step::Wrong(fault) => fault,
            };
            // What follows in it is lost, and why is said at its end if it is not this.
            let why = self.why();
            self.nested = Nested::new(Vec::new(), None, None)?;
            self.is_cut = false;
            return Ok(Some(Found::Issue(self.place, why.unwrap_or(fault))));
        }
    }

    /// Why the chunk is not what it should be.
    fn why(&self) -> Option<Fault> {
        let input = &self.nested.input;
        if self.is_cut {
            Some(Fault::Truncated("a chunk"))
        } else if let Some(damage) = input.damage() {
            Some(Fault::malformed("undamaged compressed data to the end of a chunk", damage.as_bytes()))
        } else if input.compressed_data_cut() {
            Some(Fault::malformed("compressed data to their own end in a chunk", b"fewer"))
        } else {
            None
        }
    }

    /// What to report at its end.
    fn end(self) -> Option<Found> {
        let crc = || {
            let found = b"one that does not: its frames may be wrong";
            (!self.nested.is_intact()).then(|| Fault::malformed("a chunk that fits its checksum", found))
        };
        let fault = self.why().or_else(crc)?;
        Some(Found::Issue(self.place, fault))
    }
}

/// How many chunks and messages there are.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Counts {
    pub chunks: u64,
    pub messages: u64,
}

impl Counts {
    /// What is wrong if the file says that it has others than these, which were read.
    pub(super) fn check(self, expected: Self) -> Option<Fault> {
        let text = |Self { chunks, messages }| {
            format!("{} in {}", counted(messages, "message"), counted(chunks, "chunk"))
        };
        (self != expected).then(|| {
            Fault::malformed(format!("{}, as the file's end says", text(expected)), text(self).as_bytes())
        })
    }
}

/// Skips so many bytes; false if there are fewer.
pub(super) fn skip(input: &mut Input, len: u64) -> io::Result<bool> {
    let mut rest = len;
    while rest > 0 {
        let there = input.peek(1)?.len();
        let used = there.min(usize::try_from(rest).unwrap_or(usize::MAX));
        if used == 0 {
            return Ok(false);
        }
        input.consume(used);
        rest -= used as u64;
    }
    Ok(true)
}

pub(super) fn array_of<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
    let (array, rest) = bytes.split_first_chunk()?;
    *bytes = rest;
    Some(*array)
}

pub(super) fn u32_of(bytes: &mut &[u8]) -> Option<u32> {
    array_of(bytes).map(u32::from_le_bytes)
}

/// A text with its length before it.
pub(super) fn text_of<'a>(bytes: &mut &'a [u8]) -> Option<&'a [u8]> {
    let len = u32_of(bytes)? as usize;
    let (text, rest) = bytes.split_at_checked(len)?;
    *bytes = rest;
    Some(text)
}
