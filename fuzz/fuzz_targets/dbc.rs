//! Any bytes as a DBC file; what is accepted is compiled and decoded. Seed it with `host/signals/tests/data/dbc`.

#![no_main]

use cantap_signals::{Decoder, Source, dbc};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    if let Ok(database) = dbc::parse("fuzz.dbc", bytes) {
        let decoder = Decoder::new(vec![Source { channel: None, database }]);
        let mut values = Vec::new();
        for (message, _, _) in decoder.messages() {
            decoder.decode_data(message, &bytes[..bytes.len().min(64)], &mut values);
        }
    }
});
