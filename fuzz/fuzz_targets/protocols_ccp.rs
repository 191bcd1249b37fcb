//! The whole of CCP.

#![no_main]

use cantap_fuzz::read;
use cantap_protocols::Protocol;
use cantap_wire::Id;

libfuzzer_sys::fuzz_target!(|frames: Vec<(u32, u16, Vec<u8>)>| {
    read(Protocol::Ccp, &frames, |number| Id::standard_truncated(number));
});
