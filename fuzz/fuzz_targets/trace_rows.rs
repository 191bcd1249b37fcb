//! Any text as the log of another program: the first byte chooses which.

#![no_main]

mod trace;

use cantap_formats::{CsvDialect, Format};

const FORMATS: [Format; 9] = [
    Format::Csv(CsvDialect::Gvret),
    Format::CandumpScreen,
    Format::Busmaster,
    Format::Crtd,
    Format::Kvaser,
    Format::Microchip,
    Format::CanHacker,
    Format::Printer,
    Format::CanKing,
];

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    if let Some((first, rest)) = bytes.split_first() {
        trace::read(FORMATS[usize::from(*first) % FORMATS.len()], rest);
    }
});
