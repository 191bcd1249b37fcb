//! What is said on a bus while nobody asks for it.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cantap::{Channel, TraceRecord};
use cantap_protocols::{Assembler, Event, EventKind, Protocol};
use cantap_work::bus_off::BusOffRecovery;
use cantap_work::report::Reporter;
use cantap_work::speaking::Speaking;

/// More than is kept.
const FLOOD: usize = 70_000;

/// A reader that finds a flood in each frame.
struct Flood;

impl Assembler for Flood {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        if record.frame().is_some() {
            events.extend((0..FLOOD).map(|_| Event::new(Protocol::Xcp, record, EventKind::Periodic, "DAQ")));
        }
    }

    fn finish(&mut self, _: &mut Vec<Event>) {}
}

/// A command may wait for a node for hours, or go on until Ctrl-C, while others fill the bus: what was not asked for must not fill the memory.
#[test]
fn what_waits_to_be_asked_for_is_bounded_and_what_is_left_out_is_said() {
    let device = cantap_address::open("virtual:load=1").unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    let told = Arc::new(Mutex::new(Vec::new()));
    let tell = Arc::clone(&told);
    let reporter = Reporter::new(move |_, text| tell.lock().unwrap().push(text.to_owned()));
    let recovery = BusOffRecovery::new(None, Reporter::silent());
    let on_event = Box::new(|_: &Event| Ok(()));
    let mut speaking = Speaking::new(&device, Channel::Can1, recovery, Box::new(Flood), on_event, reporter);
    let kept = loop {
        speaking.listen(Duration::from_millis(10)).unwrap();
        let events = speaking.take_events();
        if !events.is_empty() {
            break events.len();
        }
    };
    assert_eq!(kept, 1 << 16);
    let text = told.lock().unwrap().join("\n");
    assert!(text.contains("left out") && text.contains("messages before the newest 65536"), "{text}");
    // Where it is passed on as it comes, nothing is kept.
    let seen = Rc::new(Cell::new(0));
    let count = Rc::clone(&seen);
    speaking.show_as_it_comes(Box::new(move |_| {
        count.set(count.get() + 1);
        false
    }));
    while seen.get() == 0 {
        speaking.listen(Duration::from_millis(10)).unwrap();
    }
    assert!(speaking.take_events().is_empty());
}
