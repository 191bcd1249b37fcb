//! How one run of the firmware ends and what the next one does about it.

use cortex_m::peripheral::{NVIC, SCB};
use stm32f4xx_hal::pac;

use super::message::{self, ENTER_BOOTLOADER, FAILED};
use super::{entry, failure};

/// The ROM bootloader's vector table (AN2606, "STM32F40xxx/41xxx", system memory).
const SYSTEM_MEMORY: *const u32 = 0x1FFF_0000 as *const u32;
/// SYSCFG_MEMRMP: system memory at address 0, where the bootloader looks for its vectors.
const MAP_SYSTEM_MEMORY: u8 = 0b01;

/// Restarts the firmware.
pub fn restart() -> ! {
    SCB::sys_reset()
}

/// Restarts into the chip's ROM bootloader.
pub fn restart_into_bootloader() -> ! {
    message::leave(ENTER_BOOTLOADER);
    SCB::sys_reset()
}

/// The first thing a run does: enters the bootloader if the last run asked for it, with the chip as the reset left it. Returns
/// whether the last run failed: a panic, a fault, a clock, or the watchdog.
pub fn begin(rcc: &pac::RCC, syscfg: &pac::SYSCFG) -> bool {
    let message = message::take();
    if message == ENTER_BOOTLOADER {
        entry::enable_syscfg(rcc);
        // SAFETY: the field has two bits, and this is one of its values.
        syscfg.memrmp().modify(|_, w| unsafe { w.mem_mode().bits(MAP_SYSTEM_MEMORY) });
        cortex_m::asm::dsb();
        // SAFETY: with the tasks' interrupts off again and the vector table at 0, nothing but the clock gate above differs from
        // the state after a reset, which is what the bootloader expects; it needs interrupts enabled, which startup has masked.
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

/// Forgets why the chip was last reset, so that the next start finds only its own.
pub fn forget_reset_cause(rcc: &pac::RCC) {
    rcc.csr().modify(|_, w| w.rmvf().clear());
}
