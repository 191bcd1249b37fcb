//! Any bytes as the bags of ROS 1. Seed it with `host/formats/tests/data/can_msgs_lz4.bag`.

#![no_main]

mod trace;

use cantap_formats::Format;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| trace::read(Format::RosBag, bytes));
