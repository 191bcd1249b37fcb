//! Files with groups of any layout, whole and damaged. What they contain is nobody's concern here: however they are read, it must be the same,
//! which [`tests::read`] checks.

use proptest::prelude::*;

use super::{Blocks, HEADER_AT, finish, list, packed, tests};
use crate::{Format, ReadOptions, TraceReader};

/// Where a field is: byte, bit and length in bits; and its type, as in the file.
type Place = (u32, u8, u32, u8);

#[derive(Clone, Debug)]
struct Group {
    name: &'static str,
    record_bytes: u32,
    time: Place,
    /// Seconds for each step of the time; without it, the number is seconds.
    step_s: Option<f64>,
    id: Place,
    bytes: Place,
    /// Those that a group may do without.
    others: Vec<(&'static str, Place)>,
    /// How many records its block says there are, more than it has.
    more: i64,
}

#[derive(Clone, Debug)]
struct Layout {
    groups: Vec<Group>,
    id_bytes: u8,
    /// Which group each record is of, and the numbers that fill its bytes.
    records: Vec<(u8, [u8; 12])>,
    /// Where its data are divided, and how each part is stored.
    pieces: Vec<(prop::sample::Index, u8)>,
}

/// Mostly inside a record of 32 bytes, mostly whole bytes.
fn place(bits: impl Strategy<Value = u32>) -> impl Strategy<Value = Place> {
    let kind = prop::sample::select(vec![0_u8, 0, 0, 0, 0, 0, 0, 1, 2, 4, 10]);
    (0..30_u32, prop::sample::select(vec![0_u8, 0, 0, 0, 3, 7]), bits, kind)
}

fn group() -> impl Strategy<Value = Group> {
    let names = ["CAN_DataFrame", "CAN_DataFrame", "CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame"];
    let time =
        prop::sample::select(vec![(64, 4), (64, 4), (64, 0), (32, 0), (64, 2), (32, 4), (64, 5), (40, 0)]);
    let small = [
        ("DLC", 1..9_u32),
        ("DataLength", 1..9),
        ("IDE", 1..2),
        ("EDL", 1..2),
        ("Dir", 1..2),
        ("BusChannel", 1..17),
    ];
    let others = Vec::from(small.map(|(name, bits)| prop::option::weighted(0.6, (Just(name), place(bits)))));
    (
        prop::sample::select(names.to_vec()),
        prop::sample::select(vec![32_u32, 32, 32, 24, 40, 9]),
        time,
        prop::option::of(prop::sample::select(vec![1e-9, 1e-6, 2e-9, 0.0005, 1e300, f64::NAN, -1e-9])),
        place(prop::sample::select(vec![32_u32, 32, 29, 11, 64])),
        place(prop::sample::select(vec![64_u32, 64, 64, 32, 0, 96, 512])),
        others,
        prop::sample::select(vec![0_i64, 0, 0, 0, 3, -3]),
    )
        .prop_map(|(name, record_bytes, (time_bits, time_kind), step_s, id, bytes, others, more)| {
            Group {
                name,
                record_bytes,
                time: (0, 0, time_bits, time_kind),
                step_s,
                id,
                bytes: (bytes.0, 0, bytes.2, 10),
                others: others.into_iter().flatten().collect(),
                more,
            }
        })
}

/// A file with so many records at most.
pub(crate) fn any_file(most_records: usize) -> impl Strategy<Value = Vec<u8>> {
    layout(most_records).prop_map(|layout| layout.file())
}

fn layout(most_records: usize) -> impl Strategy<Value = Layout> {
    let number = prop::sample::select(vec![0_u8, 0, 0, 0, 1, 2, 4, 8, 8, 0x3F, 0x40, 0x80, 0xFF]);
    let record = (any::<u8>(), prop::array::uniform12(number));
    (
        prop::collection::vec(group(), 1..3),
        prop::sample::select(vec![0_u8, 0, 1, 2, 8]),
        prop::collection::vec(record, 0..most_records),
        prop::collection::vec((any::<prop::sample::Index>(), 0..3_u8), 1..4),
    )
        .prop_map(|(mut groups, id_bytes, records, pieces)| {
            if id_bytes == 0 {
                groups.truncate(1);
            }
            Layout { groups, id_bytes, records, pieces }
        })
}

impl Layout {
    fn file(&self) -> Vec<u8> {
        let mut blocks = Blocks(vec![0; HEADER_AT as usize + 104]);
        let mut counts = vec![0_i64; self.groups.len()];
        let mut data = Vec::new();
        for (group, numbers) in &self.records {
            let at = usize::from(*group) % self.groups.len();
            counts[at] += 1;
            data.extend(&(at as u64 + 1).to_le_bytes()[..usize::from(self.id_bytes)]);
            data.extend(numbers.iter().cycle().take(self.groups[at].record_bytes as usize));
        }
        let mut next = 0;
        for (at, group) in self.groups.iter().enumerate().rev() {
            next = group.block(&mut blocks, at as u64 + 1, counts[at], next);
        }
        let mut ends: Vec<_> = self.pieces.iter().map(|(end, _)| end.index(data.len() + 1)).collect();
        ends.sort_unstable();
        let mut stored = Vec::new();
        let mut from = 0;
        let hows = self.pieces.iter().map(|(_, how)| *how).chain([0]);
        for (end, how) in ends.into_iter().chain([data.len()]).zip(hows) {
            let piece = &data[from..end];
            stored.push(match how {
                0 => blocks.push(*b"##DT", &[], piece),
                1 => packed(&mut blocks, *b"DT", piece, 0),
                _ => packed(&mut blocks, *b"DT", piece, self.groups[0].record_bytes as usize),
            });
            from = end;
        }
        let data = if stored.len() == 1 { stored[0] } else { list(&mut blocks, &stored) };
        finish(blocks, next, data, self.id_bytes, 0)
    }
}

impl Group {
    fn block(&self, blocks: &mut Blocks, id: u64, records: i64, next: u64) -> u64 {
        let mut channel = |next: u64, name: &str, role: [u8; 2], place: Place, links: [u64; 3]| {
            let name = blocks.text(*b"##TX", name);
            blocks.channel(next, name, role, &("", place.0, place.1, place.2, place.3), links)
        };
        let part = |name: &str| format!("{}.{name}", self.name);
        let mut parts = channel(0, &part("DataBytes"), [0, 0], self.bytes, [0; 3]);
        parts = channel(parts, &part("ID"), [0, 0], self.id, [0; 3]);
        for (name, place) in &self.others {
            parts = channel(parts, &part(name), [0, 0], *place, [0; 3]);
        }
        let frame = channel(0, self.name, [0, 0], (8, 0, 64, 10), [parts, 0, 0]);
        let conversion = self.step_s.map_or(0, |step_s| {
            let mut data = vec![1, 0, 0, 0, 0, 0, 2, 0];
            data.resize(24, 0);
            data.extend(0_f64.to_le_bytes());
            data.extend(step_s.to_le_bytes());
            blocks.push(*b"##CC", &[0; 4], &data)
        });
        let name = blocks.text(*b"##TX", "t");
        let (byte, bit, bits, kind) = self.time;
        let time = blocks.channel(frame, name, [2, 1], &("", byte, bit, bits, kind), [0, conversion, 0]);
        let mut data = id.to_le_bytes().to_vec();
        data.extend((records + self.more).max(0).to_le_bytes());
        data.extend([0, 0, b'.', 0, 0, 0, 0, 0]);
        data.extend(self.record_bytes.to_le_bytes());
        data.extend([0; 4]);
        blocks.push(*b"##CG", &[next, time, 0, 0, 0, 0], &data)
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn plain_frames_are_the_records_whatever_the_layout_and_the_damage(
        layout in layout(60),
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
        keep in prop::option::weighted(0.2, any::<prop::sample::Index>()),
    ) {
        let mut file = layout.file();
        for (at, value) in damage {
            let at = at.index(file.len());
            file[at] = value;
        }
        file.truncate(keep.map_or(file.len(), |keep| keep.index(file.len())));
        tests::read(Format::Mf4, &file);
    }
}

/// As most loggers write frames, and asammdf when it sorts them: a group of its own, its time in seconds.
#[test]
fn the_frames_of_a_sorted_group_whose_times_are_floats_are_plain_ones() {
    let group = Group {
        name: "CAN_DataFrame",
        record_bytes: 32,
        time: (0, 0, 64, 4),
        step_s: None,
        id: (8, 0, 11, 0),
        bytes: (16, 0, 64, 10),
        others: vec![("IDE", (12, 7, 1, 0)), ("DLC", (13, 0, 4, 0)), ("BusChannel", (14, 0, 8, 0))],
        more: 0,
    };
    let mut layout = Layout { groups: vec![group], id_bytes: 0, records: Vec::new(), pieces: Vec::new() };
    // A number that is the same in all bytes is a time, an identifier and a length at once.
    layout.records = (0..5000).map(|at| (0, [(at % 9) as u8; 12])).collect();
    let (records, issues) = tests::read(Format::Mf4, layout.file());
    assert_eq!((records.len(), issues.first()), (5000, None));
    let source = std::io::Cursor::new(layout.file());
    let mut reader = TraceReader::from_source("a.mf4", source, Format::Mf4, &ReadOptions::default()).unwrap();
    let (mut frames, mut records, mut plain) = (Vec::new(), Vec::new(), 0);
    while reader.next_mixed(&mut frames, &mut records).is_some() {
        plain += frames.len();
    }
    // All but the last, which nothing follows.
    assert_eq!(plain, 4999);
}

/// As a program writes them that knows no mark of 29 bits: every frame was left out.
#[test]
fn an_identifier_of_29_bits_that_is_marked_as_standard_is_read() {
    let group = Group {
        name: "CAN_DataFrame",
        record_bytes: 32,
        time: (0, 0, 64, 4),
        step_s: None,
        id: (8, 0, 29, 0),
        bytes: (16, 0, 64, 10),
        others: vec![("IDE", (12, 7, 1, 0)), ("DLC", (13, 0, 4, 0))],
        more: 0,
    };
    let records = (0..10).map(|_| (0, [7; 12])).collect();
    let layout = Layout { groups: vec![group], id_bytes: 0, records, pieces: Vec::new() };
    let (records, issues) = tests::read(Format::Mf4, layout.file());
    assert_eq!((records.len(), issues.first()), (10, None));
    let id = records[0].frame().map(|frame| frame.id().to_string());
    assert_eq!(id.as_deref(), Some("07070707"));
}
