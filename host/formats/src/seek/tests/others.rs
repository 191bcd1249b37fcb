//! Files that we do not write: MF4 as others lay it out, pcap.

use super::super::identity::Identity;
use super::*;
use crate::mf4::tests::any_layout::any_file;
use crate::mf4::tests::{Scattered, scattered};

fn any_scattered() -> impl Strategy<Value = Vec<u8>> {
    let frame = (
        prop_oneof![20 => 0..4_u16, 1 => 0..3000_u16],
        any::<bool>(),
        0..60_u8,
        prop::collection::vec(any::<u8>(), 0..9),
        any::<bool>(),
    );
    let frame = frame.prop_map(|(pause, is_sent, late, value, value_first)| Scattered {
        pause,
        is_sent,
        late,
        value,
        value_first,
    });
    (prop::collection::vec(frame, 0..1200), any::<bool>())
        .prop_map(|(frames, by_order)| scattered(&frames, by_order))
}

/// The packets of a capture of the interface "any".
fn any_pcap() -> impl Strategy<Value = Vec<u8>> {
    let packet = (0..3_u32, 0..1_000_000_u32, 0..4_u8, any::<[u8; 8]>(), 0..40_u8);
    prop::collection::vec(packet, 0..400).prop_map(|packets| {
        let words = |words: &[u32]| words.iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<_>>();
        let mut file = words(&[0xA1B2_C3D4, 4 << 16 | 2, 0, 0, 65_535, 276]);
        let mut seconds = 1_400_000_000;
        for (more, us, interface, data, error) in packets {
            seconds += more;
            // Now and then an error frame, which becomes two records.
            let id = if error == 0 { 0x2000_0004_u32 } else { 0x123 };
            let mut packet = vec![0, 0x0C, 0, 0, 0, 0, 0, interface + 1, 1, 18, 0, 0];
            packet.resize(20, 0);
            packet.extend(id.to_le_bytes());
            packet.extend([8, 0, 0, 0]);
            packet.extend(data);
            file.extend(words(&[seconds, us, packet.len() as u32, packet.len() as u32]));
            file.extend(packet);
        }
        file
    })
}

/// Some ranges of a file's times, read by an index and without, before and after a change.
fn check(
    format: Format,
    mut bytes: Vec<u8>,
    damage: Vec<(Any, u8)>,
    ranges: &[[(Any, i64); 2]],
    change: Option<(Any, u8)>,
) {
    let folder = tempfile::tempdir().unwrap();
    let (path, indexes) = (folder.path().join("trace"), folder.path().join("indexes"));
    for (at, value) in damage {
        let at = at.index(bytes.len());
        bytes[at] = value;
    }
    fs::write(&path, &bytes).unwrap();
    let records = open_reader(&path, &options(format, None)).unwrap().filter_map(Result::ok);
    let mut times: Vec<_> = records.map(|record| record.time_ns).collect();
    if times.is_empty() {
        times.push(0);
    }
    let point =
        |(at, more): &(Any, i64)| Some(TimePoint::At(times[at.index(times.len())].saturating_add(*more)));
    let ranges: Vec<_> = ranges.iter().map(|[start, end]| TimeRange::new(point(start), point(end))).collect();
    assert_same(&path, format, &indexes, &ranges);
    // All of it, with what the index knows of where its data is.
    assert_same(&path, format, &indexes, &[TimeRange::default()]);
    if let Some((at, value)) = change {
        let at = at.index(bytes.len());
        bytes[at] = value;
        fs::write(&path, &bytes).unwrap();
        let time = std::time::UNIX_EPOCH;
        fs::File::options().append(true).open(&path).unwrap().set_modified(time).unwrap();
        assert_same(&path, format, &indexes, &ranges);
    }
}

fn any_ranges() -> impl Strategy<Value = Vec<[(Any, i64); 2]>> {
    prop::collection::vec([(any::<Any>(), -1..2_i64), (any::<Any>(), -1..2_i64)], 1..5)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn any_layout_of_mf4_is_read_in_parts_as_in_one(
        bytes in any_file(600),
        damage in prop::collection::vec((any::<Any>(), any::<u8>()), 0..2),
        ranges in any_ranges(),
        change in prop::option::weighted(0.2, (any::<Any>(), any::<u8>())),
    ) {
        check(Format::Mf4, bytes, damage, &ranges, change);
    }

    #[test]
    fn frames_whose_bytes_are_elsewhere_and_that_are_put_in_order_are_read_in_parts_as_in_one(
        bytes in any_scattered(),
        damage in prop::collection::vec((any::<Any>(), any::<u8>()), 0..2),
        ranges in any_ranges(),
    ) {
        check(Format::Mf4, bytes, damage, &ranges, None);
    }

    #[test]
    fn a_capture_of_any_interface_is_read_in_parts_as_in_one(
        bytes in any_pcap(),
        damage in prop::collection::vec((any::<Any>(), any::<u8>()), 0..2),
        ranges in any_ranges(),
    ) {
        check(Format::Pcap, bytes, damage, &ranges, None);
    }
}

/// How many records are read of the tenth of a file in its middle.
fn handed_out(format: Format, bytes: &[u8], is_mixed: bool) -> (u64, u64) {
    let folder = tempfile::tempdir().unwrap();
    let (path, kept) = (folder.path().join("trace"), folder.path().join("indexes"));
    fs::write(&path, bytes).unwrap();
    let range = TimeRange::new(
        Some(TimePoint::AfterFirst(5_000_000_000)),
        Some(TimePoint::AfterFirst(5_100_000_000)),
    );
    let first = read(&path, &options(format, Some(&kept)), range, !is_mixed);
    let second = read(&path, &options(format, Some(&kept)), range, is_mixed);
    assert_same_items(&second, &read(&path, &options(format, None), range, is_mixed), format);
    (first.handed_out, second.handed_out)
}

/// Read with or without plain frames, whichever made the index.
#[test]
fn little_is_read_of_mf4_as_loggers_write_it() {
    let frame = |at: usize| Scattered {
        pause: 1,
        is_sent: at.is_multiple_of(7),
        late: 3,
        value: vec![at as u8; at % 9],
        value_first: at.is_multiple_of(5),
    };
    let frames: Vec<_> = (0..10_000).map(frame).collect();
    let records: Vec<_> = (0..10_000).map(|at| data_record(at * 1_000_000)).collect();
    for bytes in [scattered(&frames, false), scattered(&frames, true), file(Format::Mf4, &records)] {
        for is_mixed in [false, true] {
            let (first, second) = handed_out(Format::Mf4, &bytes, is_mixed);
            assert_eq!(first, 10_000);
            assert!((100..4_000).contains(&second), "{second}");
        }
    }
}

/// Nothing of it is compared: so the system must say that it is the same, until the end.
#[test]
fn mf4_that_changes_while_a_part_of_it_is_read_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let (path, kept) = (folder.path().join("trace"), folder.path().join("indexes"));
    let records: Vec<_> = (0..10_000).map(|at| data_record(at * 1_000_000)).collect();
    let bytes = file(Format::Mf4, &records);
    fs::write(&path, &bytes).unwrap();
    let options = options(Format::Mf4, Some(&kept));
    let mut range = TimeRange::new(Some(TimePoint::AfterFirst(9_000_000_000)), None);
    read(&path, &options, range, false);
    if Identity::of(&fs::metadata(&path).unwrap()).is_none() {
        return;
    }
    let mut reader = open_reader(&path, &options).unwrap();
    reader.within(&mut range).unwrap();
    assert!(reader.next().unwrap().unwrap().time_ns > 8_000_000_000);
    fs::File::options().append(true).open(&path).unwrap().set_modified(std::time::UNIX_EPOCH).unwrap();
    let error = reader.find_map(Result::err).unwrap().to_string();
    assert!(error.contains("has changed"), "{error}");
    assert!(indexes(&kept).is_empty());
}
