//! What the targets of all trace readers share. Seeds: `host/formats/tests/data/nmea2000.log.gz` converted to each
//! format.

#[path = "../../host/formats/tests/it/traces/mixed.rs"]
mod mixed;

use std::io::Cursor;

use cantap_formats::{Format, ReadOptions, TraceReader};

/// Reads a file in every way: it must not panic, must come to an end, must find no more than the file can hold, and the same with plain
/// frames as without them.
pub fn read(format: Format, bytes: &[u8]) {
    let strict = ReadOptions { strict: true, ..ReadOptions::default() };
    let lenient = ReadOptions::default();
    for options in [&strict, &lenient] {
        mixed::assert_mixed_is_the_same(format, options, bytes);
    }
    let [strict, lenient] = [strict, lenient]
        .map(|options| TraceReader::from_source("fuzz", Cursor::new(bytes.to_vec()), format, &options).ok());
    let (Some(strict), Some(lenient)) = (strict, lenient) else { return };
    // The strict reader finds what the lenient one does, up to and including the first issue.
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
