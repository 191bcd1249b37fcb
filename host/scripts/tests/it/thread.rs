//! Scripts in a thread of their own, beside the one who has the device.

use std::time::Duration;

use cantap::device::Records;
use cantap::wire::message::{Periodic, TxFrame};
use cantap::{Channel, Device, TraceEvent, TraceRecord};
use cantap_scripts::{Live, Script, ScriptEvent, ScriptThread};

use super::{decoder, script};

/// The owner of a device, as the live view is one.
struct Owner {
    device: Device,
    records: Records,
    thread: ScriptThread,
    trace: Vec<TraceRecord>,
    events: Vec<ScriptEvent>,
}

impl Owner {
    fn new(options: &str, scripts: &[Script]) -> Self {
        let device = cantap_virtual::open(options.parse().unwrap()).unwrap();
        device.join(Channel::Can1, 500_000).unwrap();
        let live = Live { decoder: decoder(), seed: 1, readable: None, duration: None };
        let mut thread = ScriptThread::start(&live, &device).unwrap();
        for (place, script) in scripts.iter().enumerate() {
            assert_eq!(thread.add(script.clone()).unwrap(), place);
        }
        Self { records: device.records(), device, thread, trace: Vec::new(), events: Vec::new() }
    }

    /// Until something is so, which has to come.
    fn until(&mut self, is_so: impl Fn(&Self) -> bool) {
        while !is_so(self) {
            let batch = self.records.next_batch(Duration::from_millis(1)).unwrap().unwrap();
            self.thread.take(&batch);
            self.trace.extend(batch);
            self.thread.serve(&self.device, &mut self.events).unwrap();
        }
    }

    fn send(&self, frame: &str) {
        let frame = TxFrame { tag: 0, frame: frame.parse().unwrap(), at_ticks: None };
        self.device.send(Channel::Can1, &[frame]).unwrap();
    }

    /// How often a frame is in the trace.
    fn count(&self, frame: &str) -> usize {
        let is_it = |record: &&TraceRecord| matches!(record.event, TraceEvent::Frame { frame: own, .. } if own.to_string() == frame);
        self.trace.iter().filter(is_it).count()
    }

    fn logged(&self, text: &str) -> usize {
        let is_it =
            |events: &&ScriptEvent| matches!(events, ScriptEvent::Message(message) if message.text == text);
        self.events.iter().filter(is_it).count()
    }

    /// Frames that the device sends in 50 ms by its own clock.
    fn sent_in_a_while(&self) -> u32 {
        let status = self.device.status().unwrap();
        let until = status.ticks + u64::from(self.device.hello().tick_hz) / 20;
        while self.device.time().unwrap() < until {}
        self.device.status().unwrap().channels[0].transmitted - status.channels[0].transmitted
    }
}

#[test]
fn an_endless_loop_holds_nobody_up_and_ends_when_it_is_told_to() {
    let endless =
        script("endless", "log(\"begun\"); wait(\"1ms\"); log(\"looping\"); wait(\"1ms\"); loop {}");
    let echo = script("echo", r#"on_frame("123", |f| send(frame(0x124, f.data)));"#);
    let mut owner = Owner::new("load=0", &[endless, echo]);
    owner.until(|owner| owner.logged("looping") == 1);
    // The owner has the device all the time.
    owner.send("123#41");
    owner.until(|owner| owner.count("123#41") == 1);
    owner.thread.end(0);
    owner.until(|owner| owner.count("124#41") == 1);
    let errors =
        owner.events.iter().filter(|events| matches!(events, ScriptEvent::Ended { error: Some(_), .. }));
    assert_eq!(errors.count(), 0, "{:?}", owner.events);
    assert!(!owner.thread.is_over());
    owner.thread.end(1);
    assert!(owner.thread.is_over());
}

#[test]
fn a_script_that_is_ended_repeats_and_answers_nothing_any_more() {
    let node = script(
        "node",
        r#"
        periodic("100#01", "2ms");
        every("3ms", || send("101#02"));
        on_frame("123", |f| send("124#"));
        "#,
    );
    let other = script("other", r#"periodic("200#01", "5ms");"#);
    let mut owner = Owner::new("load=0", &[node, other]);
    owner.until(|owner| owner.count("100#01") > 3 && owner.count("101#02") > 3 && owner.count("200#01") > 3);
    owner.thread.end(0);
    owner.thread.serve(&owner.device, &mut owner.events).unwrap();
    // What the device had already is still sent.
    let others = owner.count("200#01");
    owner.until(|owner| owner.count("200#01") > others + 10);
    let before = (owner.count("100#01"), owner.count("101#02"));
    owner.send("123#");
    let others = owner.count("200#01");
    owner.until(|owner| owner.count("200#01") > others + 10);
    assert_eq!((owner.count("100#01"), owner.count("101#02"), owner.count("124#")), (before.0, before.1, 0));
    let Owner { device, thread, .. } = owner;
    thread.finish(Some(&device));
    let owner = Owner {
        records: device.records(),
        thread: ScriptThread::start(
            &Live { decoder: decoder(), seed: 1, readable: None, duration: None },
            &device,
        )
        .unwrap(),
        device,
        trace: Vec::new(),
        events: Vec::new(),
    };
    assert_eq!(owner.sent_in_a_while(), 0);
}

#[test]
fn the_owner_and_the_scripts_have_entries_of_their_own_and_hear_each_other() {
    let node = script(
        "node",
        r#"
        on_frame("100", |f| log("periodic of the owner"));
        on_frame("101", |f| log("once of the owner"));
        on_frame("300", |f| log("of itself"));
        periodic("300#", "5ms");
        "#,
    );
    let mut owner = Owner::new("load=0", &[]);
    let last = owner.device.hello().periodic_slots - 1;
    assert!(owner.thread.claim(Channel::Can1, last));
    let tick_hz = owner.device.hello().tick_hz;
    let entry = Periodic {
        frame: "100#".parse().unwrap(),
        period_ticks: tick_hz / 200,
        count: 0,
        modifiers: heapless::Vec::new(),
    };
    owner.device.set_periodic(Channel::Can1, last, Some(entry)).unwrap();
    assert_eq!(owner.thread.add(node).unwrap(), 0);
    owner.until(|owner| owner.count("300#") > 3);
    owner.send("101#");
    owner.until(|owner| owner.logged("once of the owner") == 1 && owner.logged("periodic of the owner") > 3);
    assert_eq!(owner.logged("of itself"), 0);
    // The script has the one before, and gives it back.
    assert!(!owner.thread.claim(Channel::Can1, last - 1));
    assert!(owner.thread.claim(Channel::Can1, last - 2));
    owner.thread.end(0);
    owner.until(|owner| owner.thread.claim(Channel::Can1, last - 1));
    let before = owner.count("100#");
    owner.until(|owner| owner.count("100#") > before + 3);
}

#[test]
fn what_the_device_refuses_ends_the_script_that_wants_it_and_no_other() {
    let wrong = script("wrong", r#"every("1ms", || send(2, "100#"));"#);
    let right = script("right", r#"every("2ms", || send("101#"));"#);
    let mut owner = Owner::new("load=0", &[wrong, right]);
    let is_refused = |events: &ScriptEvent| matches!(events, ScriptEvent::Refused { place: 0, .. });
    owner.until(|owner| owner.events.iter().any(is_refused));
    let before = owner.count("101#");
    owner.until(|owner| owner.count("101#") > before + 5);
    assert_eq!(owner.events.iter().filter(|events| is_refused(events)).count(), 1);
    assert!(owner.thread.add(script("bad", "let a = ;")).is_err());
}

#[test]
fn a_device_that_vanishes_is_an_error_for_the_owner() {
    let node = script("node", r#"every("1ms", || send("100#"));"#);
    let mut owner = Owner::new("load=0", &[node]);
    owner.until(|owner| owner.count("100#") > 3);
    let _ = owner.device.reset();
    let mut events = Vec::new();
    while owner.thread.serve(&owner.device, &mut events).is_ok() {
        let _ = owner.records.next_batch(Duration::from_millis(1));
    }
    // It ends all the same.
    owner.thread.finish(None);
}
