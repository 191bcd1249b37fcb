//! Where a controller's registers are.

use core::ops::Deref;

use stm32f4xx_hal::pac::can1::RegisterBlock;

/// A controller's registers.
#[derive(Clone, Copy)]
pub(super) struct Registers(*const RegisterBlock);

impl Registers {
    /// For `Controllers::new` alone, with the PAC's pointers.
    pub(super) const fn of(block: *const RegisterBlock) -> Self {
        Self(block)
    }
}

// SAFETY: the registers are there for the whole program, wherever it touches them from. What the halves that hold
// copies of the pointer write is disjoint, as their docs say.
unsafe impl Send for Registers {}

impl Deref for Registers {
    type Target = RegisterBlock;

    #[inline]
    fn deref(&self) -> &RegisterBlock {
        // SAFETY: the pointer is one of the PAC's, made from a peripheral that `Controllers::new` took.
        unsafe { &*self.0 }
    }
}
