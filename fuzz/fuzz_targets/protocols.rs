//! Any frames, losses among them, through every protocol at once; and any bytes as a CANopen sheet.

#![no_main]

use cantap_fuzz::{id, record};
use cantap_protocols::canopen::Sheet;
use cantap_protocols::canopen::eds::Eds;
use cantap_protocols::{Conversations, Options, Overview, Protocol, Survey};

libfuzzer_sys::fuzz_target!(|input: (Vec<u8>, Vec<(u32, u16, Vec<u8>)>)| {
    let (sheet, frames) = input;
    let sheets = vec![Sheet { node: None, eds: Eds::parse(&sheet).into() }];
    let options = Options { protocols: Protocol::ALL.to_vec(), sheets, ..Options::default() };
    let (mut conversations, mut survey, mut events) = (Conversations::new(&options), Survey::new(), Vec::new());
    let mut time_ns = 0_i64;
    for (number, after_100us, data) in frames {
        time_ns += i64::from(after_100us) * 100_000;
        let record = record(time_ns, id(number), &data);
        survey.take(&record);
        conversations.take(&record, &mut events);
    }
    let _ = conversations.under_way();
    conversations.finish(&mut events);
    let _ = survey.found();
    let mut overview = Overview::default();
    for event in events {
        overview.take(&event);
        let _ = event.to_string();
    }
});
