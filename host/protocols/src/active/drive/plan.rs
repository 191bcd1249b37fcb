//! Decides what comes next: by the step, how far it is, and what the drive answered.

use super::error::DriveError;
use super::step::{DriveStep, DriveTiming, DriveValues};
use crate::canopen::drive::{CONTROLWORD, DriveState, ERROR_CODE, MODE, MODE_DISPLAY, STATUSWORD};

const POSITION: u16 = 0x6064;
const VELOCITY: u16 = 0x606C;
const VELOCITY_THRESHOLD: u16 = 0x606F;
const TORQUE: u16 = 0x6077;
pub(super) const HEARTBEAT: u16 = 0x1017;

// Controlwords (CiA 402, table of commands).
const DISABLE_VOLTAGE: u16 = 0x0000;
const QUICK_STOP: u16 = 0x0002;
const SHUTDOWN: u16 = 0x0006;
const SWITCH_ON: u16 = 0x0007;
const ENABLE_OPERATION: u16 = 0x000F;
const FAULT_RESET: u16 = 0x0080;
/// With [`ENABLE_OPERATION`]: a new set-point, or the start of homing.
const START: u16 = 0x0010;
const RELATIVE: u16 = 0x0040;

// Bits of the statusword.
const TARGET_REACHED: u8 = 10;
/// Set-point acknowledged, or homing attained.
const ACKNOWLEDGED: u8 = 12;
/// Following error, or homing error.
const MOTION_ERROR: u8 = 13;

/// What is read of a drive, in this order.
const READ: [u16; 8] =
    [STATUSWORD, MODE_DISPLAY, ERROR_CODE, POSITION, VELOCITY, TORQUE, VELOCITY_THRESHOLD, HEARTBEAT];
/// More controlwords than any way through the states has.
const MOST_COMMANDS: u32 = 10;
/// For how long "target reached" may still be that of the target before.
const STALE_NS: u64 = 200_000_000;

/// What has just happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Input {
    Begin,
    Read(u16),
    Wrote,
    Woke,
}

/// What comes next.
#[derive(Clone, Debug)]
pub(super) enum Next {
    Read(u16),
    Write(u16, Vec<u8>),
    Pause(u64),
    Done,
}

/// How far a step is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    Begin,
    /// The next one of [`READ`].
    Reading(usize),
    /// The statusword decides.
    Look,
    /// A controlword was written that leads from one state to another.
    Commanded {
        from: DriveState,
        to: DriveState,
        limit_ns: u64,
    },
    /// A quick stop was commanded.
    Braking,
    /// No voltage, although it has not braked.
    Forced,
    ResettingFault(u8),
    Mode,
    Writing,
    /// Bit 4: not yet, set, and not any more.
    SetPoint(u8),
    Reaching {
        was_unreached: bool,
    },
    Holding,
    /// A fault, whose code is read.
    FaultCode,
}

/// One step, and how far it is.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    timing: DriveTiming,
    step: Option<DriveStep>,
    phase: Phase,
    /// When the step, and the wait in it, began.
    begun_ns: u64,
    since_ns: u64,
    commands: u32,
    values: DriveValues,
    /// States confirmed since they were last taken.
    states: Vec<DriveState>,
}

impl Plan {
    pub fn new(timing: DriveTiming) -> Self {
        Self {
            timing,
            step: None,
            phase: Phase::Begin,
            begun_ns: 0,
            since_ns: 0,
            commands: 0,
            values: DriveValues::default(),
            states: Vec::new(),
        }
    }

    pub fn begin(&mut self, step: DriveStep) {
        (self.step, self.phase, self.commands) = (Some(step), Phase::Begin, 0);
    }

    pub const fn step(&self) -> Option<&DriveStep> {
        self.step.as_ref()
    }

    /// Whether nothing of the step was done so far.
    pub fn is_new(&self) -> bool {
        self.step.is_some() && self.phase == Phase::Begin
    }

    /// Whether the code of a fault is being read.
    pub fn reads_fault(&self) -> bool {
        self.phase == Phase::FaultCode
    }

    /// Whether the drive need not have an object that is read now.
    pub fn is_optional(&self, index: u16) -> bool {
        index != STATUSWORD && self.phase != Phase::Mode
    }

    pub const fn values(&self) -> &DriveValues {
        &self.values
    }

    pub fn take_states(&mut self) -> Vec<DriveState> {
        std::mem::take(&mut self.states)
    }

    /// What comes after `input`. A fault is an error when its code has been read.
    pub fn next(&mut self, now_ns: u64, input: Input) -> Result<Next, DriveError> {
        match self.plan(now_ns, input) {
            Err(DriveError::Fault { code: None }) if self.phase != Phase::FaultCode => {
                self.phase = Phase::FaultCode;
                Ok(Next::Read(ERROR_CODE))
            }
            next => next,
        }
    }

    /// Keeps a value that was read.
    pub fn keep(&mut self, index: u16, data: &[u8]) -> Result<(), DriveError> {
        let wrong = DriveError::Length { index, bytes: data.len() };
        let length = match index {
            MODE_DISPLAY => 1,
            POSITION | VELOCITY => 4,
            _ => 2,
        };
        // A node need not say how many of four bytes count.
        if data.len() != length && data.len() != 4 {
            return Err(wrong);
        }
        let mut bytes = [0; 4];
        bytes[..length].copy_from_slice(&data[..length]);
        let number = u32::from_le_bytes(bytes);
        let values = &mut self.values;
        match index {
            STATUSWORD => {
                let before = values.state();
                values.statusword = Some(number as u16);
                let state = values.state();
                self.states.extend(state.filter(|_| state != before));
            }
            MODE_DISPLAY => values.mode = Some(number as i8),
            ERROR_CODE => values.error_code = Some(number as u16),
            POSITION => values.position = Some(number as i32),
            VELOCITY => values.velocity = Some(number as i32),
            TORQUE => values.torque = Some(number as i16),
            VELOCITY_THRESHOLD => values.velocity_threshold = Some(number as u16),
            HEARTBEAT => values.heartbeat_ms = Some(number as u16),
            _ => {}
        }
        Ok(())
    }

    fn state(&self) -> Result<DriveState, DriveError> {
        let statusword = self.values.statusword.unwrap_or_default();
        DriveState::of(statusword).ok_or(DriveError::NoState { statusword })
    }

    fn statusword(&self) -> u16 {
        self.values.statusword.unwrap_or_default()
    }

    /// Asks again later, or says that it took too long.
    fn poll(
        &self,
        now_ns: u64,
        limit_ns: u64,
        late: impl FnOnce(u64) -> DriveError,
    ) -> Result<Next, DriveError> {
        let passed_ns = now_ns.saturating_sub(self.since_ns);
        if passed_ns >= limit_ns {
            return Err(late(passed_ns / 1_000_000));
        }
        Ok(Next::Pause(now_ns + self.timing.poll_ns))
    }

    fn control(word: u16) -> Next {
        Next::Write(CONTROLWORD, word.to_le_bytes().to_vec())
    }

    /// Commands a transition.
    fn transit(
        &mut self,
        word: u16,
        from: DriveState,
        to: DriveState,
        limit_ns: u64,
    ) -> Result<Next, DriveError> {
        self.commands += 1;
        if self.commands > MOST_COMMANDS {
            return Err(DriveError::Restless { commands: self.commands });
        }
        self.phase = Phase::Commanded { from, to, limit_ns };
        Ok(Self::control(word))
    }

    fn plan(&mut self, now_ns: u64, input: Input) -> Result<Next, DriveError> {
        let Some(step) = self.step.clone() else { return Ok(Next::Done) };
        if input == Input::Woke {
            return Ok(Next::Read(if self.phase == Phase::Mode { MODE_DISPLAY } else { STATUSWORD }));
        }
        match (self.phase, input) {
            (Phase::Begin, _) => {
                (self.begun_ns, self.since_ns) = (now_ns, now_ns);
                Ok(self.first(step))
            }
            (Phase::Reading(place), _) => {
                self.phase = Phase::Reading(place + 1);
                Ok(READ.get(place + 1).map_or(Next::Done, |index| Next::Read(*index)))
            }
            (Phase::FaultCode, _) => Err(DriveError::Fault { code: self.values.error_code }),
            (Phase::Writing, _) => Ok(Next::Done),
            (Phase::Mode, Input::Wrote) => {
                self.since_ns = now_ns;
                Ok(Next::Read(MODE_DISPLAY))
            }
            (Phase::Mode, _) => {
                let DriveStep::SetMode(wanted) = step else { return Ok(Next::Done) };
                let shown = self.values.mode;
                if shown == Some(wanted) {
                    return Ok(Next::Done);
                }
                self.poll(now_ns, self.timing.confirm_ns, |_| DriveError::Mode { wanted, shown })
            }
            (_, Input::Wrote) => {
                self.since_ns = now_ns;
                match self.phase {
                    Phase::ResettingFault(0) => {
                        self.phase = Phase::ResettingFault(1);
                        Ok(Self::control(FAULT_RESET))
                    }
                    Phase::ResettingFault(2) => Ok(Next::Done),
                    _ => Ok(Next::Read(STATUSWORD)),
                }
            }
            (Phase::Look, _) => self.look(now_ns, &step),
            (Phase::Commanded { from, to, limit_ns }, _) => self.confirm(now_ns, &step, from, to, limit_ns),
            (Phase::Braking, Input::Read(index)) => self.brake(now_ns, &step, index),
            (Phase::Forced, _) => self.forced(now_ns),
            (Phase::ResettingFault(_), _) => self.reset(now_ns),
            (Phase::SetPoint(stage), _) => self.set_point(now_ns, &step, stage),
            (Phase::Reaching { was_unreached }, Input::Read(index)) => {
                self.reach(now_ns, &step, was_unreached, index)
            }
            (Phase::Holding, _) => {
                self.operates()?;
                let DriveStep::Hold(Some(for_ns)) = step else {
                    return Ok(Next::Pause(now_ns + self.timing.poll_ns));
                };
                let until_ns = self.begun_ns.saturating_add(for_ns);
                Ok(if now_ns >= until_ns {
                    Next::Done
                } else {
                    Next::Pause(until_ns.min(now_ns + self.timing.poll_ns))
                })
            }
            (Phase::Braking | Phase::Reaching { .. }, _) => Ok(Next::Read(STATUSWORD)),
        }
    }

    fn first(&mut self, step: DriveStep) -> Next {
        let (phase, next) = match step {
            DriveStep::Inspect => (Phase::Reading(0), Next::Read(READ[0])),
            DriveStep::Enable | DriveStep::Disable | DriveStep::ResetFault => {
                (Phase::Look, Next::Read(STATUSWORD))
            }
            DriveStep::QuickStop | DriveStep::Stop => (Phase::Braking, Self::control(QUICK_STOP)),
            DriveStep::SetMode(mode) => (Phase::Mode, Next::Write(MODE, mode.to_le_bytes().to_vec())),
            DriveStep::Write { index, data } => (Phase::Writing, Next::Write(index, data)),
            DriveStep::SetPoint { .. } => (Phase::SetPoint(0), Next::Read(STATUSWORD)),
            DriveStep::Home => (Phase::Writing, Self::control(ENABLE_OPERATION | START)),
            DriveStep::Reach { .. } => (Phase::Reaching { was_unreached: false }, Next::Read(STATUSWORD)),
            DriveStep::Hold(_) => (Phase::Holding, Next::Read(STATUSWORD)),
        };
        self.phase = phase;
        next
    }

    /// Decides by the state what leads on to that of the step.
    fn look(&mut self, now_ns: u64, step: &DriveStep) -> Result<Next, DriveError> {
        use DriveState as State;
        let state = self.state()?;
        let DriveTiming { confirm_ns, stop_ns, .. } = self.timing;
        let statusword = self.statusword();
        let stays =
            |wanted, last| move |after_ms| DriveError::NotConfirmed { wanted, last, statusword, after_ms };
        let enables = *step == DriveStep::Enable;
        match (state, enables) {
            (State::OperationEnabled, true) | (State::SwitchOnDisabled | State::Fault, false)
                if *step != DriveStep::ResetFault =>
            {
                Ok(Next::Done)
            }
            (State::Fault | State::FaultReactionActive, true) => Err(DriveError::Fault { code: None }),
            (State::FaultReactionActive, false) => self.poll(now_ns, stop_ns, stays(State::Fault, state)),
            (State::Fault, false) => {
                self.phase = Phase::ResettingFault(0);
                Ok(Self::control(DISABLE_VOLTAGE))
            }
            // There is nothing to reset.
            _ if *step == DriveStep::ResetFault => Ok(Next::Done),
            (State::NotReadyToSwitchOn, _) => {
                self.poll(now_ns, confirm_ns, stays(State::SwitchOnDisabled, state))
            }
            (State::QuickStopActive, _) | (State::ReadyToSwitchOn, false) => {
                self.transit(DISABLE_VOLTAGE, state, State::SwitchOnDisabled, confirm_ns)
            }
            (State::SwitchOnDisabled, _) | (State::SwitchedOn, false) => {
                self.transit(SHUTDOWN, state, State::ReadyToSwitchOn, confirm_ns)
            }
            (State::ReadyToSwitchOn, true) => self.transit(SWITCH_ON, state, State::SwitchedOn, confirm_ns),
            (State::SwitchedOn, true) => {
                self.transit(ENABLE_OPERATION, state, State::OperationEnabled, confirm_ns)
            }
            (State::OperationEnabled, _) => self.transit(SWITCH_ON, state, State::SwitchedOn, stop_ns),
        }
    }

    /// The state after a command.
    fn confirm(
        &mut self,
        now_ns: u64,
        step: &DriveStep,
        from: DriveState,
        to: DriveState,
        limit_ns: u64,
    ) -> Result<Next, DriveError> {
        let (got, statusword) = (self.state()?, self.statusword());
        if got == to && *step == DriveStep::Stop {
            return Ok(Next::Done);
        }
        // Without power sooner than it was told is as good.
        if got == to || got != from && *step != DriveStep::Enable && !got.is_powered() {
            (self.phase, self.since_ns) = (Phase::Look, now_ns);
            return self.look(now_ns, step);
        }
        match got {
            _ if got == from => self.poll(now_ns, limit_ns, |after_ms| DriveError::NotConfirmed {
                wanted: to,
                last: got,
                statusword,
                after_ms,
            }),
            DriveState::Fault | DriveState::FaultReactionActive => Err(DriveError::Fault { code: None }),
            _ => Err(DriveError::Jumped { from, wanted: to, got, statusword }),
        }
    }

    /// After a quick stop was commanded.
    fn brake(&mut self, now_ns: u64, step: &DriveStep, index: u16) -> Result<Next, DriveError> {
        let state = self.state()?;
        let DriveTiming { confirm_ns, stop_ns, .. } = self.timing;
        let ends = *step == DriveStep::Stop;
        match state {
            DriveState::SwitchOnDisabled | DriveState::Fault | DriveState::NotReadyToSwitchOn => {
                Ok(Next::Done)
            }
            DriveState::QuickStopActive if !ends => Ok(Next::Done),
            DriveState::QuickStopActive if index != VELOCITY => Ok(Next::Read(VELOCITY)),
            DriveState::QuickStopActive if self.values.stands() => {
                self.transit(DISABLE_VOLTAGE, state, DriveState::SwitchOnDisabled, confirm_ns)
            }
            DriveState::QuickStopActive | DriveState::FaultReactionActive => {
                self.brake_longer(now_ns, stop_ns, state)
            }
            _ => self.brake_longer(now_ns, confirm_ns, state),
        }
    }

    /// Waits on; then, if it is a motion's end, takes the voltage away.
    fn brake_longer(&mut self, now_ns: u64, limit_ns: u64, last: DriveState) -> Result<Next, DriveError> {
        let (wanted, statusword) = (DriveState::QuickStopActive, self.statusword());
        let late = |after_ms| DriveError::NotConfirmed { wanted, last, statusword, after_ms };
        match self.poll(now_ns, limit_ns, late) {
            Err(_) if self.step == Some(DriveStep::Stop) => {
                self.phase = Phase::Forced;
                Ok(Self::control(DISABLE_VOLTAGE))
            }
            next => next,
        }
    }

    /// After the voltage was taken away from a drive that had not braked.
    fn forced(&self, now_ns: u64) -> Result<Next, DriveError> {
        let (last, statusword) = (self.state()?, self.statusword());
        if matches!(last, DriveState::SwitchOnDisabled | DriveState::Fault) {
            return Ok(Next::Done);
        }
        self.poll(now_ns, self.timing.confirm_ns, |after_ms| DriveError::NotConfirmed {
            wanted: DriveState::SwitchOnDisabled,
            last,
            statusword,
            after_ms,
        })
    }

    fn reset(&mut self, now_ns: u64) -> Result<Next, DriveError> {
        if self.state()? != DriveState::Fault {
            self.phase = Phase::ResettingFault(2);
            return Ok(Self::control(DISABLE_VOLTAGE));
        }
        self.poll(now_ns, self.timing.confirm_ns, |_| DriveError::Fault { code: None })
    }

    /// An error unless operation is enabled.
    fn operates(&self) -> Result<(), DriveError> {
        match self.state()? {
            DriveState::OperationEnabled => Ok(()),
            DriveState::Fault | DriveState::FaultReactionActive => Err(DriveError::Fault { code: None }),
            got => Err(DriveError::Left { got, statusword: self.statusword() }),
        }
    }

    fn set_point(&mut self, now_ns: u64, step: &DriveStep, stage: u8) -> Result<Next, DriveError> {
        self.operates()?;
        let is_acknowledged = self.values.has(ACKNOWLEDGED);
        let relative = if *step == (DriveStep::SetPoint { relative: true }) { RELATIVE } else { 0 };
        match (stage, is_acknowledged) {
            // One before may still be acknowledged.
            (0, true) => {
                self.phase = Phase::SetPoint(1);
                Ok(Self::control(ENABLE_OPERATION))
            }
            (0 | 1, false) => {
                self.phase = Phase::SetPoint(2);
                Ok(Self::control(ENABLE_OPERATION | START | relative))
            }
            (2, true) => {
                self.phase = Phase::SetPoint(3);
                Ok(Self::control(ENABLE_OPERATION | relative))
            }
            (3, false) => Ok(Next::Done),
            _ => self.poll(now_ns, self.timing.confirm_ns, |after_ms| DriveError::SetPoint {
                is_acknowledged,
                after_ms,
            }),
        }
    }

    fn reach(
        &mut self,
        now_ns: u64,
        step: &DriveStep,
        was_unreached: bool,
        index: u16,
    ) -> Result<Next, DriveError> {
        let DriveStep::Reach { is_homing, within_ns } = *step else { return Ok(Next::Done) };
        match index {
            POSITION => return Ok(Next::Read(VELOCITY)),
            VELOCITY if is_homing => {
                self.phase = Phase::Writing;
                return Ok(Self::control(ENABLE_OPERATION));
            }
            VELOCITY => return Ok(Next::Done),
            _ => self.operates()?,
        }
        if self.values.has(MOTION_ERROR) {
            match self.values.mode {
                Some(6) => return Err(DriveError::HomingError),
                Some(1 | 8) => return Err(DriveError::FollowingError),
                _ => {}
            }
        }
        let is_reached = self.values.has(TARGET_REACHED) && (!is_homing || self.values.has(ACKNOWLEDGED));
        if is_reached && (was_unreached || now_ns >= self.begun_ns + STALE_NS) {
            return Ok(Next::Read(POSITION));
        }
        self.phase = Phase::Reaching { was_unreached: was_unreached || !is_reached };
        self.poll(now_ns, within_ns, |after_ms| DriveError::NotReached { after_ms })
    }
}
