//! Any bytes as a CANopen sheet: every object in it can be looked up.

#![no_main]

use cantap_protocols::canopen::eds::Eds;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let eds = Eds::parse(bytes);
    for (index, object) in &eds.objects {
        for sub in object.entries.keys() {
            assert!(eds.entry_of(*index, *sub).is_some());
            let _ = eds.value_of(*index, *sub, 5);
        }
    }
});
