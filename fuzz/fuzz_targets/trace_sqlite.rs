//! Any bytes as python-can's SQLite databases. Seed it with one that python-can wrote.

#![no_main]

mod trace;

use cantap_formats::Format;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| trace::read(Format::Sqlite, bytes));
