//! Brings channels back from bus-off while a command runs, and says so.

use std::time::Duration;

use cantap::device::Transmission;
use cantap::recovery::Recovery;
use cantap::wire::record::TransmitFailure;
use cantap::{Device, DeviceError};

use crate::interrupt;

/// How often [`Rescue::wait`] looks.
const WAIT_EVERY: Duration = Duration::from_millis(5);

/// Looks after the channels that a command has open.
pub struct Rescue {
    recovery: Option<Recovery>,
}

impl Rescue {
    /// Brings channels back, or none.
    pub const fn new(recovery: Option<Recovery>) -> Self {
        Self { recovery }
    }

    /// To be called again and again. Says on standard error what it did.
    pub fn look(&mut self, device: &Device) -> Result<(), DeviceError> {
        let Some(recovery) = &mut self.recovery else { return Ok(()) };
        for channel in recovery.look(device)? {
            eprintln!("cantap: channel {} was bus-off and joins the bus again", channel.number());
        }
        Ok(())
    }

    /// As [`Self::look`], and waits until no channel is bus-off, or Ctrl-C: what is sent meanwhile would only fail. Returns
    /// whether it had to wait. An error comes with the next request.
    pub fn wait(&mut self, device: &Device) -> bool {
        let mut waited = false;
        while self.look(device).is_ok() && self.is_waiting() && !interrupt::requested() {
            waited = true;
            std::thread::sleep(WAIT_EVERY);
        }
        waited
    }

    /// Whether a channel is bus-off and will be brought back.
    pub fn is_waiting(&self) -> bool {
        self.recovery.as_ref().is_some_and(Recovery::is_waiting)
    }

    /// Looks the next time at once if a transmission failed for bus-off.
    pub fn note(&mut self, ends: &[Transmission]) {
        let off = |end: &Transmission| end.result == Err(TransmitFailure::BusOff);
        if let Some(recovery) = self.recovery.as_mut().filter(|_| ends.iter().any(off)) {
            recovery.hurry();
        }
    }

    /// Whether a channel that is bus-off will be brought back.
    pub const fn is_on_duty(&self) -> bool {
        self.recovery.is_some()
    }
}
