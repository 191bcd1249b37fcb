//! Any bytes as MCAP files. Seed it with `host/formats/tests/data/can_msgs_zstd.mcap`.

#![no_main]

mod trace;

use cantap_formats::Format;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| trace::read(Format::Mcap, bytes));
