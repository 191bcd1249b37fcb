//! Records for tests.

use std::fmt::Write as _;

use cantap_can::LossStage;
use cantap_trace::{Direction, TraceEvent, TraceRecord};

use crate::{Assembler, Event, Options, Protocol, ReadItem, Reader};

/// A frame on channel 1.
pub fn at(time_ms: f64, frame: &str) -> TraceRecord {
    let event = TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
    TraceRecord { time_ns: (time_ms * 1e6) as i64, device_ns: None, channel: 1, event }
}

/// A lost frame on channel 1.
pub fn lost(time_ms: f64) -> TraceRecord {
    let event = TraceEvent::Lost { stage: Some(LossStage::Queue), count: 1, at_least: false };
    TraceRecord { time_ns: (time_ms * 1e6) as i64, device_ns: None, channel: 1, event }
}

/// Formatted as in a frame's text.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02X}").unwrap();
        text
    })
}

/// Drops, doubles and swaps up to five frames.
pub fn disturb<T: Clone>(frames: &mut Vec<T>, random: &mut fastrand::Rng) {
    for _ in 0..random.usize(1..6) {
        let place = random.usize(0..frames.len() - 1);
        match random.u8(0..3) {
            0 => drop(frames.remove(place)),
            1 => frames.insert(place, frames[place].clone()),
            _ => frames.swap(place, place + 1),
        }
    }
}

/// The events that an assembler makes from the records.
pub fn events(mut assembler: impl Assembler, records: &[TraceRecord]) -> Vec<Event> {
    let mut events = Vec::new();
    for record in records {
        assembler.take(record, &mut events);
    }
    assembler.finish(&mut events);
    events
}

/// The same as text, for frames with times in milliseconds.
pub fn event_lines(assembler: impl Assembler, frames: &[(f64, &str)]) -> Vec<String> {
    let records: Vec<_> = frames.iter().map(|(ms, frame)| at(*ms, frame)).collect();
    events(assembler, &records).iter().map(ToString::to_string).collect()
}

/// The protocols of the events that a reader finds by itself in frames with times in milliseconds, in the order in which they begin.
pub fn found(frames: &[(f64, &str)]) -> Vec<Protocol> {
    let (mut reader, mut found) = (Reader::new(Options::default()), Vec::new());
    let records: Vec<_> = frames.iter().map(|(ms, frame)| at(*ms, frame)).collect();
    let Ok(()) = reader.take(&records, false, |read| {
        if let ReadItem::Event(event) = read
            && !found.contains(&event.protocol)
        {
            found.push(event.protocol);
        }
        Ok::<_, std::convert::Infallible>(())
    });
    found
}
