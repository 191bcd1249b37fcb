//! The first instructions: they put the chip into the state after a reset, no matter what ran before.
//!
//! The ROM bootloader leaves its own vectors, clocks and peripherals as they are when it starts a program ("the Jump to
//! application works only if the user application sets the vector table correctly", AN3156); a debugger or another program may do
//! so too.

use core::arch::global_asm;

use cortex_m::peripheral::{NVIC, SCB};
use stm32f4xx_hal::pac;

// Before anything else, memory included: no interrupt may run with our vectors on another program's memory, or with its
// vectors on ours. So cortex-m-rt's `set-vtor`, which does not mask, is not enough. The order: mask (PRIMASK, and BASEPRI
// open), VTOR, then SysTick, SysTick's and PendSV's pending bits, and every interrupt's enable and pending bits (82 of them in
// three words). cortex-m-rt calls this with the stack set and before memory is initialised, which it does for SRAM only: the
// part of the core-coupled memory that must begin as zero is cleared here.
global_asm!(
    ".section .text.__pre_init, \"ax\"",
    ".global __pre_init",
    ".type __pre_init,%function",
    ".thumb_func",
    "__pre_init:",
    "cpsid i",
    "movs r0, #0",
    "msr basepri, r0",
    // SCB_VTOR.
    "ldr r1, =0xE000ED08",
    "ldr r2, =__vector_table",
    "str r2, [r1]",
    // SYST_CSR.
    "ldr r1, =0xE000E010",
    "str r0, [r1]",
    // SCB_ICSR: PENDSVCLR and PENDSTCLR.
    "ldr r1, =0xE000ED04",
    "ldr r2, =0x0A000000",
    "str r2, [r1]",
    // NVIC_ICER and NVIC_ICPR.
    "mvns r2, r0",
    "ldr r1, =0xE000E180",
    "str r2, [r1]",
    "str r2, [r1, #4]",
    "str r2, [r1, #8]",
    "ldr r1, =0xE000E280",
    "str r2, [r1]",
    "str r2, [r1, #4]",
    "str r2, [r1, #8]",
    // The memory that `init` hands out (memory.x).
    "ldr r1, =__sshared_out",
    "ldr r2, =__eshared_out",
    "1:",
    "cmp r1, r2",
    "bhs 2f",
    "str r0, [r1], #4",
    "b 1b",
    "2:",
    "dsb",
    "isb",
    "bx lr",
    ".ltorg",
    ".size __pre_init, . - __pre_init",
);

/// RCC_AHB1ENR after a reset: the core-coupled memory, where the stack is (RM0090, RCC_AHB1ENR).
const CCM_ENABLED: u32 = 1 << 20;
/// Every peripheral that has a reset bit on the F405/407 (RM0090, RCC_AHB1RSTR and following).
const AHB1: u32 = 0x2260_11FF;
const AHB2: u32 = 0x0000_00F1;
const AHB3: u32 = 0x0000_0001;
const APB1: u32 = 0x36FE_C9FF;
const APB2: u32 = 0x0007_5933;

/// What was found at the start.
pub struct Found {
    /// A host may have seen a USB device here, run by this firmware or another program.
    pub usb_was_connected: bool,
}

/// Puts clocks, peripherals, memory map and flash interface into their state after a reset. From here on the processor
/// runs from HSI, and USB is disconnected.
pub fn restore(rcc: &pac::RCC, syscfg: &pac::SYSCFG, flash: &pac::FLASH) -> Found {
    let usb_was_connected =
        rcc.ahb2enr().read().otgfsen().is_enabled() || rcc.csr().read().porrstf().is_no_reset();
    super::clocks::back_to_hsi(rcc, flash);
    reset_peripherals(rcc);
    map_flash_at_zero(rcc, syscfg);
    super::flash::lock(flash);
    // Clear the interrupts that peripherals raised before they were reset.
    // SAFETY: no interrupt is wanted yet, and all are masked.
    unsafe { (*NVIC::PTR).icpr.iter().for_each(|clear| clear.write(u32::MAX)) };
    Found { usb_was_connected }
}

/// Resets every peripheral and switches their clocks off.
fn reset_peripherals(rcc: &pac::RCC) {
    // The ports first: no CAN controller may be reset while a pin connects it to a bus.
    // SAFETY: these are bits that the registers have; what they reset is not in use yet.
    unsafe {
        rcc.ahb1rstr().write(|w| w.bits(AHB1));
        rcc.ahb2rstr().write(|w| w.bits(AHB2));
        rcc.ahb3rstr().write(|w| w.bits(AHB3));
        rcc.apb1rstr().write(|w| w.bits(APB1));
        rcc.apb2rstr().write(|w| w.bits(APB2));
        rcc.ahb1rstr().write(|w| w.bits(0));
        rcc.ahb2rstr().write(|w| w.bits(0));
        rcc.ahb3rstr().write(|w| w.bits(0));
        rcc.apb1rstr().write(|w| w.bits(0));
        rcc.apb2rstr().write(|w| w.bits(0));
        // The stack's memory stays on; everything else is switched on where it is used.
        rcc.ahb1enr().write(|w| w.bits(CCM_ENABLED));
        rcc.ahb2enr().write(|w| w.bits(0));
        rcc.ahb3enr().write(|w| w.bits(0));
        rcc.apb1enr().write(|w| w.bits(0));
        rcc.apb2enr().write(|w| w.bits(0));
    }
}

/// Maps flash at address 0. A reset of SYSCFG leaves the mapping to the boot pins, and the jumper that selects the
/// bootloader may still be in.
fn map_flash_at_zero(rcc: &pac::RCC, syscfg: &pac::SYSCFG) {
    enable_syscfg(rcc);
    // SAFETY: 0 is the field's value for flash.
    syscfg.memrmp().modify(|_, w| unsafe { w.mem_mode().bits(0) });
    // From the next instruction on, address 0 is a different memory.
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}

/// Switches SYSCFG's clock on, and waits until the peripheral responds (ES0182, "Delay after an RCC peripheral clock
/// enabling").
pub fn enable_syscfg(rcc: &pac::RCC) {
    rcc.apb2enr().modify(|_, w| w.syscfgen().enabled());
    cortex_m::asm::dsb();
    rcc.apb2enr().read();
}

/// Gives the vector table back to whatever is at address 0, as after a reset.
pub fn forget_vectors() {
    // SAFETY: the caller is about to leave this program, and all interrupts are disabled.
    unsafe { (*SCB::PTR).vtor.write(0) };
}
