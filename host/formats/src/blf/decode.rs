//! Reading BLF.

use std::io;

use cantap_wire::record::BusErrorKind;
use cantap_wire::{Frame, Id};
use flate2::{Decompress, FlushDecompress, Status};

use super::super::calendar::Date;
use super::super::codec::{Decode, REQUESTS_TO_SEND};
use super::super::event_text;
use super::super::found::Found;
use super::super::input::{Input, MAX_ITEM_BYTES};
use super::super::issue::{Fault, Place};
use super::super::sja1000;
use super::super::zone::Zone;
use super::kinds::{group, is_bookkeeping};
use super::{
    BASE_HEADER_BYTES, CAN_ERROR, CAN_ERROR_EXT, CAN_FD_ERROR_64, CAN_FD_MESSAGE, CAN_FD_MESSAGE_64,
    CAN_MESSAGE, CAN_MESSAGE2, COMPRESSION_NONE, COMPRESSION_ZLIB, CONTAINER_FIELDS_BYTES, DATA_LOST_END,
    DIRECTION, EVENT_COMMENT, EXTENDED, FD_FORMAT, FD_PASSIVE_SENDER, FD_SWITCHED_BIT_RATE, FD64_FORMAT,
    FD64_PASSIVE_SENDER, FD64_REMOTE, FD64_SWITCHED_BIT_RATE, FILE_BYTES_OFFSET, FILE_HEADER_BYTES,
    FILE_MAGIC, HAS_SJA1000_CODE, LOG_CONTAINER, OBJECT_MAGIC, OWN_MARK, REMOTE, REQUESTED, SENT,
    START_OFFSET, TIME_IN_TEN_US,
};
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

/// The numbers of [`OWN_MARK`]'s kinds, from 1.
pub(crate) const KINDS: [BusErrorKind; 6] = [
    BusErrorKind::Stuff,
    BusErrorKind::Form,
    BusErrorKind::Acknowledgment,
    BusErrorKind::BitRecessive,
    BusErrorKind::BitDominant,
    BusErrorKind::Crc,
];

/// Reads BLF.
pub(crate) struct Decoder {
    started: bool,
    start_ns: i64,
    /// Of the dates in the header.
    zone: Zone,
    /// How long the header says that the file is.
    file_bytes: u64,
    /// Decompressed objects; those before `at` are used up. One may go on in the next container.
    objects: Vec<u8>,
    at: usize,
    decompressor: Decompress,
    /// Something wrong with the container whose objects are being read; told after them.
    fault: Option<(Place, Fault)>,
    /// Offset of the container.
    container: u64,
    /// The last object was a comment that already told what a loss object would.
    loss_told: bool,
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
            fault: None,
            container: 0,
            loss_told: false,
        }
    }
}

#[inline]
fn u16_at(bytes: &[u8], at: usize) -> u16 {
    bytes.get(at..at + 2).map_or(0, |field| u16::from_le_bytes([field[0], field[1]]))
}

#[inline]
fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |field| u32::from_le_bytes(*field))
}

#[inline]
fn u64_at(bytes: &[u8], at: usize) -> u64 {
    bytes.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |field| u64::from_le_bytes(*field))
}

/// A Windows SYSTEMTIME; 0 where it is none, as in a trace without a date.
fn system_time(bytes: &[u8]) -> i64 {
    let field = |at: usize| u16_at(bytes, 2 * at);
    let [year, month, _, day, hour, minute, second, ms] = std::array::from_fn(field);
    let of_day_ns =
        Date::of_day(u64::from(hour), u64::from(minute), u64::from(second), i64::from(ms) * 1_000_000);
    let date = |of_day_ns| Date { year: i64::from(year), month: month as u8, day: day as u8, of_day_ns };
    of_day_ns.and_then(|of_day_ns| date(of_day_ns).time_ns()).unwrap_or(0)
}

const EXPECTED_OBJECT: &str = "an object that begins with LOBJ";

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
    /// With the zone of the file's dates.
    pub(crate) fn new(zone: &Zone) -> Self {
        Self { zone: zone.clone(), ..Self::default() }
    }
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
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
                        // An object that would go on in the next container lost its rest here.
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
    /// The file's header. A file without it is read all the same, from the first object on.
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
        // A cut is told once.
        self.file_bytes = if cut { 0 } else { u64_at(head, FILE_BYTES_OFFSET) };
        self.start_ns = self.zone.utc_ns(system_time(&head[START_OFFSET.min(head.len())..]));
        input.consume(if (START_OFFSET..=4096).contains(&len) { len } else { FILE_HEADER_BYTES });
        Ok(cut.then_some(Fault::Truncated("the file header")))
    }

    /// After the last container, `offset` bytes into the file.
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

    /// Takes the next container (or bare object) of the file into `objects`. False at the end.
    fn container(&mut self, input: &mut Input) -> io::Result<bool> {
        loop {
            let offset = input.offset();
            let place = Place::Offset(offset);
            let head = input.peek(BASE_HEADER_BYTES)?;
            if head.is_empty() {
                return Ok(false);
            }
            if !head.starts_with(OBJECT_MAGIC) {
                // Padding first; else the file is damaged here.
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
                    COMPRESSION_ZLIB => {
                        let expected_len = u32_at(fields, 8) as usize;
                        if !inflate(&mut self.decompressor, data, expected_len, &mut self.objects) && !cut {
                            fault = Some(Fault::malformed("a whole zlib stream", b"damaged bytes"));
                        }
                    }
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
            let found = format!("an object of {len} bytes with a header of {header_len}");
            return Object::Issue(Fault::malformed("an object's length", found.as_bytes()));
        }
        let Some(object) = rest.get(..len) else { return Object::Incomplete };
        let kind = u32_at(object, 12);
        self.at += len;
        // Only with these headers is the time where it is looked for.
        if !matches!(version, 1 | 2) {
            let found = format!("version {version}");
            return Object::Issue(Fault::malformed("an object's header of version 1 or 2", found.as_bytes()));
        }
        if header_len < BASE_HEADER_BYTES + 16 {
            let found = format!("{header_len} bytes");
            return Object::Issue(Fault::malformed("an object's header with a time", found.as_bytes()));
        }
        let time = u64_at(object, 24);
        let offset_ns = if u32_at(object, 16) == TIME_IN_TEN_US { time.saturating_mul(10_000) } else { time };
        let offset_ns = i64::try_from(offset_ns).unwrap_or(i64::MAX);
        let time_ns = self.start_ns.saturating_add(offset_ns);
        let told = std::mem::take(&mut self.loss_told);
        match event(kind, &object[header_len..], told) {
            Ok(Content::Event(channel, event)) => {
                self.loss_told = kind == EVENT_COMMENT && matches!(event, TraceEvent::Lost { .. });
                Object::Event(TraceRecord { time_ns, channel, event })
            }
            Ok(Content::Request) => Object::Request,
            Ok(Content::LeftOut(what)) => Object::LeftOut(what),
            Ok(Content::Other) => Object::Other,
            Err(fault) => Object::Issue(fault),
        }
    }

    /// Goes to the next object: over padding quietly, over anything else with an issue.
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
                // What is left is padding, or the beginning of an object that goes on in the next container.
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

/// Goes on to the next LOBJ in the file, or to its end.
fn skip_to_object(input: &mut Input) -> io::Result<()> {
    loop {
        let bytes = input.peek(OBJECT_MAGIC.len())?;
        if bytes.len() < OBJECT_MAGIC.len() {
            let rest = bytes.len();
            input.consume(rest);
            return Ok(());
        }
        if let Some(at) = memchr::memmem::find(bytes, OBJECT_MAGIC) {
            input.consume(at);
            return Ok(());
        }
        let searched = bytes.len() + 1 - OBJECT_MAGIC.len();
        input.consume(searched);
    }
}

/// Appends what a zlib stream decompresses to; false if it is damaged, cut or larger than anything real.
fn inflate(decompressor: &mut Decompress, mut data: &[u8], expected_len: usize, out: &mut Vec<u8>) -> bool {
    const STEP_BYTES: usize = 256 * 1024;
    let limit = out.len() + MAX_ITEM_BYTES;
    decompressor.reset(true);
    out.reserve(expected_len.min(MAX_ITEM_BYTES));
    loop {
        let (before_in, before_out) = (decompressor.total_in(), decompressor.total_out());
        let status = decompressor.decompress_vec(data, out, FlushDecompress::None);
        let used = (decompressor.total_in() - before_in) as usize;
        data = &data[used..];
        match status {
            Ok(Status::StreamEnd) => return true,
            Ok(_) if out.len() == out.capacity() && out.len() < limit => out.reserve(STEP_BYTES),
            Ok(_) if used > 0 || decompressor.total_out() > before_out => {
                if out.len() >= limit {
                    return false;
                }
            }
            _ => return false,
        }
    }
}

/// What an object's fields say.
enum Content {
    /// A channel and what happened there.
    Event(u8, TraceEvent),
    /// The mere request to send a frame.
    Request,
    /// Something that a trace of CAN does not hold, by kind.
    LeftOut(&'static str),
    /// Something that nobody misses.
    Other,
}

#[inline]
fn event(kind: u32, fields: &[u8], loss_told: bool) -> Result<Content, Fault> {
    let need = |len: usize| {
        let found = fields.len();
        if found >= len {
            return Ok(());
        }
        let expected = format!("at least {len} bytes of fields in an object of type {kind}");
        Err(Fault::malformed(expected, format!("{found} bytes").as_bytes()))
    };
    let channel = || {
        let channel = u16_at(fields, 0);
        u8::try_from(channel)
            .map_err(|_| Fault::malformed("a channel of 0 to 255", channel.to_string().as_bytes()))
    };
    let unknown_error = TraceEvent::BusError { kind: None, counters: None };
    let on = |channel| {
        move |event: Option<_>| event.map_or(Content::Request, |event| Content::Event(channel, event))
    };
    Ok(match kind {
        CAN_MESSAGE | CAN_MESSAGE2 => {
            need(16)?;
            frame(fields[2], fields[3], u32_at(fields, 4), &fields[8..16]).map(on(channel()?))?
        }
        CAN_FD_MESSAGE => {
            need(28)?;
            let (flags, dlc, id) = (fields[2], fields[3], u32_at(fields, 4));
            let has = |flag| fields[13] & flag != 0;
            if has(FD_FORMAT) {
                let (brs, esi) = (has(FD_SWITCHED_BIT_RATE), has(FD_PASSIVE_SENDER));
                fd_frame(flags, dlc, id, brs, esi, valid(&fields[20..], fields[14])).map(on(channel()?))?
            } else {
                frame(flags, dlc, id, &fields[20..28]).map(on(channel()?))?
            }
        }
        CAN_FD_MESSAGE_64 => {
            need(40)?;
            let (dlc, id) = (fields[1], u32_at(fields, 4));
            let has = |flag| u32_at(fields, 12) & flag != 0;
            let direction = fields[34] & DIRECTION;
            let data = valid(&fields[40..], fields[2]);
            if has(FD64_FORMAT) {
                let (brs, esi) = (has(FD64_SWITCHED_BIT_RATE), has(FD64_PASSIVE_SENDER));
                fd_frame(direction, dlc, id, brs, esi, data).map(on(fields[0]))?
            } else {
                let remote = if has(FD64_REMOTE) { REMOTE } else { 0 };
                frame(remote | direction, dlc, id, data).map(on(fields[0]))?
            }
        }
        CAN_ERROR => Content::Event(channel()?, unknown_error),
        CAN_FD_ERROR_64 => Content::Event(fields.first().copied().unwrap_or_default(), unknown_error),
        CAN_ERROR_EXT => {
            need(32)?;
            Content::Event(channel()?, error_ext(fields))
        }
        DATA_LOST_END if !loss_told => {
            need(16)?;
            let count = u32_at(fields, 12);
            let lost = TraceEvent::Lost { stage: None, count: count.max(1), at_least: count == 0 };
            Content::Event(1, lost)
        }
        EVENT_COMMENT => {
            let len = u32_at(fields, 4) as usize;
            let text = fields.get(16..).unwrap_or_default();
            let text = &text[..text.len().min(len)];
            let channel = text.strip_prefix(b"CAN ").and_then(|rest| {
                let (number, _) = super::super::text::word(rest);
                u8::try_from(super::super::text::decimal(number)?).ok()
            });
            let event = channel.zip(event_text::marked(text));
            event.map_or(Content::LeftOut(group(kind)), |(channel, event)| Content::Event(channel, event))
        }
        DATA_LOST_END => Content::Other,
        _ if is_bookkeeping(kind) => Content::Other,
        _ => Content::LeftOut(group(kind)),
    })
}

/// The first `len` bytes. Valid bytes may be more than there are: those missing are zero.
fn valid(data: &[u8], len: u8) -> &[u8] {
    &data[..data.len().min(usize::from(len))]
}

/// A frame's direction; `None` for the mere request to send one.
#[inline]
fn direction(flags: u8) -> Option<Direction> {
    match flags & DIRECTION {
        SENT => Some(Direction::Tx),
        REQUESTED => None,
        _ => Some(Direction::Rx),
    }
}

/// A frame's identifier and length code, checked.
#[inline]
fn id_and_dlc(id: u32, dlc: u8) -> Result<Id, Fault> {
    let raw = id & !EXTENDED;
    let parsed = if id & EXTENDED != 0 { Id::extended(raw) } else { Id::standard(raw) };
    let fault =
        |expected: &'static str, found: u32| Fault::malformed(expected, format!("{found:#x}").as_bytes());
    let parsed = parsed.ok_or_else(|| fault("an identifier up to 0x7ff, or up to 0x1fffffff", id))?;
    if dlc > 15 {
        return Err(fault("a data length code of 0 to 0xf", u32::from(dlc)));
    }
    Ok(parsed)
}

/// A CAN FD frame; `None` for the mere request to send one.
fn fd_frame(
    flags: u8,
    dlc: u8,
    id: u32,
    brs: bool,
    esi: bool,
    data: &[u8],
) -> Result<Option<TraceEvent>, Fault> {
    let Some(direction) = direction(flags) else { return Ok(None) };
    let id = id_and_dlc(id, dlc)?;
    let mut bytes = [0; FD_MAX_BYTES];
    let len = usize::from(FD_LENGTHS[usize::from(dlc)]);
    let present = data.len().min(len);
    bytes[..present].copy_from_slice(&data[..present]);
    let frame = FdFrame::new(id, brs, esi, &bytes[..len]);
    Ok(frame.map(|frame| TraceEvent::Frame { frame: TraceFrame::Fd(frame), direction, late: false }))
}

/// A classical frame; `None` for the mere request to send one.
#[inline]
fn frame(flags: u8, dlc: u8, id: u32, data: &[u8]) -> Result<Option<TraceEvent>, Fault> {
    let Some(direction) = direction(flags) else { return Ok(None) };
    let parsed = id_and_dlc(id, dlc)?;
    let mut bytes = [0; 8];
    let len = data.len().min(8);
    bytes[..len].copy_from_slice(&data[..len]);
    let frame = Frame::from_bus(parsed, flags & REMOTE != 0, dlc, bytes);
    Ok(Some(TraceEvent::Frame { frame: frame.into(), direction, late: false }))
}

/// An error object: ours exactly, others as far as the controller's code tells.
fn error_ext(fields: &[u8]) -> TraceEvent {
    if fields[10] == 0 && fields[24] == OWN_MARK {
        let kind = fields[25].checked_sub(1).and_then(|at| KINDS.get(usize::from(at)).copied());
        let counters = (fields[26] != 0).then_some((fields[27], fields[28]));
        return TraceEvent::BusError { kind, counters };
    }
    let has_code = u32_at(fields, 4) & HAS_SJA1000_CODE != 0;
    let kind = if has_code { sja1000::kind(fields[8]) } else { extended_code(u16_at(fields, 20)) };
    TraceEvent::BusError { kind, counters: None }
}

/// The kind in bits 6 to 11 of an error object's extended flags, as Vector's interfaces report it.
fn extended_code(flags: u16) -> Option<BusErrorKind> {
    match flags >> 6 & 0x3F {
        1 => Some(BusErrorKind::Form),
        2 => Some(BusErrorKind::Stuff),
        4 => Some(BusErrorKind::Crc),
        5 | 7 => Some(BusErrorKind::Acknowledgment),
        _ => None,
    }
}
