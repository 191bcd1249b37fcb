//! The millisecond tick: TIM7.

use stm32f4xx_hal::pac::TIM7;
use stm32f4xx_hal::rcc::{BusTimerClock, Enable, Rcc, Reset};

/// Interrupts each millisecond.
pub struct Tick(TIM7);

impl Tick {
    /// Starts the timer.
    pub fn start(timer: TIM7, rcc: &mut Rcc) -> Self {
        TIM7::enable(rcc);
        TIM7::reset(rcc);
        // Divided down to 1 MHz; a thousand of those are a millisecond.
        let divider = TIM7::timer_clock(&rcc.clocks).raw() / 1_000_000;
        timer.psc().write(|w| w.psc().set((divider - 1) as u16));
        timer.arr().write(|w| w.arr().set(1_000 - 1));
        // The divider takes effect with an update event, whose flag must not stay set.
        timer.egr().write(|w| w.ug().update());
        timer.sr().write(|w| w.uif().clear());
        timer.dier().modify(|_, w| w.uie().enabled());
        timer.cr1().modify(|_, w| w.cen().enabled());
        Self(timer)
    }

    /// Ends the interrupt.
    pub fn acknowledge(&self) {
        self.0.sr().write(|w| w.uif().clear());
    }
}
