//! Any bytes as cantap's own signal file; what is accepted is compiled and decoded.

#![no_main]

use cantap_signals::{Decoder, Source, file};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    if let Ok(database) = file::parse("fuzz.toml", bytes) {
        let decoder = Decoder::new(vec![Source { channel: None, database }]);
        let mut values = Vec::new();
        for (message, _, _) in decoder.messages() {
            decoder.decode_data(message, &bytes[..bytes.len().min(64)], &mut values);
        }
    }
});
