//! The stamp timer: TIM2, 32 bits, free running at 12 MHz, with one compare channel as the alarm. `sof.rs` uses another channel.

use cantap_firmware::ports::Clock;
use cantap_firmware::{TICK_HZ, TICKS_PER_US};
use stm32f4xx_hal::pac::TIM2;
use stm32f4xx_hal::pac::tim2::RegisterBlock;
use stm32f4xx_hal::rcc::{BusTimerClock, Enable, Rcc, Reset};

/// The running timer, readable by any task at any time. Copies refer to the same timer.
#[derive(Clone, Copy)]
pub struct StampTimer(());

/// The timer with its alarm. There is only one, which cannot be copied: only its owner can set the alarm.
pub struct StampAlarm(StampTimer);

impl StampTimer {
    /// Starts the timer at 0.
    pub fn start(_: TIM2, rcc: &mut Rcc) -> StampAlarm {
        TIM2::enable(rcc);
        TIM2::reset(rcc);
        let timer = Self(()).registers();
        // 72 MHz / 6: APB1's timers run at twice its 36 MHz.
        let divider = TIM2::timer_clock(&rcc.clocks).raw() / TICK_HZ;
        timer.psc().write(|w| w.psc().set((divider - 1) as u16));
        // SAFETY: every value is a period; this one is the longest.
        timer.arr().write(|w| unsafe { w.bits(u32::MAX) });
        // The divider takes effect with an update event, whose flag must not stay set.
        timer.egr().write(|w| w.ug().update());
        timer.sr().write(|w| w.uif().clear());
        timer.cr1().modify(|_, w| w.cen().enabled());
        StampAlarm(Self(()))
    }

    /// The current count.
    #[inline]
    pub fn now(self) -> u32 {
        self.registers().cnt().read().bits()
    }

    /// The registers, for [`StampAlarm`] and for the latch, which uses another channel.
    #[inline]
    #[expect(clippy::unused_self, reason = "a timer proves that it was started")]
    pub(super) fn registers(self) -> &'static RegisterBlock {
        // SAFETY: the registers exist for the whole program. `start` took the peripheral and makes the only alarm, so only its
        // owner writes the alarm's registers; the latch writes channel 4's, at the start.
        unsafe { &*TIM2::ptr() }
    }
}

impl StampAlarm {
    /// The timer, for reading.
    pub fn timer(&self) -> StampTimer {
        self.0
    }

    /// Ends the alarm's interrupt.
    pub fn acknowledge(&self) {
        self.0.registers().sr().write(|w| w.cc1if().clear());
    }
}

impl Clock for StampAlarm {
    /// 14 µs: longer than any lock, and than what the other handlers of the alarm's priority, which drain before it runs, take
    /// for a frame. Stamps are taken at a higher priority and do not wait; draining the FIFOs may wait 141 µs.
    const ALARM_EARLY_TICKS: u32 = 14 * TICKS_PER_US;

    #[inline]
    fn wait_until(&self, at: u32) {
        // Bounded: the caller has made sure that the time is at most 1.5 ALARM_EARLY_TICKS ahead, and the timer counts as long as the
        // processor does, from the same clock.
        while (at.wrapping_sub(self.now()) as i32) > 0 {}
    }

    #[inline]
    fn now(&self) -> u32 {
        self.0.now()
    }

    fn set_alarm(&self, at: Option<u32>) {
        let timer = self.0.registers();
        let Some(at) = at else {
            timer.dier().modify(|_, w| w.cc1ie().disabled());
            self.acknowledge();
            cortex_m::asm::dsb();
            return;
        };
        // SAFETY: every value is a time.
        timer.ccr1().write(|w| unsafe { w.bits(at) });
        self.acknowledge();
        timer.dier().modify(|_, w| w.cc1ie().enabled());
        // The counter may have passed the time before the comparison was set. If it passes it right now,
        // the interrupt comes twice, which does no harm.
        if at.wrapping_sub(self.now()) as i32 <= 0 {
            timer.egr().write(|w| w.cc1g().set_bit());
        }
        // Often the last thing that a task does (Cortex-M4 erratum 838869, see `Bells::open_receive`).
        cortex_m::asm::dsb();
    }
}
