//! The banks of acceptance filters.

use cantap_firmware::bus::filters::{BANKS, Layout, Shape};
use cantap_firmware::ports::FilterBanks;

use super::registers::Registers;

/// The acceptance filters of both controllers. They alone write FMR, FM1R, FS1R, FFA1R, FA1R and the banks.
pub struct CanFilters {
    can1: Registers,
}

impl CanFilters {
    pub(super) const fn new(can1: Registers) -> Self {
        Self { can1 }
    }
}

impl FilterBanks for CanFilters {
    fn write(&mut self, layout: &Layout) -> bool {
        let can = &self.can1;
        let bits = |is: fn(Shape) -> bool| {
            let bit = |(number, bank): (usize, &Option<_>)| {
                u32::from(bank.is_some_and(|bank: cantap_firmware::bus::filters::Bank| is(bank.shape)))
                    << number
            };
            layout.banks.iter().enumerate().map(bit).sum::<u32>()
        };
        let lists = bits(|shape| matches!(shape, Shape::List32 | Shape::List16));
        let wide = bits(|shape| matches!(shape, Shape::List32 | Shape::Mask32));
        let active = bits(|_| true);

        // In initialisation mode neither controller receives, so it is entered only when necessary. It is
        // also the mode after a reset.
        let reshaped = can.fmr().read().finit().bit()
            || can.fmr().read().can2sb().bits() != layout.split
            || can.fm1r().read().bits() != lists
            || can.fs1r().read().bits() != wide
            || can.fa1r().read().bits() != active;
        if reshaped {
            can.fmr().modify(|_, w| {
                // SAFETY: a layout's split is at most 28, and the field has six bits.
                unsafe { w.can2sb().bits(layout.split) };
                w.finit().set_bit()
            });
            // SAFETY: one bit for each of the 28 banks, no others.
            can.fm1r().write(|w| unsafe { w.bits(lists) });
            // SAFETY: as above.
            can.fs1r().write(|w| unsafe { w.bits(wide) });
            // SAFETY: as above; all banks lead to FIFO 0.
            can.ffa1r().write(|w| unsafe { w.bits(0) });
        }
        let mut differed = reshaped;
        for (number, bank) in layout.banks.iter().enumerate().take(BANKS) {
            let Some(bank) = bank else { continue };
            let registers = can.fb(number);
            if registers.fr1().read().bits() == bank.first && registers.fr2().read().bits() == bank.second {
                continue;
            }
            differed = true;
            // A bank can only be written while it is off.
            // SAFETY: one bit for each of the 28 banks, no others.
            can.fa1r().modify(|r, w| unsafe { w.bits(r.bits() & !(1 << number)) });
            // SAFETY: every value is a filter.
            registers.fr1().write(|w| unsafe { w.bits(bank.first) });
            // SAFETY: every value is a filter.
            registers.fr2().write(|w| unsafe { w.bits(bank.second) });
            // SAFETY: one bit for each of the 28 banks, no others.
            can.fa1r().modify(|r, w| unsafe { w.bits(r.bits() | 1 << number) });
        }
        if reshaped {
            // SAFETY: one bit for each of the 28 banks, no others.
            can.fa1r().write(|w| unsafe { w.bits(active) });
            can.fmr().modify(|_, w| w.finit().clear_bit());
        }
        differed
    }
}
