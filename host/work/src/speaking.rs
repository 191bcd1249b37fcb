//! Talking to nodes: connects a protocol's client (a [`Machine`]) to a device's open channel, and passes on what really was on the bus,
//! as a reader of the protocol sees it.

use std::collections::VecDeque;
use std::fmt::Write as _;
use std::io;
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};
use cantap::device::Records;
use cantap::transmit::Stream;
use cantap::wire::message::Periodic;
use cantap::wire::record::ErrorState;
use cantap::{Channel, Frame, TraceEvent, TraceRecord, periodic};
use cantap_address::OpenDevice;
use cantap_protocols::active::Machine;
use cantap_protocols::{Assembler, Event};
use cantap_trace::counted;

use crate::bus_hints::{BusHint, HintPlace};
use crate::bus_off::BusOffRecovery;
use crate::interrupt;
use crate::reception::Reception;
use crate::report::Reporter;
use crate::sending::Sending;

/// The longest time between two checks of what is being sent, and of Ctrl-C.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// How long the last frame of a conversation that is ended by Ctrl-C may take: a block of SDO frames may be before it.
const FAREWELL: Duration = Duration::from_millis(200);
/// The device's slot for repeated frames.
const REPEAT_SLOT: u8 = 0;
/// How many events wait to be asked for. Whoever floods the bus while a node takes its time would otherwise fill the memory.
const MOST_EVENTS: usize = 1 << 16;

/// What was on the bus since the last request.
#[derive(Clone, Copy, Debug, Default)]
struct Traffic {
    since: Option<Instant>,
    /// Our own frames, which a node acknowledged.
    own: u64,
    /// Frames of others.
    frames: u64,
    bits: u64,
    /// CAN FD frames switched to a bit rate of their own: the bits of those phases are not among these.
    is_bound: bool,
    lost: u64,
    errors: u64,
}

/// Talks on one channel.
pub struct Speaking<'d> {
    device: &'d OpenDevice,
    channel: Channel,
    /// If known.
    bitrate_bps: Option<u32>,
    records: Records,
    stream: Stream<'d>,
    sending: Sending<'d>,
    started: Instant,
    pushed: u64,
    /// Frames not yet confirmed.
    under_way: VecDeque<Frame>,
    witness: Box<dyn Assembler>,
    /// What the bus's reader has just found.
    found: Vec<Event>,
    events: VecDeque<Event>,
    /// Events that were not asked for before there was no more room.
    left_out: u64,
    as_it_comes: Option<IsWanted<'d>>,
    /// What leaves a machine as it must be left.
    is_last: bool,
    reporter: Reporter,
    traffic: Traffic,
    reception: Reception,
    /// Any frame of others, since the beginning.
    has_received: bool,
    /// The channel went bus-off.
    is_off: bool,
    on_event: OnEvent<'d>,
}

/// Takes events for the user.
pub type OnEvent<'d> = Box<dyn FnMut(&Event) -> io::Result<()> + 'd>;

/// Chooses events.
pub type IsWanted<'d> = Box<dyn FnMut(&Event) -> bool + 'd>;

impl<'d> Speaking<'d> {
    /// Starts talking over the device, on its open `channel`. `witness` is the reader that finds the events in what was on the bus.
    pub fn new(
        device: &'d OpenDevice,
        channel: Channel,
        recovery: BusOffRecovery,
        witness: Box<dyn Assembler>,
        on_event: OnEvent<'d>,
        reporter: Reporter,
    ) -> Self {
        let open = device.open_channels().into_iter().find(|(open, _)| *open == channel);
        let clock_hz = device.hello().can_clock_hz;
        Self {
            device,
            channel,
            bitrate_bps: open.and_then(|(_, config)| config.timing.known_bitrate_bps(clock_hz)),
            records: device.records(),
            stream: Stream::new(device),
            sending: Sending::fed(device, recovery, None),
            started: Instant::now(),
            pushed: 0,
            under_way: VecDeque::new(),
            witness,
            found: Vec::new(),
            events: VecDeque::new(),
            left_out: 0,
            as_it_comes: None,
            is_last: false,
            reporter,
            traffic: Traffic::default(),
            reception: Reception::default(),
            has_received: false,
            is_off: false,
            on_event,
        }
    }

    fn now_ns(&self) -> u64 {
        self.started.elapsed().as_nanos() as u64
    }

    /// The channel.
    pub const fn channel(&self) -> Channel {
        self.channel
    }

    /// The device.
    pub const fn device(&self) -> &OpenDevice {
        self.device
    }

    /// The events from the bus's reader since the last call, the newest 65 536 at most. How many more there were is reported.
    pub fn take_events(&mut self) -> Vec<Event> {
        self.tell_left_out();
        std::mem::take(&mut self.events).into()
    }

    /// Puts back what [`Self::take_events`] returned.
    pub fn put_back(&mut self, events: Vec<Event>) {
        self.events = events.into();
    }

    /// Passes on the wanted ones of the events that [`Self::take_events`] would return.
    pub fn show(&mut self, mut is_wanted: impl FnMut(&Event) -> bool) -> io::Result<()> {
        self.tell_left_out();
        for event in self.events.drain(..).filter(|event| is_wanted(event)) {
            (self.on_event)(&event)?;
        }
        Ok(())
    }

    /// Passes on the wanted events as soon as they are there, and keeps no others: for what goes on for as long as the user wants.
    pub fn show_as_it_comes(&mut self, is_wanted: IsWanted<'d>) {
        self.as_it_comes = Some(is_wanted);
    }

    fn tell_left_out(&mut self) {
        let left_out = usize::try_from(std::mem::take(&mut self.left_out)).unwrap_or(usize::MAX);
        if left_out > 0 {
            self.reporter.warn(format!(
                "more was said on the bus meanwhile than is kept: {} before the newest {MOST_EVENTS} left out",
                counted(left_out, "message")
            ));
        }
    }

    /// Runs a client until it ends. An error means that frames are stuck, the device is gone, or Ctrl-C; the client itself has
    /// its result.
    pub fn run(&mut self, machine: &mut dyn Machine) -> anyhow::Result<()> {
        let result = self.run_to_its_end(machine);
        if result.is_err() && interrupt::requested() {
            // Whether it still arrives changes nothing here.
            let _ = self.cancel(machine);
        }
        result
    }

    /// Runs a client that leaves a machine as it must be left, after Ctrl-C, too, and whatever else was the reason.
    pub fn run_last(&mut self, machine: &mut dyn Machine) -> anyhow::Result<()> {
        self.sending.begin_farewell();
        self.is_last = true;
        self.run_to_its_end(machine)
    }

    /// Tells the other side that this is over, if it would otherwise go on.
    fn cancel(&mut self, machine: &mut dyn Machine) -> anyhow::Result<()> {
        machine.cancel().map_or(Ok(()), |frame| self.send_last(frame))
    }

    /// Sends a frame after the end, so that a node does not wait or stay as it is, and waits a moment until it was on the bus.
    pub fn send_last(&mut self, frame: Frame) -> anyhow::Result<()> {
        self.under_way.push_back(frame);
        self.stream.push(self.channel, frame, None, |_| false)?;
        self.stream.flush()?;
        let until = Instant::now() + FAREWELL;
        while self.under_way.contains(&frame) && Instant::now() < until {
            self.take_records(LOOK_EVERY, None)?;
        }
        Ok(())
    }

    fn run_to_its_end(&mut self, machine: &mut dyn Machine) -> anyhow::Result<()> {
        self.traffic = Traffic { since: Some(Instant::now()), ..Traffic::default() };
        self.take_records(Duration::ZERO, None)?;
        // Nothing new begins after Ctrl-C.
        if self.sending.is_interrupted() {
            return Err(self.stopped());
        }
        loop {
            let mut any = false;
            while let Some(frame) = machine.next(self.now_ns()) {
                self.send(frame)?;
                any = true;
            }
            if any {
                self.stream.flush()?;
            }
            if machine.is_done() && self.under_way.is_empty() {
                return self.look();
            }
            let wait = machine.due_ns().filter(|_| !machine.is_done()).map_or(LOOK_EVERY, |due_ns| {
                Duration::from_nanos(due_ns.saturating_sub(self.now_ns())).min(LOOK_EVERY)
            });
            self.take_records(wait, Some(machine))?;
            self.look()?;
        }
    }

    /// Has the device send frames periodically by its own clock, until the requested number, the end of the time, or Ctrl-C. Returns
    /// how many were sent, and an error in their place if some that were due were not.
    pub fn repeat(
        &mut self,
        frame: Frame,
        period: Duration,
        count: Option<u32>,
        time: Option<Duration>,
    ) -> anyhow::Result<(u64, anyhow::Result<()>)> {
        let period_ticks = periodic::period_ticks(period, self.device.hello().tick_hz)?;
        let entry =
            Periodic { frame, period_ticks, count: count.unwrap_or(0), modifiers: heapless::Vec::new() };
        self.device.set_periodic(self.channel, REPEAT_SLOT, Some(entry))?;
        let over = self.repeats(count, time);
        // Periods that passed without a frame, while the device still counts them.
        let missed = over.is_ok().then(|| self.sending.periods_missed(self.channel)).transpose();
        // However it ended, the device's clock must not go on by itself.
        let ended = self.device.set_periodic(self.channel, REPEAT_SLOT, None);
        over?;
        ended?;
        let sent = self.sending.ended();
        let due = sent + missed?.unwrap_or_default();
        let asked = count.map_or(due, |count| u64::from(count).min(due));
        Ok((self.sending.sent(), self.sending.outcome(asked)?.verdict()))
    }

    /// Watches repeated frames until their end.
    fn repeats(&mut self, count: Option<u32>, time: Option<Duration>) -> anyhow::Result<()> {
        let started = Instant::now();
        loop {
            self.take_records(LOOK_EVERY, None)?;
            self.stream.wait(Duration::ZERO)?;
            let ends = self.stream.take_ended();
            let goes_on = self.sending.device_goes_on(&ends);
            let sent = self.sending.sent();
            let is_over = interrupt::requested()
                || time.is_some_and(|time| started.elapsed() >= time)
                || count.is_some_and(|count| sent >= u64::from(count));
            if is_over && !self.is_off {
                return Ok(());
            }
            if !goes_on || self.is_off {
                self.pushed = self.sending.ended() + 1;
                return Err(self.stopped());
            }
        }
    }

    /// Only listens, and lets the bus's reader work.
    pub fn listen(&mut self, time: Duration) -> anyhow::Result<()> {
        let until = Instant::now() + time;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            self.take_records(left.min(LOOK_EVERY), None)?;
            if left.is_zero() || interrupt::requested() {
                return Ok(());
            }
        }
    }

    fn send(&mut self, frame: Frame) -> anyhow::Result<()> {
        if self.is_off {
            return Err(self.stopped());
        }
        self.under_way.push_back(frame);
        self.pushed += 1;
        let sending = &mut self.sending;
        let tag = self.stream.push(self.channel, frame, None, |stream| {
            sending.goes_on(&stream.take_ended(), stream.oldest_due())
        })?;
        match tag {
            Some(_) => Ok(()),
            None => Err(self.stopped()),
        }
    }

    fn take_records(&mut self, wait: Duration, mut machine: Option<&mut dyn Machine>) -> anyhow::Result<()> {
        let Some(batch) = self.records.next_batch(wait)? else {
            bail!("the device ended the session");
        };
        self.sending.take(&batch);
        self.reception.take(&batch, Instant::now());
        for record in &batch {
            if record.channel == self.channel.number() {
                let machine = machine.as_mut().map(|machine| &mut **machine as &mut dyn Machine);
                self.record(record, machine);
            }
        }
        self.records.recycle(batch);
        if let Some(mut is_wanted) = self.as_it_comes.take() {
            let shown = self.show(&mut is_wanted);
            self.as_it_comes = Some(is_wanted);
            // A machine is stopped whether or not whoever reads what is printed is still there.
            if !self.is_last {
                shown?;
            }
        }
        Ok(())
    }

    fn record(&mut self, record: &TraceRecord, machine: Option<&mut dyn Machine>) {
        self.witness.take(record, &mut self.found);
        self.events.extend(self.found.drain(..));
        let excess = self.events.len().saturating_sub(MOST_EVENTS);
        self.events.drain(..excess);
        self.left_out += excess as u64;
        let now_ns = self.now_ns();
        match record.event {
            TraceEvent::Frame { frame, .. } => {
                // On a shared board, other programs' frames are also sent from here.
                if let Some(place) = self.under_way.iter().position(|own| frame == *own) {
                    self.under_way.remove(place);
                    self.traffic.own += 1;
                    if let Some(machine) = machine {
                        machine.sent(now_ns);
                    }
                    return;
                }
                self.traffic.frames += 1;
                self.has_received = true;
                let bits = frame.bus_bits();
                self.traffic.bits += u64::from(bits.nominal);
                self.traffic.is_bound |= bits.data > 0;
                if let Some(machine) = machine.filter(|_| !frame.is_remote()) {
                    machine.hear(now_ns, frame.id(), frame.data());
                }
            }
            TraceEvent::Lost { count, .. } => {
                self.traffic.lost += u64::from(count);
                if let Some(machine) = machine {
                    machine.gap(now_ns);
                }
            }
            TraceEvent::BusError { .. } => self.traffic.errors += 1,
            TraceEvent::ErrorsSuppressed { count } => self.traffic.errors += u64::from(count),
            TraceEvent::State { state: ErrorState::BusOff, .. } => self.is_off = true,
            _ => {}
        }
    }

    /// Checks that everything to be sent leaves.
    fn look(&mut self) -> anyhow::Result<()> {
        self.stream.wait(Duration::ZERO)?;
        let goes_on = self.sending.goes_on(&self.stream.take_ended(), self.stream.oldest_due());
        if goes_on && !self.is_off && self.sending.ended() == self.sending.sent() {
            Ok(())
        } else {
            Err(self.stopped())
        }
    }

    /// Why nothing more is sent.
    fn stopped(&mut self) -> anyhow::Error {
        if self.sending.is_interrupted() {
            return anyhow!("ended by Ctrl-C before it was complete");
        }
        // By then it may be back, and send what was waiting, which nobody expects any more.
        if self.is_off {
            return anyhow!(
                "channel {} went bus-off: errors destroyed what it sent; check bit rate, wiring and termination, then run this again; \
                 nothing more is sent",
                self.channel.number()
            );
        }
        match self.sending.outcome(self.pushed) {
            Ok(outcome) => {
                outcome.verdict().err().unwrap_or_else(|| anyhow!("frames no longer leave the device"))
            }
            Err(error) => error,
        }
    }

    /// What is known of the bus when a node does not answer: whether the last request was acknowledged, and what else there
    /// was.
    pub fn circumstances(&self) -> String {
        let Traffic { since, own, frames, bits, is_bound, lost, errors } = self.traffic;
        let seconds = since.map_or(0.0, |since| since.elapsed().as_secs_f64()).max(1e-3);
        let load = self.bitrate_bps.map_or_else(String::new, |bitrate_bps| {
            let load_pct = (bits as f64 / (f64::from(bitrate_bps) * seconds) * 100.0).min(100.0);
            format!(" (load {}{load_pct:.0} %)", if is_bound { "at least " } else { "" })
        });
        let count = |number, noun| counted(usize::try_from(number).unwrap_or(usize::MAX), noun);
        let mut text = match own {
            0 => "nothing was sent".to_owned(),
            _ => "what was sent was acknowledged by a node".to_owned(),
        };
        let _ = match frames {
            0 => write!(text, "; no other frame was heard in {seconds:.1} s"),
            frames => write!(text, "; {} of others in {seconds:.1} s{load}", count(frames, "frame")),
        };
        if errors > 0 {
            let _ = write!(text, "; {}", count(errors, "bus error"));
        }
        if let Ok(status) = self.device.status() {
            let _ =
                write!(text, "; the controller is {}", status.channels[self.channel.index()].state.name());
        }
        if lost > 0 {
            let _ = write!(
                text,
                "; {lost} or more were lost on the way to this computer",
                lost = counted(lost, "frame")
            );
        }
        text
    }

    /// An error if there were errors and not one frame, since that must not look like a silent bus.
    pub fn judge(&self) -> anyhow::Result<()> {
        let is_deaf = self.reception.deaf().any(|number| number == self.channel.number());
        if is_deaf {
            let number = self.channel.number();
            let hint = self.reception.hint(number, false).unwrap_or(BusHint::WrongBitRate);
            bail!(hint.sentence(&HintPlace { number, device: self.device.name(), channel_there: number }));
        }
        Ok(())
    }

    /// Whether any frame of others was heard since the beginning.
    pub const fn has_received(&self) -> bool {
        self.has_received
    }
}
