//! Scripts in a thread of their own, on a device that somebody else has and also uses: whatever a script does, its owner goes on.
//!
//! The owner passes on what the device says, and does what the scripts want when it likes. Everything that is sent goes through it, so that
//! nothing more comes from a script once it is ended, and so that both never have the same tag or periodic entry.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use cantap::device::Transmission;
use cantap::wire::message::{MAX_SEND, Periodic, Refusal, TxFrame};
use cantap::{Device, DeviceError, TraceEvent, TraceRecord};
use cantap_can::{CHANNELS, Channel, Frame};

use super::events::{ScriptCounts, ScriptEvent};
use super::run::LiveRun;
use super::settings::{Live, LiveError};
use super::thread_port::{Owner, Request, Shared, TAGS, ThreadPort};
use crate::node::{Script, ScriptError};

/// Records that may wait for slow scripts; of more, they see a gap.
const MOST_RECORDS: usize = 200_000;
/// The longest wait of the scripts' thread.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// What the owner hands to the scripts' thread.
enum ToScripts {
    Add(Script, Arc<AtomicBool>),
    End(usize),
    Key(char),
    Transmission(Transmission),
    Records(Vec<TraceRecord>),
}

/// A frame that waits for room in the device's queue.
struct Waiting {
    of: usize,
    tag: u32,
    frame: Frame,
}

/// Scripts in a thread of their own. Its end is the end of all of them.
pub struct ScriptThread {
    to: Option<Sender<ToScripts>>,
    requests: Receiver<Request>,
    thread: Option<JoinHandle<()>>,
    shared: Arc<Shared>,
    confirmations: Receiver<Transmission>,
    /// Each script's, by place.
    stops: Vec<Arc<AtomicBool>>,
    ended: BTreeSet<usize>,
    waiting: [VecDeque<Waiting>; CHANNELS],
    /// Whose each of the device's periodic entries is, by channel and slot.
    entries: BTreeMap<(usize, u8), usize>,
    /// Records for which there was no room, by channel.
    missed: [u32; CHANNELS],
}

impl ScriptThread {
    /// Starts the thread, without scripts. It takes over the device's confirmations.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn start(live: &Live, device: &Device) -> Result<Self, ScriptError> {
        let (to, passed) = channel();
        let (request, requests) = channel();
        let shared = Arc::<Shared>::default();
        let (live, hello, both) = (live.clone(), device.hello().clone(), Arc::clone(&shared));
        let time = device.device_time();
        let body = move || {
            let port = ThreadPort::new(request.clone(), Arc::clone(&both));
            let mut run = live.start_through(Box::new(port), &hello, time);
            if let Err(error) = serve(&mut run, &passed, &request, &both) {
                // If nobody waits for it, the scripts were ended from outside.
                let _ = request.send(Request::Broken(error));
            }
        };
        let thread = std::thread::Builder::new().name("cantap-scripts".to_owned()).spawn(body);
        let thread = thread
            .map_err(|error| ScriptError::Thread { name: "scripts".to_owned(), reason: error.to_string() })?;
        Ok(Self {
            to: Some(to),
            requests,
            thread: Some(thread),
            shared,
            confirmations: device.transmissions(),
            stops: Vec::new(),
            ended: BTreeSet::new(),
            waiting: Default::default(),
            entries: BTreeMap::new(),
            missed: [0; CHANNELS],
        })
    }

    /// One more script, from now on; returns its place.
    ///
    /// # Errors
    /// If it is not in the language; what goes wrong later is in the events.
    pub fn add(&mut self, script: Script) -> Result<usize, ScriptError> {
        script.tests()?;
        let stop = Arc::<AtomicBool>::default();
        self.stops.push(Arc::clone(&stop));
        self.pass(ToScripts::Add(script, stop));
        Ok(self.stops.len() - 1)
    }

    /// Ends a script, whatever it does: nothing of it is sent any more but what the device has already, and the device repeats nothing of
    /// it from the next [`Self::serve`] on.
    pub fn end(&mut self, place: usize) {
        let Some(stop) = self.stops.get(place) else { return };
        stop.store(true, Ordering::Relaxed);
        self.ended.insert(place);
        for waiting in &mut self.waiting {
            let before = waiting.len();
            waiting.retain(|waiting| waiting.of != place);
            self.shared.waiting.fetch_sub(before - waiting.len(), Ordering::Relaxed);
        }
        self.pass(ToScripts::End(place));
    }

    /// The user has typed a key for the scripts.
    pub fn key(&self, key: char) {
        self.pass(ToScripts::Key(key));
    }

    /// Takes a periodic entry of the device for its owner; false if a script has it.
    #[must_use]
    pub fn claim(&self, channel: Channel, slot: u8) -> bool {
        self.shared.claim(channel, slot, Owner::Device)
    }

    /// The owner's periodic entry has ended.
    pub fn release(&self, channel: Channel, slot: u8) {
        self.shared.release(channel, slot, Owner::Device);
    }

    /// Hands records of the device to the scripts. Frames for which they are too slow are a gap to them, and counted.
    pub fn take(&mut self, records: &[TraceRecord]) {
        // Before the records of what they confirm.
        while let Ok(transmission) = self.confirmations.try_recv() {
            // A script waits for no others.
            if TAGS.contains(&transmission.tag) || self.has_room_for(1) {
                self.shared.backlog.fetch_add(1, Ordering::Relaxed);
                self.pass(ToScripts::Transmission(transmission));
            }
        }
        let of_device = |record: &&TraceRecord| Channel::from_number(record.channel).is_some();
        let mut batch: Vec<TraceRecord> = records.iter().filter(of_device).copied().collect();
        if !self.has_room_for(batch.len()) {
            for record in &batch {
                if let Some(channel) = Channel::from_number(record.channel) {
                    let missed = &mut self.missed[channel.index()];
                    *missed = missed.saturating_add(1);
                }
            }
            return;
        }
        let Some(first) = batch.first() else { return };
        let (time_ns, missed) = (first.time_ns, std::mem::take(&mut self.missed));
        for (channel, count) in Channel::ALL.into_iter().zip(missed).filter(|(_, count)| *count > 0) {
            let event = TraceEvent::Lost { stage: None, count, at_least: false };
            batch.insert(0, TraceRecord { time_ns, device_ns: None, channel: channel.number(), event });
        }
        self.shared.backlog.fetch_add(batch.len(), Ordering::Relaxed);
        self.pass(ToScripts::Records(batch));
    }

    fn has_room_for(&self, count: usize) -> bool {
        self.shared.backlog.load(Ordering::Relaxed) + count <= MOST_RECORDS
    }

    /// Does what the scripts want of the device, and adds what they have done to `events`.
    ///
    /// # Errors
    /// If the device is gone: the scripts cannot go on.
    pub fn serve(&mut self, device: &Device, events: &mut Vec<ScriptEvent>) -> Result<(), LiveError> {
        while let Ok(request) = self.requests.try_recv() {
            match request {
                Request::Send { of, .. } if self.ended.contains(&of) => {
                    self.shared.waiting.fetch_sub(1, Ordering::Relaxed);
                }
                Request::Send { of, tag, channel, frame } => {
                    self.waiting[channel.index()].push_back(Waiting { of, tag, frame });
                }
                Request::Periodic { of, channel, slot, entry } => {
                    self.set_periodic(device, of, (channel, slot), entry, events)?;
                }
                Request::Event(ScriptEvent::Ended { place, .. }) if self.ended.contains(&place) => {}
                Request::Event(one) => {
                    if let ScriptEvent::Ended { place, .. } = one {
                        self.ended.insert(place);
                    }
                    events.push(one);
                }
                Request::Broken(error) => return Err(error),
            }
        }
        for channel in Channel::ALL {
            self.hand_over(device, channel, events)?;
        }
        self.withdraw(device)
    }

    fn set_periodic(
        &mut self,
        device: &Device,
        of: usize,
        (channel, slot): (Channel, u8),
        entry: Option<Periodic>,
        events: &mut Vec<ScriptEvent>,
    ) -> Result<(), LiveError> {
        let key = (channel.index(), slot);
        if self.ended.contains(&of) {
            // Another may have the entry by now.
            if !self.entries.contains_key(&key) && entry.is_some() {
                self.shared.release(channel, slot, Owner::Scripts);
            }
            return Ok(());
        }
        match &entry {
            Some(_) => _ = self.entries.insert(key, of),
            None => _ = self.entries.remove(&key),
        }
        let is_over = entry.is_none();
        match device.set_periodic(channel, slot, entry) {
            Err(error @ DeviceError::Refused { .. }) => self.refuse(of, error, events),
            result => result?,
        }
        if is_over {
            self.shared.release(channel, slot, Owner::Scripts);
        }
        Ok(())
    }

    /// The device repeats nothing any more for scripts that have ended.
    fn withdraw(&mut self, device: &Device) -> Result<(), LiveError> {
        let of_ended = self.entries.iter().filter(|(_, of)| self.ended.contains(of));
        let of_ended: Vec<(usize, u8)> = of_ended.map(|(key, _)| *key).collect();
        for key in of_ended {
            let channel = Channel::ALL[key.0];
            match device.set_periodic(channel, key.1, None) {
                // It never had it.
                Ok(()) | Err(DeviceError::Refused { .. }) => {}
                Err(error) => return Err(error.into()),
            }
            self.entries.remove(&key);
            self.shared.release(channel, key.1, Owner::Scripts);
        }
        Ok(())
    }

    /// The device refuses what a script wants: the others go on.
    fn refuse(&mut self, of: usize, error: DeviceError, events: &mut Vec<ScriptEvent>) {
        if !self.ended.contains(&of) {
            self.end(of);
            events.push(ScriptEvent::Refused { place: of, error });
        }
    }

    /// Whether every script has ended.
    pub fn is_over(&self) -> bool {
        self.ended.len() == self.stops.len()
    }

    /// Ends all scripts, and what the device repeats for them. Returns what they have done last.
    pub fn finish(mut self, device: Option<&Device>) -> Vec<ScriptEvent> {
        self.join();
        if let Some(device) = device {
            // If it does not answer, it is gone, and repeats nothing.
            for (channel, slot) in self.shared.of_scripts() {
                let _ = device.set_periodic(channel, slot, None);
            }
        }
        let last = self.requests.try_iter().filter_map(|request| match request {
            Request::Event(event) => Some(event),
            _ => None,
        });
        last.collect()
    }

    /// As many of the frames that wait as the device's queue has room for.
    fn hand_over(
        &mut self,
        device: &Device,
        channel: Channel,
        events: &mut Vec<ScriptEvent>,
    ) -> Result<(), DeviceError> {
        let mut most = MAX_SEND;
        while most > 0 {
            let waiting = &mut self.waiting[channel.index()];
            let Some(Waiting { of, .. }) = waiting.front() else { return Ok(()) };
            let of = *of;
            let next = waiting.iter().take(most);
            let frames: Vec<TxFrame> = next
                .map(|Waiting { tag, frame, .. }| TxFrame { tag: *tag, frame: *frame, at_ticks: None })
                .collect();
            match device.send(channel, &frames) {
                Ok(_) => {
                    waiting.drain(..frames.len());
                    self.shared.waiting.fetch_sub(frames.len(), Ordering::Relaxed);
                }
                Err(DeviceError::Refused { refusal: Refusal::QueueFull { free }, .. }) => {
                    most = usize::from(free).min(frames.len() - 1);
                }
                Err(error @ DeviceError::Refused { .. }) => self.refuse(of, error, events),
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    fn pass(&self, message: ToScripts) {
        // If the thread has ended, its requests say why.
        if let Some(to) = &self.to {
            let _ = to.send(message);
        }
    }

    fn join(&mut self) {
        self.stops.iter().for_each(|stop| stop.store(true, Ordering::Relaxed));
        self.to = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Drop for ScriptThread {
    fn drop(&mut self) {
        self.join();
    }
}

/// What the owner knows of a script, by its place.
#[derive(Default)]
struct Known {
    test: Option<String>,
    is_reported: bool,
}

/// The thread: turn after turn, until the owner is gone.
fn serve(
    run: &mut LiveRun<'_>,
    passed: &Receiver<ToScripts>,
    requests: &Sender<Request>,
    shared: &Shared,
) -> Result<(), LiveError> {
    let mut known: Vec<Known> = Vec::new();
    let mut tests = 0;
    let mut counts = ScriptCounts::default();
    let report = |event| requests.send(Request::Event(event)).map_err(|_| LiveError::Over);
    loop {
        let wait = run.turn()?;
        run.take_messages().into_iter().map(ScriptEvent::Message).try_for_each(&report)?;
        let ended = &run.report().tests[tests..];
        ended.iter().cloned().map(ScriptEvent::Test).try_for_each(&report)?;
        tests = run.report().tests.len();
        for (place, script) in known.iter_mut().enumerate() {
            let test = run.test_of(place);
            if script.test.as_deref() != test {
                script.test = test.map(str::to_owned);
                script
                    .test
                    .iter()
                    .cloned()
                    .map(|name| ScriptEvent::TestBegan { place, name })
                    .try_for_each(&report)?;
            }
            if run.has_ended(place) && !std::mem::replace(&mut script.is_reported, true) {
                report(ScriptEvent::Ended { place, error: run.error_of(place).map(str::to_owned) })?;
            }
        }
        let so_far = run.report();
        let now = ScriptCounts {
            sent: so_far.frames_sent,
            received: so_far.frames_received,
            waiting: run.waiting() as u64,
            not_sent: so_far.frames_not_sent,
            lost: so_far.frames_lost,
        };
        if counts != now {
            counts = now;
            report(ScriptEvent::Counts(now))?;
        }
        let mut next = match passed.recv_timeout(wait.min(LOOK_EVERY)) {
            Ok(next) => Some(next),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        };
        while let Some(one) = next {
            let is_batch = matches!(one, ToScripts::Records(_));
            match one {
                ToScripts::Add(script, stop) => {
                    run.add_until(&script, stop)?;
                    known.push(Known::default());
                }
                ToScripts::End(place) => run.end(place)?,
                ToScripts::Key(key) => run.key(key)?,
                ToScripts::Transmission(transmission) => {
                    shared.backlog.fetch_sub(1, Ordering::Relaxed);
                    run.take_transmission(transmission);
                }
                ToScripts::Records(batch) => {
                    shared.backlog.fetch_sub(batch.len(), Ordering::Relaxed);
                    batch.into_iter().try_for_each(|record| run.take_record(record).map(drop))?;
                }
            }
            // After records, it is the scripts' turn.
            next = if is_batch { None } else { passed.try_recv().ok() };
        }
    }
}
