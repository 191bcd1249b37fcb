//! The two bxCAN controllers (RM0090, "Controller area network"), each in two halves that share no register
//! that both write: [`CanTraffic`] for the tasks of priority 4, [`CanControl`] for commands. [`CanFilters`]
//! are the filter banks; CAN1's registers hold those of both.
//!
//! The `bxcan` crate is not used: its `enable` waits for the bus, it cannot lock the receive FIFO (so an
//! overrun would overwrite the newest frame) and it hides which mailbox a confirmation belongs to.

mod bells;
mod control;
mod filters;
mod registers;
mod traffic;

use core::sync::atomic::AtomicU32;

use cantap_firmware::ports::Control;
use cantap_wire::CHANNELS;
use stm32f4xx_hal::pac::{CAN1, CAN2};
use stm32f4xx_hal::rcc::{Enable, Rcc};

pub use bells::Bells;
pub use control::CanControl;
pub use filters::CanFilters;
use registers::Registers;
pub use traffic::CanTraffic;

use crate::board::TransmitPin;

/// Both controllers' halves, and the filters.
pub struct Controllers {
    /// For the tasks of priority 4.
    pub traffic: [CanTraffic; CHANNELS],
    /// For commands.
    pub control: [CanControl; CHANNELS],
    /// For commands.
    pub filters: CanFilters,
    /// For the interrupts that stamp, and the tasks that they raise.
    pub bells: (Bells<0>, Bells<1>),
}

impl Controllers {
    /// Switches both controllers on; they stay off the bus and let no frame pass. Each is connected to its TX pin only when it has
    /// acknowledged initialisation mode, before it first joins its bus. Neither is reset here: `entry` did that, with all pins inputs.
    pub fn new(
        _: (CAN1, CAN2),
        transmit: [TransmitPin; CHANNELS],
        rcc: &mut Rcc,
        sent_at: &'static [AtomicU32; CHANNELS],
    ) -> Self {
        CAN1::enable(rcc);
        CAN2::enable(rcc);
        let blocks = [Registers::of(CAN1::ptr()), Registers::of(CAN2::ptr())];
        let [first, second] = transmit;
        let mut control = [CanControl::new(blocks[0], first), CanControl::new(blocks[1], second)];
        // After a reset a controller sleeps.
        control.iter_mut().for_each(Control::stop);
        Self {
            traffic: [CanTraffic::new(blocks[0], &sent_at[0]), CanTraffic::new(blocks[1], &sent_at[1])],
            control,
            filters: CanFilters::new(Registers::of(CAN1::ptr())),
            bells: (Bells::new(), Bells::new()),
        }
    }
}
