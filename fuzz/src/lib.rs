//! What several targets share.

use cantap_protocols::{Event, Options, Protocol, Reader};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceRecord};
use cantap_wire::{Frame, Id};

/// A record of a frame, or of a loss if the data does not fit into a frame.
pub fn record(time_ns: i64, id: Id, data: &[u8]) -> TraceRecord {
    let frame = Frame::data_frame(id, data).map(Into::into);
    let frame = frame.or_else(|| FdFrame::new(id, false, false, data).map(Into::into));
    let event = match frame {
        Some(frame) => TraceEvent::Frame { frame, direction: Direction::Rx, late: false },
        None => TraceEvent::GAP,
    };
    TraceRecord { time_ns, device_ns: None, channel: 1, event }
}

/// Any identifier: odd numbers are extended ones.
pub fn id(number: u32) -> Id {
    if number & 1 == 0 { Id::standard_truncated(number >> 1) } else { Id::extended_truncated(number >> 1) }
}

/// Lets one protocol read frames with these identifiers, and formats its events. Every event must be of that protocol, and no later
/// than the last frame, except for timeouts.
pub fn read(protocol: Protocol, frames: &[(u32, u16, Vec<u8>)], of: impl Fn(u32) -> Id) {
    let options = Options { protocols: vec![protocol], ..Options::default() };
    let (mut reader, mut events) = (Reader::new(options), Vec::<Event>::new());
    let mut time_ns = 0_i64;
    for (number, after_100us, data) in frames {
        time_ns += i64::from(*after_100us) * 100_000;
        reader.push(&record(time_ns, of(*number), data), &mut events);
    }
    let _ = reader.under_way();
    reader.finish(&mut events);
    for event in events {
        assert_eq!(event.protocol, protocol);
        assert!(event.start_ns <= event.time_ns, "{event}");
        let _ = event.to_string();
    }
}
