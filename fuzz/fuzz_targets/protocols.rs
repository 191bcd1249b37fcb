//! Any frames, losses among them, through every protocol at once; and any bytes as a CANopen sheet.

#![no_main]

use cantap_fuzz::{id, record};
use cantap_protocols::canopen::Sheet;
use cantap_protocols::canopen::eds::Eds;
use cantap_protocols::{Options, Overview, Protocol, Reader};

libfuzzer_sys::fuzz_target!(|input: (Vec<u8>, Vec<(u32, u16, Vec<u8>)>)| {
    let (sheet, frames) = input;
    let sheets = vec![Sheet { node: None, eds: Eds::parse(&sheet).into() }];
    let options = Options { protocols: Protocol::ALL.to_vec(), sheets, ..Options::default() };
    let (mut reader, mut finder, mut events) = (Reader::new(options), Reader::new(Options::default()), Vec::new());
    let mut time_ns = 0_i64;
    for (number, after_100us, data) in frames {
        time_ns += i64::from(after_100us) * 100_000;
        let record = record(time_ns, id(number), &data);
        finder.push(&record, &mut events);
        reader.push(&record, &mut events);
    }
    let _ = reader.under_way();
    reader.finish(&mut events);
    finder.finish(&mut events);
    let mut overview = Overview::default();
    for event in events {
        overview.take(&event);
        let _ = event.to_string();
    }
});
