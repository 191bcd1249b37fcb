//! The clock tree: 144 MHz for the processor, a quarter of it for CAN, 48 MHz for USB: from a crystal of 8 or 12 MHz by a PLL at
//! 288 MHz, divided by 2 and by 6.
//!
//! The HAL sets it up, but assumes the state after a reset: it neither switches off a running PLL, whose factors it then
//! cannot change, nor gives up on a crystal that never starts. Both are done here, and what the registers hold at the end
//! is checked.

use cantap_firmware::CAN_CLOCK_HZ;
use cantap_firmware::revision::reads_flash_uncached;
use cortex_m::peripheral::CPUID;
use stm32f4xx_hal::pac;
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::rcc::{Config, Rcc};

use crate::board;

/// The processor's clock.
pub const SYSCLK_HZ: u32 = 144_000_000;
/// USB's clock.
const USB_HZ: u32 = 48_000_000;
/// The processor's clock before that: the internal oscillator, HSI.
pub const HSI_HZ: u32 = 16_000_000;
/// Least number of cycles that a turn of cortex-m's delay loop takes on this core (cortex-m 0.7, `asm::delay`).
const CYCLES_PER_TURN: u32 = 3;
/// A crystal that has not started after this time, in ms, will not: the data sheet gives 2 ms as typical (STM32F405, "HSE
/// 4-26 MHz oscillator characteristics"), and ST's drivers allow 100.
const CRYSTAL_MS: u32 = 100;
/// Most reads of a register while waiting for a switch-over, which takes a few clocks.
const MOST_READS: u32 = 10_000;
/// Flash wait states above 120 and up to 150 MHz at 2.7 to 3.6 V (RM0090, "Number of wait states according to CPU clock
/// frequency").
const WAIT_STATES: u8 = 4;

/// Puts the processor on HSI and switches everything else off: PLL, I2S's PLL, crystal, clock security. Wait states stay until
/// the HAL sets them: too many do no harm. The caches are emptied, because their contents may be older than the flash.
pub fn back_to_hsi(rcc: &pac::RCC, flash: &pac::FLASH) {
    rcc.cr().modify(|_, w| w.hsion().on());
    wait_until(|| rcc.cr().read().hsirdy().is_ready());
    rcc.cfgr().modify(|_, w| w.sw().hsi());
    wait_until(|| rcc.cfgr().read().sws().is_hsi());
    // Prescalers of 1, no clock outputs.
    rcc.cfgr().reset();
    rcc.cr().modify(|_, w| w.csson().off().pllon().off().plli2son().off());
    wait_until(|| rcc.cr().read().pllrdy().is_not_ready() && rcc.cr().read().plli2srdy().is_not_ready());
    // Only now, since the PLL may have run from it.
    rcc.cr().modify(|_, w| w.hseon().off().hsebyp().not_bypassed());
    rcc.pllcfgr().reset();
    // Interrupts of the clock controller off, and their flags cleared.
    // SAFETY: the flags' clear bits and the clock security's.
    rcc.cir().write(|w| unsafe { w.bits(0x00BF_0000) });
    flash.acr().modify(|_, w| w.prften().clear_bit().icen().clear_bit().dcen().clear_bit());
    flash.acr().modify(|_, w| w.icrst().set_bit().dcrst().set_bit());
    flash.acr().modify(|_, w| w.icrst().clear_bit().dcrst().clear_bit());
}

/// Waits this many ms or a little longer, at a processor clock of `hz`.
pub fn wait_ms(ms: u32, hz: u32) {
    cortex_m::asm::delay(ms * (hz / 1_000 / CYCLES_PER_TURN));
}

fn wait_until(done: impl Fn() -> bool) {
    let mut reads = MOST_READS;
    while !done() && reads > 0 {
        reads -= 1;
    }
}

/// Starts the crystal, while running from HSI; returns whether it oscillates.
pub fn start_crystal(rcc: &pac::RCC) -> bool {
    rcc.cr().modify(|_, w| w.hseon().on());
    for _ in 0..CRYSTAL_MS {
        wait_ms(1, HSI_HZ);
        if rcc.cr().read().hserdy().is_ready() {
            return true;
        }
    }
    false
}

/// Switches to the crystal, which must already oscillate.
pub fn run(rcc: Rcc) -> Rcc {
    let config = Config::hse(board::HSE_MHZ.MHz())
        .sysclk(SYSCLK_HZ.Hz())
        .pclk1(CAN_CLOCK_HZ.Hz())
        .pclk2((SYSCLK_HZ / 2).Hz())
        .require_pll48clk();
    let rcc = rcc.freeze(config);
    wait_until(|| rcc.cfgr().read().sws().is_pll());
    spare_the_caches();
    check(&rcc);
    rcc
}

/// The HAL has switched the caches and the prefetch on; some chips must go without.
fn spare_the_caches() {
    // SAFETY: reads registers that have no effect on being read.
    let (idcode, cpuid) =
        unsafe { ((*pac::DBGMCU::ptr()).idcode().read().bits(), (*CPUID::PTR).base.read()) };
    if reads_flash_uncached(idcode, cpuid) {
        // SAFETY: nothing else uses the register while the clocks are set up.
        let acr = unsafe { (*pac::FLASH::ptr()).acr() };
        acr.modify(|_, w| w.prften().clear_bit().icen().clear_bit().dcen().clear_bit());
    }
}

/// Wrong clocks would give wrong bit rates and wrong times: what counts is what the registers hold, not what was
/// intended.
fn check(rcc: &Rcc) {
    let (cfgr, pll) = (rcc.cfgr().read(), rcc.pllcfgr().read());
    // SAFETY: reads a register that has no effect on being read.
    let acr = unsafe { (*pac::FLASH::ptr()).acr().read() };
    let (m, n) = (u32::from(pll.pllm().bits()), u32::from(pll.plln().bits()));
    let vco_hz = board::HSE_MHZ * 1_000_000 / m.max(1) * n;
    let right = cfgr.sws().is_pll()
        && cfgr.hpre().is_div1()
        && cfgr.ppre1().is_div4()
        && cfgr.ppre2().is_div2()
        && pll.pllsrc().is_hse()
        && vco_hz == 2 * SYSCLK_HZ
        && pll.pllp().is_div2()
        && vco_hz == USB_HZ * u32::from(pll.pllq().bits())
        && acr.latency().bits() == WAIT_STATES;
    assert!(
        right && rcc.clocks.pclk1().raw() == CAN_CLOCK_HZ && rcc.clocks.is_pll48clk_valid(),
        "clocks: CFGR {:08X}, PLLCFGR {:08X}, ACR {:08X}",
        cfgr.bits(),
        pll.bits(),
        acr.bits()
    );
}
