//! Plain frames are what the records say, whatever the file is like.

use std::io::Cursor;

use cantap_formats::{Format, ReadOptions, TraceReader};
use cantap_trace::PlainFrame;

/// Reads bytes record by record, and with plain frames: both must find the same, in the same order, and count alike.
pub fn assert_mixed_is_the_same(format: Format, options: &ReadOptions, bytes: &[u8]) {
    let open = || TraceReader::from_source("test", Cursor::new(bytes.to_vec()), format, options).ok();
    let (Some(mut one_by_one), Some(mut mixed)) = (open(), open()) else { return };
    let (mut frames, mut records) = (Vec::new(), Vec::new());
    while let Some(read) = mixed.next_mixed(&mut frames, &mut records) {
        for frame in &frames {
            let record = one_by_one.next().and_then(Result::ok);
            assert_eq!(record.as_ref().and_then(PlainFrame::of), Some(*frame), "{format}: {record:?}");
        }
        for record in &records {
            let same = one_by_one.next().and_then(Result::ok);
            assert_eq!(same.as_ref(), Some(record), "{format}");
        }
        if let Err(issue) = read {
            let same = one_by_one.next().and_then(Result::err);
            assert_eq!(same.map(|issue| issue.to_string()), Some(issue.to_string()), "{format}");
        }
    }
    let next = one_by_one.next();
    assert!(next.is_none(), "{format}: {next:?} was not found with plain frames");
    let counts = |reader: &TraceReader| {
        let kinds = |kinds: &cantap_formats::LeftOut| format!("{:?}", kinds.iter().collect::<Vec<_>>());
        (reader.records(), reader.issues(), kinds(reader.left_out()), kinds(reader.notes()))
    };
    assert_eq!(counts(&one_by_one), counts(&mixed), "{format}");
}
