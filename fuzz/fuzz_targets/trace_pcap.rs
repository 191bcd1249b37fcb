//! Any bytes as pcap files.

#![no_main]

mod trace;

use cantap_formats::Format;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| trace::read(Format::Pcap, bytes));
