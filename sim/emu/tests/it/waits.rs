//! What the core waits for, shown by small programs whose cycles can be counted by hand. Each measures itself
//! with the core's own cycle counter.

use crate::assembly;

use std::sync::{Arc, Mutex};

use assembly::{Alarm, NE, Program, adds, bx_lr, ldr, movs, nop, str, wfi};
use cantap_emu::memory_map::{CCM, FLASH, SRAM};
use cantap_emu::soc::Oddity;
use cantap_emu::soc::rcc::CRYSTAL_START_US;
use cantap_emu::timing::Bound;
use cantap_emu::{Clock, Machine, Setup};

const CLOCK: Clock = Clock::new(144_000_000);

const DEMCR: u32 = 0xE000_EDFC;
const DWT: u32 = 0xE000_1000;
const FLASH_ACR: u32 = 0x4002_3C00;
const RCC: u32 = 0x4002_3800;
/// Four wait states, prefetch, both caches.
const FOUR_WAIT_STATES: u32 = 4 | 7 << 8;
/// APB1 at a quarter of the core's clock, APB2 at half of it.
const QUARTER_AND_HALF: u32 = 5 << 10 | 4 << 13;
/// The independent watchdog's prescaler: on APB1, without a clock to switch on, and locked.
const ON_APB1: u32 = 0x4000_3004;
/// Bit 0 of that word.
const ON_APB1_BIT: u32 = 0x4200_0000 + 0x3004 * 32;
/// The tests' own device on APB1, and its interrupt.
const ALARM: u32 = 0x4000_7800;
const IRQ: u16 = 5;
/// Somewhere in flash, at the start of a line.
const DATA: u32 = FLASH.start + 0x4000;
const RESULT: u32 = CCM.start;
/// NVIC_ISER0 and, 0x100 bytes on, NVIC_ISPR0.
const NVIC: u32 = 0xE000_E100;
const DSB: [u16; 2] = [0xF3BF, 0x8F4F];
/// `MOVW r3, #0`, 32 bits long.
const MOVW: [u16; 2] = [0xF240, 0x0300];

/// A program under construction, with R7 at the cycle counter and R1, R2, R4 and R5 at APB1, SRAM, CCM and data in flash.
fn start() -> Program {
    start_with(Program::new())
}

/// The same, after code that a program already has.
fn start_with(mut program: Program) -> Program {
    program.handler(1);
    for (address, value) in
        [(FLASH_ACR, FOUR_WAIT_STATES), (RCC + 8, QUARTER_AND_HALF), (DEMCR, 1 << 24), (DWT, 1)]
    {
        program.load(0, address);
        program.load(1, value);
        program.put(&[str(1, 0, 0)]);
    }
    for (register, address) in [(7, DWT), (1, ON_APB1), (2, SRAM.start), (4, CCM.start), (5, DATA)] {
        program.load(register, address);
    }
    program
}

/// Reads the counter in the last word of a line, so that what follows begins a line that has been read ahead. Before
/// that it reads APB1, so that what follows begins at an edge of its clock: two cycles of that read come after the
/// edge, and the counter takes two.
fn begin(program: &mut Program) {
    while program.here() % 16 != 12 {
        program.put(&[nop()]);
    }
    program.put(&[nop(); 8][..]);
    program.put(&[ldr(3, 1, 0), ldr(6, 7, 1)]);
    assert_eq!(program.here() % 16, 0);
}

/// Reads the counter again, writes the difference and ends the program.
fn end(mut program: Program, bound: Bound) -> u32 {
    // SUBS r5, r5, r6
    program.put(&[ldr(5, 7, 1), 0x1BAD]);
    program.load(0, RESULT);
    program.put(&[str(5, 0, 0)]);
    let sleep = program.here();
    program.put(&[wfi()]);
    program.branch_to(sleep);
    let mut machine = Machine::new(program.image(), Setup { bound, ..Setup::new(CLOCK, 8_000_000) });
    machine.run_until(10_000).unwrap();
    // The first read of the counter is part of the measured time; reading one of the core's own registers takes two
    // cycles.
    machine.cpu().word(RESULT).unwrap() - 2
}

/// Cycles of a piece of code, at best and at worst.
fn cycles(body: impl Fn(&mut Program)) -> [u32; 2] {
    Bound::ALL.map(|bound| {
        let mut program = start();
        begin(&mut program);
        body(&mut program);
        end(program, bound)
    })
}

/// Cycles of these instructions in a row.
fn row(instructions: &[u16]) -> [u32; 2] {
    cycles(|program| program.put(instructions))
}

/// A line of four long instructions takes four cycles to execute and five to read, and all lines but the first
/// are waited for.
#[test]
fn straight_code_waits_a_cycle_for_each_line() {
    assert_eq!(row(&MOVW.repeat(16)), [16, 16 + 3]);
    assert_eq!(row(&[nop(); 32]), [32, 32], "eight short instructions leave the time");
}

/// A loop within a line is fetched once; at worst, refilling the pipeline takes one more cycle.
#[test]
fn a_loop_waits_for_its_branches_only() {
    let rounds = |count| {
        cycles(|program| {
            program.put(&[movs(0, count)]);
            let again = program.here();
            // SUBS r0, #1
            program.put(&[0x3801]);
            program.branch_if(NE, again);
        })
    };
    let [[best_ten, worst_ten], [best_thirty, worst_thirty]] = [rounds(10), rounds(30)];
    assert_eq!([best_thirty - best_ten, worst_thirty - worst_ten], [20 * 4, 20 * 5]);
}

/// From the edge on, two cycles of the slower clock and the core's own two; the next read misses an edge by two cycles
/// and waits two for another.
#[test]
fn reads_through_a_bridge_take_three_of_its_cycles() {
    assert_eq!(row(&[ldr(0, 1, 0); 1]), [2, 10]);
    assert_eq!(row(&[ldr(0, 1, 0); 7]), [14, 10 + 6 * 12]);
}

/// For the core, a write is over at once. The next must wait for it: two cycles of the slower clock, one of the core's
/// for the bridge's register, and the rest until the next edge.
#[test]
fn writes_through_a_bridge_wait_for_the_one_before() {
    assert_eq!(row(&[str(0, 1, 0); 2]), [4, 9 + 2]);
    assert_eq!(row(&[str(0, 1, 0); 7]), [14, 9 + 5 * 12 + 2]);
    assert_eq!(
        row(&[str(0, 1, 0), nop(), nop(), nop(), nop(), nop()]),
        [7, 7],
        "with other work it costs nothing"
    );
}

/// A write that begins at an edge of APB1's clock is made nine cycles later, of which two are the store's own.
#[test]
fn what_is_on_the_same_bus_waits_for_a_write() {
    let after_write = |next: &[u16]| row(&[&[str(0, 1, 0)], next].concat());
    assert_eq!(after_write(&[ldr(0, 2, 0)]), [4, 4 + 7], "SRAM");
    assert_eq!(after_write(&[ldr(0, 4, 0)]), [4, 4], "CCM is on the D-bus");
    assert_eq!(after_write(&DSB), [3, 3 + 7], "a barrier");
}

/// Writing a bit is a read and a write, and the next access must wait for both.
#[test]
fn a_bits_write_takes_two_accesses() {
    let bits = |n: usize| {
        cycles(|program| {
            program.load(2, ON_APB1_BIT);
            program.put(&[str(0, 2, 0)].repeat(n));
        })
    };
    let [[best_two, worst_two], [best_four, worst_four]] = [bits(2), bits(4)];
    assert_eq!([best_four - best_two, worst_four - worst_two], [2 * 3, 2 * 20]);
}

/// The first read of a line waits for flash, which may still be reading instructions ahead; every read, for the fetch
/// unit.
#[test]
fn data_in_flash_comes_from_the_data_cache() {
    // Five cycles in which the following line is read.
    let after = |loads: &[u16]| row(&[&[nop(); 5][..], loads].concat()).map(|cycles| cycles - 5);
    assert_eq!(after(&[ldr(0, 5, 0), ldr(0, 5, 1), ldr(0, 5, 3)]), [6, 6 + 4 + 3], "a line");
    assert_eq!(after(&[ldr(0, 5, 0), ldr(0, 5, 4), ldr(0, 5, 8)]), [6, 6 + 3 * 4 + 3], "three lines");
    assert_eq!(row(&[ldr(0, 5, 0)]), [2, 2 + 1 + 4 + 4], "a cycle of the five has gone by");
}

/// Vector and handler are waited for, and so is the interrupted line, which had been read ahead and is in no cache. The
/// second time, the handler's line is cached, and so is the one returned to. Either time the vector waits for what is
/// still being read ahead: three of its five cycles, then one. A return refills the pipeline.
#[test]
fn an_interrupt_waits_for_its_vector_its_handler_and_its_return() {
    let interrupts = |count: u16| {
        Bound::ALL.map(|bound| {
            let mut program = Program::new();
            program.handler(16);
            program.put(&[bx_lr()]);
            let endless = program.here();
            program.branch_to(endless);
            // So that the line read ahead after the handler is not the one returned to.
            program.put(&[nop(); 24]);
            let mut program = start_with(program);
            program.load(3, NVIC);
            program.load(2, NVIC + 0x100);
            program.put(&[movs(0, 1), str(0, 3, 0)]);
            begin(&mut program);
            for _ in 0..count {
                program.put(&[str(0, 2, 0), nop(), nop()]);
            }
            end(program, bound)
        })
    };
    let [[best_none, worst_none], [best_one, worst_one], [best_two, worst_two]] =
        [interrupts(0), interrupts(1), interrupts(2)];
    let own = 2 + 2 + 12 + 11;
    assert_eq!([best_one - best_none, best_two - best_one], [own, own]);
    assert_eq!([worst_one - worst_none, worst_two - worst_one], [own + 3 + 4 + 4 + 1 + 4, own + 1 + 4 + 1]);
}

/// A handler's last write has not arrived yet when it returns: the interrupt is still asserted and comes again, unless
/// the handler waits for its write.
#[test]
fn an_interrupt_that_is_cleared_last_comes_again() {
    let handled = |barrier: &[u16]| {
        Bound::ALL.map(|bound| {
            let mut program = Program::new();
            program.handler(16 + usize::from(IRQ));
            program.put(&[ldr(0, 4, 0), adds(0, 1), str(0, 4, 0), str(0, 1, 0)]);
            program.put(barrier);
            program.put(&[bx_lr()]);
            let endless = program.here();
            program.branch_to(endless);
            let mut program = start_with(program);
            program.load(1, ALARM);
            program.load(3, NVIC);
            program.load(2, 1 << IRQ);
            program.put(&[str(2, 3, 0)]);
            let sleep = program.here();
            program.put(&[wfi()]);
            program.branch_to(sleep);
            let mut machine = Machine::new(program.image(), Setup { bound, ..Setup::new(CLOCK, 8_000_000) });
            let alarm = Arc::new(Mutex::new(Alarm::new(Some(1000))));
            machine.attach(ALARM..ALARM + 0x400, IRQ, alarm);
            machine.run_until(2000).unwrap();
            machine.cpu().word(RESULT).unwrap()
        })
    };
    assert_eq!(handled(&[]), [1, 2]);
    assert_eq!(handled(&DSB), [1, 1]);
}

/// Below the wait states of RM0090's table the hardware reads garbage; the emulator reports it.
#[test]
fn too_few_wait_states_are_reported() {
    let odd = |wait_states: u32, bound: Bound| {
        let mut program = Program::new();
        program.handler(1);
        // HSE 8 MHz / 4 × 144 / 2, both oscillators on, the PLL as system clock.
        for (address, value) in [
            (FLASH_ACR, wait_states),
            (RCC + 4, 4 | 144 << 6 | 1 << 22 | 6 << 24),
            (RCC, 1 | 1 << 16 | 1 << 24),
            (RCC + 8, 2 | QUARTER_AND_HALF),
        ] {
            program.load(0, address);
            program.load(1, value);
            program.put(&[str(1, 0, 0)]);
        }
        // The switch takes place once the PLL is ready, which reading the register shows.
        program.load(0, RCC + 8);
        let endless = program.here();
        program.put(&[ldr(1, 0, 0)]);
        program.branch_to(endless);
        let mut machine = Machine::new(program.image(), Setup { bound, ..Setup::new(CLOCK, 8_000_000) });
        machine.run_until(2 * CLOCK.us(CRYSTAL_START_US)).unwrap();
        machine.board().odd_accesses()
    };
    for bound in Bound::ALL {
        assert_eq!(odd(4, bound), []);
        for wait_states in [0, 3] {
            let [odd] = odd(wait_states, bound)[..] else { panic!("one access") };
            assert_eq!((odd.oddity, odd.address, odd.count), (Oddity::TooFast, RCC + 8, 1));
        }
    }
}
