//! A trace as parts that follow each other in time and can be read independently of each other.

use std::path::Path;

use cantap_trace::PlainFrame;

use crate::{OpenError, ReadOptions, open_reader};

/// A part of a trace: what it has from one time to before another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimePart {
    /// Its first record's, in nanoseconds since 1970; `None`: the part begins with the trace.
    pub start_ns: Option<i64>,
    /// The next part's start; `None`: the part ends with the trace.
    pub end_ns: Option<i64>,
    /// How many records it has.
    pub records: u64,
}

/// Where the parts begin, as far as the trace was read.
#[derive(Default)]
struct Cuts {
    /// The first time of each part but the first, and how many records are before it.
    begins: Vec<(i64, u64, u64)>,
    records: u64,
    latest_ns: Option<i64>,
}

impl Cuts {
    /// The next record; `position` is how far the file was read, about.
    fn push(&mut self, time_ns: i64, position: u64, part_bytes: u64) {
        // What belongs before a cut by its time must be before it.
        while self.begins.last().is_some_and(|(start_ns, ..)| time_ns < *start_ns) {
            self.begins.pop();
        }
        let begin = self.begins.last().map_or(0, |(_, _, position)| *position);
        if position.saturating_sub(begin) >= part_bytes
            && self.latest_ns.is_some_and(|latest| time_ns > latest)
        {
            self.begins.push((time_ns, self.records, position));
        }
        self.latest_ns = self.latest_ns.max(Some(time_ns));
        self.records += 1;
    }

    fn parts(&self) -> Vec<TimePart> {
        let starts = std::iter::once((None, 0)).chain(self.begins.iter().map(|cut| (Some(cut.0), cut.1)));
        let ends = self.begins.iter().map(|cut| (Some(cut.0), cut.1)).chain([(None, self.records)]);
        starts
            .zip(ends)
            .map(|((start_ns, before), (end_ns, until))| TimePart {
                start_ns,
                end_ns,
                records: until - before,
            })
            .collect()
    }
}

/// Reads a trace once, and finds times that divide it: every record before such a time is also before it in the file, so that the
/// parts, read one after the other ([`TimeRange`](crate::time_range::TimeRange)), are the trace in its order. A part has `part_bytes` or more of
/// the file, about; the last one may be shorter.
///
/// With [`ReadOptions::index`] the file then has an index, by which [`TraceReader::within`](crate::TraceReader::within) goes straight to a part.
///
/// `None` if it has a single part, or is not to be divided: anything in it is wrong, it is compressed as a whole or comes from a pipe, or its format
/// can only be read from the beginning.
///
/// # Errors
///
/// The file cannot be opened.
pub fn divide(
    path: &Path,
    options: &ReadOptions,
    part_bytes: u64,
) -> Result<Option<Vec<TimePart>>, OpenError> {
    let mut reader = open_reader(path, options)?;
    if !reader.can_go_on_from_anywhere() {
        return Ok(None);
    }
    let (mut cuts, mut frames, mut records) = (Cuts::default(), Vec::<PlainFrame>::new(), Vec::new());
    let mut position = 0;
    while let Some(read) = reader.next_mixed(&mut frames, &mut records) {
        if read.is_err() {
            return Ok(None);
        }
        for time_ns in frames.iter().map(|frame| frame.time_ns) {
            cuts.push(time_ns, position, part_bytes);
        }
        for record in &records {
            cuts.push(record.time_ns, position, part_bytes);
        }
        position = reader.position();
    }
    let parts = cuts.parts();
    // Times before 1970 cannot be asked for.
    let is_divided = parts.len() > 1 && cuts.begins.iter().all(|(start_ns, ..)| *start_ns >= 0);
    Ok(is_divided.then_some(parts))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn starts(times: &[i64], part_bytes: u64) -> Vec<(Option<i64>, u64)> {
        let mut cuts = Cuts::default();
        for (at, time_ns) in times.iter().enumerate() {
            cuts.push(*time_ns, at as u64, part_bytes);
        }
        cuts.parts().iter().map(|part| (part.start_ns, part.records)).collect()
    }

    #[test]
    fn a_part_begins_where_all_before_is_earlier_and_all_behind_is_not() {
        assert_eq!(starts(&[0, 1, 2, 3, 4, 5], 2), [(None, 2), (Some(2), 2), (Some(4), 2)]);
        // Records of the same time stay together.
        assert_eq!(starts(&[0, 1, 1, 1, 2, 3], 2), [(None, 4), (Some(2), 2)]);
        // One that comes late takes back the cuts that it contradicts.
        assert_eq!(starts(&[0, 1, 2, 3, 4, 1, 6, 7], 2), [(None, 6), (Some(6), 2)]);
        assert_eq!(starts(&[5, 4, 3, 2, 1], 1), [(None, 5)]);
        assert_eq!(starts(&[], 1), [(None, 0)]);
    }

    #[test]
    fn the_parts_read_one_after_the_other_are_the_trace() {
        use crate::time_range::{TimePoint, TimeRange};

        let folder = tempfile::tempdir().unwrap();
        let trace = folder.path().join("drive.log");
        let lines: Vec<_> = (0..500)
            // Now and then one comes late.
            .map(|at| (at, if at % 50 == 49 { at - 3 } else { at }))
            .map(|(at, time)| format!("(1700000000.{time:06}) can{} 123#{at:04X}\n", at % 2))
            .collect();
        let lines = lines.concat();
        std::fs::write(&trace, lines).unwrap();
        let options = ReadOptions {
            index: Some(crate::IndexFolder::new(folder.path().join("index"))),
            ..ReadOptions::default()
        };
        let whole: Vec<_> = open_reader(&trace, &options).unwrap().map(Result::unwrap).collect();
        let parts = divide(&trace, &options, 2000).unwrap().unwrap();
        assert!(parts.len() > 4, "{parts:?}");
        let mut together = Vec::new();
        for part in &parts {
            let mut range = TimeRange::new(part.start_ns.map(TimePoint::At), part.end_ns.map(TimePoint::At));
            let mut reader = open_reader(&trace, &options).unwrap();
            reader.within(&mut range).unwrap();
            let before = together.len();
            together.extend(reader.map(Result::unwrap).filter(|record| range.contains(record)));
            assert_eq!((together.len() - before) as u64, part.records);
        }
        assert_eq!(together, whole);
    }

    #[test]
    fn what_is_damaged_or_compressed_is_not_divided() {
        let folder = tempfile::tempdir().unwrap();
        let lines: Vec<_> = (0..500).map(|at| format!("(1.{at:06}) can0 123#11\n")).collect();
        let lines = lines.concat();
        let options = ReadOptions::default();
        let bad = folder.path().join("bad.log");
        std::fs::write(&bad, format!("{lines}nonsense\n")).unwrap();
        assert_eq!(divide(&bad, &options, 2000).unwrap(), None);
        let packed = folder.path().join("packed.log.gz");
        let mut writer = crate::create_writer(&packed, &crate::WriteOptions::default()).unwrap();
        for record in open_reader(&bad, &options).unwrap().flatten() {
            writer.write(&record).unwrap();
        }
        writer.finish().unwrap();
        assert_eq!(divide(&packed, &options, 2000).unwrap(), None);
        assert!(divide(&folder.path().join("none.log"), &options, 2000).is_err());
    }
}
