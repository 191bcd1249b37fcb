//! What a failed run leaves for the next: the log of [`cantap_firmware::failures`], in memory that startup does not touch.

use core::arch::global_asm;
use core::fmt;
use core::mem::MaybeUninit;
use core::panic::PanicInfo;
use core::ptr::{addr_of, addr_of_mut};

use cantap_firmware::failures::FailureLog;
use cantap_wire::message::Failures;
use cortex_m::peripheral::SCB;
use cortex_m_rt::exception;

use super::message;

#[unsafe(link_section = ".uninit.cantap_failures")]
static mut LOG: MaybeUninit<FailureLog> = MaybeUninit::uninit();

fn load() -> FailureLog {
    // SAFETY: never initialised, but every value of its words and bytes is valid, and a volatile read takes what is there.
    // Nothing holds a reference to it.
    unsafe { addr_of!(LOG).cast::<FailureLog>().read_volatile() }
}

/// Notes a failure.
pub fn record(what: fmt::Arguments) {
    let mut log = load();
    log.add(what);
    // SAFETY: as in `load`; the writer runs before anything else, or at priority 2, or never returns to what it interrupted. A failure that
    // interrupts the second of these in the middle finds the log as it was or damaged, in which case it begins anew.
    unsafe { addr_of_mut!(LOG).cast::<FailureLog>().write_volatile(log) }
}

/// How often the firmware failed since power-on, and why it last did.
pub fn failures() -> Failures {
    load().failures()
}

/// Restarts the firmware, which has failed and recorded why.
pub fn restart() -> ! {
    message::leave(message::FAILED);
    SCB::sys_reset()
}

/// Records the failure and restarts: a device that restarts is back within a second; one that halts never comes back.
fn fail(what: fmt::Arguments) -> ! {
    cortex_m::interrupt::disable();
    record(what);
    restart()
}

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    fail(format_args!("{info}"))
}

/// An interrupt or exception that nothing here enables.
// SAFETY: as a panic.
#[exception]
unsafe fn DefaultHandler(irq: i16) -> ! {
    fail(format_args!("interrupt {irq} has no handler"))
}

// Takes PC and LR out of the frame that the fault pushed, unless it was the stack that failed, and continues on an empty stack:
// nothing returns from here, and the old one may have no room.
global_asm!(
    ".section .HardFaultTrampoline, \"ax\"",
    ".global HardFault",
    ".type HardFault,%function",
    ".thumb_func",
    "HardFault:",
    "mrs r2, msp",
    "movs r0, #0",
    "movs r1, #0",
    "ldr r3, =_stack_end",
    "cmp r2, r3",
    "blo 1f",
    "ldr r0, [r2, #24]",
    "ldr r1, [r2, #20]",
    "1:",
    "ldr r3, =_stack_start",
    "msr msp, r3",
    "b cantap_hard_fault",
    ".ltorg",
    ".size HardFault, . - HardFault",
);

#[unsafe(no_mangle)]
extern "C" fn cantap_hard_fault(pc: u32, lr: u32) -> ! {
    // SAFETY: reads registers that have no effect on being read.
    let (cfsr, hfsr, bfar) = unsafe {
        let scb = &*SCB::PTR;
        (scb.cfsr.read(), scb.hfsr.read(), scb.bfar.read())
    };
    fail(format_args!(
        "HardFault at PC {pc:08X}, LR {lr:08X}, CFSR {cfsr:08X}, HFSR {hfsr:08X}, BFAR {bfar:08X}"
    ))
}
