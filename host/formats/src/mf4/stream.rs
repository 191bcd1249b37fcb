//! The data of a group or channel: bytes in one block or many, plain or compressed.

use cantap_trace::counted;
use serde::{Deserialize, Serialize};

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::blocks::{BLOCK_HEAD_BYTES, Block, u32_at, u64_at};
use super::joined::{BEGIN_BYTES, begin};
use super::unpack::{Packed, Unpacker};

/// Plain data is read in pieces of this many bytes: they stay in the processor's cache until they have been gone through.
const PIECE_BYTES: u64 = 1 << 18;

/// The standard allows at most 4 MiB in a compressed block; other programs write more. Anything larger means
/// damage.
const MAX_UNPACKED_BYTES: u64 = 256 << 20;

/// Flag of a 4.2 list.
const INVALID_APART: u32 = 1 << 31;

/// In place of a place in the file: zeros, which are not there.
const ALL_VALID: u64 = 0;

/// How deeply lists of lists may be nested.
const MAX_DEPTH: u32 = 4;

/// Length of the fields of a compressed block before its data.
const DZ_FIELDS_BYTES: u64 = 24;

/// What a stream is made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct Origin {
    /// To its data; 0 if it has none.
    pub link: u64,
    /// Bytes of a record's values, and of the bits that say which of them are none.
    pub row_bytes: (u64, u64),
}

/// Where the pieces of a stream are in its file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Laid {
    /// Of each its length in the stream, its position in the file, and how it is compressed.
    pieces: Vec<(u64, u64, Option<Packed>)>,
    cut: bool,
    invalid: Option<Box<Laid>>,
}

/// A contiguous piece of the stream in the file.
#[derive(Clone, Copy, Debug)]
struct Piece {
    /// Where it begins in the stream, and its length there.
    start: u64,
    len: u64,
    /// Its position in the file.
    at: u64,
    packed: Option<Packed>,
    /// Whether it extends to the end of the file for want of a length.
    is_open: bool,
}

/// A stream of bytes with random access, fast if the next position follows the last one.
#[derive(Default)]
pub(super) struct Stream {
    pieces: Vec<Piece>,
    /// Length in bytes.
    len: u64,
    /// Whether bytes are missing at the end of the file.
    cut: bool,
    /// How many bytes behind those asked for must have been looked at, because another file may begin among them.
    ahead: u64,
    /// Where in the file another one begins.
    next_file: Option<u64>,
    origin: Origin,
    /// The bits that say which values are none, where they lie apart (4.2).
    invalid: Option<Box<Stream>>,
    /// What was read last, and its position in the stream.
    buffer: Vec<u8>,
    buffer_start: u64,
    unpacker: Unpacker,
}

impl Stream {
    /// Goes through its blocks. `open_end`: the last block's length was not written, and it extends to the end of the file.
    pub(super) fn open(file: &mut Whole, origin: Origin, open_end: bool) -> Result<Self, Fault> {
        let mut stream = Self { origin, ..Self::default() };
        if origin.link != 0 {
            stream.collect(file, origin.link, open_end, 0)?;
        }
        Ok(stream)
    }

    /// The same without going through its blocks: what [`Self::laid`] returned.
    pub(super) fn of(origin: Origin, laid: &Laid) -> Self {
        let mut stream = Self { origin, cut: laid.cut, ..Self::default() };
        stream.pieces.reserve(laid.pieces.len());
        for (len, at, packed) in &laid.pieces {
            stream.push(*len, *at, *packed);
        }
        stream.invalid = laid.invalid.as_ref().map(|laid| Box::new(Self::of(Origin::default(), laid)));
        stream
    }

    /// Where its pieces are.
    pub(super) fn laid(&self) -> (Origin, Laid) {
        let pieces = self.pieces.iter().map(|piece| (piece.len, piece.at, piece.packed)).collect();
        let invalid = self.invalid.as_ref().map(|stream| Box::new(stream.laid().1));
        (self.origin, Laid { pieces, cut: self.cut, invalid })
    }

    /// The bits that say which values are none, where they lie apart.
    pub(super) fn invalid(&mut self) -> Option<&mut Self> {
        self.invalid.as_deref_mut()
    }

    /// Length in bytes.
    pub(super) fn len(&self) -> u64 {
        self.len
    }

    /// Whether the file ends before the stream does.
    pub(super) fn is_cut(&self) -> bool {
        self.cut
    }

    /// Where in the file another one begins, as far as the stream was read.
    pub(super) fn next_file(&self) -> Option<u64> {
        self.next_file
    }

    fn push(&mut self, len: u64, at: u64, packed: Option<Packed>) {
        if len > 0 {
            self.pieces.push(Piece { start: self.len, len, at, packed, is_open: false });
            self.len += len;
        }
    }

    fn collect(&mut self, file: &mut Whole, link: u64, open_end: bool, depth: u32) -> Result<(), Fault> {
        let head = file.head(link)?;
        match &head.name {
            b"##DT" | b"##SD" | b"##RD" | b"##DV" | b"##DI" => {
                let begin = link + BLOCK_HEAD_BYTES;
                let there = file.len().saturating_sub(begin);
                let says = head.len - BLOCK_HEAD_BYTES;
                let len = if open_end && says == 0 { there } else { says };
                self.cut |= len > there;
                self.push(len.min(there), begin, None);
                if open_end && says == 0 && len > 0 {
                    self.ahead = BEGIN_BYTES as u64;
                    if let Some(last) = self.pieces.last_mut() {
                        last.is_open = true;
                    }
                }
            }
            b"##DZ" => {
                let fields = file.read_at(link + BLOCK_HEAD_BYTES, DZ_FIELDS_BYTES as usize)?;
                let (kind, columns) = (fields.get(2).copied().unwrap_or(0), u32_at(&fields, 4));
                let (unpacked, stored) = (u64_at(&fields, 8), u64_at(&fields, 16));
                if kind > 5 || unpacked > MAX_UNPACKED_BYTES {
                    let found = format!("kind {kind}, {unpacked}", unpacked = counted(unpacked, "byte"));
                    let expected = format!("data compressed in a known way at {link:#x}");
                    return Err(Fault::malformed(expected, found.as_bytes()));
                }
                let at = link + BLOCK_HEAD_BYTES + DZ_FIELDS_BYTES;
                if at.saturating_add(stored) > file.len() {
                    // The rest of it cannot be put in order, or ends within a record.
                    self.cut = true;
                } else {
                    self.push(unpacked, at, Some(Packed { stored, kind, columns }));
                }
            }
            b"##HL" if depth < MAX_DEPTH => {
                let list = file.block(link, *b"##HL")?;
                if list.link(0) != 0 {
                    self.collect(file, list.link(0), open_end, depth + 1)?;
                }
            }
            b"##DL" | b"##LD" if depth < MAX_DEPTH => {
                let (mut next, mut lists) = (link, 0);
                while next != 0 {
                    let list = file.block(next, head.name)?;
                    if &head.name == b"##LD" && u32_at(&list.data, 0) & INVALID_APART != 0 {
                        self.collect_apart(file, &list, open_end, depth + 1)?;
                    } else {
                        for data in list.links.iter().skip(1).filter(|link| **link != 0) {
                            self.collect(file, *data, open_end, depth + 1)?;
                        }
                    }
                    next = list.link(0);
                    lists += 1;
                    if lists * BLOCK_HEAD_BYTES > file.len() {
                        return Err(Fault::malformed("a list of data that ends", b"a circle of links"));
                    }
                }
            }
            name => {
                let name = String::from_utf8_lossy(name).into_owned();
                return Err(Fault::malformed(format!("a block of data at {link:#x}"), name.as_bytes()));
            }
        }
        Ok(())
    }

    /// A list of values, and behind them of the bits that say which of these are none; no link to bits says that all are values.
    fn collect_apart(
        &mut self,
        file: &mut Whole,
        list: &Block,
        open_end: bool,
        depth: u32,
    ) -> Result<(), Fault> {
        let count = u32_at(&list.data, 4) as usize;
        let (values, invalid) =
            list.links.get(1..).and_then(|links| links.split_at_checked(count)).ok_or_else(|| {
                Fault::malformed(
                    format!("a list of {count} of data", count = counted(count, "block")),
                    list.links.len().to_string().as_bytes(),
                )
            })?;
        for (at, link) in values.iter().enumerate() {
            let before = self.len;
            if *link != 0 {
                self.collect(file, *link, open_end, depth)?;
            }
            let rows = (self.len - before).checked_div(self.origin.row_bytes.0).unwrap_or(0);
            let bits = self.invalid.get_or_insert_default();
            match invalid.get(at) {
                Some(&link) if link != 0 => bits.collect(file, link, open_end, depth)?,
                _ => bits.push(rows * self.origin.row_bytes.1, ALL_VALID, None),
            }
        }
        Ok(())
    }

    /// `len` bytes from a position on; `None` if the stream has fewer there.
    pub(super) fn at(&mut self, file: &mut Whole, at: u64, len: usize) -> Result<Option<&[u8]>, Fault> {
        let Some(end) = at.checked_add(len as u64).filter(|end| *end <= self.len) else { return Ok(None) };
        let looked_at = end.saturating_add(self.ahead).min(self.len);
        if at < self.buffer_start || looked_at > self.buffer_start + self.buffer.len() as u64 {
            self.load(file, at, looked_at)?;
            if end > self.len {
                return Ok(None);
            }
        }
        let from = (at - self.buffer_start) as usize;
        Ok(self.buffer.get(from..from + len))
    }

    /// The bytes from a place on that are at hand, perhaps none.
    #[inline]
    pub(super) fn held(&self, at: u64) -> &[u8] {
        let from = at.checked_sub(self.buffer_start).and_then(|from| usize::try_from(from).ok());
        let is_last = self.buffer_start + self.buffer.len() as u64 >= self.len;
        let ahead = if is_last { 0 } else { self.ahead as usize };
        let to = self.buffer.len().saturating_sub(ahead);
        from.and_then(|from| self.buffer.get(from..to)).unwrap_or_default()
    }

    /// Makes the buffer hold these bytes.
    fn load(&mut self, file: &mut Whole, at: u64, end: u64) -> Result<(), Fault> {
        let held_until = self.buffer_start + self.buffer.len() as u64;
        if at >= self.buffer_start && at <= held_until {
            self.buffer.drain(..(at - self.buffer_start) as usize);
            self.buffer_start = at;
        } else {
            self.buffer.clear();
            let holds = self.pieces.partition_point(|piece| piece.start + piece.len <= at);
            let piece = self.pieces[holds];
            self.buffer_start = if piece.packed.is_some() { piece.start } else { at };
        }
        loop {
            let loaded = self.buffer_start + self.buffer.len() as u64;
            if loaded >= end.min(self.len) {
                return Ok(());
            }
            let holds = self.pieces.partition_point(|piece| piece.start + piece.len <= loaded);
            let Some(piece) = self.pieces.get(holds).copied() else { return Ok(()) };
            if piece.packed.is_some() {
                let pieces = &self.pieces;
                let block = |index: usize| {
                    pieces.get(index).and_then(|piece| Some((piece.at, piece.len, piece.packed?)))
                };
                let bytes = self.unpacker.take(file, holds, block)?;
                if self.buffer.is_empty() {
                    self.buffer = bytes;
                } else {
                    self.buffer.extend_from_slice(&bytes);
                }
            } else {
                let within = loaded - piece.start;
                let len = (piece.len - within).min(PIECE_BYTES);
                if piece.at == ALL_VALID {
                    self.buffer.resize(self.buffer.len() + len as usize, 0);
                } else {
                    file.append_at(piece.at + within, len as usize, &mut self.buffer)?;
                }
                if piece.is_open {
                    self.look_for_file(piece, within);
                }
            }
        }
    }

    /// Ends the stream where another file begins in what the buffer has had since this place of a piece.
    fn look_for_file(&mut self, piece: Piece, within: u64) {
        let held = (piece.start + within).saturating_sub(self.buffer_start) as usize;
        let from = held.saturating_sub(BEGIN_BYTES);
        let Some(begin) = self.buffer.get(from..).and_then(begin) else { return };
        self.buffer.truncate(from + begin);
        self.len = self.buffer_start + self.buffer.len() as u64;
        self.next_file = Some(piece.at + (self.len - piece.start));
    }
}
