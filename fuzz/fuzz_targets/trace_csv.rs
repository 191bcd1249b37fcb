//! Any bytes as CSV files of any dialect.

#![no_main]

mod trace;

use cantap_formats::{CsvDialect, Format};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| trace::read(Format::Csv(CsvDialect::PythonCan), bytes));
