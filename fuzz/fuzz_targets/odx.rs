//! Any bytes as a description of ECUs (ODX), and any message to what is read of it.

#![no_main]

use cantap_protocols::odx::Odx;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let (message, file) = bytes.split_at(bytes.len().min(32));
    let Ok(odx) = Odx::read("any.odx-d", file) else { return };
    let layers: Vec<_> = odx.layers().map(|(_, name)| name.to_owned()).collect();
    for ecu in layers.iter().filter_map(|name| odx.ecu(name).ok()) {
        let _ = (ecu.requests(), ecu.describe(Some(message), Some(message)), ecu.describe(None, Some(message)));
    }
});
