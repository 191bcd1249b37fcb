//! Transfers of DroneCAN from few senders.

#![no_main]

use cantap_fuzz::read;
use cantap_protocols::Protocol;
use cantap_wire::Id;

libfuzzer_sys::fuzz_target!(|frames: Vec<(u32, u16, Vec<u8>)>| {
    read(Protocol::DroneCan, &frames, |number| Id::extended_truncated(number & 0x1FFF_FF83));
});
