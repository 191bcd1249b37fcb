//! Writes MF4: a single data group in which each record begins with its group's number, so that a file is a stream except
//! for the counts in its header. Until those are filled in, the file is marked as unfinished, as the standard provides.

use cantap_can::BusErrorKind;

use super::super::bit_rates::{self, BitRates};
use super::super::codec::Encode;
use super::super::event_text::EventText;
use super::super::left_out::LeftOut;
use super::super::output::Patch;
use super::super::writer::WriteOptions;
use super::comment::BIT_RATES;
use super::part::{OPEN_COUNTERS, OPEN_LENGTH};
use super::{
    BIT_ERROR, DEVICE_TIME, ERROR_TYPES, FILE_MAGIC, HEADER_AT, PROGRAM_NAME, UNFINISHED_MAGIC, WORDS,
};
use cantap_trace::fd::FD_MAX_BYTES;
use cantap_trace::{DeviceNs, Direction, TraceEvent, TraceFrame, TraceRecord};

/// What a stream or a compressed file lacks.
pub(crate) const COUNTS_UNTOLD: &str = "the numbers of records in its head, which only a plain file can be given afterwards; it is marked as unfinished";

/// A block's name, reserved bytes, its length, and the number of its links.
const BLOCK_HEAD_BYTES: usize = 24;

/// Offset in the identification of the flags for what must be corrected.
const UNFINISHED_AT: usize = 60;

// Types of data.
const UNSIGNED: u8 = 0;
const SIGNED: u8 = 2;
const TEXT: u8 = 7;
const BYTES: u8 = 10;

/// A field of a record: name, byte and bit, bits, type of data.
pub(super) type Part = (&'static str, u32, u8, u32, u8);

/// Length of an event's words; the longest have 58 characters.
const WORDS_BYTES: usize = 64;

const TIME_BYTES: u32 = 8;

/// Length of the device's time at the end of a record.
const DEVICE_TIME_BYTES: u32 = 8;

/// Records whose device's time has no place.
const NO_DEVICE_TIME: &str = "the device's own times, because the first record has none";

// Bits of the byte that begins with the direction.
const EDL: u8 = 1 << 1;
const BRS: u8 = 1 << 2;
const ESI: u8 = 1 << 3;

/// The fields of records of one kind, after their time.
struct Kind {
    name: &'static str,
    /// Length of a record including its time.
    bytes: u32,
    parts: &'static [Part],
}

/// The fields of a frame with this many bytes.
const fn with_bytes(bytes: u32) -> [Part; 10] {
    let mut parts = FRAME_PARTS;
    parts[9].3 = 8 * bytes;
    parts
}

const FRAME_PARTS: [Part; 10] = [
    ("BusChannel", 8, 0, 8, UNSIGNED),
    ("ID", 9, 0, 29, UNSIGNED),
    ("IDE", 12, 7, 1, UNSIGNED),
    ("Dir", 13, 0, 1, UNSIGNED),
    ("EDL", 13, 1, 1, UNSIGNED),
    ("BRS", 13, 2, 1, UNSIGNED),
    ("ESI", 13, 3, 1, UNSIGNED),
    ("DLC", 14, 0, 8, UNSIGNED),
    ("DataLength", 15, 0, 8, UNSIGNED),
    ("DataBytes", 16, 0, 0, BYTES),
];

/// The kinds; the number before a kind's records is its index here plus one.
const KINDS: [Kind; 5] = [
    Kind { name: "CAN_DataFrame", bytes: 16 + 8, parts: &with_bytes(8) },
    Kind { name: "CAN_DataFrame", bytes: 16 + 64, parts: &with_bytes(64) },
    Kind {
        name: "CAN_RemoteFrame",
        bytes: 16,
        parts: &[
            ("BusChannel", 8, 0, 8, UNSIGNED),
            ("ID", 9, 0, 29, UNSIGNED),
            ("IDE", 12, 7, 1, UNSIGNED),
            ("Dir", 13, 0, 1, UNSIGNED),
            ("DLC", 14, 0, 8, UNSIGNED),
            ("DataLength", 15, 0, 8, UNSIGNED),
        ],
    },
    Kind {
        name: "CAN_ErrorFrame",
        bytes: 10 + WORDS_BYTES as u32,
        parts: &[
            ("BusChannel", 8, 0, 8, UNSIGNED),
            ("ErrorType", 9, 0, 8, UNSIGNED),
            ("Words", 10, 0, 8 * WORDS_BYTES as u32, TEXT),
        ],
    },
    Kind {
        name: WORDS,
        bytes: 9 + WORDS_BYTES as u32,
        parts: &[("BusChannel", 8, 0, 8, UNSIGNED), ("Words", 9, 0, 8 * WORDS_BYTES as u32, TEXT)],
    },
];
const DATA: usize = 0;
const FD_DATA: usize = 1;
const REMOTE: usize = 2;
const ERROR: usize = 3;
const EVENT: usize = 4;

/// Writes MF4.
#[derive(Default)]
pub(crate) struct Encoder {
    /// The file's header, up to the first record; empty before that.
    head: Vec<u8>,
    start_ns: i64,
    /// Whether records end with the device's time: as the first one has it or not.
    has_device_time: bool,
    /// The number of records of each kind, and its position in the header.
    counts: [u64; KINDS.len()],
    count_places: [usize; KINDS.len()],
    bit_rates: BitRates,
}

/// The blocks of a header, each after those that it links to.
pub(super) struct Blocks(pub(super) Vec<u8>);

impl Blocks {
    /// Appends a block and returns its address.
    pub(super) fn push(&mut self, name: [u8; 4], links: &[u64], data: &[u8]) -> u64 {
        let at = self.0.len() as u64;
        let len = BLOCK_HEAD_BYTES + 8 * links.len() + data.len();
        self.0.extend_from_slice(&name);
        self.0.extend_from_slice(&[0; 4]);
        self.0.extend_from_slice(&(len as u64).to_le_bytes());
        self.0.extend_from_slice(&(links.len() as u64).to_le_bytes());
        for link in links {
            self.0.extend_from_slice(&link.to_le_bytes());
        }
        self.0.extend_from_slice(data);
        self.0.resize(self.0.len().next_multiple_of(8), 0);
        at
    }

    pub(super) fn text(&mut self, name: [u8; 4], text: &str) -> u64 {
        let mut data = text.as_bytes().to_vec();
        // It ends with a zero, and further zeros fill the last word.
        data.resize((data.len() + 1).next_multiple_of(8), 0);
        self.push(name, &[], &data)
    }

    /// A channel: its type and what it counts, its field, and the links that can be non-zero.
    pub(super) fn channel(
        &mut self,
        next: u64,
        name: u64,
        role: [u8; 2],
        part: &Part,
        links: [u64; 3],
    ) -> u64 {
        const BUS_EVENT: u32 = 1 << 10;
        let (_, byte, bit, bits, kind) = *part;
        let [composition, conversion, unit] = links;
        let mut data = vec![role[0], role[1], kind, bit];
        let flags = if role[0] == 0 { BUS_EVENT } else { 0 };
        for value in [byte, bits, flags, 0] {
            data.extend_from_slice(&value.to_le_bytes());
        }
        // No precision, no attachments, no limits.
        data.resize(72, 0);
        data[20] = 0xFF;
        self.push(*b"##CN", &[next, composition, name, 0, conversion, 0, unit, 0], &data)
    }
}

impl Encoder {
    /// The length of a record of this kind.
    const fn bytes(&self, kind: &Kind) -> u32 {
        kind.bytes + if self.has_device_time { DEVICE_TIME_BYTES } else { 0 }
    }

    pub(crate) fn new(options: &WriteOptions) -> Self {
        Self { bit_rates: bit_rates::known(&options.channels), ..Self::default() }
    }

    fn begin(&mut self, first_ns: i64, has_device_time: bool) {
        const UTC: u8 = 2;
        const SOURCE_BUS: u8 = 2;
        const BUS_CAN: u8 = 2;
        const BUS_EVENTS: u16 = 1 << 1 | 1 << 2;
        const LINEAR: u8 = 1;
        const MASTER_OF_TIME: [u8; 2] = [2, 1];
        const HEADER_BYTES: usize = 104;
        const GROUP_BYTES: u64 = BLOCK_HEAD_BYTES as u64 + 4 * 8 + 8;
        // A date before 1970 cannot be expressed; times before the start can.
        self.start_ns = first_ns.max(0);
        self.has_device_time = has_device_time;
        let mut blocks = Blocks(vec![0; HEADER_AT as usize + HEADER_BYTES]);
        let bus = blocks.text(*b"##TX", "CAN");
        let source = blocks.push(*b"##SI", &[bus, 0, 0], &[SOURCE_BUS, BUS_CAN, 0, 0, 0, 0, 0, 0]);
        let time = blocks.text(*b"##TX", "Timestamp");
        let unit = blocks.text(*b"##TX", "s");
        // Type, no precision, no flags, no links, two values; no range; nanoseconds as seconds.
        let mut data = vec![LINEAR, 0xFF, 0, 0, 0, 0, 2, 0];
        for value in [0.0, 0.0, 0.0, 1e-9_f64] {
            data.extend_from_slice(&value.to_le_bytes());
        }
        let conversion = blocks.push(*b"##CC", &[0; 4], &data);
        let nanoseconds = if has_device_time { blocks.text(*b"##TX", "ns") } else { 0 };
        let mut next_group = 0;
        for (at, kind) in KINDS.iter().enumerate().rev() {
            let mut next = 0;
            if has_device_time {
                let name = blocks.text(*b"##TX", &format!("{}.{DEVICE_TIME}", kind.name));
                let part = ("", kind.bytes, 0, 8 * DEVICE_TIME_BYTES, UNSIGNED);
                next = blocks.channel(0, name, [0, 0], &part, [0, 0, nanoseconds]);
            }
            for part in kind.parts.iter().rev() {
                let name = blocks.text(*b"##TX", &format!("{}.{}", kind.name, part.0));
                next = blocks.channel(next, name, [0, 0], part, [0; 3]);
            }
            let name = blocks.text(*b"##TX", kind.name);
            let all = ("", TIME_BYTES, 0, 8 * (self.bytes(kind) - TIME_BYTES), BYTES);
            let frame = blocks.channel(0, name, [0, 0], &all, [next, 0, 0]);
            let stamp = ("", 0, 0, 8 * TIME_BYTES, SIGNED);
            let first = blocks.channel(frame, time, MASTER_OF_TIME, &stamp, [0, conversion, unit]);
            // Number, count, flags, the separator in names, record size.
            let mut data = (at as u64 + 1).to_le_bytes().to_vec();
            data.extend_from_slice(&0_u64.to_le_bytes());
            data.extend_from_slice(&BUS_EVENTS.to_le_bytes());
            data.extend_from_slice(&u16::from(b'.').to_le_bytes());
            data.extend_from_slice(&[0; 4]);
            data.extend_from_slice(&self.bytes(kind).to_le_bytes());
            data.extend_from_slice(&[0; 4]);
            let links = [next_group, first, name, source, 0, 0];
            next_group = blocks.push(*b"##CG", &links, &data);
            self.count_places[at] = next_group as usize + BLOCK_HEAD_BYTES + 8 * links.len() + 8;
        }
        let version = env!("CARGO_PKG_VERSION");
        let comment = blocks.text(
            *b"##MD",
            &format!(
                "<FHcomment><TX>Written by cantap.</TX><tool_id>cantap</tool_id>\
                 <tool_vendor>The cantap developers</tool_vendor><tool_version>{version}</tool_version></FHcomment>"
            ),
        );
        let mut date = self.start_ns.to_le_bytes().to_vec();
        date.extend_from_slice(&[0, 0, 0, 0, UTC, 0, 0, 0]);
        let history = blocks.push(*b"##FH", &[0, comment], &date);
        let about = if self.bit_rates.is_empty() {
            0
        } else {
            let (tree, name) = BIT_RATES.split_once('.').unwrap_or_default();
            let rates = bit_rates::listed(&self.bit_rates);
            let text = format!(
                "<HDcomment><TX></TX><common_properties><tree name=\"{tree}\"><e name=\"{name}\" unit=\"bit/s\" \
                 type=\"string\">{rates}</e></tree></common_properties></HDcomment>"
            );
            blocks.text(*b"##MD", &text)
        };
        // The data begin after this block, which is the last one except for the data's own header.
        let data_at = blocks.0.len() as u64 + GROUP_BYTES;
        let group = blocks.push(*b"##DG", &[0, next_group, data_at, 0], &[1, 0, 0, 0, 0, 0, 0, 0]);
        blocks.push(*b"##DT", &[], &[]);
        date.resize(32, 0);
        let mut header = Blocks(Vec::new());
        header.push(*b"##HD", &[group, history, 0, 0, 0, about], &date);
        self.head = blocks.0;
        self.head[HEADER_AT as usize..][..HEADER_BYTES].copy_from_slice(&header.0);
        self.head[8..16].copy_from_slice(b"4.10    ");
        self.head[16..24].copy_from_slice(&PROGRAM_NAME);
        self.head[28..30].copy_from_slice(&410_u16.to_le_bytes());
        self.head[..8].copy_from_slice(UNFINISHED_MAGIC);
        let open = OPEN_COUNTERS | OPEN_LENGTH;
        self.head[UNFINISHED_AT..UNFINISHED_AT + 2].copy_from_slice(&open.to_le_bytes());
    }
}

impl Encode for Encoder {
    fn carries_lin(&self) -> bool {
        true
    }

    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut) {
        if self.head.is_empty() {
            self.begin(record.time_ns, record.device_ns.is_some());
            out.extend_from_slice(&self.head);
        }
        let mut begin = |kind: usize| {
            self.counts[kind] += 1;
            out.push(kind as u8 + 1);
            out.extend_from_slice(&record.time_ns.saturating_sub(self.start_ns).to_le_bytes());
            out.push(record.channel);
        };
        match &record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                let (kind, flags, bytes) = match frame {
                    TraceFrame::Fd(frame) => {
                        let flag = |is_set: bool, bit: u8| if is_set { bit } else { 0 };
                        let flags = EDL | flag(frame.brs(), BRS) | flag(frame.esi(), ESI);
                        (FD_DATA, flags, FD_MAX_BYTES)
                    }
                    TraceFrame::Classic(frame) if frame.is_remote() => (REMOTE, 0, 0),
                    TraceFrame::Classic(_) => (DATA, 0, 8),
                };
                begin(kind);
                let id = frame.id();
                let extended = if id.is_extended() { 1 << 31 } else { 0 };
                out.extend_from_slice(&(id.raw() | extended).to_le_bytes());
                out.push(flags | u8::from(*direction == Direction::Tx));
                out.push(frame.dlc());
                out.push(frame.data_len() as u8);
                let from = out.len();
                out.extend_from_slice(frame.data());
                out.resize(from + bytes, 0);
            }
            event => {
                if let TraceEvent::BusError { kind, .. } = event {
                    begin(ERROR);
                    out.push(match kind {
                        None => 0,
                        Some(BusErrorKind::BitRecessive | BusErrorKind::BitDominant) => BIT_ERROR,
                        Some(kind) => {
                            let known = ERROR_TYPES.iter().find(|(_, known)| known == kind);
                            known.map_or(0, |(number, _)| *number as u8)
                        }
                    });
                } else {
                    begin(EVENT);
                }
                let from = out.len();
                out.extend_from_slice(EventText(*event).to_string().as_bytes());
                out.resize(from + WORDS_BYTES, 0);
            }
        }
        if self.has_device_time {
            out.extend_from_slice(&DeviceNs::or_zero(record.device_ns).to_le_bytes());
        } else if record.device_ns.is_some() {
            left_out.note(NO_DEVICE_TIME);
        }
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        if self.head.is_empty() {
            self.begin(0, false);
            out.extend_from_slice(&self.head);
        }
    }

    fn patch(&self, written: u64) -> Option<Patch> {
        if self.head.is_empty() {
            return None;
        }
        let mut bytes = self.head.clone();
        bytes[..8].copy_from_slice(FILE_MAGIC);
        bytes[UNFINISHED_AT..UNFINISHED_AT + 2].fill(0);
        for (place, count) in self.count_places.iter().zip(self.counts) {
            bytes[*place..place + 8].copy_from_slice(&count.to_le_bytes());
        }
        let data_at = bytes.len() - BLOCK_HEAD_BYTES;
        let len = written - data_at as u64;
        bytes[data_at + 8..data_at + 16].copy_from_slice(&len.to_le_bytes());
        Some(Patch { offset: 0, bytes, missed: Some(COUNTS_UNTOLD) })
    }

    fn whole(&self, bytes: &[u8]) -> usize {
        let mut at = if bytes.starts_with(UNFINISHED_MAGIC) { self.head.len() } else { 0 };
        while let Some(number) = bytes.get(at) {
            let kind = usize::from(*number).checked_sub(1).and_then(|kind| KINDS.get(kind));
            let Some(end) =
                kind.map(|kind| at + 1 + self.bytes(kind) as usize).filter(|end| *end <= bytes.len())
            else {
                break;
            };
            at = end;
        }
        at.min(bytes.len())
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::tests;
    use crate::{Format, WriteOptions};
    use cantap_trace::testing::{data_record, record_lin_or_can, with_device_time};
    use cantap_trace::{Direction, TraceEvent, TraceRecord};
    use proptest::prelude::*;

    proptest! {
        /// Times go backwards and dates are before 1970; records need not be in time order.
        #[test]
        fn any_trace_round_trips(records in prop::collection::vec(record_lin_or_can(1), 0..20)) {
            prop_assert_eq!(tests::round_trip(Format::Mf4, &records), records);
        }

        /// The first record decides whether there is a place for it.
        #[test]
        fn the_devices_time_is_kept_or_counted(
            records in prop::collection::vec(with_device_time(record_lin_or_can(1)), 0..20),
        ) {
            let options = WriteOptions { format: Some(Format::Mf4), ..WriteOptions::default() };
            let (bytes, left_out) = tests::write_with(&options, &records);
            let (read, issues) = tests::read(Format::Mf4, bytes);
            prop_assert_eq!(issues, Vec::<String>::new());
            let has_place = records.first().is_some_and(|first| first.device_ns.is_some());
            let expected = records.iter().map(|record| {
                TraceRecord { device_ns: record.device_ns.filter(|_| has_place), ..*record }
            });
            prop_assert_eq!(read, expected.collect::<Vec<_>>());
            let missing = records.iter().filter(|record| record.device_ns.is_some() && !has_place).count();
            let counted = left_out.iter().filter(|(what, _)| *what == super::NO_DEVICE_TIME);
            prop_assert_eq!(counted.map(|(_, count)| count).sum::<u64>(), missing as u64);
        }
    }

    /// What other programs write is put in the order of time; ours has it as it was recorded.
    #[test]
    fn frames_of_two_kinds_that_go_back_a_little_stay_where_they_were() {
        let mut records: Vec<_> = (0..4).map(data_record).collect();
        let remote = "124#R".parse().unwrap();
        records[2].event = TraceEvent::Frame { frame: remote, direction: Direction::Rx, late: false };
        records[2].time_ns = records[0].time_ns - 1_000_000;
        assert_eq!(tests::round_trip(Format::Mf4, &records), records);
    }

    #[test]
    fn a_finished_file_counts_its_records_and_an_unfinished_one_says_so() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mf4");
        let records: Vec<_> = (0..1000).map(data_record).collect();
        let mut writer = crate::create_writer(&path, &WriteOptions::default()).unwrap();
        for record in &records {
            writer.write(record).unwrap();
        }
        assert!(writer.finish().unwrap().is_empty());
        let bytes = std::fs::read(&path).unwrap();
        assert!(bytes.starts_with(b"MDF     4.10    cantap"));
        assert_eq!(tests::read(Format::Mf4, &bytes), (records.clone(), Vec::new()));
        let options = WriteOptions { format: Some(Format::Mf4), ..WriteOptions::default() };
        let (bytes, left_out) = tests::write_with(&options, &records);
        assert!(bytes.starts_with(b"UnFinMF 4.10"));
        assert_eq!(left_out.iter().count(), 1);
        // Wherever it is cut, everything before the cut is there.
        for keep in [bytes.len() - 1, bytes.len() - 26, bytes.len() / 2] {
            let (read, issues) = tests::read(Format::Mf4, &bytes[..keep]);
            assert_eq!(issues.len(), 1, "{issues:?}");
            assert!(read.len() > 300 && read == records[..read.len()], "{}", read.len());
        }
    }
}
