//! Interrupts in IT blocks: the core underneath loses the block's state on exception entry, and the emulator
//! works around that. The proof: an interrupt at any instant of a loop full of IT blocks does not change the
//! loop's result.

use crate::assembly;

use std::sync::{Arc, Mutex};

use assembly::{Alarm, EQ, NE, Program, adds, ands, bx_lr, cmp, eors, it, ldr, lsls, movs, str, wfi};
use cantap_emu::memory_map::SRAM;
use cantap_emu::{Clock, Image, Machine, Setup};

const CLOCK: Clock = Clock::new(144_000_000);

const DEVICE: u32 = 0x5005_0000;
const IRQ: u16 = 40;
/// Where the program leaves its result, its handler's count and a mark when it is done.
const RESULT: u32 = SRAM.start;
const HANDLED: u32 = SRAM.start + 4;
const DONE: u32 = SRAM.start + 8;
const ROUNDS: u32 = 24;

/// A loop of IT blocks of every length and shape, and a handler that itself returns conditionally.
fn program() -> Image {
    let mut program = Program::new();
    program.handler(16 + usize::from(IRQ));
    program.load(0, DEVICE);
    program.put(&[str(0, 0, 0)]);
    program.load(0, RESULT);
    // Set the flags to the opposite of what the interrupted code relies on, then return conditionally.
    program.put(&[ldr(1, 0, 1), adds(1, 1), str(1, 0, 1), cmp(1, 1), it(EQ, 0b1000), bx_lr()]);
    let endless = program.here();
    program.branch_to(endless);

    program.handler(1);
    // Enable the interrupt: NVIC_ISER1.
    program.load(0, 0xE000_E104);
    program.load(1, 1 << (IRQ - 32));
    program.put(&[str(1, 0, 0)]);
    program.put(&[movs(0, 0), movs(1, 1), movs(4, ROUNDS as u16)]);
    let start = program.here();
    program.put(&[
        movs(2, 1),
        ands(2, 0),
        // ITTEE EQ
        it(EQ, 0b0111),
        adds(1, 3),
        lsls(1, 1, 1),
        eors(1, 0),
        adds(1, 5),
        movs(3, 3),
        ands(3, 0),
        // ITETE NE
        it(NE, 0b0101),
        adds(1, 7),
        lsls(1, 1, 2),
        eors(1, 4),
        adds(1, 11),
        cmp(2, 3),
        // ITE EQ
        it(EQ, 0b1100),
        adds(1, 13),
        eors(1, 3),
        // IT NE
        it(NE, 0b1000),
        adds(1, 17),
        adds(0, 1),
        cmp(0, 4),
    ]);
    program.branch_if(NE, start);
    program.load(5, RESULT);
    program.put(&[str(1, 5, 0), movs(6, 1), str(6, 5, 2)]);
    let sleep = program.here();
    program.put(&[wfi()]);
    program.branch_to(sleep);
    program.image()
}

/// What the loop should compute.
fn expected() -> u32 {
    (0..ROUNDS).fold(1u32, |sum, round| {
        let (odd, low) = (round & 1, round & 3);
        let sum = if odd == 0 { sum.wrapping_add(3) << 1 } else { (sum ^ round).wrapping_add(5) };
        // ITETE NE: then, else, then, else.
        let sum = if low == 0 { (sum << 2).wrapping_add(11) } else { sum.wrapping_add(7) ^ ROUNDS };
        if odd == low { sum.wrapping_add(13) } else { (sum ^ low).wrapping_add(17) }
    })
}

/// Runs the program with the interrupt at cycle `at`; returns the result, the interrupts handled and when it
/// was done.
fn run(at: Option<u64>) -> (u32, u32, u64) {
    let mut machine = Machine::new(program(), Setup::new(CLOCK, 8_000_000));
    let alarm = Arc::new(Mutex::new(Alarm::new(at)));
    machine.attach(DEVICE..DEVICE + 0x400, IRQ, alarm);
    let mut done_at = 0;
    while machine.now() < 5000 {
        machine.run_until(machine.now() + 1).unwrap();
        if done_at == 0 && machine.cpu().word(DONE) == Some(1) {
            done_at = machine.now();
        }
    }
    (machine.cpu().word(RESULT).unwrap(), machine.cpu().word(HANDLED).unwrap(), done_at)
}

#[test]
fn an_interrupt_at_any_instant_leaves_it_blocks_as_they_are() {
    let (result, handled, done_at) = run(None);
    assert_eq!((result, handled), (expected(), 0), "undisturbed");
    assert!(done_at > 500, "the loop is long enough to be worth sweeping: {done_at} cycles");
    for at in 20..done_at {
        let (disturbed, handled, _) = run(Some(at));
        assert_eq!((disturbed, handled), (result, 1), "interrupt at cycle {at}");
    }
}
