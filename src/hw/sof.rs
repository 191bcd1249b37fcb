//! The stamp timer's latch of USB's start of frame: channel 4 of TIM2 captures the count when OTG_FS has received a SOF token.
//!
//! TIM2's internal trigger 1 is set to OTG_FS's SOF pulse, in place of TIM8 (RM0090, TIM2_OR, `ITR1_RMP` = 10). The trigger is selected without a
//! slave mode, so that it neither starts nor resets the count; the channel's input is the trigger itself (CCMR2, `CC4S` = 11: TRC). No pin and no
//! interrupt is involved.

use cantap_firmware::bus::sof::SofReading;
use stm32f4xx_hal::pac::OTG_FS_DEVICE;

use super::stamp::StampTimer;

/// The latch. For priority 2 only, like everything that reads OTG_FS.
pub struct SofLatch(StampTimer);

impl SofLatch {
    /// Starts latching.
    pub fn start(stamp: StampTimer) -> Self {
        let timer = stamp.registers();
        timer.or().write(|w| w.itr1_rmp().otg_fs_sof());
        timer.smcr().write(|w| w.ts().itr1());
        // The source can only be chosen while the channel is off.
        timer.ccmr2_input().write(|w| w.cc4s().trc());
        timer.ccer().modify(|_, w| w.cc4e().enabled());
        Self(stamp)
    }

    /// What came since the last call.
    pub fn take(&mut self) -> Option<SofReading> {
        let timer = self.0.registers();
        let status = timer.sr().read();
        if !status.cc4if().bit() {
            return None;
        }
        // The first read clears the flag.
        let before = timer.ccr4().read().bits();
        let frame = usb().dsts().read().fnsof().bits() & 0x7FF;
        let after = timer.ccr4().read().bits();
        let several = status.cc4of().bit();
        if several {
            // Flags are cleared by writing 0; the others, including the alarm's, are left alone.
            timer.sr().write(|w| w.cc4of().clear());
        }
        Some(SofReading { latched: [before, after], frame, now: self.0.now(), several })
    }
}

fn usb() -> &'static stm32f4xx_hal::pac::otg_fs_device::RegisterBlock {
    // SAFETY: DSTS has no side effects, and priority 2, which this runs at, is the USB driver's.
    unsafe { &*OTG_FS_DEVICE::ptr() }
}
