//! A run on a device, turn by turn.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use cantap::device::Records;
use cantap::device::{DeviceTime, Transmission};
use cantap::wire::Hello;
use cantap::wire::message::{TRIGGER_TAG, capability};
use cantap::{Device, TraceEvent, TraceRecord};
use cantap_can::{CHANNELS, Channel, DEVICE_TAG, Frame};
use cantap_trace::{Direction, TraceFrame};

use super::port::{Direct, Port};
use super::repeat::Repeat;
use super::run_clock::RunClock;
use super::settings::{Live, LiveError};
use crate::device_replies::DeviceReplies;
use crate::exchange::{Input, Output};
use crate::files::GrantedFiles;
use crate::node::{Node, Script, ScriptError};
use crate::placement::Target;
use crate::report::{Message, Report};
use crate::results::{Results, is_over};
use crate::surroundings::Surroundings;

/// The longest wait for records: Ctrl-C is seen after it.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// How long frames that are under way at the end may take to be on the bus.
const FAREWELL: Duration = Duration::from_millis(200);
/// Batches of records from before a run, at most: on a full bus there is always another one.
const MOST_BEFORE: u32 = 1000;
/// The place of the caller, which is none of the scripts.
const CALLER: usize = usize::MAX;

impl Live {
    /// The same for a caller that has the device's records itself and hands them over between turns, and adds scripts as it likes.
    /// [`Self::duration`] is its business.
    pub fn start<'d>(&self, device: &'d Device) -> LiveRun<'d> {
        self.start_through(Box::new(Direct::new(device)), device.hello(), device.device_time())
    }

    /// The same through anything that leads to a device.
    pub(super) fn start_through<'d>(
        &self,
        port: Box<dyn Port + 'd>,
        hello: &Hello,
        device_time: DeviceTime,
    ) -> LiveRun<'d> {
        // An adapter's clock is this computer's.
        let has_clock = hello.capabilities & capability::ADAPTER == 0;
        let device_time = has_clock.then_some(device_time);
        LiveRun {
            port,
            surroundings: Surroundings {
                decoder: Arc::clone(&self.decoder),
                seed: self.seed,
                files: Arc::new(GrantedFiles::under(self.readable.clone())),
                replies: None,
                nodes: None,
            },
            nodes: Vec::new(),
            under_way: BTreeMap::new(),
            ended: Default::default(),
            repeated: BTreeMap::new(),
            dropped: Vec::new(),
            slots: BTreeMap::new(),
            replies: BTreeMap::new(),
            replied: BTreeMap::new(),
            repeats: Vec::new(),
            target: Target::of(hello),
            periodic_slots: hello.periodic_slots,
            tick_hz: hello.tick_hz,
            results: Results::default(),
            clock: RunClock::start(device_time),
            now_ns: 0,
            stamp_ns: 0,
        }
    }
}

/// Returns the next key that the user has typed.
pub type Keys<'a> = Box<dyn FnMut() -> Option<char> + 'a>;

/// Scripts on a device, turn by turn. Its end is the end of everything that they began.
pub struct LiveRun<'d> {
    pub(super) port: Box<dyn Port + 'd>,
    pub(super) target: Target,
    pub(super) periodic_slots: u8,
    /// The rate of the device's clock.
    pub(super) tick_hz: u32,
    surroundings: Surroundings,
    nodes: Vec<Node>,
    /// Whose frame a tag is, and whether the script waits to see it confirmed.
    under_way: BTreeMap<(usize, u32), (usize, bool)>,
    /// Of each channel, how transmissions ended whose records have not come, in the device's order: a record does not say whose frame it is.
    ended: [VecDeque<Transmission>; CHANNELS],
    /// Whose each slot is by channel, also when it has ended.
    pub(super) repeated: BTreeMap<(usize, u8), usize>,
    /// Frames for which there was no room, by script, of which it does not know yet.
    dropped: Vec<(usize, Channel)>,
    /// The device's slot of each repetition, by channel, script and handle.
    pub(super) slots: BTreeMap<(usize, usize, u32), u8>,
    /// Whose each of the device's replies is, by channel and slot.
    pub(super) replies: BTreeMap<(usize, u8), usize>,
    /// The same of those that have ended, too.
    pub(super) replied: BTreeMap<(usize, u8), usize>,
    /// What is repeated from here, because the device has no more slots.
    pub(super) repeats: Vec<Repeat>,
    results: Results,
    clock: RunClock,
    pub(super) now_ns: u64,
    /// The time of the last record: it may be before the present turn's.
    stamp_ns: u64,
}

impl LiveRun<'_> {
    pub(super) fn go(
        &mut self,
        mut records: Records,
        duration: Option<Duration>,
        on_record: &mut dyn FnMut(TraceRecord),
        on_message: &mut dyn FnMut(Message),
        mut keys: Option<Keys<'_>>,
        goes_on: &mut dyn FnMut() -> bool,
    ) -> Result<(), LiveError> {
        // What came before the run is in the trace, and nothing that its scripts have seen.
        for _ in 0..MOST_BEFORE {
            match records.next_batch(Duration::ZERO)? {
                Some(batch) if !batch.is_empty() => batch.into_iter().for_each(&mut *on_record),
                _ => break,
            }
        }
        let is_wanted = |run: &Self| !run.is_over() || run.results.is_tracing(run.now_ns);
        let is_in_time = |run: &mut Self| {
            duration.is_none_or(|duration| u128::from(run.clock.now_ns()) < duration.as_nanos())
        };
        while is_in_time(self) && is_wanted(self) && goes_on() {
            match &mut keys {
                Some(keys) => std::iter::from_fn(keys).try_for_each(|key| self.key(key))?,
                None => self.results.without_keys(&self.nodes, self.now_ns),
            }
            let wait = self.turn()?;
            self.results.messages.drain(..).for_each(&mut *on_message);
            let Some(batch) = records.next_batch(wait.min(LOOK_EVERY))? else { break };
            for record in batch {
                on_record(record);
                self.take_record(record)?;
            }
            self.results.messages.drain(..).for_each(&mut *on_message);
        }
        // However short the run was: before their first turn, scripts wait for nothing.
        if keys.is_none() {
            self.results.without_keys(&self.nodes, self.now_ns);
        }
        Ok(())
    }

    /// The device may reply in place of scripts on its only open channel, on which there is only one.
    pub(super) const fn let_device_reply(&mut self, channel: Channel, slots: u8) {
        self.surroundings.replies = Some(DeviceReplies { channel, slots });
    }

    /// One more node, from now on; returns its place.
    ///
    /// # Errors
    /// If it is not in the language; what goes wrong later is in [`Self::errors`].
    pub fn add(&mut self, script: &Script) -> Result<usize, ScriptError> {
        self.add_until(script, Arc::default())
    }

    /// The same; it ends when `stop` becomes true, also in the middle of a computation.
    pub(super) fn add_until(&mut self, script: &Script, stop: Arc<AtomicBool>) -> Result<usize, ScriptError> {
        self.nodes.push(Node::start_nth(self.nodes.len() as u64, script, &self.surroundings, stop)?);
        Ok(self.nodes.len() - 1)
    }

    /// Ends a node: it sends nothing more but what is under way.
    ///
    /// # Errors
    /// As [`Self::turn`].
    pub fn end(&mut self, place: usize) -> Result<(), LiveError> {
        if let Some(node) = self.nodes.get_mut(place) {
            node.end();
        }
        self.end_replies(|of| of == place)?;
        self.end_repeats(|of, _| of == place)
    }

    /// Whether a node has ended.
    pub fn has_ended(&self, place: usize) -> bool {
        self.nodes.get(place).is_none_or(|node| node.has_ended)
    }

    /// The error with which a node has ended.
    pub(super) fn error_of(&self, place: usize) -> Option<&str> {
        self.nodes.get(place)?.error.as_deref()
    }

    /// The test that a node is in.
    pub(super) fn test_of(&self, place: usize) -> Option<&str> {
        self.results.tests.get(&self.nodes.get(place)?.name).map(String::as_str)
    }

    /// Frames of the scripts that were not on the bus yet.
    pub(super) fn waiting(&self) -> usize {
        self.under_way.len()
    }

    /// Scripts that have ended with an error, and the error.
    pub fn errors(&self) -> Vec<(String, String)> {
        self.nodes.iter().filter_map(|node| Some((node.name.clone(), node.error.clone()?))).collect()
    }

    /// Sends a frame of the caller's.
    ///
    /// # Errors
    /// As [`Self::turn`].
    pub fn send(&mut self, channel: Channel, frame: Frame) -> Result<(), LiveError> {
        self.send_of(CALLER, (channel, frame), true)
    }

    /// Sends a frame of the caller's now and then again after each period, until the next call with the same handle: with another frame
    /// or period, or with none.
    ///
    /// # Errors
    /// As [`Self::turn`].
    pub fn repeat(&mut self, handle: u32, repeated: Option<(Channel, Frame, u64)>) -> Result<(), LiveError> {
        match repeated {
            Some((channel, frame, period_ns)) => self.repeat_of(CALLER, (handle, channel), frame, period_ns),
            None => self.end_repeats(|of, own| (of, own) == (CALLER, handle)),
        }
    }

    /// Whether every script with tests has ended, or, if none has tests, every script has.
    pub fn is_over(&self) -> bool {
        is_over(&self.nodes)
    }

    /// Does what is due, and hands to the device what the scripts send. Returns for how long there is nothing to do unless something arrives.
    ///
    /// # Errors
    /// If the device is gone, or refused something.
    pub fn turn(&mut self) -> Result<Duration, LiveError> {
        let now_ns = self.clock.now_ns();
        self.pass_time(now_ns);
        for place in 0..self.nodes.len() {
            if self.nodes[place].wake_ns.is_some_and(|wake_ns| wake_ns <= self.now_ns) {
                self.resume(place, None)?;
            }
        }
        self.send_repeated()?;
        self.port.flush()?;
        self.take_failed()?;
        for (place, channel) in std::mem::take(&mut self.dropped) {
            self.resume(place, Some(Input::NotSent { channel }))?;
        }
        let of_repeats = self.repeats.iter().map(|repeat| repeat.due_ns);
        let wake_ns = self.nodes.iter().filter_map(|node| node.wake_ns).chain(of_repeats).min();
        let until = |wake_ns: u64| Duration::from_nanos(wake_ns.saturating_sub(self.now_ns));
        Ok(wake_ns.map_or(Duration::MAX, until))
    }

    /// The user has typed a key.
    ///
    /// # Errors
    /// As [`Self::turn`].
    pub fn key(&mut self, key: char) -> Result<(), LiveError> {
        self.resume_all(Input::Key(key))
    }

    /// What scripts have logged since the last call.
    pub fn take_messages(&mut self) -> Vec<Message> {
        std::mem::take(&mut self.results.messages)
    }

    /// The report so far.
    pub const fn report(&self) -> &Report {
        &self.results.report
    }

    /// Time never goes back, whatever the stamps are.
    fn pass_time(&mut self, now_ns: u64) {
        self.now_ns = self.now_ns.max(now_ns);
    }

    /// A record of the device. Returns it as a node of the caller's sees it: frames of the scripts are received, its own are sent.
    ///
    /// # Errors
    /// As [`Self::turn`].
    pub fn take_record(&mut self, record: TraceRecord) -> Result<TraceRecord, LiveError> {
        let Some(channel) = Channel::from_number(record.channel) else { return Ok(record) };
        let (stamp_ns, now_ns) = self.clock.stamp_ns(&record);
        self.stamp_ns = stamp_ns;
        // By what is known of the device's clock, it may be yet to come.
        self.pass_time(stamp_ns.min(now_ns));
        match record.event {
            TraceEvent::Frame { frame, direction: Direction::Tx, late } => {
                let is_callers = self.take_sent(channel, frame)?;
                let direction = if is_callers { Direction::Tx } else { Direction::Rx };
                return Ok(TraceRecord { event: TraceEvent::Frame { frame, direction, late }, ..record });
            }
            TraceEvent::Frame { frame, .. } => self.take_frame(channel, frame)?,
            event => self.take_event(channel, event)?,
        }
        Ok(record)
    }

    fn take_event(&mut self, channel: Channel, event: TraceEvent) -> Result<(), LiveError> {
        let input = match event {
            TraceEvent::BusError { kind, .. } => Input::Error { channel, kind },
            TraceEvent::State { state, .. } => Input::State { channel, state },
            TraceEvent::Lost { count, .. } => {
                self.results.report.frames_lost += u64::from(count);
                Input::Gap
            }
            _ => return Ok(()),
        };
        self.resume_all(input)
    }

    /// A frame of another node, or of another client of a shared device.
    fn take_frame(&mut self, channel: Channel, frame: TraceFrame) -> Result<(), LiveError> {
        let TraceFrame::Classic(frame) = frame else {
            // Scripts have no CAN FD: to them, a frame is missing.
            self.results.report.frames_lost += 1;
            return self.resume_all(Input::Gap);
        };
        self.results.frame(self.stamp_ns, channel, frame);
        self.results.report.frames_received += 1;
        self.resume_all(Input::Frame { channel, frame, at_ns: self.stamp_ns })
    }

    /// A frame that the device has sent: its confirmation, which says for whom, has come before its record. Returns whether it is the
    /// caller's.
    fn take_sent(&mut self, channel: Channel, frame: TraceFrame) -> Result<bool, LiveError> {
        self.collect_ended()?;
        let ended = &mut self.ended[channel.index()];
        let Some(place) = ended.iter().position(|ended| ended.result == Ok(frame)) else {
            // Sent before the run: its confirmation went to whoever sent it.
            return Ok(false);
        };
        let tag = ended[place].tag;
        // What is before it has failed, or its record was lost.
        let until: Vec<Transmission> = ended.drain(..=place).collect();
        let is_callers = self.known_sender(channel, tag).is_some_and(|(sender, _)| sender == CALLER);
        until.into_iter().try_for_each(|ended| self.pass_on(ended))?;
        Ok(is_callers)
    }

    /// Passes on what failed: it has no record.
    fn take_failed(&mut self) -> Result<(), LiveError> {
        self.collect_ended()?;
        for channel in Channel::ALL {
            while let Some(failed) = self.ended[channel.index()].pop_front_if(|ended| ended.result.is_err()) {
                self.pass_on(failed)?;
            }
        }
        Ok(())
    }

    fn collect_ended(&mut self) -> Result<(), LiveError> {
        self.port.take_ended()?.into_iter().for_each(|ended| self.take_transmission(ended));
        Ok(())
    }

    /// How a transmission ended; before its record.
    pub(super) fn take_transmission(&mut self, ended: Transmission) {
        self.ended[ended.channel.index()].push_back(ended);
    }

    /// Passes on how a transmission ended: to the sender as such, to the others as a frame.
    fn pass_on(&mut self, ended: Transmission) -> Result<(), LiveError> {
        let Transmission { channel, tag, result, .. } = ended;
        match (result, self.sender(channel, tag)) {
            (Err(_), Some((place, true))) => self.resume(place, Some(Input::NotSent { channel })),
            (Err(_), _) => Ok(()),
            (Ok(TraceFrame::Classic(frame)), Some((sender, is_awaited))) => {
                self.sent(channel, tag, frame);
                for place in 0..self.nodes.len() {
                    match (place == sender, is_awaited) {
                        (false, _) => {
                            self.resume(place, Some(Input::Frame { channel, frame, at_ns: self.stamp_ns }))?;
                        }
                        // Repetitions are not among the frames that a script waits to see confirmed.
                        (true, true) => self.resume(place, Some(Input::Sent { channel }))?,
                        (true, false) => {}
                    }
                }
                Ok(())
            }
            // Of an earlier run, which had it repeated.
            (Ok(_), None)
                if (DEVICE_TAG..TRIGGER_TAG).contains(&tag) && !self.port.is_of_owner(channel, tag) =>
            {
                Ok(())
            }
            (Ok(frame), _) => self.take_frame(channel, frame),
        }
    }

    /// Which script's a transmission is, if one's, and whether the script waits to see it confirmed. It is not under way any more.
    fn sender(&mut self, channel: Channel, tag: u32) -> Option<(usize, bool)> {
        let sender = self.known_sender(channel, tag);
        self.under_way.remove(&(channel.index(), tag));
        sender
    }

    fn known_sender(&self, channel: Channel, tag: u32) -> Option<(usize, bool)> {
        if let Some(sender) = self.under_way.get(&(channel.index(), tag)) {
            return Some(*sender);
        }
        let slot = |first: u32| u8::try_from(tag.checked_sub(first)?).ok();
        let repeated = slot(DEVICE_TAG).and_then(|slot| self.repeated.get(&(channel.index(), slot)));
        let replied = slot(TRIGGER_TAG).and_then(|slot| self.replied.get(&(channel.index(), slot)));
        repeated.or(replied).map(|place| (*place, false))
    }

    fn sent(&mut self, channel: Channel, tag: u32, frame: Frame) {
        self.results.frame(self.stamp_ns, channel, frame);
        self.results.report.frames_sent += 1;
        self.results.report.frames_repeated += u64::from(tag >= DEVICE_TAG);
    }

    fn resume_all(&mut self, input: Input) -> Result<(), LiveError> {
        (0..self.nodes.len()).try_for_each(|place| self.resume(place, Some(input)))
    }

    fn resume(&mut self, place: usize, input: Option<Input>) -> Result<(), LiveError> {
        // The caller has no turns.
        let Some(node) = self.nodes.get_mut(place) else { return Ok(()) };
        let outputs = node.resume(self.now_ns, input);
        let name = node.name.clone();
        let has_failed = node.error.is_some();
        for output in outputs {
            match self.results.take(&name, self.now_ns, output) {
                // What it sent before its error, without a wait, it sent at the same moment.
                Some(Output::Send { .. }) if has_failed => self.results.report.frames_not_sent += 1,
                Some(Output::Repeat { .. } | Output::Reply { entry: Some(_), .. }) if has_failed => {}
                Some(Output::Send { channel, frame }) => self.send_of(place, (channel, frame), true)?,
                Some(Output::Repeat { handle, channel, frame, period_ns }) => {
                    self.repeat_of(place, (handle, channel), frame, period_ns)?;
                }
                Some(Output::EndRepeat { handle }) => {
                    self.end_repeats(|of, own| (of, own) == (place, handle))?;
                }
                Some(Output::Reply { channel, slot, entry }) => {
                    self.set_reply(place, (channel, slot), entry)?;
                }
                // The first is refused to scripts on a device.
                Some(
                    Output::Fault { .. }
                    | Output::Log(_)
                    | Output::Tests(_)
                    | Output::TestBegan(_)
                    | Output::Test { .. },
                )
                | None => {}
            }
        }
        if self.nodes[place].has_ended {
            self.end_replies(|of| of == place)?;
            self.end_repeats(|of, _| of == place)?;
        }
        Ok(())
    }

    pub(super) fn send_of(
        &mut self,
        place: usize,
        (channel, frame): (Channel, Frame),
        is_awaited: bool,
    ) -> Result<(), LiveError> {
        // A queue that stays full means that nothing leaves, which the report says at the end.
        let tag = self.port.push(place, channel, frame)?;
        if let Some(tag) = tag {
            self.under_way.insert((channel.index(), tag), (place, is_awaited));
        } else {
            self.results.report.frames_not_sent += 1;
            if is_awaited {
                self.dropped.push((place, channel));
            }
        }
        Ok(())
    }

    /// Ends everything that the scripts began, as far as the device is still there.
    /// And returns how it went, and what was logged last.
    pub fn finish(mut self) -> (Report, Vec<Message>) {
        self.end_all();
        let _ = self.port.finish(FAREWELL);
        // Their records are not waited for, and the scripts have had their last turn.
        let _ = self.collect_ended();
        for Transmission { channel, tag, result, .. } in std::mem::take(&mut self.ended).into_iter().flatten()
        {
            if let (Ok(TraceFrame::Classic(frame)), Some(_)) = (result, self.sender(channel, tag)) {
                self.sent(channel, tag, frame);
            }
        }
        if !self.under_way.is_empty() {
            for channel in self
                .under_way
                .keys()
                .map(|(index, _)| Channel::ALL[*index])
                .collect::<std::collections::BTreeSet<_>>()
            {
                let _ = self.port.abort(channel);
            }
        }
        self.results.report.frames_not_sent += self.under_way.len() as u64;
        let messages = self.take_messages();
        (std::mem::take(&mut self.results).finish(&self.nodes, self.now_ns), messages)
    }
}

impl Drop for LiveRun<'_> {
    fn drop(&mut self) {
        self.end_all();
    }
}
