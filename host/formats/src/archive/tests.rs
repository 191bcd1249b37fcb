//! Archives made here: which file is read, and what damage or malice comes to.

use super::*;

const ENTRY: &[u8] = b"PK\x01\x02";
const END: &[u8] = b"PK\x05\x06";
const END_BYTES: usize = 22;
use crate::{OpenError, ReadOptions, open_reader, open_source};
use std::io::{Cursor, Write};

/// An archive of these files, deflated if their names end in `z`.
fn archive(files: &[(&str, &[u8])]) -> Vec<u8> {
    let (mut bytes, mut directory) = (Vec::new(), Vec::new());
    for (name, content) in files {
        let (method, packed) = if name.ends_with('z') {
            let mut encoder = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::fast());
            encoder.write_all(content).unwrap();
            (8_u16, encoder.finish().unwrap())
        } else {
            (0, content.to_vec())
        };
        let mut crc = flate2::Crc::new();
        crc.update(content);
        let at = bytes.len() as u32;
        let mut fields =
            [&[20, 0, 0, 0][..], &method.to_le_bytes(), &[0; 4], &crc.sum().to_le_bytes()].concat();
        fields.extend((packed.len() as u32).to_le_bytes());
        fields.extend((content.len() as u32).to_le_bytes());
        fields.extend([(name.len() as u16).to_le_bytes(), [0; 2]].concat());
        bytes.extend([FILE, &fields, name.as_bytes(), &packed].concat());
        directory.extend([ENTRY, &[20, 0], &fields, &[0; 10], &at.to_le_bytes(), name.as_bytes()].concat());
    }
    let at = bytes.len() as u32;
    bytes.extend(&directory);
    let count = (files.len() as u16).to_le_bytes();
    let size = (directory.len() as u32).to_le_bytes();
    bytes.extend([END, &[0; 4], &count, &count, &size, &at.to_le_bytes(), &[0; 2]].concat());
    bytes
}

/// The records of an archive, and what is wrong with it; or why it is not read.
fn read(bytes: Vec<u8>) -> Result<(usize, Vec<String>), String> {
    let reader = open_source("a.zip", Cursor::new(bytes), &ReadOptions::default());
    let reader = reader.map_err(|error| error.to_string())?;
    let (mut records, mut issues) = (0, Vec::new());
    for item in reader {
        match item {
            Ok(_) => records += 1,
            Err(issue) => issues.push(issue.to_string()),
        }
    }
    Ok((records, issues))
}

fn log(lines: usize) -> Vec<u8> {
    (0..lines)
        .flat_map(|at| {
            format!("(1410714882.{at:06}) can0 18EF{:04X}#{:08X}\n", at % 97, at * 7919).into_bytes()
        })
        .collect()
}

#[test]
fn the_only_trace_is_read_and_of_several_the_named_one() {
    let log = log(1000);
    for name in ["a.log", "inside/a.logz"] {
        assert_eq!(read(archive(&[(name, &log)])), Ok((1000, vec![])), "{name}");
    }
    let beside: [(&str, &[u8]); 5] = [
        ("inside/", b""),
        ("__MACOSX/._a.log", b"x"),
        ("README.txt", b"x"),
        ("a.dbc", b"x"),
        ("a.log", &log),
    ];
    assert_eq!(read(archive(&beside)), Ok((1000, vec![])));
    let several = archive(&[("inside/a.log", &log), ("b.asc", b"x"), ("c\u{1b}[2J.trc", b"x")]);
    let error = read(several.clone()).unwrap_err();
    assert_eq!(
        error,
        "a.zip has several files; name the one to read: a.zip/inside/a.log, a.zip/b.asc, a.zip/c\u{fffd}[2J.trc"
    );
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.zip");
    std::fs::write(&path, several).unwrap();
    let reader = open_reader(path.join("inside/a.log"), &ReadOptions::default()).unwrap();
    assert_eq!(reader.flatten().count(), 1000);
    let error = open_reader(path.join("d.log"), &ReadOptions::default()).err().unwrap();
    assert!(
        matches!(&error, OpenError::Archive(ArchiveError::Missing { member, .. }) if member == "d.log"),
        "{error}"
    );
    std::fs::write(&path, &log).unwrap();
    let error = open_reader(path.join("d.log"), &ReadOptions::default()).err().unwrap();
    assert!(error.to_string().ends_with("a.zip is no ZIP archive, so nothing in it can be named"), "{error}");
}

#[test]
fn what_is_no_trace_is_named() {
    let sheet = archive(&[("[Content_Types].xml", b"<x/>"), ("xl/workbook.xml", b"<x/>")]);
    assert!(read(sheet).unwrap_err().contains("a spreadsheet or document"));
    assert_eq!(read(archive(&[])).unwrap_err(), "a.zip is an archive without files");
    let mut encrypted = archive(&[("a.log", b"x")]);
    let entry = memchr::memmem::find(&encrypted, ENTRY).unwrap();
    encrypted[entry + 8] = 1;
    assert!(read(encrypted.clone()).unwrap_err().starts_with("a.zip/a.log is encrypted"));
    encrypted[entry + 8..entry + 11].copy_from_slice(&[0, 0, 14]);
    assert!(read(encrypted).unwrap_err().starts_with("a.zip/a.log is packed by method 14"));
}

#[test]
fn a_cut_archive_gives_what_there_is_of_its_first_file() {
    let log = log(40_000);
    for (name, least) in [("a.log", 9_900), ("a.logz", 5_000)] {
        let whole = archive(&[(name, &log)]);
        let (records, issues) = read(whole[..whole.len() / 4].to_vec()).unwrap();
        assert!(records >= least && issues.len() <= 2, "{name}: {records} {issues:?}");
        assert!(issues.last().unwrap().contains("the file ends inside the compressed data"), "{issues:?}");
    }
    assert!(read(b"PK\x03\x04".to_vec()).is_err());
}

/// Nobody gets a record that the file does not have, and nobody a panic.
#[test]
fn damage_is_noticed() {
    let log = log(50);
    let mut random = fastrand::Rng::with_seed(7);
    for name in ["a.log", "a.logz"] {
        let whole = archive(&[(name, &log)]);
        for _ in 0..2000 {
            let mut damaged = whole.clone();
            let at = random.usize(..whole.len());
            damaged[at] ^= random.u8(1..);
            let content = memchr::memmem::find(&whole, ENTRY).unwrap();
            if let Ok((records, issues)) = read(damaged) {
                // Only what the content's check covers.
                assert!(at >= content || at < 60 || !issues.is_empty() || records == 50, "{name} {at}");
            }
        }
    }
}

#[test]
fn hostile_directories_take_no_memory() {
    let log = log(10);
    let mut bytes = archive(&[("a.log", &log)]);
    let end = bytes.len() - END_BYTES;
    // A directory of 4 GiB less a byte, which ends where the archive does, and one at an address beyond the file.
    bytes[end + 12..end + 16].copy_from_slice(&0xFFFF_FFFE_u32.to_le_bytes());
    assert_eq!(read(bytes.clone()), Ok((10, vec![])));
    bytes[end + 12..end + 20].copy_from_slice(&[100, 0, 0, 0, 0xFE, 0xFF, 0xFF, 0x7F]);
    assert!(read(bytes.clone()).unwrap_err().contains("its directory is not whole"));
    // A longer end, which is missing.
    bytes[end + 12..end + 16].copy_from_slice(&[0xFF; 4]);
    assert!(read(bytes).unwrap_err().contains("a.zip is damaged"));
    // A large one without content.
    let mut bytes = archive(&[("a.log", &log)]);
    let (end, size) = (bytes.split_off(bytes.len() - END_BYTES), DIRECTORY_BYTES as usize + 1);
    let directory = memchr::memmem::find(&bytes, ENTRY).unwrap();
    bytes.resize(directory + size, 0);
    bytes.extend([&end[..12], &(size as u32).to_le_bytes(), &end[16..]].concat());
    assert!(read(bytes).unwrap_err().contains("larger than 16 MiB"));
}

/// Numbers of 64 bits, as for a file above 4 GiB: in an extra field of the entry, and in a second end.
#[test]
fn an_archive_with_long_numbers_is_read() {
    let log = log(10);
    let plain = archive(&[("a.log", &log)]);
    let (at, end) = (memchr::memmem::find(&plain, ENTRY).unwrap(), plain.len() - END_BYTES);
    let (mut bytes, mut entry, mut end) =
        (plain[..at].to_vec(), plain[at..end].to_vec(), plain[end..].to_vec());
    let len = (log.len() as u64).to_le_bytes();
    entry[20..28].fill(0xFF);
    entry[30] = 28;
    entry[42..46].fill(0xFF);
    entry.extend([&[1, 0, 24, 0][..], &len, &len, &0_u64.to_le_bytes()].concat());
    let long_at = (at + entry.len()) as u64;
    bytes.extend(&entry);
    bytes.extend([&b"PK\x06\x06"[..], &44_u64.to_le_bytes(), &[45, 0, 45, 0], &[0; 8]].concat());
    for number in [1, 1, entry.len() as u64, at as u64] {
        bytes.extend(number.to_le_bytes());
    }
    bytes.extend([&b"PK\x06\x07"[..], &[0; 4], &long_at.to_le_bytes(), &[1, 0, 0, 0]].concat());
    end[8..20].fill(0xFF);
    bytes.extend(&end);
    assert_eq!(read(bytes), Ok((10, vec![])));
}

/// An installer that unpacks itself, and a log that was written in front by mistake: places count from the archive's first byte.
#[test]
fn an_archive_behind_something_else_is_found_where_it_is_taken_for_one() {
    let log = log(10);
    let whole = [&b"PK\x03\x04 not a file"[..], &archive(&[("a.log", &log)])].concat();
    assert_eq!(read(whole), Ok((10, vec![])));
}

/// Its check does not fit: what was unpacked is still read, and that it does not fit is said.
#[test]
fn a_file_whose_check_does_not_fit_is_read_to_its_end() {
    for name in ["a.log", "a.logz"] {
        let mut bytes = archive(&[(name, &log(10))]);
        let entry = memchr::memmem::find(&bytes, ENTRY).unwrap();
        bytes[entry + 16] ^= 1;
        let (records, issues) = read(bytes).unwrap();
        assert_eq!((records, issues.len()), (10, 1), "{issues:?}");
    }
}
