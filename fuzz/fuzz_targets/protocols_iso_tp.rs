//! Transfers of ISO 15765-2 between few identifiers, so that they collide.

#![no_main]

use cantap_fuzz::read;
use cantap_protocols::Protocol;
use cantap_wire::Id;

libfuzzer_sys::fuzz_target!(|frames: Vec<(u32, u16, Vec<u8>)>| {
    read(Protocol::IsoTp, &frames, |number| Id::standard_truncated(0x7E0 | number & 0xF));
});
