//! A bus's level at the pins, and how the external interrupts respond to it (RM0090 Rev 21 §8, §9.2, §12), without firmware.

use std::sync::{Arc, Mutex, MutexGuard};

use cantap_emu::Clock;
use cantap_emu::bus::bits::FrameBits;
use cantap_emu::bus::{BitTime, Node};
use cantap_emu::cpu::{Bus, Memories};
use cantap_emu::soc::Board;
use cantap_emu::soc::access::SharedBoard;
use cantap_emu::soc::rcc::Crystal;
use cantap_emu::traffic::Script;

const CLOCK: Clock = Clock::new(144_000_000);
const BIT: u64 = 288;

const AHB1ENR: u32 = 0x4002_3830;
const APB2ENR: u32 = 0x4002_3844;
const GPIOB_IDR: u32 = 0x4002_0410;
const EXTICR3: u32 = 0x4001_3810;
const EXTICR4: u32 = 0x4001_3814;
const IMR: u32 = 0x4001_3C00;
const RTSR: u32 = 0x4001_3C08;
const FTSR: u32 = 0x4001_3C0C;
const PR: u32 = 0x4001_3C14;
const EXTI15_10: u32 = 40;
const PB12: u32 = 1 << 12;
const START: u64 = 100_000;

struct Bench {
    board: Arc<Mutex<Board>>,
    now: u64,
}

impl Bench {
    /// CAN2's bus, on which a frame starts at [`START`]; the clocks of GPIOB and SYSCFG are on.
    fn new(frame: &str) -> Self {
        let mut board = Board::new(&Memories::new(), CLOCK, Crystal { hz: 8_000_000, start_us: Some(1) });
        let script = Script::new(vec![(START, frame.parse().unwrap())]);
        let bit = BitTime::of_cycles(BIT);
        board.wires[1].add(Node::new(bit).with_source(script));
        board.wires[1].add(Node::new(bit));
        let mut bench = Self { board: Arc::new(Mutex::new(board)), now: 1000 };
        bench.write(AHB1ENR, 1 << 1);
        bench.write(APB2ENR, 1 << 14);
        bench
    }

    fn board(&self) -> MutexGuard<'_, Board> {
        self.board.lock().unwrap()
    }

    fn read(&self, address: u32) -> u32 {
        SharedBoard(Arc::clone(&self.board)).read(address, 4, self.now).unwrap()
    }

    fn write(&mut self, address: u32, value: u32) {
        SharedBoard(Arc::clone(&self.board)).write(address, 4, value, self.now).unwrap();
        self.now += 100;
    }

    fn watch(&mut self, port: u32) {
        self.write(EXTICR4, port);
        self.write(RTSR, PB12);
        self.write(FTSR, PB12);
        self.write(IMR, PB12);
    }

    /// Advances to the next event that the board announces, but not beyond `until`.
    fn step(&mut self, until: u64) -> bool {
        let next = self.board().next_event().filter(|next| *next <= until);
        let Some(next) = next else { return false };
        self.now = self.now.max(next);
        self.board().advance(self.now);
        true
    }

    fn interrupts(&self) -> bool {
        self.board().lines() >> EXTI15_10 & 1 != 0
    }
}

/// The levels of an acknowledged frame, true for recessive.
fn levels(frame: &str) -> Vec<bool> {
    let bits = FrameBits::new(&frame.parse().unwrap());
    let mut levels = bits.levels().to_vec();
    levels[bits.ack_slot()] = false;
    levels
}

#[test]
fn a_pin_reads_the_bus_s_level_at_any_instant() {
    let frame = "123#DEADBEEF";
    let mut bench = Bench::new(frame);
    assert_ne!(bench.read(GPIOB_IDR) & PB12, 0, "recessive before");
    for (n, recessive) in levels(frame).into_iter().enumerate() {
        for into in [2, BIT - 2] {
            bench.now = START + n as u64 * BIT + into;
            assert_eq!(bench.read(GPIOB_IDR) & PB12 != 0, recessive, "bit {n}");
        }
    }
}

#[test]
fn each_edge_of_a_watched_pin_interrupts_at_its_cycle() {
    let frame = "123#DEADBEEF";
    let mut bench = Bench::new(frame);
    bench.watch(1);
    let mut seen = Vec::new();
    while bench.step(START + 200 * BIT) {
        if bench.interrupts() {
            seen.push(bench.now - START);
            bench.write(PR, PB12);
            assert!(!bench.interrupts());
        }
    }
    let levels = [vec![true], levels(frame)].concat();
    let edges = (1..levels.len()).filter(|n| levels[*n] != levels[n - 1]);
    assert_eq!(seen, edges.map(|n| (n as u64 - 1) * BIT).collect::<Vec<_>>());
}

#[test]
fn an_edge_to_recessive_can_be_late() {
    let mut bench = Bench::new("555#");
    bench.board().wires[1].slow_recessive(20);
    bench.watch(1);
    let mut seen = Vec::new();
    while bench.step(START + 10 * BIT) {
        if bench.interrupts() {
            seen.push(bench.now - START);
            bench.write(PR, PB12);
        }
    }
    assert_eq!(seen[..4], [0, BIT + 20, 2 * BIT, 3 * BIT + 20]);
}

#[test]
fn a_line_that_is_led_elsewhere_hears_nothing_and_costs_nothing() {
    // Port A's pin 12, and PB8, which belongs to the other bus.
    for (register, port) in [(EXTICR4, 0), (EXTICR3, 1)] {
        let mut bench = Bench::new("123#DEADBEEF");
        bench.watch(0);
        bench.write(register, port);
        let mut steps = 0;
        while bench.step(START + 200 * BIT) {
            steps += 1;
            assert!(!bench.interrupts());
        }
        assert!(steps < 10, "{steps}: only the frame's own steps");
        assert_eq!(bench.read(PR), 0);
    }
}
