//! Counts the records in a part of a trace: `part_of_a_trace TRACE START END [INDEXES]`. With a folder for indexes, the second time is quick.

use std::env;
use std::error::Error;
use std::time::Instant;

use cantap_formats::time_range::TimeRange;
use cantap_formats::{IndexFolder, ReadOptions, open_reader};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [trace, start, end, rest @ ..] = &arguments[..] else {
        return Err("usage: part_of_a_trace TRACE START END [INDEXES]".into());
    };
    let begin = Instant::now();
    let options = ReadOptions { index: rest.first().map(IndexFolder::new), ..ReadOptions::default() };
    let mut reader = open_reader(trace, &options)?;
    let mut range = TimeRange::new(Some(start.parse()?), Some(end.parse()?));
    reader.within(&mut range)?;
    let mut records = reader.readable();
    let inside = records.by_ref().filter(|record| range.contains(record)).count();
    let all = records.reader().records();
    println!(
        "{inside} of {all} records, {} places not read, {:.3} s",
        records.unread().issues(),
        begin.elapsed().as_secs_f64()
    );
    Ok(())
}
