//! The stamp timer: TIM2, 32 bits, free running at 12 MHz, with one compare channel as the alarm. Another is `sof.rs`'s.

use core::ops::Deref;

use cantap_firmware::ports::Clock;
use cantap_firmware::{TICK_HZ, TICKS_PER_US};
use stm32f4xx_hal::pac::TIM2;
use stm32f4xx_hal::pac::tim2::RegisterBlock;
use stm32f4xx_hal::rcc::{BusTimerClock, Enable, Rcc, Reset};

/// The running timer. Copies are the same timer: any priority may read it, only the alarm's owner sets
/// the alarm.
#[derive(Clone, Copy)]
pub struct StampTimer(*const RegisterBlock);

// SAFETY: the registers are there for the whole program, wherever it touches them from. `start` took the peripheral,
// so nobody else writes them; of the copies, one sets the alarm and the others read.
unsafe impl Send for StampTimer {}

impl Deref for StampTimer {
    type Target = RegisterBlock;

    #[inline]
    fn deref(&self) -> &RegisterBlock {
        // SAFETY: the pointer is the PAC's, of the peripheral that `start` took.
        unsafe { &*self.0 }
    }
}

impl StampTimer {
    /// Starts the timer at 0.
    pub fn start(_: TIM2, rcc: &mut Rcc) -> Self {
        TIM2::enable(rcc);
        TIM2::reset(rcc);
        let timer = Self(TIM2::ptr());
        // 72 MHz / 6: the timers of APB1 run at twice its 36 MHz.
        let divider = TIM2::timer_clock(&rcc.clocks).raw() / TICK_HZ;
        timer.psc().write(|w| w.psc().set((divider - 1) as u16));
        // SAFETY: every value is a period; this one is the longest.
        timer.arr().write(|w| unsafe { w.bits(u32::MAX) });
        // The divider takes effect with an update event, whose flag is not wanted.
        timer.egr().write(|w| w.ug().update());
        timer.sr().write(|w| w.uif().clear());
        timer.cr1().modify(|_, w| w.cen().enabled());
        timer
    }

    /// Ends the alarm's interrupt.
    pub fn acknowledge(self) {
        self.sr().write(|w| w.cc1if().clear());
    }
}

impl Clock for StampTimer {
    /// 14 µs: longer than the other handlers of the alarm's priority take for a frame, those that drain before it, and any lock.
    /// Stamps are taken at a higher priority and do not wait; draining the FIFOs has 141 µs.
    const ALARM_EARLY_TICKS: u32 = 14 * TICKS_PER_US;

    #[inline]
    fn wait_until(&self, at: u32) {
        // Bounded: whoever calls this has found that the time is at most 1.5 ALARM_EARLY_TICKS ahead.
        while (at.wrapping_sub(self.now()) as i32) > 0 {}
    }

    #[inline]
    fn now(&self) -> u32 {
        self.cnt().read().bits()
    }

    fn set_alarm(&self, at: Option<u32>) {
        let Some(at) = at else {
            self.dier().modify(|_, w| w.cc1ie().disabled());
            self.acknowledge();
            return;
        };
        // SAFETY: every value is a time.
        self.ccr1().write(|w| unsafe { w.bits(at) });
        self.acknowledge();
        self.dier().modify(|_, w| w.cc1ie().enabled());
        // The counter may have passed the time before the comparison was set. If it passes it just now, the
        // interrupt comes twice, which does no harm.
        if at.wrapping_sub(self.now()) as i32 <= 0 {
            self.egr().write(|w| w.cc1g().set_bit());
        }
    }
}
