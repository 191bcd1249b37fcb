//! The device handle against a scripted device at the other end of a pipe.

use crate::fake_device;

use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap::device::{Intake, Link, UtcNs};
use cantap::wire::batch::BatchWriter;
use cantap::wire::framing::{self, CRC_LEN, MAX_ENCODED, MAX_MESSAGE};
use cantap::wire::message::DeviceMessage;
use cantap::wire::record::{LossStage, MAX_RECORD, encode_received};
use cantap::wire::{Command, Event, Hello, Received, Refusal, Reply, Request, Response, Stamp};
use cantap::{Channel, Device, DeviceError, Direction, TraceEvent, TraceRecord};
use fake_device::{FakeDevice, hello};

/// A device whose records a test writes by hand, in ticks, starting at one second.
struct Scripted(FakeDevice);

const BASE_TICKS: u64 = 1_000_000;
/// The time it reports: later than all of them.
const NOW_TICKS: u64 = 1_000_000_000;

impl Scripted {
    fn new() -> (Link, Self) {
        let (link, fake) = FakeDevice::new();
        (link, Self(fake))
    }

    fn frame(&mut self, text: &str, ticks: i64, stamp: Stamp) {
        self.0.frame(Channel::Can1, text.parse().unwrap(), stamp, ticks, BASE_TICKS);
    }

    fn event(&mut self, event: &Event, ticks: i64) {
        self.0.event(event, ticks, BASE_TICKS);
    }

    /// Answers everything; `on_open` is called after a channel opened. Ends when the host goes, or when
    /// `on_open` returns false.
    fn serve(mut self, mut on_open: impl FnMut(&mut Self) -> bool + Send + 'static) -> JoinHandle<()> {
        std::thread::spawn(move || {
            while let Some(Request { id, command }) = self.0.next_request() {
                let is_open = matches!(command, Command::Open { .. });
                match command {
                    Command::Time => self.0.answer(id, Ok(Reply::Time(NOW_TICKS))),
                    command => self.0.handle(id, &command, true),
                }
                if is_open && !on_open(&mut self) {
                    return;
                }
                self.0.flush();
            }
        })
    }
}

fn record(records: &[TraceRecord], index: usize) -> (i64, &TraceEvent) {
    (records[index].time_ns - records[0].time_ns, &records[index].event)
}

fn rx(text: &str, late: bool) -> TraceEvent {
    TraceEvent::Frame { frame: text.parse().unwrap(), direction: Direction::Rx, late }
}

#[test]
fn a_session_delivers_frames_losses_and_their_places_and_ends_cleanly() {
    let (link, fake) = Scripted::new();
    let served = fake.serve(|device| {
        device.frame("100#", 0, Stamp::Exact);
        // Two frames found in the FIFO: 58 bits of 12 ticks apart at least.
        device.frame("000#55", 12_000, Stamp::UpperBound);
        device.frame("000#55", 0, Stamp::UpperBound);
        device.0.flush();
        device.frame("101#", 12_000, Stamp::Exact);
        device.frame("102#", 12_000, Stamp::Exact);
        device.0.lose();
        let lost = Event::Lost { channel: Channel::Can1, stage: LossStage::Queue, count: 7, at_least: false };
        device.event(&lost, 24_000);
        device.frame("103#", 12_000, Stamp::Exact);
        device.0.flush();
        device.0.status.channels[0].frames = 13;
        device.0.status.channels[0].lost_queue = 7;
        true
    });
    let device = Device::over(link, "fake").unwrap();
    assert_eq!(device.hello().board, "fake");
    device.listen(Channel::Can1, 1_000_000).unwrap();
    let records = device.records();
    let status = device.stop().unwrap();
    assert_eq!(status.channels[0].lost_queue, 7);
    let records: Vec<TraceRecord> = records.map(Result::unwrap).collect();
    let lost = |stage, count| TraceEvent::Lost { stage: Some(stage), count, at_least: false };
    assert_eq!(record(&records, 0).1, &rx("100#", false));
    assert_eq!(record(&records, 1), (1_000_000 - 58_000, &rx("000#55", true)));
    assert_eq!(record(&records, 2), (1_000_000, &rx("000#55", true)));
    assert_eq!(record(&records, 3).1, &lost(LossStage::Link, 2));
    assert_eq!(record(&records, 4).1, &lost(LossStage::Queue, 7));
    assert_eq!(record(&records, 5).1, &rx("103#", false));
    assert_eq!(records.len(), 6);
    assert!(records.is_sorted_by_key(|record| record.time_ns));
    let counters = device.counters().channels[0];
    assert_eq!((counters.received, counters.lost_queue, counters.lost_link), (4, 7, 2));
    drop(device);
    served.join().unwrap();
}

#[test]
fn losses_that_went_with_the_last_batch_are_found_in_the_devices_counters() {
    let (link, fake) = Scripted::new();
    let served = fake.serve(|device| {
        device.frame("100#", 0, Stamp::Exact);
        device.0.flush();
        device.0.status.channels[0].frames = 30;
        device.0.status.channels[0].lost_queue = 9;
        device.0.status.channels[0].lost_controller = 2;
        true
    });
    let device = Device::over(link, "fake").unwrap();
    device.listen(Channel::Can1, 1_000_000).unwrap();
    device.stop().unwrap();
    let counters = device.counters().channels[0];
    assert_eq!((counters.received, counters.lost_link), (1, 20));
    assert_eq!((counters.lost_queue, counters.lost_controller), (9, 2));
    let records: Vec<TraceRecord> = device.records().map(Result::unwrap).collect();
    assert_eq!(records.len(), 4);
    drop(device);
    served.join().unwrap();
}

#[test]
fn a_device_that_vanishes_leaves_everything_received_and_then_a_clear_error() {
    let (link, fake) = Scripted::new();
    let served = fake.serve(|device| {
        device.frame("100#", 0, Stamp::Exact);
        device.frame("101#", 600, Stamp::Exact);
        device.0.flush();
        false
    });
    let device = Device::over(link, "fake").unwrap();
    device.listen(Channel::Can1, 1_000_000).unwrap();
    served.join().unwrap();
    let mut records = device.records();
    assert_eq!(records.next().unwrap().unwrap().event, rx("100#", false));
    assert_eq!(records.next().unwrap().unwrap().event, rx("101#", false));
    let error = records.next().unwrap().unwrap_err();
    assert!(error.to_string().starts_with("the device at 'fake' vanished"), "{error}");
    assert!(records.next().is_none());
    assert!(matches!(device.status(), Err(DeviceError::Vanished { .. })));
}

#[test]
fn another_version_names_the_side_to_update() {
    for (version, side) in [(0, "device's firmware"), (9, "cantap program on this computer")] {
        let (link, mut fake) = FakeDevice::new();
        let served = std::thread::spawn(move || {
            let request = fake.next_request().unwrap();
            if version == 0 {
                fake.answer(request.id, Err(Refusal::Protocol { device: version }));
            } else {
                fake.answer(request.id, Ok(Reply::Hello(Hello { protocol: version, ..hello() })));
            }
            while fake.next_request().is_some() {}
        });
        let Err(error) = Device::over(link, "fake") else { panic!("version {version} was accepted") };
        assert!(matches!(error, DeviceError::Protocol { device } if device == version));
        assert!(error.to_string().ends_with(&format!("update the {side}")), "{error}");
        served.join().unwrap();
    }
}

#[test]
fn something_that_is_no_device_is_distinguished_from_one_that_vanished() {
    let (link, mut fake) = FakeDevice::new();
    let served = std::thread::spawn(move || {
        fake.write(b"\x07\x07NMEA 0183 $GPGGA,\r\n\x07");
        while fake.next_request().is_some() {}
    });
    let started = Instant::now();
    let Err(error) = Device::over(link, "fake") else { panic!("it was accepted") };
    assert!(matches!(error, DeviceError::NotCantap { .. }), "{error}");
    assert!(started.elapsed() < Duration::from_secs(30));
    served.join().unwrap();
}

#[test]
fn a_refusal_becomes_a_sentence() {
    let (link, fake) = Scripted::new();
    let served = fake.serve(|_| true);
    let device = Device::over(link, "fake").unwrap();
    let error = device.recover(Channel::Can1).unwrap_err();
    assert_eq!(error.to_string(), "the device refused: it cannot do that");
    let error = device.listen(Channel::Can1, 999_999).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the device's clock cannot be divided to 999999 bit/s; the nearest it reaches: 947368 and 1000000 bit/s"
    );
    drop(device);
    served.join().unwrap();
}

/// Marks of USB frames begin as soon as the session does.
#[test]
fn a_sessions_first_batch_may_stand_right_behind_the_answer_to_hello() {
    let batch = |writer: &mut BatchWriter, text: &str| {
        let frame = text.parse().unwrap();
        let received = Received { channel: Channel::Can1, frame, stamp: Stamp::Exact, data_omitted: false };
        let (mut record, mut out) = ([0; MAX_RECORD], [0; MAX_ENCODED]);
        let len = encode_received(&received, 1, &mut record);
        assert!(writer.push(&record[..len], 1_000_000, Some(Channel::Can1)));
        let len = writer.finish(&mut out);
        out[..len].to_vec()
    };
    let (mut message, mut answer) = ([0; MAX_MESSAGE + CRC_LEN], [0; MAX_ENCODED]);
    let response = DeviceMessage::Response(Response { id: 1, result: Ok(Reply::Hello(hello())) });
    let len = framing::encode(&response, &mut message, &mut answer).unwrap();
    // From the session before, the answer, and the first batch of this one, in a single read.
    let mut writer = BatchWriter::new();
    let mut bytes = batch(&mut writer, "200#");
    bytes.extend(&answer[..len]);
    writer.restart();
    bytes.extend(batch(&mut writer, "100#"));
    let mut intake = Intake::new();
    let mut records: Vec<TraceRecord> = intake.push(&bytes, UtcNs(0), |_| {}).drain(..).collect();
    records.append(intake.push(&batch(&mut writer, "101#"), UtcNs(0), |_| {}));
    let events: Vec<TraceEvent> = records.into_iter().map(|record| record.event).collect();
    assert_eq!(events, [rx("100#", false), rx("101#", false)]);
    let counters = intake.counters();
    assert_eq!((counters.channels[0].received, counters.channels[0].lost_link, counters.corrupt), (2, 0, 0));
}
