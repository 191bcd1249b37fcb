//! Takes a controller on and off its bus.

use cantap_firmware::ports::Control;
use cantap_wire::message::{ChannelConfig, Mode};

use super::registers::Registers;
use crate::board::TransmitPin;

/// How far [`Control::halt`] has come.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Halt {
    None,
    /// The reset is requested; the controller acknowledges it by sleeping.
    Resetting,
    /// It has been woken and is to enter initialisation mode.
    Entering,
}

/// A controller's control half. It alone writes MCR and BTR, and IER while the controller is off the bus.
pub struct CanControl {
    can: Registers,
    halt: Halt,
    /// Until the controller is connected to it.
    transmit: Option<TransmitPin>,
}

impl CanControl {
    pub(super) const fn new(can: Registers, transmit: TransmitPin) -> Self {
        Self { can, halt: Halt::None, transmit: Some(transmit) }
    }

    /// Leaves sleep and enters initialisation mode with one write: without INRQ a controller would first wait for eleven recessive
    /// bits, which never come on a stuck bus (Zephyr, issue 71142).
    fn ask_for_initialisation(&self) {
        self.can.mcr().modify(|_, w| w.sleep().clear_bit().inrq().set_bit());
    }
}

impl Control for CanControl {
    fn stop(&mut self) {
        self.halt = Halt::None;
        self.ask_for_initialisation();
    }

    /// The controller's own reset, requested only once: a second request, or any write to MCR before SLAK has acknowledged the
    /// first, would restart it or be lost. Same as Linux's `bxcan_chip_softreset`, but without waiting.
    fn halt(&mut self) {
        match self.halt {
            Halt::None => {
                self.can.mcr().modify(|_, w| w.reset().set_bit());
                self.halt = Halt::Resetting;
            }
            Halt::Resetting if self.can.msr().read().slak().bit() => {
                self.ask_for_initialisation();
                self.halt = Halt::Entering;
            }
            Halt::Resetting | Halt::Entering => {}
        }
    }

    fn is_stopped(&self) -> bool {
        self.can.msr().read().inak().bit()
    }

    fn start(&mut self, config: &ChannelConfig) {
        let timing = &config.timing;
        let silent = matches!(config.mode, Mode::ListenOnly | Mode::SilentLoopback);
        let loopback = matches!(config.mode, Mode::Loopback | Mode::SilentLoopback);
        self.can.btr().write(|w| {
            // SAFETY: the timing is valid, so each value minus one fits its field.
            unsafe {
                w.brp().bits(timing.prescaler - 1);
                w.ts1().bits(timing.segment1 - 1);
                w.ts2().bits(timing.segment2 - 1);
                w.sjw().bits(timing.jump_width - 1);
            }
            w.silm().bit(silent).lbkm().bit(loopback)
        });
        self.can.mcr().modify(|_, w| {
            // The stamps of time-triggered mode must not be used (ES0206 2.13.1, for the F42x; the F405 is assumed to
            // be the same).
            w.ttcm().clear_bit();
            w.abom().bit(!config.manual_recovery);
            w.awum().clear_bit();
            w.nart().bit(config.one_shot);
            // A full FIFO keeps the frames it holds.
            w.rflm().set_bit();
            // Mailboxes are sent in the order of their requests.
            w.txfp().set_bit()
        });
        self.can.ier().modify(|_, w| {
            w.fmpie0().set_bit().tmeie().set_bit();
            w.errie().set_bit().lecie().set_bit();
            w.ewgie().set_bit().epvie().set_bit().bofie().set_bit()
        });
        // Only now: the controller has acknowledged initialisation mode.
        if let Some(pin) = self.transmit.take() {
            pin.connect();
        }
        self.resume();
    }

    fn resume(&mut self) {
        self.can.mcr().modify(|_, w| w.inrq().clear_bit());
    }
}
