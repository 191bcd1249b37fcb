//! Any bytes as PEAK's TRC files of any version.

#![no_main]

mod trace;

use cantap_formats::{Format, TrcVersion};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| trace::read(Format::Trc(TrcVersion::V2_1), bytes));
