//! A session that only listens, for programs that move the bytes themselves and have no threads, as a page in a browser does.
//!
//! [`Listener`] does no I/O and reads no clock: it is given what the device sent, and the time, and says what to write. It is otherwise what
//! [`Device`](crate::Device) is: the greeting, the device's time, the checks of its answers, the losses, and the end. It can open a channel
//! in no other mode than listen-only, and has no request that sends a frame.

mod step;

use std::time::Duration;

use cantap_wire::message::{ChannelConfig, Mode, Status, capability};
use cantap_wire::{
    BitTiming, CHANNELS, Channel, Command, Hello, PROTOCOL_VERSION, Refusal, Reply, Request, Response,
};

use crate::device::{
    ClockReport, Counters, DeviceError, Intake, Notice, PIECE_BYTES, Ticks, UtcNs, unaccounted,
};
use crate::session::{
    HELLO_TIMEOUT, HELLO_TRIES, LONGEST_PASS, Next, SessionOver, SilenceWatch, believe, clean, encode,
    over_by,
};
use crate::{TraceEvent, TraceRecord};
pub use step::Stage;
use step::{Asked, Purpose, Step};

/// Time limit for a request.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(2);
/// Round trips that set the clock at the beginning.
const CLOCK_ROUNDS: u32 = 8;
/// How often the device's status is asked for.
const STATUS_EVERY: Duration = Duration::from_secs(1);
/// At the end, the last records are given up if none has arrived for this long.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);

/// A session that only listens; see the [module](self).
pub struct Listener {
    name: String,
    bitrates_bps: [Option<u32>; CHANNELS],
    step: Step,
    intake: Intake,
    records: Vec<TraceRecord>,
    output: Vec<u8>,
    asked: Vec<Asked>,
    first_id: u16,
    next_id: u16,
    hello: Option<Hello>,
    status: Option<Status>,
    /// Opened with these, as the device confirmed.
    open: [Option<ChannelConfig>; CHANNELS],
    /// Channels that the device was asked to open, whatever came of it.
    may_be_open: [bool; CHANNELS],
    stopped: [bool; CHANNELS],
    error: Option<DeviceError>,
    watch: SilenceWatch,
    passed_at: UtcNs,
    /// How long the step, and the next question for the status, have waited.
    waited: Duration,
    since_status: Duration,
    heard_at: UtcNs,
    ended_at: Option<UtcNs>,
    /// Of the last record.
    latest_ns: i64,
}

impl Listener {
    /// Begins with the greeting. `bitrates_bps`: of the channels that are opened, in bit/s. Messages call the device `name`.
    pub fn new(name: &str, bitrates_bps: [Option<u32>; CHANNELS], now: UtcNs) -> Self {
        // Answers to an earlier host must not be mistaken for ours, so begin at an arbitrary number.
        let first_id = (now.0 >> 14) as u16;
        let mut listener = Self {
            name: name.to_owned(),
            bitrates_bps,
            step: Step::Hello { tries: 1 },
            intake: Intake::new(),
            records: Vec::new(),
            output: Vec::new(),
            asked: Vec::new(),
            first_id,
            next_id: first_id,
            hello: None,
            status: None,
            open: [None; CHANNELS],
            may_be_open: [false; CHANNELS],
            stopped: [false; CHANNELS],
            error: None,
            watch: SilenceWatch::default(),
            passed_at: now,
            waited: Duration::ZERO,
            since_status: Duration::ZERO,
            heard_at: now,
            ended_at: None,
            latest_ns: i64::MIN,
        };
        listener.greet(now);
        listener
    }

    /// The same, for a device that comes back to a trace whose last record has this time: no record is put before it.
    #[must_use]
    pub const fn after(mut self, latest_ns: i64) -> Self {
        self.latest_ns = latest_ns;
        self
    }

    /// Takes what has arrived by `now`, which may be nothing. Call it at least every 100 ms, since it also measures how long the device has
    /// not answered; time in which it was not called accuses nobody.
    pub fn take(&mut self, bytes: &[u8], now: UtcNs) {
        if self.step == Step::Over {
            return;
        }
        let mut answered = false;
        let mut over = None;
        for piece in bytes.chunks(PIECE_BYTES) {
            self.take_piece(piece, now, &mut answered, &mut over);
            if self.step == Step::Over {
                return;
            }
        }
        if let Some(reason) = over {
            return self.lose(DeviceError::SessionEnded { address: self.name.clone(), reason });
        }
        self.pass(now, answered);
    }

    /// What is to be written to the device; empty if nothing is.
    pub fn output(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.output)
    }

    /// The records that were captured, in order, to be taken out of the vector.
    pub const fn records(&mut self) -> &mut Vec<TraceRecord> {
        &mut self.records
    }

    /// How far the session is.
    pub const fn stage(&self) -> Stage {
        self.step.stage()
    }

    /// Why the session has ended, if it was not because of [`Self::stop`].
    pub const fn error(&self) -> Option<&DeviceError> {
        self.error.as_ref()
    }

    /// The device's description of itself, once it has answered the greeting.
    pub const fn hello(&self) -> Option<&Hello> {
        self.hello.as_ref()
    }

    /// Its latest status: at most a second old while it listens, and after [`Self::stop`] the last one.
    pub const fn status(&self) -> Option<&Status> {
        self.status.as_ref()
    }

    /// The channels that are open, or were until the end, with their configurations.
    pub fn channels(&self) -> impl Iterator<Item = (Channel, ChannelConfig)> + '_ {
        Channel::ALL.into_iter().filter_map(|channel| Some((channel, self.open[channel.index()]?)))
    }

    /// What was received and lost.
    pub const fn counters(&self) -> &Counters {
        self.intake.counters()
    }

    /// What is known of the device's clock.
    pub fn clock(&mut self) -> ClockReport {
        self.intake.clock().report()
    }

    /// Closes the channels; the rest of what they captured still comes, until [`Stage::Over`].
    pub fn stop(&mut self) {
        match self.stage() {
            Stage::Stopping | Stage::Over => {}
            Stage::Greeting | Stage::Opening => self.leave(),
            Stage::Listening => {
                let open: Vec<_> = self.channels().map(|(channel, _)| channel).collect();
                self.wait_for(Step::Close { left: open.len() as u32 });
                for channel in open {
                    self.ask(Command::Close { channel }, Purpose::Step, self.passed_at);
                }
            }
        }
    }

    /// The port is gone, for this reason: a gap of unknown length on each open channel is the last that is captured.
    pub fn vanished(&mut self, reason: &str) {
        self.lose(DeviceError::Vanished { address: self.name.clone(), reason: reason.to_owned() });
    }

    /// Ends the session with an error; the gap is the last record.
    fn lose(&mut self, error: DeviceError) {
        if self.step == Step::Over {
            return;
        }
        let was_stopping = self.stage() == Stage::Stopping;
        self.leave();
        let known = self.ended_at.unwrap_or(self.heard_at).0;
        let gap: Vec<_> = self.channels().map(|(channel, _)| channel.number()).collect();
        for channel in gap {
            self.keep(TraceRecord { time_ns: known, device_ns: None, channel, event: TraceEvent::GAP });
        }
        self.error = Some(if was_stopping {
            DeviceError::BadEnd { address: self.name.clone(), reason: error.to_string() }
        } else {
            error
        });
    }

    /// Has the device leave the buses that this session put it on; nothing more is expected.
    fn leave(&mut self) {
        for channel in Channel::ALL {
            if std::mem::take(&mut self.may_be_open[channel.index()]) {
                self.ask(Command::Close { channel }, Purpose::Status, self.passed_at);
            }
        }
        self.asked.clear();
        self.step = Step::Over;
    }

    fn keep(&mut self, mut record: TraceRecord) {
        record.time_ns = record.time_ns.max(self.latest_ns);
        self.latest_ns = record.time_ns;
        self.records.push(record);
    }

    fn greet(&mut self, now: UtcNs) {
        // The zero byte ends anything left in the device's input and selects our protocol over slcan.
        self.output.push(0);
        self.ask(Command::Hello { protocol: PROTOCOL_VERSION }, Purpose::Step, now);
    }

    fn ask(&mut self, command: Command, purpose: Purpose, at: UtcNs) {
        let id = self.next_id;
        self.next_id = id.wrapping_add(1);
        match encode(&Request { id, command }) {
            Ok(bytes) => self.output.extend(bytes),
            // None of these is too long.
            Err(error) => return self.error = Some(error),
        }
        self.asked.push(Asked { id, purpose, at, latest_ticks: self.intake.latest_ticks() });
    }

    fn wait_for(&mut self, step: Step) {
        self.step = step;
        self.waited = Duration::ZERO;
    }

    fn take_piece(&mut self, piece: &[u8], now: UtcNs, answered: &mut bool, over: &mut Option<SessionOver>) {
        let mut responses = Vec::new();
        let (mut stopped, mut ended, mut other) = (self.stopped, None, None);
        let was_in_session = self.intake.is_in_session();
        self.intake.push(piece, now, |notice| match notice {
            Notice::Response(response) => responses.push(response),
            Notice::OtherProtocol(device) => other = Some(device),
            Notice::Stopped(channel) => stopped[channel.index()] = true,
            // Whatever else the same read shows, the device's own reason says most.
            Notice::Ended { time_ns, reason } => ended = Some((UtcNs(time_ns), reason.into())),
            Notice::WentBack => _ = over.get_or_insert(SessionOver::StreamWentBack),
            Notice::TimesDisagree => _ = over.get_or_insert(SessionOver::TimesDisagree),
            Notice::Transmission(_) => {}
        });
        self.stopped = stopped;
        let records = std::mem::take(self.intake.records());
        if !records.is_empty() || !responses.is_empty() {
            self.heard_at = now;
        }
        if !records.is_empty() && matches!(self.step, Step::Drain { .. }) {
            self.waited = Duration::ZERO;
        }
        let is_opening = matches!(self.stage(), Stage::Greeting | Stage::Opening);
        let first = self.records.len();
        for record in records {
            self.keep(record);
        }
        let came = first..self.records.len();
        if let Some((at, reason)) = ended {
            self.ended_at = Some(at);
            *over = Some(reason);
        }
        if let (Some(device), Step::Hello { .. }) = (other, self.step) {
            return self.lose(DeviceError::Protocol { device });
        }
        for response in responses {
            *answered = true;
            if was_in_session && let Some(reason) = over_by(&response, self.is_ours(response.id)) {
                over.get_or_insert(reason);
                continue;
            }
            if let Some(at) = self.asked.iter().position(|asked| asked.id == response.id)
                && over.is_none()
            {
                let asked = self.asked.remove(at);
                self.answer(asked, response, now, over);
            }
        }
        // What a device sends that was opened otherwise than it was asked for, behind the answer that says so.
        if is_opening && self.error.is_some() {
            self.records.drain(came);
        }
    }

    const fn is_ours(&self, id: u16) -> bool {
        id.wrapping_sub(self.first_id) < self.next_id.wrapping_sub(self.first_id)
    }

    fn answer(&mut self, asked: Asked, response: Response, now: UtcNs, over: &mut Option<SessionOver>) {
        let reply = match response.result {
            Ok(reply) => believe(reply),
            Err(Refusal::Protocol { device }) => Err(DeviceError::Protocol { device }),
            Err(refusal) => Err(DeviceError::Refused { refusal }),
        };
        let reply = match reply {
            Ok(reply) => reply,
            Err(error) => return self.lose(error),
        };
        if let Reply::Time(ticks) = reply
            && !self.intake.add_time(Ticks(ticks), asked.latest_ticks, asked.at, now)
        {
            *over = Some(SessionOver::TimesDisagree);
            return;
        }
        if let Reply::Status(status) = &reply {
            self.status = Some(status.clone());
        }
        if asked.purpose == Purpose::Step {
            match self.next_step(reply, now) {
                Ok(()) => {}
                Err(error) => self.lose(error),
            }
        }
    }

    /// The step's answer has come.
    fn next_step(&mut self, reply: Reply, now: UtcNs) -> Result<(), DeviceError> {
        match (self.step, reply) {
            (Step::Hello { .. }, Reply::Hello(mut hello)) => {
                clean(&mut hello);
                if hello.capabilities & capability::ALWAYS_ACKNOWLEDGES != 0 {
                    return Err(DeviceError::AlwaysAcknowledges { address: self.name.clone() });
                }
                self.hello = Some(hello);
                self.wait_for(Step::Clock { rounds: 1 });
                self.ask(Command::Time, Purpose::Step, now);
            }
            (Step::Clock { rounds }, Reply::Time(_)) if rounds < CLOCK_ROUNDS => {
                self.wait_for(Step::Clock { rounds: rounds + 1 });
                self.ask(Command::Time, Purpose::Step, now);
            }
            (Step::Clock { .. }, Reply::Time(_)) => {
                self.intake.clock().settle();
                self.open_next(None, now)?;
            }
            (Step::Open(channel), Reply::Opened(applied)) => {
                let clock_hz = self.hello.as_ref().map_or(0, |hello| hello.can_clock_hz);
                let asked = self.config(channel)?;
                if asked.is_none_or(|asked| (asked.timing, asked.mode) != (applied.timing, applied.mode)) {
                    // Left open, it might acknowledge frames, or destroy them at a wrong bit rate; it is closed when the session is left.
                    let bitrate_bps = applied.timing.bitrate_bps(clock_hz);
                    return Err(DeviceError::OpenedOtherwise { channel, bitrate_bps, mode: applied.mode });
                }
                self.open[channel.index()] = Some(applied);
                self.open_next(Some(channel), now)?;
            }
            (Step::Close { left }, Reply::Done) if left > 1 => {
                self.wait_for(Step::Close { left: left - 1 });
            }
            (Step::Close { .. }, Reply::Done) => {
                self.may_be_open = [false; CHANNELS];
                self.wait_for(Step::ClosedAt);
                self.ask(Command::Time, Purpose::Step, now);
            }
            (Step::ClosedAt, Reply::Time(closed_at)) => {
                self.wait_for(Step::Drain { closed_at });
            }
            (Step::LastStatus, Reply::Status(status)) => {
                for (channel, stage, count) in unaccounted(&status, self.intake.counters()) {
                    for record in std::mem::take(self.intake.add_losses(channel, stage, count)) {
                        self.keep(record);
                    }
                }
                self.leave();
            }
            _ => return Err(DeviceError::WrongReply),
        }
        Ok(())
    }

    /// How a channel is opened, if it is.
    fn config(&self, channel: Channel) -> Result<Option<ChannelConfig>, DeviceError> {
        let Some((hello, bitrate_bps)) = self.hello.as_ref().zip(self.bitrates_bps[channel.index()]) else {
            return Ok(None);
        };
        let timing = BitTiming::choose(hello.can_clock_hz, bitrate_bps, None)
            .map_err(|reason| DeviceError::BitRate { bitrate_bps, reason })?;
        Ok(Some(ChannelConfig::listen_only(timing)))
    }

    /// Opens the channel after this one, or listens if there is none.
    fn open_next(&mut self, after: Option<Channel>, now: UtcNs) -> Result<(), DeviceError> {
        let first = after.map_or(0, |channel| channel.index() + 1);
        for channel in Channel::ALL.into_iter().skip(first) {
            let Some(config) = self.config(channel)? else { continue };
            debug_assert_eq!(config.mode, Mode::ListenOnly);
            let Some(hello) = &self.hello else { return Err(DeviceError::WrongReply) };
            if channel.number() > hello.channels {
                return Err(DeviceError::NoChannel { channel });
            }
            if hello.capabilities & capability::NO_BIT_RATE == 0 {
                // Before the first frame can arrive.
                let (clock_hz, tick_hz) = (hello.can_clock_hz, hello.tick_hz);
                let clocks = config.timing.clocks_per_bit();
                self.intake.lengths().set(channel.index(), clocks, clock_hz, tick_hz);
            }
            self.may_be_open[channel.index()] = true;
            self.wait_for(Step::Open(channel));
            self.ask(Command::Open { channel, config: Some(config) }, Purpose::Step, now);
            return Ok(());
        }
        self.wait_for(Step::Listen);
        self.since_status = Duration::ZERO;
        self.ask(Command::Status, Purpose::Status, now);
        Ok(())
    }

    /// Measures how long the device has not answered, and asks what is to be asked now and then.
    fn pass(&mut self, now: UtcNs, answered: bool) {
        let passed_ns = now.since(std::mem::replace(&mut self.passed_at, now)).max(0) as u64;
        let passed = Duration::from_nanos(passed_ns).min(LONGEST_PASS);
        self.waited += passed;
        match self.step {
            Step::Hello { tries } if self.waited >= HELLO_TIMEOUT => {
                self.asked.clear();
                if tries == HELLO_TRIES {
                    return self.lose(DeviceError::NotCantap { address: self.name.clone() });
                }
                self.wait_for(Step::Hello { tries: tries + 1 });
                self.greet(now);
            }
            Step::Drain { closed_at } => {
                let all = self.channels().all(|(channel, _)| self.stopped[channel.index()]);
                if all || self.intake.latest_ticks() > closed_at || self.waited >= DRAIN_TIMEOUT {
                    // If not all have stopped, the record itself was lost; the device's counters cover what else was.
                    self.wait_for(Step::LastStatus);
                    self.ask(Command::Status, Purpose::Step, now);
                }
            }
            Step::Hello { .. } | Step::Listen | Step::Over => {}
            _ if self.waited >= REQUEST_TIMEOUT => {
                return self.lose(DeviceError::Timeout { seconds: REQUEST_TIMEOUT.as_secs_f32() });
            }
            _ => {}
        }
        if !self.intake.is_in_session() || self.step == Step::Over {
            return;
        }
        match self.watch.pass(passed, answered) {
            Next::Listen => {}
            Next::Ask => self.ask(Command::Time, Purpose::Time, now),
            Next::GiveUp(silent) => {
                let seconds = silent.as_secs_f32();
                return self.lose(DeviceError::Silent { address: self.name.clone(), seconds });
            }
        }
        self.since_status += passed;
        if self.step == Step::Listen && self.since_status >= STATUS_EVERY {
            self.since_status = Duration::ZERO;
            self.ask(Command::Status, Purpose::Status, now);
        }
    }
}
