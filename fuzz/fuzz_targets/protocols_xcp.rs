//! The whole of XCP.

#![no_main]

use cantap_fuzz::read;
use cantap_protocols::Protocol;
use cantap_wire::Id;

libfuzzer_sys::fuzz_target!(|frames: Vec<(u32, u16, Vec<u8>)>| {
    read(Protocol::Xcp, &frames, |number| Id::standard_truncated(number));
});
