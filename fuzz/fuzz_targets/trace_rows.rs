//! Anything as a file of any format: the first byte chooses which.

#![no_main]

mod trace;

use cantap_formats::Format;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    if let Some((first, rest)) = bytes.split_first() {
        let formats: Vec<Format> = Format::all().collect();
        trace::read(formats[usize::from(*first) % formats.len()], rest);
    }
});
