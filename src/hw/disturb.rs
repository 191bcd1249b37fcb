//! A level on a TX pin that ends by itself: TIM4, whose outputs are on two of the TX pins as another alternate function.
//!
//! The level is one pulse (RM0090, "One-pulse mode") of PWM mode 2 with inverted polarity: high, which is recessive, while the count is below
//! 1; low from 1 to the reload value; then the counter stops itself at 0, high again. It is started by the stamp timer's channel 2 in
//! hardware (OC2REF is TIM2's trigger output, and TIM4's internal trigger 1), so no instruction lies on its way, neither at its start nor at
//! its end. All values are preloaded: a write during the pulse cannot lengthen it.
//!
//! A core that stops for good, at any instruction:
//!
//! | after | the pin |
//! |---|---|
//! | [`PulseTimer::prepare`], in whole or in part | is the controller's; TIM4 may run once, and nobody sees it |
//! | [`PulseTimer::connect`], one store | is TIM4's: recessive, low once for the time prepared, recessive until the watchdog restarts the chip, which makes it an input |
//! | [`PulseTimer::disconnect`]'s first store | is the controller's |
//!
//! A debugger's halt does not stop TIM4 (RM0090, DBGMCU_APB1_FZ, which is left as after a reset). What no timer survives is the loss of its
//! clock: if the crystal stops within the pulse, the pin stays low until the chip is reset, as it does in a frame.

use cantap_firmware::TICK_HZ;
use cantap_firmware::ports::PulseTimer;
use cantap_wire::Channel;
use stm32f4xx_hal::pac::{GPIOB, TIM4};
use stm32f4xx_hal::rcc::{BusTimerClock, Enable, Rcc, Reset};

use super::stamp::StampTimer;
use crate::board::{PULSE_PINS, PulsePin};

/// Alternate functions (STM32F405 data sheet, "Alternate function mapping").
const AF_TIM4: u32 = 2;
const AF_CAN: u32 = 9;
/// TIMx_CCMR1 and 2, of the upper channel: PWM mode 2 (OCxM = 111), preloaded (OCxPE). The same of the lower channel, 8 bits below.
const PWM_2: u32 = 0x78;
/// TIMx_CCER: channels 1 and 4 enabled, active low.
const OUTPUTS: u32 = 0x3003;
/// TIMx_CR1: reload preloaded (ARPE), one pulse (OPM), only an overflow sets UIF (URS).
const ONE_PULSE: u32 = 1 << 7 | 1 << 3 | 1 << 2;
/// TIM4_SMCR: internal trigger 1, which is TIM2 (RM0090, "TIMx internal trigger connection"), starts the count (SMS = 110).
const STARTED_BY_TIM2: u32 = 1 << 4 | 6;
/// TIM2_CR2: OC2REF is the trigger output (MMS = 101).
const OC2REF_IS_TRGO: u32 = 5 << 4;
/// TIM2_CCMR1, channel 2: forced inactive; active on match.
const INACTIVE: u32 = 4 << 12;
const ACTIVE_ON_MATCH: u32 = 1 << 12;

/// TIM4 with its pins, and of the stamp timer channel 2, which starts it, and channel 3, which is its alarm.
pub struct BusPulse {
    timer: TIM4,
    stamp: StampTimer,
}

impl BusPulse {
    /// Sets the timer up; no pin is connected to it.
    pub fn start(timer: TIM4, stamp: StampTimer, rcc: &mut Rcc) -> Self {
        TIM4::enable(rcc);
        TIM4::reset(rcc);
        let divider = TIM4::timer_clock(&rcc.clocks).raw() / TICK_HZ;
        timer.psc().write(|w| w.psc().set((divider - 1) as u16));
        // SAFETY: the bits are those described above.
        unsafe {
            timer.ccmr1_output().write(|w| w.bits(PWM_2));
            timer.ccmr2_output().write(|w| w.bits(PWM_2 << 8));
            timer.ccr1().write(|w| w.bits(1));
            timer.ccr4().write(|w| w.bits(1));
            timer.cr1().write(|w| w.bits(ONE_PULSE));
            timer.egr().write(|w| w.bits(1));
            timer.ccer().write(|w| w.bits(OUTPUTS));
            timer.smcr().write(|w| w.bits(STARTED_BY_TIM2));
            let master = stamp.registers();
            master.ccmr1_output().write(|w| w.bits(INACTIVE));
            master.cr2().write(|w| w.bits(OC2REF_IS_TRGO));
        }
        Self { timer, stamp }
    }

    /// Ends the alarm's interrupt.
    pub fn acknowledge(&self) {
        self.stamp.registers().sr().write(|w| w.cc3if().clear());
    }
}

/// Gives a pin to a peripheral. Of the two registers each holds one of the pins, which `TransmitPin::connect` writes only before the
/// channel is first open, and this only while it is.
fn give(pin: PulsePin, function: u32) {
    // SAFETY: four bits for each pin, whose value is one of the functions. The registers exist for the whole program.
    unsafe {
        let port = &*GPIOB::ptr();
        match pin {
            PulsePin::B6 => port.afrl().modify(|r, w| w.bits(r.bits() & !(0xF << 24) | function << 24)),
            PulsePin::B9 => port.afrh().modify(|r, w| w.bits(r.bits() & !(0xF << 4) | function << 4)),
        };
    }
}

impl PulseTimer for BusPulse {
    fn reaches(&self, channel: Channel) -> bool {
        PULSE_PINS[channel.index()].is_some()
    }

    fn prepare(&mut self, _: Channel, at: u32, ticks: u16) {
        let master = self.stamp.registers();
        // SAFETY: every value is a time, a period, or bits described above.
        unsafe {
            master.ccmr1_output().write(|w| w.bits(INACTIVE));
            // Low from the first tick to this one.
            self.timer.arr().write(|w| w.bits(ticks.into()));
            // Takes what is preloaded, at count 0.
            self.timer.egr().write(|w| w.bits(1));
            self.timer.sr().write(|w| w.bits(0));
            // The level begins a tick after the count.
            master.ccr2().write(|w| w.bits(at.wrapping_sub(1)));
            master.ccmr1_output().write(|w| w.bits(ACTIVE_ON_MATCH));
        }
    }

    fn connect(&mut self, channel: Channel) {
        if let Some(pin) = PULSE_PINS[channel.index()] {
            give(pin, AF_TIM4);
        }
    }

    fn disconnect(&mut self) -> bool {
        PULSE_PINS.into_iter().flatten().for_each(|pin| give(pin, AF_CAN));
        let running = self.timer.cr1().read().cen().bit();
        // SAFETY: the bits are those described above.
        unsafe {
            self.stamp.registers().ccmr1_output().write(|w| w.bits(INACTIVE));
            self.timer.cr1().write(|w| w.bits(ONE_PULSE));
            // Count 0.
            self.timer.egr().write(|w| w.bits(1));
        }
        running || self.timer.sr().read().uif().bit()
    }

    fn set_alarm(&mut self, at: Option<u32>) {
        let timer = self.stamp.registers();
        if let Some(at) = at {
            // SAFETY: every value is a time.
            timer.ccr3().write(|w| unsafe { w.bits(at) });
        }
        timer.sr().write(|w| w.cc3if().clear());
        timer.dier().modify(|_, w| w.cc3ie().bit(at.is_some()));
        // As for the alarm of frames.
        if at.is_some_and(|at| at.wrapping_sub(self.stamp.now()) as i32 <= 0) {
            timer.egr().write(|w| w.cc3g().set_bit());
        }
        cortex_m::asm::dsb();
    }
}
