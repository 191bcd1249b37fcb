//! Any bytes as MF4 files.

#![no_main]

mod trace;

use cantap_formats::Format;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| trace::read(Format::Mf4, bytes));
