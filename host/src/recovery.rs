//! Brings channels back on the bus some time after they went bus-off, where their configuration leaves that to the host.
//!
//! It is what `restart-ms` is to SocketCAN: longer than the controller's own recovery (128 times 11 recessive bits), so that
//! a broken node does not come back every few milliseconds.

use std::time::{Duration, Instant};

use cantap_wire::record::ErrorState;
use cantap_wire::{CHANNELS, Channel, Refusal};

use crate::{Device, DeviceError};

/// How often the device is asked.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Looks after channels that are open with manual recovery.
#[derive(Clone, Debug)]
pub struct Recovery {
    after: Duration,
    off_since: [Option<Instant>; CHANNELS],
    look_at: Instant,
}

impl Recovery {
    /// Channels come back so long after they went bus-off.
    pub fn new(after: Duration) -> Self {
        Self { after, off_since: [None; CHANNELS], look_at: Instant::now() }
    }

    /// Looks the next time, however soon that is: there is a sign that a channel went off.
    pub fn hurry(&mut self) {
        self.look_at = Instant::now();
    }

    /// Whether a channel is bus-off and has still to wait.
    pub fn is_waiting(&self) -> bool {
        self.off_since.iter().any(Option::is_some)
    }

    /// To be called again and again: asks the device now and then, and recovers what has been off for long enough.
    /// Returns the channels that it recovered.
    pub fn look(&mut self, device: &Device) -> Result<Vec<Channel>, DeviceError> {
        let now = Instant::now();
        let mut recovered = Vec::new();
        if now < self.look_at {
            return Ok(recovered);
        }
        self.look_at = now + LOOK_EVERY;
        let status = device.status()?;
        for channel in Channel::ALL {
            let state = &status.channels[channel.index()];
            let since = &mut self.off_since[channel.index()];
            let is_off =
                state.state == ErrorState::BusOff && state.open.is_some_and(|config| config.manual_recovery);
            if !is_off {
                *since = None;
            } else if now.duration_since(*since.get_or_insert(now)) >= self.after {
                *since = None;
                match device.recover(channel) {
                    Ok(()) => recovered.push(channel),
                    Err(DeviceError::Refused { refusal: Refusal::NotBusOff | Refusal::ChannelClosed }) => {}
                    Err(error) => return Err(error),
                }
            }
        }
        Ok(recovered)
    }
}
