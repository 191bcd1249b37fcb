//! The independent watchdog: restarts the chip when the firmware hangs.

use stm32f4xx_hal::pac::{DBGMCU, IWDG};
use stm32f4xx_hal::prelude::*;
use stm32f4xx_hal::watchdog::IndependentWatchdog;

/// Period in ms. Erasing the sector of saved settings may take 2 s (STM32F405 data sheet, "Flash memory programming", 32 bits at a time), during
/// which nothing runs. The period is longer than that even with the watchdog's oscillator at its fastest, 47 kHz rather than 32 kHz: 4000 ms × 32 /
/// 47 = 2.7 s.
const PERIOD_MS: u32 = 4_000;

/// The running watchdog; it cannot be stopped.
pub struct Watchdog(IndependentWatchdog);

impl Watchdog {
    /// Starts it. It pauses while a debugger has halted the processor.
    pub fn start(iwdg: IWDG, debug: &DBGMCU) -> Self {
        let mut watchdog = IndependentWatchdog::new(iwdg);
        watchdog.stop_on_debug(debug, true);
        watchdog.start(PERIOD_MS.millis());
        Self(watchdog)
    }

    /// Starts another period.
    pub fn feed(&mut self) {
        self.0.feed();
    }
}
