//! Writing BLF.

use flate2::{Compress, Compression, FlushCompress, Status};

use super::super::bit_rates;
use super::super::calendar::{Date, FIRST_DATE_NS, start_of_trace};
use super::super::codec::Encode;
use super::super::event_text;
use super::super::left_out::LeftOut;
use super::super::output::Patch;
use super::super::sja1000;
use super::super::writer::WriteOptions;
use super::super::zone::Zone;
use super::lin;
use super::object::KINDS;
use super::{
    BASE_HEADER_BYTES, CAN_ERROR_EXT, CAN_FD_MESSAGE, CAN_MESSAGE, COMPRESSION_ZLIB, CONTAINER_FIELDS_BYTES,
    DATA_LOST_END, EVENT_COMMENT, EXTENDED, FD_FORMAT, FD_PASSIVE_SENDER, FD_SWITCHED_BIT_RATE,
    FILE_HEADER_BYTES, FILE_MAGIC, HAS_SJA1000_CODE, HEADER_BYTES, LOG_CONTAINER, OBJECT_MAGIC, OWN_MARK,
    REMOTE, SENT, TIME_IN_NS,
};
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};

/// Bytes of objects per container, as in files by Vector's own writer.
const CONTAINER_BYTES: usize = 128 * 1024;
/// zlib's fastest: a capture must keep up with two buses.
const LEVEL: u32 = 1;

/// Writes BLF.
pub(crate) struct Encoder {
    started: bool,
    start_ns: i64,
    stop_ns: i64,
    /// Objects for the next container.
    objects: Vec<u8>,
    compressor: Compress,
    object_count: u32,
    /// Length of the file without compression.
    uncompressed_bytes: u64,
    /// The zone of the dates in the header.
    zone: Zone,
    /// What is known of the channels' bit rates.
    note: Option<String>,
}

impl Default for Encoder {
    fn default() -> Self {
        Self {
            started: false,
            start_ns: 0,
            stop_ns: 0,
            objects: Vec::with_capacity(CONTAINER_BYTES + 1024),
            compressor: Compress::new(Compression::new(LEVEL), true),
            object_count: 0,
            uncompressed_bytes: FILE_HEADER_BYTES as u64,
            zone: Zone::default(),
            note: None,
        }
    }
}

impl Encoder {
    pub(crate) fn new(options: &WriteOptions) -> Self {
        let note = bit_rates::note(&options.channels);
        Self { zone: options.zone.clone(), note, ..Self::default() }
    }
}

/// Writes a Windows SYSTEMTIME; zeros for a trace without a date.
fn push_system_time(out: &mut Vec<u8>, time_ns: i64) {
    if (0..FIRST_DATE_NS).contains(&time_ns) {
        out.extend_from_slice(&[0; 16]);
        return;
    }
    let date = Date::of(time_ns);
    let (hour, minute, second, ns) = date.clock();
    let weekday = Date::weekday(time_ns) as u16;
    let (month, day) = (u16::from(date.month), u16::from(date.day));
    let (hour, minute, second) = (u16::from(hour), u16::from(minute), u16::from(second));
    let ms = (ns / 1_000_000) as u16;
    for field in [date.year as u16, month, weekday, day, hour, minute, second, ms] {
        out.extend_from_slice(&field.to_le_bytes());
    }
}

impl Encoder {
    /// The file's header, as far as it is known.
    fn file_header(&self, file_bytes: u64) -> Vec<u8> {
        /// CANoe, the application that python-can claims to be, too; some readers refuse others.
        const APPLICATION: u8 = 5;
        /// Version of the binary log format: 2.6.8.1.
        const FORMAT_VERSION: [u8; 4] = [2, 6, 8, 1];
        let mut header = Vec::with_capacity(FILE_HEADER_BYTES);
        header.extend_from_slice(FILE_MAGIC);
        header.extend_from_slice(&(FILE_HEADER_BYTES as u32).to_le_bytes());
        header.extend_from_slice(&[APPLICATION, 0, 0, 0]);
        header.extend_from_slice(&FORMAT_VERSION);
        header.extend_from_slice(&file_bytes.to_le_bytes());
        header.extend_from_slice(&self.uncompressed_bytes.to_le_bytes());
        header.extend_from_slice(&self.object_count.to_le_bytes());
        header.extend_from_slice(&0_u32.to_le_bytes());
        push_system_time(&mut header, self.zone.clock_ns(self.start_ns));
        push_system_time(&mut header, self.zone.clock_ns(self.stop_ns));
        header.resize(FILE_HEADER_BYTES, 0);
        header
    }

    /// Begins the file. The start is final from here on; the rest of the header is patched later.
    fn start(&mut self, first_ns: i64, out: &mut Vec<u8>) {
        self.started = true;
        self.start_ns = start_of_trace(first_ns);
        self.stop_ns = self.start_ns;
        out.extend_from_slice(&self.file_header(FILE_HEADER_BYTES as u64));
        if let Some(note) = self.note.take() {
            self.comment(note.into_bytes(), 0);
        }
    }

    /// Appends an object's header and fields.
    #[inline]
    fn object(&mut self, kind: u32, offset_ns: u64, fields: &[u8]) {
        let len = HEADER_BYTES + fields.len();
        let mut header = [0; HEADER_BYTES];
        header[..4].copy_from_slice(OBJECT_MAGIC);
        header[4..6].copy_from_slice(&(HEADER_BYTES as u16).to_le_bytes());
        header[6..8].copy_from_slice(&1_u16.to_le_bytes());
        header[8..12].copy_from_slice(&(len as u32).to_le_bytes());
        header[12..16].copy_from_slice(&kind.to_le_bytes());
        header[16..20].copy_from_slice(&TIME_IN_NS.to_le_bytes());
        header[24..32].copy_from_slice(&offset_ns.to_le_bytes());
        self.objects.extend_from_slice(&header);
        self.objects.extend_from_slice(fields);
        // The padding is the length modulo four: unexpected, but what readers use.
        self.objects.resize(self.objects.len() + len % 4, 0);
        self.object_count = self.object_count.saturating_add(1);
    }

    /// Adds a comment that carries the whole event.
    fn event_comment(&mut self, record: &TraceRecord, offset_ns: u64) {
        // The channel comes first, because comments belong to no channel.
        let mut text = format!("CAN {} ", record.channel).into_bytes();
        event_text::push_marked(&mut text, &record.event);
        self.comment(text, offset_ns);
    }

    fn comment(&mut self, mut text: Vec<u8>, offset_ns: u64) {
        // Multiples of four need no padding, on which readers disagree.
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut fields = vec![0; 16];
        fields[4..8].copy_from_slice(&(text.len() as u32).to_le_bytes());
        fields.extend_from_slice(&text);
        self.object(EVENT_COMMENT, offset_ns, &fields);
    }

    /// Compresses what was collected into a container.
    fn container(&mut self, out: &mut Vec<u8>) {
        if self.objects.is_empty() {
            return;
        }
        let at = out.len();
        let head = BASE_HEADER_BYTES + CONTAINER_FIELDS_BYTES;
        out.resize(at + head, 0);
        // zlib adds at most 5 bytes per 16 KiB, plus its header and trailer.
        out.reserve(self.objects.len() + self.objects.len() / 1024 + 64);
        self.compressor.reset();
        let mut done = 0;
        loop {
            let before = self.compressor.total_in();
            let status = self.compressor.compress_vec(&self.objects[done..], out, FlushCompress::Finish);
            done += (self.compressor.total_in() - before) as usize;
            match status {
                Ok(Status::Ok | Status::BufError) => out.reserve(CONTAINER_BYTES),
                // Compression in memory cannot fail.
                Ok(Status::StreamEnd) | Err(_) => break,
            }
        }
        let len = out.len() - at;
        out[at..at + 4].copy_from_slice(OBJECT_MAGIC);
        out[at + 4..at + 6].copy_from_slice(&(BASE_HEADER_BYTES as u16).to_le_bytes());
        out[at + 6..at + 8].copy_from_slice(&1_u16.to_le_bytes());
        out[at + 8..at + 12].copy_from_slice(&(len as u32).to_le_bytes());
        out[at + 12..at + 16].copy_from_slice(&LOG_CONTAINER.to_le_bytes());
        out[at + 16..at + 18].copy_from_slice(&COMPRESSION_ZLIB.to_le_bytes());
        out[at + 24..at + 28].copy_from_slice(&(self.objects.len() as u32).to_le_bytes());
        out.resize(out.len() + len % 4, 0);
        self.uncompressed_bytes += (head + self.objects.len()) as u64;
        self.objects.clear();
    }
}

impl Encode for Encoder {
    fn carries_lin(&self) -> bool {
        true
    }

    #[inline]
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut) {
        if !self.started {
            self.start(record.time_ns, out);
        }
        let offset_ns = u64::try_from(record.time_ns.saturating_sub(self.start_ns)).unwrap_or_else(|_| {
            left_out.note("times before that of the first record, which became the start");
            0
        });
        self.stop_ns = self.stop_ns.max(record.time_ns);
        let channel = u16::from(record.channel).to_le_bytes();
        match &record.event {
            TraceEvent::Frame { frame: TraceFrame::Fd(frame), direction, .. } => {
                // The data are followed by four reserved bytes.
                let mut fields = [0; 20 + 64 + 4];
                let id = frame.id();
                fields[..2].copy_from_slice(&channel);
                fields[2] = if *direction == Direction::Tx { SENT } else { 0 };
                fields[3] = frame.dlc();
                let extended = if id.is_extended() { EXTENDED } else { 0 };
                fields[4..8].copy_from_slice(&(id.raw() | extended).to_le_bytes());
                fields[13] = FD_FORMAT
                    | if frame.brs() { FD_SWITCHED_BIT_RATE } else { 0 }
                    | if frame.esi() { FD_PASSIVE_SENDER } else { 0 };
                fields[14] = frame.data_len() as u8;
                fields[20..20 + frame.data_len()].copy_from_slice(frame.data());
                self.object(CAN_FD_MESSAGE, offset_ns, &fields);
            }
            TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction, .. } => {
                let id = frame.id();
                let extended = if id.is_extended() { EXTENDED } else { 0 };
                let remote = if frame.is_remote() { REMOTE } else { 0 };
                let sent = if *direction == Direction::Tx { SENT } else { 0 };
                let mut fields = [0; 16];
                fields[..2].copy_from_slice(&channel);
                fields[2] = remote | sent;
                fields[3] = frame.dlc();
                fields[4..8].copy_from_slice(&(id.raw() | extended).to_le_bytes());
                fields[8..].copy_from_slice(&frame.padded_data());
                self.object(CAN_MESSAGE, offset_ns, &fields);
            }
            TraceEvent::BusError { kind, counters } => {
                let mut fields = [0; 32];
                fields[..2].copy_from_slice(&channel);
                if let Some(kind) = kind {
                    fields[4..8].copy_from_slice(&HAS_SJA1000_CODE.to_le_bytes());
                    fields[8] = sja1000::code(*kind);
                }
                fields[24] = OWN_MARK;
                fields[25] = kind.map_or(0, |kind| {
                    KINDS.iter().position(|known| *known == kind).map_or(0, |at| at as u8 + 1)
                });
                fields[26] = u8::from(counters.is_some());
                (fields[27], fields[28]) = counters.unwrap_or_default();
                self.object(CAN_ERROR_EXT, offset_ns, &fields);
            }
            TraceEvent::Lin { frame, direction }
                if let Some((kind, fields)) = lin::object(record.channel, frame, *direction) =>
            {
                self.object(kind, offset_ns, &fields);
            }
            event => {
                self.event_comment(record, offset_ns);
                if let TraceEvent::Lost { count, .. } = event {
                    let mut fields = [0; 16];
                    fields[4..12].copy_from_slice(&offset_ns.to_le_bytes());
                    fields[12..].copy_from_slice(&count.to_le_bytes());
                    self.object(DATA_LOST_END, offset_ns, &fields);
                }
            }
        }
        if self.objects.len() >= CONTAINER_BYTES {
            self.container(out);
        }
    }

    fn flush(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.container(out);
    }

    fn held_back(&self) -> usize {
        self.objects.len()
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        if !self.started {
            self.start(0, out);
        }
        self.container(out);
    }

    fn patch(&self, written: u64) -> Option<Patch> {
        self.started.then(|| Patch { offset: 0, bytes: self.file_header(written), missed: None })
    }

    fn whole(&self, _bytes: &[u8]) -> usize {
        // Containers before this write are whole; it is unknown whether this one is.
        0
    }
}
