//! A2lDescriptions of ECUs, and the values in any memory by them.

#![no_main]

use cantap_protocols::a2l::Description;
use cantap_protocols::calibration::ByteOrder;

libfuzzer_sys::fuzz_target!(|input: (&str, u32, Vec<u8>)| {
    let (text, address, bytes) = input;
    for description in Description::parse(text).into_iter().flatten() {
        let _ = description.fields(0, address, &bytes, Some(ByteOrder::Big));
        for object in description.objects() {
            let _ = description.fields(object.extension, object.address, &bytes, None);
            let _ = object.bytes("1", Some(ByteOrder::Little));
        }
    }
});
