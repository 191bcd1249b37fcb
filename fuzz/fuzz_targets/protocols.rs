//! Any frames, losses among them, through every protocol at once; and any bytes as a CANopen sheet.

#![no_main]

use cantap_protocols::canopen::Sheet;
use cantap_protocols::canopen::eds::Eds;
use cantap_protocols::{Conversations, Options, Protocol, Survey};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceRecord};
use cantap_wire::{Frame, Id};

libfuzzer_sys::fuzz_target!(|input: (Vec<u8>, Vec<(u32, u16, Vec<u8>)>)| {
    let (sheet, frames) = input;
    let sheets = vec![Sheet { node: None, eds: Eds::parse(&sheet).into() }];
    let options = Options { protocols: Protocol::ALL.to_vec(), sheets, ..Options::default() };
    let (mut conversations, mut survey, mut events) = (Conversations::new(&options), Survey::new(), Vec::new());
    let mut time_ns = 0_i64;
    for (id, after_100us, data) in frames {
        time_ns += i64::from(after_100us) * 100_000;
        let id = if id & 1 == 0 { Id::standard_truncated(id >> 1) } else { Id::extended_truncated(id >> 1) };
        let frame = Frame::data_frame(id, &data).map(Into::into);
        let frame = frame.or_else(|| FdFrame::new(id, false, false, &data).map(Into::into));
        let event = match frame {
            Some(frame) => TraceEvent::Frame { frame, direction: Direction::Rx, late: false },
            None => TraceEvent::GAP,
        };
        let record = TraceRecord { time_ns, channel: 1, event };
        survey.take(&record);
        conversations.take(&record, &mut events);
    }
    conversations.finish(&mut events);
    let _ = survey.found();
    for event in events {
        let _ = event.to_string();
    }
});
