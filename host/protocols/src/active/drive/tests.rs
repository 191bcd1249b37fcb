use cantap_can::Frame;
use cantap_trace::Id;

use super::*;
use crate::active::testing::{Say, arrives, disturbed, run};
use crate::canopen::codec::sdo::{Content, SdoRequest, SdoResponse};
use crate::canopen::drive::{DriveState as State, mode_name};

const MS: u64 = 1_000_000;

/// How a stand-in differs from a drive that behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lie {
    None,
    /// Its statusword never changes.
    Frozen,
    /// From ready to switch on it is operation enabled at once.
    Jumps,
    /// It says a state that there is not.
    NoState,
    /// A fault instead of operation enabled.
    Faults,
    /// Objects that are not there.
    Aborts(u16),
    /// A second node answers as well.
    Twice,
    /// An emergency instead of an answer's peace.
    Emergency,
    /// A boot-up message in the middle.
    Restarts,
    /// It shows no other mode.
    OneMode,
    NoAcknowledge,
    NoRelease,
    /// It goes on after a quick stop, as fast as before.
    NoBrake,
    /// And does not even show that a quick stop is active.
    IgnoresQuickStop,
    Silent,
    Long,
    FollowingError,
    /// Instead of losing its voltage it starts, and is ready to switch on again.
    Flaps,
}

/// A drive, by CiA 402's state machine.
struct Drive {
    lie: Lie,
    state: State,
    word: u16,
    mode: i8,
    velocity: i32,
    acknowledged: bool,
    /// How often it was asked for its statusword since the target came.
    polls: u32,
    log: Vec<u16>,
    fault: u16,
    /// What its objects are above those of the first axis.
    axis: u16,
}

impl Drive {
    fn new(lie: Lie) -> Self {
        Self {
            lie,
            state: State::SwitchOnDisabled,
            word: 0,
            mode: 0,
            velocity: 0,
            acknowledged: false,
            polls: 0,
            log: Vec::new(),
            fault: 0,
            axis: 0,
        }
    }

    fn in_state(state: State) -> Self {
        Self { state, ..Self::new(Lie::None) }
    }

    fn statusword(&mut self) -> u16 {
        self.polls += 1;
        let state = match (self.lie, self.state) {
            (Lie::Frozen, _) => State::SwitchOnDisabled,
            (Lie::Flaps, _) if self.polls.is_multiple_of(2) => State::NotReadyToSwitchOn,
            (Lie::Flaps, _) => State::ReadyToSwitchOn,
            (Lie::NoState, State::ReadyToSwitchOn) => return 0x0001,
            (_, state) => state,
        };
        let low = match state {
            State::NotReadyToSwitchOn => 0x00,
            State::SwitchOnDisabled => 0x40,
            State::ReadyToSwitchOn => 0x21,
            State::SwitchedOn => 0x23,
            State::OperationEnabled => 0x27,
            State::QuickStopActive => 0x07,
            State::FaultReactionActive => 0x0F,
            State::Fault => 0x08,
        };
        let reached = if self.polls > 3 { 0x400 } else { 0 };
        let acknowledged = if self.acknowledged { 0x1000 } else { 0 };
        let wrong = if self.lie == Lie::FollowingError && self.polls > 2 { 0x2000 } else { 0 };
        low | reached | acknowledged | wrong
    }

    fn control(&mut self, word: u16) {
        self.log.push(word);
        let rises = word & !self.word;
        self.word = word;
        let powered = self.state == State::OperationEnabled;
        self.state = match self.state {
            State::Fault if rises & 0x80 != 0 => {
                self.fault = 0;
                State::SwitchOnDisabled
            }
            State::Fault => State::Fault,
            _ if word & 2 == 0 => State::SwitchOnDisabled,
            state if word & 4 == 0 => match (powered, self.lie) {
                (true, Lie::IgnoresQuickStop) => state,
                (true, _) => State::QuickStopActive,
                _ => State::SwitchOnDisabled,
            },
            _ if word & 1 == 0 => State::ReadyToSwitchOn,
            state @ (State::SwitchOnDisabled | State::QuickStopActive) => state,
            State::ReadyToSwitchOn if self.lie == Lie::Jumps => State::OperationEnabled,
            _ if word & 8 == 0 => State::SwitchedOn,
            State::SwitchedOn if self.lie == Lie::Faults => {
                self.fault = 0x2310;
                State::Fault
            }
            _ => State::OperationEnabled,
        };
        if rises & 0x10 != 0 && self.lie != Lie::NoAcknowledge {
            (self.acknowledged, self.polls) = (true, 0);
        }
        if word & 0x10 == 0 && self.lie != Lie::NoRelease {
            self.acknowledged = false;
        }
        if self.state != State::OperationEnabled && self.lie != Lie::NoBrake {
            self.velocity = 0;
        }
    }

    /// 0 for the objects of another axis.
    fn of_first_axis(&self, index: u16) -> u16 {
        if index < 0x6000 {
            index
        } else {
            index.checked_sub(self.axis).filter(|index| *index < 0x6800).unwrap_or(0)
        }
    }

    fn answer(&mut self, request: SdoRequest, say: &mut Say) -> Option<SdoResponse> {
        let expedited = |bytes: &[u8]| Content::expedited(bytes).unwrap();
        Some(match request {
            SdoRequest::Upload(object) if self.lie == Lie::Aborts(object.index) => {
                SdoResponse::Abort(object, 0x0602_0000)
            }
            SdoRequest::Upload(object) => {
                let bytes = match self.of_first_axis(object.index) {
                    0x6041 if self.lie == Lie::Long => vec![0; 3],
                    0x6041 => self.statusword().to_le_bytes().to_vec(),
                    0x6061 => self.mode.to_le_bytes().to_vec(),
                    0x603F => self.fault.to_le_bytes().to_vec(),
                    0x6064 => 5000_i32.to_le_bytes().to_vec(),
                    0x606C => self.velocity.to_le_bytes().to_vec(),
                    0x1017 => 0_u16.to_le_bytes().to_vec(),
                    _ => return Some(SdoResponse::Abort(object, 0x0602_0000)),
                };
                SdoResponse::Upload(object, expedited(&bytes))
            }
            SdoRequest::Download(object, Content::Expedited { bytes, .. }) => {
                let number = u32::from_le_bytes(bytes);
                match self.of_first_axis(object.index) {
                    0x6040 => {
                        self.control(number as u16);
                        if self.log.len() == 2 {
                            let frame = match self.lie {
                                Lie::Emergency => Some(frame(0x85, &[0x10, 0x32, 4, 0, 0, 0, 0, 0])),
                                Lie::Restarts => Some(frame(0x705, &[0])),
                                _ => None,
                            };
                            say.extend(frame.map(|frame| (0, frame)));
                        }
                    }
                    0x6060 if self.lie != Lie::OneMode => self.mode = number as i8,
                    0x60FF => self.velocity = number as i32,
                    _ => {}
                }
                SdoResponse::Download(object)
            }
            _ => return None,
        })
    }

    fn hear(&mut self, id: Id, data: &[u8], say: &mut Say) {
        let Ok(data) = data.try_into() else { return };
        if id.raw() != 0x605 || self.lie == Lie::Silent {
            return;
        }
        let Some(request) = SdoRequest::decode(data) else { return };
        if let Some(response) = self.answer(request, say) {
            let frame = frame(0x585, &response.encode());
            say.push((MS, frame));
            if self.lie == Lie::Twice {
                say.push((2 * MS, frame));
            }
        }
    }
}

fn frame(id: u32, data: &[u8]) -> Frame {
    Frame::data_frame(Id::standard_truncated(id), data).unwrap()
}

/// Runs steps until one fails.
fn steps(drive: &mut Drive, steps: &[DriveStep]) -> (DriveClient, Result<(), DriveError>) {
    let mut client = DriveClient::new(5, DriveTiming::default());
    let mut result = Ok(());
    for step in steps {
        result = one(&mut client, drive, step.clone());
        if result.is_err() {
            break;
        }
    }
    (client, result)
}

fn one(client: &mut DriveClient, drive: &mut Drive, step: DriveStep) -> Result<(), DriveError> {
    client.begin(step);
    run(client, &mut |id: Id, data: &[u8], say: &mut Say| drive.hear(id, data, say), arrives);
    client.outcome()
}

const REACH: DriveStep = DriveStep::Reach { is_homing: false, within_ns: 60_000 * MS };

#[test]
fn a_drive_is_enabled_and_disabled_state_by_state() {
    let mut drive = Drive::new(Lie::None);
    let (mut client, result) = steps(&mut drive, &[DriveStep::Inspect, DriveStep::Enable]);
    assert_eq!(result, Ok(()));
    assert_eq!(drive.log, [0x06, 0x07, 0x0F]);
    let up = [State::SwitchOnDisabled, State::ReadyToSwitchOn, State::SwitchedOn, State::OperationEnabled];
    assert_eq!(client.take_states(), up);
    assert_eq!((client.values().position, client.values().torque), (Some(5000), None));
    drive.log.clear();
    assert_eq!(one(&mut client, &mut drive, DriveStep::Disable), Ok(()));
    assert_eq!(drive.log, [0x07, 0x06, 0x00]);
    let down = [State::SwitchedOn, State::ReadyToSwitchOn, State::SwitchOnDisabled];
    assert_eq!(client.take_states(), down);
}

/// A node with several axes has their objects 800h apart; those that are no part of the profile are common.
#[test]
fn another_axis_is_commanded_by_its_own_objects() {
    let mut drive = Drive { axis: 0x1000, ..Drive::new(Lie::None) };
    let mut third = DriveClient::new(5, DriveTiming::default()).with_axis(3);
    for step in [DriveStep::Inspect, DriveStep::SetMode(3), DriveStep::Enable] {
        assert_eq!(one(&mut third, &mut drive, step), Ok(()));
    }
    assert_eq!((drive.state, drive.mode, third.values().position), (State::OperationEnabled, 3, Some(5000)));
    assert_eq!((third.object(0x6041), third.object(0x1017)), (0x7041, 0x1017));
    let mut first = DriveClient::new(5, DriveTiming::default());
    let error = one(&mut first, &mut drive, DriveStep::Stop).unwrap_err();
    assert!(matches!(error, DriveError::Sdo { index: 0x6041, .. }), "{error}");
    assert_eq!(drive.state, State::OperationEnabled);
    let error =
        one(&mut DriveClient::new(5, DriveTiming::default()).with_axis(2), &mut drive, DriveStep::Inspect);
    assert!(matches!(error, Err(DriveError::Sdo { index: 0x6841, .. })), "{error:?}");
}

/// A drive that starts anew whenever it should lose its voltage must not be commanded for ever.
#[test]
fn a_drive_that_goes_back_and_forth_is_given_up() {
    let (_, result) = steps(&mut Drive::new(Lie::Flaps), &[DriveStep::Disable]);
    assert_eq!(result, Err(DriveError::Restless { commands: 11 }));
}

/// From each state that it can be found in.
#[test]
fn a_stop_ends_in_a_state_without_power_whatever_the_state_was() {
    for state in [
        State::SwitchOnDisabled,
        State::ReadyToSwitchOn,
        State::SwitchedOn,
        State::OperationEnabled,
        State::QuickStopActive,
        State::Fault,
    ] {
        let mut drive = Drive::in_state(state);
        let (client, result) = steps(&mut drive, &[DriveStep::Stop]);
        assert_eq!((result, drive.log[0]), (Ok(()), 0x02), "{state:?}");
        let expected = if state == State::Fault { state } else { State::SwitchOnDisabled };
        assert_eq!((drive.state, client.values().state()), (expected, Some(expected)), "{state:?}");
    }
}

#[test]
fn a_drive_that_does_not_brake_loses_its_voltage() {
    for lie in [Lie::NoBrake, Lie::IgnoresQuickStop] {
        let mut drive = Drive { velocity: 900, ..Drive::new(lie) };
        let (mut client, result) = steps(&mut drive, &[DriveStep::Enable]);
        assert_eq!(result, Ok(()), "{lie:?}");
        drive.velocity = 900;
        assert_eq!(one(&mut client, &mut drive, DriveStep::Stop), Ok(()), "{lie:?}");
        assert_eq!((drive.state, drive.log.last()), (State::SwitchOnDisabled, Some(&0)), "{lie:?}");
    }
}

#[test]
fn each_lie_ends_with_its_reason() {
    let moves = [
        DriveStep::Inspect,
        DriveStep::SetMode(1),
        DriveStep::Enable,
        DriveStep::Write { index: 0x607A, data: vec![1, 0, 0, 0] },
        DriveStep::SetPoint { relative: true },
        REACH,
    ];
    for (lie, expected) in [
        (Lie::None, None),
        (Lie::Frozen, Some("it is still switch on disabled (0440) 20")),
        (
            Lie::Jumps,
            Some("it was ready to switch on and was to become switched on, but it is operation enabled (0"),
        ),
        (Lie::NoState, Some("its statusword 0001 is that of no state")),
        (Lie::Faults, Some("it has a fault: continuous over-current on the motor side (2310)")),
        (Lie::Aborts(0x6041), Some("object 6041: the node aborted it: object does not exist (06020000)")),
        (Lie::Aborts(0x6064), None),
        (Lie::Aborts(0x606C), None),
        (Lie::Twice, Some("answers come that nobody has asked for")),
        (Lie::Emergency, Some("it sent an emergency: DC link over-voltage (3210)")),
        (Lie::Restarts, Some("it has restarted by itself")),
        (Lie::OneMode, Some("it does not take the mode profile position (1), but shows no mode (0)")),
        (Lie::NoAcknowledge, Some("it does not acknowledge the set-point within 20")),
        (Lie::NoRelease, Some("it does not release the set-point within 20")),
        (Lie::Silent, Some("object 6041: no answer within 1000 ms, after 0 bytes")),
        (Lie::Long, Some("object 6041 has 3 bytes, which is not what a drive has there")),
        (Lie::FollowingError, Some("it reports a following error")),
    ] {
        let mut drive = Drive::new(lie);
        let (mut client, result) = steps(&mut drive, &moves);
        let text = result.err().map(|error| error.to_string());
        let fits = match (&text, expected) {
            (Some(text), Some(expected)) => text.starts_with(expected),
            (text, expected) => text.is_none() && expected.is_none(),
        };
        assert!(fits, "{lie:?}: {text:?}");
        // However it lies, the stop has commanded what it could, and says whether that was confirmed.
        drive.log.clear();
        let stopped = one(&mut client, &mut drive, DriveStep::Stop);
        let is_known = !matches!(lie, Lie::Aborts(0x6041) | Lie::Silent | Lie::Long);
        assert_eq!(
            (stopped.is_ok(), drive.log.first().copied()),
            (is_known, (lie != Lie::Silent).then_some(2)),
            "{lie:?} {stopped:?}"
        );
    }
}

#[test]
fn a_set_point_is_handed_over_and_bit_10_of_the_one_before_does_not_count() {
    let mut drive = Drive::in_state(State::OperationEnabled);
    // One before is still acknowledged.
    (drive.acknowledged, drive.mode) = (true, 1);
    let (_, result) = steps(&mut drive, &[DriveStep::SetPoint { relative: false }]);
    assert_eq!((result, &drive.log[..]), (Ok(()), &[0x0F, 0x1F, 0x0F][..]));
    let polls = drive.polls;
    let (client, result) = steps(&mut drive, &[REACH]);
    assert!(result.is_ok() && drive.polls > polls + 1, "{polls} {}", drive.polls);
    assert_eq!(client.values().position, Some(5000));
}

#[test]
fn a_fault_is_reset_by_an_edge_and_stays_if_its_cause_does() {
    let mut drive = Drive { fault: 0x7305, ..Drive::in_state(State::Fault) };
    assert_eq!(steps(&mut drive, &[DriveStep::ResetFault]).1, Ok(()));
    assert_eq!((&drive.log[..], drive.state), (&[0x00, 0x80, 0x00][..], State::SwitchOnDisabled));
    // The bit is set already, so that there is no edge, as in a drive that does not let go.
    let mut stuck = Drive { fault: 0x7305, ..Drive::in_state(State::Fault) };
    let mut client = DriveClient::new(5, DriveTiming::default());
    client.begin(DriveStep::ResetFault);
    let mut peer = |id: Id, data: &[u8], say: &mut Say| {
        stuck.word = 0x80;
        stuck.hear(id, data, say);
    };
    run(&mut client, &mut peer, arrives);
    assert_eq!(client.outcome(), Err(DriveError::Fault { code: Some(0x7305) }));
    assert_eq!(steps(&mut Drive::new(Lie::None), &[DriveStep::ResetFault]).1, Ok(()));
}

#[test]
fn a_heartbeat_that_stops_ends_a_motion_and_one_that_this_computer_slept_through_does_not() {
    let mut client = DriveClient::new(5, DriveTiming::default());
    let mut drive = Drive::in_state(State::OperationEnabled);
    let mut beats = 0;
    let mut peer = |id: Id, data: &[u8], say: &mut Say| {
        if data[..3] == [0x40, 0x17, 0x10] {
            say.push((MS, frame(0x585, &[0x4B, 0x17, 0x10, 0, 100, 0, 0, 0])));
            return;
        }
        // Five of them, and no more.
        if beats < 5 && data[..3] == [0x40, 0x41, 0x60] {
            beats += 1;
            say.push((3 * MS, frame(0x705, &[5])));
        }
        drive.hear(id, data, say);
    };
    client.begin(DriveStep::Inspect);
    run(&mut client, &mut peer, arrives);
    assert_eq!((client.outcome(), client.values().heartbeat_ms), (Ok(()), Some(100)));
    client.begin(DriveStep::Hold(None));
    run(&mut client, &mut peer, arrives);
    assert!(
        matches!(client.outcome(), Err(DriveError::HeartbeatMissing { after_ms: 350..=400 })),
        "{:?}",
        client.outcome()
    );
    // For ten seconds nothing was taken from the bus: the heartbeats of that time are not here yet.
    client.begin(DriveStep::Hold(Some(MS)));
    let later_ns = 100_000 * MS;
    client.hear(later_ns, Id::standard_truncated(0x705), &[5]);
    assert!(client.next(later_ns).is_some());
    client.sent(later_ns);
    let awake_ns = later_ns + 10_000 * MS;
    client.hear(awake_ns, Id::standard_truncated(0x585), &[0x4B, 0x41, 0x60, 0, 0x27, 0, 0, 0]);
    assert_eq!((client.next(awake_ns), client.outcome()), (None, Ok(())));
}

/// Whatever comes, each step ends; `run` enforces it.
#[test]
fn every_step_ends_on_a_bus_that_loses_doubles_and_swaps_frames() {
    let mut random = fastrand::Rng::with_seed(402);
    let reach = DriveStep::Reach { is_homing: true, within_ns: 5_000 * MS };
    let all = [
        DriveStep::Inspect,
        DriveStep::Enable,
        DriveStep::SetMode(6),
        DriveStep::Home,
        reach,
        DriveStep::SetPoint { relative: false },
        REACH,
        DriveStep::Hold(Some(300 * MS)),
        DriveStep::QuickStop,
        DriveStep::ResetFault,
        DriveStep::Disable,
        DriveStep::Stop,
    ];
    let mut ended_well = 0;
    for _ in 0..200 {
        let mut client = DriveClient::new(5, DriveTiming::default());
        let mut drive = Drive::new(Lie::None);
        for step in &all {
            client.begin(step.clone());
            let fate = disturbed(&mut random, 20);
            run(&mut client, &mut |id: Id, data: &[u8], say: &mut Say| drive.hear(id, data, say), fate);
            ended_well += u32::from(client.outcome().is_ok());
            assert_eq!(client.cancel(), None);
        }
    }
    assert!(ended_well > 500, "{ended_well}");
    assert_eq!(mode_name(6), Some("homing"));
}

/// Ctrl-C in the middle of a question: the channel is free for the stop.
#[test]
fn cancelling_aborts_the_question_and_the_stop_follows() {
    let mut client = DriveClient::new(5, DriveTiming::default());
    client.begin(DriveStep::Hold(None));
    assert_eq!(client.next(1).unwrap().data(), [0x40, 0x41, 0x60, 0, 0, 0, 0, 0]);
    assert_eq!(client.cancel().unwrap().data(), [0x80, 0x41, 0x60, 0, 0, 0, 0, 8]);
    assert!(client.is_done() && client.outcome() == Err(DriveError::Cancelled));
    let mut drive = Drive::in_state(State::OperationEnabled);
    assert_eq!(one(&mut client, &mut drive, DriveStep::Stop), Ok(()));
    assert_eq!(drive.log, [0x02, 0x00]);
}
