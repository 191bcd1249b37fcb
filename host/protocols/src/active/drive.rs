//! Commands a drive (CiA 402) by SDO: state by state, each confirmed by its statusword.
//!
//! One [`DriveStep`] at a time. Whoever uses it decides what follows a step that failed: for a drive that may be moving, that is
//! [`DriveStep::Stop`], which takes no notice of what would end the others.

mod error;
mod plan;
mod step;
#[cfg(test)]
mod tests;

use cantap_can::Frame;
use cantap_trace::Id;

pub use self::error::DriveError;
use self::plan::{HEARTBEAT, Input, Next, Plan};
pub use self::step::{DriveStep, DriveTiming, DriveValues};
use super::Machine;
use super::sdo::{SdoClient, SdoError, SdoIds, SdoJob};
use crate::canopen::codec::sdo::SdoObject;
use crate::canopen::drive::{DriveState, object_of_axis};

/// How often an object is asked for again because frames were lost on the way to this computer.
const MOST_REPEATS: u32 = 3;
/// How much later than its period times 2.5 a heartbeat may arrive here.
const BEAT_GRACE_NS: u64 = 100_000_000;

/// Which object is under way, and what is written to it.
#[derive(Clone, Debug)]
struct Access {
    index: u16,
    data: Option<Vec<u8>>,
}

/// Commands one drive.
#[derive(Clone, Debug)]
pub struct DriveClient {
    node: u8,
    /// Of the node, from 1.
    axis: u8,
    timing: DriveTiming,
    plan: Plan,
    sdo: Option<(Access, SdoClient)>,
    pause_ns: Option<u64>,
    repeats: u32,
    emergency: Option<u16>,
    has_restarted: bool,
    has_stray_answer: bool,
    has_rival: bool,
    hears_pdos: bool,
    /// The state of network management that its heartbeat reports.
    nmt_state: Option<u8>,
    beat_ns: Option<u64>,
    looked_ns: u64,
    end: Option<Result<(), DriveError>>,
}

impl DriveClient {
    /// For the drive with this node number, 1 to 127.
    pub fn new(node: u8, timing: DriveTiming) -> Self {
        Self {
            node,
            axis: 1,
            timing,
            plan: Plan::new(timing),
            sdo: None,
            pause_ns: None,
            repeats: 0,
            emergency: None,
            has_restarted: false,
            has_stray_answer: false,
            has_rival: false,
            hears_pdos: false,
            nmt_state: None,
            beat_ns: None,
            looked_ns: 0,
            end: None,
        }
    }

    /// For this axis of the node, 1 to 8. Steps and results name the objects of the first; errors those of the axis.
    #[must_use]
    pub fn with_axis(self, axis: u8) -> Self {
        Self { axis, ..self }
    }

    /// An object of the first axis as this one has it.
    pub fn object(&self, index: u16) -> u16 {
        object_of_axis(index, self.axis)
    }

    /// Gives it the next step, after the one before has ended.
    pub fn begin(&mut self, step: DriveStep) {
        // What was before does not count.
        if matches!(step, DriveStep::Inspect | DriveStep::ResetFault) {
            (self.emergency, self.has_restarted, self.has_rival) = (None, false, false);
        }
        self.plan.begin(step);
        (self.sdo, self.pause_ns, self.repeats, self.end) = (None, None, 0, None);
        self.has_stray_answer = false;
    }

    /// How the step ended.
    pub const fn outcome(&self) -> Result<(), DriveError> {
        match self.end {
            Some(end) => end,
            None => Err(DriveError::Cancelled),
        }
    }

    /// What is known of the drive.
    pub const fn values(&self) -> &DriveValues {
        self.plan.values()
    }

    /// The states that it has confirmed since the last call, in order.
    pub fn take_states(&mut self) -> Vec<DriveState> {
        self.plan.take_states()
    }

    /// Whether other nodes send this one PDOs: another master may command it.
    pub const fn hears_pdos(&self) -> bool {
        self.hears_pdos
    }

    /// The state of network management that its heartbeat reports: 4 stopped, 5 operational, 127 pre-operational.
    pub const fn nmt_state(&self) -> Option<u8> {
        self.nmt_state
    }

    /// What ends work, whatever the statusword says.
    fn check(&self, now_ns: u64) -> Result<(), DriveError> {
        if !self.plan.step().is_some_and(DriveStep::is_work) {
            return Ok(());
        }
        let period_ns = u64::from(self.values().heartbeat_ms.unwrap_or(0)) * 1_000_000;
        let silent_ns = self.beat_ns.map_or(0, |beat_ns| now_ns.saturating_sub(beat_ns));
        match (self.emergency, self.nmt_state) {
            _ if self.has_restarted => Err(DriveError::Restarted),
            (Some(code), _) => Err(DriveError::Emergency { code }),
            (_, Some(4)) => Err(DriveError::Stopped),
            _ if self.has_rival => Err(DriveError::OtherClient),
            _ if self.has_stray_answer => Err(DriveError::TwoAnswers),
            _ if period_ns > 0 && silent_ns > period_ns * 5 / 2 + BEAT_GRACE_NS => {
                Err(DriveError::HeartbeatMissing { after_ms: silent_ns / 1_000_000 })
            }
            _ => Ok(()),
        }
    }

    /// Takes what happened, and does what comes next.
    fn go(&mut self, now_ns: u64, input: Result<Input, DriveError>) {
        let next = input.and_then(|input| {
            self.check(now_ns)?;
            self.plan.next(now_ns, input)
        });
        match next {
            Ok(Next::Read(index)) => self.access(Access { index, data: None }),
            Ok(Next::Write(index, data)) => self.access(Access { index, data: Some(data) }),
            Ok(Next::Pause(until_ns)) => self.pause_ns = Some(until_ns),
            Ok(Next::Done) => self.end = Some(Ok(())),
            Err(error) => self.end = Some(Err(error)),
        }
    }

    fn access(&mut self, access: Access) {
        let job = access.data.clone().map_or(SdoJob::Read, SdoJob::Write);
        let (ids, answer_ns) = (SdoIds::of(self.node), self.timing.answer_ns);
        let client = SdoClient::new(ids, self.object(access.index), 0, job, false, answer_ns);
        self.sdo = Some((access, client));
    }

    /// What an access has brought.
    fn accessed(&mut self, now_ns: u64, access: Access, result: Result<Vec<u8>, SdoError>) {
        let index = access.index;
        let (is_read, is_optional) = (access.data.is_none(), self.plan.is_optional(index));
        let input = match result {
            Err(SdoError::FramesLost) if self.repeats < MOST_REPEATS => {
                // Each of them may be asked for, or written, twice.
                self.repeats += 1;
                return self.access(access);
            }
            // A stop must not fail because one frame was disturbed.
            Err(SdoError::NoAnswer { .. })
                if self.repeats == 0 && self.plan.step() == Some(&DriveStep::Stop) =>
            {
                self.repeats += 1;
                return self.access(access);
            }
            Ok(_) if !is_read => Ok(Input::Wrote),
            Ok(data) => {
                if index == HEARTBEAT {
                    self.beat_ns = Some(now_ns);
                }
                let kept = self.plan.keep(index, &data).map(|()| Input::Read(index));
                kept.map_err(|error| match error {
                    DriveError::Length { bytes, .. } => {
                        DriveError::Length { index: self.object(index), bytes }
                    }
                    error => error,
                })
            }
            Err(SdoError::Aborted { .. }) if is_read && is_optional => Ok(Input::Read(index)),
            Err(_) if self.plan.reads_fault() => Ok(Input::Read(index)),
            Err(error) => Err(DriveError::Sdo { index: self.object(index), error }),
        };
        self.go(now_ns, input);
    }
}

impl Machine for DriveClient {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        // If this computer did nothing for a while, heartbeats wait here, and are no later than it was.
        let stalled_ns = now_ns.saturating_sub(self.looked_ns).saturating_sub(BEAT_GRACE_NS);
        if let Some(beat_ns) = &mut self.beat_ns {
            *beat_ns = beat_ns.saturating_add(stalled_ns);
        }
        self.looked_ns = now_ns;
        loop {
            if let Some((_, sdo)) = &mut self.sdo {
                if let Some(frame) = sdo.next(now_ns) {
                    return Some(frame);
                }
                if !sdo.is_done() {
                    return None;
                }
            }
            if let Some((access, sdo)) = self.sdo.take() {
                self.accessed(now_ns, access, sdo.finish());
                continue;
            }
            if self.end.is_some() || self.plan.step().is_none() {
                return None;
            }
            match self.pause_ns {
                None if self.plan.is_new() => self.go(now_ns, Ok(Input::Begin)),
                None => return None,
                Some(until_ns) if now_ns >= until_ns => {
                    self.pause_ns = None;
                    self.go(now_ns, Ok(Input::Woke));
                }
                Some(_) => match self.check(now_ns) {
                    Ok(()) => return None,
                    error => self.end = Some(error),
                },
            }
        }
    }

    fn sent(&mut self, now_ns: u64) {
        if let Some((_, sdo)) = &mut self.sdo {
            sdo.sent(now_ns);
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        if id.is_extended() {
            return;
        }
        let node = u32::from(self.node);
        match (id.raw().wrapping_sub(node), data) {
            (0x700, [0 | 0x80]) => (self.has_restarted, self.beat_ns) = (true, Some(now_ns)),
            (0x700, [state]) => (self.nmt_state, self.beat_ns) = (Some(state & 0x7F), Some(now_ns)),
            (0x80, [low, high, ..]) => {
                let code = u16::from_le_bytes([*low, *high]);
                self.emergency = (code >= 0x100).then_some(code);
            }
            (0x580, _) => {
                let object = <[u8; 8]>::try_from(data).ok().map(SdoObject::decode);
                let asked = self
                    .sdo
                    .as_ref()
                    .map(|(access, _)| SdoObject { index: self.object(access.index), sub: 0 });
                self.has_stray_answer |= asked.is_none() || object.is_some() && object != asked;
            }
            (0x600, _) => self.has_rival = true,
            (0x200 | 0x300 | 0x400 | 0x500, _) => self.hears_pdos = true,
            _ => {}
        }
        if let Some((_, sdo)) = &mut self.sdo {
            sdo.hear(now_ns, id, data);
        }
    }

    fn gap(&mut self, now_ns: u64) {
        // Heartbeats may be among what is missing.
        self.beat_ns = self.beat_ns.map(|_| now_ns);
        if let Some((_, sdo)) = &mut self.sdo {
            sdo.gap(now_ns);
        }
    }

    fn due_ns(&self) -> Option<u64> {
        match &self.sdo {
            Some((_, sdo)) => sdo.due_ns(),
            None => self.pause_ns,
        }
    }

    fn is_done(&self) -> bool {
        self.end.is_some() && self.sdo.is_none()
    }

    fn cancel(&mut self) -> Option<Frame> {
        self.end = Some(Err(DriveError::Cancelled));
        self.pause_ns = None;
        self.sdo.take().and_then(|(_, mut sdo)| sdo.cancel())
    }
}
