//! Services of OBD-II, in frames and transfers of two servers.

#![no_main]

use cantap_fuzz::read;
use cantap_protocols::Protocol;
use cantap_wire::Id;

libfuzzer_sys::fuzz_target!(|frames: Vec<(u32, u16, Vec<u8>)>| {
    read(Protocol::Obd, &frames, |number| Id::standard_truncated(0x7E0 | number & 9));
});
