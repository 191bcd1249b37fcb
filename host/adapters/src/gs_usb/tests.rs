//! The driver, and a whole session, against a stand-in that answers as candleLight's firmware (`src/usbd_gs_can.c`, `src/can_common.c`), but confirms
//! as CANnectivity's: candleLight's returns a frame at once.

#[cfg(unix)]
mod emulated;
mod fd;

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use cantap::device::Device;
use cantap_trace::{TraceEvent, TraceRecord};
use cantap_wire::message::TxFrame;
use cantap_wire::record::ErrorState;

use super::wire::tests::constants;
use super::*;
use crate::source::Piece;
use crate::testing::{frames, until};

const EVERYTHING: u32 = feature::LISTEN_ONLY
    | feature::STAMPS
    | feature::IDENTIFY
    | feature::TERMINATION
    | feature::BUS_ERRORS
    | feature::STATE;

struct State {
    features: u32,
    channels: u8,
    /// Vendor requests with data for the adapter: which, to which channel, and what.
    requests: Vec<(u8, u16, Vec<u8>)>,
    /// The flags with which each channel was started.
    started: [Option<u32>; 2],
    /// On their way to the host.
    transfers: VecDeque<Vec<u8>>,
    /// Frames sent, while nobody on the bus acknowledges.
    unacknowledged: Option<Vec<Vec<u8>>>,
    is_unplugged: bool,
    /// Requests that it stalls.
    stalls: Vec<u8>,
    time_us: u32,
}

#[derive(Clone)]
struct StandIn(Arc<(Mutex<State>, Condvar)>);

impl StandIn {
    fn new(features: u32, channels: u8) -> Self {
        let state = State {
            features,
            channels,
            requests: Vec::new(),
            started: [None; 2],
            transfers: VecDeque::new(),
            unacknowledged: None,
            is_unplugged: false,
            stalls: Vec::new(),
            time_us: u32::MAX - 1_000,
        };
        Self(Arc::new((Mutex::new(state), Condvar::new())))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn changed(&self) {
        self.0.1.notify_all();
    }

    /// Passes bytes to the host.
    fn transfer(&self, bytes: Vec<u8>) {
        self.lock().transfers.push_back(bytes);
        self.changed();
    }

    /// A frame from the bus of a channel, 100 us after the last.
    fn receive(&self, channel: u8, frame: &str) {
        let bytes = wire::frame(&frame.parse().unwrap(), channel, RECEIVED);
        let stamped = self.stamped(bytes);
        self.transfer(stamped);
    }

    fn stamped(&self, mut bytes: Vec<u8>) -> Vec<u8> {
        let mut state = self.lock();
        state.time_us = state.time_us.wrapping_add(100);
        if state.started.iter().flatten().any(|flags| flags & feature::STAMPS != 0) {
            bytes.extend_from_slice(&state.time_us.to_le_bytes());
        }
        bytes
    }

    fn unplug(&self) {
        self.lock().is_unplugged = true;
        self.changed();
    }

    fn requests(&self, request: u8) -> Vec<(u16, Vec<u8>)> {
        let requests = &self.lock().requests;
        requests
            .iter()
            .filter(|(of, ..)| *of == request)
            .map(|(_, value, data)| (*value, data.clone()))
            .collect()
    }
}

impl Usb for StandIn {
    fn control_out(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), String> {
        let mut state = self.lock();
        let known = [
            request::HOST_FORMAT,
            request::BIT_TIMING,
            request::MODE,
            request::DATA_BIT_TIMING,
            request::IDENTIFY,
            request::SET_TERMINATION,
        ];
        if state.is_unplugged || state.stalls.contains(&request) || !known.contains(&request) {
            return Err("stalled".to_owned());
        }
        state.requests.push((request, value, data.to_vec()));
        if request == request::MODE {
            let word = |at: usize| u32::from_le_bytes(data[at..at + 4].try_into().unwrap());
            state.started[usize::from(value)] = (word(0) == 1).then(|| word(4));
        }
        Ok(())
    }

    fn control_in(
        &mut self,
        request: u8,
        _value: u16,
        len: u16,
        _within: Duration,
    ) -> Result<Vec<u8>, String> {
        let state = self.lock();
        if state.is_unplugged || state.stalls.contains(&request) {
            return Err("stalled".to_owned());
        }
        let mut answer = match request {
            request::DEVICE_CONFIG => [&[0, 0, 0, state.channels - 1][..], &words(&[2, 1])].concat(),
            request::CONSTANTS => constants(state.features),
            request::EXTENDED_CONSTANTS => {
                [constants(state.features), words(&[1, 32, 1, 16, 16, 1, 32, 1])].concat()
            }
            // Error passive, 130 received and 7 sent in error.
            request::STATE => words(&[2, 130, 7]),
            _ => return Err("stalled".to_owned()),
        };
        answer.truncate(len.into());
        Ok(answer)
    }

    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        let nothing = |state: &mut State| state.transfers.is_empty() && !state.is_unplugged;
        let (mut state, _) =
            self.0.1.wait_timeout_while(self.lock(), wait, nothing).unwrap_or_else(PoisonError::into_inner);
        match state.transfers.pop_front() {
            Some(content) => Ok(Some(Piece { at: Instant::now(), content })),
            None if state.is_unplugged => Err("it was unplugged".to_owned()),
            None => Ok(None),
        }
    }

    fn write(&mut self, bytes: Vec<u8>) -> Result<bool, String> {
        let channel = usize::from(bytes[9]);
        {
            let mut state = self.lock();
            if state.is_unplugged {
                return Err("it was unplugged".to_owned());
            }
            let flags = state.started[channel].expect("a frame to a channel that is off");
            assert_eq!(flags & feature::LISTEN_ONLY, 0, "a frame to a channel that only listens");
            if let Some(waiting) = &mut state.unacknowledged {
                waiting.push(bytes);
                return Ok(true);
            }
        }
        let echo = self.stamped(bytes);
        self.transfer(echo);
        Ok(true)
    }
}

fn connect(stand_in: &StandIn, options: Options) -> Result<GsUsb, OpenError> {
    GsUsb::over(Box::new(stand_in.clone()), "0042".to_owned(), options, "gs_usb:")
}

/// A session with it.
fn session(stand_in: &StandIn) -> Device {
    let driver = connect(stand_in, Options::default()).unwrap();
    Device::over(crate::engine::start(Box::new(driver)).unwrap(), "gs_usb:").unwrap()
}

fn losses(records: &[TraceRecord]) -> Vec<(&'static str, u32)> {
    let loss = |record: &TraceRecord| match record.event {
        TraceEvent::Lost { stage: Some(stage), count, .. } => Some((stage.name(), count)),
        _ => None,
    };
    records.iter().filter_map(loss).collect()
}

fn send(device: &Device, frame: &str) {
    let frame = TxFrame { tag: 1, frame: frame.parse().unwrap(), at_ticks: None };
    device.send(Channel::Can1, &[frame]).unwrap();
}

#[test]
fn it_is_greeted_and_both_channels_are_off_until_they_are_asked_for() {
    let stand_in = StandIn::new(EVERYTHING, 2);
    let device = session(&stand_in);
    assert_eq!(stand_in.requests(request::HOST_FORMAT), [(1, vec![0xEF, 0xBE, 0, 0])]);
    assert_eq!(stand_in.requests(request::MODE), [(0, vec![0; 8]), (1, vec![0; 8])]);
    let hello = device.hello();
    assert_eq!((hello.board.as_str(), hello.serial.as_str(), hello.channels), ("gs_usb", "0042", 2));
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!(stand_in.requests(request::BIT_TIMING), [(0, words(&[6, 7, 2, 2, 6]))]);
    let flags = feature::LISTEN_ONLY | feature::STAMPS | feature::BUS_ERRORS;
    assert_eq!(stand_in.lock().started, [Some(flags), None]);
    device.identify(1).unwrap();
    assert_eq!(stand_in.requests(request::IDENTIFY)[0], (0, words(&[1])));
    device.stop().unwrap();
    drop(device);
    assert_eq!(stand_in.lock().started, [None; 2]);
}

#[test]
fn frames_of_both_channels_arrive_with_the_adapter_s_intervals_over_the_wrap_of_its_clock() {
    let stand_in = StandIn::new(EVERYTHING, 2);
    let mut driver = connect(&stand_in, Options::default()).unwrap();
    let opening = Opening { bitrate_bps: 500_000, sample_point_permille: 875, listen_only: true };
    for channel in Channel::ALL {
        driver.open(channel, opening).unwrap();
    }
    for number in 0..20_u8 {
        stand_in.receive(number % 2, &format!("{number:03X}#11"));
    }
    let mut reports = Vec::new();
    while reports.len() < 20 {
        driver.poll(Duration::from_secs(10), &mut reports).unwrap();
    }
    let seen: Vec<(Channel, u32, Instant)> = reports
        .iter()
        .filter_map(|report| match report {
            Incoming::Received { channel, frame, at } => Some((*channel, frame.id().raw(), at.instant)),
            _ => None,
        })
        .collect();
    for (number, (channel, id, _)) in seen.iter().enumerate() {
        assert_eq!((channel.index(), *id), (number % 2, number as u32));
    }
    // While the clock settles, an arrival may move it, but no interval becomes longer than it was.
    for pair in seen.windows(2) {
        assert!(pair[1].2 - pair[0].2 <= Duration::from_micros(100));
    }
}

#[test]
fn without_stamps_frames_are_stamped_on_arrival() {
    let stand_in = StandIn::new(feature::LISTEN_ONLY, 1);
    let device = session(&stand_in);
    assert_eq!((device.hello().board.as_str(), device.hello().channels), ("gs_usb-arrival", 1));
    device.listen(Channel::Can1, 500_000).unwrap();
    stand_in.receive(0, "123#R4");
    stand_in.receive(0, "1ABCDEF0#0102030405060708");
    let records = until(&device, "1ABCDEF0#0102030405060708");
    assert_eq!(frames(&records)[0], (1, "123#R4".to_owned()));
    assert!(records.iter().filter(|record| record.frame().is_some()).count() == 2);
}

#[test]
fn one_that_cannot_only_listen_is_not_opened_until_that_is_allowed() {
    let stand_in = StandIn::new(feature::STAMPS, 1);
    let device = session(&stand_in);
    assert_eq!(device.hello().board.as_str(), "gs_usb-normal");
    let refused = device.listen(Channel::Can1, 500_000).unwrap_err();
    assert!(matches!(refused, cantap::DeviceError::AlwaysAcknowledges { .. }), "{refused}");
    assert_eq!(stand_in.lock().started, [None; 2]);
    device.join(Channel::Can1, 500_000).unwrap();
    assert_eq!(stand_in.lock().started, [Some(feature::STAMPS), None]);
}

#[test]
fn a_frame_is_confirmed_by_its_echo_and_not_before() {
    let stand_in = StandIn::new(EVERYTHING, 1);
    let device = session(&stand_in);
    device.join(Channel::Can1, 500_000).unwrap();
    let ends = device.transmissions();
    send(&device, "123#DEAD");
    assert_eq!(ends.recv().unwrap().result.unwrap().to_string(), "123#DEAD");
    // Nobody acknowledges; the channel is closed, and then it is known that it was not sent.
    stand_in.lock().unacknowledged = Some(Vec::new());
    send(&device, "456#");
    device.stop().unwrap();
    assert!(ends.recv().unwrap().result.is_err());
}

#[test]
fn an_echo_of_nothing_is_counted_and_confirms_nothing() {
    let stand_in = StandIn::new(EVERYTHING, 1);
    let device = session(&stand_in);
    device.join(Channel::Can1, 500_000).unwrap();
    for echo in [0, 3, 77] {
        stand_in.transfer(wire::frame(&"123#".parse().unwrap(), 0, echo));
    }
    stand_in.receive(0, "7FF#");
    assert_eq!(frames(&until(&device, "7FF#")), [(1, "7FF#".to_owned())]);
    let failures = device.failures().unwrap();
    assert!(failures.last.contains("3 confirmations"), "{}", failures.last);
}

#[test]
fn lengths_that_lie_and_babble_are_losses_and_an_overflow_is_one_of_the_controller() {
    let stand_in = StandIn::new(EVERYTHING, 1);
    let device = session(&stand_in);
    device.listen(Channel::Can1, 500_000).unwrap();
    let good = wire::frame(&"001#".parse().unwrap(), 0, RECEIVED);
    let changed = |at: usize, byte: u8| {
        let mut bytes = good.clone();
        bytes[at] = byte;
        stand_in.stamped(bytes)
    };
    for bytes in [
        good[..11].to_vec(),
        vec![0xFF; 64],
        // A DLC of 16, the third channel, CAN FD in 24 bytes, an overflow.
        changed(8, 16),
        changed(9, 2),
        changed(10, 2),
        changed(10, 1),
    ] {
        stand_in.transfer(bytes);
    }
    stand_in.receive(0, "7FF#");
    let records = until(&device, "7FF#");
    let unreadable = [("link", 1); 5];
    assert_eq!(losses(&records)[..5], unreadable);
    assert_eq!(losses(&records)[5..], [("controller", 1)]);
    assert_eq!(frames(&records), [(1, "001#".to_owned()), (1, "7FF#".to_owned())]);
    let failures = device.failures().unwrap();
    assert!(failures.last.contains("5 transfers that cannot be read"), "{}", failures.last);
}

#[test]
fn errors_states_and_counters_are_those_of_the_error_frames_and_of_the_answers() {
    let stand_in = StandIn::new(EVERYTHING, 1);
    let mut driver = connect(&stand_in, Options::default()).unwrap();
    let opening = Opening { bitrate_bps: 500_000, sample_point_permille: 875, listen_only: true };
    driver.open(Channel::Can1, opening).unwrap();
    let mut stuff = words(&[RECEIVED, 0x2000_0088]);
    stuff.extend_from_slice(&[8, 0, 0, 0, 0, 0, 4, 0, 0, 0, 0, 0]);
    let mut bus_off = words(&[RECEIVED, 0x2000_0040]);
    bus_off.extend_from_slice(&[8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    stand_in.transfer(stuff);
    stand_in.transfer(bus_off);
    let mut reports = Vec::new();
    driver.poll(Duration::from_secs(10), &mut reports).unwrap();
    assert!(matches!(reports[0], Incoming::BusError { .. }));
    assert!(matches!(reports[1], Incoming::State { state: ErrorState::BusOff, .. }));
    driver.asked = Instant::now().checked_sub(ASK_EVERY).unwrap();
    reports.clear();
    driver.poll(Duration::ZERO, &mut reports).unwrap();
    let [Incoming::State { state: ErrorState::Passive, counters: (7, 130), .. }] = reports[..] else {
        panic!("{reports:?}")
    };
    // One that does not answer is not asked again: frames would wait for it.
    stand_in.lock().stalls.push(request::STATE);
    for _ in 0..2 {
        driver.asked = Instant::now().checked_sub(ASK_EVERY).unwrap();
        driver.poll(Duration::ZERO, &mut reports).unwrap();
    }
    assert_eq!(driver.oddities().1, "1 questions for the state that were not answered");
}

#[test]
fn the_resistor_is_switched_only_where_that_is_asked_for_and_there_is_one() {
    let opening = Opening { bitrate_bps: 500_000, sample_point_permille: 875, listen_only: true };
    let stand_in = StandIn::new(EVERYTHING, 1);
    connect(&stand_in, Options::default()).unwrap().open(Channel::Can1, opening).unwrap();
    assert_eq!(stand_in.requests(request::SET_TERMINATION), []);
    connect(&stand_in, Options { termination: Some(true), ..Options::default() })
        .unwrap()
        .open(Channel::Can1, opening)
        .unwrap();
    assert_eq!(stand_in.requests(request::SET_TERMINATION), [(0, words(&[1]))]);
    let without = StandIn::new(feature::LISTEN_ONLY, 1);
    let on = Options { termination: Some(true), ..Options::default() };
    assert!(matches!(connect(&without, on), Err(OpenError::NoTermination { .. })));
}

#[test]
fn one_that_is_unplugged_ends_the_session_after_what_it_had_received() {
    let stand_in = StandIn::new(EVERYTHING, 1);
    let device = session(&stand_in);
    device.listen(Channel::Can1, 500_000).unwrap();
    stand_in.receive(0, "001#");
    stand_in.unplug();
    let records: Vec<_> = device.records().collect();
    // Nobody counts its losses, which its stream begins with.
    assert_eq!(records[0].as_ref().unwrap().event, TraceEvent::UNCOUNTED);
    assert_eq!(records[1].as_ref().unwrap().frame().unwrap().to_string(), "001#");
    let error = records.last().unwrap().as_ref().unwrap_err();
    assert!(error.to_string().contains("it was unplugged"), "{error}");
}

#[test]
fn one_that_stalls_a_request_is_foreign_or_refuses_and_is_not_left_half_open() {
    for request in [request::HOST_FORMAT, request::DEVICE_CONFIG, request::CONSTANTS] {
        let stand_in = StandIn::new(EVERYTHING, 1);
        stand_in.lock().stalls.push(request);
        assert!(
            matches!(connect(&stand_in, Options::default()), Err(OpenError::Foreign { .. })),
            "{request}"
        );
    }
    let stand_in = StandIn::new(EVERYTHING, 1);
    let device = session(&stand_in);
    stand_in.lock().stalls.push(request::BIT_TIMING);
    assert!(device.listen(Channel::Can1, 500_000).is_err());
    assert_eq!(stand_in.requests(request::MODE).last(), Some(&(0, vec![0; 8])));
    // A bit rate that its clock has not.
    stand_in.lock().stalls.clear();
    let refused = device.listen(Channel::Can1, 700_000).unwrap_err();
    assert!(refused.to_string().contains("bit"), "{refused}");
}

/// As fast as a bus at 1 Mbit/s carries the shortest frames, for a second.
#[test]
fn twenty_thousand_frames_arrive_in_order_and_none_is_missing() {
    let stand_in = StandIn::new(EVERYTHING, 1);
    let device = session(&stand_in);
    device.listen(Channel::Can1, 1_000_000).unwrap();
    let sender = stand_in.clone();
    let sending = std::thread::spawn(move || {
        for number in 0..20_000_u32 {
            sender.receive(0, &format!("{:08X}#", number + 1));
        }
    });
    let records = until(&device, &format!("{:08X}#", 20_000));
    sending.join().unwrap();
    assert_eq!(losses(&records), []);
    let ids: Vec<u32> =
        records.iter().filter_map(|record| Some(record.frame()?.classic()?.id().raw())).collect();
    assert!(ids.iter().copied().eq(1..=20_000), "{}", ids.len());
}
