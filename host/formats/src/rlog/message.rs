//! Cap'n Proto's encoding, as far as openpilot's events need it: pointers are followed only to what lies within the message.
//!
//! Source: capnproto.org, "Encoding Spec": segment table, structs, lists, inter-segment pointers.

/// Everything is a multiple of this.
const WORD_BYTES: usize = 8;
/// More segments than a message that may be held has: each is as long as all before it.
const MAX_SEGMENTS: usize = 32;
/// The table of so many segments, and the root pointer.
pub(super) const LONGEST_TABLE_BYTES: usize = table_bytes(MAX_SEGMENTS) + WORD_BYTES;
/// An `Event`'s root pointer: the struct follows, with two words of data and one pointer. Every version has had these.
const ROOT: [u8; WORD_BYTES] = [0, 0, 0, 0, 2, 0, 1, 0];

/// Of a message with this many segments: their count, the length of each, padding.
const fn table_bytes(segments: usize) -> usize {
    (4 + 4 * segments).next_multiple_of(WORD_BYTES)
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().map(|word| u32::from_le_bytes(*word))
}

fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    bytes.get(at..)?.first_chunk().map(|word| u64::from_le_bytes(*word))
}

/// How many segments a message has, at least one.
fn segments(bytes: &[u8]) -> Option<usize> {
    let count = u32_at(bytes, 0)?.checked_add(1)? as usize;
    (count <= MAX_SEGMENTS).then_some(count)
}

/// The length of the event that begins here, table and all; `None` if none does.
pub(super) fn event_len(bytes: &[u8]) -> Option<usize> {
    /// The root pointer and its struct.
    const FEWEST_WORDS: usize = 4;
    let count = segments(bytes)?;
    let table = table_bytes(count);
    if bytes.get(table..)?.first_chunk() != Some(&ROOT) {
        return None;
    }
    let mut words = 0_usize;
    for segment in 0..count {
        words = words.checked_add(u32_at(bytes, 4 + 4 * segment)? as usize)?;
    }
    let len = words.checked_mul(WORD_BYTES)?.checked_add(table)?;
    (words >= FEWEST_WORDS).then_some(len)
}

/// Where the next event begins.
pub(super) fn find_event(bytes: &[u8]) -> Option<usize> {
    let roots = memchr::memmem::find_iter(bytes, &ROOT);
    // Most have one segment; others are found only where all else is damaged.
    roots
        .flat_map(|root| (1..=MAX_SEGMENTS).map(move |count| (root, count)))
        .filter_map(|(root, count)| root.checked_sub(table_bytes(count)).zip(Some(count)))
        .find(|(at, count)| segments(&bytes[*at..]) == Some(*count) && event_len(&bytes[*at..]).is_some())
        .map(|(at, _)| at)
}

/// A message's segments.
pub(super) struct Message<'a> {
    segments: Vec<&'a [u8]>,
}

/// A word that may be a pointer.
#[derive(Clone, Copy)]
pub(super) struct Pointer<'a> {
    message: &'a Message<'a>,
    segment: usize,
    /// Offset in the segment, in bytes.
    at: usize,
}

/// What a pointer points to.
#[derive(Clone, Copy)]
struct Target {
    segment: usize,
    at: usize,
    /// The pointer that says what it is.
    tag: u64,
}

/// A struct's data and pointers.
pub(super) struct Struct<'a> {
    message: &'a Message<'a>,
    segment: usize,
    /// Offset of the pointers in the segment.
    pointers_at: usize,
    data: &'a [u8],
    pointers: usize,
}

impl<'a> Message<'a> {
    /// Takes it apart.
    pub(super) fn new(bytes: &'a [u8]) -> Option<Self> {
        let count = segments(bytes)?;
        let mut at = table_bytes(count);
        let mut parts = Vec::with_capacity(count);
        for segment in 0..count {
            let len = (u32_at(bytes, 4 + 4 * segment)? as usize).checked_mul(WORD_BYTES)?;
            parts.push(bytes.get(at..)?.get(..len)?);
            at += len;
        }
        Some(Self { segments: parts })
    }

    /// The struct that is the message.
    pub(super) fn root(&'a self) -> Option<Struct<'a>> {
        Pointer { message: self, segment: 0, at: 0 }.struct_at()
    }

    fn word(&self, segment: usize, at: usize) -> Option<u64> {
        u64_at(self.segments.get(segment)?, at)
    }

    fn bytes(&self, segment: usize, at: usize, len: usize) -> Option<&'a [u8]> {
        self.segments.get(segment)?.get(at..)?.get(..len)
    }

    /// What is `offset` words behind this place.
    fn behind(at: usize, offset: i32) -> Option<usize> {
        let offset = isize::try_from(offset).ok()?.checked_mul(WORD_BYTES as isize)?;
        at.checked_add_signed(offset)
    }

    fn structs_at(&'a self, target: &Target, at: usize) -> Option<Struct<'a>> {
        let data_len = usize::from((target.tag >> 32) as u16) * WORD_BYTES;
        let pointers = usize::from((target.tag >> 48) as u16);
        let data = self.bytes(target.segment, at, data_len)?;
        let pointers_at = at + data_len;
        self.bytes(target.segment, pointers_at, pointers * WORD_BYTES)?;
        Some(Struct { message: self, segment: target.segment, pointers_at, data, pointers })
    }
}

/// A pointer to nothing: the default of what it stands for.
const NOTHING: u64 = 0;
/// Kinds of pointers: their lowest bits.
const STRUCT: u64 = 0;
const LIST: u64 = 1;
const FAR: u64 = 2;

impl<'a> Pointer<'a> {
    /// What it points to, through other segments if need be; `None` if it makes no sense.
    fn target(self) -> Option<Target> {
        let word = self.message.word(self.segment, self.at)?;
        if word == NOTHING {
            return Some(Target { segment: self.segment, at: 0, tag: NOTHING });
        }
        if word & 3 != FAR {
            return near(word, self.segment, self.at);
        }
        let (segment, at) = far(word);
        let pad = self.message.word(segment, at)?;
        if word & 4 == 0 {
            return near(pad, segment, at);
        }
        // The pad says where it is, and the word behind it what.
        let tag = self.message.word(segment, at.checked_add(WORD_BYTES)?)?;
        if pad & 7 != FAR || tag & 3 == FAR {
            return None;
        }
        let (segment, at) = far(pad);
        Some(Target { segment, at, tag })
    }

    /// The struct; one without data if there is none.
    pub(super) fn struct_at(self) -> Option<Struct<'a>> {
        let target = self.target()?;
        (target.tag & 3 == STRUCT).then_some(())?;
        self.message.structs_at(&target, target.at)
    }

    /// The structs of a list.
    pub(super) fn structs(self) -> Option<impl ExactSizeIterator<Item = Option<Struct<'a>>>> {
        const COMPOSITE: u64 = 7;
        let target = self.target()?;
        let mut list = (Target { tag: NOTHING, ..target }, 0, 0);
        if target.tag != NOTHING {
            if target.tag & 3 != LIST || target.tag >> 32 & 7 != COMPOSITE {
                return None;
            }
            let words = (target.tag >> 35) as usize;
            self.message.bytes(
                target.segment,
                target.at.checked_add(WORD_BYTES)?,
                words.checked_mul(WORD_BYTES)?,
            )?;
            let tag = self.message.word(target.segment, target.at)?;
            let count = (tag as u32 >> 2) as usize;
            let size = usize::from((tag >> 32) as u16) + usize::from((tag >> 48) as u16);
            // Structs without a word could be any number.
            if tag & 3 != STRUCT || size == 0 || count.checked_mul(size)? > words {
                return None;
            }
            list = (Target { tag, at: target.at + WORD_BYTES, ..target }, count, size * WORD_BYTES);
        }
        let (target, count, step) = list;
        Some((0..count).map(move |number| self.message.structs_at(&target, target.at + number * step)))
    }

    /// The bytes of a list of them; none if there is none.
    pub(super) fn bytes(self) -> Option<&'a [u8]> {
        const BYTES: u64 = 2;
        let target = self.target()?;
        if target.tag == NOTHING {
            return Some(&[]);
        }
        if target.tag & 3 != LIST || target.tag >> 32 & 7 != BYTES {
            return None;
        }
        self.message.bytes(target.segment, target.at, (target.tag >> 35) as usize)
    }
}

/// What a pointer within a segment points to.
fn near(word: u64, segment: usize, at: usize) -> Option<Target> {
    if word & 3 > LIST {
        return None;
    }
    let at = Message::behind(at.checked_add(WORD_BYTES)?, word as i32 >> 2)?;
    Some(Target { segment, at, tag: word })
}

/// The place that a pointer to another segment gives.
fn far(word: u64) -> (usize, usize) {
    ((word >> 32) as usize, (word as u32 >> 3) as usize * WORD_BYTES)
}

impl<'a> Struct<'a> {
    /// A number in the data; as in all of Cap'n Proto, what a shorter struct does not have is 0.
    pub(super) fn u64(&self, at: usize) -> u64 {
        u64_at(self.data, at).unwrap_or(0)
    }

    pub(super) fn u32(&self, at: usize) -> u32 {
        u32_at(self.data, at).unwrap_or(0)
    }

    pub(super) fn u16(&self, at: usize) -> u16 {
        u16::from_le_bytes([self.u8(at), self.u8(at + 1)])
    }

    pub(super) fn u8(&self, at: usize) -> u8 {
        self.data.get(at).copied().unwrap_or(0)
    }

    /// A pointer by its number; `None` if the struct does not have it.
    pub(super) fn pointer(&self, number: usize) -> Option<Pointer<'a>> {
        let at = self.pointers_at + number * WORD_BYTES;
        (number < self.pointers).then_some(Pointer { message: self.message, segment: self.segment, at })
    }
}
