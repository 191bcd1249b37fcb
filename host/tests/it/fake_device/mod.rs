//! A scripted device at the other end of a byte stream, which answers like a real device or misbehaves on
//! request.

use std::io::{ErrorKind, Read, Write};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cantap::Channel;
use cantap::device::{Link, pipe};
use cantap::wire::batch::BatchWriter;
use cantap::wire::framing::{self, CRC_LEN, MAX_ENCODED, MAX_MESSAGE, unseal};
use cantap::wire::message::{ChannelConfig, ChannelStatus, DeviceMessage, EndReason, Status};
use cantap::wire::record::{ErrorState, MAX_RECORD, encode_event, encode_received};
use cantap::wire::{
    Command, Event, Frame, Hello, PROTOCOL_VERSION, Received, Refusal, Reply, Request, Response, Stamp,
};

const TICK_HZ: u32 = 12_000_000;
/// One frame arrives on each open channel in this time.
const FRAME_EVERY: Duration = Duration::from_millis(2);

/// What a device does wrong, from a given moment on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Fault {
    /// Nothing.
    #[default]
    None,
    /// It neither answers nor sends.
    Deaf,
    /// It keeps sending but answers nothing.
    Mute,
    /// It has lost its session and does not say so.
    SessionLost,
    /// It was suspended and resumed: after its captured frames it reports that the session has ended. Its last batch is
    /// lost.
    Suspended,
    /// It was configured again: at the next request it delivers its captured frames, reports that the session has ended, and
    /// refuses. Its last batch is lost.
    Configured,
    /// Another program has greeted it and now has the session.
    Stolen,
    /// Its batches start over.
    GoesBack,
    /// Every batch comes twice.
    Repeats,
    /// Meaningless bytes come between its messages.
    Garbage,
    /// Every answer takes 300 ms.
    Slow,
    /// Records overtake its answers about its time, as in a server that was kept waiting between the two.
    Overtaken,
    /// The record that ends a channel never comes.
    NeverStops,
    /// Its clock was set back by a second.
    SetBack,
    /// The time it reports is a second earlier than its records.
    TimeBehind,
    /// The port is gone.
    Vanishes,
}

/// What came from the host.
#[expect(clippy::large_enum_variant, reason = "one for each request, taken at once")]
pub enum Asked {
    Request(Request),
    Nothing,
    /// It has closed the port.
    Gone,
}

/// What tests ask about afterwards.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Log {
    /// Every channel that was opened, with its configuration.
    pub opened: Vec<(Channel, ChannelConfig)>,
    /// Number of requests to transmit anything.
    pub sent: u32,
}

/// The device.
pub struct FakeDevice {
    input: Box<dyn Read + Send>,
    output: Box<dyn Write + Send>,
    kept: Vec<u8>,
    batch: BatchWriter,
    pub status: Status,
    pub serial: String,
    started: Instant,
    set_back: u64,
    time_behind: u64,
    /// Its answer to `Open`, if different from the request.
    pub opens: Option<ChannelConfig>,
    /// Its description of itself.
    pub says: Hello,
    /// A number that no request of this host has.
    strangers_id: u16,
    log: Arc<Mutex<Log>>,
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

pub fn hello() -> Hello {
    Hello {
        protocol: PROTOCOL_VERSION,
        firmware: [1, 2, 3],
        board: "fake".try_into().unwrap(),
        serial: "0001".try_into().unwrap(),
        channels: 2,
        tick_hz: TICK_HZ,
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
    /// A device at the end of any stream; reading must return within a fraction of a second.
    pub fn over(input: impl Read + Send + 'static, output: impl Write + Send + 'static) -> Self {
        let status = Status {
            ticks: 0,
            queue_bytes: 0,
            queue_high_water_bytes: 0,
            bad_requests: 0,
            temperature_decicelsius: None,
            supply_millivolts: None,
            channels: [channel_status(); 2],
        };
        Self {
            input: Box::new(input),
            output: Box::new(output),
            kept: Vec::new(),
            batch: BatchWriter::new(),
            status,
            serial: "0001".to_owned(),
            started: Instant::now(),
            set_back: 0,
            time_behind: 0,
            opens: None,
            says: hello(),
            strangers_id: 0,
            log: Arc::default(),
        }
    }

    /// The two ends of a connection: ours for the host, and the device's.
    pub fn new() -> (Link, Self) {
        let (host_reader, output) = pipe(1 << 20);
        let (input, host_writer) = pipe(1 << 16);
        (Link::new(host_reader, host_writer), Self::over(input, output))
    }

    /// Sets where it logs requests.
    pub fn log_to(mut self, log: &Arc<Mutex<Log>>) -> Self {
        self.log = Arc::clone(log);
        self
    }

    /// The next request, if one arrives within a moment.
    pub fn asked(&mut self) -> Asked {
        loop {
            if let Some(end) = self.kept.iter().position(|byte| *byte == 0) {
                let encoded: Vec<u8> = self.kept.drain(..=end).collect();
                if end == 0 {
                    continue;
                }
                let mut message = [0; MAX_ENCODED];
                let message = unseal(&encoded[..end], &mut message).unwrap();
                return Asked::Request(postcard::from_bytes(message).unwrap());
            }
            let mut bytes = [0; 512];
            match self.input.read(&mut bytes) {
                Ok(0) => return Asked::Gone,
                Ok(len) => self.kept.extend(&bytes[..len]),
                Err(error) if error.kind() == ErrorKind::TimedOut => return Asked::Nothing,
                Err(error) => panic!("{error}"),
            }
        }
    }

    /// Waits for the next request; `None` when the host is gone.
    pub fn next_request(&mut self) -> Option<Request> {
        loop {
            match self.asked() {
                Asked::Request(request) => return Some(request),
                Asked::Nothing => {}
                Asked::Gone => return None,
            }
        }
    }

    /// Writes bytes as they are. A host that has gone takes none.
    pub fn write(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            match self.output.write(bytes) {
                Ok(len) => bytes = &bytes[len..],
                Err(error) if error.kind() == ErrorKind::TimedOut => {}
                Err(_) => return,
            }
        }
    }

    pub fn answer(&mut self, id: u16, result: Result<Reply, Refusal>) {
        let mut message = [0; MAX_MESSAGE + CRC_LEN];
        let response = DeviceMessage::Response(Response { id, result });
        let mut out = [0; MAX_ENCODED];
        let len = framing::encode(&response, &mut message, &mut out).unwrap();
        self.write(&out[..len]);
    }

    /// Adds a received frame to the batch, this many ticks after the record before; the first counts from `base_ticks`.
    pub fn frame(&mut self, channel: Channel, frame: Frame, stamp: Stamp, ticks: i64, base_ticks: u64) {
        let received = Received { channel, frame, stamp, data_omitted: false };
        let mut record = [0; MAX_RECORD];
        let len = encode_received(&received, ticks, &mut record);
        if !self.batch.push(&record[..len], base_ticks, Some(channel)) {
            self.flush();
            assert!(self.batch.push(&record[..len], base_ticks, Some(channel)));
        }
    }

    pub fn event(&mut self, event: &Event, ticks: i64, base_ticks: u64) {
        let mut record = [0; MAX_RECORD];
        let len = encode_event(event, ticks, &mut record);
        assert!(self.batch.push(&record[..len], base_ticks, None));
    }

    /// Sends the batch if it is not empty, and returns its bytes.
    pub fn flush(&mut self) -> Vec<u8> {
        let mut out = [0; MAX_ENCODED];
        let len = self.batch.finish(&mut out);
        self.write(&out[..len]);
        out[..len].to_vec()
    }

    /// Drops the batch, as a bad cable would.
    pub fn lose(&mut self) {
        self.batch.finish(&mut [0; MAX_ENCODED]);
    }

    /// It has been running for ten seconds when it is opened.
    fn ticks(&self) -> u64 {
        let ran = self.started.elapsed() + Duration::from_secs(10);
        (ran.as_nanos() * u128::from(TICK_HZ) / 1_000_000_000) as u64 - self.set_back
    }

    fn hello(&self) -> Hello {
        Hello { serial: self.serial.as_str().try_into().unwrap(), ..self.says.clone() }
    }

    fn begin_session(&mut self) {
        self.batch.restart();
        self.status.channels = [channel_status(); 2];
    }

    /// Carries out a request, as far as these tests need it.
    pub fn handle(&mut self, id: u16, command: &Command, says_stopped: bool) {
        let result = match command {
            Command::Hello { .. } => {
                self.begin_session();
                Ok(Reply::Hello(self.hello()))
            }
            Command::Time => Ok(Reply::Time(self.ticks() - self.time_behind)),
            Command::Status => Ok(Reply::Status(self.status.clone())),
            &Command::Open { channel, config: Some(config) } => {
                self.status.channels[channel.index()].open = Some(config);
                self.log.lock().unwrap().opened.push((channel, config));
                Ok(Reply::Opened(self.opens.unwrap_or(config)))
            }
            &Command::Close { channel } => {
                if self.status.channels[channel.index()].open.take().is_some() && says_stopped {
                    let now = self.ticks();
                    self.event(&Event::Stopped { channel }, 0, now);
                }
                Ok(Reply::Done)
            }
            Command::Send { .. } => {
                self.log.lock().unwrap().sent += 1;
                Ok(Reply::Queued { free: 256 })
            }
            Command::SetPeriodic { .. } => {
                self.log.lock().unwrap().sent += 1;
                Ok(Reply::Done)
            }
            _ => Err(Refusal::Unsupported),
        };
        self.answer(id, result);
    }

    /// A frame on each open channel, with its number as data.
    fn hear_frames(&mut self) {
        for channel in Channel::ALL {
            let status = &mut self.status.channels[channel.index()];
            if status.open.is_some() {
                let frame = format!("123#{:08X}", status.frames).parse().unwrap();
                status.frames += 1;
                let now = self.ticks();
                self.frame(channel, frame, Stamp::Exact, 0, now);
            }
        }
    }

    /// Sends frames, of which a batch is lost, and the end.
    fn end_session(&mut self, reason: EndReason) {
        self.hear_frames();
        self.lose();
        let mut out = [0; MAX_ENCODED];
        let len = self.batch.end(reason, self.ticks(), &mut out);
        self.write(&out[..len]);
    }

    /// Answers like a device, and hears a numbered frame on each open channel every [`FRAME_EVERY`]. After `frames` of them
    /// it misbehaves. Returns when the host closes the port, or when the device vanishes.
    pub fn run(&mut self, fault: Fault, frames: u32) {
        let (mut next, mut greeted, mut turned, mut told) = (Instant::now(), false, false, false);
        loop {
            let is_bad = self.status.channels.iter().any(|channel| channel.frames >= frames);
            let fault = if is_bad || turned { fault } else { Fault::None };
            if fault != Fault::None && !std::mem::replace(&mut turned, true) {
                match fault {
                    Fault::SessionLost | Fault::Configured => greeted = false,
                    Fault::Stolen => {
                        self.begin_session();
                        let strangers_id = self.strangers_id;
                        self.answer(strangers_id, Ok(Reply::Hello(self.hello())));
                    }
                    Fault::Suspended => {
                        greeted = false;
                        self.end_session(EndReason::Suspended);
                    }
                    Fault::GoesBack => self.batch.restart(),
                    Fault::SetBack => self.set_back = u64::from(TICK_HZ),
                    Fault::TimeBehind => self.time_behind = u64::from(TICK_HZ),
                    _ => {}
                }
            }
            match (self.asked(), fault) {
                (Asked::Gone, _) | (_, Fault::Vanishes) => return,
                (_, Fault::Deaf) => continue,
                (Asked::Nothing, _) | (Asked::Request(_), Fault::Mute) => {}
                (Asked::Request(Request { id, command }), _) => {
                    self.strangers_id = id.wrapping_add(0x8000);
                    if fault == Fault::Slow {
                        std::thread::sleep(Duration::from_millis(300));
                    }
                    greeted |= matches!(command, Command::Hello { .. });
                    if fault == Fault::Configured && !greeted && !std::mem::replace(&mut told, true) {
                        self.end_session(EndReason::Configured);
                    }
                    if fault == Fault::Overtaken && command == Command::Time {
                        let then = self.ticks();
                        std::thread::sleep(Duration::from_millis(300));
                        self.hear_frames();
                        self.flush();
                        self.answer(id, Ok(Reply::Time(then)));
                    } else if greeted {
                        self.handle(id, &command, fault != Fault::NeverStops);
                    } else {
                        self.answer(id, Err(Refusal::NoSession));
                    }
                }
            }
            if fault == Fault::Garbage {
                self.write(b"\x13\x02garbage\x00\xff\xff\xff\x00");
            }
            while greeted && next.elapsed() > FRAME_EVERY {
                next += FRAME_EVERY;
                self.hear_frames();
            }
            let batch = self.flush();
            if fault == Fault::Repeats {
                self.write(&batch);
            }
        }
    }
}
