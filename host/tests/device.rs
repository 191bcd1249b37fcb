//! The device handle against a hand-made device at the other end of a pipe.

use std::io::{Read, Write};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap::device::{Link, PipeReader, PipeWriter, pipe};
use cantap::wire::batch::BatchWriter;
use cantap::wire::framing::{self, CRC_LEN, MAX_ENCODED, MAX_MESSAGE, unseal};
use cantap::wire::message::{ChannelStatus, DeviceMessage, Status};
use cantap::wire::record::{ErrorState, LossStage, MAX_RECORD, encode_event, encode_received};
use cantap::wire::{
    Command, Event, Hello, PROTOCOL_VERSION, Received, Refusal, Reply, Request, Response, Stamp,
};
use cantap::{Channel, Device, DeviceError, Direction, TraceEvent, TraceRecord};

/// A device that answers as its script says and sends the batches it is given.
struct FakeDevice {
    input: PipeReader,
    output: PipeWriter,
    kept: Vec<u8>,
    batch: BatchWriter,
    status: Status,
}

fn channel_status() -> ChannelStatus {
    ChannelStatus {
        open: None,
        state: ErrorState::Active,
        tec: 0,
        rec: 0,
        last_error: None,
        frames: 0,
        lost_controller: 0,
        lost_queue: 0,
        bus_errors: 0,
        transmitted: 0,
        transmit_failures: 0,
        tx_pending: 0,
    }
}

fn hello() -> Hello {
    Hello {
        protocol: PROTOCOL_VERSION,
        firmware: [1, 2, 3],
        board: "fake".try_into().unwrap(),
        serial: "0001".try_into().unwrap(),
        channels: 2,
        tick_hz: 12_000_000,
        can_clock_hz: 36_000_000,
        queue_bytes: 98_304,
        tx_queue: 256,
        periodic_slots: 32,
        trigger_slots: 8,
        filter_banks: 28,
        capabilities: 0,
    }
}

impl FakeDevice {
    /// The two ends of a connection: ours for the host, and the device's.
    fn new() -> (Link, Self) {
        let (host_reader, output) = pipe(1 << 20);
        let (input, host_writer) = pipe(1 << 16);
        let status = Status {
            ticks: 0,
            queue_bytes: 0,
            queue_high_water_bytes: 0,
            bad_requests: 0,
            temperature_decicelsius: None,
            supply_millivolts: None,
            channels: [channel_status(); 2],
        };
        let device = Self { input, output, kept: Vec::new(), batch: BatchWriter::new(), status };
        (Link::new(host_reader, host_writer), device)
    }

    /// The next request; `None` when the host is gone.
    fn next_request(&mut self) -> Option<Request> {
        loop {
            if let Some(end) = self.kept.iter().position(|byte| *byte == 0) {
                let encoded: Vec<u8> = self.kept.drain(..=end).collect();
                if end == 0 {
                    continue;
                }
                let mut message = [0; MAX_ENCODED];
                let message = unseal(&encoded[..end], &mut message).unwrap();
                return Some(postcard::from_bytes(message).unwrap());
            }
            let mut bytes = [0; 512];
            match self.input.read(&mut bytes) {
                Ok(0) => return None,
                Ok(len) => self.kept.extend(&bytes[..len]),
                Err(_) => {}
            }
        }
    }

    fn answer(&mut self, id: u16, result: Result<Reply, Refusal>) {
        let mut message = [0; MAX_MESSAGE + CRC_LEN];
        let response = DeviceMessage::Response(Response { id, result });
        let mut out = [0; MAX_ENCODED];
        let len = framing::encode(&response, &mut message, &mut out).unwrap();
        self.output.write_all(&out[..len]).unwrap();
    }

    fn frame(&mut self, text: &str, ticks: i32, stamp: Stamp) {
        let frame = text.parse().unwrap();
        let received = Received { channel: Channel::Can1, frame, stamp, data_omitted: false };
        let mut record = [0; MAX_RECORD];
        let len = encode_received(&received, ticks, &mut record);
        assert!(self.batch.push(&record[..len], 1_000_000, Some(Channel::Can1)));
    }

    fn event(&mut self, event: &Event, ticks: i32) {
        let mut record = [0; MAX_RECORD];
        let len = encode_event(event, ticks, &mut record);
        assert!(self.batch.push(&record[..len], 1_000_000, None));
    }

    fn flush(&mut self) {
        let mut out = [0; MAX_ENCODED];
        let len = self.batch.finish(&mut out);
        self.output.write_all(&out[..len]).unwrap();
    }

    /// Drops the batch as a bad cable would.
    fn lose(&mut self) {
        self.batch.finish(&mut [0; MAX_ENCODED]);
    }

    /// Answers everything; `on_open` is called after a channel opened. Ends when the host goes, or when
    /// `on_open` says so by returning false.
    fn serve(mut self, mut on_open: impl FnMut(&mut Self) -> bool + Send + 'static) -> JoinHandle<()> {
        std::thread::spawn(move || {
            while let Some(Request { id, command }) = self.next_request() {
                match command {
                    Command::Hello { .. } => self.answer(id, Ok(Reply::Hello(hello()))),
                    Command::Time => self.answer(id, Ok(Reply::Time(1_000_000))),
                    Command::Status => self.answer(id, Ok(Reply::Status(self.status.clone()))),
                    Command::Open { channel, config } => {
                        self.status.channels[channel.index()].open = config;
                        self.answer(id, Ok(Reply::Opened(config.unwrap())));
                        if !on_open(&mut self) {
                            return;
                        }
                    }
                    Command::Close { channel } => {
                        self.answer(id, Ok(Reply::Done));
                        if self.status.channels[channel.index()].open.take().is_some() {
                            self.event(&Event::Stopped { channel }, 0);
                            self.flush();
                        }
                    }
                    _ => self.answer(id, Err(Refusal::Unsupported)),
                }
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
    let (link, fake) = FakeDevice::new();
    let served = fake.serve(|device| {
        device.frame("100#", 0, Stamp::Exact);
        // Two frames found in the FIFO: 58 bits of 12 ticks apart at least.
        device.frame("000#55", 12_000, Stamp::UpperBound);
        device.frame("000#55", 0, Stamp::UpperBound);
        device.flush();
        device.frame("101#", 12_000, Stamp::Exact);
        device.frame("102#", 12_000, Stamp::Exact);
        device.lose();
        let lost = Event::Lost { channel: Channel::Can1, stage: LossStage::Queue, count: 7, at_least: false };
        device.event(&lost, 24_000);
        device.frame("103#", 12_000, Stamp::Exact);
        device.flush();
        device.status.channels[0].frames = 13;
        device.status.channels[0].lost_queue = 7;
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
    let (link, fake) = FakeDevice::new();
    let served = fake.serve(|device| {
        device.frame("100#", 0, Stamp::Exact);
        device.flush();
        device.status.channels[0].frames = 30;
        device.status.channels[0].lost_queue = 9;
        device.status.channels[0].lost_controller = 2;
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
    let (link, fake) = FakeDevice::new();
    let served = fake.serve(|device| {
        device.frame("100#", 0, Stamp::Exact);
        device.frame("101#", 600, Stamp::Exact);
        device.flush();
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
fn something_that_is_no_device_is_told_from_one_that_vanished() {
    let (link, mut fake) = FakeDevice::new();
    let served = std::thread::spawn(move || {
        let _ = fake.output.write_all(b"\x07\x07NMEA 0183 $GPGGA,\r\n\x07");
        while fake.next_request().is_some() {}
    });
    let started = Instant::now();
    let Err(error) = Device::over(link, "fake") else { panic!("it was accepted") };
    assert!(matches!(error, DeviceError::NotCantap { .. }), "{error}");
    assert!(started.elapsed() < Duration::from_secs(4));
    served.join().unwrap();
}

#[test]
fn a_refusal_becomes_a_sentence_that_says_what_to_do() {
    let (link, fake) = FakeDevice::new();
    let served = fake.serve(|_| true);
    let device = Device::over(link, "fake").unwrap();
    let error = device.recover(Channel::Can1).unwrap_err();
    assert_eq!(error.to_string(), "the device refused: it cannot do that; `cantap info` shows what it can");
    let error = device.listen(Channel::Can1, 999_999).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the device's clock cannot be divided to 999999 bit/s; the nearest it reaches: 947368 and 1000000 bit/s"
    );
    drop(device);
    served.join().unwrap();
}
