//! The CAN controllers' registers and the bus between them, as RM0090 and ISO 11898-1 describe them:
//! what firmware would see, without firmware.

use cantap_can::Frame;
use cantap_emu::Clock;
use cantap_emu::bus::bits::FrameBits;
use cantap_emu::bus::{BitTime, BusFrame, Disturbance, Member, Node, Wire};
use cantap_emu::can::{CanPair, Mode};
use cantap_emu::traffic::{Kind, Script, Traffic};

const CLOCK: Clock = Clock::new(144_000_000);

const MCR: u32 = 0x00;
const MSR: u32 = 0x04;
const TSR: u32 = 0x08;
const RF0R: u32 = 0x0C;
const IER: u32 = 0x14;
const ESR: u32 = 0x18;
const BTR: u32 = 0x1C;
const TI0R: u32 = 0x180;
const RI0R: u32 = 0x1B0;
const CAN2: u32 = 0x400;

const INRQ: u32 = 1;
const NART: u32 = 1 << 4;
const ABOM: u32 = 1 << 6;
const SILENT: u32 = 1 << 31;
const LOOPBACK: u32 = 1 << 30;
/// 36 MHz / 3 / (1 + 8 + 3): 1 Mbit/s.
const MEGABIT: u32 = 2 | 7 << 16 | 2 << 20;
/// 36 MHz / 6 / (1 + 8 + 3): 500 kbit/s.
const HALF_MEGABIT: u32 = 5 | 7 << 16 | 2 << 20;
const BIT: u64 = CLOCK.us(1);
const MS: u64 = 1000 * CLOCK.us(1);

/// Both controllers and one bus with both on it.
struct Bench {
    can: CanPair,
    wire: Wire,
    now: u64,
}

impl Bench {
    /// A bus with these controllers, all filters open.
    fn new(attached: &[usize]) -> Self {
        let mut can = CanPair::default();
        for controller in &mut can.controllers {
            controller.set_cycles_per_clock(4);
        }
        let mut bench = Self { can, wire: Wire::new(attached), now: 1000 };
        for (register, value) in [(0x204, 0), (0x20C, 1 | 1 << 14), (0x240, 0), (0x244, 0)] {
            bench.write(register, value);
        }
        bench.write(0x2B0, 0);
        bench.write(0x2B4, 0);
        bench.write(0x21C, 1 | 1 << 14);
        bench.write(0x200, 14 << 8);
        bench
    }

    fn read(&mut self, offset: u32) -> u32 {
        self.can.read(offset, self.now).expect("a register")
    }

    fn write(&mut self, offset: u32, value: u32) {
        self.wire.advance(self.now, &mut self.can);
        self.can.write(offset, value, self.now).expect("a register that takes this");
    }

    fn run(&mut self, cycles: u64) {
        self.now += cycles;
        self.can.advance(self.now);
        self.wire.advance(self.now, &mut self.can);
    }

    /// The initialisation handshake, up to the point where the controller has synchronised.
    fn start(&mut self, base: u32, mcr: u32, btr: u32) {
        self.write(base + MCR, INRQ | mcr);
        assert_eq!(self.read(base + MSR) & 3, 1, "INAK, no longer SLAK");
        self.write(base + BTR, btr);
        self.write(base + MCR, mcr);
        assert_eq!(self.read(base + MSR) & 1, 1, "not before eleven recessive bits");
        self.run(30 * BIT);
        assert_eq!(self.read(base + MSR) & 3, 0);
    }

    fn transmit(&mut self, base: u32, mailbox: u32, frame: &str) {
        let frame: Frame = frame.parse().unwrap();
        let at = base + TI0R + 0x10 * mailbox;
        let data = frame.padded_data();
        self.write(at + 4, frame.dlc().into());
        self.write(at + 8, u32::from_le_bytes(data[..4].try_into().unwrap()));
        self.write(at + 12, u32::from_le_bytes(data[4..].try_into().unwrap()));
        self.write(at, cantap_emu::can::identifier_word(&frame) | 1);
    }

    /// A node that acknowledges.
    fn add_peer(&mut self) -> usize {
        self.wire.add(Node::new(BitTime::of_rate(1_000_000, CLOCK)))
    }

    fn good_frames(&self) -> Vec<&BusFrame> {
        self.wire.history().iter().filter(|frame| frame.error.is_none()).collect()
    }

    fn esr(&mut self, base: u32) -> (bool, bool, bool, u32, u32, u32) {
        let esr = self.read(base + ESR);
        (esr & 1 != 0, esr & 2 != 0, esr & 4 != 0, esr >> 4 & 7, esr >> 16 & 255, esr >> 24)
    }
}

fn frame(text: &str) -> Frame {
    text.parse().unwrap()
}

#[test]
fn two_controllers_talk_and_the_receiver_acknowledges() {
    let mut bench = Bench::new(&[0, 1]);
    bench.start(0, 0, MEGABIT);
    bench.start(CAN2, 0, MEGABIT);
    bench.write(CAN2 + IER, 1 << 1);
    bench.write(IER, 1);
    bench.transmit(0, 0, "12345678#1122334455667788");
    bench.run(200 * BIT);
    let sent = *bench.good_frames()[0];
    assert_eq!((sent.sender, sent.taken_by), (Member::Controller(0), 0b10));
    assert_eq!(sent.valid + BIT, sent.end);
    assert_eq!(bench.read(TSR) & 0xF, 0b0011, "RQCP0, TXOK0");
    assert_eq!(bench.can.irqs(0), [true, false, false, false]);
    assert_eq!(bench.can.irqs(1), [false, true, false, false]);
    assert_eq!(bench.read(CAN2 + RF0R) & 3, 1);
    assert_eq!(bench.read(CAN2 + RI0R), 0x1234_5678 << 3 | 4);
    assert_eq!(bench.read(CAN2 + RI0R + 4) & 15, 8);
    assert_eq!(bench.read(CAN2 + RI0R + 8), 0x4433_2211);
    bench.write(CAN2 + RF0R, 1 << 5);
    bench.write(TSR, 1);
    assert_eq!((bench.can.irqs(0)[0], bench.can.irqs(1)[1]), (false, false));
}

#[test]
fn the_lower_identifier_wins_and_the_other_follows() {
    let mut bench = Bench::new(&[0, 1]);
    bench.start(0, 0, MEGABIT);
    bench.start(CAN2, 0, MEGABIT);
    // While a first frame is on the bus, both get ready for the next slot.
    bench.transmit(0, 2, "700#");
    bench.run(10 * BIT);
    bench.transmit(0, 0, "123#");
    bench.transmit(CAN2, 0, "122#");
    bench.run(300 * BIT);
    let order: Vec<String> = bench.good_frames().iter().map(|frame| frame.frame.to_string()).collect();
    assert_eq!(order, ["700#", "122#", "123#"]);
    let starts: Vec<u64> = bench.good_frames().iter().map(|frame| frame.start).collect();
    let ends: Vec<u64> = bench.good_frames().iter().map(|frame| frame.end).collect();
    assert_eq!((starts[1] - ends[0], starts[2] - ends[1]), (3 * BIT, 3 * BIT), "the intermission");
}

#[test]
fn once_only_reports_what_stopped_it() {
    let mut bench = Bench::new(&[0]);
    bench.start(0, NART, MEGABIT);
    let peer = bench.add_peer();
    let at = bench.now;
    // While the peer's first frame is on the bus, both get ready for the next slot.
    bench.wire.node(peer).send_at(at, frame("002#"));
    bench.wire.node(peer).send_at(at, frame("001#"));
    bench.run(10 * BIT);
    bench.transmit(0, 0, "100#");
    bench.run(200 * BIT);
    assert_eq!(bench.read(TSR) & 0xF, 0b0101, "RQCP0, ALST0");
    bench.wire.disturb(0, Disturbance::Bit { index: 30 });
    bench.transmit(0, 0, "100#");
    bench.run(200 * BIT);
    assert_eq!(bench.read(TSR) & 0xF, 0b1001, "RQCP0, TERR0");
}

#[test]
fn a_lone_sender_turns_passive_and_never_bus_off() {
    let mut bench = Bench::new(&[0]);
    bench.start(0, 0, MEGABIT);
    bench.write(IER, 1 << 15 | 1 << 8 | 1 << 9);
    bench.transmit(0, 0, "123#");
    bench.run(10 * MS);
    let (warning, passive, off, code, tec, _) = bench.esr(0);
    assert_eq!((warning, passive, off, code, tec), (true, true, false, 3, 128));
    assert!(bench.can.irqs(0)[3], "warning and passive were reported");
    bench.write(MSR, 1 << 2);
    assert!(!bench.can.irqs(0)[3]);
    // Once a node acknowledges, it gets through and recovers.
    bench.add_peer();
    bench.run(MS);
    assert_eq!(bench.good_frames().len(), 1);
    assert_eq!(bench.esr(0).4, 127);
}

#[test]
fn bus_off_ends_by_itself_with_abom_and_on_request_without() {
    for abom in [false, true] {
        let mut bench = Bench::new(&[0]);
        bench.start(0, if abom { ABOM } else { 0 }, MEGABIT);
        bench.add_peer();
        bench.write(IER, 1 << 15 | 1 << 10);
        for attempt in 0..32 {
            bench.wire.disturb(attempt, Disturbance::Bit { index: 30 });
        }
        bench.transmit(0, 0, "123#");
        while !bench.esr(0).2 {
            bench.run(10 * BIT);
        }
        assert!(bench.can.irqs(0)[3]);
        assert!(
            matches!(bench.can.controllers[0].mode(), Mode::BusOff { left, .. } if left.is_some() == abom)
        );
        let mut from = bench.now;
        bench.run(2 * MS);
        assert_eq!(bench.wire.history().iter().filter(|frame| frame.error.is_some()).count(), 32);
        if !abom {
            assert!(bench.esr(0).2, "bus-off until software starts the recovery");
            bench.write(MCR, INRQ);
            from = bench.now;
            bench.write(MCR, 0);
            bench.run(2 * MS);
        }
        assert!(!bench.esr(0).2);
        let resumed = bench.good_frames()[0].start;
        let waited = (resumed - from) / BIT;
        assert!(resumed > from, "{abom}: {resumed} after {from}");
        assert!(waited <= 128 * 11 + 20, "{abom}: {waited} bits");
        assert_eq!(bench.esr(0).4, 0);
    }
}

#[test]
fn every_disturbance_reaches_the_last_error_code() {
    let bits = FrameBits::new(&frame("555#00"));
    let dominant = (bits.arbitration_end()..bits.len()).find(|bit| !bits.levels()[*bit]).unwrap();
    for (disturbance, sender, receiver) in [
        (Disturbance::Stuff, 4, 1),
        (Disturbance::Form, 3, 2),
        (Disturbance::Crc, 3, 6),
        (Disturbance::Ack, 3, 2),
        (Disturbance::Bit { index: dominant }, 5, 1),
    ] {
        let mut bench = Bench::new(&[0, 1]);
        bench.start(0, NART, MEGABIT);
        bench.start(CAN2, 0, MEGABIT);
        bench.write(CAN2 + IER, 1 << 15 | 1 << 11);
        bench.wire.disturb(0, disturbance);
        bench.transmit(0, 0, "555#00");
        bench.run(200 * BIT);
        assert_eq!(bench.esr(0).3, sender, "{disturbance:?} for the sender");
        assert_eq!(bench.esr(CAN2).3, receiver, "{disturbance:?} for the receiver");
        assert!(bench.can.irqs(1)[3], "{disturbance:?} is reported");
        assert_eq!(bench.read(CAN2 + RF0R) & 3, 0, "{disturbance:?}: nothing is received");
    }
}

/// Frames, errors, a stuck bus, a wrong bit rate: not a single dominant bit.
#[test]
fn a_silent_controller_never_drives_the_bus() {
    for btr in [MEGABIT, HALF_MEGABIT] {
        let mut bench = Bench::new(&[0]);
        bench.start(0, 0, btr | SILENT);
        let from = bench.now;
        let traffic = Traffic::new(Kind::Mix, 5, 100.0, from, from + 50 * MS);
        bench.wire.add(Node::new(BitTime::of_rate(1_000_000, CLOCK)).with_source(traffic));
        bench.run(5 * MS);
        bench.add_peer();
        for (frames, disturbance) in
            [Disturbance::Stuff, Disturbance::Crc, Disturbance::Form, Disturbance::Ack]
                .into_iter()
                .enumerate()
        {
            bench.wire.disturb(frames as u64 * 7, disturbance);
        }
        bench.transmit(0, 0, "123#55");
        bench.run(20 * MS);
        bench.wire.hold_dominant(true, &mut bench.can);
        bench.run(5 * MS);
        bench.wire.hold_dominant(false, &mut bench.can);
        bench.run(20 * MS);
        assert!(bench.good_frames().len() > 100);
        assert!(bench.wire.history().iter().any(|frame| frame.error.is_some()));
        assert_eq!(bench.can.controllers[0].dominant_bits(), 0);
    }
}

#[test]
fn a_listener_at_the_wrong_rate_sees_errors_and_disturbs_nobody() {
    let mut bench = Bench::new(&[0]);
    let from = bench.now;
    bench.add_peer();
    bench.start(0, 0, HALF_MEGABIT | SILENT);
    let traffic = Traffic::new(Kind::Mix, 5, 50.0, from, from + 40 * MS);
    bench.wire.add(Node::new(BitTime::of_rate(1_000_000, CLOCK)).with_source(traffic));
    bench.run(40 * MS);
    assert!(bench.wire.history().len() > 100);
    assert!(bench.wire.history().iter().all(|frame| frame.error.is_none() && frame.taken_by == 0));
    let (_, _, _, code, _, rec) = bench.esr(0);
    assert!(code != 0 && rec > 0, "last error {code}, counter {rec}");
    // A controller that is not silent destroys everybody's frames until it is error-passive.
    let mut bench = Bench::new(&[0]);
    bench.add_peer();
    bench.start(0, 0, HALF_MEGABIT);
    let traffic = Traffic::new(Kind::Mix, 5, 50.0, bench.now, bench.now + 40 * MS);
    bench.wire.add(Node::new(BitTime::of_rate(1_000_000, CLOCK)).with_source(traffic));
    bench.run(40 * MS);
    let ruined = bench.wire.history().iter().filter(|frame| frame.error.is_some()).count();
    assert!((10..=200).contains(&ruined), "{ruined}");
}

#[test]
fn loopback_hears_itself_alone() {
    let mut bench = Bench::new(&[0, 1]);
    bench.start(CAN2, 0, MEGABIT);
    bench.write(MCR, INRQ);
    bench.write(BTR, MEGABIT | LOOPBACK | SILENT);
    bench.write(MCR, 0);
    bench.transmit(0, 0, "123#AB");
    bench.transmit(0, 1, "100#");
    bench.run(300 * BIT);
    assert_eq!(bench.read(TSR) & 0x0F0F, 0x0303, "both were sent without anybody's acknowledgement");
    assert_eq!(bench.read(RF0R) & 3, 2);
    assert_eq!(bench.wire.history().len(), 0);
    assert_eq!(bench.can.controllers[0].dominant_bits(), 0, "silent as well");
}

#[test]
fn synchronisation_waits_for_a_full_bus_to_pause() {
    let mut bench = Bench::new(&[0]);
    let traffic = Traffic::new(Kind::Std0, 1, 100.0, 0, MS);
    bench.wire.add(Node::new(BitTime::of_rate(1_000_000, CLOCK)).with_source(traffic));
    bench.add_peer();
    bench.run(10 * BIT);
    bench.write(MCR, INRQ);
    bench.write(BTR, MEGABIT | SILENT);
    bench.write(MCR, 0);
    bench.run(100 * BIT);
    // The acknowledge delimiter, end of frame and intermission are eleven recessive bits.
    assert_eq!(bench.read(MSR) & 1, 0);
    bench.run(MS);
    let taken: Vec<bool> = bench.wire.history().iter().map(|frame| frame.taken_by == 1).collect();
    assert_eq!(taken[..3], [false, true, true], "from the second frame on");
}

#[test]
fn a_frame_wakes_a_sleeping_controller() {
    const SLEEP: u32 = 1 << 1;
    const AWUM: u32 = 1 << 5;
    for automatic in [false, true] {
        let mut bench = Bench::new(&[0]);
        let mcr = if automatic { AWUM } else { 0 };
        bench.start(0, mcr, MEGABIT | SILENT);
        bench.write(IER, 1 << 16 | 1 << 17);
        bench.write(MCR, mcr | SLEEP);
        assert_eq!(bench.read(MSR) & 0b1_0010, 0b1_0010, "SLAK, SLAKI");
        bench.write(MSR, 1 << 4);
        assert!(!bench.can.irqs(0)[3]);
        let sender = bench.add_peer();
        bench.add_peer();
        for at in [bench.now, bench.now + MS] {
            bench.wire.node(sender).send_at(at, frame("123#"));
        }
        bench.run(2 * MS);
        assert_eq!(bench.read(MSR) >> 3 & 1, 1, "WKUI");
        assert!(bench.can.irqs(0)[3]);
        // It misses the frame that wakes it, but not the next.
        let taken: Vec<u8> = bench.wire.history().iter().map(|frame| frame.taken_by).collect();
        assert_eq!(taken, if automatic { [0, 1] } else { [0, 0] });
        assert_eq!(bench.read(MSR) >> 1 & 1, u32::from(!automatic), "SLAK");
    }
}

#[test]
fn a_stuck_bus_keeps_a_controller_from_synchronising() {
    let mut bench = Bench::new(&[0]);
    bench.wire.hold_dominant(true, &mut bench.can);
    bench.write(MCR, INRQ);
    bench.write(BTR, MEGABIT);
    bench.write(MCR, 0);
    bench.run(10 * MS);
    assert_eq!(bench.read(MSR) & 1, 1);
    bench.wire.hold_dominant(false, &mut bench.can);
    bench.run(12 * BIT);
    assert_eq!(bench.read(MSR) & 1, 0);
}

/// The earlier analyser's two burst tests, on the bus itself: the frames start where they must.
#[test]
fn bursts_are_as_long_as_the_earlier_analyser_measured() {
    let mut bench = Bench::new(&[]);
    bench.add_peer();
    let period = 960_375 * CLOCK.us(1) / 1000;
    let from = bench.now;
    let burst = |n: u64| (0..10).map(move |_| (from + n * period, frame("000#55")));
    let script = Script::new((0..3).flat_map(burst).collect());
    bench.wire.add(Node::new(BitTime::of_rate(1_000_000, CLOCK)).with_source(script));
    bench.run(4 * MS);
    let frames = bench.good_frames();
    assert_eq!(frames.len(), 30);
    assert_eq!(frames[1].start - frames[0].start, 58 * CLOCK.us(1), "58 us each");
    assert_eq!(frames[10].start - frames[0].start, period);
}

#[test]
fn a_rate_that_is_no_whole_number_of_cycles_does_not_drift() {
    let mut bench = Bench::new(&[]);
    let node = Node::new(BitTime::of_rate(33_333, CLOCK)).without_acknowledging();
    let sender = bench.wire.add(node);
    bench.wire.add(Node::new(BitTime::of_rate(33_333, CLOCK)));
    let from = bench.now;
    for n in 0..10 {
        bench.wire.node(sender).send_at(from + n, frame("555#"));
    }
    bench.run(CLOCK.hz() / 10);
    let frames = bench.good_frames();
    let span = frames[9].start - frames[0].start;
    let exact = 9.0 * 48.0 * CLOCK.hz() as f64 / 33_333.0;
    assert!((span as f64 - exact).abs() < 10.0, "{span} instead of {exact}");
}
