//! Reads BLF: the file, its containers, and the objects one after another.

use std::io;

use cantap_trace::counted;
use flate2::Decompress;

use super::super::bit_rates::{self, BitRates};
use super::super::calendar::Date;
use super::super::codec::{BATCH, Decode, PLAIN_BATCH, REQUESTS_TO_SEND};
use super::super::found::Found;
use super::super::input::{Input, MAX_ITEM_BYTES};
use super::super::issue::{Fault, Place};
use super::super::seek;
use super::super::zone::Zone;
use super::containers::{AHEAD_BYTES, Containers};
use super::kinds::{group, is_left_out};
use super::object::{Content, event, u16_at, u32_at, u64_at};
use super::unpack::{inflate, skip_to_object};
use super::{
    BASE_HEADER_BYTES, CAN_MESSAGE, CAN_MESSAGE2, COMPRESSION_NONE, COMPRESSION_ZLIB, CONTAINER_FIELDS_BYTES,
    DIRECTION, EVENT_COMMENT, EXTENDED, FILE_BYTES_OFFSET, FILE_HEADER_BYTES, FILE_MAGIC, HEADER_BYTES,
    LOG_CONTAINER, OBJECT_MAGIC, REMOTE, REQUESTED, SENT, START_OFFSET, TIME_IN_TEN_US,
};
use cantap_trace::{Direction, Frame, Id, PlainFrame, TraceEvent, TraceRecord};

/// Reads BLF.
pub(crate) struct Decoder {
    started: bool,
    start_ns: i64,
    /// The zone of the dates in the header.
    zone: Zone,
    /// The file's length according to the header.
    file_bytes: u64,
    /// Decompressed objects; those before `at` are used up. The last one may continue in the next container.
    objects: Vec<u8>,
    at: usize,
    decompressor: Decompress,
    /// What other cores have unpacked already.
    ahead: Containers,
    /// A fault in the container whose objects are being read; reported after them.
    fault: Option<(Place, Fault)>,
    /// Offset of the container.
    container: u64,
    /// The last object was a comment that already reported the loss that a loss object would report.
    loss_told: bool,
    bit_rates: BitRates,
}

impl Default for Decoder {
    fn default() -> Self {
        Self {
            zone: Zone::default(),
            started: false,
            start_ns: 0,
            file_bytes: 0,
            objects: Vec::new(),
            at: 0,
            decompressor: Decompress::new(true),
            ahead: Containers::default(),
            fault: None,
            container: 0,
            loss_told: false,
            bit_rates: BitRates::new(),
        }
    }
}

/// Reads a Windows SYSTEMTIME; 0 in a trace without a date, `None` if it is not a date.
fn system_time(bytes: &[u8]) -> Option<i64> {
    let field = |at: usize| u16_at(bytes, 2 * at);
    if (0..8).all(|at| field(at) == 0) {
        return Some(0);
    }
    let [year, month, _, day, hour, minute, second, ms] = std::array::from_fn(field);
    let of_day_ns =
        Date::of_day(u64::from(hour), u64::from(minute), u64::from(second), i64::from(ms) * 1_000_000);
    let date = |of_day_ns| Date { year: i64::from(year), month: month as u8, day: day as u8, of_day_ns };
    // Years and months have more bits in the file.
    (month <= 12 && day <= 31).then_some(())?;
    date(of_day_ns?).time_ns()
}

const EXPECTED_OBJECT: &str = "an object that begins with LOBJ";

/// The length of a classical frame's object: its header, and 16 bytes of fields.
const CLASSICAL_BYTES: usize = HEADER_BYTES + 16;

/// A classical frame about which there is nothing else to say.
struct Classical {
    time_ns: i64,
    channel: u8,
    id: Id,
    direction: Direction,
    remote: bool,
    dlc: u8,
    data: [u8; 8],
}

/// What came out of looking for an object.
enum Object {
    Event(TraceRecord),
    Request,
    LeftOut(&'static str),
    Other,
    Issue(Fault),
    /// The rest is in the next container, if there is one.
    Incomplete,
}

impl Decoder {
    /// `zone` is the zone of the file's dates.
    pub(crate) fn new(zone: &Zone) -> Self {
        Self { zone: zone.clone(), ..Self::default() }
    }
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn bit_rates(&self) -> &[(u8, u32)] {
        &self.bit_rates
    }

    fn batch(&mut self, input: &mut Input, records: &mut Vec<TraceRecord>) -> io::Result<Option<Found>> {
        loop {
            self.frames(records);
            // Records that are there do not wait for more input; and between two containers is a place to read on from.
            if records.len() >= BATCH || (input.may_wait() || self.is_between()) && !records.is_empty() {
                return Ok(None);
            }
            match self.next(input)? {
                Found::Record(record) => records.push(record),
                other => return Ok(Some(other)),
            }
            if records.len() >= BATCH || input.may_wait() {
                return Ok(None);
            }
        }
    }

    fn save(&self, state: &mut Vec<u8>) -> bool {
        /// A longer object is not begun before a place.
        const MOST_BEGUN_BYTES: usize = 4096;
        let begun = &self.objects[self.at..];
        let Self { started, start_ns, file_bytes, container, loss_told, bit_rates, .. } = self;
        self.fault.is_none()
            && self.is_between()
            && begun.len() <= MOST_BEGUN_BYTES
            && seek::save(&(started, start_ns, file_bytes, container, loss_told, begun, bit_rates), state)
    }

    fn restore(&mut self, state: &[u8]) -> Option<()> {
        let Self { started, start_ns, file_bytes, container, loss_told, objects, bit_rates, .. } = self;
        (*started, *start_ns, *file_bytes, *container, *loss_told, *objects, *bit_rates) = seek::load(state)?;
        Some(())
    }

    fn plain_frames(&mut self, frames: &mut Vec<PlainFrame>) -> io::Result<bool> {
        self.take_plain(frames);
        Ok(true)
    }

    #[inline]
    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if !self.started
            && let Some(fault) = self.head(input)?
        {
            return Ok(Found::Issue(Place::Offset(0), fault));
        }
        loop {
            match self.object() {
                Object::Event(record) => return Ok(Found::Record(record)),
                Object::Request => return Ok(Found::Note(REQUESTS_TO_SEND)),
                Object::LeftOut(what) => return Ok(Found::LeftOut(what)),
                Object::Other => {}
                Object::Issue(fault) => return Ok(Found::Issue(Place::Offset(self.container), fault)),
                Object::Incomplete => {
                    if let Some((place, fault)) = self.fault.take() {
                        // An object that should continue in the next container lost its rest here.
                        self.objects.clear();
                        self.at = 0;
                        return Ok(Found::Issue(place, fault));
                    }
                    if !self.container(input)? {
                        return Ok(self.end(input.offset()));
                    }
                }
            }
        }
    }
}

impl Decoder {
    /// Whether nothing more can be read without the next container: at most the beginning of an object is left.
    fn is_between(&self) -> bool {
        let rest = &self.objects[self.at..];
        rest.len() < BASE_HEADER_BYTES || {
            let (header_len, len) = (usize::from(u16_at(rest, 4)), u32_at(rest, 8) as usize);
            let is_object = rest.starts_with(OBJECT_MAGIC) && header_len <= len;
            is_object && (BASE_HEADER_BYTES..=MAX_ITEM_BYTES).contains(&len) && rest.len() < len
        }
    }

    /// Reads the file's header. A file without one is still read, from the first object on.
    fn head(&mut self, input: &mut Input) -> io::Result<Option<Fault>> {
        self.started = true;
        let head = input.peek(FILE_HEADER_BYTES)?;
        let cut = head.len() < FILE_HEADER_BYTES;
        if head.len() < FILE_MAGIC.len() {
            let rest = head.len();
            input.consume(rest);
            return Ok(Some(Fault::Truncated("the file header")));
        }
        if !head.starts_with(FILE_MAGIC) {
            let found = &head[..FILE_MAGIC.len()];
            return Ok(Some(Fault::malformed("a BLF file, which begins with LOGG", found)));
        }
        let len = u32_at(head, 4) as usize;
        // Report a cut only once.
        self.file_bytes = if cut { 0 } else { u64_at(head, FILE_BYTES_OFFSET) };
        let start = &head[START_OFFSET.min(head.len())..];
        let date = system_time(start);
        let no_date = date.is_none().then(|| {
            let fields: Vec<_> = (0..8).map(|at| u16_at(start, 2 * at).to_string()).collect();
            let expected = "a date that the times count from; they count from 1970 now";
            Fault::malformed(expected, fields.join(" ").as_bytes())
        });
        self.start_ns = self.zone.utc_ns(date.unwrap_or(0));
        input.consume(if (START_OFFSET..=4096).contains(&len) { len } else { FILE_HEADER_BYTES });
        Ok(if cut { Some(Fault::Truncated("the file header")) } else { no_date })
    }

    /// Handles the end after the last container, `offset` bytes into the file.
    fn end(&mut self, offset: u64) -> Found {
        let rest = self.objects.len() - self.at;
        self.objects.clear();
        self.at = 0;
        // Up to three bytes may be padding.
        if rest > 3 {
            self.file_bytes = 0;
            return Found::Issue(Place::Offset(self.container), Fault::Truncated("an object"));
        }
        // Cut between two containers.
        if offset < std::mem::take(&mut self.file_bytes) {
            return Found::Issue(Place::Offset(offset), Fault::Truncated("the length that its header tells"));
        }
        Found::End
    }

    /// Reads the next container (or bare object) of the file into `objects`. False at the end.
    fn container(&mut self, input: &mut Input) -> io::Result<bool> {
        loop {
            let offset = input.offset();
            let place = Place::Offset(offset);
            let head = input.peek(BASE_HEADER_BYTES)?;
            if head.is_empty() {
                return Ok(false);
            }
            if !head.starts_with(OBJECT_MAGIC) {
                // Skip padding; otherwise the file is damaged here.
                let found = head[..head.len().min(4)].to_vec();
                let padding = head.iter().take(4).take_while(|byte| **byte == 0).count();
                if padding > 0 && (head.len() == padding || head[padding..].starts_with(&OBJECT_MAGIC[..1])) {
                    input.consume(padding);
                    continue;
                }
                skip_to_object(input)?;
                self.fault = Some((place, Fault::malformed(EXPECTED_OBJECT, &found)));
                return Ok(true);
            }
            self.container = offset;
            let len = u32_at(head, 8) as usize;
            let kind = u32_at(head, 12);
            if head.len() < BASE_HEADER_BYTES {
                let rest = head.len();
                input.consume(rest);
                self.fault = Some((place, Fault::Truncated("an object's header")));
                self.file_bytes = 0;
                return Ok(true);
            }
            if !(BASE_HEADER_BYTES..=MAX_ITEM_BYTES).contains(&len) {
                input.consume(OBJECT_MAGIC.len());
                skip_to_object(input)?;
                let expected = format!("an object of {BASE_HEADER_BYTES} to {MAX_ITEM_BYTES} bytes");
                self.fault = Some((place, Fault::malformed(expected, len.to_string().as_bytes())));
                return Ok(true);
            }
            if kind == LOG_CONTAINER && !input.may_wait() && self.ahead.is_due(offset) {
                self.ahead.unpack(input.peek(AHEAD_BYTES)?, offset);
            }
            let object = input.peek(len)?;
            let cut = object.len() < len;
            let object = &object[..object.len().min(len)];
            if self.at > 0 {
                self.objects.drain(..self.at);
                self.at = 0;
            }
            let mut fault = None;
            if kind == LOG_CONTAINER {
                let fields = object.get(BASE_HEADER_BYTES..).unwrap_or_default();
                let data = fields.get(CONTAINER_FIELDS_BYTES..).unwrap_or_default();
                match u16_at(fields, 0) {
                    COMPRESSION_NONE => self.objects.extend_from_slice(data),
                    COMPRESSION_ZLIB => match self.ahead.take(offset) {
                        Some(objects) if self.objects.is_empty() => self.objects = objects,
                        Some(objects) => self.objects.extend_from_slice(&objects),
                        None => {
                            let expected_len = u32_at(fields, 8) as usize;
                            let is_whole =
                                inflate(&mut self.decompressor, data, expected_len, &mut self.objects);
                            if !is_whole && !cut {
                                fault = Some(Fault::malformed("a whole zlib stream", b"damaged bytes"));
                            }
                        }
                    },
                    other => {
                        fault = Some(Fault::Unsupported(format!("compression method {other}").into()));
                    }
                }
            } else {
                // A file without containers.
                self.objects.extend_from_slice(object);
            }
            if cut {
                fault = Some(Fault::Truncated("an object"));
                self.file_bytes = 0;
            }
            let used = object.len();
            input.consume(used);
            self.fault = fault.map(|fault| (place, fault));
            return Ok(true);
        }
    }

    /// Appends classical frames, which are most of a trace, up to the first object that is anything else or needs a report, which is
    /// left to [`Self::object`]. It skips that function's individual checks and does not copy a record more than once.
    fn frames(&mut self, records: &mut Vec<TraceRecord>) {
        let room = BATCH.saturating_sub(records.len());
        let frames = self.classical().take(room).map(|frame| {
            let Classical { time_ns, channel, id, direction, remote, dlc, data } = frame;
            let frame = Frame::from_bus(id, remote, dlc, data).into();
            TraceRecord {
                time_ns,
                device_ns: None,
                channel,
                event: TraceEvent::Frame { frame, direction, late: false },
            }
        });
        let before = records.len();
        records.extend(frames);
        self.at += (records.len() - before) * CLASSICAL_BYTES;
    }

    /// The same for data frames alone.
    fn take_plain(&mut self, frames: &mut Vec<PlainFrame>) {
        frames.reserve(PLAIN_BATCH);
        let plain = self.classical().take_while(|frame| !frame.remote).take(PLAIN_BATCH);
        let plain =
            plain.map(|frame| PlainFrame::new(frame.time_ns, frame.channel, frame.id, frame.dlc, frame.data));
        let before = frames.len();
        frames.extend(plain);
        self.at += (frames.len() - before) * CLASSICAL_BYTES;
    }

    /// The classical frames that come next, without using them up.
    #[inline]
    fn classical(&self) -> impl Iterator<Item = Classical> {
        // A loss behind the comment that says the same is not to be told twice.
        let objects = if self.loss_told { &[] } else { &self.objects[self.at..] };
        objects.chunks_exact(CLASSICAL_BYTES).map_while(|object| self.classical_frame(object.first_chunk()?))
    }

    /// The frame of an object; `None` if there is anything to say about it.
    #[inline]
    fn classical_frame(&self, object: &[u8; CLASSICAL_BYTES]) -> Option<Classical> {
        /// Signature, header of 32 bytes in its first version, and length, as they stand in each of these objects.
        const HEAD: [u8; 12] =
            [b'L', b'O', b'B', b'J', HEADER_BYTES as u8, 0, 1, 0, CLASSICAL_BYTES as u8, 0, 0, 0];
        let field =
            |at: usize| u32::from_le_bytes([object[at], object[at + 1], object[at + 2], object[at + 3]]);
        if object[..HEAD.len()] != HEAD || !matches!(field(12), CAN_MESSAGE | CAN_MESSAGE2) {
            return None;
        }
        let (flags, dlc, raw, channel) = (object[34], object[35], field(36), object[32]);
        let direction = match flags & DIRECTION {
            SENT => Direction::Tx,
            REQUESTED => return None,
            _ => Direction::Rx,
        };
        let id = raw & !EXTENDED;
        let id = if raw & EXTENDED != 0 { Id::extended(id) } else { Id::standard(id) };
        let (Some(id), 0..=15, 0) = (id, dlc, object[33]) else { return None };
        let time_ns = self.time_ns(field(16), u64::from(field(24)) | u64::from(field(28)) << 32);
        let data = std::array::from_fn(|at| object[40 + at]);
        Some(Classical { time_ns, channel, id, direction, remote: flags & REMOTE != 0, dlc, data })
    }

    /// An object's time, in the unit given by its flags.
    #[inline]
    fn time_ns(&self, flags: u32, time: u64) -> i64 {
        let offset_ns = if flags == TIME_IN_TEN_US { time.saturating_mul(10_000) } else { time };
        self.start_ns.saturating_add(i64::try_from(offset_ns).unwrap_or(i64::MAX))
    }

    /// The next object in `objects`.
    #[inline]
    fn object(&mut self) -> Object {
        let rest = &self.objects[self.at..];
        if rest.len() < BASE_HEADER_BYTES {
            return Object::Incomplete;
        }
        if !rest.starts_with(OBJECT_MAGIC) {
            return self.resync();
        }
        let header_len = usize::from(u16_at(rest, 4));
        let version = u16_at(rest, 6);
        let len = u32_at(rest, 8) as usize;
        if !(BASE_HEADER_BYTES..=MAX_ITEM_BYTES).contains(&len) || header_len > len {
            self.at += OBJECT_MAGIC.len();
            let found =
                format!("an object of {len} with a header of {header_len}", len = counted(len, "byte"));
            return Object::Issue(Fault::malformed("an object's length", found.as_bytes()));
        }
        let Some(object) = rest.get(..len) else { return Object::Incomplete };
        let kind = u32_at(object, 12);
        self.at += len;
        // Only these headers have the time in the expected place.
        if !matches!(version, 1 | 2) && is_left_out(kind) {
            return Object::LeftOut(group(kind));
        }
        if !matches!(version, 1 | 2) {
            let found = format!("version {version}");
            return Object::Issue(Fault::malformed("an object's header of version 1 or 2", found.as_bytes()));
        }
        if header_len < BASE_HEADER_BYTES + 16 {
            let found = counted(header_len, "byte");
            return Object::Issue(Fault::malformed("an object's header with a time", found.as_bytes()));
        }
        let time_ns = self.time_ns(u32_at(object, 16), u64_at(object, 24));
        let told = std::mem::take(&mut self.loss_told);
        match event(kind, &object[header_len..], told) {
            Ok(Content::Event(channel, event)) => {
                self.loss_told = kind == EVENT_COMMENT && matches!(event, TraceEvent::Lost { .. });
                Object::Event(TraceRecord { time_ns, device_ns: None, channel, event })
            }
            Ok(Content::BitRates(rates)) => {
                for (channel, bps) in rates {
                    bit_rates::learn(&mut self.bit_rates, channel, bps);
                }
                Object::Other
            }
            Ok(Content::Request) => Object::Request,
            Ok(Content::LeftOut(what)) => Object::LeftOut(what),
            Ok(Content::Other) => Object::Other,
            Err(fault) => Object::Issue(fault),
        }
    }

    /// Goes to the next object: silently over padding, with an issue over anything else.
    fn resync(&mut self) -> Object {
        const MOST_PADDING: usize = 8;
        let rest = &self.objects[self.at..];
        match memchr::memmem::find(rest, OBJECT_MAGIC) {
            Some(skipped) if skipped <= MOST_PADDING => {
                self.at += skipped;
                Object::Other
            }
            Some(skipped) => {
                let found = rest[..4].to_vec();
                self.at += skipped;
                Object::Issue(Fault::malformed(EXPECTED_OBJECT, &found))
            }
            None if rest.len() < MOST_PADDING + OBJECT_MAGIC.len() => {
                // The rest is padding, or the beginning of an object that continues in the next container.
                let kept = (1..=OBJECT_MAGIC.len().min(rest.len()))
                    .rev()
                    .find(|kept| OBJECT_MAGIC.starts_with(&rest[rest.len() - kept..]))
                    .unwrap_or(0);
                self.at = self.objects.len() - kept;
                Object::Incomplete
            }
            None => {
                let found = rest[..4].to_vec();
                self.at = self.objects.len();
                Object::Issue(Fault::malformed(EXPECTED_OBJECT, &found))
            }
        }
    }
}
