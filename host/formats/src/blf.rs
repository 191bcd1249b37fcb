//! Vector's BLF: objects in compressed containers after a header of 144 bytes.
//!
//! Vector publishes no description. This is based on Tobias Lorenz's vector_blf and on python-can; field names
//! follow them. The writer uses CAN_MESSAGE, CAN_FD_MESSAGE, CAN_ERROR_EXT, DATA_LOST_END, and EVENT_COMMENT for
//! anything without its own kind of object. A container that is on the disk can be read whatever happens
//! afterwards: the header's totals are only informative.

mod containers;
mod decode;
mod encode;
mod kinds;
mod lin;
mod object;
mod unpack;

pub(crate) use decode::Decoder;
pub(crate) use encode::Encoder;

/// A file's first bytes.
pub(crate) const FILE_MAGIC: &[u8; 4] = b"LOGG";
const FILE_HEADER_BYTES: usize = 144;
/// Offset of the file's length in the header.
const FILE_BYTES_OFFSET: usize = 16;
/// Offset of the time of measurement start in the header.
const START_OFFSET: usize = 40;

const OBJECT_MAGIC: &[u8; 4] = b"LOBJ";
/// Signature, header length, header version, object length, object type.
const BASE_HEADER_BYTES: usize = 16;
/// The base header with flags, client, version and time.
const HEADER_BYTES: usize = 32;
/// A container's own fields: compression, and length after decompression.
const CONTAINER_FIELDS_BYTES: usize = 16;

const TIME_IN_TEN_US: u32 = 1;
const TIME_IN_NS: u32 = 2;

const COMPRESSION_NONE: u16 = 0;
const COMPRESSION_ZLIB: u16 = 2;

const CAN_MESSAGE: u32 = 1;
const CAN_ERROR: u32 = 2;
const LOG_CONTAINER: u32 = 10;
const CAN_ERROR_EXT: u32 = 73;
const CAN_MESSAGE2: u32 = 86;
const EVENT_COMMENT: u32 = 92;
const CAN_FD_MESSAGE: u32 = 100;
const CAN_FD_MESSAGE_64: u32 = 101;
const CAN_FD_ERROR_64: u32 = 104;
const DATA_LOST_END: u32 = 126;

/// Bit 31 of an identifier.
const EXTENDED: u32 = 1 << 31;
/// A frame's flags: the low four bits are the direction (0 received, 1 sent, 2 requested to be sent).
const DIRECTION: u8 = 0x0F;
const SENT: u8 = 1;
const REQUESTED: u8 = 2;
const REMOTE: u8 = 0x80;

// A CAN FD object's own flags.
const FD_FORMAT: u8 = 1;
const FD_SWITCHED_BIT_RATE: u8 = 2;
const FD_PASSIVE_SENDER: u8 = 4;
// The longer object's.
const FD64_REMOTE: u32 = 1 << 4;
const FD64_FORMAT: u32 = 1 << 12;
const FD64_SWITCHED_BIT_RATE: u32 = 1 << 13;
const FD64_PASSIVE_SENDER: u32 = 1 << 14;

/// In an error object: the SJA1000's error code is valid.
const HAS_SJA1000_CODE: u32 = 1;
/// Ours, in the data bytes of an error object whose length is 0: this mark, then the kind from 1, whether the
/// counters are known, and the counters. Other programs ignore bytes beyond the length.
const OWN_MARK: u8 = b'c';

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::super::tests;
    use crate::{Format, WriteOptions};
    use cantap_trace::TraceRecord;
    use cantap_trace::testing::{data_record, record_lin_or_can};
    use proptest::prelude::*;

    fn file(records: &[TraceRecord]) -> Vec<u8> {
        let options = WriteOptions { format: Some(Format::Blf), ..WriteOptions::default() };
        tests::write_with(&options, records).0
    }

    proptest! {
        #[test]
        fn any_trace_in_order_round_trips(mut records in prop::collection::vec(record_lin_or_can(1), 0..20)) {
            records.sort_by_key(|record| record.time_ns);
            prop_assert_eq!(tests::round_trip(Format::Blf, &records), records);
        }
    }

    /// The file's head, without objects.
    fn head() -> Vec<u8> {
        let mut bytes = file(&[]);
        bytes.truncate(super::FILE_HEADER_BYTES);
        bytes[16..24].fill(0);
        bytes
    }

    /// A container of these bytes, compressed or not.
    fn container(bytes: &[u8], is_compressed: bool) -> Vec<u8> {
        let method = if is_compressed { super::COMPRESSION_ZLIB } else { super::COMPRESSION_NONE };
        let mut data = bytes.to_vec();
        if is_compressed {
            let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
            encoder.write_all(bytes).unwrap();
            data = encoder.finish().unwrap();
        }
        let mut container = super::OBJECT_MAGIC.to_vec();
        let len = super::BASE_HEADER_BYTES + super::CONTAINER_FIELDS_BYTES + data.len();
        container.extend([super::BASE_HEADER_BYTES as u8, 0, 1, 0]);
        container.extend((len as u32).to_le_bytes());
        container.extend(super::LOG_CONTAINER.to_le_bytes());
        container.extend(method.to_le_bytes());
        container.extend([0; 6]);
        container.extend((bytes.len() as u32).to_le_bytes());
        container.extend([0; 4]);
        container.extend(data);
        container
    }

    /// Objects of every kind that is read, mostly frames about which there is nothing else to say, with numbers that are mostly small.
    fn any_object() -> impl Strategy<Value = Vec<u8>> {
        let kind = prop::sample::select(vec![1_u32, 1, 1, 86, 86, 2, 73, 92, 100, 101, 104, 126, 10, 115]);
        let number = prop::sample::select(vec![0_u8, 0, 0, 0, 0, 1, 2, 8, 9, 0x80, 0xFF]);
        let flags = prop::sample::select(vec![0_u8, 1, 2, 2]);
        let version = prop::sample::select(vec![1_u16, 1, 1, 1, 2, 9]);
        let len = prop::sample::select(vec![16_usize, 16, 16, 16, 24, 72, 0]);
        (kind, version, prop::collection::vec(number, 72), flags, len, 0..4_usize).prop_map(
            |(kind, version, fields, flags, len, padding)| {
                let mut bytes = object(kind, version, &fields[..len]).split_off(super::FILE_HEADER_BYTES);
                bytes[16] = flags;
                bytes[24..28].copy_from_slice(&fields[..4]);
                bytes.extend(vec![0; if padding == 3 { len % 4 } else { padding }]);
                bytes
            },
        )
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1000))]

        /// Objects that continue in the next container, with and without compression, whole and damaged: plain frames are the records,
        /// which [`tests::read`] checks.
        #[test]
        fn plain_frames_are_the_records_whatever_the_objects_and_the_damage(
            objects in prop::collection::vec(any_object(), 0..40),
            containers in prop::collection::vec((any::<prop::sample::Index>(), any::<bool>()), 0..4),
            damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<bool>()), 0..4),
            keep in prop::option::weighted(0.2, any::<prop::sample::Index>()),
        ) {
            let mut objects = objects.concat();
            // Damage to what is compressed, and to the file.
            let count = objects.len();
            for (at, value, _) in damage.iter().filter(|(.., inside)| *inside && count > 0) {
                objects[at.index(count)] = *value;
            }
            let mut bytes = head();
            let mut ends: Vec<_> = containers.iter().map(|(end, _)| end.index(objects.len() + 1)).collect();
            ends.sort_unstable();
            let mut from = 0;
            for (end, (_, is_compressed)) in ends.into_iter().zip(&containers) {
                bytes.extend(container(&objects[from..end], *is_compressed));
                from = end;
            }
            // The rest without a container.
            bytes.extend(&objects[from..]);
            for (at, value, _) in damage.iter().filter(|(.., inside)| !inside) {
                let at = at.index(bytes.len());
                bytes[at] = *value;
            }
            bytes.truncate(keep.map_or(bytes.len(), |keep| keep.index(bytes.len())));
            tests::read(Format::Blf, &bytes);
        }
    }

    /// A file with a single object.
    fn object(kind: u32, header_version: u16, fields: &[u8]) -> Vec<u8> {
        let mut bytes = head();
        let len = (super::HEADER_BYTES + fields.len()) as u32;
        let mut header = [0; super::HEADER_BYTES];
        header[..4].copy_from_slice(super::OBJECT_MAGIC);
        header[4..6].copy_from_slice(&(super::HEADER_BYTES as u16).to_le_bytes());
        header[6..8].copy_from_slice(&header_version.to_le_bytes());
        header[8..12].copy_from_slice(&len.to_le_bytes());
        header[12..16].copy_from_slice(&kind.to_le_bytes());
        header[16] = super::TIME_IN_NS as u8;
        bytes.extend(header);
        bytes.extend(fields);
        bytes
    }

    #[test]
    fn what_is_not_can_is_counted_by_its_kind() {
        let options = crate::ReadOptions::default();
        let mut bytes = object(20, 1, &[0; 16]);
        for kind in [71, 71, 92, 3, 200, 115] {
            bytes.extend(&object(kind, 1, &[0; 16])[super::FILE_HEADER_BYTES..]);
        }
        let source = std::io::Cursor::new(bytes);
        let mut reader = crate::TraceReader::from_source("test", source, Format::Blf, &options).unwrap();
        assert_eq!(reader.by_ref().count(), 0);
        let expected = [
            ("CAN overload frames", 1),
            ("Ethernet frames and events", 2),
            ("LIN events other than frames", 1),
            ("comments and texts", 1),
            ("objects of other kinds", 1),
        ];
        assert_eq!(reader.left_out().iter().collect::<Vec<_>>(), expected);
    }

    /// They were counted and not kept: of both generations of objects.
    #[test]
    fn lin_frames_are_kept_with_what_was_wrong() {
        let old = |sum: u16| {
            let [low, high] = sum.to_le_bytes();
            [2, 0, 0x3C, 3, 1, 2, 3, 0, 0, 0, 0, 0, 9, 9, 9, 9, low, high, 1, 0]
        };
        let mut new = [0; 140];
        (new[12], new[37], new[38]) = (3, 0x0A, 2);
        new[112..120].copy_from_slice(&[0xAA, 0xBB, 7, 7, 7, 7, 7, 7]);
        new[120] = 0x5C;
        let mut request = new;
        request[122] = 2;
        let mut bytes = object(11, 1, &old(0xF9));
        for (kind, fields) in [
            (12, &old(0x100)[..]),
            (14, &old(0)),
            (15, &old(0)),
            (57, &new),
            (57, &request),
            (60, &new),
            (58, &new),
            (61, &new),
            (57, &new[..100]),
        ] {
            bytes.extend(&object(kind, 1, fields)[super::FILE_HEADER_BYTES..]);
        }
        let (records, issues) = tests::read(Format::Blf, bytes);
        let found: Vec<_> =
            records.iter().map(|record| format!("{} {}", record.interface(), record.event)).collect();
        assert_eq!(
            found,
            [
                "lin1 LIN frame 3C: 01 02 03, checksum F9",
                "lin1 LIN frame 3C: 01 02 03, wrong checksum",
                "lin1 LIN frame 3C: wrong response",
                "lin1 LIN frame 3C: no response",
                "lin2 LIN frame 0A: AA BB, checksum 5C",
                "lin2 LIN frame 0A: AA BB, wrong checksum 5C",
                "lin2 LIN frame 0A: no response",
                "lin2 LIN frame 0A: wrong response",
            ]
        );
        assert_eq!(issues.len(), 1, "{issues:?}");
        assert!(issues[0].contains("at least 123 bytes of fields in an object of type 57"), "{issues:?}");
    }

    #[test]
    fn channels_that_do_not_fit_and_unknown_headers_are_issues() {
        let mut message = [0; 16];
        message[..2].copy_from_slice(&300_u16.to_le_bytes());
        let (records, issues) = tests::read(Format::Blf, object(1, 1, &message));
        assert_eq!(records, []);
        assert_eq!(issues, ["test, offset 0x90: expected a channel of 0 to 255, found '300'"]);
        message[..2].copy_from_slice(&255_u16.to_le_bytes());
        assert_eq!(tests::read(Format::Blf, object(1, 1, &message)).0[0].channel, 255);
        message[..2].copy_from_slice(&0_u16.to_le_bytes());
        assert_eq!(tests::read(Format::Blf, object(1, 1, &message)).0[0].channel, 0);
        let (records, issues) = tests::read(Format::Blf, object(1, 9, &message));
        assert_eq!(records, []);
        assert_eq!(
            issues,
            ["test, offset 0x90: expected an object's header of version 1 or 2, found 'version 9'"]
        );
    }

    #[test]
    fn times_before_the_first_are_moved_and_counted() {
        let records = [data_record(5_000_000_000_000_000_000), data_record(1)];
        let options = WriteOptions { format: Some(Format::Blf), ..WriteOptions::default() };
        let (bytes, left_out) = tests::write_with(&options, &records);
        assert_eq!(tests::read(Format::Blf, bytes).0, [records[0], records[0]]);
        assert_eq!(left_out.iter().map(|(_, count)| count).collect::<Vec<_>>(), [1]);
    }

    #[test]
    fn a_cut_file_gives_everything_up_to_the_cut() {
        let records: Vec<_> = (0..20_000).map(|at| data_record(at * 1_000_003)).collect();
        let whole = file(&records);
        let (read, issues) = tests::read(Format::Blf, &whole);
        assert_eq!((read.len(), issues.len()), (20_000, 0));
        let mut most = 0;
        for cut in [whole.len() - 1, whole.len() / 2, whole.len() / 10, 200, 144, 100, 3] {
            let (read, issues) = tests::read(Format::Blf, &whole[..cut]);
            assert!(records.starts_with(&read));
            assert!(cut == 144 || issues.len() == 1, "{cut}: {issues:?}");
            most = most.max(read.len());
        }
        // The cut container yields what it has.
        assert!(most > 19_900, "{most}");
    }

    /// Found by random damage: all times silently moved to 1970.
    #[test]
    fn a_start_that_is_no_date_is_named_and_none_at_all_is_not() {
        let whole = file(&[data_record(1_410_714_882_000_000_000)]);
        let at = super::START_OFFSET;
        for (place, value) in [(at + 2, 13), (at + 3, 1), (at + 8, 24)] {
            let mut damaged = whole.clone();
            damaged[place] = value;
            let (read, issues) = tests::read(Format::Blf, &damaged);
            assert_eq!((read.len(), issues.len()), (1, 1), "{issues:?}");
            assert!(issues[0].contains("expected a date that the times count from"), "{issues:?}");
        }
        let mut without = whole.clone();
        without[at..at + 16].fill(0);
        let (read, issues) = tests::read(Format::Blf, &without);
        assert_eq!((read[0].time_ns, issues), (0, Vec::new()));
    }

    #[test]
    fn damage_costs_a_container_and_is_named() {
        let records: Vec<_> = (0..20_000).map(|at| data_record(at * 1_000_003)).collect();
        let mut bytes = file(&records);
        let second = memchr::memmem::find_iter(&bytes, b"LOBJ").nth(1).unwrap();
        bytes[second..second + 4].copy_from_slice(b"XXXX");
        let (read, issues) = tests::read(Format::Blf, &bytes);
        assert!(read.len() > 10_000 && read.len() < 20_000, "{}", read.len());
        assert_eq!(issues.len(), 1);
        assert!(issues[0].contains("expected an object that begins with LOBJ"), "{issues:?}");
        bytes[..4].copy_from_slice(b"junk");
        assert!(tests::read(Format::Blf, &bytes).1[0].contains("LOGG"));
    }
}
