//! Brings channels back from bus-off while a program runs, and reports it.

use std::time::Duration;

use cantap::device::Transmission;
use cantap::recovery::Recovery;
use cantap::wire::record::TransmitFailure;
use cantap::{Device, DeviceError};

use crate::interrupt;
use crate::report::Reporter;

/// How often [`BusOffRecovery::wait`] checks.
const WAIT_EVERY: Duration = Duration::from_millis(5);

/// Looks after open channels.
pub struct BusOffRecovery {
    recovery: Option<Recovery>,
    reporter: Reporter,
}

impl BusOffRecovery {
    /// Brings channels back, or none.
    pub const fn new(recovery: Option<Recovery>, reporter: Reporter) -> Self {
        Self { recovery, reporter }
    }

    /// Call this repeatedly. It reports what it did.
    pub fn look(&mut self, device: &Device) -> Result<(), DeviceError> {
        let Some(recovery) = &mut self.recovery else { return Ok(()) };
        for channel in recovery.look(device)? {
            let number = channel.number();
            self.reporter.note(format!("channel {number} was bus-off and joins the bus again"));
        }
        Ok(())
    }

    /// Like [`Self::look`], but waits until no channel is bus-off, or for Ctrl-C: frames sent meanwhile would only fail.
    /// Returns whether it had to wait. Errors come with the next request.
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

    /// Checks immediately the next time if a transmission failed because of bus-off.
    pub fn note(&mut self, ends: &[Transmission]) {
        let off = |end: &Transmission| end.result == Err(TransmitFailure::BusOff);
        if let Some(recovery) = self.recovery.as_mut().filter(|_| ends.iter().any(off)) {
            recovery.hurry();
        }
    }

    /// Whether a channel that is bus-off will be brought back.
    pub const fn is_wanted(&self) -> bool {
        self.recovery.is_some()
    }
}
