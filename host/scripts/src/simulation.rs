//! Scripts on simulated buses, step by step.

mod injection;
mod wire;

use std::collections::VecDeque;
use std::sync::Arc;

use cantap_can::{CHANNELS, Channel, Frame, LossStage};
use cantap_trace::{Direction, TraceEvent, TraceRecord};
use cantap_virtual::simbus::SimBus;

use crate::attached::{Attached, Sighting, Whose};
use crate::exchange::{Input, Output};
use crate::faults::{BenchNodes, PlannedFault};
use crate::intake::{Intake, Losses, Taken};
use crate::node::{Node, Script, ScriptError};
use crate::report::{Message, Report};
use crate::results::{Results, is_over};
use crate::surroundings::Surroundings;
use wire::Wire;

/// The place of the caller, which is none of the scripts.
const CALLER: usize = usize::MAX;
/// "Never", for times.
const NEVER: u64 = u64::MAX;
/// A frame that is sent again and again.
struct Repeat {
    node: usize,
    handle: u32,
    channel: Channel,
    frame: Frame,
    period_ns: u64,
    due_ns: u64,
}

/// A script with everything that its node has besides its controllers.
struct Place {
    script: Script,
    /// The way to its host.
    intake: Intake<Input>,
    /// When it has power again.
    power_on_ns: Option<u64>,
    /// How often it has begun anew.
    restarts: u64,
}

/// Scripts on simulated buses, in simulated time, that go on only as far as the caller says.
pub struct Simulation {
    surroundings: Surroundings,
    known: BenchNodes,
    nodes: Vec<Node>,
    /// Of each node.
    places: Vec<Place>,
    /// Whether keys are typed in this run.
    has_keys: bool,
    /// Those that have not been typed yet, in the order of their times.
    keys: VecDeque<(u64, char)>,
    /// What has not gone wrong yet, in the order of its times.
    faults: VecDeque<PlannedFault>,
    buses: [Wire; CHANNELS],
    repeats: Vec<Repeat>,
    pub(crate) results: Results,
    /// The way to the caller.
    intake: Intake<TraceRecord>,
    /// Frames that nobody's host takes.
    losses: Losses,
    /// Frames and errors of the buses, to be taken.
    records: Vec<TraceRecord>,
    now_ns: u64,
}

impl Simulation {
    /// Of these buses with their bit rates, in bit/s; keys and faults have their times.
    pub(crate) fn new(
        buses: [(SimBus, u32); CHANNELS],
        surroundings: Surroundings,
        mut keys: Vec<(u64, char)>,
        mut faults: Vec<PlannedFault>,
    ) -> Self {
        keys.sort_by_key(|(at_ns, _)| *at_ns);
        faults.sort_by_key(|planned| planned.at_ns);
        Self {
            known: surroundings.nodes.clone().unwrap_or_default(),
            surroundings,
            nodes: Vec::new(),
            places: Vec::new(),
            has_keys: !keys.is_empty(),
            keys: keys.into(),
            faults: faults.into(),
            buses: buses.map(|(bus, bitrate_bps)| Wire {
                bus,
                nodes: Vec::new(),
                own: Attached::new(bitrate_bps),
            }),
            repeats: Vec::new(),
            results: Results::default(),
            intake: Intake::new(),
            losses: Losses::default(),
            records: Vec::new(),
            now_ns: 0,
        }
    }

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
        let node = Node::start_nth(place as u64, script, &self.surroundings, Arc::default())?;
        self.known.add(node.name.clone(), node.has_tests());
        self.nodes.push(node);
        self.places.push(Place {
            script: script.clone(),
            intake: Intake::new(),
            power_on_ns: None,
            restarts: 0,
        });
        for wire in &mut self.buses {
            wire.nodes.push(Attached::new(wire.own.bitrate_bps));
        }
        Ok(place)
    }

    /// Ends a node: it sends nothing more but what may be under way.
    pub fn end(&mut self, place: usize) {
        let Some(node) = self.nodes.get_mut(place) else { return };
        node.end();
        self.places[place].power_on_ns = None;
        self.places[place].intake.clear();
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
        let before = self.results.report.errors.iter().cloned();
        before
            .chain(self.nodes.iter().filter_map(|node| Some((node.name.clone(), node.error.clone()?))))
            .collect()
    }

    /// Whether every script with tests has ended, or, if none has tests, every script has.
    pub(crate) fn is_over(&self) -> bool {
        is_over(&self.nodes)
    }

    /// When something is due next, on the buses or of the nodes.
    fn next_ns(&mut self) -> u64 {
        let now_ns = self.now_ns;
        let of_scripts = self.nodes.iter().zip(&self.places).filter_map(|(node, place)| {
            let woken = node.wake_ns.map(|wake_ns| wake_ns.max(place.intake.stalled_until_ns()));
            [woken, place.intake.due_ns(), place.power_on_ns].into_iter().flatten().min()
        });
        let of_repeats =
            self.repeats.iter().filter(|repeat| !self.waits(repeat)).map(|repeat| repeat.due_ns).min();
        let of_keys = self.keys.front().map(|(at_ns, _)| *at_ns);
        let of_faults = self.faults.front().map(|planned| planned.at_ns);
        let others = [of_repeats, of_keys, of_faults, self.intake.due_ns()];
        let mut next_ns = of_scripts.chain(others.into_iter().flatten()).min().unwrap_or(NEVER);
        for wire in &mut self.buses {
            next_ns = next_ns.min(wire.recovers_at_ns(now_ns).unwrap_or(NEVER));
            next_ns = next_ns.min(wire.with(|bus, nodes| bus.next_event_ns(now_ns, nodes)));
        }
        next_ns
    }

    /// Does what is due next, and returns false if nothing will be.
    pub(crate) fn step(&mut self, end_ns: u64) -> bool {
        let next_ns = self.next_ns();
        if next_ns > end_ns {
            self.now_ns = end_ns;
            return next_ns != NEVER;
        }
        self.now_ns = next_ns.max(self.now_ns);
        self.inject_faults();
        for channel in Channel::ALL {
            self.pass(channel);
        }
        self.go_on();
        self.queue_repeated();
        let now_ns = self.now_ns;
        while let Some((_, key)) = self.keys.pop_front_if(|(at_ns, _)| *at_ns <= now_ns) {
            for place in 0..self.nodes.len() {
                self.hand(place, Input::Key(key));
            }
        }
        self.wake();
        if !self.has_keys {
            self.results.without_keys(&self.nodes, self.now_ns);
        }
        true
    }

    /// Hosts that stalled take what waits for them.
    fn go_on(&mut self) {
        while let Some(record) = self.intake.next(self.now_ns) {
            self.records.push(record);
        }
        for place in 0..self.nodes.len() {
            while let Some(input) = self.places[place].intake.next(self.now_ns) {
                self.resume(place, Some(input));
            }
        }
    }

    /// What waits for a caller whose host stalls when a run ends.
    pub(crate) fn end_stall(&mut self) {
        self.records.extend(std::iter::from_fn(|| self.intake.next(NEVER)));
    }

    /// Whether a frame of a script that has ended is not on the bus yet.
    pub(crate) fn is_sending(&self) -> bool {
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
        let mut is_lost = false;
        for seen in wire.own.take_seen() {
            if let Sighting::Frame(frame, whose) = seen {
                self.results.frame(now_ns, channel, frame);
                is_lost = whose == Whose::Others && self.losses.take(now_ns);
            }
            self.record(channel, seen, is_lost);
        }
        for place in 0..self.nodes.len() {
            for seen in self.buses[channel.index()].nodes[place].take_seen() {
                match seen {
                    Sighting::Frame(frame, Whose::Others) => self.arrive(place, channel, frame, is_lost),
                    Sighting::Frame(_, whose) => {
                        self.results.report.frames_sent += 1;
                        if whose == Whose::Own {
                            self.hand(place, Input::Sent { channel });
                        }
                    }
                    Sighting::Error(kind, _) => self.hand(place, Input::Error { channel, kind: Some(kind) }),
                    Sighting::State(state, _) => self.hand(place, Input::State { channel, state }),
                }
            }
        }
    }

    /// Something that the caller's controller has seen.
    fn record(&mut self, channel: Channel, seen: Sighting, is_lost: bool) {
        let now_ns = self.now_ns;
        let record =
            |event| TraceRecord { time_ns: now_ns as i64, device_ns: None, channel: channel.number(), event };
        let event = match seen {
            Sighting::Frame(frame, Whose::Others) => {
                let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
                let stage = match self.intake.take_frame(now_ns, record(event), is_lost) {
                    Taken::Now(record) => return self.records.push(record),
                    Taken::Later => return,
                    Taken::Lost(stage) => stage,
                };
                if let Some(last) = self.intake.last_waiting()
                    && last.channel == channel.number()
                    && let TraceEvent::Lost { stage: Some(of), count, .. } = &mut last.event
                    && *of == stage
                {
                    *count += 1;
                    return;
                }
                TraceEvent::Lost { stage: Some(stage), count: 1, at_least: false }
            }
            Sighting::Frame(frame, _) => {
                TraceEvent::Frame { frame: frame.into(), direction: Direction::Tx, late: false }
            }
            Sighting::Error(kind, counters) => {
                TraceEvent::BusError { kind: Some(kind), counters: Some(counters) }
            }
            Sighting::State(state, counters) => TraceEvent::State { state, counters: Some(counters) },
        };
        let taken = self.intake.take_other(now_ns, record(event));
        self.records.extend(taken);
    }

    /// Another node's frame arrives at a script's device.
    fn arrive(&mut self, place: usize, channel: Channel, frame: Frame, is_lost: bool) {
        let now_ns = self.now_ns;
        if self.nodes[place].has_ended {
            self.results.report.frames_received += 1;
            return;
        }
        let intake = &mut self.places[place].intake;
        match intake.take_frame(now_ns, Input::Frame { channel, frame, at_ns: now_ns }, is_lost) {
            Taken::Lost(stage) => {
                self.results.report.frames_lost += 1;
                // As the device's records of losses: one stands for all frames that are missing there.
                let is_known = stage == LossStage::Queue && matches!(intake.last_waiting(), Some(Input::Gap));
                if !is_known {
                    self.hand(place, Input::Gap);
                }
            }
            Taken::Later => self.results.report.frames_received += 1,
            Taken::Now(input) => {
                self.results.report.frames_received += 1;
                self.resume(place, Some(input));
            }
        }
    }

    /// Hands something to a script, unless its host stalls: then it waits.
    fn hand(&mut self, place: usize, input: Input) {
        if self.nodes[place].has_ended {
            return;
        }
        if let Some(input) = self.places[place].intake.take_other(self.now_ns, input) {
            self.resume(place, Some(input));
        }
    }

    /// Whether a repetition's last frame has not been sent yet: as in a device, it is not due again before.
    fn waits(&self, repeat: &Repeat) -> bool {
        let Wire { nodes, own, .. } = &self.buses[repeat.channel.index()];
        nodes.get(repeat.node).unwrap_or(own).holds(repeat.handle)
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
            let stalled_until_ns = self.places[place].intake.stalled_until_ns();
            if self.nodes[place].wake_ns.is_some_and(|wake_ns| wake_ns.max(stalled_until_ns) <= self.now_ns) {
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
        let mut faults = Vec::new();
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
                Some(Output::Fault { node, fault }) => faults.push((node, fault)),
                // Simulated controllers have no replies of their own.
                Some(
                    Output::Reply { .. }
                    | Output::Log(_)
                    | Output::Tests(_)
                    | Output::TestBegan(_)
                    | Output::Test { .. },
                )
                | None => {}
            }
        }
        if has_ended {
            // A node that is gone sends nothing more.
            self.repeats.retain(|repeat| repeat.node != place);
        }
        if has_failed {
            self.drop_waiting(place);
        }
        // What the node has sent by then is on its way, also if the fault is its own end.
        for (node, fault) in faults {
            self.take_fault(node, fault);
        }
    }

    /// What a node's controllers have not begun to send is not sent.
    fn drop_waiting(&mut self, place: usize) {
        for wire in &mut self.buses {
            self.results.report.frames_not_sent += wire.nodes[place].drop_waiting() as u64;
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
