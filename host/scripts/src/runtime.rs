//! A script's thread from inside: its functions call this to send, and to wait for their turn.

mod replies;
mod tests_of_rows;

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::rc::Rc;
use std::sync::mpsc::{Receiver, SyncSender};

use cantap_can::{CHANNELS, Channel, Frame};
use cantap_protocols::active::Machine;
use cantap_signals::{MessageRef, Reading, SignalValue};
use cantap_trace::TraceFrame;
use rhai::{Dynamic, EvalAltResult, FnPtr, FuncArgs, Map, NativeCallContext};

use crate::exchange::{Input, Next, Output, Resume, Turn, Wanted};
use crate::handlers::{BusEvent, Handlers, Repeated, Selector};
use crate::memory;
use crate::row_test::RowTest;
use crate::sandbox::{ENDED, Operations};
use crate::script_frame::ScriptFrame;
use crate::script_result::Result;
use crate::servers::{Server, Servers};
use crate::settings::Settings;
use crate::surroundings::Surroundings;

/// How many unconfirmed frames a script may have: more are a loop without a wait.
const MAX_UNCONFIRMED: usize = 4096;
/// How many frames a script may have repeated: more are a loop that starts one each time.
const MAX_REPEATED: usize = 4096;
/// How many functions, and how many servers, a script may have waiting: each of them is looked at in every turn.
const MAX_WAITING: usize = 8192;
/// What an output costs in operations besides its text: about its bytes.
const OUTPUT_COST: usize = 64;

/// The state of a script.
pub struct Runtime {
    resume: Receiver<Resume>,
    turn: SyncSender<Turn>,
    operations: Operations,
    /// What it shares with the others of its run.
    pub surroundings: Surroundings,
    /// What the user has set for it.
    pub settings: Settings,
    /// What answers for it. Never borrowed while a function of the script runs.
    pub servers: RefCell<Servers>,
    /// Its functions that only send one constant frame.
    constant_replies: RefCell<BTreeMap<String, (Channel, Frame)>>,
    state: RefCell<State>,
}

struct State {
    now_ns: u64,
    outputs: Vec<Output>,
    handlers: Handlers,
    /// The last value of each signal, by `Message.Signal`.
    values: BTreeMap<String, Dynamic>,
    /// Of each channel, whose the frames are that were not on the bus yet, oldest first.
    unconfirmed: [VecDeque<Sender>; CHANNELS],
    /// Its repetitions.
    repeated: BTreeSet<u32>,
    /// The device's replies that it has, by its handles.
    replies: BTreeMap<u32, Vec<u8>>,
    random: fastrand::Rng,
    /// What its own lines have made: tests that have not begun, and whether there can be more.
    tests: VecDeque<RowTest>,
    has_all_tests: bool,
}

/// What of a script sends a frame.
#[derive(Clone, Copy, Debug)]
enum Sender {
    /// Its own functions.
    Script,
    /// A client for which it waits.
    Client,
    /// What answers for it, by its place.
    Server(usize),
}

/// What ends a wait early.
enum Want<'a> {
    /// Nothing does.
    Time,
    /// Nothing can happen any more.
    End,
    /// A frame.
    Frame(&'a Selector),
    /// A client that talks on the bus is done.
    Machine(&'a mut dyn Machine, cantap_can::Channel),
}

impl Runtime {
    /// Of a script that has not begun.
    pub fn new(
        resume: Receiver<Resume>,
        turn: SyncSender<Turn>,
        operations: Operations,
        surroundings: Surroundings,
        settings: BTreeMap<String, String>,
    ) -> Rc<Self> {
        let state = State {
            now_ns: 0,
            outputs: Vec::new(),
            handlers: Handlers::default(),
            values: BTreeMap::new(),
            unconfirmed: Default::default(),
            repeated: BTreeSet::new(),
            replies: BTreeMap::new(),
            random: fastrand::Rng::with_seed(surroundings.seed),
            tests: VecDeque::new(),
            has_all_tests: false,
        };
        Rc::new(Self {
            resume,
            turn,
            operations,
            surroundings,
            settings: Settings::new(settings),
            servers: RefCell::default(),
            constant_replies: RefCell::default(),
            state: RefCell::new(state),
        })
    }

    /// Nanoseconds since the run began.
    pub fn now_ns(&self) -> u64 {
        self.state.borrow().now_ns
    }

    /// Calls `act` with what the script reacts to.
    pub fn with_handlers<R>(&self, act: impl FnOnce(&mut Handlers) -> R) -> R {
        act(&mut self.state.borrow_mut().handlers)
    }

    /// Adds something that the script reacts to.
    pub fn react<R>(&self, add: impl FnOnce(&mut Handlers) -> R) -> Result<R> {
        has_place(self.with_handlers(|handlers| handlers.len()), "functions")?;
        Ok(self.with_handlers(add))
    }

    /// Adds what answers for the script; returns its place.
    pub fn serve_with(&self, channel: Channel, name: String, server: Server) -> Result<usize> {
        let mut servers = self.servers.borrow_mut();
        has_place(servers.len(), "servers")?;
        Ok(servers.add(channel, name, server))
    }

    /// Calls a function after a time, then again if it is repeated; returns its handle.
    pub fn after(&self, delay_ns: u64, repeated: Option<Repeated>, call: FnPtr) -> Result<u32> {
        has_place(self.with_handlers(|handlers| handlers.len()), "functions")?;
        let State { handlers, now_ns, random, .. } = &mut *self.state.borrow_mut();
        Ok(handlers.at(*now_ns + delay_ns, repeated, call, random))
    }

    /// Counts as so many operations.
    pub fn spend(&self, cost: usize) {
        self.operations.spend(cost);
    }

    /// Calls `act` with the script's random numbers.
    pub fn with_random<R>(&self, act: impl FnOnce(&mut fastrand::Rng) -> R) -> R {
        act(&mut self.state.borrow_mut().random)
    }

    /// Hands over at the end of this turn.
    pub fn output(&self, output: Output) -> Result<()> {
        self.output_of(Sender::Script, output)
    }

    fn send(&self, sender: Sender, channel: Channel, frame: Frame) -> Result<()> {
        self.output_of(sender, Output::Send { channel, frame })
    }

    fn output_of(&self, sender: Sender, output: Output) -> Result<()> {
        let text_len = if let Output::Log(text) = &output { text.len() } else { 0 };
        self.operations.spend(OUTPUT_COST + text_len);
        let mut state = self.state.borrow_mut();
        match &output {
            Output::Send { channel, .. } => {
                state.unconfirmed[channel.index()].push_back(sender);
                if state.unconfirmed.iter().map(VecDeque::len).sum::<usize>() > MAX_UNCONFIRMED {
                    let reason =
                        format!("{MAX_UNCONFIRMED} frames wait to be sent; wait(…) before sending more");
                    return Err(reason.into());
                }
            }
            Output::Repeat { handle, .. } => {
                if state.repeated.len() >= MAX_REPEATED && !state.repeated.contains(handle) {
                    let reason =
                        format!("{MAX_REPEATED} frames are repeated already; stop(…) one of them first");
                    return Err(reason.into());
                }
                state.repeated.insert(*handle);
            }
            Output::EndRepeat { handle } => {
                state.repeated.remove(handle);
            }
            Output::Reply { .. }
            | Output::Fault { .. }
            | Output::Log(_)
            | Output::Tests(_)
            | Output::TestBegan(_)
            | Output::Test { .. } => {}
        }
        state.outputs.push(output);
        Ok(())
    }

    /// Whether nothing of the script can happen any more: it has no function to call, and repeats nothing.
    fn has_nothing_left(&self) -> bool {
        let state = self.state.borrow();
        state.handlers.is_empty()
            && state.repeated.is_empty()
            && state.replies.is_empty()
            && self.servers.borrow().is_empty()
    }

    /// The last value of a signal, if it was on the bus.
    pub fn value(&self, name: &str) -> Option<Dynamic> {
        self.state.borrow().values.get(name).cloned()
    }

    /// Waits for the first turn.
    pub fn begin(&self) -> Result<()> {
        self.take_turn().map(|_| ())
    }

    /// Lets time pass up to `until_ns` while the script's functions are called.
    pub fn wait(&self, context: &NativeCallContext<'_>, until_ns: u64) -> Result<()> {
        self.pump(context, Some(until_ns), Want::Time).map(|_| ())
    }

    /// The same for as long as anything of the script can happen.
    pub fn serve(&self, context: &NativeCallContext<'_>) -> Result<()> {
        self.pump(context, None, Want::End).map(|_| ())
    }

    /// The next selected frame, if one comes in time.
    pub fn wait_for(
        &self,
        context: &NativeCallContext<'_>,
        until_ns: u64,
        selector: &Selector,
    ) -> Result<Option<ScriptFrame>> {
        self.pump(context, Some(until_ns), Want::Frame(selector))
    }

    /// Runs a client on the bus until it is done.
    pub fn run_client(
        &self,
        context: &NativeCallContext<'_>,
        channel: cantap_can::Channel,
        client: &mut dyn Machine,
    ) -> Result<()> {
        self.pump(context, None, Want::Machine(client, channel)).map(|_| ())
    }

    fn pump(
        &self,
        context: &NativeCallContext<'_>,
        until_ns: Option<u64>,
        mut want: Want<'_>,
    ) -> Result<Option<ScriptFrame>> {
        loop {
            while let Some(call) = self.take_due() {
                self.call(context, &call, ())?;
            }
            self.serve_calls(context)?;
            self.send_of_servers()?;
            let mut until_ns = until_ns;
            if let Want::Machine(machine, channel) = &mut want {
                while let Some(frame) = machine.next(self.now_ns()) {
                    self.send(Sender::Client, *channel, frame)?;
                }
                if machine.is_done() {
                    return Ok(None);
                }
                until_ns = machine.due_ns();
            } else if until_ns.is_some_and(|until_ns| until_ns <= self.now_ns())
                || matches!(want, Want::End) && self.has_nothing_left()
            {
                return Ok(None);
            }
            let timer_ns = self.with_handlers(|handlers| handlers.next_due_ns());
            let server_ns = self.servers.borrow().due_ns();
            let wake_ns = [until_ns, timer_ns, server_ns].into_iter().flatten().min();
            self.hand_over(Next::Wait { until_ns: wake_ns, inputs: self.wanted(&want) })?;
            let Some(input) = self.take_turn()? else { continue };
            if let Some(found) = self.take_input(context, input, &mut want)? {
                return Ok(Some(found));
            }
        }
    }

    /// Calls the script's functions for what others have asked its servers.
    fn serve_calls(&self, context: &NativeCallContext<'_>) -> Result<()> {
        loop {
            let Some(call) = self.servers.borrow_mut().take_call() else { return Ok(()) };
            let result = call.function.call_within_context::<Dynamic>(context, call.arguments.clone())?;
            self.servers.borrow_mut().answer(call, result)?;
        }
    }

    fn send_of_servers(&self) -> Result<()> {
        let now_ns = self.now_ns();
        loop {
            let next = self.servers.borrow_mut().next(now_ns);
            let Some((place, channel, frame)) = next else { break };
            self.send(Sender::Server(place), channel, frame)?;
        }
        while let Some(trouble) = self.servers.borrow_mut().take_trouble() {
            self.output(Output::Log(trouble))?;
        }
        Ok(())
    }

    /// The oldest frame on a channel was on the bus, or never will be.
    fn confirm(&self, channel: Channel, client: Option<&mut dyn Machine>, is_sent: bool) {
        let sender = self.state.borrow_mut().unconfirmed[channel.index()].pop_front();
        match (sender, client) {
            (Some(Sender::Client), Some(client)) if is_sent => client.sent(self.now_ns()),
            // Whoever waits for what it never sent gives up in time.
            (Some(Sender::Server(place)), _) => self.servers.borrow_mut().sent(place, self.now_ns()),
            _ => {}
        }
    }

    fn take_due(&self) -> Option<FnPtr> {
        let State { handlers, now_ns, random, .. } = &mut *self.state.borrow_mut();
        handlers.take_due(*now_ns, random)
    }

    fn wanted(&self, want: &Want<'_>) -> Wanted {
        let state = self.state.borrow();
        let is_client = matches!(want, Want::Machine(..));
        // With a database, the last value of each signal is kept.
        let keeps_values = self.surroundings.decoder.messages().next().is_some();
        let has_servers = !self.servers.borrow().is_empty();
        Wanted {
            frames: keeps_values
                || is_client
                || has_servers
                || matches!(want, Want::Frame(_))
                || state.handlers.has_frames(),
            confirmations: is_client || has_servers,
            events: state.handlers.has_events(),
            keys: state.handlers.has_keys(),
        }
    }

    /// The turn ends.
    fn hand_over(&self, next: Next) -> Result<()> {
        let outputs = std::mem::take(&mut self.state.borrow_mut().outputs);
        let texts: usize = outputs.iter().map(Output::text_bytes).sum();
        memory::hand_over(outputs.capacity() * size_of::<Output>() + texts);
        self.turn.send(Turn { outputs, next }).map_err(|_| Box::new(ended()))
    }

    /// The script has ended.
    pub fn finish(&self, error: Option<String>) {
        // If nobody is there any more, nobody wants to know.
        let _ = self.hand_over(Next::End { error });
    }

    fn take_turn(&self) -> Result<Option<Input>> {
        let Resume { now_ns, input, confirmed } = self.resume.recv().map_err(|_| Box::new(ended()))?;
        let mut state = self.state.borrow_mut();
        state.now_ns = now_ns;
        for (unconfirmed, confirmed) in state.unconfirmed.iter_mut().zip(confirmed) {
            unconfirmed.drain(..confirmed.min(unconfirmed.len()));
        }
        drop(state);
        self.operations.reset();
        Ok(input)
    }

    /// Calls the functions for an input; returns the frame that ends the wait.
    fn take_input(
        &self,
        context: &NativeCallContext<'_>,
        input: Input,
        want: &mut Want<'_>,
    ) -> Result<Option<ScriptFrame>> {
        let now_ns = self.now_ns();
        match input {
            Input::Sent { channel } | Input::NotSent { channel } => {
                let is_sent = matches!(input, Input::Sent { .. });
                match want {
                    Want::Machine(machine, _) => self.confirm(channel, Some(&mut **machine), is_sent),
                    _ => self.confirm(channel, None, is_sent),
                }
            }
            Input::Gap => {
                self.servers.borrow_mut().gap(now_ns);
                if let Want::Machine(machine, _) = want {
                    machine.gap(now_ns);
                }
            }
            Input::Key(key) => {
                for (gets_key, call) in self.with_handlers(|handlers| handlers.for_key(key)) {
                    if gets_key {
                        self.call(context, &call, (key.to_string(),))?;
                    } else {
                        self.call(context, &call, ())?;
                    }
                }
            }
            Input::Error { channel, kind } => self.take_event(context, BusEvent::Error(channel, kind))?,
            Input::State { channel, state } => self.take_event(context, BusEvent::State(channel, state))?,
            Input::Frame { channel, frame, at_ns } => {
                let frame = ScriptFrame { channel, frame, at_ns };
                let message = self.surroundings.decoder.find(channel.number(), frame.frame.id());
                let signals = message.map(|message| self.signals_of(&frame, message));
                if let Want::Machine(machine, of) = want
                    && *of == channel
                    && !frame.frame.is_remote()
                {
                    machine.hear(now_ns, frame.frame.id(), frame.frame.data());
                }
                if !frame.frame.is_remote() {
                    self.servers.borrow_mut().hear(now_ns, channel, &frame.frame);
                    self.serve_calls(context)?;
                }
                for (as_message, call) in self.with_handlers(|handlers| handlers.for_frame(&frame, message)) {
                    match &signals {
                        Some(signals) if as_message => self.call(context, &call, (signals.clone(),))?,
                        _ => self.call(context, &call, (frame,))?,
                    }
                }
                if let Want::Frame(selector) = want
                    && selector.selects(&frame, message)
                {
                    return Ok(Some(frame));
                }
            }
        }
        Ok(None)
    }

    /// Calls a function of the script; what it returns does not matter.
    #[expect(clippy::unused_self, reason = "only a script's own thread may call its functions")]
    fn call(&self, context: &NativeCallContext<'_>, call: &FnPtr, arguments: impl FuncArgs) -> Result<()> {
        call.call_within_context::<Dynamic>(context, arguments).map(|_| ())
    }

    fn take_event(&self, context: &NativeCallContext<'_>, event: BusEvent) -> Result<()> {
        let (channel, text) = match event {
            BusEvent::Error(channel, kind) => {
                (channel, kind.map_or("unknown", cantap_can::BusErrorKind::name))
            }
            BusEvent::State(channel, state) => (channel, state.name()),
        };
        for call in self.with_handlers(|handlers| handlers.for_event(event)) {
            let channel = i64::from(channel.number());
            self.call(context, &call, (channel, text.to_owned()))?;
        }
        Ok(())
    }

    /// The values in a frame, which become the last ones of their signals.
    fn signals_of(&self, frame: &ScriptFrame, message: MessageRef) -> Map {
        let mut map = self.decode(frame);
        let name = &self.surroundings.decoder.message(message).name;
        let mut state = self.state.borrow_mut();
        for (signal, value) in &map {
            state.values.insert(format!("{name}.{signal}"), value.clone());
        }
        drop(state);
        map.insert("frame".into(), Dynamic::from(*frame));
        map
    }

    /// The values in a frame by the signals' names: numbers, or a text where J1939 has one in place of a value.
    pub fn decode(&self, frame: &ScriptFrame) -> Map {
        let mut values: Vec<SignalValue> = Vec::new();
        let traced = TraceFrame::from(frame.frame);
        let Some(message) = self.surroundings.decoder.decode(frame.channel.number(), &traced, &mut values)
        else {
            return Map::new();
        };
        let message = self.surroundings.decoder.message(message);
        let readings = values.iter().map(|value| Reading::of(message, value));
        readings
            .map(|reading| {
                let value = match reading.number_for_programs() {
                    Some(number) => Dynamic::from(number.as_f64()),
                    None => Dynamic::from(reading.indicator.unwrap_or_default().to_owned()),
                };
                (reading.label.as_ref().into(), value)
            })
            .collect()
    }
}

/// The error that ends a script whose bus is gone.
fn ended() -> EvalAltResult {
    EvalAltResult::ErrorTerminated(ENDED.into(), rhai::Position::NONE)
}

/// Whether there is room for one more of what waits.
fn has_place(len: usize, what: &str) -> Result<()> {
    if len < MAX_WAITING {
        return Ok(());
    }
    Err(format!("{MAX_WAITING} {what} are waiting already; add none each time that something happens").into())
}
