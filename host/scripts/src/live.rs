//! Scripts as nodes on a real bus, through a device.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use cantap::device::Transmission;
use cantap::transmit::Stream;
use cantap::wire::message::{OTHERS_TAG, Periodic};
use cantap::{Device, DeviceError, TraceEvent, TraceRecord};
use cantap_can::{Channel, DEVICE_TAG, Frame};
use cantap_signals::Decoder;
use cantap_trace::{Direction, TraceFrame};

use crate::exchange::{Input, Output};
use crate::node::{Node, Script, ScriptError};
use crate::report::{Message, Report};
use crate::results::{Results, is_over};

/// The longest wait for records: Ctrl-C is seen after it.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// How long frames that are under way at the end may take to be on the bus.
const FAREWELL: Duration = Duration::from_millis(200);

/// What a run on a device needs.
#[derive(Clone, Debug)]
pub struct Live {
    /// The databases for messages and signals.
    pub decoder: Arc<Decoder>,
    /// Selects another sequence of random numbers; each script has its own.
    pub seed: u64,
    /// When the run ends, since its beginning; scripts with tests end it earlier.
    pub duration: Option<Duration>,
}

/// Why a run on a device broke off.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LiveError {
    /// A script cannot run.
    #[error(transparent)]
    Script(#[from] ScriptError),
    /// The device is gone, or refused something.
    #[error(transparent)]
    Device(#[from] DeviceError),
}

impl Live {
    /// Runs scripts on the open channels of a device, which have to be in normal mode to send. Times are those of the device's stamps; the
    /// scripts' own timers follow the computer's clock, and repeated frames the device's.
    ///
    /// `keys` returns the next key that the user has typed, if there is one; without it, none come.
    ///
    /// At the end, however it comes, nothing is repeated any more.
    ///
    /// # Errors
    /// If a script is not in the language, or the device is gone; what else goes wrong is in the report.
    pub fn run(
        &self,
        device: &Device,
        scripts: &[Script],
        on_record: &mut dyn FnMut(TraceRecord),
        on_message: &mut dyn FnMut(Message),
        keys: Option<&mut dyn FnMut() -> Option<char>>,
        goes_on: &mut dyn FnMut() -> bool,
    ) -> Result<Report, LiveError> {
        let nodes = Node::start_all(scripts, &self.decoder, self.seed)?;
        let mut run = Run {
            device,
            nodes,
            stream: Stream::new(device),
            under_way: BTreeMap::new(),
            own: Vec::new(),
            repeated: BTreeMap::new(),
            dropped: Vec::new(),
            slots: BTreeMap::new(),
            results: Results::new(on_message),
            on_record,
            keys: keys.map(|next| Box::new(next) as Keys<'_>),
            began: Instant::now(),
            first_ns: None,
            now_ns: 0,
        };
        let result = run.go(self.duration, goes_on);
        let report = run.finish();
        result.map(|()| report)
    }
}

/// Returns the next key that the user has typed.
type Keys<'a> = Box<dyn FnMut() -> Option<char> + 'a>;

/// A run.
struct Run<'a> {
    device: &'a Device,
    nodes: Vec<Node>,
    stream: Stream<'a>,
    /// Whose frame a tag is.
    under_way: BTreeMap<(usize, u32), usize>,
    /// Own frames of which the record has not come: other clients of a shared device send on it, too, and theirs are for the scripts.
    own: Vec<(Channel, Frame)>,
    /// Of each slot by channel, also when it has ended: whose it is, its frame and the one before it.
    repeated: BTreeMap<(usize, u8), (usize, [Frame; 2])>,
    /// Frames for which there was no room, by script, of which it does not know yet.
    dropped: Vec<(usize, Channel)>,
    /// The device's slot of each repetition, by channel, script and handle.
    slots: BTreeMap<(usize, usize, u32), u8>,
    results: Results<'a>,
    on_record: &'a mut dyn FnMut(TraceRecord),
    keys: Option<Keys<'a>>,
    began: Instant,
    /// The stamp that is the run's time zero, and when it came.
    first_ns: Option<i64>,
    now_ns: u64,
}

impl Run<'_> {
    fn go(&mut self, duration: Option<Duration>, goes_on: &mut dyn FnMut() -> bool) -> Result<(), LiveError> {
        let mut records = self.device.records();
        while duration.is_none_or(|duration| self.began.elapsed() < duration)
            && !is_over(&self.nodes)
            && goes_on()
        {
            self.pass_time(self.began.elapsed().as_nanos() as u64);
            for place in 0..self.nodes.len() {
                if self.nodes[place].wake_ns.is_some_and(|wake_ns| wake_ns <= self.now_ns) {
                    self.resume(place, None)?;
                }
            }
            self.take_keys()?;
            self.stream.flush()?;
            self.take_ended()?;
            for (place, channel) in std::mem::take(&mut self.dropped) {
                self.resume(place, Some(Input::NotSent { channel }))?;
            }
            let wake_ns = self.nodes.iter().filter_map(|node| node.wake_ns).min();
            let wait = wake_ns
                .map_or(LOOK_EVERY, |wake_ns| Duration::from_nanos(wake_ns.saturating_sub(self.now_ns)));
            let Some(batch) = records.next_batch(wait.min(LOOK_EVERY))? else { break };
            for record in batch {
                self.take_record(record)?;
            }
        }
        Ok(())
    }

    /// Passes on what the user has typed.
    fn take_keys(&mut self) -> Result<(), LiveError> {
        let Some(keys) = &mut self.keys else {
            self.results.without_keys(&self.nodes, self.now_ns);
            return Ok(());
        };
        let typed: Vec<char> = std::iter::from_fn(keys).collect();
        for key in typed {
            (0..self.nodes.len()).try_for_each(|place| self.resume(place, Some(Input::Key(key))))?;
        }
        Ok(())
    }

    /// Time never goes back, whatever the stamps are.
    fn pass_time(&mut self, now_ns: u64) {
        self.now_ns = self.now_ns.max(now_ns);
    }

    fn take_record(&mut self, record: TraceRecord) -> Result<(), LiveError> {
        (self.on_record)(record);
        let Some(channel) = Channel::from_number(record.channel) else { return Ok(()) };
        let now_ns = self.began.elapsed().as_nanos() as u64;
        let first_ns = *self.first_ns.get_or_insert(record.time_ns - now_ns as i64);
        self.pass_time(u64::try_from(record.time_ns - first_ns).unwrap_or(0).min(now_ns));
        let input = match record.event {
            // To the other scripts it goes with its confirmation.
            TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction: Direction::Tx, .. }
                if self.take_own(channel, frame) =>
            {
                return Ok(());
            }
            TraceEvent::Frame { frame: TraceFrame::Classic(frame), .. } => {
                self.results.frame(self.now_ns, channel, frame);
                self.results.report.frames_received += 1;
                Input::Frame { channel, frame }
            }
            TraceEvent::BusError { kind, .. } => Input::Error { channel, kind },
            TraceEvent::State { state, .. } => Input::State { channel, state },
            // Scripts have no CAN FD: to them, a frame is missing.
            TraceEvent::Frame { frame: TraceFrame::Fd(_), .. } => {
                self.results.report.frames_lost += 1;
                Input::Gap
            }
            TraceEvent::Lost { count, .. } => {
                self.results.report.frames_lost += u64::from(count);
                Input::Gap
            }
            _ => return Ok(()),
        };
        (0..self.nodes.len()).try_for_each(|place| self.resume(place, Some(input)))
    }

    /// Whether a frame that the device sent is one of these scripts'.
    fn take_own(&mut self, channel: Channel, frame: Frame) -> bool {
        if let Some(place) = self.own.iter().position(|own| *own == (channel, frame)) {
            self.own.remove(place);
            return true;
        }
        self.repeated.iter().any(|((of, _), (_, frames))| *of == channel.index() && frames.contains(&frame))
    }

    /// Passes the confirmations: to the sender as such, to the others as a frame.
    fn take_ended(&mut self) -> Result<(), LiveError> {
        self.stream.wait(Duration::ZERO)?;
        // What another client of a shared device has sent comes as a record.
        let ended = self.stream.take_ended().into_iter().filter(|ended| ended.tag != OTHERS_TAG);
        for Transmission { channel, tag, result, .. } in ended {
            let sender = self.under_way.remove(&(channel.index(), tag));
            let Ok(TraceFrame::Classic(frame)) = result else {
                self.dropped.extend(sender.map(|place| (place, channel)));
                // Its record never comes. Which frame it was is not known; the oldest on the channel waits longest.
                if let Some(place) = self.own.iter().position(|(of, _)| *of == channel) {
                    self.own.remove(place);
                }
                continue;
            };
            let slot = tag.checked_sub(DEVICE_TAG).map(|slot| slot as u8);
            let repeated = slot.and_then(|slot| self.repeated.get(&(channel.index(), slot)));
            let sender = sender.or_else(|| repeated.map(|(place, _)| *place));
            self.results.frame(self.now_ns, channel, frame);
            self.results.report.frames_sent += 1;
            for place in 0..self.nodes.len() {
                let own = sender == Some(place);
                // Repetitions are not among the frames that a script waits to see confirmed.
                match (own, slot) {
                    (true, None) => self.resume(place, Some(Input::Sent { channel }))?,
                    (true, Some(_)) => {}
                    (false, _) => self.resume(place, Some(Input::Frame { channel, frame }))?,
                }
            }
        }
        Ok(())
    }

    fn resume(&mut self, place: usize, input: Option<Input>) -> Result<(), LiveError> {
        let outputs = self.nodes[place].resume(self.now_ns, input);
        let name = self.nodes[place].name.clone();
        for output in outputs {
            match self.results.take(&name, self.now_ns, output) {
                Some(Output::Send { channel, frame }) => self.send(place, channel, frame)?,
                Some(Output::Repeat { handle, channel, frame, period_ns }) => {
                    self.repeat(place, (handle, channel), frame, period_ns)?;
                }
                Some(Output::EndRepeat { handle }) => {
                    self.end_repeats(|of, own| (of, own) == (place, handle))?;
                }
                Some(Output::Log(_) | Output::Test { .. }) | None => {}
            }
        }
        if self.nodes[place].has_ended {
            self.end_repeats(|of, _| of == place)?;
        }
        Ok(())
    }

    fn send(&mut self, place: usize, channel: Channel, frame: Frame) -> Result<(), LiveError> {
        let began = Instant::now();
        // A queue that stays full means that nothing leaves, which the report says at the end.
        let tag = self.stream.push(channel, frame, None, |_| began.elapsed() < Duration::from_secs(1))?;
        if let Some(tag) = tag {
            self.under_way.insert((channel.index(), tag), place);
            self.own.push((channel, frame));
        } else {
            self.results.report.frames_not_sent += 1;
            self.dropped.push((place, channel));
        }
        Ok(())
    }

    fn repeat(
        &mut self,
        place: usize,
        (handle, channel): (u32, Channel),
        frame: Frame,
        period_ns: u64,
    ) -> Result<(), LiveError> {
        let index = channel.index();
        let used: Vec<u8> =
            self.slots.iter().filter(|((of, _, _), _)| *of == index).map(|(_, slot)| *slot).collect();
        let slot = self.slots.get(&(index, place, handle)).copied();
        let slot = slot.or_else(|| (0..=u8::MAX).find(|slot| !used.contains(slot))).unwrap_or(u8::MAX);
        let ticks = u128::from(period_ns) * u128::from(self.device.hello().tick_hz) / 1_000_000_000;
        let period_ticks = u32::try_from(ticks).unwrap_or(u32::MAX).max(1);
        let entry = Periodic { frame, period_ticks, count: 0, modifiers: heapless::Vec::new() };
        self.device.set_periodic(channel, slot, Some(entry))?;
        let before = self.repeated.get(&(index, slot)).map_or(frame, |(_, [frame, _])| *frame);
        self.repeated.insert((index, slot), (place, [frame, before]));
        self.slots.insert((index, place, handle), slot);
        Ok(())
    }

    fn end_repeats(&mut self, is_meant: impl Fn(usize, u32) -> bool) -> Result<(), LiveError> {
        let meant: Vec<(usize, usize, u32)> =
            self.slots.keys().filter(|(_, place, handle)| is_meant(*place, *handle)).copied().collect();
        for key in meant {
            if let Some(slot) = self.slots.remove(&key) {
                self.device.set_periodic(Channel::ALL[key.0], slot, None)?;
            }
        }
        Ok(())
    }

    /// Ends everything that the scripts began, as far as the device is still there.
    fn finish(mut self) -> Report {
        let _ = self.end_repeats(|_, _| true);
        let began = Instant::now();
        let _ = self.stream.finish(|_| began.elapsed() < FAREWELL);
        let _ = self.take_ended();
        if !self.under_way.is_empty() {
            for channel in self
                .under_way
                .keys()
                .map(|(index, _)| Channel::ALL[*index])
                .collect::<std::collections::BTreeSet<_>>()
            {
                let _ = self.device.abort(channel);
            }
        }
        self.results.report.frames_not_sent += self.under_way.len() as u64;
        self.results.finish(&self.nodes, self.now_ns)
    }
}
