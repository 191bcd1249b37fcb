//! The interrupts that stamp.

use stm32f4xx_hal::pac::can1::RegisterBlock;
use stm32f4xx_hal::pac::{CAN1, CAN2};

/// Bits of IER: transmit mailbox empty, FIFO 0 message pending, errors of any kind (RM0090, CAN_IER).
pub(super) const TMEIE: usize = 0;
const FMPIE0: usize = 1;
const ERRIE: usize = 15;

/// The switches of a controller's interrupts: `CAN` is 0 or 1. Those for reception and transmission each only stamp, silence themselves and
/// leave the rest to a task of lower priority, which enables them again. That for errors is silenced only if its flag does not clear.
///
/// All these tasks and interrupts share these. The switches are bits of one register, each changed atomically through its bit-band alias
/// (Cortex-M4 technical reference manual, "Bit-banding"): if the whole register were read and written back, a change made by an
/// interrupt in between would be undone. Commands write the register only while the controller is off the bus.
///
/// FIFO 0's overrun needs no interrupt: a FIFO that overran is full, and the frames in it raise the receive interrupt.
pub struct Bells<const CAN: usize>(());

#[expect(clippy::unused_self, reason = "only the owner of the bells may ring them")]
impl<const CAN: usize> Bells<CAN> {
    /// Only for `Controllers::new`.
    pub(super) const fn new() -> Self {
        Self(())
    }

    #[inline]
    fn registers() -> &'static RegisterBlock {
        let block = if CAN == 0 { CAN1::ptr() } else { CAN2::ptr() };
        // SAFETY: the registers exist for the whole program, and `Controllers::new`, which makes the only bells, took them.
        unsafe { &*block }
    }

    /// Reads the register back, so that the interrupt line has fallen before the handler returns.
    #[inline]
    fn silence(bit: usize) {
        switch(Self::registers(), bit, false);
        Self::registers().ier().read();
    }

    /// Ends the receive interrupt although frames are waiting.
    #[inline]
    pub fn silence_receive(&self) {
        Self::silence(FMPIE0);
    }

    /// Enables the receive interrupt again; it comes at once if a frame is waiting.
    ///
    /// The last thing that the draining tasks do. A store that is still on its way to a slow bus when an exception returns may have the
    /// wrong handler entered next (Cortex-M4 erratum 838869, "Store immediate overlapping exception return operation might vector to
    /// incorrect interrupt", whose workaround this barrier is).
    #[inline]
    pub fn open_receive(&self) {
        switch(Self::registers(), FMPIE0, true);
        cortex_m::asm::dsb();
    }

    /// Ends the error interrupt although its flag is set.
    #[cold]
    pub fn silence_errors(&self) {
        Self::silence(ERRIE);
    }

    /// Enables the error interrupt again.
    pub fn open_errors(&self) {
        switch(Self::registers(), ERRIE, true);
    }

    /// Ends the transmit interrupt although a mailbox has finished, until [`Traffic::await_finished`].
    #[inline]
    pub fn silence_transmit(&self) {
        Self::silence(TMEIE);
    }
}

/// Switches a controller's interrupt through its bit's alias (see [`Bells`]).
#[inline]
pub(super) fn switch(controller: &RegisterBlock, bit: usize, on: bool) {
    const PERIPHERALS: usize = 0x4000_0000;
    const ALIAS: usize = 0x4200_0000;
    let register = controller.ier().as_ptr() as usize;
    let alias = (ALIAS + (register - PERIPHERALS) * 32 + bit * 4) as *mut u32;
    // SAFETY: the controllers lie in the first megabyte of the peripherals, so the word is IER's bit.
    unsafe { alias.write_volatile(u32::from(on)) };
}
