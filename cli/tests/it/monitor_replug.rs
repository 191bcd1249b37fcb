//! A device is unplugged and plugged in again while the live view runs: a virtual device behind a
//! pseudo-terminal, at the end of a link with a stable name.
#![cfg(unix)]

use crate::port;
use crate::terminal;

use std::path::Path;

use cantap::wire::record::LossStage;
use cantap::{Channel, Device, TraceEvent, TraceRecord};
use cantap_formats::{ReadOptions, open_reader};
use port::Port;
use terminal::Terminal;

fn records(path: &Path) -> Vec<TraceRecord> {
    open_reader(path, &ReadOptions::default()).unwrap().map(Result::unwrap).collect()
}

/// The figure after a word on the screen.
fn figure(screen: &str, word: &str) -> Option<u64> {
    screen.split_once(word)?.1.split_whitespace().next()?.parse().ok()
}

#[test]
fn an_unplugged_device_is_missed_and_goes_on_when_it_is_back() {
    let mut port = Port::new();
    port.plug("load=20,frames=std8,serial=ONE");
    let folder = tempfile::tempdir().unwrap();
    let recording = folder.path().join("drive.asc");
    let line = format!("monitor -d {} -b 500k --view statistics -o {}", port.name(), recording.display());
    let mut view = Terminal::start(&line, (120, 40));
    view.wait_until("200 frames", |screen| figure(screen, "Frames").is_some_and(|frames| frames > 200));
    view.wait_for("Device virtual ONE");

    port.unplug();
    let gone = view.wait_for("GONE, trying again");
    assert!(gone.contains("lost ?"), "{gone}");
    let before = figure(&gone, "Frames").unwrap();
    // What was seen remains, and can be viewed.
    view.keys("2");
    view.wait_for("Period ms");
    view.keys("1");
    let trace = view.wait_for("an unknown number of frames lost (link)");
    assert!(trace.contains("ttyACM0"), "{trace}");
    view.keys("5");
    std::thread::sleep(std::time::Duration::from_millis(1500));
    port.plug("load=20,frames=std8,serial=ONE");
    view.wait_for("is back after");
    let back = view.wait_until("more frames", |screen| {
        figure(screen, "Frames").is_some_and(|frames| frames > before + 500)
    });
    // The load covers only the time in which the device was there.
    let mean = back.split_once("mean ").unwrap().1.split_once(" %").unwrap().0.parse::<f64>().unwrap();
    assert!((mean - 20.0).abs() < 1.0, "{back}");
    assert!(back.contains("1 reconnects"), "{back}");

    // A different board in its place is reported.
    port.unplug();
    view.wait_for("GONE, trying again");
    port.plug("load=20,frames=std8,serial=TWO");
    view.wait_for("another board is at");
    view.wait_for("Device virtual TWO");
    view.keys("q");
    assert_eq!(view.end(), 0);
    view.check_given_back();
    assert!(view.text().contains("records are in"), "{}", view.text());

    // The recording has everything, and both gaps on both channels, in place.
    let records = records(&recording);
    let is_gap = |record: &TraceRecord| matches!(record.event, TraceEvent::Lost { .. });
    let gaps: Vec<_> = records.iter().filter(|record| is_gap(record)).collect();
    assert_eq!(gaps.iter().map(|gap| gap.channel).collect::<Vec<_>>(), [1, 2, 1, 2]);
    for gap in gaps {
        let event = TraceEvent::Lost { stage: Some(LossStage::Link), count: 0, at_least: true };
        assert_eq!(gap.event, event);
    }
    assert!(records.windows(2).all(|pair| pair[0].time_ns <= pair[1].time_ns));
    let first = records.iter().position(is_gap).unwrap();
    let next = records[first..].iter().find(|record| record.frame().is_some()).unwrap();
    assert!(next.time_ns - records[first].time_ns > 1_000_000_000);
    assert!(records.iter().filter(|record| record.frame().is_some()).count() as u64 > 2 * before);
}

#[test]
fn what_was_sent_periodically_is_off_when_the_device_is_back() {
    let mut port = Port::new();
    port.plug("load=0");
    let line = format!("monitor -d {} -b 500k --normal --view send", port.name());
    let mut view = Terminal::start(&line, (120, 24));
    // As if pasted.
    view.wait_for("running");
    view.keys("a123#11 50ms\n");
    view.wait_for("123#11 50ms");
    view.keys(" ");
    view.wait_for("on 1 123#11");
    view.keys("2");
    view.wait_until("a sent frame", |screen| screen.contains("      123   "));
    port.unplug();
    view.wait_for("GONE, trying again");
    // Nothing can be sent meanwhile, and a message says so.
    view.keys("6\r");
    view.wait_for("there is no device to send with");
    port.plug("load=0");
    view.wait_for("nothing is sent periodically any more");
    view.keys("h");
    view.wait_for("any key closes");
    view.keys("h");
    view.wait_until("off", |screen| screen.contains("   1 123#11") && !screen.contains("on 1 123#11"));
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_device_in_use_elsewhere_and_one_that_comes_late_are_waited_for() {
    let mut port = Port::new();
    let line = format!("monitor -d {} -b 500k --view statistics", port.name());
    let mut view = Terminal::start(&line, (120, 24));
    view.wait_for("there is no device at");
    port.plug("load=20");
    view.wait_for("running");
    port.unplug();
    view.wait_for("GONE, trying again");
    // Another program is quicker. The view may have it in between, so it takes more than one try.
    let address = port.name().to_owned();
    let elsewhere = loop {
        port.plug("load=20");
        if let Ok(device) = Device::open(&address) {
            break device;
        }
        port.unplug();
        view.wait_for("GONE, trying again");
    };
    view.wait_for("is in use by another program");
    elsewhere.listen(Channel::Can1, 500_000).unwrap();
    drop(elsewhere);
    view.wait_for("running");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_device_that_vanishes_while_its_bit_rate_is_looked_for_comes_back_too() {
    let mut port = Port::new();
    // Nothing to receive, so that the search takes its time.
    port.plug("load=0,bitrate=250k");
    let line = format!("monitor -d {} -b 500k --view statistics", port.name());
    let mut view = Terminal::start(&line, (120, 24));
    view.wait_for("running");
    // It can be stopped.
    view.keys("A");
    view.wait_for("A stops");
    view.keys("A");
    view.wait_for("channel 1: stopped");
    view.wait_for("running");
    view.keys("A");
    view.wait_for("A stops");
    port.unplug();
    view.wait_for("GONE, trying again");
    port.plug("load=50,bitrate=250k");
    view.wait_for("running");
    // The first key only ends the message about the device that was gone.
    view.keys("xA");
    view.wait_for("channel 1: 250000 bit/s; channel 2: 250000 bit/s");
    view.wait_for("Channel 1: 250000 bit/s");
    // And it can be left.
    port.unplug();
    view.wait_for("GONE, trying again");
    port.plug("load=0,bitrate=250k");
    view.wait_for("running");
    view.keys("xA");
    view.wait_for("A stops");
    view.keys("q");
    assert_eq!(view.end(), 0);
}
