//! What a script does when something happens: its functions for frames, errors and times.

use cantap_can::{BusErrorKind, Channel, ErrorState};
use cantap_signals::MessageRef;
use cantap_trace::grammar::IdPattern;
use fastrand::Rng;
use rhai::FnPtr;

use crate::script_frame::ScriptFrame;

/// Which frames a function is for.
#[derive(Clone, Debug)]
pub enum Selector {
    /// Those with one of these identifiers, on one channel or on both.
    Ids { channel: Option<Channel>, ids: IdPattern },
    /// All frames.
    All,
    /// A message of the database.
    Message(MessageRef),
}

impl Selector {
    /// Whether it selects this frame, which is this message.
    pub fn selects(&self, frame: &ScriptFrame, message: Option<MessageRef>) -> bool {
        match self {
            Self::All => true,
            Self::Ids { channel, ids } => {
                channel.is_none_or(|channel| channel == frame.channel) && ids.matches(frame.frame.id())
            }
            Self::Message(wanted) => message == Some(*wanted),
        }
    }
}

/// An error or a change of state, as scripts see it.
#[derive(Clone, Copy, Debug)]
pub enum BusEvent {
    /// An error on the bus.
    Error(Channel, Option<BusErrorKind>),
    /// A controller's new state.
    State(Channel, ErrorState),
}

/// A function that is called at a time, once or again and again.
#[derive(Clone, Debug)]
struct Timer {
    due_ns: u64,
    /// When it would be due without jitter.
    on_time_ns: u64,
    handle: u32,
    repeated: Option<Repeated>,
    call: FnPtr,
}

/// How a timer is due again.
#[derive(Clone, Copy, Debug)]
pub struct Repeated {
    /// After this time.
    pub period_ns: u64,
    /// Later by a random time up to this, which does not add up.
    pub jitter_ns: u64,
}

impl Repeated {
    /// Without jitter.
    pub const fn exactly(period_ns: u64) -> Self {
        Self { period_ns, jitter_ns: 0 }
    }

    /// How late it is this time. Without jitter no random number is used up.
    fn late_ns(self, random: &mut Rng) -> u64 {
        if self.jitter_ns == 0 { 0 } else { random.u64(0..=self.jitter_ns) }
    }
}

/// Everything that a script wants to react to.
#[derive(Debug, Default)]
pub struct Handlers {
    frames: Vec<(u32, Selector, FnPtr)>,
    errors: Vec<FnPtr>,
    states: Vec<FnPtr>,
    /// Each for one key, or for all, and then it gets the key.
    keys: Vec<(u32, Option<char>, FnPtr)>,
    timers: Vec<Timer>,
    last_handle: u32,
}

impl Handlers {
    /// A number that nothing else of this script has.
    pub fn new_handle(&mut self) -> u32 {
        self.last_handle += 1;
        self.last_handle
    }

    /// Calls a function with each selected frame; returns its handle.
    pub fn on_frame(&mut self, selector: Selector, call: FnPtr) -> u32 {
        let handle = self.new_handle();
        self.frames.push((handle, selector, call));
        handle
    }

    /// Calls a function with each error.
    pub fn on_error(&mut self, call: FnPtr) {
        self.errors.push(call);
    }

    /// Calls a function with each change of a controller's state.
    pub fn on_state(&mut self, call: FnPtr) {
        self.states.push(call);
    }

    /// Calls a function when a key is typed, or when any is; returns its handle.
    pub fn on_key(&mut self, key: Option<char>, call: FnPtr) -> u32 {
        let handle = self.new_handle();
        self.keys.push((handle, key, call));
        handle
    }

    /// Calls a function at a time, then again if it is repeated; returns its handle.
    pub fn at(&mut self, due_ns: u64, repeated: Option<Repeated>, call: FnPtr, random: &mut Rng) -> u32 {
        let handle = self.new_handle();
        let late_ns = repeated.map_or(0, |repeated| repeated.late_ns(random));
        self.timers.push(Timer { due_ns: due_ns + late_ns, on_time_ns: due_ns, handle, repeated, call });
        handle
    }

    /// Ends a timer, or a function for frames or keys.
    pub fn end(&mut self, handle: u32) {
        self.timers.retain(|timer| timer.handle != handle);
        self.frames.retain(|(of, _, _)| *of != handle);
        self.keys.retain(|(of, _, _)| *of != handle);
    }

    /// How many functions there are.
    pub const fn len(&self) -> usize {
        self.frames.len() + self.errors.len() + self.states.len() + self.keys.len() + self.timers.len()
    }

    /// Whether there is no function for anything.
    pub fn is_empty(&self) -> bool {
        !self.has_frames() && !self.has_events() && !self.has_keys() && self.timers.is_empty()
    }

    /// Whether there is a function for frames.
    pub fn has_frames(&self) -> bool {
        !self.frames.is_empty()
    }

    /// Whether there is a function for errors or states.
    pub fn has_events(&self) -> bool {
        !self.errors.is_empty() || !self.states.is_empty()
    }

    /// Whether there is a function for keys.
    pub fn has_keys(&self) -> bool {
        !self.keys.is_empty()
    }

    /// When the next timer is due.
    pub fn next_due_ns(&self) -> Option<u64> {
        self.timers.iter().map(|timer| timer.due_ns).min()
    }

    /// The function of the earliest timer that is due; it is due again after its period. Of two that are due at the same time, the older one
    /// is first.
    pub fn take_due(&mut self, now_ns: u64, random: &mut Rng) -> Option<FnPtr> {
        let due = (0..self.timers.len()).filter(|&place| self.timers[place].due_ns <= now_ns);
        let place = due.min_by_key(|&place| (self.timers[place].due_ns, self.timers[place].handle))?;
        let timer = &mut self.timers[place];
        let call = timer.call.clone();
        match timer.repeated {
            Some(repeated) => {
                timer.on_time_ns += repeated.period_ns;
                timer.due_ns = timer.on_time_ns + repeated.late_ns(random);
            }
            None => {
                self.timers.remove(place);
            }
        }
        Some(call)
    }

    /// The functions for a frame.
    pub fn for_frame(&self, frame: &ScriptFrame, message: Option<MessageRef>) -> Vec<(bool, FnPtr)> {
        let selected = self.frames.iter().filter(|(_, selector, _)| selector.selects(frame, message));
        selected.map(|(_, selector, call)| (matches!(selector, Selector::Message(_)), call.clone())).collect()
    }

    /// The functions for a key, and whether they get it.
    pub fn for_key(&self, typed: char) -> Vec<(bool, FnPtr)> {
        let meant = self.keys.iter().filter(|(_, key, _)| key.is_none_or(|key| key == typed));
        meant.map(|(_, key, call)| (key.is_none(), call.clone())).collect()
    }

    /// The functions for an error or a state.
    pub fn for_event(&self, event: BusEvent) -> Vec<FnPtr> {
        match event {
            BusEvent::Error(..) => self.errors.clone(),
            BusEvent::State(..) => self.states.clone(),
        }
    }
}
