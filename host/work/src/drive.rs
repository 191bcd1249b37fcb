//! A drive (CiA 402) in motion: what it is told, and the state in which it is left, whatever happens.

mod guard;
mod watched;

use std::cell::Cell;
use std::fmt;
use std::io;
use std::rc::Rc;
use std::time::Duration;

use anyhow::{anyhow, bail};
use cantap_protocols::active::drive::{DriveClient, DriveError, DriveStep, DriveTiming, DriveValues};
use cantap_protocols::active::heartbeat::HeartbeatProducer;
use cantap_protocols::active::sdo::SdoError;
use cantap_protocols::canopen::drive::{DriveState, error, mode_name, status_flags};
use cantap_protocols::{EventKind, Party};

pub use self::guard::Guard;
use self::watched::{Guarded, run};
use crate::advice::sentence;
use crate::interrupt;
use crate::speaking::Speaking;

/// Modes of operation (6060) of the motions below.
const PROFILE_POSITION: i8 = 1;
const PROFILE_VELOCITY: i8 = 3;
const PROFILE_TORQUE: i8 = 4;
const HOMING: i8 = 6;

/// The objects of targets, which have sub-index 0.
pub const TARGET_TORQUE: u16 = 0x6071;
/// See [`TARGET_TORQUE`].
pub const TARGET_POSITION: u16 = 0x607A;
/// See [`TARGET_TORQUE`].
pub const TARGET_VELOCITY: u16 = 0x60FF;

/// A motion. Targets are the objects' bytes, in the drive's own units.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Motion {
    /// Turns at this velocity (60FF).
    Velocity(Vec<u8>),
    /// Turns with this torque (6071), in thousandths of the rated one.
    Torque(Vec<u8>),
    /// Goes to this position (607A), or as far from where it is.
    Position {
        /// The target.
        target: Vec<u8>,
        /// From where it is.
        relative: bool,
    },
    /// Looks for its home position.
    Home,
}

/// How a motion is done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MotionOptions {
    /// Objects that are written before operation is enabled, with their values: velocities, accelerations, the way of homing.
    pub parameters: Vec<(u16, Vec<u8>)>,
    /// How long a velocity or a torque lasts, and how long a target may take to be reached; without it, a velocity and a torque last until
    /// Ctrl-C, and a target may take a minute.
    pub time: Option<Duration>,
    /// Leave operation enabled after a motion that went well.
    pub stay_enabled: bool,
}

/// For how long a target may take, unless said otherwise.
const TARGET_TIME: Duration = Duration::from_mins(1);

/// What is known of a drive.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveStatus {
    /// Its node number.
    pub node: u8,
    /// Which axis of the node it is, from 1.
    pub axis: u8,
    /// When the last of it was read: the stamp, in nanoseconds, as in records.
    pub time_ns: i64,
    /// The states that it has confirmed, one after the other, since the last status.
    pub states: Vec<DriveState>,
    /// Its values.
    pub values: DriveValues,
}

impl DriveStatus {
    /// `node 5`; of a further axis, `node 5 axis 2`.
    pub fn name(&self) -> String {
        match self.axis {
            0 | 1 => format!("node {}", self.node),
            axis => format!("node {} axis {axis}", self.node),
        }
    }

    /// The bits of its statusword that are no state, with commas.
    pub fn flags(&self) -> String {
        self.values.statusword.map(|word| status_flags(word, self.values.mode)).unwrap_or_default()
    }

    /// The name of its mode, or its number.
    pub fn mode(&self) -> Option<String> {
        self.values.mode.map(|mode| mode_name(mode).map_or_else(|| mode.to_string(), str::to_owned))
    }

    /// What its error code stands for, if there is one.
    pub fn error(&self) -> Option<&'static str> {
        self.values.error_code.filter(|code| *code != 0).map(error)
    }
}

impl fmt::Display for DriveStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let DriveValues { statusword, error_code, position, velocity, torque, .. } = self.values;
        write!(f, "{}", self.name())?;
        if let Some(word) = statusword {
            let state = DriveState::of(word).map_or("in no state", DriveState::name);
            write!(f, ": {state}, statusword {word:04X}")?;
            let flags = self.flags();
            if !flags.is_empty() {
                write!(f, " ({flags})")?;
            }
        }
        if let Some(mode) = self.mode() {
            write!(f, ", mode {mode}")?;
        }
        if let (Some(code), Some(text)) = (error_code, self.error()) {
            write!(f, ", error {code:04X} ({text})")?;
        }
        for (name, value) in
            [("position", position), ("velocity", velocity), ("torque", torque.map(i32::from))]
        {
            if let Some(value) = value {
                write!(f, ", {name} {value}")?;
            }
        }
        Ok(())
    }
}

/// Takes what is known of a drive, for the user.
pub type OnStatus<'a> = Box<dyn FnMut(&DriveStatus) -> io::Result<()> + 'a>;

/// One drive, over a channel.
pub struct Drive<'s, 'd> {
    speaking: &'s mut Speaking<'d>,
    client: DriveClient,
    node: u8,
    axis: u8,
    /// The stamp of the last answer.
    time_ns: Rc<Cell<i64>>,
    /// The nodes from which anything was heard: bit n is node n.
    heard: Rc<Cell<u128>>,
    states: Vec<DriveState>,
    /// It was told something, so that it may have to be stopped.
    is_commanded: bool,
    answer_ns: u64,
    /// Our heartbeat, while it is watched.
    heartbeat: Option<HeartbeatProducer>,
    guarded: Option<Guarded>,
    on_status: OnStatus<'s>,
}

impl<'s, 'd> Drive<'s, 'd> {
    /// For this axis, from 1, of the node with this number, 1 to 127.
    pub fn new(
        speaking: &'s mut Speaking<'d>,
        node: u8,
        axis: u8,
        timing: DriveTiming,
        on_status: OnStatus<'s>,
    ) -> Self {
        let client = DriveClient::new(node, timing).with_axis(axis);
        let (time_ns, heard) = (Rc::new(Cell::new(0)), Rc::new(Cell::new(0)));
        let (last_ns, senders, party) = (Rc::clone(&time_ns), Rc::clone(&heard), Party::Node(node));
        // A motion may last for days: what is said meanwhile is not kept.
        speaking.show_as_it_comes(Box::new(move |event| {
            if let Party::Node(number @ 0..=127) = event.from {
                senders.set(senders.get() | 1_u128 << number);
            }
            if event.to == party && matches!(event.kind, EventKind::SdoRead | EventKind::SdoWrite) {
                last_ns.set(event.time_ns);
            }
            event.from == party && matches!(event.kind, EventKind::Emergency | EventKind::BootUp)
        }));
        Self {
            speaking,
            client,
            node,
            axis,
            time_ns,
            heard,
            states: Vec::new(),
            is_commanded: false,
            answer_ns: timing.answer_ns,
            heartbeat: None,
            guarded: None,
            on_status,
        }
    }

    /// The last confirmed state.
    pub fn state(&self) -> Option<DriveState> {
        self.client.values().state()
    }

    /// Does one step, and waits until it is confirmed.
    ///
    /// # Errors
    /// Why it was not, with what may help; why nothing leaves the device; Ctrl-C.
    pub fn step(&mut self, step: DriveStep) -> anyhow::Result<()> {
        self.is_commanded |= step != DriveStep::Inspect;
        self.client.begin(step);
        let ran = run(self.speaking, self.heartbeat.as_mut(), &mut self.client, false);
        self.states.extend(self.client.take_states());
        ran?;
        self.client.outcome().map_err(|error| self.explained(error))
    }

    fn explained(&self, error: DriveError) -> anyhow::Error {
        let node = self.node;
        let mut text = format!("node {node}: {error}");
        let advice = match error {
            DriveError::Sdo { error: SdoError::NoAnswer { .. }, .. } => Some(format!(
                "{}; check the node's number (`cantap canopen scan`) and that it is not stopped",
                self.speaking.circumstances()
            )),
            // Data cannot be transferred or stored because of the state.
            DriveError::Sdo { error: SdoError::Aborted { code: 0x0800_0020..=0x0800_0022 }, .. }
            | DriveError::NotConfirmed { .. }
            | DriveError::Jumped { .. }
                if self.client.nmt_state() == Some(127) =>
            {
                Some(format!(
                    "it is pre-operational, where some drives do nothing: `cantap canopen nmt {node} start`"
                ))
            }
            DriveError::Fault { .. } => {
                Some(format!("`cantap canopen drive {node} fault-reset` when its cause is gone"))
            }
            _ => None,
        };
        if let Some(advice) = advice {
            text.push_str("; ");
            text.push_str(&advice);
        }
        if self.client.hears_pdos() && matches!(error, DriveError::Jumped { .. } | DriveError::Left { .. }) {
            text += "; another node sends it PDOs, and may command it, too";
        }
        anyhow!(text)
    }

    /// Reads its values anew, and passes them on.
    pub fn report(&mut self) -> anyhow::Result<()> {
        self.step(DriveStep::Inspect)?;
        self.pass_on()
    }

    /// Passes on what is known.
    fn pass_on(&mut self) -> anyhow::Result<()> {
        let status = DriveStatus {
            node: self.node,
            axis: self.axis,
            time_ns: self.time_ns.get(),
            states: std::mem::take(&mut self.states),
            values: *self.client.values(),
        };
        Ok((self.on_status)(&status)?)
    }

    /// Passes on its values whenever they change, until Ctrl-C or the end of `time`.
    pub fn watch(&mut self, period: Duration, time: Option<Duration>) -> anyhow::Result<()> {
        let started = std::time::Instant::now();
        let mut before = None;
        while !interrupt::requested() && time.is_none_or(|time| started.elapsed() < time) {
            match self.step(DriveStep::Inspect) {
                Err(_) if interrupt::requested() => break,
                result => result?,
            }
            if before.replace(*self.client.values()) != Some(*self.client.values()) {
                self.pass_on()?;
            }
            self.speaking.listen(period)?;
        }
        Ok(())
    }

    /// Does a motion from its beginning to its end, and leaves the drive without power, or as `options` say. Returns how it ended, and how
    /// the drive was left.
    ///
    /// # Errors
    /// What ended it early, and how the drive was left.
    pub fn move_it(&mut self, motion: &Motion, options: &MotionOptions) -> anyhow::Result<String> {
        // Whoever insists on ending at once is told what that means.
        interrupt::before_the_end(Some(left_alone));
        let done = self.motion(motion, options);
        let done = match done {
            // The usual end of what lasts.
            Err(_) if interrupt::requested() && self.lasts(motion, options) => {
                Ok("ended by Ctrl-C".to_owned())
            }
            done => done,
        };
        let stays = options.stay_enabled && !interrupt::requested();
        self.leave(done, stays)
    }

    /// Enables operation, and leaves it so. Returns that in words.
    ///
    /// # Errors
    /// What ended it early, and how the drive was left.
    pub fn enable(&mut self) -> anyhow::Result<String> {
        interrupt::before_the_end(Some(left_alone));
        let done = self.step(DriveStep::Inspect).and_then(|()| self.step(DriveStep::Enable));
        let done = done.and_then(|()| self.step(DriveStep::Inspect)).map(|()| "done".to_owned());
        self.leave(done, true)
    }

    /// Leaves the drive as it is if all is well and it `stays` enabled, and stopped otherwise.
    fn leave(&mut self, done: anyhow::Result<String>, stays: bool) -> anyhow::Result<String> {
        let left = match &done {
            Ok(_) if stays => Ok("operation stays enabled".to_owned()),
            Err(_) if !self.is_commanded => Ok("it was told nothing".to_owned()),
            _ => self.stop(),
        };
        let guard = self.unguard().map_or_else(String::new, |text| format!("; {text}"));
        interrupt::before_the_end(None);
        // Of a drive that has not answered, nothing is known.
        let told = if self.client.values().statusword.is_some() { self.pass_on() } else { Ok(()) };
        let node = self.node;
        match (done, left) {
            (Ok(done), Ok(left)) => told.map(|()| format!("node {node}: {done}; {left}{guard}")),
            (Ok(done), Err(stop)) => Err(anyhow!("node {node}: {done}; {stop}{guard}")),
            (Err(error), Ok(left)) => Err(anyhow!("{}; {left}{guard}", sentence(&error))),
            (Err(error), Err(stop)) => Err(anyhow!("{}; {stop}{guard}", sentence(&error))),
        }
    }

    fn lasts(&self, motion: &Motion, options: &MotionOptions) -> bool {
        matches!(motion, Motion::Velocity(_) | Motion::Torque(_))
            && options.time.is_none()
            && self.state() == Some(DriveState::OperationEnabled)
    }

    fn motion(&mut self, motion: &Motion, options: &MotionOptions) -> anyhow::Result<String> {
        let (mode, rest) = match motion {
            Motion::Velocity(target) => (PROFILE_VELOCITY, Some((TARGET_VELOCITY, vec![0; target.len()]))),
            Motion::Torque(target) => (PROFILE_TORQUE, Some((TARGET_TORQUE, vec![0; target.len()]))),
            Motion::Position { .. } => (PROFILE_POSITION, None),
            Motion::Home => (HOMING, None),
        };
        self.step(DriveStep::Inspect)?;
        for (index, data) in &options.parameters {
            self.write(*index, data)?;
        }
        // What an earlier master wanted must not begin when operation is enabled.
        if let Some((index, zero)) = &rest {
            self.write(*index, zero)?;
        }
        self.step(DriveStep::SetMode(mode))?;
        self.step(DriveStep::Enable)?;
        self.pass_on()?;
        let within_ns = nanoseconds(options.time.unwrap_or(TARGET_TIME));
        let hold = DriveStep::Hold(options.time.map(nanoseconds));
        let reach = |is_homing| DriveStep::Reach { is_homing, within_ns };
        match motion {
            Motion::Velocity(target) | Motion::Torque(target) => {
                let Some((index, zero)) = rest else { bail!("a velocity and a torque have a target") };
                self.write(index, target)?;
                self.step(hold)?;
                self.step(DriveStep::Inspect)?;
                let DriveValues { velocity, torque, .. } = *self.client.values();
                if options.stay_enabled {
                    self.write(index, &zero)?;
                }
                Ok(if index == TARGET_TORQUE {
                    format!("the time is over{}", at("torque", torque.map(i32::from)))
                } else {
                    format!("the time is over{}", at("velocity", velocity))
                })
            }
            Motion::Position { target, relative } => {
                self.write(TARGET_POSITION, target)?;
                self.step(DriveStep::SetPoint { relative: *relative })?;
                self.step(reach(false))?;
                Ok(format!("the target is reached{}", at("position", self.client.values().position)))
            }
            Motion::Home => {
                self.step(DriveStep::Home)?;
                self.step(reach(true))?;
                Ok(format!("the home position is found{}", at("position", self.client.values().position)))
            }
        }
    }

    fn write(&mut self, index: u16, data: &[u8]) -> anyhow::Result<()> {
        self.step(DriveStep::Write { index, data: data.to_vec() })
    }

    /// Stops the drive and takes its power, even after Ctrl-C. Returns how it was left.
    fn stop(&mut self) -> anyhow::Result<String> {
        let ended = self.last_step(DriveStep::Stop);
        let state = self.state().map_or("unknown", DriveState::name);
        match ended {
            Ok(()) => {
                // Where it stands now; that it stands was confirmed.
                let _ = self.last_step(DriveStep::Inspect);
                Ok(format!("it was stopped, and is {state}"))
            }
            Err(error) => Err(anyhow!(
                "it could not be stopped ({error}) and may still move; the last state that it confirmed is {state}"
            )),
        }
    }

    /// As [`Self::step`], after Ctrl-C as well.
    fn last_step(&mut self, step: DriveStep) -> anyhow::Result<()> {
        self.client.begin(step);
        let ran = run(self.speaking, self.heartbeat.as_mut(), &mut self.client, true);
        self.states.extend(self.client.take_states());
        ran?;
        Ok(self.client.outcome()?)
    }

    /// A step of its own, with the last confirmed state if it fails.
    ///
    /// # Errors
    /// As [`Self::step`].
    pub fn single(&mut self, step: DriveStep) -> anyhow::Result<()> {
        self.step(step).map_err(|error| {
            let state = self.state().map_or("unknown", DriveState::name);
            anyhow!("{}; the last state that it confirmed is {state}", sentence(&error))
        })?;
        self.report()
    }
}

fn at(name: &str, value: Option<i32>) -> String {
    value.map_or_else(String::new, |value| format!(" at {name} {value}"))
}

fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX).min(u64::MAX / 4)
}

/// The last words before an end that leaves no time for anything else.
fn left_alone() {
    eprintln!("cantap: ended before the drive was stopped: it may still move");
}
