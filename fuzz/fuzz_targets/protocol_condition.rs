//! Any text as a condition on what frames mean, tried on any frames.

#![no_main]

use cantap_fuzz::{id, record};
use cantap_protocols::{Options, condition};
use cantap_signals::Decoder;

libfuzzer_sys::fuzz_target!(|input: (String, Vec<(u32, u16, Vec<u8>)>)| {
    let (text, frames) = input;
    let Ok(mut condition) = condition(&text, &Decoder::new(Vec::new()), &Options::default()) else { return };
    let mut time_ns = 0_i64;
    for (number, after_100us, data) in frames {
        time_ns += i64::from(after_100us) * 100_000;
        condition.holds(&record(time_ns, id(number), &data));
    }
    let _ = condition.names_without_events().count();
});
