//! The car, checked against its database over two drive cycles in simulated time.

use std::collections::BTreeMap;

use cantap_firmware::bus::checksum::checksum;
use cantap_signals::{Decoder, SignalValue, Source};
use cantap_trace::TraceFrame;
use cantap_trace::bits::FrameBits;
use cantap_wire::message::Checksum;
use cantap_wire::record::BusErrorKind;

use super::*;
use crate::simbus::{Node, Schedule, SimBus, Traffic};

const SECOND_NS: u64 = 1_000 * MS_NS;

/// Listens, and sends what it is given.
struct Analyser {
    bitrate_bps: u32,
    now_ns: u64,
    heard: Vec<(u64, Frame)>,
    to_send: VecDeque<Frame>,
    destroys: bool,
    errors: u32,
}

impl Node for Analyser {
    fn bitrate_bps(&self) -> Option<u32> {
        Some(self.bitrate_bps)
    }
    fn bid(&self) -> Option<Frame> {
        self.to_send.front().copied()
    }
    fn acknowledges(&self) -> bool {
        false
    }
    fn destroys(&self) -> bool {
        self.destroys
    }
    fn on_start(&mut self) {}
    fn on_lost(&mut self) {}
    fn on_frame(&mut self, frame: &Frame, own: bool) {
        if own {
            self.to_send.pop_front();
        } else {
            self.heard.push((self.now_ns, *frame));
        }
    }
    fn on_error(&mut self, _: BusErrorKind, _: bool) {
        self.errors += 1;
    }
    fn on_boundary(&mut self) {}
}

/// A bus of the car and an analyser on it.
struct Rig {
    bus: SimBus,
    analyser: Analyser,
}

impl Rig {
    fn new(bus: usize, seed: u64) -> Self {
        let nodes = Schedule::Nodes(Box::new(CarBus::new(bus, seed)));
        let analyser = Analyser {
            bitrate_bps: BITRATES_BPS[bus],
            now_ns: 0,
            heard: vec![],
            to_send: VecDeque::new(),
            destroys: false,
            errors: 0,
        };
        Self { bus: SimBus::new(Some(BITRATES_BPS[bus]), Traffic::new(nodes), seed), analyser }
    }

    fn run(&mut self, until_ns: u64) {
        loop {
            let next = self.bus.next_event_ns(self.analyser.now_ns, &[&mut self.analyser]);
            // Like the virtual device, which looks several times per millisecond.
            let look = self.analyser.now_ns / (MS_NS / 4) * (MS_NS / 4) + MS_NS / 4;
            let next = next.min(look).max(self.analyser.now_ns);
            if next > until_ns {
                return;
            }
            self.analyser.now_ns = next;
            self.bus.step(next, &mut [&mut self.analyser]);
        }
    }

    /// Everything received with this identifier since a given time.
    fn with_id(&self, id: u32, from_ns: u64) -> Vec<Vec<u8>> {
        let heard = self.analyser.heard.iter().filter(|(at_ns, _)| *at_ns >= from_ns);
        heard.filter(|(_, frame)| frame.id().raw() == id).map(|(_, frame)| frame.data().to_vec()).collect()
    }
}

fn decoder() -> Decoder {
    Decoder::new(vec![Source { channel: None, database: database().unwrap() }])
}

/// The frames of both buses over two cycles.
fn drive(seed: u64) -> [Vec<(u64, Frame)>; 2] {
    [0, 1].map(|bus| {
        let mut rig = Rig::new(bus, seed);
        rig.run(240 * SECOND_NS);
        assert_eq!(rig.analyser.errors, 0);
        rig.analyser.heard
    })
}

/// Each signal's values with their times.
fn signals(frames: &[(u64, Frame)]) -> BTreeMap<String, Vec<(f64, f64)>> {
    let decoder = decoder();
    let mut signals: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
    let mut values: Vec<SignalValue> = Vec::new();
    for (at_ns, frame) in frames {
        let message = decoder
            .decode(1, &TraceFrame::from(*frame), &mut values)
            .unwrap_or_else(|| panic!("{frame} is in no message"));
        for value in &values {
            let signal = &decoder.message(message).signals[value.signal as usize];
            let physical = value.value;
            let inside = signal.min.is_none_or(|min| physical >= min - 1e-9)
                && signal.max.is_none_or(|max| physical <= max + 1e-9);
            assert!(inside, "{} is {physical}", signal.name);
            signals.entry(signal.name.clone()).or_default().push((*at_ns as f64 / 1e9, physical));
        }
    }
    signals
}

#[test]
fn the_database_has_no_fault_and_every_signal_a_value() {
    let database = database().unwrap();
    assert!(database.warnings.is_empty(), "{:?}", database.warnings);
    let car = Vehicle::new(1);
    for message in database.messages.iter().filter(|message| !message.name.starts_with("DIAG_")) {
        for signal in message.signals.iter().filter(|signal| !signal.name.ends_with("Checksum")) {
            let value = values::value(&signal.name, &car, Context::default());
            assert!(value.is_some(), "{} has no value", signal.name);
        }
        assert_eq!(Layout::new(message).data(&car, Context::default()).len(), usize::from(message.length));
    }
}

/// Every message of the database comes in its cycle, within the jitter; and everything that comes is in range.
#[test]
fn messages_come_in_their_cycles_with_a_little_jitter() {
    let decoder = decoder();
    for (bus, frames) in drive(1).into_iter().enumerate() {
        let mut times: BTreeMap<u32, Vec<u64>> = BTreeMap::new();
        for (at_ns, frame) in &frames {
            times.entry(frame.id().raw()).or_default().push(*at_ns);
        }
        signals(&frames);
        for (_, _, message) in decoder.messages().filter(|(_, _, message)| !message.name.starts_with("DIAG_"))
        {
            let sender = message.name.split('_').next().unwrap();
            if BODY.contains(&sender) != (bus == 1) || message.name == "BBM_TPDT" {
                continue;
            }
            let times = times.get(&message.id.raw()).map_or(&[][..], Vec::as_slice);
            let Some(cycle_ms) = message.cycle_ms.filter(|ms| *ms > 0) else {
                assert!(
                    message.name == "BCM_Key" || times.len() >= 10,
                    "{} came {}",
                    message.name,
                    times.len()
                );
                continue;
            };
            let cycle_ns = u64::from(cycle_ms) * MS_NS;
            let expected = (240 * SECOND_NS - START_NS) / cycle_ns;
            assert!((times.len() as u64) + 2 >= expected, "{} came {} times", message.name, times.len());
            let gaps: Vec<u64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
            let longest = gaps.iter().max().unwrap();
            assert!(*longest < cycle_ns * 13 / 10 + MS_NS * 3, "{}: {longest} ns", message.name);
            let jitter = gaps.iter().any(|gap| gap.abs_diff(cycle_ns) > 20_000);
            assert!(jitter, "{} comes like a clock", message.name);
        }
        let bits: u64 = frames.iter().map(|(_, frame)| u64::from(FrameBits::of(frame).total())).sum();
        let load = bits as f64 / (f64::from(BITRATES_BPS[bus]) * 240.0) * 100.0;
        assert!((4.0..35.0).contains(&load), "bus {bus}: {load} %");
    }
}

/// A receiver's check: each counter increments by one, and each checksum is right.
#[test]
fn counters_and_checksums_hold() {
    let decoder = decoder();
    let [train, body] = drive(1);
    let mut counters: BTreeMap<&str, u64> = BTreeMap::new();
    let mut checked: BTreeMap<&str, u32> = BTreeMap::new();
    for (_, frame) in train.iter().chain(&body) {
        let mut values = Vec::new();
        let message = decoder.message(decoder.decode(1, &TraceFrame::from(*frame), &mut values).unwrap());
        for value in values {
            let signal = &message.signals[value.signal as usize];
            let now = value.raw;
            if signal.name.ends_with("Counter") {
                let before = counters.insert(&signal.name, now);
                assert!(before.is_none_or(|before| (before + 1) % 16 == now), "{} {now}", signal.name);
                *checked.entry(&signal.name).or_default() += 1;
            } else if signal.name.ends_with("Checksum") {
                let algorithm =
                    if signal.name.starts_with("Steering") { Checksum::Xor } else { Checksum::Crc8J1850 };
                let expected = checksum(algorithm, frame.data(), 7);
                assert_eq!(u64::from(expected), now, "{}", signal.name);
                *checked.entry(&signal.name).or_default() += 1;
            }
        }
    }
    assert_eq!(checked.len(), 8 + 1 + 8, "{checked:?}");
    assert!(checked.values().all(|count| *count > 2000), "{checked:?}");
}

/// How fast a signal may change, in its unit per second, on top of one step of its resolution.
const LIMITS: [(&str, f64); 26] = [
    ("EngineSpeed", 4000.0),
    ("EngineTorque", 4000.0),
    ("ThrottlePosition", 1000.0),
    ("AcceleratorPedal", 700.0),
    ("CoolantTemperature", 1.5),
    ("OilTemperature", 1.0),
    ("TransmissionOilTemperature", 0.5),
    ("IntakeAirTemperature", 2.0),
    ("BatteryVoltage", 8.0),
    ("FuelLevel", 0.9),
    ("VehicleSpeed", 18.0),
    ("WheelSpeedFL", 30.0),
    ("WheelSpeedFR", 30.0),
    ("WheelSpeedRL", 30.0),
    ("WheelSpeedRR", 30.0),
    ("BrakePressure", 400.0),
    ("LongitudinalAcceleration", 20.0),
    ("LateralAcceleration", 30.0),
    ("YawRate", 120.0),
    ("SteeringAngle", 230.0),
    ("Odometer", 0.035),
    ("TripDistance", 0.035),
    ("CabinTemperature", 0.5),
    ("TyrePressureFL", 1.0),
    ("WindowFL", 26.0),
    ("WiperAngle", 450.0),
];

#[test]
fn signals_move_as_things_do() {
    for seed in [1, 2, 77] {
        let [train, body] = drive(seed);
        let mut all = signals(&train);
        all.append(&mut signals(&body));
        let database = database().unwrap();
        for (name, per_second) in LIMITS {
            let signal = database.messages.iter().find_map(|message| message.signal(name)).unwrap();
            let jump = all[name].windows(2).find(|pair| {
                let [(before_s, before), (now_s, now)] = [pair[0], pair[1]];
                // The car moves in steps of 10 ms, and a frame's time is its end.
                (now - before).abs() > per_second * (now_s - before_s + 0.012) + signal.factor
            });
            assert_eq!(jump, None, "{name} jumps, seed {seed}");
        }
        // Anyone watching for a minute sees them move.
        let range = |name: &str| {
            let minute = all[name].iter().filter(|(at_s, _)| *at_s < 60.0).map(|(_, value)| *value);
            minute.fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)))
        };
        for (name, least) in [
            ("EngineSpeed", 1500.0),
            ("VehicleSpeed", 90.0),
            ("CurrentGear", 6.0),
            ("CoolantTemperature", 25.0),
            ("ThrottlePosition", 30.0),
            ("BrakePressure", 10.0),
            ("SteeringAngle", 90.0),
            ("WindowFL", 50.0),
            ("TripDistance", 0.5),
            ("TurnRight", 1.0),
            ("EngineState", 2.0),
        ] {
            let (low, high) = range(name);
            assert!(high - low >= least, "{name} goes from {low} to {high}, seed {seed}");
        }
        // The engine turns in proportion to the wheels when a gear is in and nothing slips.
        assert!(all["VehicleSpeed"].iter().all(|(_, kmh)| *kmh < 110.0));
    }
}

#[test]
fn the_same_seed_is_the_same_car_and_another_is_not() {
    let heard = |seed| {
        let mut rig = Rig::new(0, seed);
        rig.run(20 * SECOND_NS);
        rig.analyser.heard
    };
    assert_eq!(heard(1), heard(1));
    assert_ne!(heard(1), heard(2));
}

/// A channel that is opened late finds the car where it is by then, without a burst of unheard frames.
#[test]
fn who_comes_late_finds_the_car_on_its_way() {
    let mut rig = Rig::new(0, 1);
    rig.analyser.now_ns = 3600 * SECOND_NS;
    rig.run(3601 * SECOND_NS);
    assert!((400..1200).contains(&rig.analyser.heard.len()), "{}", rig.analyser.heard.len());
    assert!(signals(&rig.analyser.heard)["Odometer"].iter().all(|(_, km)| *km > 48_230.0));
}

/// Destroyed frames are sent again, and an ECU whose frames all fail stays away for a while.
#[test]
fn a_disturbed_car_suffers_and_recovers() {
    let mut rig = Rig::new(0, 1);
    rig.run(5 * SECOND_NS);
    let counted = rig.analyser.heard.len();
    rig.analyser.bitrate_bps = 250_000;
    rig.analyser.destroys = true;
    rig.run(6 * SECOND_NS);
    assert_eq!(rig.analyser.heard.len(), counted);
    rig.analyser.bitrate_bps = 500_000;
    let from_ns = rig.analyser.now_ns;
    rig.run(8 * SECOND_NS);
    let after = rig.with_id(0x0C0, from_ns);
    assert!(
        (150..=200).contains(&after.len()),
        "{} of 200: some were left out while it was away",
        after.len()
    );
    let counters: Vec<u8> = after.iter().map(|data| data[6] & 15).collect();
    assert!(counters.windows(2).all(|pair| (pair[0] + 1) % 16 == pair[1]), "{counters:?}");
}

fn tester(bytes: &str) -> Frame {
    bytes.parse().unwrap()
}

#[test]
fn a_tester_reads_values_and_an_answer_of_several_frames() {
    let mut rig = Rig::new(0, 1);
    rig.run(30 * SECOND_NS);
    // Engine speed and coolant temperature, requested from all: only the engine's ECU knows them.
    rig.analyser.to_send.push_back(tester("7DF#03010C0500000000"));
    rig.run(30 * SECOND_NS + 50 * MS_NS);
    let answers = rig.with_id(0x7E8, 0);
    assert_eq!(answers.len(), 1);
    let [0x06, 0x41, 0x0C, high, low, 0x05, coolant, 0xAA] = answers[0][..] else { panic!("{answers:?}") };
    let rpm = u32::from(u16::from_be_bytes([high, low]) / 4);
    assert!((700..3000).contains(&rpm) && coolant > 60, "{rpm} {coolant}");
    assert!(rig.with_id(0x7E9, 0).is_empty());

    // The identification number: a first frame, and no more before flow control.
    let from_ns = rig.analyser.now_ns;
    rig.analyser.to_send.push_back(tester("7DF#0209020000000000"));
    rig.run(from_ns + 500 * MS_NS);
    assert_eq!(rig.with_id(0x7E8, from_ns), [b"\x10\x14\x49\x02\x01WCT".to_vec()]);
    // One frame, then the others at least 20 ms apart.
    rig.analyser.to_send.push_back(tester("7E0#3001000000000000"));
    rig.run(from_ns + 600 * MS_NS);
    assert_eq!(rig.with_id(0x7E8, from_ns).len(), 2);
    rig.analyser.to_send.push_back(tester("7E0#3000140000000000"));
    rig.run(from_ns + 800 * MS_NS);
    let answers = rig.with_id(0x7E8, from_ns);
    assert_eq!(answers[1..], [b"\x21CANTA4P".to_vec(), b"\x220000001".to_vec()]);
}

#[test]
fn frames_of_an_answer_keep_the_gap_that_the_tester_asked_for() {
    let mut rig = Rig::new(0, 1);
    rig.run(SECOND_NS);
    // The name of the ECU: 23 bytes, three consecutive frames.
    rig.analyser.to_send.push_back(tester("7E1#02090A0000000000"));
    rig.run(SECOND_NS + 50 * MS_NS);
    rig.analyser.to_send.push_back(tester("7E1#3000140000000000"));
    rig.run(2 * SECOND_NS);
    let answers = rig.analyser.heard.iter().filter(|(_, frame)| frame.id().raw() == 0x7E9);
    let times: Vec<u64> = answers.map(|(at_ns, _)| *at_ns).collect();
    assert_eq!(times.len(), 4);
    assert!(times[1..].windows(2).all(|pair| (19 * MS_NS..24 * MS_NS).contains(&(pair[1] - pair[0]))));
}

#[test]
fn a_long_request_is_taken_with_flow_control_and_silence_ends_an_answer() {
    let mut rig = Rig::new(0, 1);
    rig.run(SECOND_NS);
    // Part number, serial number, rpm and the gear, which this ECU does not have: a request of 9 bytes in two
    // frames.
    rig.analyser.to_send.push_back(tester("7E0#100922F187F18C01"));
    rig.run(SECOND_NS + 20 * MS_NS);
    assert_eq!(rig.with_id(0x7E8, 0), [[0x30, 0, 0, 0xAA, 0xAA, 0xAA, 0xAA, 0xAA].to_vec()]);
    rig.analyser.to_send.push_back(tester("7E0#2100020000000000"));
    rig.run(SECOND_NS + 60 * MS_NS);
    let answers = rig.with_id(0x7E8, 0);
    // 62, F187 and 13 bytes, F18C and 10, 0100 and 2; 0200 belongs to the gearbox.
    assert_eq!(answers[1][..3], [0x10, 1 + 15 + 12 + 4, 0x62]);
    assert_eq!(answers.len(), 2);
    rig.run(4 * SECOND_NS);
    rig.analyser.to_send.push_back(tester("7E0#3000000000000000"));
    rig.run(5 * SECOND_NS);
    assert_eq!(rig.with_id(0x7E8, 0).len(), 2, "nobody waits for so long");
}

#[test]
fn trouble_codes_are_read_and_cleared_and_the_lamp_goes_out() {
    let mut rig = Rig::new(0, 1);
    let ask = |rig: &mut Rig, text: &str| {
        let from_ns = rig.analyser.now_ns;
        rig.analyser.to_send.push_back(tester(text));
        rig.run(from_ns + 50 * MS_NS);
        rig.with_id(0x7E8, from_ns).pop().unwrap_or_default()
    };
    rig.run(2 * SECOND_NS);
    assert_eq!(ask(&mut rig, "7E0#0103000000000000")[..5], [4, 0x43, 1, 0x01, 0x28]);
    assert_eq!(ask(&mut rig, "7E0#031902FF00000000")[..8], [7, 0x59, 2, 0x7F, 0x01, 0x28, 0, 0x2A]);
    assert_eq!(ask(&mut rig, "7E0#02270100000000")[..4], [3, 0x7F, 0x27, 0x11]);
    assert!(ask(&mut rig, "7DF#02270100000000").is_empty(), "to all, nobody says no");
    assert_eq!(ask(&mut rig, "7E0#0322123400000000")[..4], [3, 0x7F, 0x22, 0x31]);
    assert!(ask(&mut rig, "7E0#023E800000000000").is_empty());
    assert_eq!(ask(&mut rig, "7E0#023E000000000000")[..3], [2, 0x7E, 0]);
    assert_eq!(ask(&mut rig, "7E0#0210030000000000")[..3], [6, 0x50, 3]);
    let lamp = |rig: &Rig| signals(&rig.analyser.heard)["MalfunctionLamp"].last().unwrap().1 > 0.5;
    assert!(lamp(&rig));
    assert_eq!(ask(&mut rig, "7E0#0414FFFFFF000000")[..2], [1, 0x54]);
    assert_eq!(ask(&mut rig, "7E0#0103000000000000")[..3], [2, 0x43, 0]);
    rig.run(rig.analyser.now_ns + SECOND_NS);
    assert!(!lamp(&rig));
}

#[test]
fn what_is_said_to_be_supported_is_answered() {
    let car = Vehicle::new(1);
    for who in [Who::Engine, Who::Transmission] {
        let mut memory = Diagnostics::new(who);
        let mut first = 0;
        loop {
            let answer = memory.answer(&[0x01, first], false, &car).unwrap();
            let bits = u32::from_be_bytes(answer[2..6].try_into().unwrap());
            let there = |n: u8| bits >> (0x20 - n) & 1 == 1;
            for n in 1..0x20 {
                let answer = memory.answer(&[0x01, first + n], false, &car);
                assert_eq!(answer.is_some(), there(n), "{who:?} PID {:#04x}", first + n);
            }
            if !there(0x20) {
                break;
            }
            first += 0x20;
        }
        assert_eq!(first, 0x40, "{who:?}");
        let kinds = memory.answer(&[0x09, 0], false, &car).unwrap();
        let bits = u32::from_be_bytes(kinds[2..6].try_into().unwrap());
        for n in 1..0x20 {
            let answer = memory.answer(&[0x09, n], false, &car);
            assert_eq!(answer.is_some(), bits >> (0x20 - n) & 1 == 1, "{who:?} {n:#04x}");
        }
    }
}

/// Packets of a long J1939 message: the identification is complete.
#[test]
fn the_broadcast_identification_is_whole() {
    let mut rig = Rig::new(0, 1);
    rig.run(15 * SECOND_NS);
    let announced = rig.with_id(0x1CEC_FF00, 0);
    assert_eq!(announced[0], [32, 18, 0, 3, 0xFF, 0xEC, 0xFE, 0]);
    let packets = rig.with_id(0x1CEB_FF00, 0);
    let text: Vec<u8> = packets[..3].iter().flat_map(|packet| packet[1..].to_vec()).collect();
    assert_eq!(&text[..18], b"WCTCANTA4P0000001*");
    assert_eq!(packets[..3].iter().map(|packet| packet[0]).collect::<Vec<_>>(), [1, 2, 3]);
}
