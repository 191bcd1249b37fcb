//! Any bytes as openpilot's logs. Seed it with `host/formats/tests/data/openpilot.rlog.gz`, unpacked.

#![no_main]

mod trace;

use cantap_formats::Format;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| trace::read(Format::Rlog, bytes));
