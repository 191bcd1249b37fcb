//! bxCAN 1 and 2 (RM0090 Rev 21 §32): what the firmware sees of the two controllers, and what the bus
//! ([`crate::bus`]) sees of each as a node.
//!
//! Not modelled: the time-triggered mode (the errata of these chips say that its stamps are unusable; its
//! registers read 0). In loop-back mode a controller sends only to itself: its dominant bits are counted,
//! but no other node sees them.

mod controller;
pub mod fault;
pub mod fifo;
pub mod filter;
mod identifier;
pub mod mailbox;

use cantap_can::Frame;

use crate::Clock;
use crate::hostile::{Dice, Hostile};

pub use controller::{BitTiming, Controller, MasterReset, Mode};
use filter::Filters;
pub use filter::ZeroSplit;
pub use identifier::identifier_word;

/// Registers of CAN2 begin this far above CAN1's.
const CAN2: u32 = 0x400;
/// CAN1's master control register and its reset bit.
const MCR: u32 = 0;
const MCR_RESET: u32 = 1 << 15;
/// Filter registers, in CAN1 only.
const FILTERS: std::ops::Range<u32> = 0x200..0x400;

/// Both controllers and the filter banks they share.
#[derive(Clone, Debug, Default)]
pub struct CanPair {
    /// CAN1 and CAN2.
    pub controllers: [Controller; 2],
    filters: Filters,
}

impl CanPair {
    /// Reads a register at an offset from CAN1's base; `None` where there is none.
    pub fn read(&mut self, offset: u32, now: u64) -> Option<u32> {
        self.advance(now);
        match offset {
            offset if FILTERS.contains(&offset) => self.filters.read(offset),
            0..CAN2 => self.controllers[0].read(offset),
            _ => self.controllers[1].read(offset - CAN2),
        }
    }

    /// Writes a register; `None` where there is none, or if the hardware would not accept it.
    pub fn write(&mut self, offset: u32, value: u32, now: u64) -> Option<()> {
        self.advance(now);
        if offset == MCR && value & MCR_RESET != 0 && self.controllers[0].master_reset == MasterReset::Most {
            self.filters = self.filters.after_reset();
        }
        match offset {
            offset if FILTERS.contains(&offset) => self.filters.write(offset, value),
            0..CAN2 => self.controllers[0].write(offset, value, now),
            _ => self.controllers[1].write(offset - CAN2, value, now),
        }
    }

    /// Sets what a master reset clears.
    pub fn set_master_reset(&mut self, scope: MasterReset) {
        for controller in &mut self.controllers {
            controller.master_reset = scope;
        }
    }

    /// What CAN2SB = 0 means from now on.
    pub fn set_zero_split(&mut self, zero_split: ZeroSplit) {
        self.filters.zero_split = zero_split;
    }

    /// Makes both controllers as `hostile` has them.
    pub fn set_hostile(&mut self, hostile: &Hostile, clock: Clock) {
        for (controller, salt) in self.controllers.iter_mut().zip(1..) {
            controller.faults = hostile.can;
            controller.is_hostile = true;
            controller.dice = Dice::new(hostile.seed, salt, clock);
        }
    }

    /// Ends that: see [`Dice::calm`].
    pub fn calm(&mut self) {
        self.controllers.iter_mut().for_each(|controller| controller.dice.calm());
    }

    /// A frame reached controller `n` without error.
    pub fn receive(&mut self, n: usize, frame: &Frame) {
        let found = self.filters.accept(n, identifier_word(frame));
        self.controllers[n].received(frame, found);
    }

    /// The interrupt lines of controller `n`: transmit, FIFO 0, FIFO 1, status change and error.
    pub fn irqs(&self, n: usize) -> [bool; 4] {
        self.controllers[n].irqs()
    }

    /// When [`Self::advance`] must be called next: needed only for loop-back and for what comes late.
    pub fn next_event(&self) -> Option<u64> {
        let due = |one: &Controller| [one.loopback_event(), one.next_flag()].into_iter().flatten().min();
        self.controllers.iter().filter_map(due).min()
    }

    /// Completes what loop-back sent until `now`.
    pub fn advance(&mut self, now: u64) {
        for n in 0..self.controllers.len() {
            self.controllers[n].advance_flags(now);
            while let Some(frame) = self.controllers[n].advance_loopback(now) {
                self.receive(n, &frame);
            }
        }
    }

    /// Puts controller `n` into its reset state, as the clock controller's reset bit does; CAN1's also
    /// resets the filters.
    pub fn reset(&mut self, n: usize) {
        self.controllers[n] = self.controllers[n].after_reset();
        if n == 0 {
            self.filters = self.filters.after_reset();
        }
    }
}
