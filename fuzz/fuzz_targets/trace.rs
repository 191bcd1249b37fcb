//! What the targets of all trace readers do with their bytes. Seeds: `host/formats/tests/data/nmea2000.log.gz` converted
//! to the format.

use std::io::Cursor;

use cantap_formats::{Format, ReadOptions, TraceReader};

/// Reads a file in every way: no panic, an end, and no more found than the file can hold.
pub fn read(format: Format, bytes: &[u8]) {
    let strict = ReadOptions { strict: true, ..ReadOptions::default() };
    let lenient = ReadOptions::default();
    let [strict, lenient] = [strict, lenient]
        .map(|options| TraceReader::from_source("fuzz", Cursor::new(bytes.to_vec()), format, &options).ok());
    let (Some(strict), Some(lenient)) = (strict, lenient) else { return };
    // The strict reader finds what the other one does, up to and with the first issue.
    let mut issues = 0_u64;
    let mut lenient = lenient.take(1 << 16);
    for item in strict.take(1 << 16) {
        let other = lenient.next().expect("a lenient reader reads at least as far");
        match (item, other) {
            (Ok(record), Ok(same)) => assert_eq!(record, same),
            (Err(issue), Err(same)) => {
                issues += 1;
                assert_eq!(issue.to_string(), same.to_string());
            }
            (item, other) => panic!("{item:?} strictly, else {other:?}"),
        }
    }
    assert!(issues <= 1, "a strict reader ends at the first issue");
    lenient.for_each(drop);
}
