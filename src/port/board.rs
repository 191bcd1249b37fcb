//! The whole board, as commands see it: the hardware's traits ([`crate::ports`]) and the capture, which belongs to other tasks.

use cantap_wire::framing;
use cantap_wire::{CHANNELS, Channel, Command, Hello, Refusal};

use crate::bus::capture::Capture;
#[cfg(any(feature = "disturb", not(target_os = "none")))]
use crate::bus::disturb::Disturber;
use crate::bus::sof::SofReading;
#[cfg(any(feature = "disturb", not(target_os = "none")))]
use crate::ports::PulseTimer;
use crate::ports::{Chip, Clock, Control, EdgeMeter, FilterBanks, Traffic};

/// All of the hardware, and access to the buses' state.
pub trait Board<'q, const N: usize> {
    /// Controllers' traffic side.
    type Traffic: Traffic;
    /// Controllers' control side.
    type Control: Control;
    /// Stamp timer.
    type Clock: Clock;
    /// Acceptance filters.
    type Filters: FilterBanks;
    /// The chip.
    type Chip: Chip;
    /// Meter for the receive pins.
    type Meter: EdgeMeter;

    /// Lets `act` touch what the tasks of priority 4 own. It holds them up meanwhile, so `act` must be short: frames wait in the
    /// FIFOs, and frames that are due are sent late. Stamps are taken at a higher priority and do not wait.
    fn with_capture<R>(
        &mut self,
        act: impl FnOnce(&mut Capture<'q, N>, &mut [Self::Traffic; CHANNELS], &Self::Clock) -> R,
    ) -> R;
    /// The stamp timer now.
    fn now(&self) -> u32;
    /// What the stamp timer has latched of USB's start of frame since the last call; nothing if none came.
    fn take_sof(&mut self) -> Option<SofReading>;
    /// The CRC of a message ([`cantap_wire::framing::crc32`]), in hardware where available.
    fn crc32(&mut self, message: &[u8]) -> u32 {
        framing::crc32(message)
    }
    /// A channel's control side.
    fn control(&mut self, channel: Channel) -> &mut Self::Control;
    /// The acceptance filters.
    fn filters(&mut self) -> &mut Self::Filters;
    /// The chip.
    fn chip(&mut self) -> &mut Self::Chip;
    /// The meter for the receive pins.
    fn meter(&mut self) -> &mut Self::Meter;

    /// Lets `act` touch what disturbs a bus, too; `None` where nothing can.
    #[cfg(any(feature = "disturb", not(target_os = "none")))]
    fn with_disturber<R>(
        &mut self,
        _act: impl FnOnce(&mut Disturber, &mut dyn PulseTimer, &mut Capture<'q, N>, &Self::Clock) -> R,
    ) -> Option<R> {
        None
    }

    /// Corrects the device's description of itself, where its hardware is not a board's.
    fn describe(&self, _hello: &mut Hello) {}
    /// Refuses a command that this hardware cannot carry out, before anything has changed. A board's hardware can do everything.
    fn prepare(&mut self, _command: &Command) -> Result<(), Refusal> {
        Ok(())
    }

    /// Whether a channel can be open without anybody knowing its bit rate ([`BitTiming::UNKNOWN`](cantap_wire::BitTiming::UNKNOWN)), since
    /// there is no controller to be set to one: a board has some.
    fn needs_no_bit_rate(&self) -> bool {
        false
    }

    /// Whether the controllers transmit CAN FD frames: a board's do not.
    fn sends_fd(&self) -> bool {
        false
    }

    /// Whether a channel is open.
    fn is_open(&mut self, channel: Channel) -> bool {
        self.with_capture(|capture, _, _| capture.config(channel).is_some())
    }
}
