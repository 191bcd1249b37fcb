//! How one run of the firmware ends and what the next one does about it.
//!
//! A word of RAM that startup does not touch outlives every reset but a loss of power.

use core::mem::MaybeUninit;
use core::ptr::{addr_of, addr_of_mut};

use cortex_m::peripheral::{NVIC, SCB};
use stm32f4xx_hal::pac;

use super::{entry, failure};

/// What the next run shall know. Arbitrary numbers that RAM is unlikely to hold by chance.
const ENTER_BOOTLOADER: u32 = 0xB007_10AD;
const FAILED: u32 = 0x0BAD_C0DE;

/// The ROM bootloader's vector table (AN2606, "STM32F40xxx/41xxx", system memory).
const SYSTEM_MEMORY: *const u32 = 0x1FFF_0000 as *const u32;
/// SYSCFG_MEMRMP: system memory at address 0, where the bootloader looks for its vectors.
const MAP_SYSTEM_MEMORY: u8 = 0b01;

#[unsafe(link_section = ".uninit.cantap_restart")]
static mut MESSAGE: MaybeUninit<u32> = MaybeUninit::uninit();

fn leave(message: u32) {
    // SAFETY: a plain word, written whole and volatile; nobody holds a reference to it.
    unsafe { addr_of_mut!(MESSAGE).cast::<u32>().write_volatile(message) }
}

fn take() -> u32 {
    // SAFETY: as in `leave`. Never initialised, but every value of a word is valid, and a volatile read takes
    // what is there.
    let message = unsafe { addr_of!(MESSAGE).cast::<u32>().read_volatile() };
    leave(0);
    message
}

/// Restarts the firmware.
pub fn restart() -> ! {
    SCB::sys_reset()
}

/// Restarts the firmware, which has failed and said why.
pub fn after_failure() -> ! {
    leave(FAILED);
    SCB::sys_reset()
}

/// Restarts into the chip's ROM bootloader.
pub fn restart_into_bootloader() -> ! {
    leave(ENTER_BOOTLOADER);
    SCB::sys_reset()
}

/// The first thing a run does: enters the bootloader if the last run asked for it, with the chip as the reset left it. Returns
/// whether the last run failed: a panic, a fault, a clock, or the watchdog.
pub fn begin(rcc: &pac::RCC, syscfg: &pac::SYSCFG) -> bool {
    let message = take();
    if message == ENTER_BOOTLOADER {
        entry::enable_syscfg(rcc);
        // SAFETY: the field has two bits, and this is one of its values.
        syscfg.memrmp().modify(|_, w| unsafe { w.mem_mode().bits(MAP_SYSTEM_MEMORY) });
        cortex_m::asm::dsb();
        // SAFETY: with the tasks' interrupts off again and the vector table at 0, nothing but the clock gate above differs from
        // the state after a reset, which is what the bootloader expects; it needs interrupts as such, which startup has masked.
        unsafe {
            (*NVIC::PTR).icer.iter().for_each(|disable| disable.write(u32::MAX));
            entry::forget_vectors();
            cortex_m::interrupt::enable();
            cortex_m::asm::bootload(SYSTEM_MEMORY);
        }
    }
    let bitten = rcc.csr().read().wdgrstf().is_reset();
    let failed = message == FAILED;
    if bitten && !failed {
        failure::record(format_args!("watchdog: the millisecond tick stood still for four seconds"));
    }
    failed || bitten
}

/// Forgets why the chip was last reset, so that the next start finds its own reason.
pub fn forget_reset_cause(rcc: &pac::RCC) {
    rcc.csr().modify(|_, w| w.rmvf().clear());
}
