//! Where a controller's registers are.

use core::ops::Deref;

use stm32f4xx_hal::pac::can1::RegisterBlock;

/// A controller's registers.
#[derive(Clone, Copy)]
pub(super) struct Registers(*const RegisterBlock);

impl Registers {
    /// Only for `Controllers::new`, with the PAC's pointers.
    pub(super) const fn of(block: *const RegisterBlock) -> Self {
        Self(block)
    }
}

// SAFETY: the registers exist for the whole program, from whatever context it touches them. The halves that hold
// copies of the pointer write disjoint registers, as their docs say.
unsafe impl Send for Registers {}

impl Deref for Registers {
    type Target = RegisterBlock;

    #[inline]
    fn deref(&self) -> &RegisterBlock {
        // SAFETY: the pointer is one of the PAC's, made from a peripheral that `Controllers::new` took.
        unsafe { &*self.0 }
    }
}
