//! Scripts as nodes on simulated buses, in simulated time.

use std::collections::VecDeque;
use std::sync::Arc;

use cantap_can::{BusErrorKind, CHANNELS, Channel, Frame};
use cantap_signals::Decoder;
use cantap_trace::{Direction, TraceEvent, TraceRecord};
use cantap_virtual::Options;
use cantap_virtual::simbus::{Node as BusNode, SimBus};

use crate::exchange::{Input, Output};
use crate::node::{Node, Script, ScriptError};
use crate::report::{Message, Report};
use crate::results::{Results, is_over};

/// How long frames that are under way at the end may take to be on the bus.
const FAREWELL_NS: u64 = 100_000_000;
/// The place of the caller, which is none of the scripts.
const CALLER: usize = usize::MAX;
/// "Never", for times.
const NEVER: u64 = u64::MAX;

/// What a run on simulated buses needs.
#[derive(Clone, Debug)]
pub struct Bench {
    /// What else is on the buses, as in the address of a virtual device: `load=0` for nothing, `car` for a vehicle.
    pub options: Options,
    /// The bit rates of the buses, in bit/s, where the options do not fix them.
    pub bitrates_bps: [u32; CHANNELS],
    /// The databases for messages and signals.
    pub decoder: Arc<Decoder>,
    /// Selects another sequence of random numbers; each script has its own.
    pub seed: u64,
    /// Keys that are typed during the run, and when, in nanoseconds of simulated time.
    pub keys: Vec<(u64, char)>,
    /// When the run ends, in nanoseconds of simulated time; scripts with tests end it earlier.
    pub duration_ns: u64,
}

impl Bench {
    /// Runs scripts until the tests are done, all scripts have ended, or the time is up. Each frame on a bus goes to `on_record`, each line that a
    /// script logs to `on_message`, when `goes_on` returns false the run ends.
    ///
    /// The same scripts, options and seed give the same frames at the same times.
    ///
    /// # Errors
    /// If a script is not in the language; what goes wrong later is in the report.
    pub fn run(
        &self,
        scripts: &[Script],
        on_record: &mut dyn FnMut(TraceRecord),
        on_message: &mut dyn FnMut(Message),
        goes_on: &mut dyn FnMut() -> bool,
    ) -> Result<Report, ScriptError> {
        if scripts.is_empty() {
            return Err(ScriptError::None);
        }
        let mut simulation = self.start();
        for script in scripts {
            simulation.add(script)?;
        }
        let hand_over = |simulation: &mut Simulation,
                         on_record: &mut dyn FnMut(TraceRecord),
                         on_message: &mut dyn FnMut(Message)| {
            simulation.records.drain(..).for_each(on_record);
            simulation.results.messages.drain(..).for_each(on_message);
        };
        while simulation.now_ns < self.duration_ns && !is_over(&simulation.nodes) && goes_on() {
            let goes = simulation.step(self.duration_ns);
            hand_over(&mut simulation, on_record, on_message);
            if !goes {
                break;
            }
        }
        let until_ns = simulation.now_ns + FAREWELL_NS;
        while is_over(&simulation.nodes) && simulation.is_sending() && goes_on() {
            let goes = simulation.step(until_ns) && simulation.now_ns < until_ns;
            hand_over(&mut simulation, on_record, on_message);
            if !goes {
                break;
            }
        }
        let (report, messages) = simulation.finish();
        messages.into_iter().for_each(on_message);
        Ok(report)
    }

    /// The same, step by step, for a caller that takes part itself and adds scripts as it likes. [`Self::duration_ns`] is its business.
    pub fn start(&self) -> Simulation {
        let mut options = self.options.clone();
        let buses = [0, 1].map(|channel| {
            let bitrate_bps = options.bitrate_of_bus(channel).unwrap_or(self.bitrates_bps[channel]);
            Wire { bus: options.bus(channel), nodes: Vec::new(), own: Attached::new(bitrate_bps) }
        });
        let mut keys = self.keys.clone();
        keys.sort_by_key(|(at_ns, _)| *at_ns);
        Simulation {
            decoder: Arc::clone(&self.decoder),
            seed: self.seed,
            nodes: Vec::new(),
            has_keys: !keys.is_empty(),
            keys: keys.into(),
            buses,
            repeats: Vec::new(),
            results: Results::default(),
            records: Vec::new(),
            now_ns: 0,
        }
    }
}

/// A frame that is sent again and again.
struct Repeat {
    node: usize,
    handle: u32,
    channel: Channel,
    frame: Frame,
    period_ns: u64,
    due_ns: u64,
}

/// A bus with the scripts' controllers on it, and the caller's own, which sees everything.
struct Wire {
    bus: SimBus,
    nodes: Vec<Attached>,
    own: Attached,
}

impl Wire {
    fn with<R>(&mut self, act: impl FnOnce(&mut SimBus, &mut [&mut dyn BusNode]) -> R) -> R {
        let Self { bus, nodes, own } = self;
        let mut all: Vec<&mut dyn BusNode> = nodes.iter_mut().map(|node| node as &mut dyn BusNode).collect();
        all.push(own);
        act(bus, &mut all)
    }
}

/// A script's controller on one bus.
struct Attached {
    bitrate_bps: u32,
    /// Each frame, and the handle of its repetition if it is a repeated one.
    to_send: VecDeque<(Frame, Option<u32>)>,
    /// Whether the first of them is on the bus.
    is_sending: bool,
    received: Vec<(Frame, Whose)>,
    errors: Vec<BusErrorKind>,
}

impl Attached {
    /// Whether a repetition's last frame has not been sent yet.
    fn holds(&self, handle: u32) -> bool {
        self.to_send.iter().any(|(_, of)| *of == Some(handle))
    }

    const fn new(bitrate_bps: u32) -> Self {
        Self {
            bitrate_bps,
            to_send: VecDeque::new(),
            is_sending: false,
            received: Vec::new(),
            errors: Vec::new(),
        }
    }
}

/// Who sent a frame, for a script's controller.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Whose {
    Others,
    Own,
    /// Its own too, but not one that the script waits to see confirmed.
    Repeated,
}

impl BusNode for Attached {
    fn bitrate_bps(&self) -> Option<u32> {
        Some(self.bitrate_bps)
    }

    fn bid(&self) -> Option<Frame> {
        self.to_send.front().map(|(frame, _)| *frame)
    }

    fn acknowledges(&self) -> bool {
        true
    }

    fn destroys(&self) -> bool {
        false
    }

    fn on_start(&mut self) {
        self.is_sending = true;
    }

    fn on_lost(&mut self) {}

    fn on_frame(&mut self, frame: &Frame, own: bool) {
        let sent = if own { self.to_send.pop_front() } else { None };
        self.is_sending &= !own;
        let whose = match (own, sent) {
            (false, _) => Whose::Others,
            (true, Some((_, Some(_)))) => Whose::Repeated,
            (true, _) => Whose::Own,
        };
        self.received.push((*frame, whose));
    }

    fn on_error(&mut self, kind: BusErrorKind, own: bool) {
        self.is_sending &= !own;
        self.errors.push(kind);
    }

    fn on_boundary(&mut self) {}
}

/// Scripts on simulated buses, in simulated time, that go on only as far as the caller says.
pub struct Simulation {
    decoder: Arc<Decoder>,
    seed: u64,
    nodes: Vec<Node>,
    /// Whether keys are typed in this run.
    has_keys: bool,
    /// Those that have not been typed yet, in the order of their times.
    keys: VecDeque<(u64, char)>,
    buses: [Wire; CHANNELS],
    repeats: Vec<Repeat>,
    results: Results,
    /// Frames and errors of the buses, to be taken.
    records: Vec<TraceRecord>,
    now_ns: u64,
}

impl Simulation {
    /// Nanoseconds of simulated time since the beginning.
    pub const fn now_ns(&self) -> u64 {
        self.now_ns
    }

    /// One more node, from now on; returns its place.
    ///
    /// # Errors
    /// If it is not in the language; what goes wrong later is in [`Self::errors`].
    pub fn add(&mut self, script: &Script) -> Result<usize, ScriptError> {
        let place = self.nodes.len();
        self.nodes.push(Node::start_nth(place, script, &self.decoder, self.seed, Arc::default())?);
        for wire in &mut self.buses {
            wire.nodes.push(Attached::new(wire.own.bitrate_bps));
        }
        Ok(place)
    }

    /// Ends a node: it sends nothing more but what may be under way.
    pub fn end(&mut self, place: usize) {
        let Some(node) = self.nodes.get_mut(place) else { return };
        node.end();
        self.repeats.retain(|repeat| repeat.node != place);
        self.drop_waiting(place);
    }

    /// Queues a frame of the caller's own controller.
    pub fn send(&mut self, channel: Channel, frame: Frame) {
        self.buses[channel.index()].own.to_send.push_back((frame, None));
    }

    /// Sends a frame of the caller's now and then again after each period, until the next call with the same handle: with another frame
    /// or period, or with none.
    pub fn repeat(&mut self, handle: u32, repeated: Option<(Channel, Frame, u64)>) {
        let node = CALLER;
        self.repeats.retain(|repeat| (repeat.node, repeat.handle) != (node, handle));
        if let Some((channel, frame, period_ns)) = repeated {
            let due_ns = self.now_ns;
            self.repeats.push(Repeat { node, handle, channel, frame, period_ns: period_ns.max(1), due_ns });
        }
    }

    /// Goes on to what is due next, but not beyond `end_ns`.
    pub fn advance(&mut self, end_ns: u64) {
        self.step(end_ns);
    }

    /// What was on the buses since the last call: times are nanoseconds since the beginning, and the caller's own frames are those that were sent.
    pub fn take_records(&mut self) -> Vec<TraceRecord> {
        std::mem::take(&mut self.records)
    }

    /// What scripts have logged since the last call.
    pub fn take_messages(&mut self) -> Vec<Message> {
        std::mem::take(&mut self.results.messages)
    }

    /// Scripts that have ended with an error, and the error.
    pub fn errors(&self) -> Vec<(String, String)> {
        self.nodes.iter().filter_map(|node| Some((node.name.clone(), node.error.clone()?))).collect()
    }

    /// Does what is due next, and returns false if nothing will be.
    fn step(&mut self, end_ns: u64) -> bool {
        let now_ns = self.now_ns;
        let of_scripts = self.nodes.iter().filter_map(|node| node.wake_ns).min().unwrap_or(NEVER);
        let of_repeats = self.repeats.iter().filter(|repeat| !self.waits(repeat));
        let of_repeats = of_repeats.map(|repeat| repeat.due_ns).min().unwrap_or(NEVER);
        let of_keys = self.keys.front().map_or(NEVER, |(at_ns, _)| *at_ns);
        let mut next_ns = of_scripts.min(of_repeats).min(of_keys);
        for wire in &mut self.buses {
            next_ns = next_ns.min(wire.with(|bus, nodes| bus.next_event_ns(now_ns, nodes)));
        }
        if next_ns == NEVER {
            self.now_ns = end_ns;
            return false;
        }
        if next_ns > end_ns {
            self.now_ns = end_ns;
            return true;
        }
        self.now_ns = next_ns.max(now_ns);
        for channel in Channel::ALL {
            self.pass(channel);
        }
        self.queue_repeated();
        let now_ns = self.now_ns;
        while let Some((_, key)) = self.keys.pop_front_if(|(at_ns, _)| *at_ns <= now_ns) {
            for place in 0..self.nodes.len() {
                self.resume(place, Some(Input::Key(key)));
            }
        }
        self.wake();
        if !self.has_keys {
            self.results.without_keys(&self.nodes, self.now_ns);
        }
        true
    }

    /// Whether a frame of a script that has ended is not on the bus yet.
    fn is_sending(&self) -> bool {
        self.buses.iter().any(|wire| {
            let ended = self.nodes.iter().zip(&wire.nodes).filter(|(node, _)| node.has_ended);
            ended.into_iter().any(|(_, attached)| !attached.to_send.is_empty())
        })
    }

    /// Lets a bus do what is due, and passes to the scripts what they received.
    fn pass(&mut self, channel: Channel) {
        let now_ns = self.now_ns;
        let wire = &mut self.buses[channel.index()];
        wire.with(|bus, nodes| bus.step(now_ns, nodes));
        for (frame, whose) in std::mem::take(&mut wire.own.received) {
            self.results.frame(now_ns, channel, frame);
            let direction = if whose == Whose::Others { Direction::Rx } else { Direction::Tx };
            let event = TraceEvent::Frame { frame: frame.into(), direction, late: false };
            self.records.push(TraceRecord {
                time_ns: now_ns as i64,
                device_ns: None,
                channel: channel.number(),
                event,
            });
        }
        for kind in std::mem::take(&mut wire.own.errors) {
            let event = TraceEvent::BusError { kind: Some(kind), counters: None };
            self.records.push(TraceRecord {
                time_ns: now_ns as i64,
                device_ns: None,
                channel: channel.number(),
                event,
            });
        }
        for place in 0..self.nodes.len() {
            let attached = &mut self.buses[channel.index()].nodes[place];
            let (received, errors) =
                (std::mem::take(&mut attached.received), std::mem::take(&mut attached.errors));
            for (frame, whose) in received {
                let report = &mut self.results.report;
                if whose == Whose::Others {
                    report.frames_received += 1;
                    self.resume(place, Some(Input::Frame { channel, frame, at_ns: now_ns }));
                } else {
                    report.frames_sent += 1;
                    if whose == Whose::Own {
                        self.resume(place, Some(Input::Sent { channel }));
                    }
                }
            }
            for kind in errors {
                self.resume(place, Some(Input::Error { channel, kind: Some(kind) }));
            }
        }
    }

    fn controller_of(&self, repeat: &Repeat) -> &Attached {
        let Wire { nodes, own, .. } = &self.buses[repeat.channel.index()];
        nodes.get(repeat.node).unwrap_or(own)
    }

    /// Whether the last frame of a repetition has not been sent yet: until then it is not due again, as in a device.
    fn waits(&self, repeat: &Repeat) -> bool {
        self.controller_of(repeat).holds(repeat.handle)
    }

    /// Queues the repeated frames that are due.
    fn queue_repeated(&mut self) {
        for place in 0..self.repeats.len() {
            let repeat = &self.repeats[place];
            if repeat.due_ns > self.now_ns || self.waits(repeat) {
                continue;
            }
            let repeat = &mut self.repeats[place];
            // What was due while the last one waited is left out.
            repeat.due_ns += ((self.now_ns - repeat.due_ns) / repeat.period_ns + 1) * repeat.period_ns;
            let (frame, handle) = (repeat.frame, repeat.handle);
            let Wire { nodes, own, .. } = &mut self.buses[repeat.channel.index()];
            nodes.get_mut(repeat.node).unwrap_or(own).to_send.push_back((frame, Some(handle)));
        }
    }

    /// Wakes the scripts whose time has come.
    fn wake(&mut self) {
        for place in 0..self.nodes.len() {
            if self.nodes[place].wake_ns.is_some_and(|wake_ns| wake_ns <= self.now_ns) {
                self.resume(place, None);
            }
        }
    }

    /// A script's turn.
    fn resume(&mut self, place: usize, input: Option<Input>) {
        let node = &mut self.nodes[place];
        let outputs = node.resume(self.now_ns, input);
        let name = node.name.clone();
        let (has_ended, has_failed) = (node.has_ended, node.error.is_some());
        for output in outputs {
            match self.results.take(&name, self.now_ns, output) {
                Some(Output::Send { .. }) if has_failed => self.results.report.frames_not_sent += 1,
                Some(Output::Send { channel, frame }) => {
                    self.buses[channel.index()].nodes[place].to_send.push_back((frame, None));
                }
                Some(Output::Repeat { handle, channel, frame, period_ns }) => {
                    let known = self
                        .repeats
                        .iter_mut()
                        .find(|repeat| (repeat.node, repeat.handle) == (place, handle));
                    match known {
                        Some(repeat) => repeat.frame = frame,
                        None => self.repeats.push(Repeat {
                            node: place,
                            handle,
                            channel,
                            frame,
                            period_ns,
                            due_ns: self.now_ns,
                        }),
                    }
                }
                Some(Output::EndRepeat { handle }) => {
                    self.repeats.retain(|repeat| (repeat.node, repeat.handle) != (place, handle));
                }
                Some(Output::Log(_) | Output::TestBegan(_) | Output::Test { .. }) | None => {}
            }
        }
        if has_ended {
            // A node that is gone sends nothing more.
            self.repeats.retain(|repeat| repeat.node != place);
        }
        if has_failed {
            self.drop_waiting(place);
        }
    }

    /// What a node's controllers have not begun to send is not sent.
    fn drop_waiting(&mut self, place: usize) {
        for wire in &mut self.buses {
            let Attached { to_send, is_sending, .. } = &mut wire.nodes[place];
            let kept = usize::from(*is_sending);
            self.results.report.frames_not_sent += to_send.len().saturating_sub(kept) as u64;
            to_send.truncate(kept);
        }
    }

    /// How it went, and what was logged last.
    pub fn finish(mut self) -> (Report, Vec<Message>) {
        let waiting = self.buses.iter().flat_map(|wire| &wire.nodes).map(|node| node.to_send.len() as u64);
        self.results.report.frames_not_sent += waiting.sum::<u64>();
        let messages = self.take_messages();
        (self.results.finish(&self.nodes, self.now_ns), messages)
    }
}
